"""The classical detector to beat: CA-CFAR, clusters, boxes by rule.

Cells that stand out of their surroundings (cell-averaging CFAR) are grouped into
clusters; the cross-section that the radar equation gives a cluster chooses its class,
and the class's usual size its box. Only the steps between the classes are fitted.

References:
    Cell averaging: Richards, Fundamentals of Radar Signal Processing, ch. 6.
    Clusters of radar detections: Kellner et al., "Grid-based DBSCAN for clustering
    extended objects in radar data", IV 2012.
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
        threshold_db: How far a cell stands above the mean of its surroundings.
        guard_cells: Half width around a cell that does not count as surroundings.
        training_cells: Half width of the surroundings beyond the guard.
        peak_drop_db: A cluster ends where power falls this far below its peak.
        merge_m: Clusters whose peaks are nearer become one.
        rcs_steps: Smallest apparent cross-section in dBsm of each class, the largest
            first; weaker clusters are clutter. A cell holds a part of an object's power
            only. `fit_rcs_steps` finds them on a training split; the defaults are those
            of the quickstart's data set.
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
    """Steps between classes from apparent cross-sections of labelled objects.

    Classes are ordered by their medians; the step between neighbours is the one that
    takes the fewest of their objects for the other class. The last class ends at its
    lower quartile: what is weaker is clutter.

    Args:
        cls: Class names, one an object.
        rcs_dbsm: Apparent cross-sections, see `object_rcs_db`.
        balanced: Count errors as shares of their classes, so that rare classes weigh as
            much as frequent ones.
        least_gap_db: Width that a class keeps at least.

    Returns:
        Pairs of name and smallest cross-section, for `CfarSettings.rcs_steps`.
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
    """`[N]` apparent cross-section of boxes `[N, 7]`: of the strongest cell in each.

    NaN for boxes that hold no cell's center.
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
    """Cross-section in dBsm that the radar equation gives a cell's power in dB."""
    return power_db - parameters.gain_db + 40.0 * np.log10(np.maximum(range_m, 1.0))


def _power_db(projection: np.ndarray, grid: RadarGrid) -> np.ndarray:
    """`[R, A]` range-azimuth map in dB."""
    return projection[..., : grid.num_doppler].max(-1) * LOG_SCALE_DB - LOG_OFFSET_DB


def detect(
    projection: np.ndarray,
    grid: RadarGrid,
    parameters: RadarParameters,
    settings: CfarSettings | None = None,
    *,
    ground_m: float = -1.6,
) -> dict[str, np.ndarray]:
    """Boxes in one projection.

    Args:
        projection: `[R, A, D+E]` normalised projection.
        grid: Its axes.
        parameters: Gain and noise of the radar, for cross-sections.
        settings: Thresholds; None for the defaults.
        ground_m: Height of the ground in the ego frame, on which boxes stand.

    Returns:
        Columns `box [K, 7]` (ego frame), `cls [K]` class names and `score [K]` in
        [0, 1], strongest first.
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
    """`[R, A]` mean power of a frame of cells around each cell, without the guard.

    Linear power is averaged, as cell-averaging CFAR does; cells beyond the edges of
    the map repeat the edge.
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
    """Local maxima above the threshold, strongest first, none near a stronger one."""
    is_peak = (power_db == ndimage.maximum_filter(power_db, 3)) & (
        excess_db > settings.threshold_db
    )
    cells = np.argwhere(is_peak)
    cells = cells[np.argsort(-power_db[tuple(cells.T)], kind="stable")]
    places = grid.bin_to_ego(cells[:, 0].astype(float), cells[:, 1].astype(float))
    kept: list[int] = []
    for i, place in enumerate(places):
        # One object shows several flashes, most along the range axis.
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
    # The window smears a point over two bins on either side.
    near = min(first + 1.5, r)
    return np.asarray(grid.bin_to_ego(float(near), 0.5 * (left + right)))


def _fit_box(name: str, near: np.ndarray, ground_m: float) -> list[float]:
    """A box of the class's mean size, driving along x, whose near side is seen."""
    length, width, height = SIZES[name][0]
    x, y = near
    return [x + length / 2.0, y, ground_m + height / 2.0, length, width, height, 0.0]
