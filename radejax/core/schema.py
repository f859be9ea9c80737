"""Values as JSON has them, checked against type hints before anything works with them."""

from __future__ import annotations

import dataclasses
import reprlib
import sys
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

from radejax.core.errors import DataError

T = TypeVar("T")

_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80
_MOST = 2**63 - 1
_WORDS = {bool: "true or false", int: "an integer of 64 bits", str: "text"}
_WORDS |= {float: "a finite number", types.NoneType: "null"}


def check(value: Any, hint: Any, where: str, name: str = "") -> Any:
    """The value, lists as tuples where the hint says so, mappings as dataclasses.

    Args:
        value: Of a JSON file.
        hint: `bool`, `int`, `float`, `str`, `None`, `list[X]`, `tuple[X, ...]`,
            `dict[str, X]`, `X | Y`, `Literal[...]`, `np.ndarray` (numbers, whose shape
            is not looked at), `Any`; a dataclass: an object with its fields, those
            with defaults may be missing; a dictionary of hints by key: an object,
            where keys that end in "?" may be missing and others are left as they are.
        where: File, for the message; may be empty.
        name: Of the value in it.

    Raises:
        DataError: It is something else; names file, field, found and expected.
    """
    if isinstance(hint, dict):
        found = _fields(value, hint, where, name)
        return {**value, **found}
    if dataclasses.is_dataclass(hint):
        found = _fields(value, hints_of(hint), where, name)
        try:
            return typing.cast(Any, hint)(**found)
        except ValueError as error:  # of values that do not belong together
            raise _error(f"{name}{': ' * bool(name)}{error}", where) from None
    kind, parts = typing.get_origin(hint), typing.get_args(hint)
    if kind in (list, tuple):
        _require(isinstance(value, list | tuple), value, "a list", where, name)
        if kind is list or parts[1:] == (...,):
            parts = parts[:1] * len(value)
        expected = f"a list of {len(parts)}"
        _require(len(value) == len(parts), value, expected, where, name)
        pairs = enumerate(zip(value, parts, strict=True))
        return kind(check(v, part, where, f"{name}[{i}]") for i, (v, part) in pairs)
    if kind is dict:
        _require(isinstance(value, Mapping), value, "an object", where, name)
        return {
            key: check(v, parts[1], where, f"{name}.{key:.40}".removeprefix("."))
            for key, v in value.items()
        }
    array = getattr(hint, "array_type", hint)  # of jaxtyping's Float[np.ndarray, "N 7"]
    if getattr(array, "__name__", "") == "ndarray":
        import numpy as np  # which commands that only check their flags do without

        return np.array(check(value, list[float], where, name), np.float64)
    if kind in (typing.Union, types.UnionType):
        for part in parts:
            try:
                return check(value, part, where, name)
            except DataError:
                continue
    elif kind is Literal:
        if any(type(part) is type(value) and part == value for part in parts):
            return value
    elif hint is Any or _FITS[hint](value):
        return value
    raise _misfit(value, _expected(hint), where, name)


_FITS: dict[Any, Callable[[Any], bool]] = {
    bool: lambda value: isinstance(value, bool),
    int: lambda value: type(value) is int and abs(value) <= _MOST,
    float: lambda value: (
        # False for NaN; integers of any size can be compared, and not converted.
        type(value) in (int, float) and abs(value) <= sys.float_info.max
    ),
    str: lambda value: isinstance(value, str),
    types.NoneType: lambda value: value is None,
    None: lambda value: value is None,
}


def hints_of(cls: Any) -> dict[str, Any]:
    """Hints of a dataclass by field, with "?" where it has a default."""
    hints, none = typing.get_type_hints(cls), dataclasses.MISSING
    may_miss = {
        field.name: field.default is not none or field.default_factory is not none
        for field in dataclasses.fields(cls)
    }
    return {name + "?" * may_miss[name]: hints[name] for name in may_miss}


def _fields(
    value: Any, hints: Mapping[str, Any], where: str, name: str
) -> dict[str, Any]:
    _require(isinstance(value, Mapping), value, "an object of fields", where, name)
    if missing := [k for k in hints if not k.endswith("?") and k not in value]:
        raise _error(f"{name or 'it'} lacks {', '.join(missing)}", where)
    return {
        key: check(value[key], hint, where, f"{name}.{key}".removeprefix("."))
        for key, hint in ((key.removesuffix("?"), h) for key, h in hints.items())
        if key in value
    }


def _expected(hint: Any) -> str:
    """A hint in words."""
    parts = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return f"one of {', '.join(map(repr, parts))}"
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(map(_expected, parts))
    if typing.get_origin(hint) in (list, tuple):
        return f"a list, each {_expected(parts[0])}"
    return _WORDS.get(hint, "an object")


def _require(is_right: bool, value: Any, expected: str, where: str, name: str) -> None:
    if not is_right:
        raise _misfit(value, expected, where, name)


def _misfit(value: Any, expected: str, where: str, name: str) -> DataError:
    found = _SHORT.repr(value)[:200]
    return _error(f"{name or 'it'} is {found}, expected {expected}", where)


def _error(text: str, where: str) -> DataError:
    return DataError(f"{where}{': ' * bool(where)}{text}")
