"""Radar points of projections: the strongest bins, or those that CFAR finds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter  # type: ignore[attr-defined]

from radejax.core.errors import require
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB
from radejax.geometry.radar_grid import RadarGrid


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
        projection: Normalized projection; of a tensor, it is
            `grid.measured_channels(project_tensor(tensor))`.
        grid: Sensor axes of the projection.
        threshold_db: Minimum power of a point above the mean of its training cells.
        guard_cells: Number of guard cells on each side of a bin.
        training_cells: Number of training cells on each side, outside the guard cells.

    Returns:
        The points, by descending power.

    Raises:
        UserError: The projection does not match the grid.

    References:
        Cell averaging: Richards, Fundamentals of Radar Signal Processing, ch. 6.

    Examples:
        >>> from radejax.data.projection import project_tensor
        >>> grid = RadarGrid.reduced(
        ...     num_doppler=4, num_range=40, num_elevation=2, num_azimuth=30
        ... )
        >>> power = np.ones(grid.shape_drea, np.float32)
        >>> power[2, 20, 1, 15] = 1000.0
        >>> points = cfar_points(project_tensor(power), grid, threshold_db=12.0)
        >>> points.range_bin.tolist(), points.power_db.round().tolist()
        ([20], [30.0])
    """
    power_db = _power_db(projection, grid)
    mean_db = local_mean_db(power_db, guard_cells, training_cells)
    return _points_where(power_db - mean_db > threshold_db, power_db, projection, grid)


def percentile_points(
    projection: Float[np.ndarray, "R A DE"], grid: RadarGrid, rate: float = 0.01
) -> Points:
    """Returns the strongest bins of the range-azimuth map of a projection as points.

    Args:
        projection: Normalized projection, see `cfar_points`.
        grid: Sensor axes of the projection.
        rate: Fraction of the range-azimuth bins that become points, above 0 and below 1.

    Returns:
        The points, by descending power.

    Raises:
        UserError: The projection does not match the grid, or the rate is out of its range.

    Examples:
        >>> grid = RadarGrid.reduced(
        ...     num_doppler=4, num_range=10, num_elevation=2, num_azimuth=10
        ... )
        >>> projection = np.random.default_rng(0).random((10, 10, 6), np.float32)
        >>> percentile_points(projection, grid, rate=0.05).x_m.shape
        (5,)
    """
    require(0 < rate < 1, "rate", rate, "a number above 0 and below 1")
    power_db = _power_db(projection, grid)
    is_strong = power_db > np.quantile(power_db, 1 - rate)
    return _points_where(is_strong, power_db, projection, grid)


def _power_db(
    projection: Float[np.ndarray, "R A DE"], grid: RadarGrid
) -> Float[np.ndarray, "R A"]:
    """Returns the power of the strongest Doppler (or elevation) bin in dB."""
    is_same = projection.shape == grid.projection_shape
    expected = (
        f"{grid.projection_shape}: range, azimuth, Doppler + elevation of the grid"
    )
    require(is_same, "shape of the projection", projection.shape, expected)
    channels = slice(grid.num_doppler or None)
    power_db: np.ndarray = projection[..., channels].max(-1) * LOG_SCALE_DB
    return power_db - LOG_OFFSET_DB


def _points_where(
    is_point: Bool[np.ndarray, "R A"],
    power_db: Float[np.ndarray, "R A"],
    projection: Float[np.ndarray, "R A DE"],
    grid: RadarGrid,
) -> Points:
    """Returns the chosen bins by descending power."""
    doppler, elevation = np.split(projection, [grid.num_doppler], axis=-1)
    r, a = np.nonzero(is_point)
    order = np.argsort(-power_db[r, a], kind="stable")
    r, a = r[order], a[order]
    azimuth_rad = grid.azimuth_rad[a]
    e = np.zeros_like(r)
    elevation_rad = np.zeros(r.size)
    doppler_mps = np.full(r.size, np.nan)
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
    mean_db: np.ndarray = 10.0 * np.log10(np.maximum(mean, 1e-10))
    return mean_db
