"""Fit of the simulated radar to recorded radar tensors, as in `radejax simulate --fit`.

Noise and its correlations are those of lines of the tensor (all beams of one range and Doppler
bin) without echoes. Complex Gaussian noise with correlation c of its field between two bins has
the correlation c^2 of its power, and c follows from the windows and arrays of the sensor.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.data.kradar.folders import read_grid
from radejax.data.kradar.tesseract import read_power
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.config import SimulationOptions
from radejax.simulation.radar.sensor import LEAK_M, LEAK_SHARE, noise_window
from radejax.simulation.radar.tensor import DRAWN, array_basis
from radejax.simulation.simulator import SequenceSimulator, make_source
from radejax.visualize.draw import draw_comparison
from radejax.visualize.style import save_figure

FITTED = "radar.json"
"""File with the fields `grid` and `radar` of `SimulationOptions`."""

Tensor = Float[np.ndarray, "D R E A"]
Values = Float[np.ndarray, "*values"]

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


def fit_files(
    recordings: Sequence[files.PathLike], out: files.PathLike
) -> files.JsonObject:
    """Estimates the parameters of a radar, and draws a recording beside a simulated frame.

    Args:
        recordings: Radar tensors, or folders that contain `tesseract_*.mat`, of one radar.
            Its axes are those of the `radar_grid.json` in a folder above, or K-Radar's.
        out: Folder in which to write `radar.json` and `fit.png`.

    Returns:
        The fields of `simulation.radar`.

    Raises:
        UserError: There is no radar tensor.
        DataError: A tensor cannot be read, has other axes, is not linear power or has no
            noise to measure.
    """
    paths = []
    for path in map(files.as_path, recordings):
        is_folder = path.is_dir()
        paths += files.find_files(path, "tesseract_*.mat") if is_folder else [path]
    if not paths:
        names = ", ".join(map(str, recordings))
        raise UserError(f"no radar tensors in {names}: looked for tesseract_*.mat")
    roots = sorted({folder for path in paths for folder in path.absolute().parents})
    grid = read_grid(roots)
    tensors = (read_power(path, grid) for path in paths)
    first = next(tensors)
    fields = fit_radar(itertools.chain([first], tensors), grid)
    is_kradar = grid == RadarGrid.kradar()
    section = {"grid": "kradar" if is_kradar else grid.to_dict(), "radar": fields}
    maps = {
        f"recording, {paths[0].name}": _mean_db(first),
        "simulation": _mean_db(_simulated(section)),
    }
    out = files.as_path(out)
    files.write_json(out / FITTED, section)
    save_figure(draw_comparison(maps, grid), out / "fit.png")
    return fields


def _mean_db(power: Tensor) -> Float[np.ndarray, "R A"]:
    mean = power.mean((0, 2), dtype=np.float64) + 1e-10
    level: Float[np.ndarray, "R A"] = 10.0 * np.log10(mean)
    return level


def _simulated(section: files.JsonObject) -> Tensor:
    """Simulates the tensor of one procedural frame."""
    options = SimulationOptions(**section, train_sequences=1, frames_per_sequence=1)
    simulator = SequenceSimulator(make_source(options).make(1), options)
    given = simulator.radar_input(simulator.sequence.frame(0))
    return simulator.run(given, "tesseract")


def fit_radar(recordings: Iterable[Tensor], grid: RadarGrid) -> files.JsonObject:
    """Estimates the fields of `simulation.radar` from recorded radar tensors.

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
    fields: files.JsonObject = {"preset": "realistic", "receiver_db": 0.0}
    fields |= {"range_profile": 1.0, "array_pedestal": ARRAY_PEDESTAL}
    for name in dict.fromkeys(itertools.chain.from_iterable(found)):
        values = np.array([fit[name] for fit in found if name in fit])
        is_drawn = name in DRAWN and len(values) > 1
        result = [values.min(), values.max()] if is_drawn else np.median(values, 0)
        fields[name] = np.asarray(result).tolist()
    return fields


def _fit_one(power: Tensor, grid: RadarGrid) -> files.JsonObject:
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
    fit: files.JsonObject = {"noise_db": 10.0 * np.log10(noise)}
    fit["profile_db"] = _profile(power, base / noise, noise, grid)
    both = quiet[:, 1:] & quiet[:, :-1]
    correlation = _correlation(excess[:, 1:][both], excess[:, :-1][both])
    fit["range_correlation"] = np.clip(correlation, 0.0, 4.0 / 9.0)
    both = quiet[1:] & quiet[:-1]
    if both.any():
        correlation = _correlation(excess[1:][both], excess[:-1][both])
        _, fit["doppler_pedestal"] = noise_window(np.clip(correlation, 0.0, 4.0 / 9.0))
    noises = excess[quiet]  # [lines, E, A]
    fit["azimuth_elements"] = _num_elements(noises, grid.azimuth_rad)
    if grid.num_elevation > 1:
        turned = noises.transpose(0, 2, 1)
        fit["elevation_elements"] = _num_elements(turned, grid.elevation_rad)
    gains = [1.0 + half.mean((0, 1)) for half in np.array_split(noises, 2)]
    covariance = np.cov(10.0 * np.log10(gains))[0, 1]
    fit["beam_spread_db"] = np.sqrt(max(covariance, 0.0))
    fit |= _leakage(power, noise, grid, fit["azimuth_elements"])
    return fit


def _correlation(a: Values, b: Values) -> float:
    """Returns the correlation of values of mean 0."""
    return float((a * b).mean() / np.sqrt(np.square(a).mean() * np.square(b).mean()))


def _profile(
    power: Tensor, base: Float[np.ndarray, " R"], noise: float, grid: RadarGrid
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
    power: Tensor, noise: float, grid: RadarGrid, elements: float
) -> dict[str, float]:
    """Returns the power of the strongest echoes in other beams, relative to their peaks.

    The result is empty if no echo is strong enough.
    """
    is_echo = (grid.range_m > 10.0) & (grid.range_m < LEAK_SHARE * grid.range_m[-1])
    strongest = np.where(is_echo, power.max((0, 2, 3)), 0.0)
    sine = np.sin(grid.azimuth_rad)
    found = []
    for _ in range(_NUM_ECHOES):
        row = strongest.argmax()
        if strongest[row] < noise * 10.0 ** (_MIN_ECHO_DB / 10.0):
            break
        plane = power[:, row]
        doppler, elevation, azimuth = np.unravel_index(plane.argmax(), plane.shape)
        beams = plane[doppler, elevation] - noise
        width = max(np.sin(np.deg2rad(10.0)), 4.0 / elements)
        is_far = np.abs(sine - sine[azimuth]) > width
        found.append(beams[is_far].mean() / beams[azimuth])
        strongest[max(row - 3, 0) : row + 4] = 0.0
    return {"leakage": np.clip(np.median(found), 0.0, 0.5)} if found else {}
