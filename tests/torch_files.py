"""A writer of `.pth` files without torch, for tests of the reader."""

from __future__ import annotations

import pathlib
import struct
import zipfile
from collections.abc import Mapping

import numpy as np

STORAGES = {
    "float64": "DoubleStorage",
    "float32": "FloatStorage",
    "float16": "HalfStorage",
    "int64": "LongStorage",
    "bool": "BoolStorage",
}


def pickle_text(text: str) -> bytes:
    data = text.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def pickle_int(value: int) -> bytes:
    return b"\x8a\x08" + struct.pack("<q", value)


def pickle_ints(values: tuple[int, ...]) -> bytes:
    return b"(" + b"".join(map(pickle_int, values)) + b"t"


def pickle_tensor(
    key: str,
    size: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    offset: int = 0,
    storage: str = "FloatStorage",
) -> bytes:
    """`_rebuild_tensor_v2(storage, offset, shape, strides, False, OrderedDict())`."""
    pid = b"(" + pickle_text("storage") + f"ctorch\n{storage}\n".encode()
    pid += pickle_text(key) + pickle_text("cpu") + pickle_int(size) + b"tQ"
    view = pickle_int(offset) + pickle_ints(shape) + pickle_ints(strides)
    call = b"ctorch._utils\n_rebuild_tensor_v2\n(" + pid + view
    return call + b"\x89ccollections\nOrderedDict\n)RtR"


def write_zip(path: pathlib.Path, pickled: bytes, **members: bytes) -> None:
    """Write an archive with torch's layout and the given pickle and storages."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", pickled)
        archive.writestr("x/byteorder", "little")
        for name, data in members.items():
            archive.writestr(f"x/data/{name}", data)


def write_pth(path: pathlib.Path, tensors: Mapping[str, np.ndarray]) -> None:
    """Write a state dict."""
    body, members = b"\x80\x02}(", {}
    for i, (name, value) in enumerate(tensors.items()):
        value = np.asarray(value, order="C")
        strides = tuple(stride // value.itemsize for stride in value.strides)
        storage = STORAGES[value.dtype.name]
        tensor = pickle_tensor(str(i), value.size, value.shape, strides, 0, storage)
        body += pickle_text(name) + tensor
        members[str(i)] = value.tobytes()
    write_zip(path, body + b"u.", **members)
