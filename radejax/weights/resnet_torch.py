"""ResNet-50 weights as torchvision distributes them, to Flax. torch is not needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from radejax import models
from radejax.core.config import load_config
from radejax.core.files import PathLike
from radejax.weights.convert import (
    from_torch,
    read_state_dict,
    to_torch,
    variable_shapes,
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
        `radejax.training.step.with_pretrained`. Of a file of `save`, which has no
        last stage, only "image_backbone".

    Raises:
        FileNotFoundError: There is no such file.
        DataError: Tensors are missing, unexpected or of another shape; all are listed.
    """
    tensors, source = read_state_dict(state_dict_or_path, "layer1.0.")
    names = module_names()
    config = load_config("dinorade:rcw_resnet50").model
    config.image.resnet_width = width
    has_last = any(name.startswith("layer4.") for name in tensors)
    shapes = {
        path: shape
        for path, shape in variable_shapes(models.build(config)).items()
        if path.partition("/")[2].rpartition("/")[0] in names
        and (has_last or "/image_neck/" not in path)
    }
    return from_torch(names, shapes, tensors, source, r"fc\.")


def save(params: Mapping[str, Any], path: PathLike) -> None:
    """Writes the parameters of a `ResNetTrunk` under torchvision's names."""
    trunk = {"params": {"image_backbone": params}}
    write_state_dict(path, to_torch(module_names(), trunk))
