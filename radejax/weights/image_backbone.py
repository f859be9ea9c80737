"""Weights of image backbones: DINOv3, DINOv2, and ResNet-50 from torchvision.

All files are read without torch.
"""

from __future__ import annotations

import hashlib
import re

import jax
import numpy as np
import safetensors.numpy
from flax.typing import Collection, VariableDict

from radejax import models
from radejax.core.errors import UserError
from radejax.core.files import PathLike, differences
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.radenet import RadeNet
from radejax.weights import convert, dinov3_hf
from radejax.weights.convert import Rules, StateDict


def load_image_backbone(
    path: PathLike | None, model: RadeNet, embeddings_sha256: str | None = None
) -> VariableDict | None:
    """Loads pretrained variables for `radejax.training.step.merge_variables`.

    Args:
        path: DINOv3 or DINOv2 that `dinov3_hf.load` reads, or ResNet-50 file from
            torchvision or of `save_resnet`.
        model: Detector, which determines the kind of backbone.
        embeddings_sha256: Checksum of the weights that computed the embeddings, if there
            are any. The frozen parameters are then checked against it and not returned.
            This leaves the last stage of a ResNet, and no parameter of a DINOv3.

    Returns:
        The variables, or None without a path.

    Raises:
        FileNotFoundError: The file, the folder or a file in it is missing.
        DataError: A file is corrupted, or tensors are missing, unexpected or of another
            shape.
        UserError: The weights are of another model than the configured one or the one that
            computed the embeddings; the model has no camera; or a frozen backbone has no
            weights (nor embeddings, which suffice for a transformer).
    """
    image = model.options.image if models.has_camera(model) else None
    if path is None:
        is_embedded = embeddings_sha256 and image is not None and image.kind == "vit"
        if image is not None and image.freeze and not is_embedded:
            raise UserError(
                "config.model.image.freeze is True, but no weights are given: "
                "--image-backbone FOLDER (DINOv3 or DINOv2 from Hugging Face: config.json "
                "and model.safetensors; for resnet50 torchvision's .pth file), or train it "
                "with --config.model.image.freeze=False"
            )
        return None
    if image is None:
        raise UserError(
            f"image backbone weights are given, but {type(model).__name__} has no camera"
        )
    if image.kind == "resnet50":
        part = load_resnet(path, model)
    else:
        vit, variables = dinov3_hf.load(path)
        theirs, ours = map(dinov3_hf.image_fields, (vit.options, image))
        if lines := differences(theirs, ours, "config.model.image"):
            kind = "DINOv2" if vit.options.position_grid else "DINOv3"
            raise UserError(
                f"{path} is {kind}, another backbone than config.model.image: "
                f"{'; '.join(lines)} (dinorade:rcw_dinov2 is the config for DINOv2)"
            )
        part = {"params": {IMAGE_BACKBONE: variables["params"]}}
    if embeddings_sha256 is not None:
        params = dict(part["params"])
        check_same_backbone(params.pop(IMAGE_BACKBONE), embeddings_sha256, path)
        part = {**part, "params": params}
    return part


def check_same_backbone(params: Collection, sha256: str, source: PathLike) -> None:
    """Raises a `UserError` unless weights have the checksum of a run or of embeddings.

    Args:
        params: Parameters of an image backbone.
        sha256: Checksum that `weights_sha256` returned, or its first digits.
        source: Source of `params` for the error message.
    """
    found = weights_sha256(params)
    if not found.startswith(sha256):
        raise UserError(
            f"{source} is not the image backbone that was trained with or that the "
            f"embeddings are from: its weights have sha256 {found[:12]}, theirs "
            f"{sha256[:12]}"
        )


def check_fits(model: RadeNet, variables: VariableDict, source: PathLike) -> None:
    """Raises a `UserError` unless variables fit a model; the backbone may be missing."""
    wanted = convert.variable_shapes(model)
    found = convert.shapes_of(variables)
    if IMAGE_BACKBONE not in variables.get("params", {}):
        wanted = {k: s for k, s in wanted.items() if f"/{IMAGE_BACKBONE}/" not in k}
    if lines := differences(found, wanted, ""):
        raise UserError(
            f"weights of {source} do not fit config.model ({len(lines)} tensors), "
            f"for example: {'; '.join(lines[:3])}"
        )


def weights_sha256(params: Collection) -> str:
    """Returns the SHA-256 of the names, shapes and float32 values of a tree of weights."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(f"{jax.tree_util.keystr(path)}{leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf, np.float32).tobytes())
    return digest.hexdigest()


# ResNet-50 of torchvision ------------------------------------------------------------

RESNET_RULES: Rules = (
    (r"^image_backbone/stem_conv/", "conv1."),
    (r"^image_backbone/stem_norm/", "bn1."),
    (r"^image_backbone/stage_(\d)_block_", r"layer\1.block_"),
    (r"^image_neck/block_", "layer4.block_"),
    (r"\.block_(\d)/", lambda m: f".{int(m[1]) - 1}."),
    (r"\.conv_(\d)/", r".conv\1."),
    (r"\.norm_(\d)/", r".bn\1."),
    (r"\.conv_shortcut/", ".downsample.0."),
    (r"\.norm_shortcut/", ".downsample.1."),
)
"""Rules from modules of `DinoRade`, whose neck contains the last stage, to torchvision's."""


def load_resnet(
    state_dict_or_path: StateDict | PathLike, model: RadeNet
) -> VariableDict:
    """Loads the variables of DinoRADE's ResNet from torchvision's `resnet50-*.pth`.

    Args:
        state_dict_or_path: File, or its tensors by name.
        model: `DinoRade` with a ResNet.

    Returns:
        `{"params": {"image_backbone", "image_neck"}, "batch_stats": {"image_neck"}}` for
        `radejax.training.step.merge_variables`, without the 1x1 projection, which only
        DinoRADE has. A file of `save_resnet` has no last stage and gives only the
        parameters of "image_backbone".

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted, or tensors are missing, unexpected or of another
            shape. The message lists up to 20 of them.
    """
    tensors, source = convert.read_state_dict(state_dict_or_path, "layer1.0.")
    has_last = any(name.startswith("layer4.") for name in tensors)
    parts = r"image_backbone/|image_neck/block_" if has_last else r"image_backbone/"
    shapes = convert.variable_shapes(model)
    shapes = {k: s for k, s in shapes.items() if re.match(rf"\w+/({parts})", k)}
    return convert.from_torch(RESNET_RULES, shapes, tensors, source, r"fc\.")


def save_resnet(params: Collection, path: PathLike) -> None:
    """Writes the parameters of a `ResNetTrunk` to a safetensors file with torchvision's names."""
    trunk = {"params": {"image_backbone": params}}
    safetensors.numpy.save_file(convert.to_torch(RESNET_RULES, trunk), path)
