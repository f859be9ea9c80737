"""Weights of image backbones: DINOv3 from Hugging Face, ResNet-50 from torchvision.

torch is not needed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import flax.linen as nn
import jax
import numpy as np

from radejax import models
from radejax.core.errors import UserError
from radejax.core.files import PathLike, differences
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.weights import dinov3_hf
from radejax.weights.convert import (
    from_torch,
    read_state_dict,
    shapes_of,
    to_torch,
    variable_shapes,
    write_state_dict,
)


def load_image_backbone(
    path: PathLike | None, model: nn.Module, embeddings_sha256: str | None = None
) -> Mapping[str, Any] | None:
    """Pretrained part of the variables, for `radejax.training.step.with_pretrained`.

    Args:
        path: A DINOv3 folder from Hugging Face, or torchvision's ResNet-50 file.
        model: Says which kind is expected.
        embeddings_sha256: Checksum of the weights that embeddings are from, which stand
            for the frozen part: what is left is the ResNet's last stage, and nothing of
            a DINOv3.

    Returns:
        None without a path, and where embeddings leave nothing.

    Raises:
        FileNotFoundError: Not there, or a folder lacks a file.
        DataError: Tensors are missing, unexpected or mis-shaped.
        UserError: It is another model than the configured one, or not the one that the
            embeddings are from; or the model has a frozen backbone and no weights are
            given.
    """
    has_camera = models.has_camera(model)
    if path is None:
        is_embedded = embeddings_sha256 and has_camera and model.vit is not None
        if has_camera and model.freeze and not is_embedded:
            raise UserError(
                "config.model.image.freeze is True, but no weights are given: "
                "--image-backbone FOLDER (DINOv3 from Hugging Face: config.json and "
                "model.safetensors; for resnet50 torchvision's .pth file), or train it "
                "with --config.model.image.freeze=False"
            )
        return None
    if not has_camera:
        raise UserError(
            "image backbone weights are given, but config.model.name is 'radenet', "
            "which has no camera"
        )
    if model.vit is None:
        part = load_resnet(path, model)
    else:
        vit, variables = dinov3_hf.load(path)
        theirs, ours = map(dinov3_hf.image_fields, (vit, model.vit))
        if lines := differences(theirs, ours, "config.model.image"):
            raise UserError(f"{path}: another backbone: {'; '.join(lines)}")
        part = {"params": {IMAGE_BACKBONE: variables["params"]}}
    if embeddings_sha256 is not None:
        params = dict(part["params"])
        check_same_backbone(params.pop(IMAGE_BACKBONE), embeddings_sha256, path)
        part = {**part, "params": params}
    return part


def check_same_backbone(params: Any, sha256: str, source: PathLike) -> None:
    """`UserError` unless weights have the checksum of those of a run or of embeddings.

    Args:
        params: Parameters of an image backbone.
        sha256: Checksum that `weights_sha256` gave, or how it begins.
        source: Where `params` are from.
    """
    found = weights_sha256(params)
    if not found.startswith(sha256):
        raise UserError(
            f"{source} is not the image backbone that was trained with or that the "
            f"embeddings are from: its weights have sha256 {found[:12]}, theirs "
            f"{sha256[:12]}"
        )


def check_fits(
    model: nn.Module, variables: Mapping[str, Any], source: PathLike
) -> None:
    """`UserError` unless variables are those of a model; the backbone may be missing."""
    wanted, found = variable_shapes(model), shapes_of(variables)
    if IMAGE_BACKBONE not in variables.get("params", {}):
        wanted = {k: s for k, s in wanted.items() if f"/{IMAGE_BACKBONE}/" not in k}
    if lines := differences(found, wanted, ""):
        raise UserError(
            f"weights of {source} do not fit config.model ({len(lines)} tensors), "
            f"for example: {'; '.join(lines[:3])}"
        )


def weights_sha256(params: Mapping[str, Any]) -> str:
    """Checksum of a tree of weights: names, shapes and values."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(f"{jax.tree_util.keystr(path)}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf, np.float32).tobytes())
    return digest.hexdigest()


# ResNet-50 as torchvision distributes it ---------------------------------------------

_DEPTHS = (3, 4, 6, 3)


def resnet_names(
    conv: str = "conv1",
    norm: str = "bn1",
    stages: tuple[str, ...] = ("layer1", "layer2", "layer3", "layer4"),
) -> dict[str, str]:
    """Torch's module by module of ours, for `convert`.

    Args:
        conv: First convolution.
        norm: Its normalization.
        stages: Prefixes of the four stages; the last one is part of our neck.
    """
    names = {"image_backbone/stem_conv": conv, "image_backbone/stem_norm": norm}
    for stage, (theirs, depth) in enumerate(zip(stages, _DEPTHS, strict=True), 1):
        ours = "image_neck/" if stage == 4 else f"image_backbone/stage_{stage}_"
        for i in range(depth):
            block = f"{ours}block_{i + 1}"
            for k in (1, 2, 3):
                names[f"{block}/conv_{k}"] = f"{theirs}.{i}.conv{k}"
                names[f"{block}/norm_{k}"] = f"{theirs}.{i}.bn{k}"
            names[f"{block}/conv_shortcut"] = f"{theirs}.{i}.downsample.0"
            names[f"{block}/norm_shortcut"] = f"{theirs}.{i}.downsample.1"
    return names


def load_resnet(
    state_dict_or_path: Mapping[str, Any] | PathLike, model: nn.Module
) -> dict[str, Any]:
    """Variables of DinoRADE's ResNet from torchvision's `resnet50-*.pth`.

    Args:
        state_dict_or_path: The file, or its tensors by name.
        model: A `DinoRade` with a ResNet.

    Returns:
        `{"params": {"image_backbone", "image_neck"}, "batch_stats": {"image_neck"}}`,
        without the 1x1 projection, which is DinoRADE's own: for
        `radejax.training.step.with_pretrained`. Of a file of `save_resnet`, which has no
        last stage, only "image_backbone".

    Raises:
        FileNotFoundError: There is no such file.
        DataError: Tensors are missing, unexpected or of another shape; all are listed.
    """
    tensors, source = read_state_dict(state_dict_or_path, "layer1.0.")
    names = resnet_names()
    has_last = any(name.startswith("layer4.") for name in tensors)
    shapes = {
        path: shape
        for path, shape in variable_shapes(model).items()
        if path.partition("/")[2].rpartition("/")[0] in names
        and (has_last or "/image_neck/" not in path)
    }
    return from_torch(names, shapes, tensors, source, r"fc\.")


def save_resnet(params: Mapping[str, Any], path: PathLike) -> None:
    """Writes the parameters of a `ResNetTrunk` under torchvision's names."""
    trunk = {"params": {"image_backbone": params}}
    write_state_dict(path, to_torch(resnet_names(), trunk))
