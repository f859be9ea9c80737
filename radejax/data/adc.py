"""From ADC samples of an FMCW radar to power on the axes of a `RadarGrid`.

A target at range r, range rate v and direction u (a unit vector in the radar frame) gives the
sample n of the receiver q in chirp m of transmitter k the phase, in cycles,

    2 r S n / f_s + 2 v (m K + k) T / wavelength - (tx_k + rx_q) . u / wavelength

with slope S, sample rate f_s, K transmitters and chirp period T. So the frequency within a chirp
is positive and rises with range, and the phase from chirp to chirp rises while a target recedes.
This is how a receiver samples that mixes the transmitted signal with the conjugate of the
received one. If a recording has the opposite sign, use the conjugate of its samples.

Not compensated: the change of range during a frame, and the shift of range by Doppler, which is
v times the carrier over the slope.
"""

from __future__ import annotations

import functools
import math
import os
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from annotated_types import Ge, Gt, Le
from jax import lax
from jaxtyping import Complex, Float, Inexact, Num

from radejax.core.errors import DataError, UserError, require
from radejax.core.options import Fraction, Options, Positive
from radejax.core.structures import Array
from radejax.geometry.radar_grid import RadarGrid

LIGHT_MPS = 299_792_458.0

Window = Float[np.ndarray, " n"]

_MAX_SPACING = 20.0  # wavelengths; positions in wavelengths or millimeters give more


Position = tuple[float, float, float]


class FmcwRadar(Options, section="radar"):
    """Waveform, antennas and processing of an FMCW radar whose transmitters take turns (TDM).

    Instances are hashable and can be static arguments of `jax.jit`. The positions are x, y, z
    in the radar frame: forward, left and up.

    Raises:
        UserError: A value or an axis is out of its range, as in another unit.
    """

    tx_m: tuple[Position, ...]
    """Positions of the transmitters in meters, in the order in which they transmit."""
    rx_m: tuple[Position, ...]
    """Positions of the receivers in meters, in the order of the samples."""
    azimuth_rad: tuple[float, ...]
    """Azimuths to compute, positive to the right."""
    elevation_rad: tuple[float, ...] = ()
    """Elevations to compute, positive upward; empty if the antennas do not measure elevation."""
    carrier_hz: Annotated[float, Ge(1e9), Le(1e12)]
    """Frequency in the middle of the sampled part of a chirp."""
    slope_hz_per_s: Positive
    """Slope of the chirps; 30 MHz/us are 30e12."""
    sample_rate_hz: Positive
    """Rate of the ADC."""
    chirp_period_s: Annotated[float, Gt(0), Le(0.1)]
    """Time from one chirp to the next one, which is of the next transmitter."""
    num_chirps: Annotated[int, Ge(2)]
    """Number of chirps of each transmitter in a frame."""
    num_samples: Annotated[int, Ge(4)]
    """Number of samples in a chirp."""
    is_complex: bool = True
    """Whether samples are complex. Real samples give half as many ranges."""
    max_range_m: Positive = 10_000.0
    """Ranges up to this are computed."""
    range_pedestal: Fraction = 0.0
    """Window p + (1 - p) cos^2 over the samples of a chirp: 0 for a Hann window, 0.08 for a
    Hamming window, 1 for a uniform one."""
    doppler_pedestal: Fraction = 0.0
    """Window over chirps, likewise."""
    array_pedestal: Fraction = 0.2
    """Window over the extent of the virtual antennas, likewise."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> FmcwRadar:
        least_hz = self.num_samples / self.chirp_period_s
        is_within = self.sample_rate_hz >= least_hz
        text = f"at least {least_hz:g}, for num_samples within chirp_period_s"
        require(is_within, "radar.sample_rate_hz", self.sample_rate_hz, text)
        bandwidth_hz = self.slope_hz_per_s * self.num_samples / self.sample_rate_hz
        text = (
            "Hz per second (30 MHz/us are 30e12), for a sweep from 1 MHz to the carrier"
        )
        is_sweep = 1e6 <= bandwidth_hz < self.carrier_hz
        require(is_sweep, "radar.slope_hz_per_s", self.slope_hz_per_s, text)
        text = f"less than {_MAX_SPACING:g} wavelengths of {self.wavelength_m:.4g} m"
        for name in ("tx_m", "rx_m"):
            places = np.reshape(getattr(self, name), (-1, 3))
            distances_m = np.linalg.norm(places - places[:1], axis=1)
            spacing_m = float(min(distances_m[distances_m > 0], default=0.0))
            is_near = spacing_m < self.wavelength_m * _MAX_SPACING
            require(is_near, f"radar.{name} is in meters; its spacing", spacing_m, text)
        self.make_grid()
        return self

    @property
    def wavelength_m(self) -> float:
        """Wavelength of the carrier."""
        return LIGHT_MPS / self.carrier_hz

    @property
    def virtual_m(self) -> Float[np.ndarray, "TQ 3"]:
        """Positions of the virtual antennas, the sums of those of transmitter and receiver."""
        return np.reshape(
            [np.add(tx, rx) for tx in self.tx_m for rx in self.rx_m], (-1, 3)
        )

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the samples of a frame: chirps, transmitters, receivers, samples."""
        return self.num_chirps, len(self.tx_m), len(self.rx_m), self.num_samples

    def make_grid(self) -> RadarGrid:
        """Returns the axes of the tensor.

        The Doppler axis has the unambiguous interval `[-max, max)` with
        `max = wavelength / (4 T chirp_period_s)` for T transmitters, positive for targets
        that recede. The field of view has the ends of the axes.
        """
        sampled_s = self.num_samples / self.sample_rate_hz
        step_m = LIGHT_MPS / (2 * self.slope_hz_per_s * sampled_s)
        range_m = step_m * np.arange(self.num_samples // (1 if self.is_complex else 2))
        range_m = range_m[range_m <= self.max_range_m]
        loop_s = len(self.tx_m) * self.chirp_period_s
        step_mps = self.wavelength_m / (2 * self.num_chirps * loop_s)
        return RadarGrid(
            range_m=range_m,
            azimuth_rad=np.array(self.azimuth_rad),
            elevation_rad=np.array(self.elevation_rad),
            doppler_mps=step_mps * (np.arange(self.num_chirps) - self.num_chirps // 2),
            fov_range_m=float(range_m[-1]),
            fov_azimuth_rad=float(np.abs(self.azimuth_rad).max(initial=0)),
        )

    def steering(self) -> Complex[np.ndarray, "TQ EA"]:
        """Returns the phases by which the array is steered to every direction."""
        up, right = np.meshgrid(
            self.elevation_rad or 0.0, self.azimuth_rad, indexing="ij"
        )
        flat = np.cos(up)
        toward = [flat * np.cos(right), -flat * np.sin(right), np.sin(up)]
        turns = self.virtual_m @ np.reshape(toward, (3, -1)) / self.wavelength_m
        phases: np.ndarray = np.exp(2j * np.pi * turns)
        return phases

    def windows(self) -> tuple[Window, Window, Window]:
        """Returns the weights of samples `[N]`, chirps `[D]` and virtual antennas `[TQ]`.

        Their squares sum to 1, so white noise keeps its mean power. The window over antennas
        is the product of those over y and z, which end a quarter wavelength outside.
        """
        centers = (self.virtual_m.max(0) + self.virtual_m.min(0)) / 2
        extents = np.ptp(self.virtual_m, axis=0) + self.wavelength_m / 2
        places = ((self.virtual_m - centers) / extents)[:, 1:]
        samples, chirps = (
            (np.arange(n)[:, None] + 0.5) / n - 0.5
            for n in (self.num_samples, self.num_chirps)
        )
        return (
            _window(samples, self.range_pedestal),
            _window(chirps, self.doppler_pedestal),
            _window(places, self.array_pedestal),
        )


def _window(place: Float[np.ndarray, "n axes"], pedestal: float) -> Window:
    """Returns a window from -1/2 to 1/2, that of `simulation.radar.tensor.window_response`."""
    weights = (pedestal + (1 - pedestal) * np.cos(np.pi * place) ** 2).prod(1)
    normalized: Window = (weights / np.linalg.norm(weights)).astype(np.float32)
    return normalized


def adc_to_power(
    samples: Num[Array, "D T Q N"],
    radar: FmcwRadar,
    calibration: Num[Array, "T Q"] | None = None,
) -> Float[jax.Array, "D R E A"]:
    """Computes a radar tensor from the ADC samples of a frame.

    The steps are window and FFT over samples, window and FFT over chirps, compensation of the
    phase by which a moving target differs between transmitters, and beamforming by a sum over
    all virtual antennas for every direction. The compensation uses the velocity of the Doppler
    bin, so targets faster than the Doppler axis appear at wrong angles as well.

    White noise has the same mean power in the tensor as in the samples. The computation is
    jitted. Inside of `jax.jit` and `jax.vmap`, the values of samples are not checked.

    Args:
        samples: Samples by chirp, transmitter, receiver and time, complex or real.
        radar: Waveform, antennas and axes.
        calibration: Complex factors on the channels that correct their gain and phase.

    Returns:
        float32 linear power on the axes of `radar.make_grid()`.

    Raises:
        UserError: The samples do not have the radar's shape, are complex for a real one,
            unsigned, not finite or all 0, or the calibration does not have a factor per channel.
    """
    # Outside of jit, whose errors end with remarks of JAX.
    expected = f"{radar.shape}: num_chirps, tx_m, rx_m, num_samples of the radar"
    require(samples.shape == radar.shape, "shape of samples", samples.shape, expected)
    expected = f"{'complex' if radar.is_complex else 'real'}, as radar.is_complex"
    is_same = jnp.iscomplexobj(samples) == radar.is_complex
    require(is_same, "type of samples", samples.dtype.name, expected)
    if calibration is not None:
        found = np.shape(calibration)
        expected = f"{radar.shape[1:3]}: tx_m, rx_m of the radar"
        require(found == radar.shape[1:3], "shape of calibration", found, expected)
    if not isinstance(samples, jax.core.Tracer):
        _check_values(np.asarray(samples))
    power: Float[jax.Array, "D R E A"] = _to_power(samples, radar, calibration)
    return power


def _check_values(samples: Num[np.ndarray, "D T Q N"]) -> None:
    """Raises `UserError` for samples that no ADC records, or that were read as unsigned."""
    num_wrong = int((~np.isfinite(samples)).sum())
    require(num_wrong == 0, "number of samples that are not finite", num_wrong, "0")
    if not samples.any():
        raise UserError("all samples are 0: check the recording and the frame's number")
    parts = np.stack([samples.real, samples.imag])
    is_whole = bool((parts == np.rint(parts)).all())
    if samples.dtype.kind == "u" or (
        is_whole and parts.min() >= 0 and parts.max() >= 1 << 15
    ):
        raise UserError(
            f"samples are unsigned, from {parts.min():g} to {parts.max():g}, expected signed "
            "ones: x.astype(np.uint16).view(np.int16) converts two's complement of 16 bits "
            "(of complex samples, real and imaginary parts); subtract the middle, such as "
            "32768, from offset binary"
        )


@functools.partial(jax.jit, static_argnames="radar")
def _to_power(
    samples: Num[Array, "D T Q N"],
    radar: FmcwRadar,
    calibration: Num[Array, "T Q"] | None,
) -> Float[jax.Array, "D R E A"]:
    """Computes the tensor of `adc_to_power`."""
    grid = radar.make_grid()
    of_range, of_doppler, weights = radar.windows()
    num_doppler, num_tx, num_rx, _ = radar.shape
    transform = jnp.fft.fft if radar.is_complex else jnp.fft.rfft
    spectrum = transform(samples * of_range[None, None, None])[..., : grid.num_range]
    signals = jnp.fft.fft(spectrum * of_doppler[:, None, None, None], axis=0)
    signals = jnp.fft.fftshift(signals, axes=0)  # [D, T, Q, R]
    loops = np.fft.fftshift(np.fft.fftfreq(num_doppler))[:, None]  # turns per T chirps
    turns = loops * (np.arange(num_tx) / num_tx)  # [D, T]
    factors = jnp.exp(-2j * np.pi * turns)[..., None, None]
    if calibration is not None:
        factors = factors * jnp.asarray(calibration)[None, :, :, None]
    signals = (signals * factors).reshape(num_doppler, num_tx * num_rx, -1)
    # Products of real matrices are several times faster than complex ones on CPUs.
    steering = (radar.steering() * weights[:, None]).astype(np.complex64)  # [TQ, EA]
    matrix = np.block([[steering.real, steering.imag], [-steering.imag, steering.real]])

    def beams(signal: Complex[jax.Array, "TQ R"]) -> Float[jax.Array, "R E A"]:
        parts = jnp.concatenate([signal.real, signal.imag])
        product = jnp.matmul(parts.T, matrix, precision=lax.Precision.HIGHEST)
        halves = product.reshape(grid.num_range, 2, *grid.shape_drea[2:])
        return jnp.square(halves).sum(1)

    power: Float[jax.Array, "D R E A"] = lax.map(beams, signals)
    return power


def read_ti_bin(
    path: str | os.PathLike[str],
    frame: int,
    radar: FmcwRadar,
    *,
    is_interleaved: bool,
    is_offset_binary: bool = False,
) -> Inexact[np.ndarray, "D T Q N"]:
    """Reads a frame of a `.bin` file of raw 16-bit samples of Texas Instruments' radars.

    With `is_interleaved`, a chirp has one sample of all receivers, then the next sample; complex
    samples are the real parts of all receivers, then their imaginary parts. These are xWR12xx
    and xWR14xx with four LVDS lanes. Otherwise a chirp has all samples of one receiver, then
    those of the next; complex samples are two real parts, then their two imaginary parts.
    These are xWR16xx, xWR18xx and xWR68xx with two lanes.

    Args:
        path: The file, without a header, as DCA1000 and mmWave Studio write it.
        frame: Number of the frame in the file, from 0.
        radar: Waveform and antennas. `rx_m` has all receivers that were recorded.
        is_interleaved: Whether the receivers are interleaved.
        is_offset_binary: Whether samples are unsigned around 32768, as TSW1400 writes them,
            instead of signed.

    Returns:
        Samples in counts, complex64 or float32.

    Raises:
        DataError: The file does not have the frame, or not a whole number of frames.
        UserError: `num_samples` is odd, which complex samples in pairs cannot be.

    References:
        Texas Instruments, "Mmwave Radar Device ADC Raw Data Capture", SWRA581.
    """
    num_parts = 2 if radar.is_complex else 1
    *chirps, num_rx, num_samples = radar.shape
    words = math.prod(radar.shape) * num_parts
    frames = os.path.getsize(path) / (2 * words)
    if frames % 1 or not 0 <= frame < frames:
        raise DataError(
            f"{path} has {frames:.6g} frames of {2 * words:,} bytes, expected a whole number "
            f"above {frame}: check {radar.shape} (num_chirps, tx_m, rx_m, num_samples) and "
            f"is_complex of the radar, or remove the rest of a recording that was stopped"
        )
    encoding = "<u2" if is_offset_binary else "<i2"
    counts = np.fromfile(path, encoding, words, offset=frame * 2 * words)
    counts = counts.astype(np.float32) - (32768 if is_offset_binary else 0)
    if is_interleaved:
        parts = counts.reshape(*chirps, num_samples, num_parts, num_rx)
        parts = np.moveaxis(parts, -1, 2)
    else:
        is_even = num_samples % num_parts == 0
        require(is_even, "radar.num_samples", num_samples, "an even number of samples")
        pairs = counts.reshape(*chirps, num_rx, -1, num_parts, num_parts)
        parts = pairs.swapaxes(-1, -2).reshape(*chirps, num_rx, num_samples, num_parts)
    kind = np.complex64 if radar.is_complex else np.float32
    return np.ascontiguousarray(parts).view(kind)[..., 0]
