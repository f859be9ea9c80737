"""Weights of the image backbone of a radar-camera run: found, loaded, checked."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import flax.traverse_util
import jax
import jax.numpy as jnp
from ml_collections import ConfigDict

from radejax import models
from radejax.core.errors import UserError
from radejax.data.records.embeddings import embeddings_sha256
from radejax.inference.embed import weights_sha256
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.models.lifting import ReferencePoints

PathLike = str | os.PathLike

# Fields of a ViT that are not its weights' own.
_FREE_FIELDS = ("attention", "dtype", "remat", "layer_scale", "parent", "name")


def has_camera(config: ConfigDict) -> bool:
    """Whether the configured model looks at images."""
    return config.model.name == "dinorade"


def require_camera(config: ConfigDict) -> None:
    """`UserError` unless the configured model looks at images."""
    if not has_camera(config):
        raise UserError(
            f"config.model.name is {config.model.name!r}, which has no camera; expected "
            "'dinorade', for example configs/dinorade.py"
        )


def load_image_backbone(
    path: PathLike | None, config: ConfigDict, embeddings: PathLike | None = None
) -> Any:
    """Pretrained part of the variables, for `radejax.training.state.with_pretrained`.

    Args:
        path: A DINOv3 folder from Hugging Face, or torchvision's ResNet-50 file.
        config: Of the run; `model.image` says which kind is expected.
        embeddings: Folder of `radejax embed` that stands for the frozen part: what is
            left is the ResNet's last stage, and nothing of a DINOv3.

    Returns:
        None without a path, and where embeddings leave nothing.

    Raises:
        FileNotFoundError: Not there, or a folder lacks a file.
        DataError: Tensors are missing, unexpected or mis-shaped.
        UserError: It is another model than the configured one, or not the one that the
            embeddings are from; or the model has a frozen backbone and no weights are
            given.
    """
    if not has_camera(config):
        if path is not None:
            raise UserError(
                f"image backbone weights are given, but config.model.name is "
                f"{config.model.name!r}, which has no camera"
            )
        return None
    image = config.model.image
    if embeddings is not None and path is None and image.kind == "vit":
        return None
    if path is None:
        if image.freeze:
            raise UserError(
                "config.model.image.freeze is True, but no weights are given: "
                "--image_backbone FOLDER (DINOv3 from Hugging Face: config.json and "
                "model.safetensors; for resnet50 torchvision's .pth file), or train it "
                "with --config.model.image.freeze=False"
            )
        return None
    if image.kind == "resnet50":
        from radejax.interop import resnet_torch

        part = resnet_torch.load(path)
    else:
        part = {"params": {IMAGE_BACKBONE: _load_dinov3(path, config)}}
    if embeddings is not None:
        params = dict(part["params"])
        check_same_backbone(params.pop(IMAGE_BACKBONE), embeddings, path)
        part = {**part, "params": params}
    return part


def check_same_backbone(params: Any, embeddings: PathLike, source: PathLike) -> None:
    """`UserError` unless embeddings were made with these weights."""
    found, wanted = embeddings_sha256(embeddings), weights_sha256(params)
    if found != wanted:
        raise UserError(
            f"{source} is not the backbone that {embeddings} was made with: weights "
            f"{wanted[:12]}, the embeddings' {found[:12]} (sha256)"
        )


def _load_dinov3(path: PathLike, config: ConfigDict) -> Any:
    """Parameters of the backbone in a Hugging Face folder."""
    from radejax.interop import dinov3_hf

    image = config.model.image
    model, variables = dinov3_hf.load(path)
    configured = models.build(config.model).vit
    for name in (field.name for field in dataclasses.fields(model)):
        found, wanted = getattr(model, name), getattr(configured, name)
        if name in _FREE_FIELDS or found == wanted:
            continue
        where = f"config.model.image.{name}" if name in image else "the configured one"
        raise UserError(
            f"{path}: the backbone has {name} = {found}, {where} is {wanted}"
        )
    return variables["params"]


def check_fits(model: DinoRade, variables: Mapping[str, Any], source: str) -> None:
    """`UserError` unless variables are those of a model; the backbone may be missing."""
    radar, bins = model.radar, model.radar.pad_multiple
    channels = radar.doppler_bins + radar.elevation_bins
    queries = (1, bins, bins, model.axes.num_elevation)
    inputs = (
        jnp.zeros((1, bins, bins, channels)),
        jnp.zeros((1, *model.image_size, 3), jnp.uint8),
        ReferencePoints(jnp.zeros((*queries, 2)), jnp.ones(queries, bool)),
    )
    wanted = jax.eval_shape(model.init, jax.random.key(0), *inputs)

    def shapes(tree: Any) -> dict[str, Any]:
        flat = flax.traverse_util.flatten_dict(dict(tree), sep="/")
        return {name: tuple(leaf.shape) for name, leaf in flat.items()}

    wanted, found = shapes(wanted), shapes(variables)
    differing = [
        f"{name} is {found.get(name, 'missing')}, expected {wanted.get(name, 'none')}"
        for name in sorted(set(wanted) | set(found))
        if found.get(name) != wanted.get(name)
        and not (name not in found and name.startswith(f"params/{IMAGE_BACKBONE}/"))
    ]
    if differing:
        raise UserError(
            f"weights of {source} do not fit config.model ({len(differing)} tensors), "
            f"for example: {'; '.join(differing[:3])}"
        )


def missing_backbone(params: Mapping[str, Any], config: ConfigDict) -> bool:
    """Whether parameters from a checkpoint lack the frozen backbone."""
    return has_camera(config) and IMAGE_BACKBONE not in params
