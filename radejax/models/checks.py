"""Checks of the fields of `config.model`, for the constructors of modules."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

from radejax.core.errors import require

MAX_SIZE = 1 << 16
"""Most channels, groups, classes, heads, ..."""


def check_choice(name: str, value: Any, choices: Collection[Any]) -> None:
    """Raise `UserError` unless the field `config.model.<name>` is one of the choices."""
    choices = tuple(choices)
    require(value in choices, f"config.model.{name}", value, f"one of {choices}")


def check_size(name: str, value: Any, least: int = 1) -> None:
    """Raise `UserError` unless the field is an integer from `least` to `MAX_SIZE`."""
    is_size = isinstance(value, int) and least <= value <= MAX_SIZE
    expected = f"an integer from {least} to {MAX_SIZE}"
    require(is_size, f"config.model.{name}", value, expected)


def check_number(name: str, value: Any, low: float, high: float, text: str) -> None:
    """Raise `UserError` unless the field is strictly between two bounds."""
    is_number = isinstance(value, int | float) and math.isfinite(value)
    require(is_number and low < value < high, f"config.model.{name}", value, text)
