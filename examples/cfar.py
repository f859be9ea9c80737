"""A classical baseline: CA-CFAR, clustering by distance, and boxes by rules.

Local maxima that exceed the mean of their neighborhood (cell-averaging CFAR) are detected. Peaks
near a stronger peak belong to its cluster. The radar cross-section (RCS) of the strongest bin from
the radar equation selects the class, and the box has the mean size of this class. Only the RCS
limits between classes are fitted.

References:
    Cell averaging: Richards, Fundamentals of Radar Signal Processing, ch. 6.
    Clustering of radar detections, simplified here: Kellner et al., "Grid-based DBSCAN for
    clustering extended objects in radar data", IV 2012.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from radejax.core.structures import CLASSES
from radejax.data.points import local_mean_db
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar.sensor import high_pass
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.traffic import SIZES


@dataclasses.dataclass(frozen=True)
class CfarSettings:
    """Settings of the baseline.

    Attributes:
        threshold_db: Minimum power of a peak above the mean of its training cells.
        guard_cells: Number of guard cells on each side of a bin.
        training_cells: Number of training cells on each side, outside the guard cells.
        peak_drop_db: Drop of power from the peak at which a cluster ends toward the radar.
        merge_m: A peak that is closer than this to a stronger peak is dropped.
        rcs_steps: Smallest apparent RCS in dBsm of each class, in descending order; weaker
            clusters are clutter. The RCS is apparent because a bin contains only a part of
            an object's power. `fit_rcs_steps` estimates the limits on a training split; the
            defaults are those of the quickstart's dataset.
    """

    threshold_db: float = 9.0
    guard_cells: int = 4
    training_cells: int = 6
    peak_drop_db: float = 12.0
    merge_m: float = 4.5
    rcs_steps: tuple[tuple[str, float], ...] = (
        ("Bus or Truck", 22.0),
        ("Sedan", -7.0),
        ("Motorcycle", -12.7),
        ("Bicycle", -13.7),
        ("Pedestrian", -14.7),
    )


def fit_rcs_steps(
    cls: Sequence[str],
    rcs_dbsm: Sequence[float],
    *,
    balanced: bool = False,
    least_gap_db: float = 1.0,
) -> tuple[tuple[str, float], ...]:
    """Fits the RCS limits between classes to labeled objects.

    Classes are ordered by descending median RCS. The limit between two neighbors is the one with
    the fewest classification errors between them. The limit of the last class is its lower
    quartile. Limits are lowered if they are closer than `least_gap_db`.

    Args:
        cls: Class name of each object.
        rcs_dbsm: Apparent RCS of each object, see `object_rcs_db`.
        balanced: Whether to count errors as fractions of their classes, so that rare classes
            have the same weight as frequent ones.
        least_gap_db: Smallest difference between consecutive limits.

    Returns:
        Name and smallest RCS of each class that occurs, for `CfarSettings.rcs_steps`.
    """
    cls, values = np.asarray(cls), np.asarray(rcs_dbsm, float)
    groups = {name: values[cls == name] for name in CLASSES if (cls == name).any()}
    order = sorted(groups, key=lambda name: -np.median(groups[name]))
    steps: list[tuple[str, float]] = []
    for upper, lower in itertools.pairwise(order):
        strong, weak = groups[upper], groups[lower]
        limit = steps[-1][1] - least_gap_db if steps else np.inf
        candidates = np.unique(np.concatenate([strong, weak]))
        candidates = np.minimum(candidates, limit)
        missed = (strong[:, None] < candidates).sum(0)
        wrong = (weak[:, None] >= candidates).sum(0)
        if balanced:
            missed, wrong = missed / strong.size, wrong / weak.size
        steps.append((upper, float(candidates[np.argmin(missed + wrong)])))
    if order:
        least = float(np.percentile(groups[order[-1]], 25.0))
        limit = steps[-1][1] - least_gap_db if steps else np.inf
        steps.append((order[-1], min(least, limit)))
    return tuple(steps)


def object_rcs_db(
    projection: np.ndarray,
    boxes: np.ndarray,
    grid: RadarGrid,
    parameters: RadarParameters,
    *,
    margin_m: float = 0.5,
) -> np.ndarray:
    """Returns the apparent RCS `[N]` in dBsm of the strongest bin in each box of `[N, 7]`.

    Boxes are enlarged by `margin_m` on each side. The RCS of a box without bin centers is NaN.
    """
    power_db = _power_db(projection, grid)
    rcs = apparent_rcs_db(power_db, grid.range_m[:, None], parameters)
    centers = grid.bin_centers_ego()  # [R, A, 2]
    result = np.full(len(boxes), np.nan)
    for n, box in enumerate(boxes):
        cos, sin = np.cos(box[6]), np.sin(box[6])
        x, y = centers[..., 0] - box[0], centers[..., 1] - box[1]
        inside = np.abs(cos * x + sin * y) < box[3] / 2 + margin_m
        inside &= np.abs(cos * y - sin * x) < box[4] / 2 + margin_m
        if inside.any():
            result[n] = rcs[inside].max()
    return result


def apparent_rcs_db(power_db, range_m, parameters: RadarParameters):
    """Returns the RCS in dBsm of a bin's power in dB; ranges below 1 m count as 1 m."""
    range_m = np.maximum(range_m, 1.0)
    law = high_pass(range_m, parameters.high_pass_m) / range_m**4
    return power_db - parameters.gain_db - 10.0 * np.log10(law)


def _power_db(projection: np.ndarray, grid: RadarGrid) -> np.ndarray:
    """Returns the power `[R, A]` in dB, the maximum over the Doppler channels."""
    return projection[..., : grid.num_doppler].max(-1) * LOG_SCALE_DB - LOG_OFFSET_DB


def detect(
    projection: np.ndarray,
    grid: RadarGrid,
    parameters: RadarParameters,
    settings: CfarSettings | None = None,
    *,
    ground_m: float = -1.6,
) -> dict[str, np.ndarray]:
    """Detects boxes in one projection.

    Args:
        projection: Normalized projection `[R, A, D+E]`.
        grid: Sensor axes of the projection.
        parameters: Parameters of the radar, whose gain is used for the RCS.
        settings: Settings of the detector; None for the defaults.
        ground_m: z of the ground, on which boxes stand, measured like the z of boxes.

    Returns:
        Columns `box [K, 7]` (radar frame), `cls [K]` class names and `score [K]` in [0, 1), by
        descending score.
    """
    settings = settings or CfarSettings()
    power_db = _power_db(projection, grid)
    cells = settings.guard_cells, settings.training_cells
    excess_db = power_db - local_mean_db(power_db, *cells)
    peaks = find_peaks(power_db, excess_db, grid, settings)
    boxes, names, scores = [], [], []
    for r, a in peaks:
        rcs = apparent_rcs_db(power_db[r, a], grid.range_m[r], parameters)
        name = next((n for n, least in settings.rcs_steps if rcs >= least), None)
        if name is None:
            continue
        near = _near_side(power_db, r, a, grid, settings)
        boxes.append(_fit_box(name, near, ground_m))
        names.append(name)
        scores.append(1.0 - np.exp(-max(excess_db[r, a], 0.0) / 20.0))
    order = np.argsort(-np.array(scores), kind="stable")
    return {
        "box": np.array(boxes, float).reshape(-1, 7)[order],
        "cls": np.array(names, dtype=np.str_)[order],
        "score": np.array(scores, float)[order],
    }


def find_peaks(
    power_db: np.ndarray,
    excess_db: np.ndarray,
    grid: RadarGrid,
    settings: CfarSettings,
) -> list[tuple[int, int]]:
    """Returns the (range, azimuth) bins of the peaks, by descending power.

    Peaks are local maxima above the CFAR threshold that are not near a stronger peak.
    """
    is_peak = (power_db == ndimage.maximum_filter(power_db, 3)) & (
        excess_db > settings.threshold_db
    )
    cells = np.argwhere(is_peak)
    cells = cells[np.argsort(-power_db[tuple(cells.T)], kind="stable")]
    places = grid.bin_to_ego(cells[:, 0].astype(float), cells[:, 1].astype(float))
    kept: list[int] = []
    for i, place in enumerate(places):
        # One object has several peaks, most of which lie along the range axis.
        gap = np.hypot(*(places[kept] - place).T) if kept else np.zeros(0)
        if not (gap < settings.merge_m).any():
            kept.append(i)
    return [tuple(cells[i]) for i in kept]


def _near_side(power_db, r, a, grid, settings) -> np.ndarray:
    """Returns the position (x, y) in meters of a cluster's side nearest to the radar."""
    level = power_db[r, a] - settings.peak_drop_db
    first = r
    while first > 0 and r - first < 4 and power_db[first - 1, a] > level:
        first -= 1
    row, level = power_db[r], power_db[r, a] - 3.0
    left, right = a, a
    while left > 0 and row[left - 1] > level:
        left -= 1
    while right < grid.num_azimuth - 1 and row[right + 1] > level:
        right += 1
    # The window spreads a point over two bins on each side, so the first bin is too near.
    near = min(first + 1.5, r)
    return np.asarray(grid.bin_to_ego(float(near), 0.5 * (left + right)))


def _fit_box(name: str, near: np.ndarray, ground_m: float) -> list[float]:
    """Returns a box of a class's mean size along x, whose rear side has its center at `near`."""
    length, width, height = SIZES[name][0]
    x, y = near
    return [x + length / 2.0, y, ground_m + height / 2.0, length, width, height, 0.0]
