"""A classical baseline: CA-CFAR, clustering, and boxes by rules.

Bins that exceed the mean of their neighborhood (cell-averaging CFAR) are grouped into clusters.
The radar cross-section (RCS) of a cluster from the radar equation selects its class, and the
mean size of the class gives its box. Only the RCS limits between classes are fitted.

References:
    Cell averaging: Richards, Fundamentals of Radar Signal Processing, ch. 6.
    Clusters of radar detections: Kellner et al., "Grid-based DBSCAN for clustering extended
    objects in radar data", IV 2012.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from radejax.core.structures import CLASSES
from radejax.data.projection import LOG_OFFSET_DB, LOG_SCALE_DB
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.traffic import SIZES


@dataclasses.dataclass(frozen=True)
class CfarSettings:
    """Settings of the baseline.

    Attributes:
        threshold_db: Power of a detected bin above the mean of its training cells.
        guard_cells: Half width of the guard around a bin, in bins.
        training_cells: Half width of the ring of training cells around the guard.
        peak_drop_db: A cluster ends where the power is this far below its peak.
        merge_m: Clusters whose peaks are closer than this are merged.
        rcs_steps: Smallest apparent RCS in dBsm of each class, in descending order; weaker
            clusters are clutter. A bin contains only a part of an object's power.
            `fit_rcs_steps` estimates the limits on a training split; the defaults are
            those of the quickstart's dataset.
    """

    threshold_db: float = 9.0
    guard_cells: int = 4
    training_cells: int = 6
    peak_drop_db: float = 12.0
    merge_m: float = 4.5
    rcs_steps: tuple[tuple[str, float], ...] = (
        ("Bus or Truck", 9.0),
        ("Sedan", -5.0),
        ("Motorcycle", -7.0),
        ("Bicycle", -9.0),
        ("Pedestrian", -16.0),
    )


def fit_rcs_steps(
    cls: Sequence[str],
    rcs_dbsm: Sequence[float],
    *,
    balanced: bool = False,
    least_gap_db: float = 1.0,
) -> tuple[tuple[str, float], ...]:
    """Fit the RCS limits between classes to labeled objects.

    Classes are ordered by their median. The limit between two neighbors is the one with the fewest
    classification errors. The limit of the last class is its lower quartile: weaker clusters are
    clutter.

    Args:
        cls: Class name of each object.
        rcs_dbsm: Apparent RCS of each object, see `object_rcs_db`.
        balanced: Count errors as fractions of their classes, so that rare classes have the
            same weight as frequent ones.
        least_gap_db: Smallest RCS interval of a class.

    Returns:
        Pairs of name and smallest RCS, for `CfarSettings.rcs_steps`.
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
    """Apparent RCS `[N]` of boxes `[N, 7]`: that of the strongest bin in each box.

    NaN for boxes that contain no bin center.
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
    """RCS in dBsm from the radar equation and a bin's power in dB."""
    return power_db - parameters.gain_db + 40.0 * np.log10(np.maximum(range_m, 1.0))


def _power_db(projection: np.ndarray, grid: RadarGrid) -> np.ndarray:
    """Range-azimuth map `[R, A]` in dB."""
    return projection[..., : grid.num_doppler].max(-1) * LOG_SCALE_DB - LOG_OFFSET_DB


def detect(
    projection: np.ndarray,
    grid: RadarGrid,
    parameters: RadarParameters,
    settings: CfarSettings | None = None,
    *,
    ground_m: float = -1.6,
) -> dict[str, np.ndarray]:
    """Detect boxes in one projection.

    Args:
        projection: Normalized projection `[R, A, D+E]`.
        grid: Sensor axes of the projection.
        parameters: Gain and noise of the radar, for the RCS.
        settings: Thresholds; None for the defaults.
        ground_m: Height of the ground in the radar frame, on which boxes stand.

    Returns:
        Columns `box [K, 7]` (radar frame), `cls [K]` class names and `score [K]` in [0, 1], by
        descending score.
    """
    settings = settings or CfarSettings()
    power_db = _power_db(projection, grid)
    excess_db = power_db - local_mean_db(power_db, settings)
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


def local_mean_db(power_db: np.ndarray, settings: CfarSettings) -> np.ndarray:
    """Mean power `[R, A]` of the training cells around each bin, in dB.

    Linear power is averaged. The map is padded with its edge values.
    """
    power = 10.0 ** (power_db / 10.0)
    inner = 2 * settings.guard_cells + 1
    outer = inner + 2 * settings.training_cells
    whole = ndimage.uniform_filter(power, outer, mode="nearest") * outer**2
    guard = ndimage.uniform_filter(power, inner, mode="nearest") * inner**2
    mean = (whole - guard) / (outer**2 - inner**2)
    return 10.0 * np.log10(np.maximum(mean, 1e-10))


def find_peaks(
    power_db: np.ndarray,
    excess_db: np.ndarray,
    grid: RadarGrid,
    settings: CfarSettings,
) -> list[tuple[int, int]]:
    """Local maxima above the threshold by descending power, none close to a stronger one."""
    is_peak = (power_db == ndimage.maximum_filter(power_db, 3)) & (
        excess_db > settings.threshold_db
    )
    cells = np.argwhere(is_peak)
    cells = cells[np.argsort(-power_db[tuple(cells.T)], kind="stable")]
    places = grid.bin_to_ego(cells[:, 0].astype(float), cells[:, 1].astype(float))
    kept: list[int] = []
    for i, place in enumerate(places):
        # One object has several peaks, most of them along the range axis.
        gap = np.hypot(*(places[kept] - place).T) if kept else np.zeros(0)
        if not (gap < settings.merge_m).any():
            kept.append(i)
    return [tuple(cells[i]) for i in kept]


def _near_side(power_db, r, a, grid, settings) -> np.ndarray:
    """Ground position `[2]` of the near side of the cluster around a peak."""
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
    # The window spreads a point over two bins on either side.
    near = min(first + 1.5, r)
    return np.asarray(grid.bin_to_ego(float(near), 0.5 * (left + right)))


def _fit_box(name: str, near: np.ndarray, ground_m: float) -> list[float]:
    """Box of the mean size of a class, heading along x, with a given near side."""
    length, width, height = SIZES[name][0]
    x, y = near
    return [x + length / 2.0, y, ground_m + height / 2.0, length, width, height, 0.0]
