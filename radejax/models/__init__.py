"""Construction of detectors from their options, and functions for all detectors."""

from __future__ import annotations

import dataclasses
import typing

import flax.linen as nn

from radejax.core.errors import UserError, require
from radejax.core.options import find_part
from radejax.geometry.radar_grid import AzimuthMapping, RadarGrid
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.models.options import RadeNetOptions
from radejax.models.radenet import RadeNet

_MODELS = {"radenet": RadeNet, "dinorade": DinoRade}


def build(options: RadeNetOptions, num_frames: int = 1) -> RadeNet:
    """Creates the model that `config.model` describes.

    Args:
        options: Options of the class that `options_class(options.name)` returns.
        num_frames: `config.data.num_frames`, the number of frames of a sample.

    Returns:
        A Flax module without parameters.

    Raises:
        UserError: The name is unknown, or the options are of another model.
    """
    kind = options_class(options.name)
    expected = f"{kind.__name__} of {options.name}"
    found = type(options).__name__
    require(isinstance(options, kind), "config.model", found, expected)
    return _model_class(options.name)(options, num_frames)


def options_class(name: str) -> type[RadeNetOptions]:
    """Returns the class of a model's options, the annotation of its attribute `options`.

    Args:
        name: "radenet", "dinorade", or "module:Class" of a class derived from either.

    Raises:
        UserError: There is no such model.
    """
    try:
        kind: type[RadeNetOptions] = typing.get_type_hints(_model_class(name))[
            "options"
        ]
    except NameError as error:
        raise UserError(
            f"config.model.name is {name!r}: {error}; import the types of its attributes "
            "outside of `if TYPE_CHECKING`"
        ) from None
    return kind


def _model_class(name: str) -> type[RadeNet]:
    model: type[RadeNet] = find_part(name, "config.model.name", _MODELS, RadeNet)
    return model


def has_camera(model: nn.Module) -> typing.TypeGuard[DinoRade]:
    """Returns whether a model takes images.

    Args:
        model: Detector, as `build` creates it.
    """
    return isinstance(model, DinoRade)


def external_parts(model: nn.Module) -> tuple[str, ...]:
    """Returns the parts whose frozen parameters are in a file of their own.

    Checkpoints do not contain them.

    Args:
        model: Detector, as `build` creates it.
    """
    is_external = has_camera(model) and model.options.image.freeze
    return (IMAGE_BACKBONE,) if is_external else ()


def map_grid(
    grid: RadarGrid, model: RadeNet, azimuth_mapping: AzimuthMapping
) -> RadarGrid:
    """Returns the grid of the maps that a model predicts from projections on `grid`.

    Args:
        grid: Grid of the sensor.
        model: Model, whose `pad_multiple` and `crop_output` are used.
        azimuth_mapping: Mapping of the padded bins, see `RadarGrid.padded`.
    """
    padded = grid.padded(model.options.pad_multiple, azimuth_mapping)
    if not model.options.crop_output:
        return padded
    return dataclasses.replace(
        padded,
        range_m=padded.range_m[: grid.num_range],
        azimuth_rad=padded.azimuth_rad[: grid.num_azimuth],
    )
