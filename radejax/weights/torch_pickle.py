"""What a pickle of PyTorch may make: containers, numbers, tensors, and nothing that acts."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np

from radejax.core.errors import DataError

BFLOAT16 = "bfloat16"

_MAX_DEPTH, _MAX_VALUES = 64, 10_000

STORAGE_DTYPES: dict[str, type[np.generic] | str] = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": BFLOAT16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
    "ComplexFloatStorage": np.complex64,
    "ComplexDoubleStorage": np.complex128,
}


class Opaque:
    """What stands for an object of a class that is not read; it does nothing."""

    def __init__(self, *args: Any, **kwargs: Any):
        del args, kwargs

    def __new__(cls, *args: Any, **kwargs: Any) -> Opaque:
        del args, kwargs
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        del state

    def __setitem__(self, key: Any, value: Any) -> None:
        del key, value

    def append(self, item: Any) -> None:
        del item

    def extend(self, items: Any) -> None:
        del items


@dataclasses.dataclass(eq=False)
class Storage:
    """Numbers of a file, which may not have been read yet."""

    dtype: Any
    size: int
    values: np.ndarray | None = None


@dataclasses.dataclass(eq=False)
class Tensor:
    """A view into a storage whose bytes may not have been read yet."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Dict(dict):
    """A dict that swallows attributes, as state dicts carry `_metadata`."""

    def __setstate__(self, state: Any) -> None:
        del state


@dataclasses.dataclass(frozen=True)
class _Builder:
    """A function that a pickle may call and cannot change."""

    function: Callable[..., Any]

    def __call__(self, *args: Any) -> Any:
        return self.function(*args)

    def __setstate__(self, state: Any) -> None:
        del state


# The one in Python: that in C takes memory for the places of its memo as claimed.
class Unpickler(pickle._Unpickler):
    """Unpickler that resolves names to nothing but what this module defines."""

    def __init__(self, file: Any, storages: dict[str, Storage]):
        super().__init__(file, encoding="utf-8")
        self._storages = storages

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _BUILDERS:
            return _BUILDERS[module, name]
        if module in ("torch", "torch.storage") and name in STORAGE_DTYPES:
            return STORAGE_DTYPES[name]
        return type(name, (Opaque,), {})

    def persistent_load(self, pid: Any) -> Storage:
        if not isinstance(pid, tuple) or len(pid) < 5 or pid[0] != "storage":
            raise DataError(f"unknown persistent object {pid!r}")
        _, dtype, key, _, size, *view = pid
        if view and view[0] is not None:
            raise DataError("views of storages (before torch 0.4) are not supported")
        if dtype != BFLOAT16 and dtype not in STORAGE_DTYPES.values():
            raise DataError(f"tensors of {dtype} are not supported")
        if type(size) is not int or size < 0:
            raise DataError(f"a storage has {size!r} values")
        return self._storages.setdefault(key, Storage(dtype, size))


def _rebuild_tensor(
    storage: Storage, offset: int, shape: tuple, strides: tuple, *rest: Any
) -> Tensor:
    del rest  # requires_grad, hooks, metadata
    return Tensor(storage, offset, tuple(shape), tuple(strides))


def _rebuild_parameter(data: Tensor, *rest: Any) -> Tensor:
    del rest
    return data


def _size(values: Any) -> tuple[int, ...]:
    if not isinstance(values, tuple | list) or len(values) > _MAX_DEPTH:
        raise DataError(f"a tensor of shape {values!r:.80}")
    return tuple(values)


def _dict(items: Any = ()) -> _Dict:
    if len(items) > _MAX_VALUES:  # it could be made from the same ones again
        raise DataError(f"an ordered dictionary of {len(items)} values")
    return _Dict(items)


_BUILDERS = {
    ("torch._utils", "_rebuild_tensor"): _Builder(_rebuild_tensor),
    ("torch._utils", "_rebuild_tensor_v2"): _Builder(_rebuild_tensor),
    ("torch._utils", "_rebuild_parameter"): _Builder(_rebuild_parameter),
    ("torch._utils", "_rebuild_parameter_with_state"): _Builder(_rebuild_parameter),
    ("torch", "Size"): _Builder(_size),
    ("collections", "OrderedDict"): _Builder(_dict),
    ("collections", "defaultdict"): _Builder(lambda *args: _Dict()),
}
