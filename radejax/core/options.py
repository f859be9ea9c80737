"""The base class of all options, and the objects that options name."""

from __future__ import annotations

import contextlib
import difflib
import importlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self, TypeVar, get_args

import numpy as np
import pydantic
from annotated_types import Ge, Gt, Le, Lt
from pydantic_core import ErrorDetails

from radejax.core.errors import UserError, require
from radejax.core.files import JsonObject

Part = TypeVar("Part")
Function = TypeVar("Function", bound=Callable[..., object])

Size = Annotated[int, Ge(1), Le(1 << 16)]
"""A number of channels, classes, heads or similar."""

Count = Annotated[int, Ge(0)]
AtLeastOne = Annotated[int, Ge(1)]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Fraction = Annotated[float, Ge(0), Le(1)]
BelowOne = Annotated[float, Ge(0), Lt(1)]
Seed = Annotated[int, Ge(0), Lt(1 << 32)]
ScoreThreshold = Fraction | tuple[Fraction, ...]
"""One score threshold for all classes, or one per class in their order."""

ClassThresholds = float | Sequence[float] | Mapping[str, float] | str
"""`ScoreThreshold`, thresholds by class name, or a text, see `class_thresholds`."""

_WORDS = (
    ("greater than or equal to", "at least"),
    ("less than or equal to", "at most"),
    ("greater than", "above"),
    ("less than", "below"),
    ("a valid ", "a "),
    ("Tuple should have ", ""),
    ("a integer", "an integer"),
)


class Options(pydantic.BaseModel):
    """Immutable options of one part of the program, which are a section of the config.

    Types and ranges are those of the annotations; values are not converted, except lists and
    arrays to tuples, integers to floats, mappings to sections, and path objects to text. A subclass
    names its section, for example `class TrainOptions(Options, section="config.train")`,
    which begins every message.

    Raises:
        UserError: A field is unknown, missing, of another type or out of its range.
    """

    model_config = pydantic.ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        protected_namespaces=(),
    )
    section: ClassVar[str] = "config"

    def __init_subclass__(cls, section: str = "") -> None:
        super().__init_subclass__()
        if section:
            cls.section = section

    def __init__(self, **values: object) -> None:
        values = {name: as_tuples(value) for name, value in values.items()}
        try:
            super().__init__(**values)
        except pydantic.ValidationError as error:
            raise _explained(error, type(self), values) from None

    def __setattr__(self, name: str, value: object) -> None:
        raise UserError(
            f"{self.section}.{name} cannot be set, because options are immutable: use "
            f"config.replace or config.with_fields, which return new ones"
        )

    def replace(self, **changes: object) -> Self:
        """Returns validated options with other values.

        Args:
            **changes: Fields to replace. A mapping changes the named fields of a section, or
                of a mapping such as `loss.weights`, and keeps the others; an instance of
                `Options` replaces the section.

        Examples:
            config.replace(seed=1, train={"batch_size": 4})
        """
        return type(self)(**_merged(self, changes))

    def with_fields(self, fields: Mapping[str, object]) -> Self:
        """Returns validated options with other values by dotted names.

        Examples:
            config.with_fields({"train.batch_size": 4, "loss.weights.focal": 8.0})
        """
        return type(self)(**_merged(self, fields))

    def fields(self) -> Iterator[tuple[str, object]]:
        """Yields dotted name and value of every field of all sections."""
        for name, value in self:
            if isinstance(value, Options):
                yield from ((f"{name}.{inner}", x) for inner, x in value.fields())
            elif isinstance(value, Mapping):
                yield from ((f"{name}.{inner}", x) for inner, x in value.items())
            else:
                yield name, value

    def to_dict(self) -> JsonObject:
        """Returns the values as nested dictionaries."""
        return self.model_dump()


def _merged(
    section: Options | Mapping[str, object], changes: Mapping[str, object]
) -> dict[str, object]:
    """Returns the changed fields of a section.

    A mapping, or a dotted name, changes fields of an inner section.
    """
    values = dict(section)
    for path, change in changes.items():
        name, _, rest = path.partition(".")
        inner = values.get(name)
        if rest:
            change = {rest: change}
        if isinstance(change, Mapping) and isinstance(inner, Options | Mapping):
            is_whole = _is_of_another_kind(section, name, change)
            change = change if is_whole else _merged(inner, change)
        values[name] = change
    return values


def _is_of_another_kind(
    owner: Options | Mapping[str, object], name: str, change: Mapping[str, object]
) -> bool:
    """Returns whether a section of several kinds is replaced by one of another kind."""
    inner = getattr(owner, name, None)
    if not (isinstance(owner, Options) and isinstance(inner, Options)):
        return False
    kinds = get_args(type(owner).model_fields[name].annotation)
    sections = [x for x in kinds if isinstance(x, type) and issubclass(x, Options)]
    return len(sections) > 1 and type(inner).model_fields.keys().isdisjoint(change)


def as_tuples(value: object) -> object:
    """Converts lists and arrays to tuples, recursively in lists and mappings."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return tuple(map(as_tuples, value))
    if isinstance(value, Mapping):
        return {name: as_tuples(inner) for name, inner in value.items()}
    return value


def _explained(
    error: pydantic.ValidationError, cls: type[Options], values: Mapping[str, object]
) -> UserError:
    """Returns the first error with the full name of its field."""
    errors = error.errors(include_url=False)
    first = errors[0]
    place = _place(first["loc"], values)
    if isinstance(cause := first.get("ctx", {}).get("error"), UserError):
        return cause  # a section's own message
    name = f"{cls.section}{place}"
    if first["type"] == "extra_forbidden":
        hint = did_you_mean(str(first["loc"][-1]), cls.model_fields, f"{cls.section}.")
        return UserError(f"{name} is not a field{hint}")
    if first["type"] == "missing":
        return UserError(f"{name} is missing")
    # There is one error for each member of a union.
    same = (one for one in errors if _place(one["loc"], values) == place)
    expected = " or ".join(dict.fromkeys(map(_expected, same)))
    return UserError(f"{name} is {first['input']!r}, expected {expected}")


def _place(steps: Sequence[str | int], values: Any) -> str:
    """Returns the names and indices of a wrong value, without the members of unions."""
    place = ""
    for step in steps:
        try:
            values = values[step]
        except (KeyError, IndexError, TypeError):
            if place:
                continue
        place += f"[{step}]" if isinstance(step, int) else f".{step}"
    return place


def _expected(error: ErrorDetails) -> str:
    """Returns pydantic's description of the values that are allowed, in our words."""
    text = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    text = text.partition(" after validation")[0]
    for foreign, own in _WORDS:
        text = text.replace(foreign, own)
    limits = error.get("ctx", {})
    for limit in limits.keys() & {"ge", "gt", "le", "lt"}:
        kind = "an integer" if isinstance(limits[limit], int) else "a number"
        text = f"{kind} {'of ' * text.startswith('at ')}{text}"
    return text


def class_thresholds(
    given: ClassThresholds, classes: Sequence[str], default: ScoreThreshold
) -> ScoreThreshold:
    """Returns one score threshold for all classes, or one per class.

    Args:
        given: One threshold; one per class; those of some classes by name; or a text such
            as "0.3", "Sedan=0.4,Bicycle=0.2", or "0.3,Bicycle=0.2" with the threshold of all
            other classes.
        classes: Names of the classes.
        default: Thresholds of the classes that are not named.

    Raises:
        UserError: A class is unknown, the number of thresholds is not that of the classes,
            or one is not a number from 0 to 1.

    Examples:
        >>> class_thresholds("Bicycle=0.2", ["Sedan", "Bicycle"], 0.3)
        (0.3, 0.2)
    """
    values: Any = given
    array = np.full((), np.nan)  # of values that are not numbers
    with contextlib.suppress(TypeError, ValueError):
        if isinstance(values, str):
            pairs = [part.rpartition("=") for part in values.split(",")]
            values = {cls.strip(): float(number) for cls, _, number in pairs}
            if len(values) < len(pairs):
                raise ValueError("a class is named twice")
            default = values.pop("", default)
        if isinstance(values, Mapping):
            usual = np.broadcast_to(default, len(classes)).tolist()
            every = dict(zip(classes, usual, strict=True)) | dict(values)
            values = tuple(every.values()) if values else default
        array = np.asarray(values, np.float64)
    is_fine = array.shape in ((), (len(classes),))
    is_fine = is_fine and bool(((array >= 0) & (array <= 1)).all())
    count = f"{len(classes)} of them, or CLASS=NUMBER of {', '.join(classes)}"
    require(is_fine, "score_threshold", given, f"a number from 0 to 1, {count}")
    return tuple(array.tolist()) if array.ndim else float(array)


def find_part(
    name: str, field: str, known: Mapping[str, Part | None], kind: type = object
) -> Part:
    """Returns the class, function or object that a field of a config names.

    Args:
        name: Name of a known part, or "module:Object" for another one, which is imported.
            Commands find modules in the current folder too.
        field: Name of the field for the error message.
        known: Parts by name.
        kind: Class from which the part is derived, or of which it is an instance.

    Raises:
        UserError: There is no such part, or it is of another kind.
    """
    part = known.get(str(name))
    if part is None:
        module, _, attribute = str(name).partition(":")
        expected = " or ".join([*map(repr, known), "module:Object"])
        is_name = isinstance(name, str) and bool(module and attribute)
        require(is_name, field, name, expected)
        try:
            part = getattr(importlib.import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise UserError(
                f"{field} is {name!r}: {error}; run this in the folder of {module}, or add "
                "that folder to PYTHONPATH"
            ) from None
    is_kind = kind in getattr(part, "__mro__", type(part).__mro__)
    require(is_kind, field, name, f"the name of a {kind.__name__}")
    return part


def find_function(
    name: str, field: str, known: Mapping[str, Function] | None = None
) -> Function:
    """Returns the function that a field of a config names, see `find_part`."""
    part = find_part(name, field, known or {})
    require(callable(part), field, name, "the name of a function")
    return part


def did_you_mean(name: str, known: Collection[str], prefix: str = "") -> str:
    """Returns a hint at the known name that is most similar to a wrong one, or "".

    Examples:
        >>> did_you_mean("radnet", ["radenet", "dinorade"])
        '; did you mean radenet?'
    """
    last = name.rpartition(".")[2]  # which has to be similar, not only the section
    near = [
        found
        for found in difflib.get_close_matches(name, known)
        if difflib.get_close_matches(last, found.split("."), 1)
    ]
    return f"; did you mean {prefix}{near[0]}?" if near else ""
