"""Files of points: radar points in the columns of K-Radar's `rpc` files, and LiDAR scans."""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float

from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, require
from radejax.core.files import PathLike, as_path, atomic_write
from radejax.data.dataset import LabeledFrame
from radejax.data.kradar import reduced, tesseract
from radejax.data.points import cfar_points, percentile_points
from radejax.geometry.radar_grid import RadarGrid

_MAX_HEADER_LINES = 20

POINT_FIELDS = (
    "x", "y", "z", "power", "doppler", "range", "azimuth", "elevation",
    "range_bin", "azimuth_bin", "elevation_bin",
)  # fmt: skip
"""Columns of points in files, in the units of K-Radar's `rpc` files."""


def read_points(
    source: PathLike | LabeledFrame,
    grid: RadarGrid,
    method: str = "percentile",
    *,
    rate: float = 0.01,
    threshold_db: float = 9.0,
    is_axis_up: bool = False,
) -> Float[np.ndarray, "N 11"]:
    """Returns the points of a radar file or a frame, with the columns `POINT_FIELDS`.

    Args:
        source: Radar tensor, projection, or frame of a reduced release; or a frame of any
            reader.
        grid: Axes of the radar.
        method: "percentile" for the cells with the largest mean power, as in K-Radar's
            releases, or of a reader's frame for the strongest bins of the range-azimuth
            map; or "cfar" for `cfar_points`.
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
    if isinstance(source, LabeledFrame):
        projection = source.read_projection(grid)
    elif method == "cfar":
        projection = tesseract.read_frame(source, grid)
    else:
        require(0 < rate < 1, "rate", rate, "a number above 0 and below 1")
        polar = tesseract.read_polar(source, grid)
        return reduced.strongest_points(polar, grid, rate, is_axis_up=is_axis_up)
    if method == "cfar":
        found = cfar_points(projection, grid, threshold_db=threshold_db)
    else:
        found = percentile_points(projection, grid, rate)
    power = 10 ** (found.power_db / 10) / reduced.POWER_UNIT
    bins = found.range_bin, found.azimuth_bin, found.elevation_bin
    return reduced.points_of_bins(
        bins, power, found.doppler_mps, grid, is_axis_up=is_axis_up
    )


def write_points(path: PathLike, points: Float[np.ndarray, "N 11"]) -> None:
    """Writes points with the columns `POINT_FIELDS`, in the format of the file's name.

    - `.npy`: float64, as K-Radar's `rpc` files.
    - `.pcd`: binary point cloud of PCL with float32 fields.
    - `.bin`: little-endian float32 without a header, 11 per point.
    """
    path = as_path(path)
    values = points.astype("<f4")
    count = len(POINT_FIELDS)
    ones = count * " 1"
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
        fields = header.get("FIELDS", "none")
        kind = header.get("DATA", "none")
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
