"""Reads and writes PyTorch's `.pth` files without PyTorch.

The pickle inside such a file is never allowed to run code: every name it asks for is
either one of a few containers and tensor builders defined here, or becomes an inert
`Opaque` object. So a checkpoint that carries a whole training configuration can be
read, and a malicious one cannot do anything.

Both formats are read: the zip archive (torch 1.6 and later) and the older stream of
pickles. bfloat16 becomes float32, which holds it exactly; NumPy has no such type.
"""

from __future__ import annotations

import io
import math
import os
import pathlib
import struct
import zipfile
from collections.abc import Mapping
from typing import Any, BinaryIO, Literal

import numpy as np

from radejax.core.archives import open_zip, read_member
from radejax.core.errors import DataError, one_line
from radejax.weights.torch_pickle import (
    BFLOAT16,
    STORAGE_DTYPES,
    Storage,
    Tensor,
    Unpickler,
)

Order = Literal["<", ">"]

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001

_MAX_DEPTH, _MAX_VALUES = 64, 100_000
_FACTOR, _MAX_PICKLE = 4, 1 << 20
"""Bytes of the content for each byte of the file: storages may be shared; and of a
pickle that is deflated."""


class _File:
    """Reads no further than a file reaches: a length that is claimed takes no memory."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._size = file, os.fstat(file.fileno()).st_size
        self.readline = file.readline

    def read(self, size: int) -> bytes:
        return self._file.read(min(size, self._size - self._file.tell()))


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
                content = _read_zip(path)
            elif start[:1] == b"\x80":
                content = _read_legacy(_File(file))
            else:
                raise DataError(f"not a torch file (starts with {start!r})")
            return _Resolver(os.path.getsize(path)).resolve(content)
        except DataError as error:
            raise DataError(f"{path}: {one_line(error)}") from None
        # What a damaged pickle or archive raises is not limited to one family.
        except Exception as error:
            raise DataError(f"{path}: damaged torch file ({one_line(error)})") from None


def write(path: str | pathlib.Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes a state dict that `torch.load(path, weights_only=True)` reads.

    Args:
        path: File to write.
        arrays: Tensors by name, float32 or any other type that torch has.

    Raises:
        ValueError: torch has no such type.
    """
    path = pathlib.Path(path)
    names = {np.dtype(v): k for k, v in STORAGE_DTYPES.items() if v != BFLOAT16}
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


def _read_zip(path: pathlib.Path) -> Any:
    budget = _FACTOR * os.path.getsize(path) + _MAX_PICKLE

    def read(name: str) -> bytes:
        nonlocal budget
        content = read_member(archive, name, max_bytes=budget)
        budget -= len(content)
        return content

    with open_zip(path, "a torch file") as archive:
        names = set(archive.namelist())
        pickles = [n for n in names if n.endswith("/data.pkl") and n.count("/") == 1]
        if len(pickles) != 1:
            raise DataError("not a torch file (a zip archive without data.pkl)")
        root = pickles[0].removesuffix("data.pkl")
        order: Order = "<"
        if f"{root}byteorder" in names and read(f"{root}byteorder") == b"big":
            order = ">"
        storages: dict[str, Storage] = {}
        content = Unpickler(io.BytesIO(read(pickles[0])), storages).load()
        for key, storage in storages.items():
            data = read(f"{root}data/{key}")
            storage.values = _decode(data, storage, order, key)
    return content


def _read_legacy(file: _File) -> Any:
    storages: dict[str, Storage] = {}

    def load() -> Any:
        return Unpickler(file, storages).load()

    if load() != _LEGACY_MAGIC:
        raise DataError("not a torch file (a pickle without torch's magic number)")
    if (protocol := load()) != _LEGACY_PROTOCOL:
        raise DataError(f"unknown version {protocol!r} of the old torch format")
    order: Order = "<" if load().get("little_endian", True) else ">"
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


def _raw_dtype(storage: Storage, order: Order) -> np.dtype:
    raw = np.uint16 if storage.dtype == BFLOAT16 else storage.dtype
    return np.dtype(raw).newbyteorder(order)


def _decode(data: bytes, storage: Storage, order: Order, key: str) -> np.ndarray:
    dtype = _raw_dtype(storage, order)
    if len(data) < storage.size * dtype.itemsize:
        raise DataError(
            f"storage {key} has {len(data)} bytes, expected "
            f"{storage.size * dtype.itemsize}"
        )
    values = np.frombuffer(data, dtype, storage.size)
    if storage.dtype == BFLOAT16:
        # The upper half of a float32.
        return (values.astype(np.uint32) << 16).view(np.float32)
    return values.astype(dtype.newbyteorder("="), copy=False)


class _Resolver:
    """Replaces tensors in nested containers by arrays, within limits.

    A pickle names the same container or storage many times at no cost; here each time
    costs.
    """

    def __init__(self, file_size: int) -> None:
        self._bytes = _FACTOR * file_size
        self._values = _MAX_VALUES

    def resolve(self, value: Any, depth: int = 0) -> Any:
        """The value without tensors of torch."""
        self._values -= 1
        if depth > _MAX_DEPTH or self._values < 0:
            raise DataError(
                f"containers nested more than {_MAX_DEPTH} deep, or more than "
                f"{_MAX_VALUES} values"
            )
        if isinstance(value, Tensor):
            array = _view(value)
            self._bytes -= array.nbytes
            if self._bytes < 0:
                raise DataError("its tensors have far more bytes than the file")
            return array
        if isinstance(value, Mapping):
            return {k: self.resolve(item, depth + 1) for k, item in value.items()}
        if isinstance(value, list | tuple):
            return type(value)([self.resolve(item, depth + 1) for item in value])
        return value


def _view(tensor: Tensor) -> np.ndarray:
    values, shape = tensor.storage.values, tensor.shape
    if values is None:
        raise DataError("a tensor has no values in the file")
    if math.prod(shape) > values.size:
        raise DataError(f"a tensor of shape {shape} of a storage of {values.size}")
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
