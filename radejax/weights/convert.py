"""Conversion between named PyTorch tensors and Flax variables.

Every model has rules that rewrite the names of its Flax modules to those of torch, such as
`("^backbone/start/", "backbone.start_conv.")`. Names of leaves and layouts are common to all:

| Flax leaf | torch name | torch layout |
|---|---|---|
| kernel of a convolution `[k, k, in, out]` | weight | `[out, in, k, k]` |
| kernel of `upsample_*`, `up_*` `[k, k, in, out]` | weight | `[in, out, k, k]` |
| kernel of a linear layer `[in, out]` | weight | `[out, in]`, or a 1x1 convolution |
| scale, bias | weight, bias | unchanged |
| mean, var | running_mean, running_var | unchanged |

`{}` in a torch name is the index of a layer. The Flax variable has such layers stacked along
its first axis.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from flax.typing import MutableVariableDict, VariableDict

from radejax import models
from radejax.core.archives import read_safetensors
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike, as_path
from radejax.data.cameras import no_images
from radejax.models.radenet import RadeNet
from radejax.weights import torch_file

Rules = Sequence[tuple[str, str | Callable[[re.Match[str]], str]]]
"""Patterns and replacements of `re.sub`, applied in order to paths of Flax variables such as
"backbone/start/kernel". A path that still contains a slash afterwards is of an unknown module."""

StateDict = Mapping[str, Any]
"""NumPy, JAX or torch arrays by torch name."""

Shapes = Mapping[str, tuple[int, ...]]
"""Shape of each variable by its path, "params/backbone/start/kernel"."""

_LEAVES = {
    "kernel": "weight",
    "scale": "weight",
    "bias": "bias",
    "mean": "running_mean",
    "var": "running_var",
}
_TRANSPOSED = re.compile(r"(^|/)(upsample|up)_\d+/kernel$")
_SHOWN = 20


def from_torch(
    rules: Rules,
    shapes: Shapes,
    tensors: StateDict,
    source: PathLike,
    ignored: str = r"\Z",
) -> MutableVariableDict:
    """Converts named tensors to the variables of a model.

    Args:
        rules: Rules of the model.
        shapes: Shapes of the variables.
        tensors: Tensors by name.
        source: Name of the tensors in error messages.
        ignored: Pattern of the start of names that are ignored if they are not used. Unused
            `num_batches_tracked` are always ignored.

    Returns:
        Nested variables in float32.

    Raises:
        DataError: Tensors are missing, unexpected, of another shape or not finite. The
            message lists up to 20 of them.
        UserError: A module matches no rule, because torch's code has no counterpart.
    """
    left = dict(tensors)
    problems = list[str]()

    def take(name: str, path: str, shape: tuple[int, ...]) -> np.ndarray:
        if name not in left:
            problems.append(f"missing {name}")
            return np.broadcast_to(np.float32(0), shape)  # unused
        value = to_numpy(left.pop(name))
        ours = to_our_layout(path, value)
        if ours.ndim == 4 and len(shape) == 2:  # 1x1 convolution or patch embedding
            ours = ours.reshape(-1, ours.shape[-1])
        if ours.shape != shape:
            expected = to_torch_layout(path, np.broadcast_to(0, shape)).shape
            problems.append(
                f"{name} is {value.dtype}{value.shape}, expected {expected}"
            )
            return np.broadcast_to(np.float32(0), shape)  # unused
        if not np.isfinite(ours).all():
            problems.append(f"{name} has values that are not finite")
        return np.array(ours, np.float32, order="C")

    flat = {}
    for path, shape in shapes.items():
        name = torch_name(rules, path)
        if "{}" in name:
            layers = [take(name.format(i), path, shape[1:]) for i in range(shape[0])]
            if not problems:
                flat[path] = np.stack(layers)
        else:
            flat[path] = take(name, path, shape)
    problems += [
        f"unexpected {name}"
        for name in left
        if not re.match(ignored, name) and not name.endswith(".num_batches_tracked")
    ]
    if problems:
        shown = "; ".join(problem[:160] for problem in sorted(problems)[:_SHOWN])
        raise DataError(f"{source} does not fit, {len(problems)} problems: {shown}")
    variables: MutableVariableDict = unflatten_dict(flat, sep="/")
    return variables


def to_torch(rules: Rules, variables: VariableDict) -> dict[str, np.ndarray]:
    """Inverts `from_torch`; kernels stored as `[in, out]` become `[out, in]` in all cases."""
    tensors = {}
    for path, leaf in flatten_dict(variables, sep="/").items():
        name = torch_name(rules, path)
        value = np.asarray(leaf, np.float32)
        stack = enumerate(value) if "{}" in name else [(0, value)]
        for i, part in stack:
            part = to_torch_layout(path, part)
            tensors[name.format(i)] = np.ascontiguousarray(part)
    return tensors


def torch_name(rules: Rules, path: str) -> str:
    """Returns the torch name of a Flax path such as "params/backbone/start/kernel".

    Raises:
        UserError: The module matches no rule.
    """
    ours = name = path.partition("/")[2]
    for pattern, replacement in rules:
        name = re.sub(pattern, replacement, name)
    if "/" in name:
        raise UserError(
            f"{ours.rpartition('/')[0]} has no counterpart in the authors' code"
        )
    module, dot, leaf = name.rpartition(".")
    return module + dot + _LEAVES.get(leaf, leaf)


def to_torch_layout(path: str, value: np.ndarray) -> np.ndarray:
    """Transposes a Flax variable to the layout of torch."""
    return value.transpose(_torch_axes(path, value.ndim))


def to_our_layout(path: str, value: np.ndarray) -> np.ndarray:
    """Inverts `to_torch_layout`."""
    return value.transpose(np.argsort(_torch_axes(path, value.ndim)))


def _torch_axes(path: str, ndim: int) -> tuple[int, ...]:
    """Returns the axes of a Flax variable in the order of torch."""
    if not path.endswith("kernel"):
        return tuple(range(ndim))
    if ndim == 4:
        return (2, 3, 0, 1) if _TRANSPOSED.search(path) else (3, 2, 0, 1)
    return tuple(reversed(range(ndim)))


def variable_shapes(model: RadeNet) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of a detector's variables by path, without creating the variables."""
    options = model.options
    bins = options.pad_multiple
    channels = model.num_frames * (options.doppler_bins + options.elevation_bins)
    radar = np.zeros((1, bins, bins, channels), np.float32)
    camera = no_images(1, model.options.image.size) if models.has_camera(model) else ()
    return shapes_of(jax.eval_shape(model.init, jax.random.key(0), radar, *camera))


def check_finite(variables: VariableDict, source: PathLike) -> None:
    """Raises a `DataError` that names the first variable with NaN or infinite values."""
    for path, leaf in flatten_dict(dict(variables), sep="/").items():
        if not np.isfinite(leaf).all():
            raise DataError(f"{source}: {path} has values that are not finite")


def shapes_of(variables: VariableDict) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the leaves by path."""
    flat = flatten_dict(dict(variables), sep="/")
    return {path: tuple(leaf.shape) for path, leaf in flat.items()}


# Files -------------------------------------------------------------------------------


def read_state_dict(
    content_or_path: PathLike | StateDict, *parts: str
) -> tuple[StateDict, str]:
    """Reads the state dict in a file or checkpoint and removes the prefix of its names.

    Args:
        content_or_path: Tensors by name, a checkpoint with such a mapping under one key, or
            the path of a file with either: `.safetensors`, otherwise a file of `torch.save`.
        *parts: Alternative starts of names by which the state dict is found, such as
            "backbone.". A prefix in front of it, such as "module.", is removed from all names.

    Returns:
        Tensors by name, and the name of the source for error messages.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted, or contains no such state dict or more than one.
    """
    content: object = content_or_path
    source = "state dict"
    if isinstance(content_or_path, str | os.PathLike):
        path = as_path(content_or_path)
        source = str(content_or_path)
        is_torch = path.suffix != ".safetensors"
        content = torch_file.read(path) if is_torch else read_safetensors(path)
    start = re.compile(rf"((?:.*\.)?)(?:{'|'.join(map(re.escape, parts))})")
    inside = content.values() if isinstance(content, Mapping) else ()
    found = []
    for mapping in (content, *inside):
        if not isinstance(mapping, Mapping):
            continue
        matches = (start.match(name) for name in map(str, mapping))
        if match := next(filter(None, matches), None):
            tensors = {k: v for k, v in mapping.items() if hasattr(v, "shape")}
            found.append({str(k).removeprefix(match[1]): v for k, v in tensors.items()})
    if len(found) != 1:
        raise DataError(
            f"{source}: expected one state dict with tensors {'* or '.join(parts)}*, "
            f"found {len(found)}"
        )
    return found[0], source


def to_numpy(tensor: object) -> np.ndarray:
    """Converts a NumPy, JAX or torch array to NumPy; torch's bfloat16 becomes float32."""
    if hasattr(tensor, "detach"):  # a torch tensor; checked without importing torch
        host = tensor.detach().cpu()
        tensor = (host.float() if "bfloat16" in str(host.dtype) else host).numpy()
    return np.asarray(tensor)
