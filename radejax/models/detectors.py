"""Detectors from their configs, and what can be asked of any of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import flax.linen as nn

from radejax.core.errors import UserError
from radejax.geometry.radar_grid import AzimuthMapping, RadarGrid
from radejax.models import dinorade_config, radenet
from radejax.models.dinorade import DinoRade

_MAKERS = {"radenet": radenet.from_config, "dinorade": dinorade_config.from_config}


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
    if config.get("name") not in tuple(_MAKERS):  # also what cannot be looked up
        name = repr(config["name"]) if "name" in config else "missing"
        raise UserError(
            f"config.model.name is {name}; available models: {sorted(_MAKERS)}"
        )
    return _MAKERS[config["name"]](config)


def has_camera(model: nn.Module) -> bool:
    """Whether a model looks at images."""
    return isinstance(model, DinoRade)


def with_dtype(model: nn.Module, dtype: str) -> nn.Module:
    """The same model computing in another dtype; parameters stay float32.

    Raises:
        UserError: Neither "float32" nor "bfloat16".
    """
    if dtype not in radenet.DTYPES:
        raise UserError(f"dtype is {dtype!r}, expected one of {radenet.DTYPES}")
    if has_camera(model):
        return model.clone(radar=model.radar.clone(dtype=dtype, parent=None))
    return model.clone(dtype=dtype)


def map_grid(
    grid: RadarGrid, model: nn.Module, azimuth_mapping: AzimuthMapping
) -> RadarGrid:
    """Grid of the maps that a model makes from projections on `grid`.

    Args:
        grid: Of the sensor.
        model: Pads to `pad_multiple` and, if `crop_output`, crops again; a
            radar-camera model does so in its `radar` part.
        azimuth_mapping: See `RadarGrid.padded`.
    """
    radar = model.radar if has_camera(model) else model
    padded = grid.padded(radar.pad_multiple, azimuth_mapping)
    if not radar.crop_output:
        return padded
    return dataclasses.replace(
        padded,
        range_m=padded.range_m[: grid.num_range],
        azimuth_rad=padded.azimuth_rad[: grid.num_azimuth],
    )
