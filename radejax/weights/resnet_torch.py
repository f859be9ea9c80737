"""ResNet-50 weights as torchvision distributes them, to Flax. torch is not needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from radejax.core.files import PathLike
from radejax.models.resnet import STRIDE, ResNetNeck, ResNetTrunk
from radejax.weights.convert import (
    from_torch,
    read_state_dict,
    shapes_of,
    to_torch,
    write_state_dict,
)

DEPTHS = (3, 4, 6, 3)


def module_names(
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
    for stage, (theirs, depth) in enumerate(zip(stages, DEPTHS, strict=True), 1):
        ours = "image_neck/" if stage == 4 else f"image_backbone/stage_{stage}_"
        for i in range(depth):
            block = f"{ours}block_{i + 1}"
            for k in (1, 2, 3):
                names[f"{block}/conv_{k}"] = f"{theirs}.{i}.conv{k}"
                names[f"{block}/norm_{k}"] = f"{theirs}.{i}.bn{k}"
            names[f"{block}/conv_shortcut"] = f"{theirs}.{i}.downsample.0"
            names[f"{block}/norm_shortcut"] = f"{theirs}.{i}.downsample.1"
    return names


def load(
    state_dict_or_path: Mapping[str, Any] | PathLike, width: int = 64
) -> dict[str, Any]:
    """Variables of DinoRADE's ResNet from torchvision's `resnet50-*.pth`.

    Args:
        state_dict_or_path: The file, or its tensors by name.
        width: Channels of the stem; torchvision's have 64.

    Returns:
        `{"params": {"image_backbone", "image_neck"}, "batch_stats": {"image_neck"}}`,
        without the 1x1 projection, which is DinoRADE's own: for
        `radejax.training.state.with_pretrained`. Of a file of `save`, which has no
        last stage, only "image_backbone".

    Raises:
        FileNotFoundError: There is no such file.
        DataError: Tensors are missing, unexpected or of another shape; all are listed.
    """
    tensors, source = read_state_dict(state_dict_or_path, "layer1.0.")
    shapes = _shapes(width)
    if not any(name.startswith("layer4.") for name in tensors):
        shapes = {k: s for k, s in shapes.items() if "/image_neck/" not in k}
    return from_torch(module_names(), shapes, tensors, source, r"fc\.")


def save(params: Mapping[str, Any], path: PathLike) -> None:
    """Writes the parameters of a `ResNetTrunk` under torchvision's names."""
    trunk = {"params": {"image_backbone": params}}
    write_state_dict(path, to_torch(module_names(), trunk))


def _shapes(width: int) -> dict[str, tuple[int, ...]]:
    """Shapes of trunk and last stage."""
    key, image = jax.random.key(0), jnp.zeros((1, STRIDE, STRIDE, 3))
    features = jnp.zeros((1, 1, 1, 16 * width))
    trunk = jax.eval_shape(ResNetTrunk(width).init, key, image)
    neck = jax.eval_shape(
        ResNetNeck(width=width).init, key, features, jnp.ones(1, bool)
    )
    parts = {"image_backbone": trunk, "image_neck": neck}
    return {
        f"{kind}/{part}/{path}": shape
        for part, variables in parts.items()
        for kind, leaves in variables.items()
        for path, shape in shapes_of(leaves).items()
        if not path.startswith("proj/")
    }
