"""Reader of PyTorch's `.pth` files (zip format, torch 1.6 and later) without torch.

A pickle can run arbitrary code. This reader executes only the pickle instructions that torch
writes for state dicts, and creates only containers, numbers, strings and arrays. As with
`torch.load(..., weights_only=True)`, a reference to any other object raises an error.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import zipfile
from collections.abc import Callable
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from radejax.core.archives import check_not_pointer, read_member
from radejax.core.errors import DataError, one_line
from radejax.core.files import PathLike, as_path

_DTYPES = {
    "DoubleStorage": "float64",
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
}
_MAX_DIMS = 16


def read(path: PathLike) -> object:
    """Reads the content of a `.pth` file, with tensors as NumPy arrays.

    Args:
        path: File written by `torch.save`: a state dict, or a checkpoint that contains one
            and otherwise only plain containers, numbers and strings.

    Returns:
        Dicts, lists, tuples, numbers, strings and arrays. bfloat16 becomes float32, which
        represents it exactly.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is not a torch file, is corrupted, or contains other objects.
    """
    path = as_path(path)
    check_not_pointer(path)
    with path.open("rb") as file:
        start = file.read(4)
    if start != b"PK\x03\x04":
        raise DataError(
            f"{path}: starts with {start!r}, expected a zip archive of torch 1.6 or "
            "later: load it there and write it with torch.save"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            root = archive.namelist()[0].partition("/")[0]
            return _Unpickler(archive, f"{root}/").load()
    except DataError as error:
        raise DataError(f"{path}: {one_line(error)}") from None
    # A corrupted pickle can raise errors of any type.
    except Exception as error:
        raise DataError(f"{path}: corrupted torch file ({one_line(error)})") from None


Sizes = tuple[int, ...]


class _Storage(NamedTuple):
    values: np.ndarray


def _rebuild_tensor(
    storage: _Storage, offset: int, shape: Sizes, strides: Sizes, *unused: object
) -> np.ndarray:
    """Returns a view of a storage, after checking that it is within the storage."""
    if not isinstance(storage, _Storage) or max(len(shape), len(strides)) > _MAX_DIMS:
        raise DataError("a tensor without a storage or of more than 16 axes")
    if any(type(n) is not int or n < 0 for n in (offset, *shape, *strides)):
        raise DataError("a tensor whose shape, offset or strides are not sizes")
    values = storage.values
    if math.prod(shape) == 0:
        return np.zeros(shape, values.dtype)
    last = offset + sum((n - 1) * s for n, s in zip(shape, strides, strict=True))
    if math.prod(shape) > values.size or last >= values.size:
        raise DataError(f"a tensor {shape} reaches outside its storage {values.shape}")
    steps = [s * values.itemsize for s in strides]
    return np.lib.stride_tricks.as_strided(values[offset:], shape, steps)


_ALLOWED: dict[tuple[str, str], object] = {
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch._utils", "_rebuild_parameter"): lambda data, *unused: data,
    ("collections", "OrderedDict"): lambda: {},  # which later instructions fill
} | {("torch", name): dtype for name, dtype in _DTYPES.items()}

_OPCODES = (
    pickle.PROTO + pickle.STOP + pickle.MARK + pickle.NONE + pickle.NEWTRUE
    + pickle.NEWFALSE + pickle.BININT + pickle.BININT1 + pickle.BININT2 + pickle.LONG1
    + pickle.BINFLOAT + pickle.BINUNICODE + pickle.EMPTY_TUPLE + pickle.TUPLE
    + pickle.TUPLE1 + pickle.TUPLE2 + pickle.TUPLE3 + pickle.EMPTY_LIST + pickle.APPEND
    + pickle.APPENDS + pickle.EMPTY_DICT + pickle.BINPUT + pickle.LONG_BINPUT
    + pickle.BINGET + pickle.LONG_BINGET + pickle.GLOBAL + pickle.REDUCE
    + pickle.BINPERSID
)  # fmt: skip
"""Instructions of state dicts; none of them hashes or calls arbitrary objects."""


# The Python unpickler, as that in C has no dispatch table and allocates any memo size.
class _Unpickler(pickle._Unpickler):
    """Unpickler that executes only `_OPCODES` and resolves only `_ALLOWED` names."""

    dispatch: ClassVar[dict[int, Callable[..., None]]] = {
        code: pickle._Unpickler.dispatch[code] for code in _OPCODES
    }

    stack: list[object]
    pop_mark: Callable[[], list[object]]

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        self._archive = archive
        self._root = root
        # All members together may use memory in proportion to the file's size.
        self._budget = 4 * os.path.getsize(str(archive.filename)) + (1 << 20)
        has_order = f"{root}byteorder" in archive.namelist()
        is_big = has_order and self._member("byteorder") == b"big"
        self._order: Literal["<", ">"] = ">" if is_big else "<"
        self._storages: dict[str, _Storage] = {}
        super().__init__(io.BytesIO(self._member("data.pkl")))

    def _member(self, name: str) -> bytes:
        content = read_member(self._archive, self._root + name, max_bytes=self._budget)
        self._budget -= len(content)
        return content

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in _ALLOWED:
            raise DataError(
                f"holds {module}.{name}, which is not read: save the state dict, "
                "torch.save(model.state_dict(), ...)"
            )
        return _ALLOWED[module, name]

    def persistent_load(self, pid: Any) -> _Storage:
        """Returns the storage of an identifier `("storage", dtype, key, device, size)`."""
        kind, dtype, key, _, size = pid
        if kind != "storage" or dtype not in _DTYPES.values() or type(key) is not str:
            raise DataError("a tensor without a storage of numbers")
        if key not in self._storages:
            raw = np.dtype("uint16" if dtype == "bfloat16" else dtype)
            data = self._member(f"data/{key}")
            if not 0 <= size * raw.itemsize <= len(data):
                raise DataError(
                    f"storage {key} has {len(data)} bytes for {size} {dtype}"
                )
            values = np.frombuffer(data, raw.newbyteorder(self._order))[:size]
            if dtype == "bfloat16":  # the upper half of a float32
                values = (values.astype(np.uint32) << 16).view(np.float32)
            self._storages[key] = _Storage(values)
        return self._storages[key]

    def _ignore_state(self) -> None:
        """Ignores the state of `BUILD`, which is the `_metadata` of a state dict."""
        self.stack.pop()

    def _set_item(self) -> None:
        value = self.stack.pop()
        self._update([self.stack.pop(), value])

    def _set_items(self) -> None:
        self._update(self.pop_mark())

    def _update(self, items: list[object]) -> None:
        """Checks keys before adding them, as hashing nested tuples can take unlimited time."""
        target = self.stack[-1]
        keys = items[::2]
        if type(target) is not dict or any(type(k) not in (str, int) for k in keys):
            raise DataError("a dict whose keys are neither names nor integers")
        target.update(zip(keys, items[1::2], strict=True))

    dispatch[pickle.BUILD[0]] = _ignore_state
    dispatch[pickle.SETITEM[0]] = _set_item
    dispatch[pickle.SETITEMS[0]] = _set_items
