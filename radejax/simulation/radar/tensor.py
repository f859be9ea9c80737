"""Computation of the 4D radar tensor, or only its projections, from point scatterers.

A frame is a set of point scatterers with complex amplitudes. The response of every sensor
axis to a point is the Fourier transform of the axis's window (equation (1) of RADE-Net).
The complex responses are summed, receiver noise is added, and the tensor is the squared
magnitude. Each range row is a matrix product of (Doppler x elevation) by scatterers with
scatterers by azimuth. Rows are computed one after another on CPUs and in batches on
accelerators, so that computing the projections of a full-size frame does not need its
260 MB tensor in memory.
"""

from __future__ import annotations

import functools
import itertools
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from annotated_types import Ge, Le
from flax import struct
from jax import lax
from jaxtyping import Float, UInt32

from radejax.core.errors import require
from radejax.core.options import Count, Fraction, NotNegative, Options
from radejax.core.structures import Array
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB, POWER_FLOOR
from radejax.geometry.radar_grid import RadarGrid

PerTarget = Float[Array, " S"]
Bits = UInt32[jax.Array, "*all"]
White = Float[jax.Array, " count"]
Key = UInt32[Array, "2"]
Phases = Float[Array, " P"] | None
Pedestal = float | Float[Array, ""]
Output = Literal["tesseract", "projection"]

TESSERACT_OF_ROWS = (2, 0, 1, 3)
"""Permutation of the axes from rows `[R, E, D, A]` to a tesseract `[D, R, E, A]`."""


Level = Annotated[float, Ge(-1e3), Le(1e3)]
Elements = Annotated[float, Ge(1), Le(512)]

DRAWN = frozenset((
    "gain_db", "noise_db", "receiver_db", "range_profile", "high_pass_m",
    "leakage", "range_correlation", "beam_spread_db", "ground_clutter",
))  # fmt: skip
"""Fields of `RadarParameters` that can differ between sequences."""


class RadarParameters(Options, section="config.simulation.radar"):
    """Parameters of the sensor other than its axes.

    Instances are hashable and can be static arguments of `jax.jit`. K-Radar publishes no
    link budget. The defaults are those of an ideal sensor. Gain and noise are set so that
    the noise lies near the middle of the normalized scale of the tensor projection and a
    car at 5 m near its upper end. `radejax.simulation.config.PRESETS` has other sensors.
    """

    gain_db: Level = 178.0
    """Received power in dB from a target of 0 dBsm at 1 m on boresight, without the
    high-pass filter."""
    gain_doppler_bins: Count = 0
    """Number of Doppler bins for which the gain is given. Fewer bins integrate fewer chirps,
    so the gain is less; 0 for the same gain of all numbers."""
    noise_db: Level = 95.0
    """Mean noise power per cell in dB."""
    receiver_db: Annotated[float, Ge(-100), Le(100)] = 0.0
    """Gain of the receiver in dB, which amplifies echoes and noise."""
    range_profile: Annotated[float, Ge(0), Le(2)] = 0.0
    """Factor on the profile over range in dB that K-Radar's noise has: the direct leak into
    the first bins, a dip, a decay before the last bins and a rise in them. 0 for noise of
    the same power at all ranges."""
    profile_db: tuple[tuple[NotNegative, Annotated[float, Ge(-200), Le(200)]], ...] = ()
    """Range in m and noise in dB relative to `noise_db` at ascending ranges, as `fit_radar`
    estimates them; empty for the profile of K-Radar."""
    high_pass_m: Annotated[float, Ge(0), Le(1e3)] = 0.0
    """Range below which the receiver's high-pass filter attenuates echoes by 40 dB per
    decade, as much as echoes become stronger; 0 for no filter."""
    leakage: Annotated[float, Ge(0), Le(0.5)] = 0.0
    """Mean power of an echo in beams away from it, relative to its peak. It is due to phase
    errors of the array's channels. 0 for an ideal array."""
    range_correlation: Annotated[float, Ge(0), Le(4 / 9)] = 0.0
    """Correlation of the noise power in neighboring range bins. The window of the range axis
    follows from it: 4/9 is a Hann window, less a higher pedestal. 0 for a Hann window and
    independent noise."""
    beam_spread_db: Annotated[float, Ge(0), Le(3)] = 0.0
    """Standard deviation over azimuth of the beams' gain in dB."""
    ground_clutter: Fraction = 0.0
    """Mean radar cross-section of the ground and roadside in m2 per m2, whose many echoes
    have the statistics of noise."""
    wavelength_m: Annotated[float, Ge(1e-4), Le(1)] = 0.0039
    """Carrier wavelength, by default at 77 GHz."""
    azimuth_elements: Elements = 48.0
    """Number of elements of the virtual array in azimuth, at a spacing of half a
    wavelength."""
    scan_beamwidth_rad: Annotated[float, Ge(0), Le(0.5)] = 0.0
    """Half-power width of the beam of a single antenna that scans the azimuths by rotation,
    instead of an array in azimuth; 0 for an array. `pattern_exponent` is that of the whole
    rotation, so 0 for echoes all around."""
    elevation_elements: Elements = 16.0
    """Number of elements of the virtual array in elevation, at the same spacing."""
    array_pedestal: Fraction = 0.2
    """Taper of the array, from 0 (Hann window) to 1 (uniform window)."""
    doppler_pedestal: Fraction = 0.0
    """Window of the Doppler axis, likewise."""
    pattern_exponent: Annotated[float, Ge(0), Le(100)] = 3.0
    """Exponent of the two-way antenna gain `cos(angle) ** exponent`."""
    max_scatterers_per_row: Annotated[int, Ge(1), Le(4096)] = 96
    """Maximum number of scatterers summed in one range row. Only the strongest ones are
    summed."""
    ranges: tuple[tuple[str, float, float], ...] = ()
    """Name, lowest and highest value of the fields of `DRAWN` of which each sequence has its
    own value."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> RadarParameters:
        ascends = all(a[0] < b[0] for a, b in itertools.pairwise(self.profile_db))
        name = f"{self.section}.profile_db"
        require(ascends, name, self.profile_db, "ascending ranges")
        for name, low, high in self.ranges:
            for end in (low, high):
                self.replace(**{"ranges": (), name: end})
            order = "the lower number first"
            require(low <= high, f"{self.section}.{name}", (low, high), order)
        return self

    def draw(self, rng: np.random.Generator, num_doppler: int) -> RadarParameters:
        """Returns the parameters of one sequence for a number of Doppler bins.

        They are drawn uniformly from their ranges.
        """
        drawn = {name: rng.uniform(low, high) for name, low, high in self.ranges}
        if self.gain_doppler_bins:
            share = max(num_doppler, 1) / self.gain_doppler_bins
            drawn["gain_db"] = drawn.get("gain_db", self.gain_db) + 10 * np.log10(share)
        return self.replace(ranges=(), gain_doppler_bins=0, **drawn)


IDEAL = RadarParameters()


class SensorState(struct.PyTreeNode):
    """Imperfections of a sensor that last for a sequence, as a JAX pytree.

    Attributes:
        azimuth_phase_rad: Phase errors of one element of each pair of opposite elements of
            the array in azimuth. The other one has the opposite error, which leaves the
            response real and therefore needs no more computation than an ideal array.
        elevation_phase_rad: The same of the array in elevation.
        beam_gain: Gain of the amplitudes in each azimuth bin.
        range_pedestal: Pedestal of the range window that echoes pass.
        range_side: Amplitude of the two neighbors in the filter of the noise over range.
    """

    azimuth_phase_rad: Float[Array, " P"]
    elevation_phase_rad: Float[Array, " Q"]
    beam_gain: Float[Array, " A"]
    range_pedestal: Float[Array, ""]
    range_side: Float[Array, ""]


class Scatterers(struct.PyTreeNode):
    """Point targets of one frame in the polar coordinates of the radar, as a JAX pytree.

    Attributes:
        range_m: Distance from the radar.
        azimuth_rad: Azimuth, positive to the right.
        elevation_rad: Elevation, positive upward.
        velocity_mps: Rate of change of the range, not aliased.
        amplitude: float32 real and imaginary part, whose squares sum to the power. Padding
            has zero amplitude.
    """

    # Leaves are not checked, because JAX also rebuilds pytrees with shapes, specs or None.
    range_m: PerTarget
    azimuth_rad: PerTarget
    elevation_rad: PerTarget
    velocity_mps: PerTarget
    amplitude: Float[Array, "S 2"]


def window_response(
    x: Float[Array, "*bins"], pedestal: Pedestal, num_samples: float = 0.0
) -> Float[jax.Array, "*bins"]:
    """Computes the zero-phase transform of a raised cosine on a pedestal, 1 at its peak.

    Let D be the transform of the uniform window, which is the Dirichlet kernel of
    `num_samples` samples or sinc. The transform of the window `p + (1 - p) cos^2` is
    `D(x) + b / a (D(x - 1) + D(x + 1))` with a = p + (1 - p) / 2 and b = (1 - p) / 4.
    Pedestal 0 is the Hann window, whose first sidelobe is at -31.5 dB and whose zeros are
    at distances of 2 bins and more.

    Args:
        x: Distance from the peak in bins (cells of the unpadded FFT).
        pedestal: Pedestal p in [0, 1]; 1 is the uniform window.
        num_samples: Period in bins of an axis that wraps around, or 0 for no period.

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

    if num_samples:  # even kernels are continuous only within one period
        x = x - num_samples * jnp.round(x / num_samples)
    center = pedestal + (1.0 - pedestal) / 2.0
    side = (1.0 - pedestal) / 4.0
    return dirichlet(x) + side / center * (dirichlet(x - 1.0) + dirichlet(x + 1.0))


def doppler_response(
    velocity_mps: PerTarget, grid: RadarGrid, pedestal: float = 0.0
) -> Float[jax.Array, "D S"]:
    """Computes amplitudes on the Doppler axis, where velocities alias by its period.

    A single bin, as that of a radar without Doppler, receives all velocities alike.
    """
    if grid.num_doppler < 2:
        return jnp.ones((1, velocity_mps.shape[0]))
    step = float(grid.doppler_mps[1] - grid.doppler_mps[0])
    cell = (velocity_mps[None] - grid.doppler_mps[0]) / step
    offset = np.arange(grid.num_doppler, dtype=np.float32)[:, None] - cell
    return window_response(offset, pedestal, float(grid.num_doppler))


def range_response(
    range_m: PerTarget, grid: RadarGrid, pedestal: Pedestal
) -> Float[jax.Array, "R S"]:
    """Computes amplitudes on the range axis."""
    axis = grid.range_m.astype(np.float32)[:, None]
    offset = (axis - range_m[None]) / np.reshape(grid.range_widths_m, (-1, 1))
    return window_response(offset, pedestal)


def beam_response(
    azimuth_rad: PerTarget, grid: RadarGrid, beamwidth_rad: float
) -> Float[jax.Array, "A S"]:
    """Computes two-way amplitudes of a rotating antenna with a Gaussian beam."""
    axis = grid.azimuth_rad.astype(np.float32)[:, None]
    offset = jnp.mod(axis - azimuth_rad[None] + jnp.pi, 2 * jnp.pi) - jnp.pi
    return jnp.exp(-4 * np.log(2) * jnp.square(offset / beamwidth_rad))


@functools.partial(jax.jit, static_argnames=("grid", "parameters", "output"))
def simulate(
    scatterers: Scatterers,
    noise_power: Float[Array, "R D"],
    key: Key,
    state: SensorState | None = None,
    *,
    grid: RadarGrid,
    parameters: RadarParameters = IDEAL,
    output: Output = "projection",
) -> Float[jax.Array, "..."]:
    """Simulates one radar frame. The function is jitted and supports `jax.vmap`.

    Args:
        scatterers: Point targets, padded with targets of zero amplitude.
        noise_power: Mean power of the noise and of backscatter by weather, which has the
            same statistics.
        key: Random key of the noise of this frame.
        state: Imperfections of the sensor, or None for an ideal sensor.
        grid: Axes of the tensor.
        parameters: Parameters of the sensor. One without elevation sees with a single beam
            at elevation 0.
        output: "tesseract" for the rows `[R, E, D, A]` of the tensor in linear power, the
            order in which it is computed (see `TESSERACT_OF_ROWS`), or "projection" for its
            normalized projections `[R, A, D+E]`, with the same values as those of
            `radejax.data.projection`.

    Returns:
        float32 array, the tensor or its projections as selected by `output`.
    """
    pedestal = parameters.array_pedestal
    m = parameters.elevation_elements
    n = parameters.azimuth_elements
    up: Phases = None
    across: Phases = None
    of_range: Pedestal = 0.0
    if state is not None:
        up = state.elevation_phase_rad
        across = state.azimuth_phase_rad
        of_range = state.range_pedestal
    elevation_rad = grid.elevation_rad if grid.num_elevation else np.zeros(1)
    elevation_basis = array_basis(elevation_rad, m, pedestal)
    elevation = array_signal(scatterers.elevation_rad, m, pedestal, up)  # [M, S]
    scan_rad = parameters.scan_beamwidth_rad
    if scan_rad:  # every azimuth is measured alone, as by an element of its own
        azimuth_basis = np.eye(grid.num_azimuth, dtype=np.float32)
        azimuth = beam_response(scatterers.azimuth_rad, grid, scan_rad)  # [A, S]
    else:
        azimuth_basis = array_basis(grid.azimuth_rad, n, pedestal)
        azimuth = array_signal(scatterers.azimuth_rad, n, pedestal, across)  # [N, S]
    if state is not None:
        azimuth_basis = azimuth_basis * state.beam_gain[:, None]
    window = parameters.doppler_pedestal
    doppler = doppler_response(scatterers.velocity_mps, grid, window)  # [D, S]
    in_range = range_response(scatterers.range_m, grid, of_range)  # [R, S]
    magnitude = jnp.linalg.norm(scatterers.amplitude, axis=-1)
    num_kept = min(parameters.max_scatterers_per_row, magnitude.shape[0])
    _, kept = lax.top_k(jnp.abs(in_range) * magnitude[None], num_kept)  # [R, K]

    def row(inputs: tuple[jax.Array, ...]) -> Float[jax.Array, "..."]:
        index, weight, noise, row_idx = inputs
        amplitude = scatterers.amplitude[index] * weight[index][:, None]  # [K, 2]
        left = doppler[:, None, index] * elevation[None, :, index]
        right = jnp.concatenate(
            [azimuth[:, index].T * amplitude[:, i : i + 1] for i in (0, 1)], axis=1
        )  # [K, 2 N]
        received = _product(left.reshape(-1, num_kept), right)
        white = white_noise(received.size, key, row_idx)
        if state is not None:
            white = _correlate(white, state.range_side, key, row_idx)
        received += _noise(noise, white, window).reshape(received.shape)
        beams = _beams(received, elevation_basis, azimuth_basis)
        power = jnp.square(beams).sum(axis=2)  # [E, D, A]
        if output != "projection":
            return power
        maxima = jnp.concatenate([power.max(axis=0), power.max(axis=1)], axis=0).T
        levels = (10.0 * jnp.log10(maxima + POWER_FLOOR) + LOG_OFFSET_DB) / LOG_SCALE_DB
        measured: jax.Array = grid.measured_channels(levels)  # [A, D+E]
        return measured

    rows: Float[jax.Array, "..."] = lax.platform_dependent(
        (kept, in_range, noise_power, jnp.arange(grid.num_range, dtype=jnp.uint32)),
        cpu=functools.partial(lax.map, row),
        default=functools.partial(lax.map, row, batch_size=64),
    )
    return rows


def array_basis(
    axis_rad: Float[np.ndarray, " bins"], elements: float, pedestal: float
) -> Float[np.ndarray, "bins N"]:
    """Returns the real beamforming matrix from the elements of an array to its bins.

    A bin of angle a is the sum over the N elements with weights `w_n` and the phases of
    that angle. As the elements are placed symmetrically around zero, each pair of opposite
    elements gives two real columns, `w_n cos(pi n sin a)` and `w_n sin(pi n sin a)`. Rows
    are normalized to length 1. Therefore independent noise keeps its power in every bin,
    and the noise of two bins a and b has a correlation proportional to
    `sum_n w_n^2 cos(pi n (sin a - sin b))`.
    """
    place, weight = element_pairs(elements, pedestal)
    turn = np.pi * np.sin(axis_rad)[:, None] * place
    sine = (weight * np.sin(turn))[:, place > 0]
    basis = np.concatenate([weight * np.cos(turn), sine], axis=1)
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    return basis.astype(np.float32)


def array_signal(
    angle_rad: PerTarget, elements: float, pedestal: float, phase_rad: Phases = None
) -> Float[jax.Array, "N S"]:
    """Returns the signals of point targets at the inputs of `array_basis`.

    They are scaled so that a target has amplitude 1 in a bin at its angle. The product of
    `array_basis` and these signals is the pattern of the array with weights `w_n`. It
    depends on the difference of the sines of the angles, so beams widen away from
    boresight.

    With phase errors, as in `SensorState`, a part of the power leaks into all beams. The
    pattern of the leakage moves with the target. The amplitude at its angle remains 1.
    """
    place, weight = element_pairs(elements, pedestal)
    turn = jnp.pi * place.astype(np.float32)[:, None] * jnp.sin(angle_rad)[None]
    if phase_rad is not None:
        turn = turn + phase_rad[:, None]
    both = jnp.concatenate([jnp.cos(turn), jnp.sin(turn)[place > 0]])
    count = np.where(place > 0, 1.0, np.sqrt(0.5))  # the middle element has no partner
    gain = np.linalg.norm(weight) / np.sum(weight * count)
    scale = np.concatenate([count, count[place > 0]]) * gain
    signal: jax.Array = scale.astype(np.float32)[:, None] * both
    if phase_rad is not None:
        coherent = weight * count / np.sum(weight * count)
        signal = signal / jnp.sum(coherent * jnp.cos(phase_rad))
    return signal


def element_pairs(
    elements: float, pedestal: float
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Returns position in half wavelengths and weight of one element of each pair."""
    count = max(round(elements), 1)
    place = np.arange(count) - (count - 1) / 2
    place = place[place >= 0]
    weight = pedestal + (1.0 - pedestal) * np.cos(np.pi * place / count) ** 2
    return place, np.where(place > 0, weight, weight / np.sqrt(2.0))


def _beams(
    received: Float[jax.Array, "DM N2"],
    elevation_basis: Float[np.ndarray, "E M"],
    azimuth_basis: Float[Array, "A N"],
) -> Float[jax.Array, "E D 2 A"]:
    """Computes real and imaginary part of every bin from the signals of the arrays."""
    num_elevation, m = elevation_basis.shape
    # Products over the azimuth, [D M 2, A], and then over the elevation.
    rows = _product(received.reshape(-1, azimuth_basis.shape[1]), azimuth_basis.T)
    rows = rows.reshape(received.shape[0] // m, m, -1).transpose(1, 0, 2)
    beams = _product(elevation_basis, rows.reshape(m, -1))
    return beams.reshape(num_elevation, rows.shape[1], 2, -1)


_product = functools.partial(jnp.dot, precision=lax.Precision.HIGHEST)
"""Matrix product in full float32 precision, so that strong echoes do not mask weak ones."""


def _noise(
    power: Float[jax.Array, " D"], white: White, pedestal: float
) -> Float[jax.Array, "D columns"]:
    """Computes the complex Gaussian noise of one range row at the inputs of the arrays.

    White noise of every Doppler bin and pair of elements is filtered by the window of the
    Doppler axis (1/2, 1, 1/2 in bins for a Hann window) and scaled to the mean power of
    each bin.
    """
    num_doppler = power.shape[0]
    if pedestal == 1.0:  # a uniform window has no neighbors
        return jnp.sqrt(power)[:, None] * white.reshape(num_doppler, -1)
    one = np.eye(num_doppler, dtype=np.float32)
    side = 0.5 * (1.0 - pedestal) / (1.0 + pedestal)
    window = one + side * (np.roll(one, 1, axis=0) + np.roll(one, -1, axis=0))
    window = window / np.linalg.norm(window, axis=1, keepdims=True)
    scale: jax.Array = jnp.sqrt(power)[:, None] * window
    return scale @ white.reshape(num_doppler, -1)


def _correlate(
    white: White, side: Float[Array, ""], key: Key, row_idx: UInt32[jax.Array, ""]
) -> White:
    """Filters the white noise of a range row by the window of the range axis.

    The noise of the rows before and after it is generated again.
    """
    one = jnp.uint32(1)
    before = white_noise(white.size, key, row_idx - one)
    after = white_noise(white.size, key, row_idx + one)
    return (white + side * (before + after)) * lax.rsqrt(1.0 + 2.0 * side**2)


def white_noise(count: int, key: Key, row_idx: UInt32[jax.Array, ""]) -> White:
    """Generates independent Gaussian numbers with a mean square of 1/2.

    Adjacent numbers are the real and imaginary part of one complex number. It is computed
    from a random 32-bit integer, of which 20 bits determine its power, which has an
    exponential distribution, and 12 bits its phase.
    """
    counter = lax.iota(jnp.uint32, count)
    row_key = _hash(row_idx * jnp.uint32(0x9E3779B9) + key[0], key[1])
    bits = _hash((counter >> 1) + row_key, _hash(row_key, key[1]))
    uniform = ((bits >> 12).astype(jnp.float32) + 0.5) * np.float32(2.0**-20)
    quarter = (counter & 1) << 10
    return jnp.sqrt(-jnp.log(uniform)) * _sine_of_turn(bits + quarter)


def _sine_of_turn(bits: Bits) -> Float[jax.Array, "*all"]:
    """Approximates the sine of an angle given in 1/4096 turns by the 12 lowest bits.

    The approximation by two parabolas has an error of at most 0.1 %, which is sufficient
    for noise. The sine of the library would take most of the simulator's time.
    """
    half_turns = (bits & 0xFFF).astype(jnp.float32) * np.float32(2.0**-11) - 1.0
    rough = 4.0 * half_turns * (jnp.abs(half_turns) - 1.0)
    return rough * (0.775 + 0.225 * jnp.abs(rough))


def _hash(x: Bits, key: UInt32[Array, ""]) -> Bits:
    """Computes a keyed 32-bit integer hash by multiplications and xor-shifts.

    The hash is much cheaper than threefry and gives the same bits on every platform. The
    key is applied between the rounds, so that the hashes of a counter with two keys are
    not shifted copies of each other.
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x7FEB352D)
    x = x ^ key
    x = (x ^ (x >> 15)) * jnp.uint32(0x846CA68B)
    return x ^ (x >> 16)


def frame_key(*numbers: int) -> UInt32[np.ndarray, "2"]:
    """Derives the noise key of a frame from any number of integers."""
    return np.random.SeedSequence([n & 0xFFFFFFFF for n in numbers]).generate_state(2)
