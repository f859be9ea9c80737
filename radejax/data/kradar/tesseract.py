"""Readers of 4D radar tensors (MATLAB v5) and of the released `.npy` projections.

The reader supports the part of MATLAB's format that one real array needs. A file consists of
a header of 128 bytes and elements. An element is a tag (type, number of bytes) and content.
A variable is an element of type 14, or one of type 15, which contains a deflated element of
type 14. Flags, shape, name and values of a variable are elements inside it.

Every tag is checked against the others, so that a flipped bit in any of them is an error.
Deflated variables have a checksum of their values; uncompressed ones do not.

References:
    MathWorks, MAT-File Format, chapter 1.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import os
import pathlib
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from jaxtyping import Float, Real

from radejax.core.archives import read_npy, wrap_read_errors
from radejax.core.errors import DataError, require
from radejax.core.files import PathLike, as_path
from radejax.data.kradar import reduced
from radejax.data.projection import (
    MAX_LEVEL,
    MAX_ZERO_SHARE,
    MIN_LEVEL,
    find_problem,
    project_columns,
    project_tensor,
)
from radejax.geometry.radar_grid import RadarGrid

VARIABLE = "arrDREA"


def read_tesseract(
    path: PathLike, *, shape_drea: tuple[int, ...] | None = None
) -> Real[np.ndarray, "D R E A"]:
    """Reads a 4D radar tensor as it is stored: linear power, column-major.

    Args:
        path: `tesseract_*.mat` with the variable `arrDREA`.
        shape_drea: Expected shape, or None to accept any four axes.

    Returns:
        The array in the stored type.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated or corrupted, or has no real `arrDREA` of the shape.
    """
    with _opened(path, shape_drea) as (file, layout):
        return _read_array(file, layout)


def project_file(
    path: PathLike, *, shape_drea: tuple[int, ...] | None = None
) -> Float[np.ndarray, "R A DE"]:
    """Computes `project_tensor` of a file.

    Uncompressed floats are streamed: every azimuth is reduced while it is in the cache, and
    the 260 MB are never in memory.

    Args:
        path: `tesseract_*.mat` with the variable `arrDREA`, linear power.
        shape_drea: Expected shape, or None to accept any four axes.

    Returns:
        The float32 projection, see `project_tensor`.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated or corrupted, has no real `arrDREA` of the shape, or
            has values that cannot be power.
    """
    with _opened(path, shape_drea) as (file, layout):
        if layout.deflated is None and layout.dtype.kind == "f":
            lowest = float(next(_read_columns(file, layout)).min())
            projection = project_columns(_read_columns(file, layout), layout.shape)
        else:
            tensor = _read_array(file, layout)
            lowest = float(tensor[..., 0].min())
            projection = project_tensor(tensor)
    _check_power(path, projection[..., layout.shape[0] :], lowest)
    return projection


def _check_power(
    path: PathLike, elevations: Float[np.ndarray, "R A E"], lowest: float
) -> None:
    """Raises a `DataError` if values cannot be power.

    Args:
        path: File of the radar tensor, for the message.
        elevations: Elevation channels of its projection.
        lowest: Smallest value of its first azimuth.
    """
    if problem := find_problem(elevations.max(axis=0), lowest):
        raise DataError(f"{path}: corrupted, {VARIABLE} is not linear power: {problem}")


def read_projection_npy(
    path: PathLike, projection_shape: tuple[int, int, int]
) -> Float[np.ndarray, "R A DE"]:
    """Reads a projection in the order of the authors' code, or with its channels last.

    Args:
        path: `DERA_tesseract_*.npy`, `[D+E, R, A]` or `[R, A, D+E]` floats.
        projection_shape: Expected shape `(R, A, D+E)`.

    Returns:
        The array in the stored type.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated, corrupted or of another shape or type, or has values
            that are not between `MIN_LEVEL` and `MAX_LEVEL`.
    """
    stored = read_npy(path)
    axes = _projection_axes(path, stored, projection_shape)
    is_possible = (stored >= MIN_LEVEL) & (stored <= MAX_LEVEL)  # False for NaN
    if not is_possible.all():
        raise DataError(
            f"{path}: corrupted, {int((~is_possible).sum())} of {stored.size} values are "
            f"not between {MIN_LEVEL:g} and {MAX_LEVEL:g}, which no power gives"
        )
    if (share := np.mean(stored == 0)) > MAX_ZERO_SHARE:
        raise DataError(f"{path}: corrupted, {share:.0%} of the values are exactly 0")
    return np.ascontiguousarray(stored.transpose(axes))


def _projection_axes(
    path: PathLike, stored: np.ndarray, projection_shape: tuple[int, int, int]
) -> tuple[int, int, int]:
    """Returns the positions of range, azimuth and channels in a stored projection."""
    r, a, c = projection_shape
    is_float = stored.dtype.kind == "f"
    if is_float and stored.shape == (c, r, a):
        return 1, 2, 0
    if is_float and stored.shape == (r, a, c):
        return 0, 1, 2
    hint = "; it seems to be a radar tensor" if stored.ndim == 4 else ""
    raise DataError(
        f"{path}: shape {stored.shape} of {stored.dtype}, expected floats [Doppler + "
        f"elevation, range, azimuth] = {(c, r, a)}, or {projection_shape} with the "
        f"channels last{hint}"
    )


def read_frame(path: PathLike, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
    """Returns the float32 projection of a radar tensor, or of a file of another release.

    Files of `.npy` contain projections of the authors' code or, by their names,
    frames of K-Radar's reduced releases (see `radejax.data.kradar.reduced`).

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted or has another shape than the grid.
    """
    if pathlib.Path(path).suffix != ".npy":
        whole = project_file(path, shape_drea=grid.shape_drea)
        projection: np.ndarray = grid.measured_channels(whole)
        return projection
    if reduced.is_reduced_file(path):
        return reduced.project_reduced(read_npy(path, mapped=True), grid, str(path))
    projection = read_projection_npy(path, grid.projection_shape)
    return projection.astype(np.float32)


def check_axes(grid: RadarGrid) -> None:
    """Raises a `UserError` if there are too few bins for mean power and Doppler."""
    least = min(grid.num_doppler - 1, grid.num_elevation)
    expected = "at least (2, 2, 1, 2): Doppler, range, elevation, azimuth"
    require(least > 0, "shape of the radar's grid", grid.shape_drea, expected)


def read_polar(path: PathLike, grid: RadarGrid) -> reduced.Polar:
    """Returns mean power and mean Doppler of all cells, see `radejax.data.kradar.reduced`.

    Args:
        path: Radar tensor, or frame of a reduced release.
        grid: Axes of the radar, with elevation and at least two Doppler bins.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: The grid has too few bins.
        DataError: The file is corrupted, has another shape than the grid, or is a
            projection, which has no mean power.
    """
    check_axes(grid)
    if reduced.is_reduced_file(path):
        return reduced.to_polar(read_npy(path), grid, str(path))
    if pathlib.Path(path).suffix == ".npy":
        raise DataError(
            f"{path}: a projection, which has no mean power of cells; expected a radar "
            "tensor, polar3d or rpc file"
        )
    return reduced.reduce_tensor(read_power(path, grid), grid)


def read_power(path: PathLike, grid: RadarGrid) -> Real[np.ndarray, "D R E A"]:
    """Reads the radar tensor of a sensor and checks that its values can be linear power.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted, or of another shape, or its values are not power.
    """
    tensor = read_tesseract(path, shape_drea=grid.shape_drea)
    elevations = project_tensor(tensor)[..., tensor.shape[0] :]
    _check_power(path, elevations, float(tensor[..., 0].min()))
    return tensor


def check_frame(path: PathLike, grid: RadarGrid, *, deep: bool = False) -> None:
    """Raises the errors of `read_frame` that header and size of a file show.

    With `deep`, the whole file is read, which also detects corrupted values.
    """
    if deep:
        read_frame(path, grid)
    elif reduced.is_reduced_file(path):
        reduced.check_layout(read_npy(path, mapped=True), grid, str(path))
    elif pathlib.Path(path).suffix == ".npy":
        _projection_axes(path, read_npy(path, mapped=True), grid.projection_shape)
    else:
        with _opened(path, grid.shape_drea):
            pass


@contextlib.contextmanager
def _opened(
    path: PathLike, shape_drea: tuple[int, ...] | None
) -> Iterator[tuple[io.FileIO, Layout]]:
    """Opens a file without buffering and finds its tensor.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is invalid, or reading it fails inside the `with` block.
    """
    with (
        wrap_read_errors(path, "a MATLAB file"),
        open(as_path(path), "rb", buffering=0) as file,
    ):
        layout = _find_array(file)
        shape = layout.shape
        axes = "(Doppler, range, elevation, azimuth)"
        if len(shape) != 4 or shape != tuple(shape_drea or shape):
            raise DataError(
                f"{path}: {VARIABLE} has shape {shape}, expected "
                f"{shape_drea or 'four axes'} {axes}"
            )
        yield file, layout


def _read_columns(
    file: io.FileIO, layout: Layout
) -> Iterator[Real[np.ndarray, "E R D"]]:
    """Yields the azimuth columns of a file in order, all in the same buffer."""
    slab = np.empty(layout.shape[2::-1], layout.dtype)
    view = slab.data.cast("B")
    file.seek(layout.offset)
    for i in range(layout.shape[3]):
        filled = 0
        while filled < len(view):  # network file systems may return less
            num_bytes = file.readinto(view[filled:])
            if not num_bytes:
                raise EOFError(f"the file ends in column {i}")
            filled += num_bytes
        yield slab


# MATLAB v5 files --------------------------------------------------------------------

_INT8 = 1
_INT32 = 5
_UINT32 = 6
_MATRIX = 14
_DEFLATED = 15
# Types of arrays and types of stored values, by their numbers in the format.
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4"}
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_HEAD = 512  # bytes of a variable that contain everything before its values
_CHUNK = 1 << 16  # number of deflated bytes that are inflated at once


@dataclasses.dataclass(frozen=True)
class Layout:
    """Location of the column-major values of an array in a file.

    Attributes:
        dtype: Type of the values as stored.
        shape: Shape of the array.
        offset: Offset of the values in bytes, in the file or in the inflated variable.
        deflated: Offset and length of the deflated variable, or None if it is uncompressed.
        num_bytes: Size of the inflated variable with its tag.
    """

    dtype: np.dtype
    shape: tuple[int, ...]
    offset: int
    deflated: tuple[int, int] | None
    num_bytes: int


def _find_array(file: BinaryIO) -> Layout:
    """Finds type, shape and location of the tensor in a file that is open for reading.

    Raises:
        DataError: The file is not a MATLAB v5 file, is truncated or corrupted, or has no real
            array with the name `VARIABLE`.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    header = file.read(128)
    if header[124:] != b"\0\1IM":  # version and little-endian byte order
        hint = "; save it in v7 or v6" if header.startswith(b"MATLAB 7.3") else ""
        raise DataError(f"{file.name}: not a MATLAB v5 file{hint}")
    names = []
    start = 128
    while start + 8 <= size:
        file.seek(start)
        kind, num_bytes = struct.unpack("<II", file.read(8))
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
        name, layout = _parse(file, head)
        if layout:
            if size < end:
                raise DataError(
                    f"{file.name}: truncated: {size} bytes, an array of shape "
                    f"{layout.shape} needs {end}"
                )
            offset = layout.offset if deflated else start + layout.offset
            return dataclasses.replace(layout, offset=offset, deflated=deflated)
        names.append(name)
        start = end
    raise DataError(f"{file.name}: no {VARIABLE} in it, only {names}")


def _read_array(file: BinaryIO, layout: Layout) -> np.ndarray:
    """Reads the values of a variable in the stored type.

    Raises:
        DataError: The values are truncated or do not inflate to the expected size.
    """
    count = math.prod(layout.shape)
    if layout.deflated is None:
        file.seek(layout.offset)
        values = np.fromfile(file, layout.dtype, count)
    else:
        start, size = layout.deflated
        file.seek(start)
        inflater = zlib.decompressobj()
        content = bytearray(layout.num_bytes)
        filled = 0
        for begin in range(0, size, _CHUNK):
            part = inflater.decompress(file.read(min(_CHUNK, size - begin)))
            content[filled : filled + len(part)] = part
            filled += len(part)
            if filled > layout.num_bytes or inflater.unused_data:
                break  # a corrupted file could otherwise fill the memory
        if not inflater.eof or filled != layout.num_bytes or inflater.unused_data:
            raise _corrupted(file, f"does not inflate to {layout.num_bytes} bytes")
        values = np.frombuffer(content, layout.dtype, count, layout.offset)
    if values.size < count:
        raise _corrupted(file, "it ends within its values")
    return values.reshape(layout.shape, order="F")


def _parse(file: BinaryIO, head: bytes) -> tuple[str, Layout | None]:
    """Returns the name of a variable, and its layout if it is the tensor."""
    kind, num_bytes = struct.unpack_from("<II", head)
    flags_kind, flags_size, at, after = _tag(head, 8)
    (flags,) = struct.unpack_from("<I", head, at)
    if (kind, flags_kind, flags_size) != (_MATRIX, _UINT32, 8):
        raise _corrupted(file, f"a variable begins with types {kind}, {flags_kind}")
    dims_kind, dims_size, at, after = _tag(head, after)
    shape = struct.unpack_from(f"<{dims_size // 4}I", head, at)
    name_kind, name_size, at, after = _tag(head, after)
    name = head[at : at + name_size].decode("ascii", "replace")
    # MATLAB writes int32 shapes; uint32 shapes of other programs are read too.
    if dims_kind not in (_INT32, _UINT32) or dims_size % 4 or name_kind != _INT8:
        raise _corrupted(file, f"shape of type {dims_kind}, name of type {name_kind}")
    if name != VARIABLE:
        return name, None
    wanted = np.dtype(_CLASSES.get(flags & 0xFF, np.void))
    if flags > 0xFF or wanted.kind == "V":
        raise DataError(
            f"{file.name}: {name} has flags {flags:#x}, expected real numbers"
        )
    stored_kind, stored_size, at, end = _tag(head, after)
    stored = np.dtype(_STORED.get(stored_kind, np.void))
    # MATLAB may store float arrays as smaller integers.
    is_smaller = stored.kind in "iu" and stored.itemsize < wanted.itemsize
    if stored != wanted and not (is_smaller and wanted.kind == "f"):
        raise _corrupted(file, f"{wanted} stored as type {stored_kind}")
    needed = stored.itemsize * math.prod(shape)
    if min(shape, default=0) < 1 or stored_size != needed:
        raise _corrupted(file, f"shape {shape} of {stored}, but {stored_size} bytes")
    if num_bytes + 8 not in (end, at + stored_size):
        raise _corrupted(file, f"{name} has {num_bytes} bytes, its parts {end - 8}")
    return name, Layout(stored, shape, at, None, num_bytes + 8)


def _tag(head: bytes, at: int) -> tuple[int, int, int, int]:
    """Returns type, size and offset of an element's content, and offset of the next element."""
    (word,) = struct.unpack_from("<I", head, at)
    if word >> 16:  # small element: up to four bytes within the tag
        return word & 0xFFFF, word >> 16, at + 4, at + 8
    (size,) = struct.unpack_from("<I", head, at + 4)
    return word, size, at + 8, at + 8 + size + -size % 8


def _corrupted(file: BinaryIO, what: str) -> DataError:
    return DataError(f"{file.name}: corrupted MATLAB file: {what}")
