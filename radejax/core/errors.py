"""Errors of the user and of files, and the ranges of options.

Command line programs print every `ValueError` with an `exit_code` as one line without a
traceback: 2 for wrong use, 1 for a corrupted file and a full disk.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

_LONGEST = 2000


def one_line(error: BaseException | str) -> str:
    """What an error of another library says, as a message of ours quotes it."""
    return " ".join(str(error).split())[:200]


class _OneLine(ValueError):
    """Whatever a message quotes, it is one line and not endless."""

    def __init__(self, message: object = "") -> None:
        text = str(message).replace("\n", " ")
        super().__init__(text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ...")


class UserError(_OneLine):
    """A wrong argument, config field, folder or combination of them."""

    exit_code = 2


class DiskFullError(UserError):
    """No space is left: exit code 1, as the command itself was right."""

    exit_code = 1


class DataError(_OneLine):
    """A file that is missing parts, malformed or corrupted; the message names it."""

    exit_code = 1


def require(holds: bool, name: str, value: object, expected: str) -> None:
    """Raises `UserError` unless a setting is in its range.

    The constructors of what config sections configure check their fields with it.

    Args:
        holds: Whether the value is in its range.
        name: Field as a user knows it, such as "config.train.batch_size".
        value: What it is.
        expected: The range, such as "an integer of at least 1".

    Example:
        >>> require(2 >= 1, "config.train.batch_size", 2, "an integer of at least 1")
    """
    if not holds:
        raise UserError(f"{name} is {value!r}, expected {expected}")


Range = tuple[Callable[[Any], bool], str]
"""Whether a value is in a range, and the range in words."""


def integer(least: int, most: float = math.inf) -> Range:
    """Integers of a range; True is not 1."""
    upper = "" if most == math.inf else f" and at most {most:.0f}"
    return (
        lambda value: isinstance(value, int) and _is_number(value, least, most),
        f"an integer of at least {least}{upper}",
    )


def number(least: float, most: float = math.inf) -> Range:
    """Finite numbers of a closed range."""
    upper = "" if most == math.inf else f" and at most {most}"
    return lambda x: _is_number(x, least, most), f"a number of at least {least}{upper}"


def one_of(*choices: Any) -> Range:
    """One of several values."""
    return lambda value: value in choices, f"one of {', '.join(map(repr, choices))}"


def several(
    entries: Range, expected: str, count: int | None = None, least: int = 0
) -> Range:
    """At least so many different entries, each of a range; or `count`, equal or not."""

    def holds(values: Any) -> bool:
        is_size = len(set(values)) == len(values) >= least
        is_size = is_size if count is None else len(values) == count
        return is_size and all(map(entries[0], values))

    return holds, expected


def or_none(values: Range) -> Range:
    """A range, or None."""
    holds, expected = values
    return lambda value: value is None or holds(value), f"{expected}, or None"


SIZE = integer(1, 1 << 16)
"""Numbers of channels, classes, heads, ..."""

POSITIVE: Range = lambda x: _is_number(x, 0) and x > 0, "a number above 0"
BELOW_ONE: Range = (
    lambda x: _is_number(x, 0, 1) and x < 1,
    "a number from 0 to below 1",
)


def check_options(values: Any, section: str, ranges: Mapping[str, Range]) -> None:
    """Raises `UserError` for the first field of a section that is out of its range."""
    for name, (holds, expected) in ranges.items():
        value = values[name]
        try:
            is_fine = holds(value)
        except TypeError:
            is_fine = False
        require(is_fine, f"{section}.{name}", value, expected)


def _is_number(value: Any, least: float, most: float = math.inf) -> bool:
    return (
        not isinstance(value, bool) and math.isfinite(value) and least <= value <= most
    )
