"""Fields of a config as a user types them: `--config.train.batch_size=4`."""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator, Mapping
from typing import Any

from ml_collections import ConfigDict

from radejax.core.errors import UserError
from radejax.runs.check_config import RULES, Rule, check_name, field_values

_WORDS = {"true": True, "false": False, "none": None}


def override(config: ConfigDict, texts: Mapping[str, str]) -> None:
    """Sets fields of a config from what a user typed.

    A text becomes the first of its meanings that the field takes, see
    `check_config.RULES`: a Python value, a word such as "off", or several, "fog,rain".

    Args:
        config: To be changed.
        texts: By field, such as {"loss.weights": "(2, 1, 1)"}.

    Raises:
        UserError: There is no such field, or the text means nothing that it takes;
            names the field, the text and what is expected.
    """
    for name, text in texts.items():
        values = config.to_dict()
        leaves = dict(_leaves(values)) | dict(field_values(values))
        check_name(name, leaves)
        old = leaves[name]
        rule = RULES.get(name, _like(old))
        meanings = list(filter(rule.holds, _meanings(text)))
        if not meanings:
            raise UserError(f"config.{name} is {text!r}, expected {rule.expected}")
        value = float(meanings[0]) if _is_number(old, meanings[0]) else meanings[0]
        section, _, leaf = name.rpartition(".")
        with config.ignore_type():
            (config[section] if section else config)[leaf] = value


def _leaves(values: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """All values that are no sections, those inside of one field as well."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def _is_number(old: Any, new: Any) -> bool:
    """Whether an integer stands where a float was."""
    return isinstance(old, float) and type(new) is int


def _like(old: Any) -> Rule:
    """Of fields inside of one, such as the grid of a simulation: the same type."""
    return Rule(
        f"a value like {old!r}", lambda v: type(v) is type(old) or _is_number(old, v)
    )


def fields_like(name: str) -> list[str]:
    """Fields that a word such as "batchsize" or "train.batchsize" may mean.

    Examples:
        >>> fields_like("batchsize")
        ['train.batch_size', 'evaluation.batch_size']
        >>> fields_like("train.batchsize")
        ['train.batch_size']
    """
    short = {
        field: field if "." in name else field.rpartition(".")[2] for field in RULES
    }
    near = difflib.get_close_matches(name, set(short.values()), 1)
    return [field for field, word in short.items() if word in near]


def _meanings(text: str) -> Iterator[Any]:
    """What a text may mean, the likeliest first; lists are tuples."""
    value = _literal(text)
    yield tuple(value) if isinstance(value, list) else value
    yield text
    words = filter(None, (word.strip() for word in text.strip("()[] ").split(",")))
    yield tuple(map(_literal, words))


def _literal(text: str) -> Any:
    """The Python value that a text is, else the text."""
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return _WORDS.get(text.strip().lower(), text)
