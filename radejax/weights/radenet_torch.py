"""Official RADE-Net checkpoints (PyTorch) to Flax and back. torch is not needed."""

from __future__ import annotations

import collections
import dataclasses
import pathlib
import re
from collections.abc import Callable, Mapping
from typing import Any

import flax
import numpy as np
import safetensors.numpy

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike
from radejax.models.radenet import FIELDS, RadeNet, from_config
from radejax.weights import torch_file
from radejax.weights.radenet_names import (
    from_torch_layout,
    to_torch_layout,
    torch_names,
    torch_shapes,
)
from radejax.weights.state_dict import is_tensor, read_state_dict, shorten, to_numpy

StateDict = Mapping[str, Any]


def load(
    state_dict_or_path: StateDict | PathLike, **model_overrides: Any
) -> tuple[RadeNet, dict[str, Any]]:
    """Model and variables from an official checkpoint.

    The configuration follows from names and shapes, except where those cannot tell:
    the released model without CBAM still has its tensors (`cbam=None` switches it
    off), and nothing shows `num_groups` (32). Maps stay on the padded grid, which for
    official weights is `RadarGrid.kradar().padded(8, "stretched")`.

    Args:
        state_dict_or_path: Mapping from names to arrays (NumPy or torch), or a file:
            `.pth`, `.pt` (read without torch), `.npz` or `.safetensors`. It may be
            nested in a training checkpoint, and names may have a prefix ("module.").
        **model_overrides: Fields of `RadeNet` that replace what was worked out.

    Returns:
        The model, and `{"params": ...}` with float32 arrays.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: An override is no field of the model or impossible.
        DataError: Tensors are missing, unexpected or mis-shaped; all are listed.
    """
    content, source = read_state_dict(state_dict_or_path)
    tensors = _find_state_dict(content, source)
    if unknown := sorted(set(model_overrides) - set(FIELDS)):
        raise UserError(f"unknown model fields {unknown}; available: {sorted(FIELDS)}")
    model = from_config(infer_config(tensors, **model_overrides))
    return model, {"params": _to_params(model, tensors, source)}


def save(
    model: RadeNet,
    variables: Mapping[str, Any],
    path: str | pathlib.Path | None = None,
) -> dict[str, np.ndarray]:
    """State dict that the official code loads: inverse of `load`.

    The released model has CBAM tensors even where it does not use them; a model
    without CBAM gets untrained ones, so that a strict load succeeds there.

    Args:
        model: The model the variables belong to.
        variables: `{"params": ...}`.
        path: Where to write it: `.pth`, `.pt`, `.npz` or `.safetensors`. None only
            returns it.

    Returns:
        NumPy arrays by official name.

    Raises:
        UserError: `cbam="paper"`, or a center or scale of the input, has no official
            counterpart, or the file's ending is unknown.
    """
    if model.cbam == "paper":
        raise UserError(
            'the official code has no cbam="paper"; it knows "official" and None'
        )
    if (model.input_center, model.input_scale) != (0.0, 1.0):
        # Not to be put into the first weights either: maps are padded with zeros.
        raise UserError(
            f"the official code's network sees the projection as it is; this model's has "
            f"input_center={model.input_center} and input_scale={model.input_scale}: "
            "train with 0 and 1 to save it for that code"
        )
    path = None if path is None else pathlib.Path(path)
    if path is not None and path.suffix not in _WRITERS:
        raise UserError(f"{path}: unknown ending; available: {sorted(_WRITERS)}")
    params = flax.traverse_util.flatten_dict(dict(variables["params"]))
    state = {}
    for ours, name in torch_names(model).items():
        value = to_torch_layout(name, np.asarray(params[ours], np.float32))
        state[name] = np.ascontiguousarray(value)
    for name, shape in _unused_shapes(model).items():
        is_scale = len(shape) == 1 and name.endswith("weight")
        state[name] = np.full(shape, float(is_scale), np.float32)
    if path is not None:
        _WRITERS[path.suffix](path, state)
    return state


def _unused_shapes(model: RadeNet) -> dict[str, tuple[int, ...]]:
    """Tensors that the official model has and does not use."""
    if model.cbam is not None:
        return {}
    official = torch_shapes(model.clone(cbam="official"))
    used = set(torch_names(model).values())
    return {name: shape for name, shape in official.items() if name not in used}


def _to_params(model: RadeNet, tensors: StateDict, source: str) -> dict[str, Any]:
    expected = torch_shapes(model)
    unused = _unused_shapes(model)
    problems = [
        f"missing {name} {s}" for name, s in expected.items() if name not in tensors
    ]
    problems += [
        f"unexpected {name} {tuple(value.shape)}"
        for name, value in tensors.items()
        if name not in expected and name not in unused
    ]
    problems += [
        f"mis-shaped {name}: {tuple(tensors[name].shape)}, expected {shape}"
        for name, shape in expected.items()
        if name in tensors and tuple(tensors[name].shape) != shape
    ]
    if problems:
        raise DataError(
            f"{source} does not fit {_model_text(model)}; {len(problems)} problems: "
            + shorten(problems, "; ")
        )
    flat = {
        path: np.array(
            from_torch_layout(name, to_numpy(tensors[name])), np.float32, order="C"
        )
        for path, name in torch_names(model).items()
    }
    return flax.traverse_util.unflatten_dict(flat)


def _model_text(model: RadeNet) -> str:
    """One line with the fields that decide about parameters."""
    names = ["widths", "decoder_width", "num_classes", "cbam", "input_stem"]
    names += ["neck", "heads"]
    return f"RadeNet({', '.join(f'{n}={getattr(model, n)!r}' for n in names)})"


# Configuration -----------------------------------------------------------------------


def infer_config(tensors: StateDict, **overrides: Any) -> dict[str, Any]:
    """Model config that names and shapes of official tensors show.

    Where tensors disagree the most frequent size wins, so that one damaged tensor is
    reported as such.

    Raises:
        UserError: The input has other than 101 channels and no stem to show how many
            are Doppler; override `doppler_bins` and `elevation_bins`.
    """
    shapes = {name: tuple(value.shape) for name, value in tensors.items()}
    levels = {int(m[1]) for n in shapes if (m := _ENCODER.match(n))}
    if levels != set(range(1, len(levels) + 1)):
        raise DataError(
            "not a state dict of RADE-Net: its encoder blocks are numbered "
            f"{sorted(levels)[-3:]}, expected 1 to {len(levels)}"
        )
    widths = tuple(
        _common_size(shapes, f"backbone.encoder_block_{i}.", 0)
        for i in range(1, len(levels) + 1)
    )
    heads = "expanded" if "head.heatmap_head.head.6.weight" in shapes else "default"
    last_head = f"head.heatmap_head.head.{9 if heads == 'expanded' else 3}."
    has_cbam = any(name.startswith("backbone.cbam_") for name in shapes)
    shown = {
        "num_classes": _common_size(shapes, last_head, 0),
        "widths": widths,
        "decoder_width": _common_size(
            shapes, f"backbone.decoder_block_{len(widths)}.", 0
        ),
        "cbam": "official" if has_cbam else None,
        "neck": _infer_neck(shapes),
        "heads": heads,
        "pad_multiple": 2 ** len(widths),
    }
    if None in (shown["num_classes"], shown["decoder_width"], *widths) or not widths:
        raise DataError(
            "not a state dict of RADE-Net: encoder, decoder or head are missing; its "
            f"names are {_some_names(shapes)}"
        )
    fields = {f.name: f.default for f in dataclasses.fields(RadeNet)}
    defaults = {name: fields[name] for name in FIELDS}
    shown |= _infer_input(shapes, overrides)
    return {"name": "radenet"} | defaults | shown | overrides


def _infer_neck(shapes: Mapping[str, Any]) -> str:
    found = {n.split(".")[3] for n in shapes if n.startswith("neck.neck.0.")}
    known = {"dilated": "conv1", "plain": "conv"}
    kinds = [kind for kind, part in known.items() if part in found]
    if not kinds and found:
        raise DataError(
            f"neck.neck.0 has {', '.join(sorted(found))}, expected conv1 (neck 'dilated') "
            "or conv ('plain')"
        )
    return kinds[0] if kinds else "plain"


_ENCODER = re.compile(r"backbone\.encoder_block_([0-9]{1,9})\.")


def _infer_input(
    shapes: Mapping[str, tuple[int, ...]], overrides: Mapping[str, Any]
) -> dict[str, Any]:
    stem = "backbone.transform_input."
    doppler = _common_size(shapes, f"{stem}doppler_conv.0.weight", 1)
    elevation = _common_size(shapes, f"{stem}elevation_conv.0.weight", 1)
    has_stem = any(name.startswith(stem) for name in shapes)
    if doppler is None or elevation is None:
        channels = _common_size(shapes, "backbone.start_conv.weight", 1) or 101
        doppler, elevation = 64, 37
        is_given = {"doppler_bins", "elevation_bins"} <= set(overrides)
        if channels != doppler + elevation and not is_given:
            raise UserError(
                f"the model reads {channels} channels and nothing shows how many are "
                "Doppler; give doppler_bins and elevation_bins"
            )
    return {
        "input_stem": has_stem,
        "doppler_bins": doppler,
        "elevation_bins": elevation,
    }


def _common_size(
    shapes: Mapping[str, tuple[int, ...]], prefix: str, axis: int
) -> int | None:
    sizes = [s[axis] for n, s in shapes.items() if n.startswith(prefix) and s[axis:]]
    return collections.Counter(sizes).most_common(1)[0][0] if sizes else None


# Files -------------------------------------------------------------------------------


_WRITERS: dict[str, Callable[[pathlib.Path, dict[str, np.ndarray]], object]] = {
    ".pth": torch_file.write,
    ".pt": torch_file.write,
    # NumPy would have `allow_pickle`, which no tensor is named, a bool.
    ".npz": lambda path, state: np.savez(path, **state),  # type: ignore[arg-type]
    # `save_file` would write for the owner alone.
    ".safetensors": lambda path, state: path.write_bytes(safetensors.numpy.save(state)),
}


def _find_state_dict(content: Any, source: str) -> dict[str, Any]:
    """The one RADE-Net state dict in a checkpoint, without prefixes of its names."""
    found = list(_state_dicts(content, ""))
    if len(found) != 1:
        where = [key or "(top level)" for key, _ in found]
        if found:
            raise UserError(f"{source} has several state dicts, {where}; pass one")
        names = _some_names(content) if isinstance(content, Mapping) else type(content)
        raise DataError(f"{source} has no RADE-Net state dict; it holds {names}")
    tensors = found[0][1]
    prefixes = collections.Counter(
        name[: match.start(1)] for name in tensors if (match := _PART.search(name))
    )
    prefix = prefixes.most_common(1)[0][0]
    return {name.removeprefix(prefix): value for name, value in tensors.items()}


_PART = re.compile(r"(?:^|\.)((?:backbone|neck|head)\.)")


def _state_dicts(content: Any, key: str) -> Any:
    if not isinstance(content, Mapping):
        return
    tensors = {n: v for n, v in content.items() if is_tensor(n, v)}
    if any(map(_PART.search, tensors)):
        yield key, tensors
        return
    for name, value in content.items():
        yield from _state_dicts(value, f"{key}.{name}".removeprefix("."))


def _some_names(mapping: Mapping[str, Any]) -> str:
    names = [str(name) for name in mapping]
    return f"{names[:5]}{' and others' if len(names) > 5 else ''}"
