"""Analysis of the strengths and failures of a detector: subsets, box errors, worst frames.

All functions use the matches of the protocol `all_point` at one IoU threshold: by
descending score, every prediction is matched to the best unmatched object of its class.
The sanity checks at the end report systematic errors of the predictions.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Bool, Int, Shaped

from radejax.core.errors import require
from radejax.evaluation.boxes import Columns
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import pooled_curve
from radejax.evaluation.results import Metric, condition_masks
from radejax.evaluation.scores import reliability
from radejax.geometry.boxes import MIN_OBJECTS, find_size_problem

DISTANCES_M = (0.0, 20.0, 40.0, 60.0, 80.0, float("inf"))

OPERATING_SCORE = 0.3
"""Score threshold of precision, recall and the worst frames."""

Entry = dict[str, str | float]
"""Numbers of one row of a table, and what they belong to, by name."""

Masks = dict[str, tuple[Bool[np.ndarray, " N"], Bool[np.ndarray, " M"]]]
"""Masks `[N]` of the objects and `[M]` of the predictions by the name of the subset."""


def subsets(data: EvaluationSet, frames: Columns, iou: float) -> dict[str, list[Entry]]:
    """Computes metrics by distance and, as far as known, weather, environment and time.

    Distances are measured in the ground plane. A matched prediction belongs to the
    distance band of its object, any other prediction to the band of its own distance, so
    that a detection just across the border of a band does not become a false positive.

    Returns:
        For each kind of subset, one entry per subset and class. An entry contains the
        name of the subset (under the name of the kind), "cls", "ap" (`all_point`, 3D, 0
        to 100, NaN without objects), "precision" and "recall" above the operating score,
        the number of objects "num_gt", the number of predictions above the operating score
        "num_det", and the expected calibration errors of the scores of all predictions,
        "score_error", and of their probabilities, "probability_error", if there are any. The
        distance "all" is that of all boxes.

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> data = EvaluationSet(car, {**car, "score": [0.9]}, classes=["Sedan"])
        >>> subsets(data, {"frame": [0], "weather": ["fog"]}, 0.5)["weather"][0]["ap"]
        100.0
    """
    match = data.matched_objects("plain", "free", "3d", iou)
    everything = np.ones(len(data.gt), bool), np.ones(len(data.pred), bool)
    kinds = {"distance": {"all": everything} | _by_distance(data, match)}
    for kind in ("weather", "environment", "time"):
        kinds[kind] = {
            name: (mask[data.gt.frame], mask[data.pred.frame])
            for name, mask in condition_masks(frames, kind).items()
        }
    return {
        kind: [
            {kind: name, "cls": cls_name, **_numbers(data, cls, *among, match)}
            for name, among in masks.items()
            for cls, cls_name in enumerate(data.classes)
        ]
        for kind, masks in kinds.items()
        if masks
    }


def _by_distance(data: EvaluationSet, match: Int[np.ndarray, " M"]) -> Masks:
    """Returns the masks of the distance bands."""
    of_gt = np.hypot(data.gt.box[:, 0], data.gt.box[:, 1])
    of_pred = np.hypot(data.pred.box[:, 0], data.pred.box[:, 1])
    is_found = match >= 0
    of_pred[is_found] = of_gt[match[is_found]]
    bands = {}
    for low, high in itertools.pairwise(DISTANCES_M):
        band = f"{low:g}-{high:g} m" if np.isfinite(high) else f"{low:g} m and more"
        in_gt, in_pred = ((d >= low) & (d < high) for d in (of_gt, of_pred))
        bands[band] = in_gt, in_pred
    return bands


def distance_sets(data: EvaluationSet, iou: float) -> dict[str, EvaluationSet]:
    """Returns the evaluation set of each distance band of `subsets`.

    In `all_point` and 3D, predictions match the same objects as among all boxes.

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> data = EvaluationSet(car, {**car, "score": [0.9]}, classes=["Sedan"])
        >>> len(distance_sets(data, 0.5)["20-40 m"].gt)
        1
    """
    bands = _by_distance(data, data.matched_objects("plain", "free", "3d", iou))
    return {name: data.of_boxes(*both, data.frame) for name, both in bands.items()}


def _numbers(
    data: EvaluationSet,
    cls: int,
    in_gt: Bool[np.ndarray, " N"],
    in_pred: Bool[np.ndarray, " M"],
    match: Int[np.ndarray, " M"],
) -> dict[str, float]:
    """Computes AP, precision, recall and counts of one class in one subset."""
    order = data.by_score[(in_pred & (data.pred.cls == cls))[data.by_score]]
    score = data.score[order]
    is_tp = match[order] >= 0
    num_gt = int((in_gt & (data.gt.cls == cls)).sum())
    curve = pooled_curve(score, is_tp, np.ones_like(order), num_gt, "all_point")
    above = score > OPERATING_SCORE
    num_det = int(above.sum())
    found = int(is_tp[above].sum())
    confidences = data.confidences().items()
    errors = {f"{n}_error": reliability(x[order], is_tp).error for n, x in confidences}
    return {
        "ap": curve.ap,
        "precision": found / num_det if num_det else math.nan,
        "recall": found / num_gt if num_gt else math.nan,
        "num_gt": num_gt,
        "num_det": num_det,
        **errors,
    }


def box_errors(
    data: EvaluationSet, iou: float, metrics: Mapping[str, Metric] | None = None
) -> dict[str, dict[str, float]]:
    """Computes mean and median errors per class of boxes matched in the bird's-eye view.

    Predictions with a score of 0 are left out.

    Args:
        data: Evaluation set.
        iou: IoU threshold.
        metrics: Further errors by name. Values that are NaN do not count.

    Returns:
        For each class, the number of matches "count" and, as "<error>_mean" and
        "<error>_median": center_m (distance in the ground plane), z_m, length_m, width_m,
        height_m (absolute), heading_deg (absolute, 0 to 180) and axis_deg (heading modulo
        a half turn, 0 to 90); and "reversed", the fraction of headings with an error of
        more than 90 degrees. The errors are NaN without matches.

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> data = EvaluationSet(car, {**car, "score": [0.9]}, classes=["Sedan"])
        >>> box_errors(data, 0.5)["Sedan"]["center_m_mean"]
        0.0
    """
    match = data.matched_objects("plain", "free", "bev", iou)
    rows = np.flatnonzero((match >= 0) & (data.score > 0))
    found = data.pred.box[rows]
    truth = data.gt.box[match[rows]]
    turn = np.abs(np.angle(np.exp(1j * (found[:, 6] - truth[:, 6]))))
    gap = np.abs(found - truth)
    errors = {
        "center_m": np.hypot(gap[:, 0], gap[:, 1]),
        "z_m": gap[:, 2],
        "length_m": gap[:, 3],
        "width_m": gap[:, 4],
        "height_m": gap[:, 5],
        "heading_deg": np.rad2deg(turn),
        "axis_deg": np.rad2deg(np.minimum(turn, np.pi - turn)),
    }
    pairs = data.matched_pairs(rows, match[rows])
    for name, metric in (metrics or {}).items():
        errors[name] = values = np.asarray(metric(*pairs), np.float64)
        expected = f"an array [{len(rows)}], one value per matched box"
        is_fine = values.shape == rows.shape
        require(is_fine, f"the metric {name} returned", values.shape, expected)
    result = {}
    for cls, name in enumerate(data.classes):
        mine = data.pred.cls[rows] == cls
        numbers: dict[str, float] = {"count": int(mine.sum())}
        for what, values in errors.items():
            known = values[mine & ~np.isnan(values)]
            numbers[f"{what}_mean"] = _or_nan(np.mean, known)
            numbers[f"{what}_median"] = _or_nan(np.median, known)
        numbers["reversed"] = _or_nan(np.mean, turn[mine] > np.pi / 2)
        result[name] = numbers
    return result


def _or_nan(
    statistic: Callable[[np.ndarray], float], values: Shaped[np.ndarray, " K"]
) -> float:
    return float(statistic(values)) if values.size else math.nan


def mistakes(data: EvaluationSet, iou: float) -> dict[str, Int[np.ndarray, "F C"]]:
    """Counts the mistakes in 3D above the operating score per frame and class.

    Returns:
        Counts `[F, C]` by kind: "missed" objects, and false positives. A false positive is a
        "duplicate" if its IoU with an object of its class is above `iou`, as another
        prediction matches this object; of the "wrong class" if this holds for an object of
        another class; a "poor box" if it overlaps an object of its class less; and
        otherwise it is on the "background".

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> found = {**car, "cls": ["Bicycle"], "score": [0.9]}
        >>> data = EvaluationSet(car, found, classes=["Sedan", "Bicycle"])
        >>> [kind for kind, count in mistakes(data, 0.5).items() if count.any()]
        ['missed', 'wrong class']
    """
    match = data.matched_objects("plain", "free", "3d", iou)
    above = data.score > OPERATING_SCORE
    is_missed = ~np.isin(np.arange(len(data.gt)), match[above])
    truth, found = (
        dataclasses.replace(x, cls=np.full(len(x), "any")) for x in (data.gt, data.pred)
    )
    table = {"frame": np.arange(data.frame.size)}
    of_any_class = EvaluationSet(truth, found, classes=["any"], frames=table)
    own, best = np.zeros((2, len(data.pred)))
    for largest, of in ((own, data), (best, of_any_class)):
        np.maximum.at(largest, of.pair_pred, of.overlaps("plain")["3d"])
    counts = {"missed": data.count_groups(data.gt_group[is_missed])}
    is_left = above & (match < 0)
    for kind, is_kind in (
        ("duplicate", own > iou),
        ("wrong class", best > iou),
        ("poor box", own > 0),
        ("background", own >= 0),
    ):
        counts[kind] = data.count_groups(data.pred_group[is_left & is_kind])
        is_left = is_left & ~is_kind
    return counts


def worst_frames(data: EvaluationSet, frames: Columns, iou: float) -> list[Entry]:
    """Finds the frames with the most errors in 3D above the operating score.

    Returns:
        Up to 10 entries, worst first: the "index" in the frame table, the "frame" id, the
        numbers of "missed" objects, "false" predictions and "found" objects and, as far
        as known, "name" and "sequence". Frames with the same number of errors are sorted
        by the number of missed objects, then by the frame table. Frames without an error
        are not listed.

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> data = EvaluationSet(car, {**car, "score": [0.9]}, classes=["Sedan"])
        >>> worst_frames(data, {}, 0.5)
        []
    """
    missed, *others = (x.sum(axis=1) for x in mistakes(data, iou).values())
    false = sum(others, np.zeros_like(missed))
    found = data.gt_count.sum(axis=1) - missed
    num = data.frame.size
    order = np.lexsort((np.arange(num), -missed, -(missed + false)))[:10]
    columns = {
        "index": np.arange(num),
        "frame": data.frame,
        "missed": missed,
        "false": false,
        "found": found,
        **{name: frames[name] for name in ("name", "sequence") if name in frames},
    }
    return [
        {name: np.asarray(column).item(i) for name, column in columns.items()}
        for i in order.tolist()
        if missed[i] + false[i] > 0
    ]


# Sanity checks ------------------------------------------------------------------------

MAX_BEHIND = 0.01
"""Fraction of predictions behind the sensor (x < 0) above which a warning is given.

There is none if objects lie there too, as those of a radar that turns by 360 degrees.
"""

MAX_COPIES = 0.001
"""Fraction of copied boxes above which a warning is given. K-Radar's labels v2.1 have 10 copies
among 115,086 objects."""

MAX_OFFSET_M = 0.25
"""Median offset in meters above which a nearly constant offset is reported."""

MIN_LIMIT = 20
"""Smallest number of predictions per frame that is taken for a limit."""


def sanity_checks(data: EvaluationSet) -> list[str]:
    """Returns warnings if boxes are missing or copied, or use another unit or frame.

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> data = EvaluationSet(car, {**car, "score": [0.9]}, classes=["Sedan"])
        >>> sanity_checks(data)
        []
    """
    lines: list[str] = []
    for name, table in (("objects", data.gt), ("predictions", data.pred)):
        if not len(table):
            lines.append(f"there are no {name} of the evaluated classes in the region")
        rows = np.column_stack([table.frame, table.cls, table.box])
        copies = len(rows) - len(np.unique(rows, axis=0))
        if copies > MAX_COPIES * len(rows):
            lines.append(
                f"{copies} of {len(rows)} {name} are copies of others in their frame, such "
                "as of a frame that was written twice, and count as mistakes: remove them"
            )
    box = data.predictions.box
    is_large = np.abs(box[:, 6]) > 2 * np.pi
    if is_large.any():
        lines.append(
            f"{is_large.sum()} of {len(box)} predictions have |yaw| > 2 pi, up to "
            f"{np.abs(box[:, 6]).max():.4g}: yaw is in radians; --yaw-degrees reads degrees"
        )
    behind = int((box[:, 0] < 0).sum())
    sees_behind = bool((data.ground_truth.box[:, 0] < 0).any())
    if behind > MAX_BEHIND * len(box) and not sees_behind:
        lines.append(
            f"{behind} of {len(box)} predictions lie behind the sensor (x < 0): boxes are "
            "in the radar frame, x forward, y left, z up"
        )
    outside = data.left_out["ground truth: center outside the region of interest"]
    if outside > 2 * len(data.gt):
        lines.append(
            f"{outside} of {outside + len(data.gt)} objects are outside the region "
            f"{data.roi} and not counted: --roi none, or evaluation.roi of the config"
        )
    # Numbers of frames by their number of predictions.
    counts = np.bincount(np.unique(data.predictions.frame, return_counts=True)[1])
    if counts.size > MIN_LIMIT and counts[-1] > 2 + 2 * counts[-2]:
        lines.append(
            f"{counts[-1]} frames have {counts.size - 1} predictions and none has more: "
            "others seem to be dropped at a limit, such as config.decode.max_detections"
        )
    return lines + _constant_offset(data)


def _constant_offset(data: EvaluationSet) -> list[str]:
    """Warns if the best prediction near each object has a constant offset or scale."""
    by_score = np.argsort(data.score[data.pair_pred], kind="stable")
    best = np.full(len(data.gt), -1)
    best[data.pair_gt[by_score]] = data.pair_pred[by_score]
    has = best >= 0
    if has.sum() < MIN_OBJECTS:
        return []
    lines = []
    found, truth = data.pred.box[best[has]], data.gt.box[has]
    if problem := find_size_problem(found[:, 3:6], truth[:, 3:6]):
        lines.append(
            f"predictions have {problem} of their objects (median); boxes have full extents"
            " in meters, the length along the heading"
        )
    gap = found[:, :3] - truth[:, :3]
    median = np.median(gap, axis=0)
    spread = np.median(np.abs(gap - median), axis=0)
    is_constant = (np.abs(median) > MAX_OFFSET_M) & (np.abs(median) > 1.5 * spread)
    if not is_constant.any():
        return lines
    x, y, z = (f"{value:+.2f}" for value in median)
    hint = ""
    if is_constant[2]:
        hint = f"; --z-offset {-median[2]:.2f} of `radejax score` moves them"
    return [
        *lines,
        f"predictions lie ({x}, {y}, {z}) m from their objects (x, y, z; median of "
        f"{has.sum()}); boxes are in the radar frame, which is K-Radar's "
        f"LiDAR frame + (-2.54, 0.3, 0), with z at mid-height{hint}",
    ]
