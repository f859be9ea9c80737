"""What the released RADE-Net calls its tensors, and how it lays them out.

Its names start with `backbone.`, `neck.` and `head.`. Its convolutions are
`[out, in, k, k]`, transposed ones `[in, out, k, k]`, linear layers `[out, in]`; ours
are `[k, k, in, out]` and `[in, out]`.
"""

from __future__ import annotations

import functools

import flax
import jax
import numpy as np

from radejax.core.errors import UserError
from radejax.models.radenet import RadeNet

Path = tuple[str, ...]
"""Path of a parameter in the tree of variables["params"]."""


def _norm_conv(ours: str, theirs: str, conv: str, norm: str) -> dict[str, str]:
    return {f"{ours}/conv": f"{theirs}.{conv}", f"{ours}/norm": f"{theirs}.{norm}"}


def _double_conv(ours: str, theirs: str) -> dict[str, str]:
    names = {f"{ours}/shortcut": f"{theirs}.adjust_input"}
    for i in (1, 2):
        block = f"{theirs}.double_conv.{i - 1}.single_conv"
        names |= _norm_conv(f"{ours}/conv_{i}", block, "0", "1")
    return names


def _cbam(ours: str, theirs: str) -> dict[str, str]:
    names = {
        f"{ours}/channel/squeeze": f"{theirs}.channel_attention.fc1",
        f"{ours}/channel/excite": f"{theirs}.channel_attention.fc2",
        f"{ours}/spatial/conv": f"{theirs}.spatial_attention.convolution",
    }
    for end in ("start", "end"):
        block = f"{theirs}.{end}_conv.single_conv"
        names |= _norm_conv(f"{ours}/{end}", block, "0", "1")
    return names


def backbone_names(levels: int) -> dict[str, str]:
    """Official module name of every module of the backbone, by our path."""
    names = {"start": "start_conv"}
    for part in ("doppler", "elevation", "mix"):
        names |= _norm_conv(f"stem/{part}", f"transform_input.{part}_conv", "0", "1")
    for i in (1, 2):
        names |= _double_conv(f"bottleneck_{i}", f"bottleneck.conv{i}")
    for i in range(1, levels + 1):
        names |= _double_conv(f"encoder_{i}", f"encoder_block_{i}")
        names |= _double_conv(f"decoder_{i}", f"decoder_block_{i}")
        names |= _cbam(f"cbam_{i}", f"cbam_{i}")
        names[f"upsample_{i}"] = f"upsample_{i}.upsample"
    return names


def neck_names(kind: str) -> dict[str, str]:
    """Official module name of every module of the neck, by our path."""
    names: dict[str, str] = {}
    for i in (1, 2, 3):
        theirs = f"neck.{i - 1}"
        if kind == "plain":
            names |= _norm_conv(f"block_{i}", theirs, "conv", "gn")
        else:
            names |= _norm_conv(f"block_{i}/conv_1", f"{theirs}.conv1", "conv", "gn")
            names[f"block_{i}/conv_2"] = f"{theirs}.conv2"
            names[f"block_{i}/norm"] = f"{theirs}.gn"
    return names


def head_names(kind: str) -> dict[str, str]:
    """Official module name of every module of both heads, by our path."""
    names: dict[str, str] = {}
    convs = 3 if kind == "expanded" else 1
    for ours, theirs in (("heatmap", "heatmap_head.head"), ("box", "reg_head.head")):
        # Convolution, normalisation and activation each take a number.
        for i in range(convs):
            names |= _norm_conv(
                f"{ours}/conv_{i + 1}", theirs, str(3 * i), str(3 * i + 1)
            )
        names[f"{ours}/out"] = f"{theirs}.{3 * convs}"
    return names


_KNOWN = {
    "backbone": ("unet",),
    "neck": ("dilated", "plain"),
    "heads": ("expanded", "default"),
}


def torch_names(model: RadeNet) -> dict[Path, str]:
    """Official name of every parameter of a model, by its path in our tree.

    Raises:
        UserError: A part of the model is none of the released code's.
    """
    for part, known in _KNOWN.items():
        if (kind := getattr(model, part)) not in known:
            raise UserError(
                f"{part} {kind!r} has no names in the released code, which has "
                f"{', '.join(known)}"
            )
    modules = {
        f"{ours}/{path}": f"{theirs}.{name}"
        for ours, theirs, names in (
            ("backbone", "backbone", backbone_names(len(model.widths))),
            ("neck", "neck", neck_names(model.neck)),
            ("heads", "head", head_names(model.heads)),
        )
        for path, name in names.items()
    }
    return {
        path: f"{modules['/'.join(path[:-1])]}.{_leaf_name(path[-1])}"
        for path in param_shapes(model)
    }


def _leaf_name(ours: str) -> str:
    """Official name of a parameter within its module."""
    return "bias" if ours == "bias" else "weight"


def param_shapes(model: RadeNet) -> dict[Path, tuple[int, ...]]:
    """Shape of every parameter of a model, by its path, without making any."""
    return _param_shapes(model.clone(widths=tuple(model.widths)))


@functools.lru_cache(maxsize=8)  # traced a few times for one file otherwise
def _param_shapes(model: RadeNet) -> dict[Path, tuple[int, ...]]:
    channels = model.doppler_bins + model.elevation_bins
    example = jax.ShapeDtypeStruct(
        (1, model.pad_multiple, model.pad_multiple, channels), np.float32
    )
    variables = jax.eval_shape(model.init, jax.random.key(0), example)
    flat = flax.traverse_util.flatten_dict(variables["params"])
    return {path: leaf.shape for path, leaf in flat.items()}


# Layouts -----------------------------------------------------------------------------


def to_torch_layout(name: str, value: np.ndarray) -> np.ndarray:
    """Our parameter in the layout of the official tensor of that name."""
    if value.ndim == 4:
        is_transposed = name.endswith("upsample.weight")
        return value.transpose((2, 3, 0, 1) if is_transposed else (3, 2, 0, 1))
    return value.T if value.ndim == 2 else value


def from_torch_layout(name: str, value: np.ndarray) -> np.ndarray:
    """Inverse of `to_torch_layout`."""
    if value.ndim == 4:
        is_transposed = name.endswith("upsample.weight")
        return value.transpose((2, 3, 0, 1) if is_transposed else (2, 3, 1, 0))
    return value.T if value.ndim == 2 else value


def torch_shapes(model: RadeNet) -> dict[str, tuple[int, ...]]:
    """Shape of every official tensor that a model uses, by its official name."""
    shapes = param_shapes(model)
    # A broadcast scalar has the shape without the memory.
    return {
        name: to_torch_layout(name, np.broadcast_to(0, shapes[path])).shape
        for path, name in torch_names(model).items()
    }
