"""Frozen dataclasses of arrays that compare and hash by value."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np


class ArrayValues:
    """Base of frozen dataclasses (`eq=False`) whose fields are arrays and numbers.

    Instances can be static arguments of jitted functions and fields of flax modules.
    """

    def freeze(self, name: str) -> np.ndarray:
        """Makes a field a read-only float64 array of its own and returns it."""
        value = np.array(getattr(self, name), np.float64)
        value.setflags(write=False)
        object.__setattr__(self, name, value)
        return value

    def _key(self) -> tuple[object, ...]:
        fields: Any = dataclasses.fields(self)  # type: ignore[arg-type]
        values = (getattr(self, field.name) for field in fields)
        return tuple(v.tobytes() if isinstance(v, np.ndarray) else v for v in values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())
