"""Official RADE-Net checkpoints (PyTorch) to Flax and back. torch is not needed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from radejax import models
from radejax.core.config import load_config
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.models.radenet import RadeNet
from radejax.weights.convert import (
    Rules,
    from_torch,
    read_state_dict,
    to_torch,
    to_torch_layout,
    torch_name,
    variable_shapes,
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
    names = rules(config["heads"])
    return config, from_torch(names, shapes, tensors, source, _UNUSED_CBAM)


def save(model: RadeNet, variables: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """State dict that the official code loads: inverse of `load`.

    To write a file, use `safetensors.numpy.save_file(state, path)`, or `torch.save` after
    `torch.from_numpy` of every array.

    The official model has CBAM tensors even where it does not use them; a model without
    CBAM gets untrained ones, so that a strict load succeeds there.

    Args:
        model: The model the variables belong to.
        variables: `{"params": ...}`.

    Returns:
        NumPy arrays by official name.

    Raises:
        UserError: `cbam="paper"`, or a center or scale of the input, has no official
            counterpart.
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
    state = to_torch(rules(model.heads), {"params": variables["params"]})
    if model.cbam is None:
        for name, shape in torch_shapes(model.clone(cbam="official")).items():
            is_scale = len(shape) == 1 and name.endswith("weight")
            state.setdefault(name, np.full(shape, float(is_scale), np.float32))
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


def rules(heads: str, prefix: str = "") -> Rules:
    """Rules from modules of RADE-Net to the official ones, for `convert`.

    Args:
        heads: Kind, "expanded" or "default".
        prefix: Prefix of "backbone" and "neck": "rad_" in DinoRADE.
    """
    unet = f"{prefix}backbone"
    out = 9 if heads == "expanded" else 3
    return (
        (r"^backbone/start/", f"{unet}.start_conv."),
        (r"^backbone/stem/(\w+)/", rf"{unet}.transform_input.\1_conv."),
        (r"^backbone/bottleneck_(\d)/", rf"{unet}.bottleneck.conv\1."),
        (r"^backbone/(encoder|decoder)_(\d+)/", rf"{unet}.\1_block_\2."),
        (r"^backbone/upsample_(\d+)/", rf"{unet}.upsample_\1.upsample."),
        (r"^backbone/cbam_(\d+)/", rf"{unet}.cbam_\1."),
        (r"\.channel/squeeze/", ".channel_attention.fc1."),
        (r"\.channel/excite/", ".channel_attention.fc2."),
        (r"\.spatial/conv/", ".spatial_attention.convolution."),
        (r"\.(start|end)/", r".\1_conv.single_conv."),
        (r"\.shortcut/", ".adjust_input."),
        (r"\.conv_(\d)/", lambda m: f".double_conv.{int(m[1]) - 1}.single_conv."),
        (r"\.conv/", ".0."),
        (r"\.norm/", ".1."),
        *neck_rules("neck", f"{prefix}neck.neck"),
        # Convolution, normalization and activation each take a number.
        (r"^heads/heatmap/", "head.heatmap_head.head/"),
        (r"^heads/box/", "head.reg_head.head/"),
        (r"head/conv_(\d)/conv/", lambda m: f"head.{3 * int(m[1]) - 3}."),
        (r"head/conv_(\d)/norm/", lambda m: f"head.{3 * int(m[1]) - 2}."),
        (r"head/out/", f"head.{out}."),
    )


def neck_rules(ours: str, theirs: str) -> Rules:
    """A neck of either kind; the plain one has `conv`, the dilated `conv_1`, `conv_2`."""
    block = rf"({re.escape(theirs)}\.\d\.(?:conv1\.)?)"
    return (
        (rf"^{ours}/block_(\d)/", lambda m: f"{theirs}.{int(m[1]) - 1}."),
        (rf"{block}conv_(\d)/", r"\1conv\2."),
        (rf"{block}conv/", r"\1conv."),
        (rf"{block}norm/", r"\1gn."),
    )


def torch_shapes(model: RadeNet) -> dict[str, tuple[int, ...]]:
    """Shape of every official tensor that a model uses, by its official name."""
    names = rules(model.heads)
    return {
        # A broadcast scalar has the shape without the memory.
        torch_name(names, path): to_torch_layout(path, np.broadcast_to(0, shape)).shape
        for path, shape in variable_shapes(model).items()
    }
