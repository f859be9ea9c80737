"""What K-Radar says about whole sequences: conditions, calibration, camera, splits.

Facts of the published data set that its folders do not always carry (conditions of
the 58 sequences, LiDAR offset, split rule) are built in.
"""

from __future__ import annotations

import dataclasses
import math
import os
import pathlib
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from radejax.core.errors import DataError
from radejax.core.files import read_text
from radejax.data.kradar import folders
from radejax.data.kradar.findings import Findings
from radejax.data.kradar.folders import SequenceFolder

DEFAULT_RADAR_FROM_LIDAR_M = (-2.54, 0.3)
"""Metres to add to LiDAR x and y: the same on every K-Radar sequence."""

_DEFAULT_OFFSET_TEXT = "taking K-Radar's (-2.54, 0.3)"
_MAX_OFFSET_M = 100.0
_SPLIT_LINE = r"\s*([0-9]{1,6})\s*,\s*([0-9]{1,9}_[0-9]{1,9})(?:\.txt)?\s*"
_CAMERA_FOLDERS = ("calib", "cam_calib", "resources/cam_calib")

WEATHERS = ("normal", "overcast", "fog", "rain", "sleet", "lightsnow", "heavysnow")

# Sequences 1 to 58, as published by K-Radar; environment, time, weather: sequences.
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
    """Circumstances of a sequence, as in its `description.txt`."""

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


@dataclasses.dataclass(frozen=True, slots=True)
class RadarCalibration:
    """From the LiDAR to the radar of one sequence.

    Attributes:
        frame_difference: Radar frame number minus LiDAR frame number.
        dx_m: Metres to add to a LiDAR x.
        dy_m: Metres to add to a LiDAR y.
    """

    frame_difference: int
    dx_m: float
    dy_m: float


def read_calibration(path: str | os.PathLike) -> RadarCalibration:
    """Reads `info_calib/calib_radar_lidar.txt`: a header line and three numbers.

    Raises:
        DataError: The file is malformed; the message names file and line.
    """
    lines = _read_lines(path)
    if len(lines) < 2:
        raise DataError(
            f"{path}:{len(lines) + 1}: the file ends here, expected a header line and "
            "'frame difference,x,y' as three numbers"
        )
    try:
        difference, dx_m, dy_m = map(float, lines[1].split(","))
    except ValueError:
        difference = dx_m = dy_m = math.nan
    is_near = abs(dx_m) <= _MAX_OFFSET_M and abs(dy_m) <= _MAX_OFFSET_M
    if not is_near or not abs(difference) < 1e6 or difference % 1:
        raise DataError(
            f"{path}:2: {lines[1][:80]!r}, expected three numbers: frame difference "
            f"(whole), x, y up to {_MAX_OFFSET_M:g} m, such as 32,-2.54,0.3"
        )
    return RadarCalibration(int(difference), dx_m, dy_m)


def read_description(path: str | os.PathLike) -> Conditions:
    """Reads `description.txt`: environment, time and weather on one line.

    Raises:
        DataError: The file is malformed; the message names file and line.
    """
    lines = _read_lines(path)
    fields = [field.strip().lower() for field in lines[0].split(",")] if lines else []
    if len(fields) != 3 or not all(fields):
        raise DataError(
            f"{path}:1: {lines[0][:80] if lines else ''!r}, expected "
            "'environment,time,weather', such as urban,night,normal"
        )
    return Conditions(*fields)


@dataclasses.dataclass(frozen=True, slots=True)
class SequenceInfo:
    """What all frames of a sequence share.

    Attributes:
        conditions: Environment, time and weather.
        radar_from_lidar_m: Metres to add to LiDAR positions: x, y, z.
        camera_calibration_path: Calibration of the left front camera, or None.
    """

    conditions: Conditions
    radar_from_lidar_m: tuple[float, float, float]
    camera_calibration_path: pathlib.Path | None


def read_sequence_info(
    number: int,
    folder: SequenceFolder | None,
    findings: Findings,
    *,
    radar_from_lidar: tuple[float, float] | None,
    z_offset_m: float,
    camera_folders: Sequence[pathlib.Path],
    common_camera: bool = False,
) -> SequenceInfo:
    """Reads what is in the folders of a sequence and fills in what is not.

    Args:
        number: Of the sequence.
        folder: Its folders; None when only labels are at hand.
        findings: Where missing and malformed files are reported.
        radar_from_lidar: Offset that replaces the calibration file's.
        z_offset_m: Metres to add to LiDAR z.
        camera_folders: Where camera calibrations are looked for.
        common_camera: One calibration for all sequences, as the released code does.
    """
    if radar_from_lidar is None:
        x, y = _read_offset(number, folder, findings)
    else:
        x, y = map(float, radar_from_lidar)
    camera, is_own = folders.find_camera_calibration(
        camera_folders, number, common_only=common_camera
    )
    if camera is None:
        findings.counts["sequences without camera calibration"] += 1
    elif not is_own:
        findings.counts["sequences with the common camera calibration"] += 1
    return SequenceInfo(
        _read_conditions(number, folder, findings), (x, y, z_offset_m), camera
    )


def camera_folders(
    roots: Sequence[pathlib.Path], given: Sequence[pathlib.Path]
) -> list[pathlib.Path]:
    """The given folders, then the usual places under the roots."""
    return [*given, *(root / name for root in roots for name in _CAMERA_FOLDERS)]


def _read_offset(
    number: int, folder: SequenceFolder | None, findings: Findings
) -> tuple[float, float]:
    """Metres to add to LiDAR x and y of a sequence."""
    if folder is not None:
        path = folder.find("info_calib", "calib_radar_lidar.txt")
        try:
            if path is not None:
                calibration = read_calibration(path)
                return calibration.dx_m, calibration.dy_m
            findings.report(
                "calibration missing",
                f"sequence {number}",
                f"no info_calib/calib_radar_lidar.txt, {_DEFAULT_OFFSET_TEXT}",
                error=FileNotFoundError,
            )
        except DataError as error:
            findings.report(
                "calibration", str(path), f"{error}; {_DEFAULT_OFFSET_TEXT}"
            )
    findings.counts["sequences with the default calibration"] += 1
    return DEFAULT_RADAR_FROM_LIDAR_M


def _read_conditions(
    number: int, folder: SequenceFolder | None, findings: Findings
) -> Conditions:
    """Conditions of a sequence: its own description, else the built-in table."""
    path = None if folder is None else folder.find(".", "description.txt")
    if path is not None:
        try:
            conditions = read_description(path)
        except DataError as error:
            findings.report("description", str(path), str(error))
        else:
            if conditions.weather not in (*WEATHERS, "unknown"):
                findings.notes.append(
                    f"{path}: weather {conditions.weather!r} is none of K-Radar's: "
                    f"{', '.join(WEATHERS)}"
                )
            return conditions
    findings.counts["sequences with built-in conditions"] += 1
    return KRADAR_CONDITIONS.get(number, UNKNOWN_CONDITIONS)


def read_split(path: str | os.PathLike) -> list[tuple[int, str]]:
    """Reads a split file: lines `sequence,label file`.

    Returns:
        Pairs of sequence and frame name, such as `(1, "00033_00001")`.

    Raises:
        DataError: A line is malformed; the message names file and line.
    """
    frames = []
    for number, line in enumerate(_read_lines(path), start=1):
        if not line.strip():
            continue
        match = re.fullmatch(_SPLIT_LINE, line)
        if match is None:
            raise DataError(
                f"{path}:{number}: {line[:80]!r}, expected 'sequence,label file', such "
                "as 1,00033_00001.txt"
            )
        frames.append((int(match[1]), match[2]))
    return frames


def split_by_rule(names: Iterable[str], split: str) -> list[str]:
    """K-Radar's split of one sequence: quarters 1 and 3 train, quarters 2 and 4 test.

    Args:
        names: Names of every labelled frame of the sequence.
        split: "train" or "test".

    Returns:
        The names of the split, sorted. On complete sequences they equal the official
        split files.
    """
    names = sorted(names)
    cuts = [int(len(names) * quarter / 4) for quarter in range(5)]
    first = 0 if split == "train" else 1
    return [
        name
        for quarter in (first, first + 2)
        for name in names[cuts[quarter] : cuts[quarter + 1]]
    ]


def _read_lines(path: str | os.PathLike) -> list[str]:
    """Lines of a small text file; `DataError` if it is none."""
    return read_text(path).splitlines()
