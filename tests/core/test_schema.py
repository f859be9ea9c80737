import dataclasses
from typing import Any, Literal

import numpy as np
import pytest

from radejax.core.errors import DataError
from radejax.core.schema import check


@dataclasses.dataclass
class Part:
    name: str
    size: int
    note: str | None = None

    def __post_init__(self) -> None:
        if self.size < 0:
            raise ValueError(f"size {self.size} is negative")


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (3, int, 3),
        (3, float, 3),
        (None, int | None, None),
        ("a", Literal["a", "b"], "a"),
        ([1, 2], tuple[int, ...], (1, 2)),
        ([1, "x"], tuple[int, str], (1, "x")),
        ({"a": [1]}, dict[str, list[int]], {"a": [1]}),
        ({"a": 1, "more": 2}, {"a": int, "b?": str}, {"a": 1, "more": 2}),
        ({"name": "x", "size": 1}, Part, Part("x", 1)),
        ([{"name": "x", "size": 1, "note": "n"}], list[Part], [Part("x", 1, "n")]),
        ([["x"], [2]], list[list[int] | list[str]], [["x"], [2]]),
        (object, Any, object),
    ],
)
def test_what_fits_is_given_back(value: Any, hint: Any, expected: Any) -> None:
    found = check(value, hint, "f.json")
    assert found == expected
    assert type(found) is type(expected)


def test_numbers_become_an_array() -> None:
    np.testing.assert_array_equal(check([1, 2.5], np.ndarray, "f"), [1.0, 2.5])


@pytest.mark.parametrize(
    ("value", "hint", "message"),
    [
        (True, int, "f.json: it is True, expected an integer of 64 bits"),
        (2**63, int, "f.json: it is 9223372036854775808, expected an integer"),
        (1, bool, "f.json: it is 1, expected true or false"),
        (float("nan"), float, "f.json: it is nan, expected a finite number"),
        (10**400, float, "expected a finite number"),
        (1, Literal[True], "it is 1, expected one of True"),
        ("c", Literal["a", "b"] | None, "'c', expected one of 'a', 'b' or null"),
        ([1], tuple[int, int], r"it is \[1\], expected a list of 2"),
        ({"a": [1, "x"]}, {"a": list[int]}, r"f.json: a\[1\] is 'x', expected"),
        ({"a": {"b": None}}, {"a": {"b": str}}, "f.json: a.b is None, expected text"),
        ([], {"a": int}, r"it is \[\], expected an object of fields"),
        ({}, {"a": int, "b?": int}, "f.json: it lacks a"),
        ({"name": "x"}, Part, "f.json: it lacks size"),
        (
            {"p": {"name": "x", "size": -1}},
            {"p": Part},
            "f.json: p: size -1 is negative",
        ),
        ("x", list[int] | None, "it is 'x', expected a list, each an integer"),
        ({"a": 1}, {"a": list[list[int]]}, "f.json: a is 1, expected a list"),
    ],
)
def test_what_does_not_is_named(value: Any, hint: Any, message: str) -> None:
    with pytest.raises(DataError, match=message) as info:
        check(value, hint, "f.json")
    assert len(str(info.value)) < 400
