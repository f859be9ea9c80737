"""From point scatterers to the 4D radar tensor, or straight to its projections.

A frame is a set of point scatterers with complex amplitudes. Every axis of the sensor
answers to a point with the Fourier transform of its window (equation (1) of RADE-Net),
the responses add as complex numbers, receiver noise joins them, and the tensor is the
squared magnitude. One range row is one matrix product, (Doppler x elevation) by
scatterers by azimuth; rows are made one after another, so that the projections of a
full-size frame never need its 260 MB tensor in memory.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jaxtyping import Float, UInt32

from radejax.core.errors import check_options, integer, number
from radejax.core.structures import Array
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB, POWER_FLOOR
from radejax.geometry.radar_grid import RadarGrid

TESSERACT_OF_ROWS = (2, 0, 1, 3)
"""Axes of a tesseract `[D, R, E, A]` in the array of rows `[R, E, D, A]`."""


_RANGES = {
    "gain_db": number(-1e3, 1e3),
    "noise_db": number(-1e3, 1e3),
    "wavelength_m": number(1e-4, 1),
    "azimuth_elements": number(1, 512),
    "elevation_elements": number(1, 512),
    "array_pedestal": number(0, 1),
    "range_resolution_m": number(0, 100),
    "pattern_exponent": number(0, 100),
    "max_scatterers_per_row": integer(1, 4096),
}


@dataclasses.dataclass(frozen=True)
class RadarParameters:
    """Parameters of the sensor except its axes; hashable, so static under `jax.jit`.

    K-Radar publishes no link budget. The level is set so that the noise lies
    near the middle of the TPM's normalized scale and a car at 5 m near its upper end.

    Attributes:
        gain_db: Received power in dB of 0 dBsm at 1 m on boresight.
        noise_db: Mean noise power per cell in dB.
        wavelength_m: Carrier wavelength; 77 GHz.
        azimuth_elements: Length of the virtual array in half wavelengths, azimuth.
        elevation_elements: The same for elevation.
        array_pedestal: Taper of the array between Hann (0) and uniform (1).
        range_resolution_m: Width of a range bin of the FFT; 0 means the grid's step.
        pattern_exponent: Two-way antenna gain is `cos(angle) ** exponent`.
        max_scatterers_per_row: Scatterers summed in one range row, the strongest
            ones; what lies below them is dropped.

    Raises:
        UserError: A value is out of its range.
    """

    gain_db: float = 178.0
    noise_db: float = 95.0
    wavelength_m: float = 0.0039
    azimuth_elements: float = 48.0
    elevation_elements: float = 16.0
    array_pedestal: float = 0.2
    range_resolution_m: float = 0.0
    pattern_exponent: float = 3.0
    max_scatterers_per_row: int = 96

    def __post_init__(self) -> None:
        check_options(vars(self), "config.simulation.radar", _RANGES)


class Scatterers(struct.PyTreeNode):
    """Point targets of one frame as the radar sees them; a JAX pytree.

    Attributes:
        range_m: Distance from the radar.
        azimuth_rad: Positive to the right.
        elevation_rad: Positive upward.
        velocity_mps: Rate of change of range, not aliased.
        amplitude: float32 real and imaginary part; power is the sum of squares. Zero for
            padding.
    """

    # Any leaf passes: trees of arrays are rebuilt from shapes, specs or None as well.
    range_m: Float[Array, " S"]
    azimuth_rad: Float[Array, " S"]
    elevation_rad: Float[Array, " S"]
    velocity_mps: Float[Array, " S"]
    amplitude: Float[Array, "S 2"]


def window_response(
    x: Float[Array, "*bins"], pedestal: float, num_samples: float = 0.0
) -> Float[jax.Array, "*bins"]:
    """Zero-phase transform of a raised cosine on a pedestal, 1 at its peak.

    With D the transform of the uniform window (the Dirichlet kernel of `num_samples`
    samples, or sinc), the window `p + (1 - p) cos^2` transforms to a sum of three:
    `D(x) + b / a (D(x - 1) + D(x + 1))`, a = p + (1 - p) / 2, b = (1 - p) / 4.
    Pedestal 0 is the Hann window: first sidelobe -31.5 dB, zeros from 2 bins on.

    Args:
        x: Distance from the peak in bins (cells of the unpadded FFT).
        pedestal: p, in [0, 1]; 1 is the uniform window.
        num_samples: Period in bins for axes that wrap around; 0 means no period.

    Returns:
        Real amplitudes.
    """

    def dirichlet(t: Float[Array, "*bins"]) -> Float[jax.Array, "*bins"]:
        if not num_samples:
            return jnp.sinc(t)
        small = jnp.sin(jnp.pi * t / num_samples)
        is_peak = jnp.abs(small) < 1e-6
        ratio = jnp.sin(jnp.pi * t) / jnp.where(is_peak, 1.0, num_samples * small)
        return jnp.where(is_peak, 1.0, ratio)

    if num_samples:  # one period around the peak, where an even kernel is continuous
        x = x - num_samples * jnp.round(x / num_samples)
    center = pedestal + (1.0 - pedestal) / 2.0
    side = (1.0 - pedestal) / 4.0
    return dirichlet(x) + side / center * (dirichlet(x - 1.0) + dirichlet(x + 1.0))


def doppler_response(
    velocity_mps: Float[Array, " S"], grid: RadarGrid
) -> Float[jax.Array, "D S"]:
    """Amplitudes on the Doppler axis; velocities alias by its period."""
    step = float(grid.doppler_mps[1] - grid.doppler_mps[0])
    cell = (velocity_mps[None] - grid.doppler_mps[0]) / step
    offset = np.arange(grid.num_doppler, dtype=np.float32)[:, None] - cell
    return window_response(offset, 0.0, float(grid.num_doppler))


def range_response(
    range_m: Float[Array, " S"], grid: RadarGrid, parameters: RadarParameters
) -> Float[jax.Array, "R S"]:
    """Amplitudes on the range axis."""
    resolution = parameters.range_resolution_m or grid.range_step_m
    axis = grid.range_m.astype(np.float32)[:, None]
    return window_response((axis - range_m[None]) / resolution, 0.0)


@functools.partial(jax.jit, static_argnames=("grid", "parameters", "output"))
def simulate(
    scatterers: Scatterers,
    noise_power: Float[Array, "R D"],
    key: UInt32[Array, "2"],
    *,
    grid: RadarGrid,
    parameters: RadarParameters = RadarParameters(),
    output: Literal["rows", "projection"] = "projection",
) -> Float[jax.Array, "..."]:
    """One radar frame, jitted; map it over frames with `jax.vmap`.

    Args:
        scatterers: Point targets; pad with zero amplitude.
        noise_power: Mean power of noise (and of weather's backscatter, which
            has the same statistics); zero for none.
        key: Seed of the noise of this frame.
        grid: Axes of the tensor.
        parameters: The sensor.
        output: "rows" for linear power `[R, E, D, A]`, a tensor in the order in which it
            is computed (see `TESSERACT_OF_ROWS`); "projection" for `[R, A, D+E]`
            normalized projections, the values that `radejax.data.projection` makes of
            the tensor.

    Returns:
        float32 array as `output` says.
    """
    pedestal = parameters.array_pedestal
    arrays = (
        (grid.elevation_rad, scatterers.elevation_rad, parameters.elevation_elements),
        (grid.azimuth_rad, scatterers.azimuth_rad, parameters.azimuth_elements),
    )
    bases = [array_basis(axis, n, pedestal) for axis, _, n in arrays]
    elevation, azimuth = (  # [M, S], [N, S]
        array_signal(angle, n, pedestal) for _, angle, n in arrays
    )
    doppler = doppler_response(scatterers.velocity_mps, grid)  # [D, S]
    in_range = range_response(scatterers.range_m, grid, parameters)  # [R, S]
    magnitude = jnp.linalg.norm(scatterers.amplitude, axis=-1)
    num_kept = min(parameters.max_scatterers_per_row, magnitude.shape[0])
    _, kept = lax.top_k(jnp.abs(in_range) * magnitude[None], num_kept)  # [R, K]

    def row(inputs):
        index, weight, noise, row_idx = inputs
        amplitude = scatterers.amplitude[index] * weight[index][:, None]  # [K, 2]
        left = doppler[:, None, index] * elevation[None, :, index]
        right = jnp.concatenate(
            [azimuth[:, index].T * amplitude[:, i : i + 1] for i in (0, 1)], axis=1
        )  # [K, 2 N]
        received = _product(left.reshape(-1, num_kept), right)
        received += _noise(noise, key, row_idx, received.size).reshape(received.shape)
        power = jnp.square(_beams(received, *bases)).sum(axis=2)  # [E, D, A]
        return _project_row(power) if output == "projection" else power

    rows = (kept, in_range, noise_power, jnp.arange(grid.num_range, dtype=jnp.uint32))

    one_by_one = functools.partial(lax.map, row)
    in_batches = functools.partial(lax.map, row, batch_size=64)
    return lax.platform_dependent(rows, cpu=one_by_one, default=in_batches)


def _project_row(power: Float[jax.Array, "E D A"]) -> Float[jax.Array, "A D+E"]:
    """Normalized maxima of one range row."""
    maxima = jnp.concatenate([power.max(axis=0), power.max(axis=1)], axis=0).T
    return (10.0 * jnp.log10(maxima + POWER_FLOOR) + LOG_OFFSET_DB) / LOG_SCALE_DB


def array_basis(
    axis_rad: Float[np.ndarray, " bins"], elements: float, pedestal: float
) -> Float[np.ndarray, "bins N"]:
    """Real matrix B that makes array bins of what the array's elements receive.

    A bin is the sum of the N elements with weights `w_n` and the phases of its angle; with
    elements placed about zero, those of a pair are a column
    `w_n cos(pi n sin a)` and one with the sine. Rows have length 1: of independent noise
    every bin has the power of one column, and two bins correlate by
    `sum_n w_n^2 cos(pi n (sin a - sin b))`.
    """
    place, weight = _pairs(elements, pedestal)
    turn = np.pi * np.sin(axis_rad)[:, None] * place
    basis = np.concatenate(
        [weight * np.cos(turn), (weight * np.sin(turn))[:, place > 0]], axis=1
    )
    return (basis / np.linalg.norm(basis, axis=1, keepdims=True)).astype(np.float32)


def array_signal(
    angle_rad: Float[Array, " S"], elements: float, pedestal: float
) -> Float[jax.Array, "N S"]:
    """What the columns of `array_basis` receive of points, 1 in the bin at their angle.

    The product of both is the pattern of the array with weights `w_n`, which depends on
    the difference of sines: beams widen away from boresight.
    """
    place, weight = _pairs(elements, pedestal)
    turn = jnp.pi * place.astype(np.float32)[:, None] * jnp.sin(angle_rad)[None]
    both = jnp.concatenate([jnp.cos(turn), jnp.sin(turn)[place > 0]])
    pairs = np.where(place > 0, 1.0, np.sqrt(0.5))  # the middle element has no partner
    scale = np.concatenate([pairs, pairs[place > 0]]) * (
        np.linalg.norm(weight) / np.sum(weight * pairs)
    )
    return scale.astype(np.float32)[:, None] * both


def _pairs(
    elements: float, pedestal: float
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Places in half wavelengths and weights of one element of each pair."""
    count = max(round(elements), 1)
    place = np.arange(count) - (count - 1) / 2
    place = place[place >= 0]
    weight = pedestal + (1.0 - pedestal) * np.cos(np.pi * place / count) ** 2
    return place, np.where(place > 0, weight, weight / np.sqrt(2.0))


def _beams(
    received: Float[jax.Array, "DM N2"],
    elevation_basis: Float[np.ndarray, "E M"],
    azimuth_basis: Float[np.ndarray, "A N"],
) -> Float[jax.Array, "E D 2 A"]:
    """Real and imaginary part of every bin, of what both arrays receive."""
    (num_elevation, m), (_, n) = elevation_basis.shape, azimuth_basis.shape
    rows = _product(received.reshape(-1, n), azimuth_basis.T)  # [D M 2, A]
    rows = rows.reshape(received.shape[0] // m, m, -1).transpose(1, 0, 2)
    beams = _product(elevation_basis, rows.reshape(m, -1))
    return beams.reshape(num_elevation, rows.shape[1], 2, -1)


_product = functools.partial(jnp.dot, precision=lax.Precision.HIGHEST)
"""Weak echoes beside strong ones: 80 dB of power are 1e-4 of the amplitude."""


def _noise(
    power: Float[jax.Array, " D"],
    key: UInt32[Array, "2"],
    row_idx: UInt32[jax.Array, ""],
    count: int,
) -> Float[jax.Array, "D columns"]:
    """Complex Gaussian noise of one range row of a mean power, as the arrays receive it.

    White noise of every Doppler bin and pair of elements goes through the Hann window
    of the Doppler axis (in bins: 1/2, 1, 1/2).
    """
    num_doppler = power.shape[0]
    one = np.eye(num_doppler, dtype=np.float32)
    window = one + 0.5 * (np.roll(one, 1, axis=0) + np.roll(one, -1, axis=0))
    window = window / np.linalg.norm(window, axis=1, keepdims=True)
    white = _white_noise(count, key, row_idx)
    return (jnp.sqrt(power)[:, None] * window) @ white.reshape(num_doppler, -1)


def _white_noise(
    count: int, key: UInt32[Array, "2"], row_idx: UInt32[jax.Array, ""]
) -> Float[jax.Array, " {count}"]:
    """Independent Gaussian numbers of mean square 1/2.

    Neighbors are the real and imaginary part of one complex number, made of one
    32-bit number: 20 bits for its power, which is exponential, 12 for its phase.
    """
    counter = lax.iota(jnp.uint32, count)
    row_key = _hash(row_idx * jnp.uint32(0x9E3779B9) + key[0], key[1])
    bits = _hash((counter >> 1) + row_key, _hash(row_key, key[1]))
    uniform = ((bits >> 12).astype(jnp.float32) + 0.5) * np.float32(2.0**-20)
    quarter = (counter & 1) << 10
    return jnp.sqrt(-jnp.log(uniform)) * _sine_of_turn(bits + quarter)


def _sine_of_turn(bits: UInt32[jax.Array, "*all"]) -> Float[jax.Array, "*all"]:
    """Sine of the angle whose 4096th parts of a turn are the 12 lowest bits.

    Two parabolas, wrong by 0.1 % at most: ample for noise, and the library's sine would
    take most of the simulator's time.
    """
    half_turns = (bits & 0xFFF).astype(jnp.float32) * np.float32(2.0**-11) - 1.0
    rough = 4.0 * half_turns * (jnp.abs(half_turns) - 1.0)
    return rough * (0.775 + 0.225 * jnp.abs(rough))


def _hash(
    x: UInt32[jax.Array, "*all"], key: UInt32[Array, ""]
) -> UInt32[jax.Array, "*all"]:
    """A 32-bit integer hash of a number under a key (multiply and xor-shift).

    Cheaper than threefry by far, and the same bits on every platform. The key enters
    between the rounds, so that counters under two keys are not shifted copies.
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = x ^ key
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def frame_key(*numbers: int) -> UInt32[np.ndarray, "2"]:
    """Noise key of a frame from any integers, well mixed."""
    return np.random.SeedSequence([n & 0xFFFFFFFF for n in numbers]).generate_state(2)
