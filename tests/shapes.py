"""Annotations of radejax, shapes of arrays among them, checked while tests run."""

import functools
from collections.abc import Callable, MutableMapping
from typing import Any

import beartype
from flax import linen as nn
from flax import struct
from jaxtyping import install_import_hook
from ml_collections import ConfigDict

ROOMS = (
    "core.structures",
    "geometry",
    "losses",
    "detection",
    "models",
    "evaluation",
    "data.augment",
    "data.encoding",
    "data.records",
    "data.images",
    "data.kradar.dataset",
    "data.kradar.write",
    "data.pipeline",
    "data.projection",
    "data.tesseract",
    "training.distributed",
    "training.step",
    "simulation",
    "inference.detector",
    "inference.predict",
    "visualize",
)
"""Rooms whose annotations have shapes."""

_CHECKED = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, which refuses what its annotations do not say.

    Not constructors of pytrees, which JAX rebuilds from shapes, specs and None, nor
    those whose `__post_init__` makes arrays of what it is given.
    """
    checked = _CHECKED(function)
    if function.__name__ != "__init__":
        return checked

    @functools.wraps(function)
    def init(self: Any, *args: Any, **kwargs: Any) -> Any:
        is_free = isinstance(self, struct.PyTreeNode | nn.Module) or hasattr(
            self, "__post_init__"
        )
        return (function if is_free else checked)(self, *args, **kwargs)

    return init


def install() -> Any:
    """Rooms that are imported from now on are checked; ends as a context does."""
    MutableMapping.register(ConfigDict)  # it has all that one has
    return install_import_hook([f"radejax.{r}" for r in ROOMS], f"{__name__}.check")
