"""Checks of radejax's annotations, including array shapes, while tests run."""

import functools
from collections.abc import Callable
from typing import Any, Self

import beartype
from flax import linen as nn
from flax import struct
from jaxtyping import install_import_hook

PACKAGES = (
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
    "data.kradar.tesseract",
    "core.devices",
    "training.step",
    "simulation",
    "inference.detector",
    "inference.inputs",
    "inference.predict",
    "visualize",
)
"""Modules and packages whose annotations have shapes."""

_CHECKED = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a function so that arguments and results must match its annotations.

    Constructors of pytrees are not checked, as JAX rebuilds these from shapes, specs and
    None, nor are those of classes whose `__post_init__` converts arguments to arrays. Neither
    are methods that return `Self`, whose class beartype does not know here.
    """
    if function.__annotations__.get("return") in ("Self", Self):
        return function
    checked = _CHECKED(function)
    if function.__name__ != "__init__":
        return checked

    @functools.wraps(function)
    def init(self: Any, *args: Any, **kwargs: Any) -> Any:
        is_pytree = isinstance(self, struct.PyTreeNode | nn.Module)
        is_free = is_pytree or hasattr(self, "__post_init__")
        return (function if is_free else checked)(self, *args, **kwargs)

    return init


def install() -> Any:
    """Check the modules that are imported from now on; a context manager ends it."""
    modules = [f"radejax.{name}" for name in PACKAGES]
    return install_import_hook(modules, f"{__name__}.check")
