"""MATLAB v5 files, as far as the one real array of a radar tensor needs it.

A file is a header of 128 bytes and elements: a tag (type, number of bytes) and content.
A variable is an element of type 14, or of type 15, which is one of type 14 deflated. It
contains, each with a tag of its own: flags, shape, name and values.

Every tag is compared with the others, so that a flipped bit in any of them is an error.
Deflated variables have a checksum of their values, plain ones have none.

References:
    MathWorks, MAT-File Format, chapter 1.
"""

from __future__ import annotations

import dataclasses
import math
import os
import struct
import zlib
from typing import BinaryIO, Literal

import numpy as np

from radejax.core.errors import DataError

_Order = Literal["<", ">"]

_MATRIX, _DEFLATED = 14, 15
_INT8, _INT32, _UINT32 = 1, 5, 6
_GLOBAL = 0x0400
# Classes of arrays and types of stored values, by their number in the file.
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4"}
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_HEAD = 512  # bytes of a variable before its values, more than any real array has


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the values of an array are, column-major.

    Attributes:
        dtype: Type of the values, as stored.
        shape: Shape of the array.
        offset: First byte of the values, in the file or in the inflated variable.
        deflated: Begin and length of the deflated variable; None for a plain one.
        num_bytes: Size of the variable, inflated.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    offset: int
    deflated: tuple[int, int] | None
    num_bytes: int


def find_array(file: BinaryIO, name: str) -> Layout:
    """Type, shape and place of a variable of a file that is open for reading.

    Raises:
        DataError: The file is not a MATLAB v5 file, is truncated or corrupted, or has
            no real array of this name.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    header = file.read(128)
    orders: dict[bytes, _Order] = {b"\0\1IM": "<", b"\1\0MI": ">"}
    order = orders.get(header[124:])
    if order is None:
        hint = "; save it in v7 or v6" if header.startswith(b"MATLAB 7.3") else ""
        raise DataError(f"{file.name}: not a MATLAB v5 file{hint}")
    names, start = [], 128
    while start + 8 <= size:
        file.seek(start)
        kind, num_bytes = struct.unpack(f"{order}II", file.read(8))
        end = start + 8 + num_bytes
        deflated = (start + 8, num_bytes) if kind == _DEFLATED else None
        if deflated:
            content = file.read(min(num_bytes, 1 << 20))
            head = zlib.decompressobj().decompress(content, _HEAD)
        elif kind == _MATRIX:
            file.seek(start)
            head = file.read(_HEAD)
        else:
            raise _corrupted(file, f"no variable at byte {start}, but type {kind}")
        found, layout = _parse(file, head, order, name)
        if layout:
            _check_end(
                file, layout, end if deflated else start + layout.num_bytes, size
            )
            begin = 0 if deflated else start
            offset = begin + layout.offset
            return dataclasses.replace(layout, offset=offset, deflated=deflated)
        names.append(found)
        start = end
    raise DataError(f"{file.name}: no {name} in it, only {names}")


def read_array(file: BinaryIO, layout: Layout) -> np.ndarray:
    """The values of a variable, in the type of the file.

    Raises:
        DataError: They are truncated or fail their checksum.
    """
    count = math.prod(layout.shape)
    if layout.deflated is None:
        file.seek(layout.offset)
        values = np.fromfile(file, layout.dtype, count)
    else:
        start, size = layout.deflated
        file.seek(start)
        inflater = zlib.decompressobj()
        # A byte more than there may be: then the content is found to be too long.
        content = inflater.decompress(file.read(size), layout.num_bytes + 1)
        if not inflater.eof or len(content) != layout.num_bytes or inflater.unused_data:
            raise _corrupted(file, f"does not inflate to {layout.num_bytes} bytes")
        values = np.frombuffer(content, layout.dtype, count, layout.offset)
    if values.size < count:
        raise _corrupted(file, "it ends within its values")
    return values.reshape(layout.shape, order="F")


def _parse(
    file: BinaryIO, head: bytes, order: _Order, name: str
) -> tuple[str, Layout | None]:
    """Name of a variable, and its layout if it is the one that is looked for."""
    kind, num_bytes = struct.unpack_from(f"{order}II", head)
    flags_kind, flags_size, at, after = _tag(head, 8, order)
    (flags,) = struct.unpack_from(f"{order}I", head, at)
    if (kind, flags_kind, flags_size) != (_MATRIX, _UINT32, 8):
        raise _corrupted(file, f"a variable begins with types {kind}, {flags_kind}")
    dims_kind, dims_size, at, after = _tag(head, after, order)
    shape = struct.unpack_from(f"{order}{dims_size // 4}i", head, at)
    name_kind, name_size, at, after = _tag(head, after, order)
    found = head[at : at + name_size].decode("ascii", "replace")
    if (dims_kind, dims_size % 4, name_kind) != (_INT32, 0, _INT8):
        raise _corrupted(file, f"shape of type {dims_kind}, name of type {name_kind}")
    if found != name:
        return found, None
    wanted = np.dtype(_CLASSES.get(flags & 0xFF, np.void))
    if flags & ~(0xFF | _GLOBAL) or wanted.kind == "V":
        raise DataError(
            f"{file.name}: {name} has flags {flags:#x}, expected real numbers"
        )
    stored_kind, stored_size, at, end = _tag(head, after, order)
    stored = np.dtype(_STORED.get(stored_kind, np.void))
    # MATLAB may store floats as smaller integers.
    is_smaller = stored.kind in "iu" and stored.itemsize < wanted.itemsize
    if stored != wanted and not (is_smaller and wanted.kind == "f"):
        raise _corrupted(file, f"{wanted} stored as type {stored_kind}")
    needed = stored.itemsize * math.prod(shape)
    if min(shape, default=0) < 1 or stored_size != needed:
        raise _corrupted(file, f"shape {shape} of {stored}, but {stored_size} bytes")
    if num_bytes + 8 not in (end, at + stored_size):
        raise _corrupted(file, f"{name} has {num_bytes} bytes, its parts {end - 8}")
    return found, Layout(stored.newbyteorder(order), shape, at, None, num_bytes + 8)


def _tag(head: bytes, at: int, order: _Order) -> tuple[int, int, int, int]:
    """Type, size and begin of an element's content, and where the next element is."""
    (word,) = struct.unpack_from(f"{order}I", head, at)
    if word >> 16:  # up to four bytes, within the tag
        return word & 0xFFFF, word >> 16, at + 4, at + 8
    (size,) = struct.unpack_from(f"{order}I", head, at + 4)
    return word, size, at + 8, at + 8 + size + -size % 8


def _check_end(file: BinaryIO, layout: Layout, end: int, size: int) -> None:
    if size < end:
        raise DataError(
            f"{file.name}: truncated: {size} bytes, an array of shape {layout.shape} "
            f"needs {end}"
        )


def _corrupted(file: BinaryIO, what: str) -> DataError:
    return DataError(f"{file.name}: corrupted MATLAB file: {what}")
