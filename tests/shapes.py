"""Annotations of radejax, shapes of arrays among them, checked while tests run."""

from collections.abc import Callable, MutableMapping
from typing import Any

import beartype
from jaxtyping import install_import_hook
from ml_collections import ConfigDict

ROOMS = (
    "geometry",
    "losses",
    "detection",
    "models",
    "evaluation.overlap",
    "evaluation.matching",
)
"""Rooms whose annotations have shapes."""

_CHECKED = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, which refuses what its annotations do not say.

    Not constructors: JAX rebuilds trees of arrays from shapes, specs and None, and
    `__post_init__` makes arrays of what it is given.
    """
    return function if function.__name__ == "__init__" else _CHECKED(function)


def install() -> Any:
    """Rooms that are imported from now on are checked; ends as a context does."""
    MutableMapping.register(ConfigDict)  # it has all that one has
    return install_import_hook([f"radejax.{r}" for r in ROOMS], f"{__name__}.check")
