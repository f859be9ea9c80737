"""Construction of detectors from their configs, and functions for all detectors."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import flax.linen as nn

from radejax.core.config import find_part, plain
from radejax.core.errors import UserError, check_options, one_of
from radejax.geometry.radar_grid import AzimuthMapping, RadarGrid
from radejax.models.dinorade import DinoRade
from radejax.models.fusion import Fusion
from radejax.models.lifting import LiftingAxes
from radejax.models.radenet import RadeNet
from radejax.models.vit import ViT

_MODELS = {"radenet": RadeNet, "dinorade": DinoRade}


def build(config: Mapping[str, Any], num_frames: int = 1) -> nn.Module:
    """Creates the model that `config.model` describes.

    Args:
        config: A mapping with `name`, "radenet", "dinorade" or "module:Class" of a class
            derived from either, and exactly the fields of that model. The fields of RADE-Net
            are the attributes of `RadeNet`, where `cbam` may be "off". DinoRADE additionally
            has the sections `image`, `fusion` and `query_grid`.
        num_frames: `config.data.num_frames`, the number of frames of a sample.

    Returns:
        A Flax module without parameters.

    Raises:
        UserError: The name is unknown, or a field is missing, unknown or out of range or
            has the wrong type.
    """
    fields = plain(config)
    name = fields.pop("name", None)
    module = find_part(name, "config.model.name", _MODELS, RadeNet)
    expected, is_camera = _own_fields(module), issubclass(module, DinoRade)
    if is_camera:
        expected -= _own_fields(DinoRade) - _own_fields(RadeNet)
        expected |= {"image", "fusion", "query_grid"}
    _check_keys(fields, expected - {"num_frames"}, "")
    fields["num_frames"] = num_frames
    if fields["cbam"] == "off":
        fields["cbam"] = None
    try:
        return module(**(_with_camera(fields) if is_camera else fields))
    except TypeError as error:
        raise UserError(f"config.model has a value of a wrong type: {error}") from None


def _with_camera(fields: dict[str, Any]) -> dict[str, Any]:
    """Converts the fields of DinoRADE's config to attributes of `DinoRade`."""
    image, fusion, grid = (fields.pop(k) for k in ("image", "fusion", "query_grid"))
    shared = {"num_groups", "dtype", "remat"}
    vit_fields = _own_fields(ViT) - shared
    own = {"kind", "size", "freeze", "standardize", "resnet_width"}
    _check_keys(image, own | vit_fields, "image.")
    _check_keys(fusion, _own_fields(Fusion) - shared, "fusion.")
    _check_keys(grid, _own_fields(LiftingAxes) - {"num_elevation"}, "query_grid.")
    check_options(image, "config.model.image", {"kind": one_of("vit", "resnet50")})
    vit = None
    if image["kind"] == "vit":
        vit = ViT(**{name: image[name] for name in vit_fields})
    return fields | {
        "vit": vit,
        "fusion": Fusion(**fusion),
        "query_grid": LiftingAxes(**grid, num_elevation=fusion["num_elevation"]),
        "image_size": image["size"],
        "freeze": image["freeze"],
        "resnet_width": image["resnet_width"],
        "standardize_image": image["standardize"],
    }


def _own_fields(module: Any) -> set[str]:
    return {f.name for f in dataclasses.fields(module)} - {"parent", "name"}


def _check_keys(fields: Any, expected: Collection[str], section: str) -> None:
    """Raises a `UserError` that names an unknown or missing field, if there is one."""
    if not isinstance(fields, Mapping):
        raise UserError(f"config.model.{section[:-1]} is {fields!r}, expected fields")
    for text, names in (
        ("is not a field of this model", set(fields) - set(expected)),
        ("is missing", set(expected) - set(fields)),
    ):
        if names:
            raise UserError(f"config.model.{section}{min(names)} {text}")


def has_camera(model: nn.Module) -> bool:
    """Returns whether a model takes images."""
    return isinstance(model, DinoRade)


def map_grid(grid: RadarGrid, model: Any, azimuth_mapping: AzimuthMapping) -> RadarGrid:
    """Returns the grid of the maps that a model predicts from projections on `grid`.

    Args:
        grid: Grid of the sensor.
        model: Model, whose `pad_multiple` and `crop_output` are used.
        azimuth_mapping: Mapping of the padded bins, see `RadarGrid.padded`.
    """
    padded = grid.padded(model.pad_multiple, azimuth_mapping)
    if not model.crop_output:
        return padded
    return dataclasses.replace(
        padded,
        range_m=padded.range_m[: grid.num_range],
        azimuth_rad=padded.azimuth_rad[: grid.num_azimuth],
    )
