"""Reading tesseracts (MATLAB v5 and v7.3) and the released `.npy` projections."""

from __future__ import annotations

import contextlib
import math
import os
import pathlib
import struct
import time
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np

from radejax.core.errors import DataError, UserError
from radejax.data.kradar.frame import Frame
from radejax.data.projection import project, project_columns
from radejax.geometry.radar_grid import RadarGrid

VARIABLE = "arrDREA"

_MI_INT8, _MI_INT32, _MI_UINT32, _MI_MATRIX = 1, 5, 6, 14
_COMPLEX = 0x0800
_MI_FLOATS = {7: np.dtype("<f4"), 9: np.dtype("<f8")}


def read_tesseract(
    path: str | os.PathLike, *, shape_drea: tuple[int, ...] | None = None
) -> np.ndarray:
    """A tesseract as it is stored: `[D, R, E, A]` linear power, column-major.

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
        layout = _parse_mat5(file)
        if layout is not None:
            dtype, shape = layout
            tesseract = np.fromfile(file, dtype, count=math.prod(shape)).reshape(
                shape, order="F"
            )
        else:
            tesseract = _read_hdf5(path) if _is_hdf5(path) else _read_mat(path)
    _check(path, tesseract, shape_drea)
    return tesseract


def project_file(
    path: str | os.PathLike,
    *,
    shape_drea: tuple[int, ...] | None = None,
    dtype: Any = np.float32,
    timings: dict[str, float] | None = None,
) -> np.ndarray:
    """`projection.project` of a file; arguments and errors as in `read_tesseract`.

    An uncompressed MATLAB v5 file is streamed: every azimuth is reduced while it is in
    the cache, and 260 MB are never held. (A memory map would do the same, but a bad
    disk sector would kill the process instead of raising an error.)

    `timings["reading"]`, if given, grows by the seconds that reading took.

    Returns:
        `[R, A, D+E]` projection.
    """
    timings = {"reading": 0.0} if timings is None else timings
    with _open(path) as file, _damage_named(path):
        layout = _parse_mat5(file)
        if layout is not None:
            stored, (doppler, range_, elevation, azimuth) = layout
            _check(path, np.broadcast_to(stored.type(0), layout[1]), shape_drea)
            slab = np.empty((elevation, range_, doppler), stored)
            columns = _read_slabs(file, slab, azimuth, timings)
            projection = project_columns(columns, dtype=dtype)
    if layout is None:
        began = time.perf_counter()
        tesseract = read_tesseract(path, shape_drea=shape_drea)
        timings["reading"] += time.perf_counter() - began
        projection = project(tesseract, dtype=dtype)
    if not np.isfinite(projection).all():
        raise DataError(f"{path}: damaged, {VARIABLE} has negative or non-finite power")
    return projection


def _read_slabs(
    file: BinaryIO, slab: np.ndarray, count: int, timings: dict[str, float]
) -> Iterator[np.ndarray]:
    """The next `count` slabs of a file, all in the same buffer."""
    view = memoryview(slab).cast("B")
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


def _open(path: str | os.PathLike) -> BinaryIO:
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
    path: str | os.PathLike, tesseract: np.ndarray, shape_drea: tuple[int, ...] | None
) -> None:
    """`DataError` unless it is a real tensor of the demanded shape."""
    if tesseract.ndim != 4 or tesseract.dtype.kind not in "fiu":
        raise DataError(
            f"{path}: {VARIABLE} has shape {tesseract.shape} of {tesseract.dtype}, "
            "expected real numbers [Doppler, range, elevation, azimuth]"
        )
    if shape_drea is not None and tesseract.shape != tuple(shape_drea):
        raise DataError(
            f"{path}: {VARIABLE} has shape {tesseract.shape}, the sensor's grid demands "
            f"{tuple(shape_drea)} (Doppler, range, elevation, azimuth)"
        )


def check_tesseract(
    path: str | os.PathLike,
    *,
    shape_drea: tuple[int, ...] | None = None,
    deep: bool = False,
) -> None:
    """Raises what `project_file` would, from the head and the size of the file alone.

    Compressed and v7.3 files say little in their head: of them only `deep`, which reads
    and projects every file, finds damage.
    """
    if deep:
        project_file(path, shape_drea=shape_drea)
        return
    with _open(path) as file:
        layout = _parse_mat5(file)
    if layout is not None:
        dtype, shape = layout
        _check(path, np.broadcast_to(dtype.type(0), shape), shape_drea)


def read_projection_npy(
    path: str | os.PathLike, *, projection_shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """A projection as the released code writes it, channels moved last.

    Args:
        path: `DERA_tesseract_*.npy`, `[D+E, R, A]` float32 or float64.
        projection_shape: `(R, A, D+E)` that the sensor's grid demands; None: any.

    Returns:
        `[R, A, D+E]` array in the type of the file.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated, damaged, or of another shape or type.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such projection")
    try:
        stored = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise DataError(f"{path}: damaged, not a NumPy array file ({error})") from None
    if (
        not isinstance(stored, np.ndarray)
        or stored.ndim != 3
        or stored.dtype.kind != "f"
    ):
        raise DataError(
            f"{path}: expected floats [Doppler + elevation, range, azimuth], got "
            f"{getattr(stored, 'shape', type(stored).__name__)} of "
            f"{getattr(stored, 'dtype', 'no type')}"
        )
    projection = np.ascontiguousarray(stored.transpose(1, 2, 0))
    if projection_shape is not None and projection.shape != tuple(projection_shape):
        r, a, c = projection_shape
        raise DataError(
            f"{path}: shape {stored.shape}, the sensor's grid demands {(c, r, a)} "
            "(Doppler + elevation, range, azimuth)"
        )
    return projection


def read_frame(path: str | pathlib.Path, grid: RadarGrid) -> np.ndarray:
    """`[R, A, D+E]` float32 projection of a tesseract file or a released projection.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: It is damaged, or of another shape than the grid.
    """
    if pathlib.Path(path).suffix == ".npy":
        shape = grid.projection_shape
        projection = read_projection_npy(path, projection_shape=shape)
        return projection.astype(np.float32)
    return project_file(path, shape_drea=grid.shape_drea)


def read_projection(frame: Frame, grid: RadarGrid) -> np.ndarray:
    """`[R, A, D+E]` float32 projection of a frame: from its tesseract, or the released one.

    Raises:
        UserError: The frame has neither.
        FileNotFoundError, DataError: As `read_frame`.
    """
    path = frame.tesseract_path or frame.projection_path
    if path is None:
        raise UserError(f"frame {frame.key} has no tesseract or projection")
    return read_frame(path, grid)


def _parse_mat5(file: BinaryIO) -> tuple[np.dtype, tuple[int, ...]] | None:
    """Type and shape of an uncompressed little-endian v5 file that holds `arrDREA`.

    Leaves the file at its first number. None for anything unexpected: scipy then reads
    the file or says what is wrong. `DataError` when the file is too short.
    """
    head = file.read(200)
    if len(head) < 200 or head[124:128] != b"\x00\x01IM":
        return None
    (
        *tags,
        dims_tag,
        dims_size,
        d,
        r,
        e,
        a,
        name_tag,
        name_size,
        name,
        data_tag,
        data_size,
    ) = struct.unpack_from("<II III4x II4i II8s II", head, 128)
    matrix_tag, _, flags_tag, flags_size, flags = tags
    shape = (d, r, e, a)
    dtype = _MI_FLOATS.get(data_tag)
    if (
        (matrix_tag, flags_tag, flags_size) != (_MI_MATRIX, _MI_UINT32, 8)
        or flags & _COMPLEX
        or (dims_tag, dims_size) != (_MI_INT32, 16)
        or (name_tag, name_size) != (_MI_INT8, len(VARIABLE))
        or name != VARIABLE.encode().ljust(8, b"\0")
        or dtype is None
        or min(shape) < 1
        or data_size != dtype.itemsize * math.prod(shape)
    ):
        return None
    size, needed = os.fstat(file.fileno()).st_size, file.tell() + data_size
    if size < needed:
        raise DataError(
            f"{file.name}: truncated: {size} bytes, {VARIABLE} of shape {shape} needs "
            f"{needed}"
        )
    return dtype, shape


def _is_hdf5(path: pathlib.Path) -> bool:
    import h5py  # needed for v7.3 files only

    return bool(h5py.is_hdf5(path))


def _read_hdf5(path: pathlib.Path) -> np.ndarray:
    """v7.3: an HDF5 data set with the axes reversed."""
    import h5py

    with h5py.File(path, "r") as file:
        if VARIABLE not in file:
            raise DataError(f"{path}: no {VARIABLE} in it, only {sorted(file)}")
        return file[VARIABLE][()].T


def _read_mat(path: pathlib.Path) -> np.ndarray:
    """v5, compressed or unusual, through scipy."""
    import scipy.io

    variables = scipy.io.loadmat(path, variable_names=[VARIABLE])
    if VARIABLE not in variables:
        names = [name for name, *_ in scipy.io.whosmat(path)]
        raise DataError(f"{path}: no {VARIABLE} in it, only {names}")
    return variables[VARIABLE]
