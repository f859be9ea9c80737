"""Point clouds: radar points by percentile or CFAR, and LiDAR scans of K-Radar."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter  # type: ignore[attr-defined]

from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, require
from radejax.core.files import PathLike, as_path, atomic_write
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB
from radejax.data.reduced import POWER_UNIT, points_of_bins, strongest_points
from radejax.data.tesseract import read_frame, read_polar
from radejax.geometry.radar_grid import RadarGrid

_MAX_HEADER_LINES = 20


class Points(NamedTuple):
    """Radar points as columns of equal length, by descending power.

    Attributes:
        x_m, y_m, z_m: Position in the radar frame: forward, left and up from the radar;
            at elevation 0 if the radar does not measure it.
        doppler_mps: Doppler velocity of the strongest Doppler bin, or NaN without Doppler.
        power_db: Power of the strongest Doppler (or elevation) bin.
        range_bin, azimuth_bin, elevation_bin: Bins of the position; an elevation that the
            radar does not measure has bin 0.
    """

    x_m: Float[np.ndarray, " N"]
    y_m: Float[np.ndarray, " N"]
    z_m: Float[np.ndarray, " N"]
    doppler_mps: Float[np.ndarray, " N"]
    power_db: Float[np.ndarray, " N"]
    range_bin: Int[np.ndarray, " N"]
    azimuth_bin: Int[np.ndarray, " N"]
    elevation_bin: Int[np.ndarray, " N"]


def cfar_points(
    projection: Float[np.ndarray, "R A DE"],
    grid: RadarGrid,
    *,
    threshold_db: float = 9.0,
    guard_cells: int = 4,
    training_cells: int = 6,
) -> Points:
    """Detects points in the range-azimuth map of a projection.

    The elevation and the Doppler velocity of a point are those of the strongest bins of the
    two halves of the projection.

    Args:
        projection: Normalized projection, as `project_tensor` returns it.
        grid: Sensor axes of the projection.
        threshold_db: Minimum power of a point above the mean of its training cells.
        guard_cells: Number of guard cells on each side of a bin.
        training_cells: Number of training cells on each side, outside the guard cells.

    References:
        Cell averaging: Richards, Fundamentals of Radar Signal Processing, ch. 6.
    """
    doppler, elevation = np.split(projection, [grid.num_doppler], axis=-1)
    strongest = (doppler if grid.num_doppler else elevation).max(-1)
    power_db = strongest * LOG_SCALE_DB - LOG_OFFSET_DB
    mean_db = local_mean_db(power_db, guard_cells, training_cells)
    r, a = np.nonzero(power_db - mean_db > threshold_db)
    order = np.argsort(-power_db[r, a], kind="stable")
    r, a = r[order], a[order]
    azimuth_rad, e = grid.azimuth_rad[a], np.zeros_like(r)
    elevation_rad, doppler_mps = np.zeros(r.size), np.full(r.size, np.nan)
    if grid.num_elevation:
        e = elevation[r, a].argmax(-1)
        elevation_rad = grid.elevation_rad[e]
    if grid.num_doppler:
        doppler_mps = grid.doppler_mps[doppler[r, a].argmax(-1)]
    ground_m = grid.range_m[r] * np.cos(elevation_rad)
    return Points(
        x_m=ground_m * np.cos(azimuth_rad),
        y_m=-ground_m * np.sin(azimuth_rad),
        z_m=grid.range_m[r] * np.sin(elevation_rad),
        doppler_mps=doppler_mps,
        power_db=power_db[r, a],
        range_bin=r,
        azimuth_bin=a,
        elevation_bin=e,
    )


def local_mean_db(
    power_db: Float[np.ndarray, "R A"], guard_cells: int, training_cells: int
) -> Float[np.ndarray, "R A"]:
    """Returns the mean linear power of the training cells around each bin in dB.

    The map is padded with its edge values.
    """
    power = 10.0 ** (power_db.astype(np.float64) / 10.0)
    inner = 2 * guard_cells + 1
    outer = inner + 2 * training_cells
    whole = uniform_filter(power, outer, mode="nearest") * outer**2
    guard = uniform_filter(power, inner, mode="nearest") * inner**2
    mean = (whole - guard) / (outer**2 - inner**2)
    return 10.0 * np.log10(np.maximum(mean, 1e-10))


# Files -------------------------------------------------------------------------------

POINT_FIELDS = (
    *("x", "y", "z", "power", "doppler", "range", "azimuth", "elevation"),
    *("range_bin", "azimuth_bin", "elevation_bin"),
)
"""Columns of points in files, in the units of K-Radar's `rpc` files."""


def read_points(
    path: PathLike,
    grid: RadarGrid,
    method: str = "percentile",
    *,
    rate: float = 0.01,
    threshold_db: float = 9.0,
    is_axis_up: bool = False,
) -> Float[np.ndarray, "N 11"]:
    """Returns the points of a radar file, with the columns `POINT_FIELDS`.

    Args:
        path: Radar tensor, projection, or frame of a reduced release.
        grid: Axes of the radar.
        method: "percentile" for the cells with the largest mean power, as in K-Radar's
            releases, or "cfar" for `cfar_points`.
        rate: Fraction of the cells that become points ("percentile").
        threshold_db: Minimum power above the mean of the training cells ("cfar").
        is_axis_up: Whether the elevation axis points up, see `is_elevation_axis_up`.

    Raises:
        FileNotFoundError: There is no such file.
        UserError: An option is invalid, or the grid has too few bins for "percentile".
        DataError: The file is corrupted, has another shape than the grid, or is a
            projection and the method "percentile".
    """
    require(method in ("percentile", "cfar"), "method", method, "percentile or cfar")
    if method == "percentile":
        require(0 < rate < 1, "rate", rate, "a number above 0 and below 1")
        polar = read_polar(path, grid)
        return strongest_points(polar, grid, rate, is_axis_up=is_axis_up)
    found = cfar_points(read_frame(path, grid), grid, threshold_db=threshold_db)
    power = 10 ** (found.power_db / 10) / POWER_UNIT
    bins = found.range_bin, found.azimuth_bin, found.elevation_bin
    return points_of_bins(bins, power, found.doppler_mps, grid, is_axis_up=is_axis_up)


def write_points(path: PathLike, points: Float[np.ndarray, "N 11"]) -> None:
    """Writes points with the columns `POINT_FIELDS`, in the format of the file's name.

    - `.npy`: float64, as K-Radar's `rpc` files.
    - `.pcd`: binary point cloud of PCL with float32 fields.
    - `.bin`: little-endian float32 without a header, 11 per point.
    """
    path, values = as_path(path), points.astype("<f4")
    count, ones = len(POINT_FIELDS), len(POINT_FIELDS) * " 1"
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(POINT_FIELDS)}\nSIZE{count * ' 4'}\nTYPE{count * ' F'}\n"
        f"COUNT{ones}\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    with atomic_write(path) as file:
        if path.suffix == ".npy":
            np.save(file, points)
        else:
            file.write(header.encode() if path.suffix == ".pcd" else b"")
            file.write(values.tobytes())


def read_lidar(path: PathLike) -> Float[np.ndarray, "N 3"]:
    """Reads x, y, z in meters in the LiDAR frame from an ASCII PCD file.

    Rays without an echo, whose coordinates are 0 or not finite, are left out.

    Args:
        path: File such as K-Radar's `os2-64/os2-64_00001.pcd`.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is incomplete, or has another header.
    """
    with wrap_read_errors(path, "an ASCII PCD file"), open(as_path(path)) as file:
        header = dict[str, str]()
        for line in itertools.islice(file, _MAX_HEADER_LINES):
            name, _, header[name] = line.strip().partition(" ")
            if name == "DATA":
                break
        fields, kind = header.get("FIELDS", "none"), header.get("DATA", "none")
        if fields.split()[:3] != ["x", "y", "z"] or kind != "ascii":
            raise DataError(
                f"{path}: PCD header with FIELDS {fields[:80]} and DATA {kind[:80]}, "
                "expected FIELDS x y z ... and DATA ascii, as in K-Radar's os2-64"
            )
        points = np.loadtxt(file, usecols=(0, 1, 2), ndmin=2)
        if len(points) != int(header.get("POINTS", -1)):
            raise DataError(
                f"{path}: {len(points)} points, the header says {header.get('POINTS')}"
            )
    return points[np.isfinite(points).all(1) & points.any(1)]
