"""Estimation of the parameters of the radar model from recorded tensors.

Noise and its correlations are those of lines of the tensor (all beams of one range and Doppler
bin) without echoes. Complex Gaussian noise with correlation c of its field between two bins has
the correlation c^2 of its power, and c follows from the windows and arrays of the sensor.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from radejax.core.errors import DataError
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar.sensor import LEAK_M, LEAK_SHARE, noise_window
from radejax.simulation.radar.tensor import DRAWN, array_basis

ARRAY_PEDESTAL = 0.5
"""Taper for which the numbers of elements are estimated: more elements with a stronger taper
have nearly the same beam."""

_QUIET = 3.0  # above the expected maximum of a line; 5 % of lines of pure noise are
_LEAST_SPREAD = 0.1  # averages of 100 powers have it
_MIN_ECHO_DB = 25.0
_NUM_ECHOES = 6
_MIN_LINES = 20
_NUM_LAGS = 6
_NUM_PROFILE_POINTS = 32
_MAX_ELEMENTS = 128


def fit_radar(
    recordings: Iterable[Float[np.ndarray, "D R E A"]], grid: RadarGrid
) -> dict[str, Any]:
    """Estimate the fields of `simulation.radar` from recorded radar tensors.

    Args:
        recordings: Tensors of linear power.
        grid: Sensor axes of the tensors.

    Returns:
        Fields of `RadarParameters`: `noise_db`, `profile_db`, `azimuth_elements` and
        `elevation_elements` (beam widths, at the taper `ARRAY_PEDESTAL`),
        `range_correlation` and `doppler_pedestal` (windows), `beam_spread_db`, and
        `leakage` if an echo is strong enough. With several recordings, fields of `DRAWN`
        are their lowest and highest value, and others their median. What tensors alone do
        not tell, such as the gain, is that of the preset "realistic".

    Raises:
        DataError: There is no recording, or one has no noise to measure.
    """
    found = [_fit_one(np.asarray(power, np.float32), grid) for power in recordings]
    if not found:
        raise DataError("no recordings to estimate the parameters of the radar from")
    fields: dict[str, Any] = {"preset": "realistic", "receiver_db": 0.0}
    fields |= {"range_profile": 1.0, "array_pedestal": ARRAY_PEDESTAL}
    for name in dict.fromkeys(itertools.chain.from_iterable(found)):
        values = np.array([fit[name] for fit in found if name in fit])
        if name in DRAWN and len(values) > 1:
            fields[name] = [float(values.min()), float(values.max())]
        else:
            fields[name] = np.median(values, axis=0).tolist()
    return fields


def _fit_one(power: Float[np.ndarray, "D R E A"], grid: RadarGrid) -> dict[str, Any]:
    line = power.mean((2, 3), dtype=np.float64)  # [D, R]
    # A tenth of the cells, which have a known share of the mean: few of them hold echoes.
    base = np.quantile(power, 0.1, axis=(0, 2, 3)) / -np.log(0.9)  # [R]
    share = grid.range_m / grid.range_m[-1]
    middle = (share > 0.25) & (share < 0.8)
    middle &= base < 1.12 * np.quantile(base[middle], 0.3)
    most = base * (np.log(power[0, 0].size) + _QUIET)
    quiet = (power.max((2, 3)) < most) & middle  # [D, R]
    num_quiet = int(quiet.sum())
    spread = power[quiet].std() / max(line[quiet].mean(), 1e-30) if num_quiet else 0.0
    if num_quiet < _MIN_LINES or spread < _LEAST_SPREAD:
        raise DataError(
            f"{num_quiet} lines over Doppler and range hold noise alone, whose standard "
            f"deviation is {spread:.2g} of its mean; expected {_MIN_LINES} lines or more and about "
            "1, the value of linear power (decibels have less)"
        )
    noise = line[quiet].mean()
    # Not relative to the mean of each line, which has few independent cells.
    mean = (line * quiet).sum(0) / np.maximum(quiet.sum(0), 1)
    excess = power / np.where(mean > 0.0, mean, 1.0)[:, None, None] - 1.0
    fit: dict[str, Any] = {
        "noise_db": 10.0 * np.log10(noise),
        "profile_db": _profile(power, base / noise, noise, grid),
    }
    both = quiet[:, 1:] & quiet[:, :-1]
    fit["range_correlation"] = _clip(
        _correlation(excess[:, 1:][both], excess[:, :-1][both]), 4.0 / 9.0
    )
    both = quiet[1:] & quiet[:-1]
    if both.any():
        correlation = _correlation(excess[1:][both], excess[:-1][both])
        _, fit["doppler_pedestal"] = noise_window(_clip(correlation, 4.0 / 9.0))
    noises = excess[quiet]  # [lines, E, A]
    fit["azimuth_elements"] = _num_elements(noises, grid.azimuth_rad)
    if grid.num_elevation > 1:
        turned = noises.transpose(0, 2, 1)
        fit["elevation_elements"] = _num_elements(turned, grid.elevation_rad)
    halves = [
        10.0 * np.log10(1.0 + part.mean((0, 1))) for part in np.array_split(noises, 2)
    ]
    fit["beam_spread_db"] = np.sqrt(max(np.cov(halves)[0, 1], 0.0))
    leakage = _leakage(power, noise, grid, fit["azimuth_elements"])
    return fit if leakage is None else fit | {"leakage": leakage}


def _clip(value: float, high: float) -> float:
    return float(np.clip(value, 0.0, high))


def _correlation(
    a: Float[np.ndarray, "*cells"], b: Float[np.ndarray, "*cells"]
) -> float:
    """Returns the correlation of values of mean 0."""
    return float((a * b).mean() / np.sqrt(np.square(a).mean() * np.square(b).mean()))


def _profile(
    power: Float[np.ndarray, "D R E A"],
    base: Float[np.ndarray, " R"],
    noise: float,
    grid: RadarGrid,
) -> list[tuple[float, float]]:
    """Returns noise in dB relative to its level at some ranges.

    The leak is in the Doppler bin of velocity 0 of the first and last range bins. Between
    them, this bin has echoes of the surroundings.
    """
    still = np.abs(grid.doppler_mps).argmin() if grid.num_doppler else 0
    level = np.median(power[still].mean(1), axis=1) / noise
    range_m = grid.range_m
    leaks = (range_m < LEAK_M) | (range_m > LEAK_SHARE * range_m[-1])
    leak = np.where(leaks, np.maximum(level - base, 0.0), 0.0) / power.shape[0]
    profile_db = 10.0 * np.log10(np.maximum(base + leak, 1e-30))
    ends = np.r_[: min(8, len(range_m)), max(len(range_m) - 8, 0) : len(range_m)]
    spread = np.geomspace(8, len(range_m), _NUM_PROFILE_POINTS - 16).astype(int) - 1
    rows = np.unique(np.r_[ends, spread])
    return [(float(range_m[row]), float(profile_db[row])) for row in rows]


def _num_elements(
    noises: Float[np.ndarray, "lines other bins"], axis_rad: Float[np.ndarray, " bins"]
) -> float:
    """Returns the number of elements whose noise is correlated like that of the beams."""
    lags = range(1, min(_NUM_LAGS, len(axis_rad) - 1) + 1)
    found = [_correlation(noises[..., lag:], noises[..., :-lag]) for lag in lags]

    def error(elements: int) -> float:
        basis = array_basis(axis_rad, elements, ARRAY_PEDESTAL)
        expected = np.square(basis @ basis.T)
        errors = [np.diag(expected, lag).mean() for lag in lags] - np.array(found)
        return float(np.square(errors).sum())

    return float(min(range(2, _MAX_ELEMENTS + 1), key=error))


def _leakage(
    power: Float[np.ndarray, "D R E A"], noise: float, grid: RadarGrid, elements: float
) -> float | None:
    """Returns the power of the strongest echoes in other beams, relative to their peaks."""
    is_echo = (grid.range_m > 10.0) & (grid.range_m < LEAK_SHARE * grid.range_m[-1])
    strongest = np.where(is_echo, power.max((0, 2, 3)), 0.0)
    sine, found = np.sin(grid.azimuth_rad), []
    for _ in range(_NUM_ECHOES):
        row = strongest.argmax()
        if strongest[row] < noise * 10.0 ** (_MIN_ECHO_DB / 10.0):
            break
        plane = power[:, row]
        doppler, elevation, azimuth = np.unravel_index(plane.argmax(), plane.shape)
        beams = plane[doppler, elevation] - noise
        is_far = np.abs(sine - sine[azimuth]) > max(
            np.sin(np.deg2rad(10.0)), 4.0 / elements
        )
        found.append(beams[is_far].mean() / beams[azimuth])
        strongest[max(row - 3, 0) : row + 4] = 0.0
    return _clip(float(np.median(found)), 0.5) if found else None
