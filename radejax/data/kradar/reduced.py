"""K-Radar's reduced releases: mean power and mean Doppler instead of 4D radar tensors.

- `polar3d_<radar>.npy` holds `[2, R, A, E]`: linear power, averaged over all Doppler bins
  but the first and divided by 1e13, and the power-weighted mean Doppler in m/s.
- `rpc_<radar>.npy` holds the strongest cells of it as points `[N, 11]`: x, y, z, power,
  mean Doppler, range, azimuth, elevation and the bins of the last three. Azimuth is
  positive to the left and elevation upwards, see `points_of_bins`. Older files `[N, 5]`
  end after the Doppler.

Both become projections `[R, A, D+E]` on the scale of `project_tensor`. A cell of mean power
m (in the unit of the tensor) has the level (10 log10(m + 1e-10) + 1.2) / 184.3, where
`project_tensor` has the maximum of the power over Doppler. For noise of exponentially
distributed power, the maximum of 64 bins is 6.8 dB above the mean on average (0.037 levels);
for an echo in a single bin, at most 18 dB (0.098 levels). The Doppler half is reconstructed:
each cell contributes its level at the bin of its mean Doppler, and the maximum over elevation
is taken. Other Doppler bins have the lowest level over elevation. Bins without a point have
`EMPTY_LEVEL`, or the level of the weakest point if that is lower.

References:
    K-Radar, `datasets/kradar_detection_v2_1.py` (commit 97fe0a6): `get_cube_polar` and
    `get_proportional_rdr_points`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, Real

from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike, as_path
from radejax.core.structures import Array
from radejax.data.projection import MAX_ZERO_SHARE, to_log_scale
from radejax.geometry.radar_grid import RadarGrid

RELEASES = ("polar3d", "rpc")
"""Reduced releases, by the first part of the names of their files."""

UNUSABLE_POINTS = (
    "points [N, 4] on a Cartesian grid have neither Doppler nor polar bins, which the "
    "networks need; download rdr_polar_3d or rpc files instead"
)

Indices = Int[np.ndarray, " N"]

POWER_UNIT = 1e13
"""Released powers are linear power divided by this."""

Polar = Float[np.ndarray, "2 R A E"]
"""Mean power in `POWER_UNIT` and mean Doppler in m/s."""

EMPTY_LEVEL = 0.5
"""Level of bins without a point, a little below K-Radar's noise."""

_MAX_POWER = 1e6  # far above any echo divided by POWER_UNIT, far below undivided noise
_MIN_DECIBELS = 60.0  # undivided noise is above
_MAX_DECIBELS = 300.0  # echoes are below

_KRADAR_DOPPLER_MPS = np.linspace(-1.932591218305504, 1.872197742733457, 64)
"""K-Radar's Doppler axis, of which `RadarGrid.kradar` has six decimals."""


def is_reduced_file(path: PathLike) -> bool:
    """Returns True if a file is named like those of the reduced releases."""
    return as_path(path).name.startswith(("polar3d_", "rpc_", "sprdr_"))


def check_release(found: str | None, expected: str | None, name: str) -> None:
    """Raises a `UserError` unless radar data have the form that a model is for.

    Args:
        found: Reduced release of the data; None for radar tensors and projections.
        expected: `config.data.release` of the model.
        name: Name of the data in the message.
    """
    if found != expected:
        option = (
            f"with the option {found}" if found else f"without the option {expected}"
        )
        raise UserError(
            f"{name}: {found or 'radar tensors'}, but the model is for "
            f"{expected or 'radar tensors'} (config.data.release is {expected}); use data "
            f"of that form, or train {option} of the configs radenet and dinorade"
        )


def release_of_file(path: PathLike) -> str | None:
    """Returns the release that the name of a file tells, or None for others."""
    name = as_path(path).name.partition("_")[0]
    return name if name in RELEASES else None


def is_reduced(frame: Real[Array, "..."], grid: RadarGrid) -> bool:
    """Returns True if an array belongs to a reduced release by its shape.

    Without a Doppler axis, a `polar3d` frame has the shape of two projections. It is then
    recognized by the negative values of its Doppler.
    """
    if frame.ndim == 2:
        return frame.shape[1] in (4, 5, 11)  # 4: an error explains why not
    is_unique = frame.shape[1:] != grid.projection_shape
    is_polar = frame.shape == polar_shape(grid) != grid.shape_drea
    return is_polar and (is_unique or bool(frame[1].min() < 0))


def polar_shape(grid: RadarGrid) -> tuple[int, int, int, int]:
    """Returns the shape of `polar3d` frames: 2, range, azimuth, elevation."""
    return 2, grid.num_range, grid.num_azimuth, grid.num_elevation


def project_reduced(
    frame: Real[np.ndarray, "..."], grid: RadarGrid, name: str = "frame"
) -> Float[np.ndarray, "R A DE"]:
    """Computes the float32 projection of one frame of a reduced release.

    Points `[N, 5]` at range 0 are left out, because their direction is not known.

    Args:
        frame: `polar3d` array `[2, R, A, E]`, or points `[N, 11]` or `[N, 5]`.
        grid: Axes of the radar. Without Doppler bins, the projection is `[R, A, E]`.
        name: Name of the frame in messages.

    Raises:
        DataError: Shape, type or scale differ from those of the release, or a point does
            not lie at a bin of the grid.
    """
    frame = _with_direction(frame)
    check_layout(frame, grid, name)
    projection = np.empty(grid.projection_shape, np.float32)
    if frame.ndim == 2:
        bins = _bins_of_points(frame, grid, name)
        beams = bins[0][None] * grid.num_azimuth + bins[1]
        cells = frame.T[3:5, None]
        rows = grid.num_range
    else:
        bins = ()  # the index of all cells
        cells = frame
        rows = 16  # so few at a time stay in the cache
        beams = np.arange(rows * grid.num_azimuth).reshape(rows, -1, 1)
    _check_power(cells[0], name)
    if grid.num_doppler:
        first_mps, last_mps = map(float, grid.doppler_mps[[0, -1]])
        bins_per_mps = (grid.num_doppler - 1) / (last_mps - first_mps or 1.0)
        limit_mps = 1.01 * max(abs(first_mps), abs(last_mps))  # means may be rounded
    for start in range(0, grid.num_range, rows):
        part = projection[start : start + rows]
        power, doppler = cells[:, start : start + rows]
        levels = to_log_scale(power.astype(np.float32) * np.float32(POWER_UNIT))
        lowest = levels.min(axis=-1, keepdims=True)  # over elevation, or of all points
        part[...] = lowest if frame.ndim > 2 else np.minimum(lowest, EMPTY_LEVEL)
        part[..., grid.num_doppler :][bins] = levels
        if grid.num_doppler:
            is_far = ~(np.abs(doppler) <= limit_mps) & (power > 0)
            if is_far.any():
                raise DataError(
                    f"{name}: mean Doppler of {doppler[is_far][0]:.3g} m/s, expected from "
                    f"{-limit_mps:.3g} to {limit_mps:.3g}"
                )
            channels = np.rint((doppler.astype(np.float32) - first_mps) * bins_per_mps)
            # fmin and fmax also replace NaN, which cells without power have.
            channels = np.fmax(np.fmin(channels, grid.num_doppler - 1), 0)
            index = beams[: len(part)] * part.shape[-1] + channels.astype(np.intp)
            np.maximum.at(part.reshape(-1), index.ravel(), levels.ravel())
    return projection


def reduce_tensor(tesseract: Real[np.ndarray, "D R E A"], grid: RadarGrid) -> Polar:
    """Computes a `polar3d` array in float64 from a 4D radar tensor of linear power.

    The steps have the precision of K-Radar's: that of the tensor, and float64 from the
    product with the Doppler axis on. Cells without power have a mean Doppler of NaN.
    """
    weights = grid.doppler_mps
    is_kradar = weights.shape == _KRADAR_DOPPLER_MPS.shape
    if is_kradar and np.allclose(weights, _KRADAR_DOPPLER_MPS, atol=1e-6):
        weights = _KRADAR_DOPPLER_MPS
    weights = weights[1:, None, None]
    polar = np.empty(polar_shape(grid))
    for azimuth in range(grid.num_azimuth):
        column = np.ascontiguousarray(tesseract[1:, :, :, azimuth]) / POWER_UNIT
        total = column.sum(axis=0)  # [R, E]
        polar[0, :, azimuth] = total / len(weights)
        with np.errstate(invalid="ignore"):
            polar[1, :, azimuth] = (column / total * weights).sum(axis=0)
    return polar


def strongest_points(
    polar: Polar, grid: RadarGrid, rate: float, *, is_axis_up: bool = False
) -> Float[np.ndarray, "N 11"]:
    """Returns the points of an `rpc` file from a `polar3d` array.

    Args:
        polar: Mean power and mean Doppler.
        grid: Axes of the radar.
        rate: Fraction of the cells that become points, above 0 and below 1.
        is_axis_up: See `points_of_bins`.
    """
    power, doppler = polar
    bins = np.nonzero(power > np.quantile(power, 1 - rate))
    return points_of_bins(bins, power[bins], doppler[bins], grid, is_axis_up=is_axis_up)


def to_polar(frame: Real[np.ndarray, "..."], grid: RadarGrid, name: str) -> Polar:
    """Converts the data of one `polar3d` or `rpc` file to a `polar3d` array.

    Cells without a point have no power. Points `[N, 5]` at range 0 are left out.

    Raises:
        DataError: As for `project_reduced`.
    """
    project_reduced(frame, grid, name)  # checks the values
    if frame.ndim > 2:
        return frame
    frame = _with_direction(frame)
    polar = np.zeros(polar_shape(grid))
    r, a, e = _bins_of_points(frame, grid, name)
    polar[:, r, a, e] = frame[:, 3:5].T
    return polar


def _with_direction(frame: Real[np.ndarray, "..."]) -> Real[np.ndarray, "..."]:
    """Returns the data without points `[N, 5]` whose range is 0."""
    is_short = frame.ndim == 2 and frame.shape[1] == 5
    return frame[frame[:, :3].any(axis=1)] if is_short else frame


def points_of_bins(
    bins: tuple[Indices, ...],
    power: Float[np.ndarray, " N"],
    doppler_mps: Float[np.ndarray, " N"],
    grid: RadarGrid,
    *,
    is_axis_up: bool = False,
) -> Float[np.ndarray, "N 11"]:
    """Returns points in the columns of an `rpc` file.

    Args:
        bins: Range, azimuth and elevation bins.
        power: Power in `POWER_UNIT`.
        doppler_mps: Doppler velocity.
        grid: Axes of the radar. Without elevation bins, the elevation is 0.
        is_axis_up: Whether the elevation axis points up, as in simulated data. K-Radar's
            code takes that of its tensors to point down and negates it.
    """
    x, y, z, *angles = _points_at(bins, grid, is_axis_up)
    return np.stack([x, y, z, power, doppler_mps, *angles, *bins], axis=1)


def _points_at(
    bins: Sequence[Indices] | np.ndarray, grid: RadarGrid, is_axis_up: bool = False
) -> Float[np.ndarray, "6 N"]:
    """Returns x, y, z, range, azimuth and elevation of bins, in the signs of points."""
    r = grid.range_m[bins[0]]
    azimuth = -grid.azimuth_rad[bins[1]]
    elevation = np.zeros(r.shape)
    if grid.num_elevation:
        elevation = grid.elevation_rad[bins[2]] * (1 if is_axis_up else -1)
    ground = r * np.cos(elevation)
    xyz = ground * np.cos(azimuth), ground * np.sin(azimuth), r * np.sin(elevation)
    return np.stack([*xyz, r, azimuth, elevation])


def _bins_of_points(
    points: Float[np.ndarray, "N _"], grid: RadarGrid, name: str
) -> tuple[Indices, ...]:
    """Returns range, azimuth and elevation bins, from their columns or from x, y, z."""
    x, y, z = xyz = points[:, :3].T
    axes = grid.range_m, grid.azimuth_rad, grid.elevation_rad
    sizes = np.reshape([axis.size for axis in axes], (3, 1))
    stored = points[:, 8:].T
    if points.shape[1] == 5:
        ground = np.hypot(x, y)
        polar = np.hypot(ground, z), -np.arctan2(y, x), -np.arctan2(z, ground)
        pairs = zip(polar, axes, strict=True)
        places = [np.interp(v, axis, np.arange(axis.size)) for v, axis in pairs]
        stored = np.rint(places)
    # NaN becomes bin 0. Then, as for bins outside the grid, the position is another one.
    bins = np.nan_to_num(np.clip(stored, 0, sizes - 1)).astype(np.intp)
    expected = _points_at(bins, grid)[:3]
    expected[2] = np.copysign(expected[2], z)  # the axis may point up or down
    is_far = ~(np.abs(expected - xyz) <= np.diff(axes[0]).min() / 2)
    if (is_wrong := is_far.any(axis=0) | (bins != stored).any(axis=0)).any():
        row = int(is_wrong.argmax())
        raise DataError(
            f"{name}: point {row} has x, y, z = {xyz[:, row].round(2).tolist()} m and bins "
            f"{stored[:, row].tolist()}, which is not a point on the radar's "
            f"grid of {' x '.join(map(str, sizes.ravel()))} bins (range, azimuth, elevation)"
        )
    return tuple(bins)


def check_layout(frame: Real[np.ndarray, "..."], grid: RadarGrid, name: str) -> None:
    """Raises a `DataError` unless shape and type are those of a reduced release."""
    columns = frame.shape[1] if frame.ndim == 2 and len(frame) else None
    if columns == 4:
        raise DataError(f"{name}: {UNUSABLE_POINTS}")
    is_known = columns in (5, 11) or frame.shape == polar_shape(grid)
    if not is_known or frame.dtype.kind != "f" or frame.dtype.itemsize < 4:
        raise DataError(
            f"{name}: shape {frame.shape} of {frame.dtype}, expected float64 or float32 "
            "[power and Doppler, range, azimuth, elevation] = "
            f"{polar_shape(grid)}, or points [N, 11] or [N, 5]"
        )


def _check_power(power: Float[np.ndarray, "..."], name: str) -> None:
    """Raises a `DataError` if powers are not on the scale of the releases."""
    low = float(power.min())
    high = float(power.max())
    share = 0.0 if low else np.mean(power == 0)
    # Powers of all cells differ by more than a factor of 2, logarithms of them by less.
    is_whole = power.ndim == 3 and power.size > 1_000
    is_log = 0 < low <= high < 2 * low
    is_log &= is_whole or _MIN_DECIBELS < low < _MAX_DECIBELS
    if not 0 <= low <= high <= _MAX_POWER or is_log or share > MAX_ZERO_SHARE:
        raise DataError(
            f"{name}: powers from {low:.3g} to {high:.3g}, {share:.0%} of them 0; expected "
            f"linear power (not decibels) divided by {POWER_UNIT:g}, at most 5 % of them 0"
        )
