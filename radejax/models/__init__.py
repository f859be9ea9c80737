"""Detectors as Flax modules; `build` makes one from its config."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import flax.linen as nn

from radejax.core.errors import UserError

_MODULES = {
    "radenet": "radejax.models.radenet",
    "dinorade": "radejax.models.dinorade_config",
}


def build(config: Mapping[str, Any]) -> nn.Module:
    """The model that `config.model` describes.

    Args:
        config: A mapping with `name`, "radenet" or "dinorade", and exactly the
            fields of that model.

    Returns:
        A Flax module, without parameters.

    Raises:
        UserError: The name is unknown, a field is missing, unknown or impossible.
    """
    if "name" not in config or config["name"] not in _MODULES:
        name = repr(config["name"]) if "name" in config else "missing"
        raise UserError(
            f"config.model.name is {name}; available models: {sorted(_MODULES)}"
        )
    # Imported on demand: a radar-only run does not load the camera's modules.
    return importlib.import_module(_MODULES[config["name"]]).from_config(config)


def has_camera(model: nn.Module) -> bool:
    """Whether a model looks at images."""
    return hasattr(model, "image_size")


def with_dtype(model: nn.Module, dtype: str) -> nn.Module:
    """The same model computing in another dtype; parameters stay float32.

    Raises:
        UserError: Neither "float32" nor "bfloat16".
    """
    from radejax.models.radenet import DTYPES

    if dtype not in DTYPES:
        raise UserError(f"dtype is {dtype!r}, expected one of {DTYPES}")
    if hasattr(model, "radar"):
        return model.clone(radar=model.radar.clone(dtype=dtype, parent=None))
    return model.clone(dtype=dtype)
