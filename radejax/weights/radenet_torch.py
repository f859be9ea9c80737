"""Conversion between official RADE-Net checkpoints (PyTorch) and Flax, without torch."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from flax.typing import MutableVariableDict, VariableDict

from radejax import models
from radejax.core.errors import DataError, UserError
from radejax.models.options import OFFICIAL_RADENET, RadeNetOptions
from radejax.models.radenet import RadeNet
from radejax.weights import convert
from radejax.weights.convert import Rules, StateDict

PART = "backbone."
"""Start of names by which a RADE-Net state dict is recognized."""

_UNUSED_CBAM = r"(rad_)?backbone\.cbam_"  # official models without CBAM have them too


def read(
    tensors: StateDict, source: str, **model_overrides: object
) -> tuple[RadeNetOptions, MutableVariableDict]:
    """Returns the options and the variables of tensors by official name.

    The maps include the padding; their grid for weights of the authors' code is
    `RadarGrid.kradar().padded(8, "stretched")`.

    Args:
        tensors: Tensors by official name, see `convert.read_state_dict`.
        source: Name of the tensors in error messages.
        **model_overrides: Fields of `config.model`, which replace those inferred from names
            and shapes and the defaults. `cbam="off"` is needed for released models without
            CBAM, as they contain its tensors, and `num_groups` for other than 32 groups.

    Returns:
        `config.model`, and `{"params": ...}` with float32 arrays.

    Raises:
        UserError: An override is unknown or invalid, or `doppler_bins` and `elevation_bins`
            are needed and missing, see `infer_fields`.
        DataError: Tensors are missing, unexpected or of another shape. The message lists up
            to 20 of them.
    """
    fields = infer_fields(tensors, source, model_overrides)
    options = OFFICIAL_RADENET.replace(**fields)
    shapes = convert.variable_shapes(models.build(options))
    names = rules(options.heads)
    return options, convert.from_torch(names, shapes, tensors, source, _UNUSED_CBAM)


def save(model: RadeNet, variables: VariableDict) -> dict[str, np.ndarray]:
    """Returns a state dict that the official code can load; this is the inverse of `read`.

    To write a file, use `safetensors.numpy.save_file(state, path)`, or `torch.save` after
    `torch.from_numpy` of every array.

    Official models without CBAM contain its tensors too. For a model without CBAM, they are
    filled with ones (scales) and zeros, so that a strict load succeeds.

    Args:
        model: Model that the variables belong to.
        variables: `{"params": ...}`.

    Returns:
        NumPy arrays by official name.

    Raises:
        UserError: The model has `cbam="paper"` or an `input_center` or `input_scale`, which
            have no official counterpart.
    """
    options = model.options
    if options.cbam == "paper":
        raise UserError(
            'the official code has no cbam="paper", only "official" and "off"'
        )
    if (options.input_center, options.input_scale) != (0.0, 1.0):
        # They cannot be merged into the first weights, because zeros are padded after them.
        raise UserError(
            "the official code's network takes the projection as it is; this model has "
            f"input_center={options.input_center} and input_scale={options.input_scale}: "
            "train with 0 and 1 to save it for that code"
        )
    state = convert.to_torch(rules(options.heads), {"params": variables["params"]})
    if options.cbam == "off":
        whole = RadeNet(options.replace(cbam="official"), model.num_frames)
        for name, shape in torch_shapes(whole).items():
            is_scale = len(shape) == 1 and name.endswith("weight")
            state.setdefault(name, np.full(shape, float(is_scale), np.float32))
    return state


# Configuration -----------------------------------------------------------------------


def infer_fields(
    tensors: StateDict, source: str, overrides: Mapping[str, object], prefix: str = ""
) -> dict[str, object]:
    """Infers fields of `config.model` from names and shapes, and applies the overrides.

    Args:
        tensors: Tensors by official name.
        source: Name of the tensors in error messages.
        overrides: Fields of `config.model` that replace the inferred ones.
        prefix: Prefix of "backbone" and "neck" in names: "rad_" in DinoRADE.

    Raises:
        DataError: A tensor from which a size is inferred is missing.
        UserError: The number of Doppler channels is unknown, because the model has no input
            stem and not 101 channels, and `doppler_bins` or `elevation_bins` is missing.
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
    fields: dict[str, object] = {
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
    elif not {"doppler_bins", "elevation_bins"} <= set(overrides):
        channels = size(f"{backbone}.start_conv.weight", 1)
        if channels != 101:
            raise UserError(
                f"{source}: the model reads {channels} channels and nothing shows how "
                "many are Doppler; give doppler_bins and elevation_bins"
            )
    return fields | dict(overrides)


# Names -------------------------------------------------------------------------------


def rules(heads: str, prefix: str = "") -> Rules:
    """Returns the rules from modules of `RadeNet` to official names, for `convert`.

    Args:
        heads: Kind of the heads, "expanded" or "default".
        prefix: Prefix of "backbone" and "neck" in official names: "rad_" in DinoRADE.
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
        # In torch, convolution, normalization and activation have consecutive indices.
        (r"^heads/heatmap/", "head.heatmap_head.head/"),
        (r"^heads/box/", "head.reg_head.head/"),
        (r"head/conv_(\d)/conv/", lambda m: f"head.{3 * int(m[1]) - 3}."),
        (r"head/conv_(\d)/norm/", lambda m: f"head.{3 * int(m[1]) - 2}."),
        (r"head/out/", f"head.{out}."),
    )


def neck_rules(ours: str, theirs: str) -> Rules:
    """Returns the rules of a plain neck (with `conv`) or dilated one (`conv_1`, `conv_2`)."""
    block = rf"({re.escape(theirs)}\.\d\.(?:conv1\.)?)"
    return (
        (rf"^{ours}/block_(\d)/", lambda m: f"{theirs}.{int(m[1]) - 1}."),
        (rf"{block}conv_(\d)/", r"\1conv\2."),
        (rf"{block}conv/", r"\1conv."),
        (rf"{block}norm/", r"\1gn."),
    )


def torch_shapes(model: RadeNet) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the official tensors that a model uses, by official name."""
    names = rules(model.options.heads)
    shapes = {}
    for path, shape in convert.variable_shapes(model).items():
        # A broadcast scalar has the shape without using the memory.
        value = convert.to_torch_layout(path, np.broadcast_to(0, shape))
        shapes[convert.torch_name(names, path)] = value.shape
    return shapes
