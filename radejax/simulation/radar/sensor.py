"""Imperfections of the radar sensor: noise over range, high-pass filter, array errors.

An ideal sensor has none of them. Their sizes follow a published map of a real K-Radar frame, and
the power of one car in K-Radar's test of films on the radar (see `docs/simulated_radar.md`).

- The direct leak from transmitter to receiver does not move, so it is in the first range bins
  and the Doppler bin of velocity 0. It wraps around to the last range bins.
- FMCW receivers filter out low beat frequencies, because near echoes would saturate them. A
  second-order filter attenuates by 40 dB per decade, and the radar equation has as many. Below
  the corner, echoes of objects therefore hardly depend on the distance.
- Phase errors of the array's channels spread a part of each echo over all beams. Independent
  errors of standard deviation s leave `exp(-s^2)` of the power of the peak, and the rest has the
  same mean in all beams. They give the leakage of the map, and are not a model of the calibration
  of a real array: 48 channels need 56 to 69 degrees, and the loss of the peak is compensated.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import tensor
from radejax.simulation.radar.tensor import RadarParameters, SensorState

_NEAR_PROFILE = np.array([
    (0.0, 45.0), (0.46, 12.0), (0.9, 6.0), (3.0, 6.0), (3.7, 3.5), (5.1, 0.0),
    (6.5, -5.0), (9.3, -5.0), (12.0, -2.0), (16.0, -0.7), (30.0, 0.0),
])  # fmt: skip
"""Distance in m, and noise in dB relative to that of medium ranges. The dip is 2 dB deeper than
that of the map, in which near echoes leak into it."""

_FAR_PROFILE = np.array([
    (0.88, 0.0), (0.907, -1.0), (0.925, -2.7), (0.95, -6.2), (0.965, -3.9),
    (0.978, 0.0), (0.996, 5.0), (1.0, 11.0),
])  # fmt: skip
"""Fraction of the maximum range, and noise as in `_NEAR_PROFILE`."""


LEAK_M = 5.0
"""Distance up to which the direct leak raises the noise."""

LEAK_SHARE = 0.97
"""Fraction of the maximum range from which on it does."""


def receiver_noise(
    grid: RadarGrid, parameters: RadarParameters
) -> Float[np.ndarray, "R D"]:
    """Computes the mean power of the receiver's noise and of the direct leak."""
    range_m = grid.range_m
    if parameters.profile_db:
        profile_db = np.interp(range_m, *np.array(parameters.profile_db).T)
    else:
        profile_db = np.interp(range_m, *_NEAR_PROFILE.T)
        profile_db += np.interp(range_m / range_m[-1], *_FAR_PROFILE.T)
    factor = 10.0 ** (parameters.range_profile * profile_db / 10.0)
    is_still = np.zeros(max(grid.num_doppler, 1))
    is_still[np.abs(grid.doppler_mps).argmin() if grid.num_doppler else 0] = 1.0
    leak = np.maximum(factor - 1.0, 0.0) * is_still.size
    level = 10.0 ** ((parameters.noise_db + parameters.receiver_db) / 10.0)
    power: Float[np.ndarray, "R D"] = level * (
        np.minimum(factor, 1.0)[:, None] + leak[:, None] * is_still
    )
    return power


def high_pass(
    range_m: Float[np.ndarray, "*targets"], corner_m: float
) -> Float[np.ndarray, "*targets"]:
    """Computes the factor on the power of echoes by a second-order high-pass filter."""
    return 1.0 / (1.0 + (corner_m / range_m) ** 4)


def draw_state(
    grid: RadarGrid, parameters: RadarParameters, rng: np.random.Generator
) -> SensorState | None:
    """Draws the errors of the channels and beams of one sequence.

    Args:
        grid: Sensor axes.
        parameters: Parameters of the sequence.
        rng: Random generator.

    Returns:
        float32 NumPy arrays, or None for an ideal sensor.
    """
    correlation = parameters.range_correlation
    if not (parameters.leakage or parameters.beam_spread_db or correlation):
        return None
    count = parameters.azimuth_elements, parameters.elevation_elements
    azimuth, elevation = (_phase_errors(n, parameters, rng) for n in count)
    # Neighboring beams share elements, so their gain varies smoothly.
    window = np.hanning(11)
    white = rng.normal(size=grid.num_azimuth + 10)
    spread = np.convolve(white, window, "valid") / np.linalg.norm(window)
    side, pedestal = noise_window(correlation) if correlation else (0.0, 0.0)
    return SensorState(
        azimuth_phase_rad=azimuth,
        elevation_phase_rad=elevation,
        beam_gain=(10.0 ** (parameters.beam_spread_db * spread / 20.0)).astype("f4"),
        range_pedestal=np.array(pedestal, np.float32),
        range_side=np.array(side, np.float32),
    )


def noise_window(correlation: float) -> tuple[float, float]:
    """Computes the window whose noise power is correlated between neighboring bins.

    A filter (c, 1, c) gives fields of neighboring bins, whose correlation is the root of
    that of their powers, a correlation of 2 c / (1 + 2 c^2).

    Args:
        correlation: Correlation of the noise power, from 0 (uniform) to 4/9 (Hann window).

    Returns:
        The coefficient c, and the pedestal of the window.
    """
    root = np.sqrt(correlation)
    side = root / (1.0 + np.sqrt(1.0 - 2.0 * correlation))
    return float(side), float((1.0 - 2.0 * side) / (1.0 + 2.0 * side))


def _phase_errors(
    elements: float, parameters: RadarParameters, rng: np.random.Generator
) -> Float[np.ndarray, " P"]:
    """Draws the phase errors of one element of each pair, whose leakage is as wanted.

    They are the quantiles of a normal distribution in random order. Independent numbers
    would cancel the peak of the beam in some sequences.
    """
    place, weight = tensor.element_pairs(elements, parameters.array_pedestal)
    total = np.where(place > 0, 2.0 * weight, np.sqrt(2.0) * weight).sum()
    effective = total**2 / (2.0 * weight**2).sum()
    spread_rad = np.sqrt(np.log1p(parameters.leakage * effective))
    quantiles = ndtri((np.arange(place.size) + 0.5) / place.size)
    errors = spread_rad * rng.permutation(quantiles)
    return np.where(place > 0, errors, 0.0).astype(np.float32)
