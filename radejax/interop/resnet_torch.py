"""ResNet-50 weights as torchvision distributes them, to Flax. torch is not needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from radejax.core.errors import DataError
from radejax.core.files import PathLike
from radejax.interop.state_dict import StateDictReader, read_state_dict

DEPTHS = (3, 4, 6, 3)
WIDTH = 64


def load(state_dict_or_path: Mapping[str, Any] | PathLike) -> dict[str, Any]:
    """Variables of DinoRADE's ResNet from torchvision's `resnet50-*.pth`.

    Args:
        state_dict_or_path: The file, or its tensors by name.

    Returns:
        `{"params": {"image_backbone", "image_neck"}, "batch_stats": {"image_neck"}}`,
        without the 1x1 projection, which is DinoRADE's own: for
        `radejax.training.state.with_pretrained`.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: Tensors are missing, unexpected or mis-shaped; all are listed.
    """
    tensors, source = read_state_dict(state_dict_or_path)
    if not isinstance(tensors, Mapping):
        raise DataError(f"{source} holds {type(tensors).__name__}, not a state dict")
    reader = StateDictReader(tensors, source)
    trunk = read_trunk(reader, ("conv1", "bn1", "layer1", "layer2", "layer3"))
    params, stats = read_last_stage(reader, "layer4")
    reader.finish(ignored=(r"fc\.",))
    return {
        "params": {"image_backbone": trunk, "image_neck": params},
        "batch_stats": {"image_neck": stats},
    }


def read_trunk(reader: StateDictReader, names: tuple[str, ...]) -> dict[str, Any]:
    """Parameters of `ResNetTrunk`; `names` of stem, its norm and three stages."""
    conv, norm, *stages = names
    params = {
        "stem_conv": reader.conv(conv, 3, WIDTH, 7, use_bias=False),
        "stem_norm": _frozen_norm(reader, norm, WIDTH),
    }
    for stage, (name, depth) in enumerate(zip(stages, DEPTHS, strict=False), 1):
        for i in range(depth):
            convs, norms = _bottleneck(reader, f"{name}.{i}", stage, i)
            fixed = {k: _frozen_norm(reader, *v) for k, v in norms.items()}
            params[f"stage_{stage}_block_{i + 1}"] = convs | fixed
    return params


def read_last_stage(
    reader: StateDictReader, name: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Parameters and running statistics of `ResNetNeck`'s blocks."""
    params, stats = {}, {}
    for i in range(DEPTHS[3]):
        convs, norms = _bottleneck(reader, f"{name}.{i}", 4, i)
        key = f"block_{i + 1}"
        params[key] = convs | {k: reader.norm(*v) for k, v in norms.items()}
        stats[key] = {k: reader.running(*v) for k, v in norms.items()}
    return params, stats


def _bottleneck(
    reader: StateDictReader, name: str, stage: int, index: int
) -> tuple[dict[str, Any], dict[str, tuple[str, int]]]:
    """Convolutions of a block, and names and widths of its normalisations."""
    inside = WIDTH * 2 ** (stage - 1)
    out = 4 * inside
    before = out if index else (WIDTH if stage == 1 else out // 2)
    layers = {
        "1": ("conv1", "bn1", before, inside, 1),
        "2": ("conv2", "bn2", inside, inside, 3),
        "3": ("conv3", "bn3", inside, out, 1),
    }
    if index == 0:
        layers["shortcut"] = ("downsample.0", "downsample.1", before, out, 1)
    convs, norms = {}, {}
    for key, (conv, norm, size_in, size_out, taps) in layers.items():
        convs[f"conv_{key}"] = reader.conv(
            f"{name}.{conv}", size_in, size_out, taps, use_bias=False
        )
        norms[f"norm_{key}"] = (f"{name}.{norm}", size_out)
    return convs, norms


def _frozen_norm(reader: StateDictReader, name: str, features: int) -> dict[str, Any]:
    return reader.norm(name, features) | reader.running(name, features)
