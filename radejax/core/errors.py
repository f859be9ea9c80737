"""Errors caused by users and by files, and checks of the ranges of options.

Command line programs print every `ValueError` with an `exit_code` as one line without a
traceback. They exit with 2 for wrong use, and with 1 for a corrupted file or a full disk.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

_LONGEST = 2000


def one_line(error: BaseException | str) -> str:
    """Returns the message of another library's error on one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]


class _OneLine(ValueError):
    """A `ValueError` whose message is one line and is cut after `_LONGEST` characters."""

    def __init__(self, message: object = "") -> None:
        text = str(message).replace("\n", " ")
        super().__init__(text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ...")


class UserError(_OneLine):
    """Raised for a wrong argument, config field or folder, or a wrong combination of them."""

    exit_code = 2


class DiskFullError(UserError):
    """Raised if no space is left on the disk.

    The exit code is 1, because the command itself was correct.
    """

    exit_code = 1


class DataError(_OneLine):
    """Raised for an incomplete, malformed or corrupted file, which the message names."""

    exit_code = 1


def require(holds: bool, name: str, value: object, expected: str) -> None:
    """Raises `UserError` unless a setting is in its range.

    Args:
        holds: Whether the value is in its range.
        name: Name of the setting for users, such as "config.train.batch_size".
        value: Value of the setting.
        expected: Description of the range, such as "an integer of at least 1".

    Example:
        >>> require(2 >= 1, "config.train.batch_size", 2, "an integer of at least 1")
    """
    if not holds:
        raise UserError(f"{name} is {value!r}, expected {expected}")


Range = tuple[Callable[[Any], bool], str]
"""A function that returns whether a value is in a range, and a description of the range."""


def integer(least: int, most: float = math.inf) -> Range:
    """Returns the range of integers from `least` to `most`; booleans are not in it."""
    upper = "" if most == math.inf else f" and at most {most:.0f}"
    return (
        lambda value: isinstance(value, int) and _is_number(value, least, most),
        f"an integer of at least {least}{upper}",
    )


def number(least: float, most: float = math.inf) -> Range:
    """Returns the range of finite numbers from `least` to `most`; booleans are not in it."""
    upper = "" if most == math.inf else f" and at most {most}"
    return lambda x: _is_number(x, least, most), f"a number of at least {least}{upper}"


def one_of(*choices: Any) -> Range:
    """Returns the range that consists of the given values."""
    return lambda value: value in choices, f"one of {', '.join(map(repr, choices))}"


def several(
    entries: Range, expected: str, count: int | None = None, least: int = 0
) -> Range:
    """Returns a range of sequences.

    Args:
        entries: Range of each entry.
        expected: Description of the range.
        count: Required number of entries, which may then be equal. If None, the entries
            must be different.
        least: Smallest number of entries if `count` is None.
    """

    def holds(values: Any) -> bool:
        is_size = len(set(values)) == len(values) >= least
        is_size = is_size if count is None else len(values) == count
        return is_size and all(map(entries[0], values))

    return holds, expected


def or_none(values: Range) -> Range:
    """Returns a range extended by None."""
    holds, expected = values
    return lambda value: value is None or holds(value), f"{expected}, or None"


SIZE = integer(1, 1 << 16)
"""Range of numbers of channels, classes, heads and similar sizes."""

POSITIVE: Range = lambda x: _is_number(x, 0) and x > 0, "a number above 0"
BELOW_ONE: Range = (
    lambda x: _is_number(x, 0, 1) and x < 1,
    "a number from 0 to below 1",
)


def check_options(values: Any, section: str, ranges: Mapping[str, Range]) -> None:
    """Raises `UserError` for the first field of a section that is out of its range.

    Args:
        values: Fields of the section, as a mapping.
        section: Name of the section, such as "config.train".
        ranges: Range of each field to check.
    """
    for name, (holds, expected) in ranges.items():
        value = values[name]
        try:
            is_fine = holds(value)
        except TypeError:
            is_fine = False
        require(is_fine, f"{section}.{name}", value, expected)


def _is_number(value: Any, least: float, most: float = math.inf) -> bool:
    is_finite = not isinstance(value, bool) and math.isfinite(value)
    return is_finite and least <= value <= most
