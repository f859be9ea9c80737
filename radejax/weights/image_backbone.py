"""Weights of image backbones: DINOv3 from Hugging Face, ResNet-50 from torchvision."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np

from radejax import models
from radejax.core.errors import UserError
from radejax.core.files import PathLike
from radejax.data.records.embeddings import embeddings_sha256
from radejax.models import dinorade_config
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.lifting import ReferencePoints
from radejax.models.vit import ViT
from radejax.weights import dinov3_hf, resnet_torch

# Fields of a ViT that are not its weights' own.
_FREE_FIELDS = ("attention", "dtype", "remat", "layer_scale", "parent", "name")


def load_image_backbone(
    path: PathLike | None, model: nn.Module, embeddings: PathLike | None = None
) -> Mapping[str, Any] | None:
    """Pretrained part of the variables, for `radejax.training.state.with_pretrained`.

    Args:
        path: A DINOv3 folder from Hugging Face, or torchvision's ResNet-50 file.
        model: Says which kind is expected.
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
    if not models.has_camera(model):
        if path is not None:
            raise UserError(
                "image backbone weights are given, but config.model.name is 'radenet', "
                "which has no camera"
            )
        return None
    if embeddings is not None and path is None and model.vit is not None:
        return None
    if path is None:
        if model.freeze:
            raise UserError(
                "config.model.image.freeze is True, but no weights are given: "
                "--image_backbone FOLDER (DINOv3 from Hugging Face: config.json and "
                "model.safetensors; for resnet50 torchvision's .pth file), or train it "
                "with --config.model.image.freeze=False"
            )
        return None
    if model.vit is None:
        part = resnet_torch.load(path, model.resnet_width)
    else:
        part = {"params": {IMAGE_BACKBONE: _load_dinov3(path, model.vit)}}
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


def _load_dinov3(path: PathLike, configured: ViT) -> Any:
    """Parameters of the backbone in a Hugging Face folder."""
    model, variables = dinov3_hf.load(path)
    for name in (field.name for field in dataclasses.fields(model)):
        found, wanted = getattr(model, name), getattr(configured, name)
        if name in _FREE_FIELDS or found == wanted:
            continue
        is_field = name in dinorade_config.IMAGE_FIELDS
        where = f"config.model.image.{name}" if is_field else "the configured one"
        raise UserError(
            f"{path}: the backbone has {name} = {found}, {where} is {wanted}"
        )
    return variables["params"]


def check_fits(
    model: nn.Module, variables: Mapping[str, Any], source: PathLike
) -> None:
    """`UserError` unless variables are those of a model; the backbone may be missing."""
    radar = model.radar if models.has_camera(model) else model
    bins, channels = radar.pad_multiple, radar.doppler_bins + radar.elevation_bins

    def array(*shape: int, dtype: Any = jnp.float32) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((1, *shape), dtype)

    inputs: list[jax.ShapeDtypeStruct | ReferencePoints] = [array(bins, bins, channels)]
    if radar is not model:
        queries = (bins, bins, model.query_grid.num_elevation)
        points = ReferencePoints(array(*queries, 2), array(*queries, dtype=bool))
        inputs += [array(*model.image_size, 3, dtype=jnp.uint8), points]
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


def weights_sha256(params: Mapping[str, Any]) -> str:
    """Checksum of a tree of weights: names, shapes and values."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(f"{jax.tree_util.keystr(path)}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf, np.float32).tobytes())
    return digest.hexdigest()
