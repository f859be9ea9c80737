"""Options: changes of them, messages of wrong values, and the parts that they name."""

import pathlib
from typing import Literal

import pytest

from radejax.core.errors import UserError
from radejax.core.options import (
    AtLeastOne,
    BelowOne,
    Fraction,
    Options,
    Positive,
    Seed,
    as_tuples,
    class_thresholds,
    find_part,
)


class Part(Options, section="config.part"):
    rate: Fraction = 0.5
    sizes: tuple[AtLeastOne, ...] = (1, 2)
    scale: Positive | None = None
    kind: Literal["a", "b"] = "a"
    region: Literal["wide"] | tuple[float, ...] | None = None
    mixed: tuple[int | float, ...] = ()
    is_on: bool = False


class Whole(Options):
    count: int
    seed: Seed = 0
    decay: BelowOne = 0.0
    weights: dict[str, Positive] = {"x": 1.0, "y": 2.0}  # noqa: RUF012, immutable
    part: Part = Part()
    other: Part | None = None


WHOLE = Whole(count=1)


def test_changes_are_of_fields_of_sections_or_of_whole_sections():
    changed = WHOLE.replace(count=2, part={"rate": 1, "sizes": [3]})
    assert changed.part == Part(rate=1.0, sizes=(3,))
    assert isinstance(changed.part.rate, float)
    assert (WHOLE.count, WHOLE.part) == (1, Part())
    assert changed.replace(part=Part(kind="b")).part == Part(kind="b")
    assert WHOLE.replace(other={"kind": "b"}).other == Part(kind="b")
    assert WHOLE.replace(weights={"y": 3.0}).weights == {"x": 1.0, "y": 3.0}
    names = {"count": 2, "part.rate": 1.0, "part.sizes": [3], "weights.z": 1.0}
    by_name = WHOLE.with_fields(names)
    assert by_name == changed.replace(weights={"z": 1.0})
    assert dict(by_name.fields()) == {
        **{"count": 2, "seed": 0, "decay": 0.0},
        **{"weights.x": 1.0, "weights.y": 2.0, "weights.z": 1.0},
        **{"part.rate": 1.0, "part.sizes": (3,), "part.scale": None},
        **{"part.kind": "a", "part.region": None, "part.mixed": ()},
        **{"part.is_on": False, "other": None},
    }
    assert Whole(**by_name.to_dict()) == by_name
    assert as_tuples({"a": [1, [2]]}) == {"a": (1, (2,))}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"count": True}, "count is True, expected an integer"),
        ({"weights.x": 0.0}, "weights.x is 0.0, expected a number above 0"),
        ({"part.rate": 2}, "part.rate is 2, expected a number of at most 1"),
        ({"part.sizes": [1, 0]}, "part.sizes[1] is 0, expected an integer of at least"),
        ({"part.kind": "c"}, "part.kind is 'c', expected 'a' or 'b'"),
        ({"part.rat": 1}, "part.rat is not a field; did you mean config.part.rate?"),
        ({"seeed": 1}, "seeed is not a field; did you mean config.seed?"),
    ],
)
def test_wrong_values_are_named(fields, message):
    with pytest.raises(UserError) as refused:
        WHOLE.with_fields(fields)
    assert str(refused.value).startswith(f"config.{message}")
    assert "\n" not in str(refused.value)


def test_missing_fields_and_assignments_are_named():
    with pytest.raises(UserError, match=r"^config\.count is missing$"):
        Whole()
    message = r"^config\.part\.rate cannot be set, .*replace"
    with pytest.raises(UserError, match=message):
        WHOLE.part.rate = 1.0


def test_parts_are_known_or_imported_and_of_one_kind():
    known = {"floats": float}
    assert find_part("floats", "config.x", known, float) is float
    found = find_part("pathlib:Path", "config.x", known, pathlib.PurePath)
    assert found is pathlib.Path
    assert find_part("math:pi", "config.x", {}, float) > 3
    for name, message in (
        (":Path", r"is ':Path', expected 'floats' or module:Object"),
        ("pathlib:Paths", "no attribute 'Paths'; run this in the folder of pathlib"),
        ("no.such:Thing", "No module named 'no'"),
        ("pathlib:Path", "is 'pathlib:Path', expected the name of a float"),
    ):
        with pytest.raises(UserError, match=rf"^config\.x .*{message}"):
            find_part(name, "config.x", known, float)


CLASSES = ("Sedan", "Bus or Truck", "Bicycle")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (0.4, 0.4),
        ("0.4", 0.4),
        ((0.1, 0.2, 1), (0.1, 0.2, 1.0)),
        ({"Bicycle": 0.2}, (0.3, 0.3, 0.2)),
        ("Bicycle=0.2", (0.3, 0.3, 0.2)),
        ("Bus or Truck=0, Sedan=0.4", (0.4, 0.0, 0.3)),
        ("0.5,Bicycle=0.2", (0.5, 0.5, 0.2)),
        ({}, 0.3),
    ],
)
def test_score_thresholds_of_classes(given, expected):
    assert class_thresholds(given, CLASSES, 0.3) == expected


def test_unnamed_classes_keep_their_own_threshold():
    assert class_thresholds("Sedan=1", CLASSES, (0.1, 0.2, 0.3)) == (1.0, 0.2, 0.3)


@pytest.mark.parametrize(
    "given",
    [
        *(1.5, float("nan"), None, "high", "", "Sedan=", "Sedan=0.4=0.3", "Tram=0.3"),
        *((0.1, 0.2), (0.1, 0.2, -0.1), {"Tram": 0.3}, {"Sedan": "high"}),
        *("Sedan=0.4,Sedan=0.5", "Sedan=0.4,,", "0.3,0.4", "nan", "Sedan=nan"),
    ],
)
def test_wrong_score_thresholds_are_one_clear_line(given):
    with pytest.raises(UserError) as caught:
        class_thresholds(given, CLASSES, 0.3)
    assert str(caught.value) == (
        f"score_threshold is {given!r}, expected a number from 0 to 1, 3 of them, or "
        "CLASS=NUMBER of Sedan, Bus or Truck, Bicycle"
    )
