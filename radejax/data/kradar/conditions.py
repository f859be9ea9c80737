"""Conditions of K-Radar's sequences: environment, time of day, weather."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple, get_args

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike, read_text

Weather = Literal[
    "normal", "overcast", "fog", "rain", "sleet", "lightsnow", "heavysnow"
]
WEATHERS: tuple[str, ...] = get_args(Weather)

# Environment, time and weather of sequences 1 to 58, as published by K-Radar.
_CONDITIONS = {
    ("urban", "night", "normal"): (1, 6),
    ("highway", "night", "normal"): (2, 3, 4),
    ("urban", "day", "normal"): (5, 14, 15, 18, 20),
    ("alleyway", "night", "normal"): (7,),
    ("university", "night", "normal"): (8,),
    ("highway", "day", "normal"): (9, 10, 11, 12),
    ("highway", "day", "overcast"): (13,),
    ("university", "day", "normal"): (16, 17),
    ("alleyway", "day", "normal"): (19,),
    ("alleyway", "night", "rain"): (21,),
    ("urban", "night", "overcast"): (22,),
    ("urban", "night", "rain"): (23, 24, 25),
    ("countryside", "day", "rain"): (26, 32, 33),
    ("countryside", "day", "sleet"): (27, 31),
    ("mountain", "day", "sleet"): (28, 29),
    ("parkinglots", "day", "sleet"): (30,),
    ("countryside", "night", "rain"): (34,),
    ("parkinglots", "night", "sleet"): (35, 36),
    ("countryside", "night", "sleet"): (37,),
    ("mountain", "day", "fog"): (38, 39, 40, 41),
    ("urban", "day", "lightsnow"): (42, 43),
    ("shoulder", "day", "fog"): (44, 45),
    ("highway", "night", "heavysnow"): (46, 47),
    ("highway", "night", "lightsnow"): (48, 49),
    ("highway", "night", "sleet"): (50, 51, 52),
    ("highway", "day", "sleet"): (53,),
    ("urban", "day", "heavysnow"): (54, 55, 56, 57, 58),
}


class Conditions(NamedTuple):
    """Conditions of one sequence, as written in its `description.txt`."""

    environment: str
    time: str
    weather: str


UNKNOWN_CONDITIONS = Conditions("unknown", "unknown", "unknown")
KRADAR_CONDITIONS: Mapping[int, Conditions] = {
    sequence: Conditions(*names)
    for names, sequences in _CONDITIONS.items()
    for sequence in sequences
}
"""Conditions of K-Radar's sequences 1 to 58."""


def read_description(path: PathLike) -> Conditions:
    """Reads `description.txt` with environment, time and weather on one line.

    Raises:
        DataError: The file is malformed; the message names file and line.
    """
    lines = read_text(path).splitlines()
    fields = [field.strip().lower() for field in lines[0].split(",")] if lines else []
    if len(fields) != 3 or not all(fields):
        raise DataError(
            f"{path}:1: {lines[0][:80] if lines else ''!r}, expected "
            "'environment,time,weather', such as urban,night,normal"
        )
    return Conditions(*fields)


def check_weather(names: Iterable[str]) -> None:
    """Raises a `UserError` if there are no names or one is unknown."""
    names = tuple(names)
    known = (*WEATHERS, "unknown")
    if not names or not set(names) <= set(known):
        raise UserError(f"unknown weather {names}; available: {', '.join(known)}")
