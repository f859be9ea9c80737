"""Readers of 4D radar tensors (MATLAB v5) and of the released `.npy` projections."""

from __future__ import annotations

import io
import os
import pathlib
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, Real

from radejax.core.archives import read_npy, wrap_read_errors
from radejax.core.errors import DataError
from radejax.data import mat5
from radejax.data.projection import MAX_LEVEL, project_columns, project_tensor
from radejax.geometry.radar_grid import RadarGrid

VARIABLE = "arrDREA"


def read_tesseract(
    path: str | os.PathLike, *, shape_drea: tuple[int, ...] | None = None
) -> Real[np.ndarray, "D R E A"]:
    """A 4D radar tensor as it is stored: linear power, column-major.

    Args:
        path: `tesseract_*.mat` with the variable `arrDREA`.
        shape_drea: Shape that the sensor's grid demands; None: any four axes.

    Returns:
        The array in the type of the file.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is truncated, corrupted, or of another shape.
    """
    with wrap_read_errors(path, "a MATLAB file"), _open(path) as file:
        return mat5.read_array(file, _layout(file, shape_drea))


def project_file(
    path: str | os.PathLike,
    *,
    shape_drea: tuple[int, ...] | None = None,
    dtype: Any = np.float32,
) -> Float[np.ndarray, "R A DE"]:
    """`project_tensor` of a file; arguments and errors as in `read_tesseract`.

    An uncompressed file is streamed: every azimuth is reduced while it is in the cache,
    and the 260 MB are never held. (A memory map would do the same, but a bad disk sector
    would kill the process instead of raising an error.)
    """
    with wrap_read_errors(path, "a MATLAB file"), _open(path) as file:
        layout = _layout(file, shape_drea)
        is_native = layout.dtype.kind == "f" and layout.dtype.isnative
        if layout.deflated is None and is_native:
            columns = _read_columns(file, layout)
            projection = project_columns(columns, layout.shape, dtype=dtype)
        else:
            projection = project_tensor(mat5.read_array(file, layout), dtype=dtype)
    if not np.isfinite(projection).all():
        raise DataError(f"{path}: corrupted, {VARIABLE} has negative or infinite power")
    return projection


def check_tesseract(
    path: str | os.PathLike,
    *,
    shape_drea: tuple[int, ...] | None = None,
    deep: bool = False,
) -> None:
    """Raises what `project_file` would, from the head and the size of the file only.

    Corrupted values are found by `deep` only, which reads and projects the file.
    """
    if deep:
        project_file(path, shape_drea=shape_drea)
        return
    with wrap_read_errors(path, "a MATLAB file"), _open(path) as file:
        _layout(file, shape_drea)


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
        DataError: The file is truncated, corrupted, of another shape or type, or has
            values that are not finite or that no power gives.
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
            f"{path}: corrupted, {int((~is_possible).sum())} of {stored.size} values are "
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
    path: str | pathlib.Path, grid: RadarGrid
) -> Float[np.ndarray, "R A DE"]:
    """float32 projection of a radar tensor file or a released projection.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: It is corrupted, or of another shape than the grid.
    """
    if pathlib.Path(path).suffix == ".npy":
        shape = grid.projection_shape
        projection = read_projection_npy(path, projection_shape=shape)
        return projection.astype(np.float32)
    return project_file(path, shape_drea=grid.shape_drea)


def _open(path: str | os.PathLike) -> io.FileIO:
    """The file, unbuffered."""
    try:
        return open(path, "rb", buffering=0)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such radar tensor") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, expected a MATLAB file") from None


def _layout(file: BinaryIO, shape_drea: tuple[int, ...] | None) -> mat5.Layout:
    """Layout of the tensor; `DataError` where its shape is not the demanded one."""
    layout = mat5.find_array(file, VARIABLE)
    shape, axes = layout.shape, "(Doppler, range, elevation, azimuth)"
    if len(shape) != 4 or shape != tuple(shape_drea or shape):
        raise DataError(
            f"{file.name}: {VARIABLE} has shape {shape}, the sensor's grid demands "
            f"{shape_drea or 'four axes'} {axes}"
        )
    return layout


def _read_columns(
    file: io.FileIO, layout: mat5.Layout
) -> Iterator[Real[np.ndarray, "E R D"]]:
    """The azimuth columns of a file, one after the other, all in the same buffer."""
    slab = np.empty(layout.shape[2::-1], layout.dtype)
    view = slab.data.cast("B")
    file.seek(layout.offset)
    for i in range(layout.shape[3]):
        filled = 0
        while filled < len(view):  # network file systems return parts
            num_bytes = file.readinto(view[filled:])
            if not num_bytes:
                raise EOFError(f"the file ends in column {i}")
            filled += num_bytes
        yield slab
