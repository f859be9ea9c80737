"""Official RADE-Net checkpoints (PyTorch) to Flax and back. torch is not needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from radejax import models
from radejax.core.config import load_config
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.models.radenet import RadeNet
from radejax.weights.convert import (
    from_torch,
    read_state_dict,
    to_torch,
    to_torch_layout,
    torch_name,
    variable_shapes,
    write_state_dict,
)

StateDict = Mapping[str, Any]

PART = "backbone."
"""Start of names by which a state dict of RADE-Net is recognized."""

_UNUSED_CBAM = r"(rad_)?backbone\.cbam_"  # in official models without CBAM as well


def load(
    state_dict_or_path: StateDict | PathLike, **model_overrides: Any
) -> tuple[RadeNet, dict[str, Any]]:
    """Model and variables from an official checkpoint.

    The maps keep the padded grid, which for official weights is
    `RadarGrid.kradar().padded(8, "stretched")`.

    Args:
        state_dict_or_path: Mapping from names to arrays (NumPy or torch), or a file, see
            `convert.read_state_dict`.
        **model_overrides: Fields of `config.model` that names and shapes do not show:
            the released model without CBAM still has its tensors (`cbam=None` switches
            it off), and `num_groups` (32).

    Returns:
        The model, and `{"params": ...}` with float32 arrays.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: An override is no field of the model or impossible.
        DataError: Tensors are missing, unexpected or of another shape; all are listed.
    """
    tensors, source = read_state_dict(state_dict_or_path, PART)
    config, variables = read(tensors, source, **model_overrides)
    return cast(RadeNet, models.build(config)), variables


def read(
    tensors: StateDict, source: str, **model_overrides: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """`config.model` and variables from tensors by official name; see `load`."""
    config = load_config("radenet:official").model.to_dict()
    config |= infer_config(tensors, source, model_overrides)
    shapes = variable_shapes(models.build(config))
    names = module_names(len(config["widths"]), config["heads"])
    return config, from_torch(names, shapes, tensors, source, _UNUSED_CBAM)


def save(
    model: RadeNet, variables: Mapping[str, Any], path: PathLike | None = None
) -> dict[str, np.ndarray]:
    """State dict that the official code loads: inverse of `load`.

    The official model has CBAM tensors even where it does not use them; a model without
    CBAM gets untrained ones, so that a strict load succeeds there.

    Args:
        model: The model the variables belong to.
        variables: `{"params": ...}`.
        path: Where to write it, see `convert.write_state_dict`. None only returns it.

    Returns:
        NumPy arrays by official name.

    Raises:
        UserError: `cbam="paper"`, or a center or scale of the input, has no official
            counterpart; or the file cannot be written.
    """
    if model.cbam == "paper":
        raise UserError(
            'the official code has no cbam="paper"; it knows "official" and None'
        )
    if (model.input_center, model.input_scale) != (0.0, 1.0):
        # Not to be put into the first weights either: maps are padded with zeros.
        raise UserError(
            "the official code's network takes the projection as it is; this model has "
            f"input_center={model.input_center} and input_scale={model.input_scale}: "
            "train with 0 and 1 to save it for that code"
        )
    names = module_names(len(model.widths), model.heads)
    state = to_torch(names, {"params": variables["params"]})
    if model.cbam is None:
        for name, shape in torch_shapes(model.clone(cbam="official")).items():
            is_scale = len(shape) == 1 and name.endswith("weight")
            state.setdefault(name, np.full(shape, float(is_scale), np.float32))
    if path is not None:
        write_state_dict(path, state)
    return state


# Configuration -----------------------------------------------------------------------


def infer_config(
    tensors: StateDict, source: str, overrides: StateDict, prefix: str = ""
) -> dict[str, Any]:
    """Fields of `config.model` that names and shapes show, and the overrides.

    Args:
        tensors: By official name.
        source: What error messages call them.
        overrides: Fields of `config.model`, which hold instead.
        prefix: Of "backbone.", "neck.": "rad_" in DinoRADE.

    Raises:
        DataError: A tensor that shows a size is missing.
        UserError: The input has other than 101 channels and no stem to show how many
            are Doppler; override `doppler_bins` and `elevation_bins`.
    """

    def size(name: str, axis: int) -> int:
        shape = tuple(getattr(tensors.get(name), "shape", ()))
        if axis >= len(shape):
            raise DataError(
                f"{source}: not a state dict of RADE-Net, without a tensor {name}"
            )
        return int(shape[axis])

    def width(block: str) -> int:
        return size(f"{backbone}.{block}.double_conv.0.single_conv.0.bias", 0)

    backbone = f"{prefix}backbone"
    encoder = f"{backbone}.encoder_block_"
    levels = len({n.split(".")[1] for n in tensors if n.startswith(encoder)})
    is_expanded = "head.heatmap_head.head.6.weight" in tensors
    last = f"head.heatmap_head.head.{9 if is_expanded else 3}.bias"
    fields: dict[str, Any] = {
        "num_classes": size(last, 0),
        "widths": tuple(width(f"encoder_block_{i + 1}") for i in range(levels)),
        "decoder_width": width(f"decoder_block_{levels}"),
        "cbam": "official" if f"{backbone}.cbam_" in "\n".join(tensors) else "off",
        "neck": "plain" if f"{prefix}neck.neck.0.conv.weight" in tensors else "dilated",
        "heads": "expanded" if is_expanded else "default",
        "pad_multiple": 2**levels,
    }
    stem = f"{backbone}.transform_input"
    fields["input_stem"] = f"{stem}.doppler_conv.0.weight" in tensors
    if fields["input_stem"]:
        fields["doppler_bins"] = size(f"{stem}.doppler_conv.0.weight", 1)
        fields["elevation_bins"] = size(f"{stem}.elevation_conv.0.weight", 1)
    elif not {"doppler_bins", "elevation_bins"} <= set(overrides) and (
        (channels := size(f"{backbone}.start_conv.weight", 1)) != 101
    ):
        raise UserError(
            f"{source}: the model reads {channels} channels and nothing shows how many "
            "are Doppler; give doppler_bins and elevation_bins"
        )
    fields |= overrides
    fields["cbam"] = fields["cbam"] or "off"
    return fields


# Names -------------------------------------------------------------------------------


def module_names(levels: int, heads: str, prefix: str = "") -> dict[str, str]:
    """Official module by module of ours, for `convert`.

    Args:
        levels: Of the encoder.
        heads: Kind, "expanded" or "default".
        prefix: Of "backbone" and "neck": "rad_" in DinoRADE.
    """
    unet = f"{prefix}backbone"
    names = {"backbone/start": f"{unet}.start_conv"}
    for part in ("doppler", "elevation", "mix"):
        conv = f"{unet}.transform_input.{part}_conv"
        names |= _norm_conv(f"backbone/stem/{part}", conv, "0", "1")
    for i in (1, 2):
        conv = f"{unet}.bottleneck.conv{i}"
        names |= double_conv_names(f"backbone/bottleneck_{i}", conv)
    for i in range(1, levels + 1):
        for part in ("encoder", "decoder"):
            block = f"{unet}.{part}_block_{i}"
            names |= double_conv_names(f"backbone/{part}_{i}", block)
        names |= cbam_names(f"backbone/cbam_{i}", f"{unet}.cbam_{i}")
        names[f"backbone/upsample_{i}"] = f"{unet}.upsample_{i}.upsample"
    names |= neck_names("neck", f"{prefix}neck.neck")
    count = 3 if heads == "expanded" else 1
    for ours, theirs in (("heatmap", "heatmap_head.head"), ("box", "reg_head.head")):
        # Convolution, normalization and activation each take a number.
        for i in range(count):
            block = f"heads/{ours}/conv_{i + 1}"
            names |= _norm_conv(block, f"head.{theirs}", str(3 * i), str(3 * i + 1))
        names[f"heads/{ours}/out"] = f"head.{theirs}.{3 * count}"
    return names


def torch_shapes(model: RadeNet) -> dict[str, tuple[int, ...]]:
    """Shape of every official tensor that a model uses, by its official name."""
    names = module_names(len(model.widths), model.heads)
    return {
        # A broadcast scalar has the shape without the memory.
        torch_name(names, path): to_torch_layout(path, np.broadcast_to(0, shape)).shape
        for path, shape in variable_shapes(model).items()
    }


def _norm_conv(ours: str, theirs: str, conv: str, norm: str) -> dict[str, str]:
    return {f"{ours}/conv": f"{theirs}.{conv}", f"{ours}/norm": f"{theirs}.{norm}"}


def double_conv_names(ours: str, theirs: str) -> dict[str, str]:
    """A `DoubleConvResidual`."""
    names = {f"{ours}/shortcut": f"{theirs}.adjust_input"}
    for i in (1, 2):
        block = f"{theirs}.double_conv.{i - 1}.single_conv"
        names |= _norm_conv(f"{ours}/conv_{i}", block, "0", "1")
    return names


def cbam_names(ours: str, theirs: str) -> dict[str, str]:
    """A `CBAM`."""
    names = {
        f"{ours}/channel/squeeze": f"{theirs}.channel_attention.fc1",
        f"{ours}/channel/excite": f"{theirs}.channel_attention.fc2",
        f"{ours}/spatial/conv": f"{theirs}.spatial_attention.convolution",
    }
    for end in ("start", "end"):
        block = f"{theirs}.{end}_conv.single_conv"
        names |= _norm_conv(f"{ours}/{end}", block, "0", "1")
    return names


def neck_names(ours: str, theirs: str) -> dict[str, str]:
    """A neck of either kind; the plain one has `conv`, the dilated `conv_1`, `conv_2`."""
    names: dict[str, str] = {}
    for i in (1, 2, 3):
        block, conv = f"{ours}/block_{i}", f"{theirs}.{i - 1}"
        names |= _norm_conv(block, conv, "conv", "gn")
        names |= _norm_conv(f"{block}/conv_1", f"{conv}.conv1", "conv", "gn")
        names[f"{block}/conv_2"] = f"{conv}.conv2"
    return names
