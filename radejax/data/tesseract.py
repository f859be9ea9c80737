"""Reading tesseracts (MATLAB v5 and v7.3) and the released `.npy` projections."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import os
import pathlib
import time
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, Real

from radejax.core.archives import DEFLATE_RATIO, read_npy
from radejax.core.errors import DataError
from radejax.data import mat5
from radejax.data.projection import MAX_LEVEL, project, project_columns
from radejax.geometry.radar_grid import RadarGrid

VARIABLE = "arrDREA"


def read_tesseract(
    path: str | os.PathLike, *, shape_drea: tuple[int, ...] | None = None
) -> Real[np.ndarray, "D R E A"]:
    """A tesseract as it is stored: linear power, column-major.

    Args:
        path: `tesseract_*.mat` with the variable `arrDREA`.
        shape_drea: Shape that the sensor's grid demands; None: any four axes.

    Returns:
        The array in the type of the file.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated, damaged, or of another shape.
    """
    with _open(path) as file, _damage_named(path):
        layout = _layout(path, file, shape_drea)
        if layout is not None:
            return mat5.read_array(file, layout)
        with _open_hdf5(path) as data:
            _check(path, data.dtype, data.shape[::-1], shape_drea)
            for chunk in _chunks(data):  # HDF5 reads one that it cannot find as zeros
                data.id.read_direct_chunk(chunk.chunk_offset)
            return data[()].T


def project_file(
    path: str | os.PathLike,
    *,
    shape_drea: tuple[int, ...] | None = None,
    dtype: Any = np.float32,
    timings: dict[str, float] | None = None,
) -> Float[np.ndarray, "R A DE"]:
    """`projection.project` of a file; arguments and errors as in `read_tesseract`.

    An uncompressed MATLAB v5 file is streamed: every azimuth is reduced while it is in
    the cache, and 260 MB are never held. (A memory map would do the same, but a bad
    disk sector would kill the process instead of raising an error.)

    `timings["reading"]`, if given, grows by the seconds that reading took.
    """
    timings = {"reading": 0.0} if timings is None else timings
    with _open(path) as file, _damage_named(path):
        layout = _layout(path, file, shape_drea)
        projection = None
        if layout is not None and _is_streamed(layout):
            file.seek(layout.offset)
            slab = np.empty(layout.shape[2::-1], layout.dtype)
            azimuth = layout.shape[3]
            columns = _read_slabs(file, slab, azimuth, timings)
            projection = project_columns(columns, layout.shape, dtype=dtype)
    if projection is None:
        began = time.perf_counter()
        tesseract = read_tesseract(path, shape_drea=shape_drea)
        timings["reading"] += time.perf_counter() - began
        projection = project(tesseract, dtype=dtype)
    if not np.isfinite(projection).all():
        raise DataError(f"{path}: damaged, {VARIABLE} has negative or non-finite power")
    return projection


def _read_slabs(
    file: io.FileIO,
    slab: Real[np.ndarray, "E R D"],
    count: int,
    timings: dict[str, float],
) -> Iterator[Real[np.ndarray, "E R D"]]:
    """The next `count` slabs of a file, all in the same buffer."""
    view = slab.data.cast("B")
    for i in range(count):
        began = time.perf_counter()
        filled = 0
        while filled < len(view):  # network file systems return parts
            num_bytes = file.readinto(view[filled:])
            if not num_bytes:
                raise EOFError(f"the file ends in column {i} of {count}")
            filled += num_bytes
        timings["reading"] += time.perf_counter() - began
        yield slab


@contextlib.contextmanager
def _damage_named(path: str | os.PathLike) -> Iterator[None]:
    """Turns whatever the readers of damaged files raise into a `DataError`."""
    try:
        yield
    except (MemoryError, DataError):
        raise
    except Exception as error:
        raise DataError(
            f"{path}: damaged, cannot be read as a MATLAB file "
            f"({type(error).__name__}: {error})"
        ) from None


def _open(path: str | os.PathLike) -> io.FileIO:
    """The file, unbuffered; errors for a missing and an empty one."""
    try:
        file = open(path, "rb", buffering=0)  # noqa: SIM115  the caller closes it
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such tesseract") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, expected a MATLAB file") from None
    if os.fstat(file.fileno()).st_size == 0:
        file.close()
        raise DataError(f"{path}: the file is empty, expected a MATLAB file")
    return file


def _check(
    path: str | os.PathLike,
    dtype: np.dtype,
    shape: tuple[int, ...],
    shape_drea: tuple[int, ...] | None,
) -> None:
    """`DataError` unless it is a real tensor of the demanded shape."""
    if len(shape) != 4 or dtype.kind not in "fiu":
        raise DataError(
            f"{path}: {VARIABLE} has shape {shape} of {dtype}, "
            "expected real numbers [Doppler, range, elevation, azimuth]"
        )
    if shape_drea is not None and shape != tuple(shape_drea):
        raise DataError(
            f"{path}: {VARIABLE} has shape {shape}, the sensor's grid demands "
            f"{tuple(shape_drea)} (Doppler, range, elevation, azimuth)"
        )


def check_tesseract(
    path: str | os.PathLike,
    *,
    shape_drea: tuple[int, ...] | None = None,
    deep: bool = False,
) -> None:
    """Raises what `project_file` would, from the head and the size of the file alone.

    Damage within the numbers only `deep` finds, which reads and projects every file.
    """
    if deep:
        project_file(path, shape_drea=shape_drea)
        return
    with _open(path) as file, _damage_named(path):
        if _layout(path, file, shape_drea) is None:
            with _open_hdf5(path) as data:
                _check(path, data.dtype, data.shape[::-1], shape_drea)


def read_projection_npy(
    path: str | os.PathLike, *, projection_shape: tuple[int, ...] | None = None
) -> Float[np.ndarray, "R A DE"]:
    """A projection as the released code writes it, channels moved last.

    Args:
        path: `DERA_tesseract_*.npy`, `[D+E, R, A]` float32 or float64.
        projection_shape: `(R, A, D+E)` that the sensor's grid demands; None: any.

    Returns:
        The array in the type of the file.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated, damaged, of another shape or type, or has cells
            that are not finite or that no power gives.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such projection")
    stored = read_npy(path)
    if stored.ndim != 3 or stored.dtype.kind != "f":
        raise DataError(
            f"{path}: expected floats [Doppler + elevation, range, azimuth], got "
            f"{stored.shape} of {stored.dtype}"
        )
    is_possible = np.abs(stored) <= MAX_LEVEL  # False for NaN
    if not is_possible.all():
        raise DataError(
            f"{path}: damaged, {int((~is_possible).sum())} of {stored.size} cells are "
            f"not finite or beyond {MAX_LEVEL:g}, which no power gives"
        )
    projection = np.ascontiguousarray(stored.transpose(1, 2, 0))
    if projection_shape is not None and projection.shape != tuple(projection_shape):
        r, a, c = projection_shape
        raise DataError(
            f"{path}: shape {stored.shape}, the sensor's grid demands {(c, r, a)} "
            "(Doppler + elevation, range, azimuth)"
        )
    return projection


def read_frame(
    path: str | pathlib.Path, grid: RadarGrid, timings: dict[str, float] | None = None
) -> Float[np.ndarray, "R A DE"]:
    """float32 projection of a tesseract file or a released projection.

    Args:
        path: Of the file.
        grid: Axes of the radar.
        timings: As for `project_file`.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: It is damaged, or of another shape than the grid.
    """
    if pathlib.Path(path).suffix == ".npy":
        shape = grid.projection_shape
        projection = read_projection_npy(path, projection_shape=shape)
        return projection.astype(np.float32)
    return project_file(path, shape_drea=grid.shape_drea, timings=timings)


def _layout(
    path: str | os.PathLike, file: BinaryIO, shape_drea: tuple[int, ...] | None
) -> mat5.Layout | None:
    """Checked layout of the tesseract in a v5 file; None for a v7.3 file."""
    layout = mat5.find_array(file, VARIABLE)
    if layout is not None:
        _check(path, layout.dtype, layout.shape, shape_drea)
        return layout
    import h5py  # needed for v7.3 files only

    if not h5py.is_hdf5(path):
        raise DataError(f"{path}: damaged, neither a MATLAB v5 nor a v7.3 file")
    return None


def _is_streamed(layout: mat5.Layout) -> bool:
    """True where the numbers can be projected as they come."""
    is_native_float = layout.dtype.kind == "f" and layout.dtype.isnative
    return layout.deflated is None and is_native_float


@contextlib.contextmanager
def _open_hdf5(path: str | os.PathLike) -> Iterator[Any]:
    """v7.3: the data set of an HDF5 file, whose axes are reversed; nothing is read yet.

    Numbers that are elsewhere (links, external storage, virtual data sets) would make
    one file read another: `DataError`. Likewise claims that its bytes cannot fill.
    """
    import h5py

    with h5py.File(path, "r") as file:
        if VARIABLE not in file:
            raise DataError(f"{path}: no {VARIABLE} in it, only {sorted(file)}")
        data = file[VARIABLE]
        is_here = isinstance(file.get(VARIABLE, getlink=True), h5py.HardLink)
        if not isinstance(data, h5py.Dataset) or not is_here:
            raise DataError(f"{path}: {VARIABLE} is no array, or a link to one")
        if data.external or data.is_virtual:
            raise DataError(f"{path}: the numbers of {VARIABLE} are in other files")
        how = data.id.get_create_plist()
        filters = [how.get_filter(i)[0] for i in range(how.get_nfilters())]
        stored, claimed = data.id.get_storage_size(), data.nbytes
        chunk = math.prod(data.chunks or (1,)) * data.dtype.itemsize
        if (
            len(set(filters)) < len(filters)
            or stored > os.path.getsize(path)
            or claimed > stored * (DEFLATE_RATIO if filters else 1)
            or chunk > claimed
        ):
            raise DataError(
                f"{path}: damaged, {VARIABLE} of shape {data.shape[::-1]} claims "
                f"{claimed} bytes and stores {stored}"
            )
        _check_hdf5_storage(path, data)
        yield data


def _check_hdf5_storage(path: str | os.PathLike, data: Any) -> None:
    """`DataError` where one flipped bit of a v7.3 file makes other numbers.

    Such a bit is in the type (exponent, byte order), in the place of the numbers, or in
    the table of the chunks, of which a missing one would be read as zeros.
    """
    import h5py

    stored = data.id.get_type()
    if stored not in (h5py.h5t.IEEE_F32LE, h5py.h5t.IEEE_F64LE):
        raise DataError(
            f"{path}: numbers of {VARIABLE} are stored as an unusual {data.dtype.str}, "
            "expected little-endian float32 or float64"
        )
    # A module that h5py's stubs lack.
    info = h5py.h5o.get_info(data.id)  # type: ignore[attr-defined]
    head = data.file.userblock_size + info.addr
    if data.chunks is None:
        places = [(data.id.get_offset() or 0, data.nbytes)]
        is_whole = data.id.get_storage_size() == data.nbytes
    else:
        chunks = _chunks(data)
        places = [(chunk.byte_offset, chunk.size) for chunk in chunks]
        found = sorted(chunk.chunk_offset for chunk in chunks)
        steps = [range(0, *ends) for ends in zip(data.shape, data.chunks, strict=True)]
        is_whole = len(found) == math.prod(map(len, steps))
        is_whole = is_whole and found == list(itertools.product(*steps))
        is_whole = is_whole and not any(chunk.filter_mask for chunk in chunks)
        if not data.id.get_create_plist().get_nfilters():
            num_bytes = math.prod(data.chunks) * data.dtype.itemsize
            is_whole = is_whole and {size for _, size in places} == {num_bytes}
    if not is_whole or any(0 <= head - start < size for start, size in places):
        raise DataError(f"{path}: damaged, the table of {VARIABLE}'s numbers is wrong")


def _chunks(data: Any) -> list[Any]:
    """Places of the chunks of a data set; none where it has no chunks."""
    chunks: list[Any] = []
    if data.chunks:
        data.id.chunk_iter(chunks.append)
    return chunks
