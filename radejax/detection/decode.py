"""Decoding of a detector's maps to boxes: heatmap peaks, box parameters and rotated NMS.

`decode` is a pure function with fixed shapes. It returns K rows per frame, a mask of the
rows that contain a detection, and the number of truncated detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pydantic
from flax import struct
from jaxtyping import Bool, Float, Int, Num, Real, Shaped

from radejax.core.errors import require
from radejax.core.options import AtLeastOne, Fraction, Options, Positive, ScoreThreshold
from radejax.core.structures import MIN_SIZE_M, Array, DetectionMaps, Detections
from radejax.detection.nms import rotated_nms
from radejax.geometry.boxes import boxes7_from_8
from radejax.geometry.radar_grid import RadarGrid

Scalar = float | Float[Array, ""]
Thresholds = Scalar | Sequence[float] | Float[Array, " C"]
Roi = Real[Array, "6"] | Sequence[Scalar]


class DecodeOptions(Options, section="config.decode"):
    """Options of `decode`."""

    max_detections: AtLeastOne = 100
    """Rows of the output per frame."""
    score_threshold: ScoreThreshold = 0.3
    """Score threshold of all classes, or one per class in their order."""
    threshold_inclusive: bool = True
    """Keep scores equal to the threshold, as in the paper; the authors' code does not."""
    nms_iou: Fraction = 0.3
    """NMS removes a box whose IoU with a better box is at least this."""
    per_class_nms: bool = False
    """Apply NMS to each class separately."""
    roi: tuple[float, ...] | None = None
    """Region of interest: x0, x1, y0, y1, z0, z1 in meters. Boxes whose center is
    outside are removed before NMS. None: everywhere."""
    raw_yaw: Literal["nms", "always", "never"] = "nms"
    """Where the length of the regressed (sin, cos) vector scales length and width: nms (in
    NMS only), always (in the results too, as in the released evaluator), never."""
    calibration: tuple[tuple[Positive, float], ...] | None = None
    """Temperature and offset per class, by which scores become probabilities (see
    `scores.fit_calibration`); None: no probabilities. `radejax calibrate` fits them."""
    clip_sizes: bool = True
    """Clip sizes to at least 0.01 m; in the authors' code, they may be negative."""

    @pydantic.model_validator(mode="after")
    def _check(self) -> DecodeOptions:
        is_fine = self.roi is None or is_roi(self.roi)
        require(is_fine, "config.decode.roi", self.roi, f"{ROI_LIMITS}, or None")
        return self


ROI_LIMITS = "six numbers x0 < x1, y0 < y1, z0 < z1"


def is_roi(roi: object) -> bool:
    """Returns whether values are the `ROI_LIMITS` of a region, which may be infinite.

    Examples:
        >>> is_roi([0, 72, -6.4, 6.4, -2, 6]), is_roi([0, 72, None, None, -2, 6])
        (True, False)
    """
    limits = np.array(roi, float)  # None becomes NaN
    return limits.shape == (6,) and bool((limits[::2] < limits[1::2]).all())


class Peaks(struct.PyTreeNode):
    """The highest heatmap peaks of a batch, by descending score, before NMS.

    Attributes:
        bins: `[B, P, 2]` int32 range and azimuth bins.
        boxes: `[B, P, 8]` boxes decoded at these bins, with the yaw vector as regressed.
        scores: `[B, P]` scores, 0 where `is_valid` is False.
        classes: `[B, P]` int32 class indices.
        is_valid: `[B, P]` bool, True where a row contains a peak.
        num_found: `[B]` int32 number of all peaks that pass the threshold and the region,
            including those beyond P.
        outputs: `[B, P, ...]` further outputs of the model at these bins, by name.
    """

    bins: jax.Array
    boxes: jax.Array
    scores: jax.Array
    classes: jax.Array
    is_valid: jax.Array
    num_found: jax.Array
    outputs: dict[str, jax.Array] = struct.field(default_factory=dict)


def decode(
    maps: DetectionMaps,
    grid: RadarGrid,
    options: DecodeOptions,
    *,
    score_threshold: Thresholds | None = None,
    nms_iou: Scalar | None = None,
    roi: Roi | None = None,
    pre_nms: int | None = None,
) -> Detections:
    """Decodes a batch of detection maps to boxes.

    As in the authors' code, a peak is a bin whose score passes the threshold and is not
    exceeded in its 3 x 3 neighborhood in the map of the same class. A bin gives at most one
    box, of the class with the highest score (the first of equals). Boxes whose center is
    outside the region are removed, and greedy bird's-eye-view NMS follows.

    Args:
        maps: Heatmap logits and box parameters in any float dtype; scores are computed
            in float32.
        grid: The grid of the maps.
        options: Options, which are constants under `jit`. The result has
            K = `max_detections` rows, or fewer if fewer peaks can enter NMS.
        score_threshold: Score that a peak must reach, one or `[C]`; may be traced, as may the
            next two. Each replaces the value in `options` unless it is None.
        nms_iou: IoU at or above which the box with the lower score is removed.
        roi: `[6]` region (x0, x1, y0, y1, z0, z1) in meters, including its bounds.
        pre_nms: Maximum number of peaks that enter NMS, those with the highest scores;
            2 K by default.

    Returns:
        Detections by descending score; those with equal scores are ordered by range bin,
        then azimuth bin. `num_truncated` counts peaks beyond `pre_nms` and boxes beyond K
        after NMS. With `options.calibration`, `outputs` has the "probability" that each
        detection matches an object.

    Raises:
        ValueError: The shapes of maps and grid differ, no peak may enter NMS, or `roi` does
            not have shape [6].

    Examples:
        >>> grid = RadarGrid.reduced(
        ...     num_doppler=4, num_range=16, num_elevation=4, num_azimuth=8)
        >>> logits = jnp.full((1, 16, 8, 2), -9.0).at[0, 5, 3, 1].set(2.0)
        >>> maps = DetectionMaps(logits, jnp.ones((1, 16, 8, 8)))
        >>> jitted = jax.jit(decode, static_argnames=("grid", "options"))
        >>> found = jitted(maps, grid, DecodeOptions(max_detections=4))
        >>> found.classes.tolist(), round(float(found.scores[0, 0]), 4)
        ([[1, -1, -1, -1]], 0.8808)
    """
    if score_threshold is None:
        score_threshold = options.score_threshold
    peaks = find_peaks(
        maps,
        grid,
        max_peaks=2 * options.max_detections if pre_nms is None else pre_nms,
        score_threshold=score_threshold,
        roi=options.roi if roi is None else roi,
        threshold_inclusive=options.threshold_inclusive,
    )
    least_m = MIN_SIZE_M if options.clip_sizes else -jnp.inf
    boxes = peaks.boxes.at[..., 3:6].max(least_m)
    keep = rotated_nms(
        boxes7_from_8(boxes) if options.raw_yaw == "never" else boxes,
        peaks.is_valid,
        options.nms_iou if nms_iou is None else nms_iou,
        classes=peaks.classes if options.per_class_nms else None,
    )
    if options.raw_yaw == "always":
        length = jnp.linalg.norm(boxes[..., 6:8], axis=-1, keepdims=True)
        boxes = boxes.at[..., 3:5].multiply(length).at[..., 3:6].max(least_m)
    found = _compact(peaks.replace(boxes=boxes), keep, options.max_detections)
    if options.calibration is None:
        return found
    temperature, offset = jnp.array(options.calibration, jnp.float32).T
    # Padding has class -1 and score 0, whose probability is 0.
    logits = jnp.log(found.scores) - jnp.log1p(-found.scores)
    probability = jax.nn.sigmoid(
        logits / temperature[found.classes] + offset[found.classes]
    )
    return found.replace(outputs=found.outputs | {"probability": probability})


def find_peaks(
    maps: DetectionMaps,
    grid: RadarGrid,
    *,
    max_peaks: int,
    score_threshold: Thresholds,
    roi: Roi | None = None,
    threshold_inclusive: bool = True,
) -> Peaks:
    """Returns the highest local maxima of the heatmaps with their boxes, before NMS.

    Arguments are those of `decode` and fields of `DecodeOptions`. `max_peaks` is P, which is
    at most the number of bins.

    Raises:
        ValueError: The shapes of maps and grid differ, P is below 1, or `roi` does not have
            shape [6].

    Examples:
        >>> grid = RadarGrid.reduced(
        ...     num_doppler=4, num_range=16, num_elevation=4, num_azimuth=8)
        >>> logits = jnp.full((1, 16, 8, 2), -9.0).at[0, 5, 3, 1].set(2.0)
        >>> maps = DetectionMaps(logits, jnp.ones((1, 16, 8, 8)))
        >>> jitted = jax.jit(find_peaks, static_argnames=("grid", "max_peaks"))
        >>> peaks = jitted(maps, grid, max_peaks=4, score_threshold=0.3)
        >>> peaks.bins[0, 0].tolist(), int(peaks.classes[0, 0]), int(peaks.num_found[0])
        ([5, 3], 1, 1)
    """
    grid.check_maps(maps.heatmap_logits, maps.box_params)
    if max_peaks < 1:
        raise ValueError(f"at least 1 peak must enter NMS, got {max_peaks}")
    num_azimuth = maps.heatmap_logits.shape[2]
    scores = jax.nn.sigmoid(maps.heatmap_logits.astype(jnp.float32))
    passes = jnp.greater_equal if threshold_inclusive else jnp.greater
    least = jnp.asarray(score_threshold, scores.dtype)
    least = jnp.broadcast_to(least, scores.shape[-1:])[None, None, None]
    is_peak = passes(scores, least) & (scores >= _max_3x3(scores))
    scores = jnp.where(is_peak, scores, 0.0)
    best = jnp.max(scores, axis=-1)  # [B, R, A]
    if roi is not None:
        best = jnp.where(_in_roi(maps.box_params, grid, roi), best, 0.0)
    best = best.reshape(best.shape[0], -1)  # [B, R * A]
    top, flat = jax.lax.top_k(best, min(max_peaks, best.shape[1]))
    classes = jnp.argmax(rows_at(_flat_bins(scores), flat), -1)  # the first of equals
    params = rows_at(_flat_bins(maps.box_params), flat).astype(jnp.float32)
    bins = jnp.stack([flat // num_azimuth, flat % num_azimuth], -1)
    return Peaks(
        bins=bins,
        boxes=grid.boxes_at(params, bins),
        scores=top,
        classes=classes.astype(jnp.int32),
        is_valid=top > 0,
        num_found=jnp.sum(best > 0, axis=-1, dtype=jnp.int32),
        outputs={n: rows_at(_flat_bins(x), flat) for n, x in maps.outputs.items()},
    )


@jax.vmap
def rows_at(
    rows: Shaped[jax.Array, "N ..."], indices: Int[jax.Array, " K"]
) -> Shaped[jax.Array, "K ..."]:
    """Returns rows of every frame: `[B, N, ...]` at `[B, K]` -> `[B, K, ...]`.

    Args:
        rows: Rows `[B, N, ...]`.
        indices: Positions `[B, K]` from 0 to N - 1.

    Example:
        >>> rows_at(jnp.array([[5.0, 6.0, 7.0]]), jnp.array([[2, 0]])).tolist()
        [[7.0, 5.0]]
    """
    return rows[indices]


def _max_3x3(values: Float[jax.Array, "B R A C"]) -> Float[jax.Array, "B R A C"]:
    """Returns the maximum over each bin and its neighbors in range and azimuth."""
    for axis in (1, 2):
        size = values.shape[axis]
        pad = [(0, 0)] * values.ndim
        pad[axis] = (1, 1)
        padded = jnp.pad(values, pad, constant_values=-jnp.inf)
        shifts = [jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in (0, 2)]
        values = jnp.maximum(values, jnp.maximum(*shifts))
    return values


def _in_roi(
    params: Float[jax.Array, "B R A 8"], grid: RadarGrid, roi: Roi
) -> Bool[jax.Array, "B R A"]:
    """Returns True for bins whose box has its center in the region."""
    roi = jnp.asarray(roi, jnp.float32)
    if roi.shape != (6,):
        raise ValueError(f"roi must be [6]: x0, x1, y0, y1, z0, z1; got {roi.shape}")
    bins = np.pad(grid.bin_centers_ego(), [(0, 0), (0, 0), (0, 1)])  # [R, A, 3], z = 0
    center = params[..., :3].astype(jnp.float32) + jnp.asarray(bins, jnp.float32)[None]
    low, high = roi.reshape(3, 2).T[:, None, None, None]
    return jnp.all((center >= low) & (center <= high), axis=-1)


def _compact(
    peaks: Peaks, keep: Bool[jax.Array, "B P"], max_detections: int
) -> Detections:
    """Moves the kept peaks to the front, in order, and returns the first K rows."""
    order = jnp.argsort(~keep, axis=-1, stable=True)[:, :max_detections]
    is_valid = rows_at(keep, order)
    boxes = rows_at(peaks.boxes, order)
    num_kept = jnp.sum(keep, axis=-1, dtype=jnp.int32)
    num_entered = jnp.sum(peaks.is_valid, axis=-1, dtype=jnp.int32)
    return Detections(
        boxes=jnp.where(is_valid[..., None], boxes7_from_8(boxes), 0.0),
        scores=jnp.where(is_valid, rows_at(peaks.scores, order), 0.0),
        classes=jnp.where(is_valid, rows_at(peaks.classes, order), -1),
        is_valid=is_valid,
        num_truncated=peaks.num_found
        - num_entered
        + jnp.maximum(num_kept - max_detections, 0),
        outputs={name: rows_at(x, order) for name, x in peaks.outputs.items()},
    )


def _flat_bins(values: Num[jax.Array, "B R A ..."]) -> Num[jax.Array, "B R*A ..."]:
    return values.reshape(values.shape[0], -1, *values.shape[3:])
