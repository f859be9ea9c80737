"""Reads and writes PyTorch's `.pth` files without PyTorch.

The pickle inside such a file is never allowed to run code: every name it asks for is
either one of a few containers and tensor builders defined here, or becomes an inert
`Opaque` object. So a checkpoint that carries a whole training configuration can be
read, and a malicious one cannot do anything.

Both formats are read: the zip archive (torch 1.6 and later) and the older stream of
pickles. bfloat16 becomes float32, which holds it exactly; NumPy has no such type.
"""

from __future__ import annotations

import dataclasses
import io
import math
import pathlib
import pickle
import struct
import zipfile
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

from radejax.core.errors import DataError

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001

_BFLOAT16 = "bfloat16"

_STORAGE_DTYPES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": _BFLOAT16,
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

    def __hash__(self) -> int:
        return 0


@dataclasses.dataclass(eq=False)
class _Storage:
    dtype: Any
    size: int
    values: np.ndarray | None = None


@dataclasses.dataclass(eq=False)
class _Tensor:
    """A view into a storage whose bytes may not have been read yet."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class _Dict(dict):
    """A dict that swallows attributes, as state dicts carry `_metadata`."""

    def __setstate__(self, state: Any) -> None:
        del state


def read(path: str | pathlib.Path) -> Any:
    """Content of a `.pth` file, with NumPy arrays for tensors.

    Args:
        path: A file written by `torch.save`.

    Returns:
        The saved object: containers, numbers, strings, arrays (contiguous copies),
        and `Opaque` for anything else. OrderedDicts are dicts.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: It is not a torch file, or damaged; the message names it.
    """
    path = pathlib.Path(path)
    with path.open("rb") as file:
        start = file.read(4)
        file.seek(0)
        try:
            if start == b"PK\x03\x04":
                return _resolve(_read_zip(file))
            if start[:1] == b"\x80":
                return _resolve(_read_legacy(file))
        except DataError as error:
            raise DataError(f"{path}: {error}") from None
        # What a damaged pickle or archive raises is not limited to one family.
        except Exception as error:
            raise DataError(f"{path}: damaged torch file ({error})") from error
    raise DataError(f"{path}: not a torch file (starts with {start!r})")


def write(path: str | pathlib.Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes a state dict that `torch.load(path, weights_only=True)` reads.

    Args:
        path: File to write.
        arrays: Tensors by name, float32 or any other type that torch has.

    Raises:
        ValueError: torch has no such type.
    """
    path = pathlib.Path(path)
    names = {np.dtype(v): k for k, v in _STORAGE_DTYPES.items() if v != _BFLOAT16}
    body = [b"\x80\x02}("]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        root = path.stem or "archive"
        for key, (name, value) in enumerate(arrays.items()):
            value = np.asarray(value, order="C")
            if value.dtype not in names:
                raise ValueError(f"torch has no dtype {value.dtype} ({name})")
            body.append(_pickle_text(name))
            body.append(_pickle_tensor(value, str(key), names[value.dtype]))
            little = value.astype(value.dtype.newbyteorder("<"), copy=False)
            archive.writestr(f"{root}/data/{key}", little.tobytes())
        archive.writestr(f"{root}/data.pkl", b"".join([*body, b"u."]))
        archive.writestr(f"{root}/byteorder", "little")
        archive.writestr(f"{root}/version", "3\n")


# Reading -----------------------------------------------------------------------------


class _Unpickler(pickle.Unpickler):
    """Unpickler that resolves names to nothing but what this module defines."""

    def __init__(self, file: BinaryIO, storages: dict[str, _Storage]):
        super().__init__(file, encoding="utf-8")
        self._storages = storages

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _BUILDERS:
            return _BUILDERS[module, name]
        if module in ("torch", "torch.storage") and name in _STORAGE_DTYPES:
            return _STORAGE_DTYPES[name]
        return type(name, (Opaque,), {})

    def persistent_load(self, pid: Any) -> _Storage:
        if not isinstance(pid, tuple) or len(pid) < 5 or pid[0] != "storage":
            raise DataError(f"unknown persistent object {pid!r}")
        _, dtype, key, _, size, *view = pid
        if view and view[0] is not None:
            raise DataError("views of storages (before torch 0.4) are not supported")
        if dtype != _BFLOAT16 and dtype not in _STORAGE_DTYPES.values():
            raise DataError(f"tensors of {dtype} are not supported")
        return self._storages.setdefault(key, _Storage(dtype, size))


def _rebuild_tensor(
    storage: _Storage, offset: int, shape: tuple, strides: tuple, *rest: Any
) -> _Tensor:
    del rest  # requires_grad, hooks, metadata
    return _Tensor(storage, offset, tuple(shape), tuple(strides))


def _rebuild_parameter(data: _Tensor, *rest: Any) -> _Tensor:
    del rest
    return data


_BUILDERS = {
    ("torch._utils", "_rebuild_tensor"): _rebuild_tensor,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
    ("torch._utils", "_rebuild_parameter_with_state"): _rebuild_parameter,
    ("torch", "Size"): tuple,
    ("collections", "OrderedDict"): _Dict,
    ("collections", "defaultdict"): lambda *args: _Dict(),
}


def _read_zip(file: BinaryIO) -> Any:
    with zipfile.ZipFile(file) as archive:
        names = set(archive.namelist())
        pickles = [n for n in names if n.endswith("/data.pkl") and n.count("/") == 1]
        if len(pickles) != 1:
            raise DataError("not a torch file (a zip archive without data.pkl)")
        root = pickles[0].removesuffix("data.pkl")
        order = "<"
        if f"{root}byteorder" in names and archive.read(f"{root}byteorder") == b"big":
            order = ">"
        storages: dict[str, _Storage] = {}
        content = _Unpickler(io.BytesIO(archive.read(pickles[0])), storages).load()
        for key, storage in storages.items():
            data = archive.read(f"{root}data/{key}")
            storage.values = _decode(data, storage, order, key)
    return content


def _read_legacy(file: BinaryIO) -> Any:
    storages: dict[str, _Storage] = {}

    def load() -> Any:
        return _Unpickler(file, storages).load()

    if load() != _LEGACY_MAGIC:
        raise DataError("not a torch file (a pickle without torch's magic number)")
    if (protocol := load()) != _LEGACY_PROTOCOL:
        raise DataError(f"unknown version {protocol!r} of the old torch format")
    order = "<" if load().get("little_endian", True) else ">"
    content = load()
    for key in load():
        if key not in storages:
            raise DataError(f"storage {key} belongs to no tensor")
        storage = storages[key]
        (size,) = struct.unpack(f"{order}q", file.read(8))
        if size != storage.size:
            raise DataError(f"storage {key} has {size} values, not {storage.size}")
        data = file.read(size * _raw_dtype(storage, order).itemsize)
        storage.values = _decode(data, storage, order, key)
    return content


def _raw_dtype(storage: _Storage, order: str) -> np.dtype:
    raw = np.uint16 if storage.dtype == _BFLOAT16 else storage.dtype
    return np.dtype(raw).newbyteorder(order)


def _decode(data: bytes, storage: _Storage, order: str, key: str) -> np.ndarray:
    dtype = _raw_dtype(storage, order)
    if len(data) < storage.size * dtype.itemsize:
        raise DataError(
            f"storage {key} has {len(data)} bytes, expected "
            f"{storage.size * dtype.itemsize}"
        )
    values = np.frombuffer(data, dtype, storage.size)
    if storage.dtype == _BFLOAT16:
        # The upper half of a float32.
        return (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(dtype.newbyteorder("="), copy=False)


def _resolve(value: Any) -> Any:
    """Replaces tensors in nested containers by arrays."""
    if isinstance(value, _Tensor):
        return _view(value)
    if isinstance(value, Mapping):
        return {key: _resolve(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)([_resolve(item) for item in value])
    return value


def _view(tensor: _Tensor) -> np.ndarray:
    values, shape = tensor.storage.values, tensor.shape
    if values is None:
        raise DataError("a tensor has no values in the file")
    if math.prod(shape) == 0:
        return np.zeros(shape, values.dtype)
    last = tensor.offset + sum(
        (n - 1) * s for n, s in zip(shape, tensor.strides, strict=True)
    )
    if min(tensor.offset, *shape, *tensor.strides, 0) < 0 or last >= values.size:
        raise DataError(f"a tensor of shape {shape} reaches outside its storage")
    strides = [s * values.itemsize for s in tensor.strides]
    view = np.lib.stride_tricks.as_strided(values[tensor.offset :], shape, strides)
    return np.array(view, order="C")


# Writing: the few pickle instructions that a state dict needs -------------------------


def _pickle_text(text: str) -> bytes:
    data = text.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def _pickle_int(value: int) -> bytes:
    if value < 2**31:
        return b"J" + struct.pack("<i", value)
    return b"\x8a\x08" + struct.pack("<q", value)


def _pickle_ints(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(map(_pickle_int, values)) + b"t"


def _pickle_tensor(value: np.ndarray, key: str, storage: str) -> bytes:
    """`_rebuild_tensor_v2(storage, 0, shape, strides, False, OrderedDict())`."""
    strides = tuple(s // value.itemsize for s in value.strides)
    persistent_id = b"".join(
        [
            b"(",
            _pickle_text("storage"),
            f"ctorch\n{storage}\n".encode(),
            _pickle_text(key),
            _pickle_text("cpu"),
            _pickle_int(value.size),
            b"tQ",
        ]
    )
    return b"".join(
        [
            b"ctorch._utils\n_rebuild_tensor_v2\n(",
            persistent_id,
            _pickle_int(0),
            _pickle_ints(value.shape),
            _pickle_ints(strides),
            b"\x89ccollections\nOrderedDict\n)RtR",
        ]
    )
