"""MATLAB v5 files, as much of them as one real array needs, nothing read unchecked.

A file is a header of 128 bytes and elements: a tag (type, number of bytes) and content.
A variable is an element of type 14, or of type 15, which is one of type 14 deflated. In
it are, each with a tag of its own: flags, shape, name and numbers.

Every tag is compared with what the others say, so that a flipped bit in any of them is
an error. Deflated variables carry a checksum of their numbers, plain ones carry none.

References:
    MathWorks, MAT-File Format, chapter 1.
"""

from __future__ import annotations

import dataclasses
import math
import os
import struct
import zlib
from typing import Any, BinaryIO, Literal

import numpy as np

from radejax.core.archives import DEFLATE_RATIO
from radejax.core.errors import DataError

_MATRIX, _DEFLATED = 14, 15
_INT8, _INT32, _UINT32 = 1, 5, 6
_COMPLEX, _GLOBAL, _OPAQUE = 0x0800, 0x0400, 17
# By number: of classes of arrays, and of types of stored numbers.
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4"}
_CLASSES |= {14: "i8", 15: "u8"}
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_STORED |= {12: "i8", 13: "u8"}
_HEAD = 512  # bytes of a variable before its numbers, more than any real array has
_CHUNK = 1 << 20


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the numbers of an array are in a file, column-major.

    Attributes:
        dtype: Of the numbers, as stored.
        shape: Of the array.
        offset: First byte of the numbers, in the file or in what is inflated.
        deflated: Begin and length of the deflated element, None for a plain one.
        inflated: Bytes that it must inflate to.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    offset: int
    deflated: tuple[int, int] | None
    inflated: int

    @property
    def num_bytes(self) -> int:
        """Of the numbers."""
        return self.dtype.itemsize * math.prod(self.shape)


def find_array(file: BinaryIO, name: str) -> Layout | None:
    """Type, shape and place of a variable.

    Args:
        file: Open for reading, at any place.
        name: Of the variable.

    Returns:
        None for a file that is no MATLAB v5 file.

    Raises:
        DataError: The file is truncated or damaged, has no such variable, or it is not
            an array of real numbers.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    orders: dict[bytes, Literal["<", ">"]] = {b"\0\1IM": "<", b"\1\0MI": ">"}
    order = orders.get(file.read(128)[124:])
    if order is None:
        return None
    names, start = [], 128
    while start + 8 <= size:
        file.seek(start)
        kind, num_bytes = struct.unpack(order + "II", file.read(8))
        if kind not in (_MATRIX, _DEFLATED):
            raise _damage(file, f"no variable at byte {start}, but type {kind}")
        begin, deflated = start, None
        if kind == _DEFLATED:
            begin, deflated = 0, (start + 8, num_bytes)
        head = _inflated_head(file, num_bytes) if deflated else _head(file, start)
        found, layout = _parse_variable(file, head, order, name, begin, deflated)
        if layout is not None:
            _check_size(file, layout, size, start + 8 + num_bytes)
            return layout
        names.append(found)
        start += 8 + num_bytes + (-num_bytes % 8 if kind == _MATRIX else 0)
    raise DataError(f"{file.name}: no {name} in it, only {names}")


def read_array(file: BinaryIO, layout: Layout) -> np.ndarray:
    """The numbers of a variable, in the type of the file.

    Raises:
        DataError: They are truncated or fail their checksum.
    """
    if layout.deflated is not None:
        content: bytearray | memoryview = _inflate(file, layout)
        numbers: Any = memoryview(content)[layout.offset :][: layout.num_bytes]
    else:
        file.seek(layout.offset)
        numbers = np.fromfile(file, np.uint8, count=layout.num_bytes)
        if len(numbers) < layout.num_bytes:
            raise _damage(file, "it ends within its numbers")
    return np.frombuffer(numbers, layout.dtype).reshape(layout.shape, order="F")


def _head(file: BinaryIO, start: int) -> bytes:
    file.seek(start)
    return file.read(_HEAD)


def _inflated_head(file: BinaryIO, num_bytes: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(file.read(min(num_bytes, _CHUNK)), _HEAD)
    except zlib.error as error:
        raise _damage(file, f"cannot be inflated ({error})") from None


def _parse_variable(
    file: BinaryIO,
    head: bytes,
    order: Literal["<", ">"],
    name: str,
    begin: int,
    deflated: tuple[int, int] | None,
) -> tuple[str, Layout | None]:
    """Name of a variable, and its layout if it is the one that is looked for.

    Args:
        file: For messages.
        head: First bytes of the variable, from its tag on.
        order: "<" or ">".
        name: That is looked for.
        begin: Place of the tag, in the file or in what is inflated.
        deflated: Of the layout.
    """
    try:
        kind, num_bytes = struct.unpack_from(order + "II", head)
        flags_kind, flags_size, at, after = _tag(head, 8, order)
        (flags,) = struct.unpack_from(order + "I", head, at)
        if (kind, flags_kind, flags_size) != (_MATRIX, _UINT32, 8):
            raise _damage(file, f"a variable begins with types {kind}, {flags_kind}")
        if flags & 0xFF == _OPAQUE:
            return "?", None
        dims_kind, dims_size, at, after = _tag(head, after, order)
        shape = struct.unpack_from(f"{order}{dims_size // 4}i", head, at)
        name_kind, name_size, at, after = _tag(head, after, order)
        found = head[at : at + name_size].decode("ascii", "replace")
        if (dims_kind, dims_size % 4, name_kind) != (_INT32, 0, _INT8):
            raise _damage(file, f"shape of type {dims_kind}, name of type {name_kind}")
        if found != name:
            return found, None
        if flags & ~(0xFF | _GLOBAL | _COMPLEX) or flags & 0xFF not in _CLASSES:
            raise DataError(
                f"{file.name}: {name} has flags {flags:#x}, expected real numbers"
            )
        if flags & _COMPLEX:
            raise DataError(f"{file.name}: {name} is complex, expected real numbers")
        stored, stored_size, at, end = _tag(head, after, order)
    except struct.error:
        raise _damage(file, "it ends within the head of a variable") from None
    dtype = _stored_type(file, flags & 0xFF, stored).newbyteorder(order)
    needed = dtype.itemsize * math.prod(shape)
    if min(shape, default=0) < 1 or stored_size != needed:
        raise _damage(file, f"shape {shape} of {dtype}, but {stored_size} bytes of it")
    if num_bytes + 8 not in (end, at + stored_size):
        raise _damage(file, f"{name} says {num_bytes} bytes, its parts {end - 8}")
    return found, Layout(dtype, shape, begin + at, deflated, num_bytes + 8)


def _stored_type(file: BinaryIO, cls: int, stored: int) -> np.dtype:
    """Type of numbers of a class: its own, or a smaller integer, as MATLAB saves it."""
    wanted = np.dtype(_CLASSES[cls])
    found = np.dtype(_STORED.get(stored, np.void))
    if found == wanted or (
        found.kind in "iu" and found.itemsize < wanted.itemsize and wanted.kind == "f"
    ):
        return found
    raise _damage(file, f"{wanted} stored as type {stored}")


def _tag(head: bytes, at: int, order: Literal["<", ">"]) -> tuple[int, int, int, int]:
    """Type, size and begin of an element's content, and where the next element is."""
    (word,) = struct.unpack_from(order + "I", head, at)
    if word >> 16:  # up to four bytes, within the tag
        return word & 0xFFFF, word >> 16, at + 4, at + 8
    (size,) = struct.unpack_from(order + "I", head, at + 4)
    return word, size, at + 8, at + 8 + size + -size % 8


def _check_size(file: BinaryIO, layout: Layout, size: int, end: int) -> None:
    """`DataError` for a file that cannot hold what it claims; `end` is its element's."""
    needed = layout.offset + layout.num_bytes if layout.deflated is None else end
    if size < needed:
        raise DataError(
            f"{file.name}: truncated: {size} bytes, an array of shape {layout.shape} "
            f"needs {needed}"
        )
    if layout.deflated is None and end < needed:
        raise _damage(file, "an array is longer than its variable")
    if layout.deflated and layout.inflated > DEFLATE_RATIO * layout.deflated[1]:
        raise _damage(
            file, f"{layout.deflated[1]} bytes cannot inflate to {layout.inflated}"
        )


def _inflate(file: BinaryIO, layout: Layout) -> bytearray:
    """All of a deflated variable, never more than it claims; its checksum is compared."""
    assert layout.deflated is not None
    start, left = layout.deflated
    file.seek(start)
    content, filled = bytearray(layout.inflated), 0
    inflater = zlib.decompressobj()
    try:
        while not inflater.eof:
            data = inflater.unconsumed_tail or file.read(min(left, _CHUNK))
            if not inflater.unconsumed_tail:
                left -= len(data)
            # A byte more than there may be: then it is found to be too long.
            room = min(layout.inflated - filled + 1, _CHUNK)
            part = inflater.decompress(data, room)
            if filled + len(part) > layout.inflated or not (data or part):
                break
            content[filled : filled + len(part)] = part
            filled += len(part)
    except zlib.error as error:
        raise _damage(file, f"cannot be inflated ({error})") from None
    if not inflater.eof or filled != layout.inflated or left or inflater.unused_data:
        raise _damage(file, f"it inflates to other than {layout.inflated} bytes")
    return content


def _damage(file: BinaryIO, what: str) -> DataError:
    return DataError(f"{file.name}: damaged MATLAB file: {what}")
