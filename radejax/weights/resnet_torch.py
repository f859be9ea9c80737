"""ResNet-50 weights as torchvision distributes them, to Flax. torch is not needed."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from radejax.core.errors import DataError
from radejax.core.files import PathLike
from radejax.weights import torch_file
from radejax.weights.state_dict import StateDictReader, read_state_dict

_TRUNK = ("conv1", "bn1", "layer1", "layer2", "layer3")
DEPTHS = (3, 4, 6, 3)
WIDTH = 64


def load(
    state_dict_or_path: Mapping[str, Any] | PathLike, width: int = WIDTH
) -> dict[str, Any]:
    """Variables of DinoRADE's ResNet from torchvision's `resnet50-*.pth`.

    Args:
        state_dict_or_path: The file, or its tensors by name.
        width: Channels of the stem; torchvision's have 64.

    Returns:
        `{"params": {"image_backbone", "image_neck"}, "batch_stats": {"image_neck"}}`,
        without the 1x1 projection, which is DinoRADE's own: for
        `radejax.training.state.with_pretrained`. Of a file of `save`, which has no
        last stage, "image_backbone" alone.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: Tensors are missing, unexpected or mis-shaped; all are listed.
    """
    tensors, source = read_state_dict(state_dict_or_path)
    if not isinstance(tensors, Mapping):
        raise DataError(f"{source} holds {type(tensors).__name__}, not a state dict")
    reader = StateDictReader(tensors, source)
    part: dict[str, Any] = {
        "params": {"image_backbone": read_trunk(reader, _TRUNK, width)}
    }
    if any(name.startswith("layer4.") for name in reader.names):
        params, stats = read_last_stage(reader, "layer4", width)
        part["params"]["image_neck"] = params
        part["batch_stats"] = {"image_neck": stats}
    reader.finish(ignored=(r"fc\.",))
    return part


def save(params: Mapping[str, Any], path: PathLike) -> None:
    """Writes the parameters of a `ResNetTrunk` under torchvision's names."""
    params, tensors = jax.tree.map(np.asarray, dict(params)), {}
    theirs = {"scale": "weight", "bias": "bias", "mean": "running_mean"}
    theirs["var"] = "running_var"

    def put(conv: str, norm: str, kernel: np.ndarray, fixed: Mapping[str, Any]) -> None:
        tensors[f"{conv}.weight"] = kernel.transpose(3, 2, 0, 1)
        tensors.update({f"{norm}.{theirs[key]}": fixed[key] for key in theirs})

    put(*_TRUNK[:2], params["stem_conv"]["kernel"], params["stem_norm"])
    for stage, name in enumerate(_TRUNK[2:], 1):
        for i in range(DEPTHS[stage - 1]):
            block = params[f"stage_{stage}_block_{i + 1}"]
            for key, (conv, norm, *_) in _layers(stage, i).items():
                kernel, fixed = block[f"conv_{key}"]["kernel"], block[f"norm_{key}"]
                put(f"{name}.{i}.{conv}", f"{name}.{i}.{norm}", kernel, fixed)
    contiguous = {name: np.ascontiguousarray(x) for name, x in tensors.items()}
    torch_file.write(pathlib.Path(path), contiguous)


def read_trunk(
    reader: StateDictReader, names: tuple[str, ...], width: int = WIDTH
) -> dict[str, Any]:
    """Parameters of `ResNetTrunk`; `names` of stem, its norm and three stages."""
    conv, norm, *stages = names
    params = {
        "stem_conv": reader.conv(conv, 3, width, 7, use_bias=False),
        "stem_norm": _frozen_norm(reader, norm, width),
    }
    for stage, (name, depth) in enumerate(zip(stages, DEPTHS, strict=False), 1):
        for i in range(depth):
            convs, norms = _bottleneck(reader, f"{name}.{i}", stage, i, width)
            fixed = {k: _frozen_norm(reader, *v) for k, v in norms.items()}
            params[f"stage_{stage}_block_{i + 1}"] = convs | fixed
    return params


def read_last_stage(
    reader: StateDictReader, name: str, width: int = WIDTH
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parameters and running statistics of `ResNetNeck`'s blocks."""
    params, stats = {}, {}
    for i in range(DEPTHS[3]):
        convs, norms = _bottleneck(reader, f"{name}.{i}", 4, i, width)
        key = f"block_{i + 1}"
        params[key] = convs | {k: reader.norm(*v) for k, v in norms.items()}
        stats[key] = {k: reader.running(*v) for k, v in norms.items()}
    return params, stats


def _layers(
    stage: int, index: int, width: int = WIDTH
) -> dict[str, tuple[str, str, int, int, int]]:
    """Names, widths and taps of a block's convolutions and normalisations."""
    inside = width * 2 ** (stage - 1)
    out = 4 * inside
    before = out if index else (width if stage == 1 else out // 2)
    layers = {
        "1": ("conv1", "bn1", before, inside, 1),
        "2": ("conv2", "bn2", inside, inside, 3),
        "3": ("conv3", "bn3", inside, out, 1),
    }
    if index == 0:
        layers["shortcut"] = ("downsample.0", "downsample.1", before, out, 1)
    return layers


def _bottleneck(
    reader: StateDictReader, name: str, stage: int, index: int, width: int
) -> tuple[dict[str, Any], dict[str, tuple[str, int]]]:
    """Convolutions of a block, and names and widths of its normalisations."""
    convs, norms = {}, {}
    for key, layer in _layers(stage, index, width).items():
        conv, norm, size_in, size_out, taps = layer
        convs[f"conv_{key}"] = reader.conv(
            f"{name}.{conv}", size_in, size_out, taps, use_bias=False
        )
        norms[f"norm_{key}"] = (f"{name}.{norm}", size_out)
    return convs, norms


def _frozen_norm(reader: StateDictReader, name: str, features: int) -> dict[str, Any]:
    return reader.norm(name, features) | reader.running(name, features)
