"""ADC samples of point scatterers, from which `radejax.data.adc` computes radar tensors."""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Complex, Float, Inexact, UInt32

from radejax.core.structures import Array
from radejax.data.adc import FmcwRadar
from radejax.simulation.radar.tensor import Scatterers, white_noise


@functools.partial(jax.jit, static_argnames="radar")
def simulate_adc(
    scatterers: Scatterers,
    noise_power: Float[Array, "R D"],
    key: UInt32[Array, "2"],
    radar: FmcwRadar,
) -> Inexact[jax.Array, "D T Q N"]:
    """Simulates the ADC samples of one radar frame. The function is jitted.

    A scatterer keeps its range bin during the frame. Scatterers beyond the ADC's rate are left
    out, as by an ideal filter. The signal of each is scaled so that its peak in the tensor has
    the power that it has in `tensor.simulate`.

    Args:
        scatterers: Point targets, padded with targets of zero amplitude.
        noise_power: Mean power of the noise in the tensor's range and Doppler bins, as
            `propagation.noise_profile` computes it for `radar.make_grid()`.
        key: Random key of the noise of this frame.
        radar: Waveform and antennas.

    Returns:
        complex64 samples, or float32 ones of a real radar.
    """
    grid = radar.make_grid()
    num_doppler, num_tx, num_rx, num_samples = radar.shape
    # Times and positions are centered, so that float32 phases are small.
    samples = np.arange(num_samples) - (num_samples - 1) / 2
    loops = np.arange(num_doppler) - (num_doppler - 1) / 2
    chirps = loops[:, None] + np.arange(num_tx) / num_tx
    period_mps = (grid.doppler_mps[1] - grid.doppler_mps[0]) * num_doppler
    azimuth, elevation = scatterers.azimuth_rad, scatterers.elevation_rad
    flat = jnp.cos(elevation)
    toward = [flat * jnp.cos(azimuth), -flat * jnp.sin(azimuth), jnp.sin(elevation)]
    antennas = -(radar.virtual_m - radar.virtual_m.mean(0)) / radar.wavelength_m
    in_range = _phases(samples / (grid.range_step_m * num_samples), scatterers.range_m)
    in_time = _phases(chirps / period_mps, scatterers.velocity_mps)  # [D T, S]
    on_array = _phases(antennas, *toward)  # [T Q, S]
    gain = np.prod([window.sum() for window in radar.windows()])
    span_m = grid.range_step_m * num_samples / (1 if radar.is_complex else 2)
    is_passed = scatterers.range_m < span_m
    amplitude = lax.complex(*scatterers.amplitude.T) * is_passed / gain
    in_time = in_time.reshape(num_doppler, num_tx, 1, -1)
    spread = in_time * on_array.reshape(1, num_tx, num_rx, -1)
    of_range = (in_range * amplitude[None]).T
    signal = jnp.matmul(spread, of_range, precision=lax.Precision.HIGHEST)
    shape = (num_tx, num_rx, num_samples, num_doppler, 2)
    white = white_noise(math.prod(shape), key, jnp.uint32(0)).reshape(shape)
    missing = num_samples - grid.num_range
    power = jnp.fft.ifftshift(jnp.pad(noise_power, ((0, missing), (0, 0))), axes=1)
    spectrum = jnp.sqrt(power)[None, None] * lax.complex(white[..., 0], white[..., 1])
    noise = jnp.fft.ifft2(spectrum, norm="ortho")  # [T, Q, N, D]
    signal += jnp.moveaxis(noise, -1, 0)
    return signal if radar.is_complex else 2 * signal.real


def _phases(
    frequency: Float[np.ndarray, "..."], *values: Float[Array, " S"]
) -> Complex[jax.Array, "n S"]:
    """Returns the phasors of points, of which `frequency` has the turns per value."""
    rows = frequency.reshape(-1, len(values)).astype(np.float32)
    turns = jnp.matmul(rows, jnp.stack(values), precision=lax.Precision.HIGHEST)
    return jnp.exp(2j * jnp.pi * turns)
