"""Taking tensors out of a state dict by name, with nothing missed and nothing left."""

from __future__ import annotations

import os
import pathlib
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from radejax.core.archives import read_npz, read_safetensors
from radejax.core.errors import DataError
from radejax.weights import torch_file

_SHOWN, _LONGEST = 20, 120


class StateDictReader:
    """Hands out tensors by name and keeps account of what did not fit.

    Problems are gathered and raised together by `finish`, so that one look shows all
    of them; until then a missing or mis-shaped tensor reads as zeros.

    Args:
        tensors: Arrays by name (NumPy, torch or JAX).
        source: What the error message calls them: a file or "state dict".
    """

    def __init__(self, tensors: Mapping[str, Any], source: str):
        self._tensors = tensors
        self._source = source
        self._taken: set[str] = set()
        self._missing: list[str] = []
        self._mis_shaped: list[str] = []

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all tensors."""
        return tuple(self._tensors)

    def give_away(self, name: str) -> Any:
        """The tensor as it is, for another reader to account for."""
        self._taken.add(name)
        return self._tensors[name]

    def take(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """The tensor as float32, or zeros of the shape after noting a problem."""
        self._taken.add(name)
        if name not in self._tensors:
            self._missing.append(name)
            return np.zeros(shape, np.float32)
        tensor = to_numpy(self._tensors[name])
        if tensor.shape != tuple(shape) or not is_tensor(name, tensor):
            kind = "" if is_tensor(name, tensor) else f" of {tensor.dtype}"
            found, expected = f"{list(tensor.shape)}{kind}", list(shape)
            self._mis_shaped.append(f"{name} is {found}, expected {expected}")
            return np.zeros(shape, np.float32)
        return tensor.astype(np.float32)

    def linear(
        self, name: str, features_in: int, features_out: int, *, use_bias: bool = True
    ) -> dict[str, np.ndarray]:
        """Kernel `[in, out]` and bias of a torch linear layer."""
        kernel = self.take(f"{name}.weight", (features_out, features_in)).T
        return {"kernel": kernel} | self._bias(name, features_out, use_bias)

    def conv(
        self,
        name: str,
        features_in: int,
        features_out: int,
        size: int,
        *,
        use_bias: bool = True,
    ) -> dict[str, np.ndarray]:
        """Kernel `[k, k, in, out]` and bias of a torch convolution."""
        shape = (features_out, features_in, size, size)
        kernel = self.take(f"{name}.weight", shape).transpose(2, 3, 1, 0)
        return {"kernel": kernel} | self._bias(name, features_out, use_bias)

    def conv_transpose(
        self, name: str, features_in: int, features_out: int, size: int
    ) -> dict[str, np.ndarray]:
        """Kernel `[k, k, in, out]` and bias of a torch transposed convolution."""
        shape = (features_in, features_out, size, size)
        kernel = self.take(f"{name}.weight", shape).transpose(2, 3, 0, 1)
        return {"kernel": kernel} | self._bias(name, features_out, True)

    def norm(self, name: str, features: int) -> dict[str, np.ndarray]:
        """Scale and bias of a torch normalisation."""
        return {
            "scale": self.take(f"{name}.weight", (features,)),
            "bias": self.take(f"{name}.bias", (features,)),
        }

    def running(self, name: str, features: int) -> dict[str, np.ndarray]:
        """Running mean and variance of a torch batch normalisation."""
        self._taken.add(f"{name}.num_batches_tracked")
        return {
            "mean": self.take(f"{name}.running_mean", (features,)),
            "var": self.take(f"{name}.running_var", (features,)),
        }

    def finish(self, ignored: Iterable[str] = ()) -> None:
        """Raises unless every tensor was there, fitted, and all were used.

        Args:
            ignored: Patterns of names (matched from the start) that may be left.

        Raises:
            DataError: Lists missing, unexpected and mis-shaped tensors.
        """
        patterns = [re.compile(p) for p in ignored]
        left = [
            name
            for name in self._tensors
            if name not in self._taken and not any(p.match(name) for p in patterns)
        ]
        problems = {
            "missing": self._missing,
            "unexpected": left,
            "mis-shaped": self._mis_shaped,
        }
        parts = [
            f"{len(names)} {kind}: {shorten(names)}"
            for kind, names in problems.items()
            if names
        ]
        if parts:
            raise DataError(f"{self._source}: tensors do not fit; " + "; ".join(parts))

    def _bias(self, name: str, features: int, use_bias: bool) -> dict[str, np.ndarray]:
        return {"bias": self.take(f"{name}.bias", (features,))} if use_bias else {}


def read_state_dict(content_or_path: Any) -> tuple[Any, str]:
    """Content, and what error messages call it.

    Args:
        content_or_path: Tensors by name, perhaps nested; or a file: `.pth`, `.pt` (read
            without torch), `.npz` or `.safetensors`.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is damaged.
    """
    if not isinstance(content_or_path, str | os.PathLike):
        return content_or_path, "state dict"
    path = pathlib.Path(content_or_path)
    if path.suffix == ".npz":
        return read_npz(path), str(path)
    if path.suffix == ".safetensors":
        return read_safetensors(path), str(path)
    return torch_file.read(path), str(path)


def to_numpy(tensor: Any) -> np.ndarray:
    """A NumPy array of a NumPy, JAX or torch tensor; bfloat16 becomes float32."""
    if hasattr(tensor, "detach"):  # torch, which need not be importable
        tensor = tensor.detach().cpu()
        if str(tensor.dtype) == "torch.bfloat16":
            tensor = tensor.float()
        return tensor.numpy()
    return np.asarray(tensor)


def is_tensor(name: Any, value: Any) -> bool:
    """Whether an entry of a file is a tensor of numbers with a name."""
    dtype = getattr(value, "dtype", None)
    is_number = getattr(dtype, "kind", "f") in "biufV"  # V: bfloat16; torch has none
    return isinstance(name, str) and hasattr(value, "shape") and is_number


def shorten(names: list[str], separator: str = ", ") -> str:
    """The first names of a list, each cut to what a message can show."""
    text = separator.join(name[:_LONGEST] for name in sorted(names)[:_SHOWN])
    return text + f"{separator}..." * (len(names) > _SHOWN)
