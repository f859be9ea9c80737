"""Tensor max projection of a 4D tesseract to the input of the networks.

The released formula takes the logarithm of every cell and then two maxima. The
logarithm is monotonic, so the maxima can be taken first, which needs 101 logarithms per
range-azimuth bin instead of 64 x 37. The projection is then one pass over the tensor,
which reads each cell from memory only once if it follows the tensor's memory order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Literal, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Real

from radejax.core.errors import DataError, UserError, require
from radejax.core.structures import to_float
from radejax.geometry.boxes import ArrayT, array_module

POWER_FLOOR = 1e-10
LOG_OFFSET_DB = 1.2
LOG_SCALE_DB = 184.3
"""A level is (10 log10(power + POWER_FLOOR) + LOG_OFFSET_DB) / LOG_SCALE_DB."""

MIN_LEVEL = -0.54
MAX_LEVEL = 17.0
"""Bounds on a level; any power in float64 is between them."""

MAX_ZERO_SHARE = 0.05
"""Largest fraction of exact zeros, which noise never gives, in data of a radar."""

Unit = Literal["power", "averaged_power", "amplitude", "db"]

_NOISE_RISES_DB = {
    "power": (3.3, 4.9, "'amplitude', or 'averaged_power'"),
    "amplitude": (12.0, 20.0, "'power'"),
}
"""Rises of the noise, 8.2 dB if the unit is right, that are those of another unit."""

_MAX_DECIBELS = 300.0
_DECIBEL_LEVEL = (10 * math.log10(_MAX_DECIBELS) + LOG_OFFSET_DB) / LOG_SCALE_DB
_UNIT_LEVEL = LOG_OFFSET_DB / LOG_SCALE_DB
_LOWEST_LEVEL = (10 * math.log10(2 * POWER_FLOOR) + LOG_OFFSET_DB) / LOG_SCALE_DB
_SAME_LEVEL = 1e-6  # rounding of a level


def project_tensor(
    tesseract: Real[np.ndarray, "D R E A"],
) -> Float[np.ndarray, "R A D+E"]:
    """Computes the tensor max projection of a 4D radar tensor in one pass over memory.

    The channels are the maximum over elevation for every Doppler bin, followed by the
    maximum over Doppler for every elevation bin, both on a normalized logarithmic scale:
    p = (10 log10(power + 1e-10) + 1.2) / 184.3.

    Args:
        tesseract: Linear power of any real dtype and memory order. Column-major (as
            `scipy.io.loadmat` returns it) and C-contiguous arrays are the fastest.

    Returns:
        The float32 projection. The logarithm is computed in float64 for float64 input.

    Raises:
        UserError: The tesseract is not real or does not have four axes of at least one
            bin.

    References:
        RADE-Net paper, section III-A; the constants are from the released
        create_projections.py.

    Examples:
        >>> project_tensor(np.ones((8, 16, 5, 12), np.float32)).shape
        (16, 12, 13)
    """
    tesseract = np.asarray(tesseract)
    if tesseract.ndim != 4 or 0 in tesseract.shape or tesseract.dtype.kind not in "fiu":
        raise UserError(
            "a tesseract is a real array [Doppler, range, elevation, azimuth], got "
            f"shape {tesseract.shape} of {tesseract.dtype}"
        )
    is_double = tesseract.dtype.type is np.float64
    tesseract = tesseract.astype(np.float64 if is_double else np.float32, copy=False)
    if tesseract.T.flags.c_contiguous:
        return project_columns(tesseract.T, tesseract.shape)
    projection = _empty(tesseract.shape)
    for row, out in zip(tesseract.swapaxes(0, 1), projection, strict=True):
        _project_slab(row, _row_maxima, out)
    return projection


def project_columns(
    columns: Iterable[Float[np.ndarray, "E R D"]], shape_drea: tuple[int, ...]
) -> Float[np.ndarray, "R A DE"]:
    """Computes `project_tensor` of a tesseract that is passed as slabs of one azimuth.

    Files store tesseracts in this order.

    Args:
        columns: C-contiguous slabs of linear power, one for every azimuth. All slabs may
            use the same buffer, as each is processed before the next is requested.
        shape_drea: Shape of the whole tesseract.
    """
    projection = _empty(shape_drea)
    for column, out in zip(columns, projection.swapaxes(0, 1), strict=True):
        _project_slab(column, _column_maxima, out)
    return projection


def _empty(shape_drea: tuple[int, ...]) -> Float[np.ndarray, "R A DE"]:
    doppler, range_, elevation, azimuth = shape_drea
    return np.empty((range_, azimuth, doppler + elevation), np.float32)


def _project_slab(
    slab: Float[np.ndarray, "_ _ _"],
    reduce: Callable[[np.ndarray], np.ndarray],
    out: Float[np.ndarray, "_ DE"],
) -> None:
    """Writes the projection of one azimuth or one range into `out`.

    It is computed in the precision of the slab. Non-negative floats have the same order
    as the unsigned integers with the same bits. NumPy reduces integers twice as fast,
    because it does not need to handle NaN; a positive NaN is the largest value in both
    cases. Power has no sign bit. If a slab has one nevertheless, the integer maximum has
    it too, and the slab is reduced again as floats; bins with a negative cell are NaN, as
    the logarithm of that cell.
    """
    unsigned = np.dtype(f"u{slab.dtype.itemsize}")
    power = reduce(slab.view(unsigned))
    if power.max() >> (8 * unsigned.itemsize - 1):
        power = reduce(np.where(slab < 0, slab.dtype.type(np.nan), slab))
    to_log_scale(power.view(slab.dtype), out)


def _column_maxima(column: Real[np.ndarray, "E R D"]) -> Real[np.ndarray, "R D+E"]:
    """Returns the maxima of one azimuth, given as a C-contiguous slab."""
    elevation, range_, doppler = column.shape
    maxima = np.empty((range_, doppler + elevation), column.dtype)
    # For many short contiguous rows reduceat has a fraction of reduce's overhead.
    rows = column.reshape(elevation, -1)
    starts = np.arange(range_) * doppler
    np.maximum.reduceat(rows, starts, axis=1, out=maxima[:, doppler:].T)
    # Reversed order, because the elevations that were read last are still in the cache.
    maxima[:, :doppler] = column[::-1].max(axis=0)
    return maxima


def _row_maxima(row: Real[np.ndarray, "D E A"]) -> Real[np.ndarray, "A D+E"]:
    """Returns the maxima of one range, given as a slab in any memory order."""
    return np.concatenate([row.max(axis=1).T, row.max(axis=0).T], axis=-1)


def to_log_scale(
    power: Float[np.ndarray, "*cells"], out: Float[np.ndarray, "*cells"] | None = None
) -> Float[np.ndarray, "*cells"]:
    """Converts linear power to the normalized decibels of the network input."""
    level: np.ndarray = np.log10(power + power.dtype.type(POWER_FLOOR))
    level *= 10.0 / LOG_SCALE_DB
    scaled: np.ndarray = np.add(level, LOG_OFFSET_DB / LOG_SCALE_DB, out=out)
    return scaled


def linear_power(
    values: Real[np.ndarray, "*cells"],
    unit: Unit,
    source: object,
    *,
    db_per_step: float = 0.0,
    range_axis: int = 0,
) -> Float[np.ndarray, "*cells"]:
    """Converts the radar data of a reader to linear power and checks that they have its unit.

    Args:
        values: All bins of a frame, before maxima over an axis.
        unit: "power"; "averaged_power" for means of several looks; "amplitude"; or "db" of
            power.
        source: File, or another text that begins the message of an error.
        db_per_step: Decibels per step of values of 8 bits, whose unit is "db".
        range_axis: Axis of the ranges.

    Returns:
        float32 power.

    Raises:
        DataError: The values cannot have the unit. Noise shows whether values are amplitudes:
            from its 10 % to its 50 % quantile at a range, power rises by 8.2 dB and amplitude
            by 4.1 dB. Means of several looks rise less, so they are not compared.
        UserError: There is no such unit.
    """
    units = get_args(Unit)
    require(unit in units, "unit", unit, " or ".join(units))
    scaled = np.asarray(values, np.float32)
    lowest = float(scaled.min())
    is_raw = (
        not db_per_step and 1 < scaled.max() < 256 and (scaled == np.rint(scaled)).all()
    )
    with np.errstate(over="ignore", invalid="ignore"):
        if unit == "db":
            scaled = 10.0 ** (scaled * np.float32(0.1 * (db_per_step or 1.0)))
            lowest = min(float(scaled.min()), 1.0)
        power = np.square(scaled) if unit == "amplitude" else scaled
        levels = to_log_scale(power)
    problem = find_problem(levels.max(axis=range_axis), lowest)
    if is_raw:
        problem = "all values are integers below 256, as raw counts: give db_per_step"
    elif problem is None and unit in _NOISE_RISES_DB:
        rows = np.moveaxis(levels, range_axis, 0).reshape(levels.shape[range_axis], -1)
        steps = -(-rows.shape[0] // 64), -(-rows.shape[1] // 4096)
        tenth, half = np.quantile(rows[:: steps[0], :: steps[1]], (0.1, 0.5), axis=1)
        rise_db = float(np.median(half - tenth)) * LOG_SCALE_DB
        low, high, other = _NOISE_RISES_DB[unit]
        if low < rise_db < high:
            problem = (
                f"noise rises by {rise_db:.1f} dB from its 10 % to its 50 % quantile, "
            )
            problem += f"as if values were {other}"
    if problem:
        raise DataError(f"{source}, read as {unit!r}: {problem}")
    return power


PROBLEMS = (
    "some values are negative, infinite or NaN",
    f"more than {MAX_ZERO_SHARE:.0%} of the beams have a power of exactly 0 at every range",
    "all values are the same",
    f"all values are between 1 and {_MAX_DECIBELS:g}, as in decibels",
)
"""Reasons why values cannot be linear power, in the order of `find_problems`."""


def find_problems(
    beams: Float[ArrayT, "*B _ _"], lowest: Float[ArrayT, "*B"]
) -> tuple[Bool[ArrayT, "*B"], ...]:
    """Finds frames whose values cannot come from linear power.

    A tensor is taken to be in decibels if all its cells are above 1 and at most 300: in
    linear power, noise has a wider range, with cells below 1.

    Args:
        beams: Levels, as in a projection, of the strongest cell of every beam: for every
            elevation or channel, and azimuth. NumPy arrays, or JAX arrays in a program.
        lowest: Level of the weakest cell, or of that of a large part of the frame. NaN if
            any value of the frame is no level.

    Returns:
        For each of `PROBLEMS`, a mask that is True for the frames that have it.
    """
    highest = beams.max((-2, -1))
    is_level = (lowest >= MIN_LEVEL) & (beams <= MAX_LEVEL).all((-2, -1))
    is_empty = (beams < _LOWEST_LEVEL).mean((-2, -1)) > MAX_ZERO_SHARE
    is_constant = highest <= lowest + _SAME_LEVEL
    is_decibels = (lowest > _UNIT_LEVEL) & (highest <= _DECIBEL_LEVEL)
    return ~is_level, is_empty, is_constant, is_decibels


def find_problem(beams: Float[np.ndarray, "..."], lowest_power: float) -> str | None:
    """Describes why values cannot come from linear power; returns None if they can.

    Args:
        beams: See `find_problems`.
        lowest_power: Power of the weakest cell of the tensor, or of a large part of it.
    """
    lowest = np.array([np.nan])
    if lowest_power >= 0:
        lowest = to_log_scale(np.array([lowest_power]))
    found = find_problems(beams.reshape(1, 1, -1), lowest)
    return next((text for text, x in zip(PROBLEMS, found, strict=True) if x[0]), None)


@jax.jit
def project_jax(
    tesseract: Real[jax.Array, "*frames D R E A"],
) -> Float[jax.Array, "*frames R A D+E"]:
    """Computes `project_tensor` in float32 on an accelerator.

    The leading axes are frames. The function is jit-compiled.
    """
    chex.assert_axis_dimension_gteq(tesseract, -4, 1)
    over_elevation = jnp.moveaxis(tesseract.max(axis=-2), -3, -1)  # [..., R, A, D]
    over_doppler = tesseract.max(axis=-4).swapaxes(-1, -2)  # [..., R, A, E]
    power = jnp.concatenate([over_elevation, over_doppler], axis=-1)
    return _levels(power)


def _levels(power: Real[jax.Array, "*cells"]) -> Float[jax.Array, "*cells"]:
    level = jnp.log10(power.astype(jnp.float32) + POWER_FLOOR)
    return level * (10.0 / LOG_SCALE_DB) + LOG_OFFSET_DB / LOG_SCALE_DB


def find_invalid(
    frames: Real[jax.Array, "..."], *, are_tensors: bool
) -> tuple[Bool[jax.Array, "..."], ...]:
    """Finds frames with `PROBLEMS` in JAX; detectors and exported programs use it.

    Args:
        frames: `[..., R, A, D+E]` projections as they are stored, or `[..., D, R, E, A]`
            tensors of linear power.
        are_tensors: Whether the frames are tensors.
    """
    axes = (-4, -3, -2, -1) if are_tensors else (-3, -2, -1)
    # On a CPU, the compiler's minimum and maximum can ignore NaN; comparisons do not.
    if are_tensors:
        is_valid = (frames >= 0).all(axes)
        beams, lowest = _levels(frames.max((-4, -3))), _levels(frames.min(axes))
    else:
        frames = to_float(frames)
        is_valid = (frames >= MIN_LEVEL).all(axes)
        beams, lowest = frames.max(-3), frames.min(axes)
    return find_problems(beams, jnp.where(is_valid, lowest, jnp.nan))


# Storage and network input --------------------------------------------------------


def stack_frames(
    frames: Sequence[Real[np.ndarray, "*axes DE"]], num_doppler: int
) -> Real[np.ndarray, "*axes C"]:
    """Concatenates the channels of consecutive frames to the input of a network.

    Args:
        frames: Projections of one or several frames, oldest first.
        num_doppler: Number of their Doppler channels.

    Returns:
        The Doppler channels of all frames, then their elevation channels. A single frame
        is returned unchanged.
    """
    if len(frames) == 1:
        return frames[0]
    doppler = [frame[..., :num_doppler] for frame in frames]
    elevation = [frame[..., num_doppler:] for frame in frames]
    return np.concatenate([*doppler, *elevation], axis=-1)


def unstack_frames(
    stacked: Real[ArrayT, "*axes R A C"], num_frames: int, num_doppler: int
) -> Real[ArrayT, "*axes T R A DE"]:
    """Separates the frames of `stack_frames`.

    Args:
        stacked: Input of a network of consecutive frames.
        num_frames: Number T of frames.
        num_doppler: Number of Doppler channels of one frame.
    """
    xp = array_module(stacked)
    parts = [
        part.reshape(*part.shape[:-1], num_frames, part.shape[-1] // num_frames)
        for part in xp.split(stacked, [num_frames * num_doppler], axis=-1)
    ]
    frames: ArrayT = xp.moveaxis(xp.concatenate(parts, -1), -2, -4)
    return frames


ENCODINGS = ("float16", "uint8", "float32")


def encode(
    projection: Float[np.ndarray, "*axes"], encoding: str
) -> Real[np.ndarray, "*axes"]:
    """Converts a float projection to the type of the records.

    uint8 stores round(255 p) with p clipped to [0, 1]. p = 0 corresponds to a power of
    0.76, far below the noise of K-Radar, and p = 1 to 2.0e18, far above its echoes.

    Args:
        projection: Normalized log power p, see `project_tensor`.
        encoding: One of `ENCODINGS`.
    """
    if encoding == "uint8":
        levels: np.ndarray = np.clip(projection, 0.0, 1.0) * 255.0
        return levels.round().astype(np.uint8)
    return projection.astype(encoding)


def decode(stored: Real[np.ndarray, "*axes"]) -> Float[np.ndarray, "*axes"]:
    """Converts records to float32 projections on the host; inverse of `encode`.

    Args:
        stored: Values of records, of any type of `ENCODINGS`.
    """
    if stored.dtype == np.uint8:
        return stored.astype(np.float32) / np.float32(255.0)
    return stored.astype(np.float32)
