"""Where a detector is good and where it fails: slices, errors, calibration, confusion.

All of it uses the recommended protocol's matches (every prediction, by falling score,
takes the best free object of its class) at one IoU threshold and one space.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Int, Shaped

from radejax.evaluation import matching, overlap, protocols
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.result import SPACES

DISTANCES_M = (0.0, 20.0, 40.0, 60.0, 80.0, float("inf"))


@dataclasses.dataclass(frozen=True)
class Slice:
    """Numbers of one class in one slice of the data.

    Attributes:
        ap: Exact AP, 0 to 100, NaN without objects.
        precision: Share of predictions above the operating score that are right.
        recall: Share of objects they find.
        num_gt: Objects in the slice.
        num_det: Predictions above the operating score in the slice.
    """

    ap: float
    precision: float
    recall: float
    num_gt: int
    num_det: int


def matched_objects(
    data: EvaluationSet, space: str, iou: float
) -> Int[np.ndarray, " M"]:
    """Ground truth that each prediction found, or -1 (recommended protocol)."""
    match = data.match(protocols.PROTOCOLS[protocols.RECOMMENDED], space, iou)
    assert isinstance(match, np.ndarray)  # the recommended protocol is not K-Radar's
    return match


def by_distance(
    data: EvaluationSet,
    space: str,
    iou: float,
    *,
    edges_m: tuple[float, ...] = DISTANCES_M,
    operating_score: float = 0.3,
) -> dict[tuple[str, str], Slice]:
    """Numbers by (distance band, class); bands are of ground distance sqrt(x^2 + y^2).

    A prediction that found an object belongs to the object's band, any other to its own:
    a detection does not become a false positive for lying just across a border.
    """
    match = matched_objects(data, space, iou)
    far_gt = np.hypot(data.gt.box[:, 0], data.gt.box[:, 1])
    far = np.hypot(data.pred.box[:, 0], data.pred.box[:, 1])
    if far_gt.size:
        far = np.where(match >= 0, far_gt[match], far)
    bands = {}
    for low, high in itertools.pairwise(edges_m):
        band = f"{low:g}-{high:g} m" if np.isfinite(high) else f"{low:g} m and more"
        bands[band] = [(d >= low) & (d < high) for d in (far_gt, far)]
    return _by_slice(data, bands, match, operating_score)


def by_condition(
    data: EvaluationSet,
    conditions: Mapping[str, Bool[np.ndarray, " F"]],
    space: str,
    iou: float,
    *,
    operating_score: float = 0.3,
) -> dict[tuple[str, str], Slice]:
    """Numbers by (condition, class); a condition is a mask of frames."""
    masks = {
        name: (mask[data.gt.frame], mask[data.pred.frame])
        for name, mask in conditions.items()
    }
    match = matched_objects(data, space, iou)
    return _by_slice(data, masks, match, operating_score)


def _by_slice(
    data: EvaluationSet,
    masks: Mapping[str, Sequence[Bool[np.ndarray, " _"]]],
    match: Int[np.ndarray, " M"],
    operating_score: float,
) -> dict[tuple[str, str], Slice]:
    """Numbers by (slice, class).

    Args:
        data: The evaluation set.
        masks: `[N]` objects and `[M]` predictions in each slice.
        match: From `matched_objects`.
        operating_score: Precision and recall are of predictions above this score.
    """
    result = {}
    for (name, (in_gt, in_pred)), (cls, cls_name) in itertools.product(
        masks.items(), enumerate(data.classes)
    ):
        order = data.by_score[cls]
        order = order[in_pred[order]]
        score, is_tp = data.pred.score[order], match[order] >= 0
        num_gt = int((in_gt & (data.gt.cls == cls)).sum())
        curve = protocols.pooled_curve(
            score=score,
            is_tp=is_tp,
            weight=np.ones_like(order),
            num_gt=num_gt,
            curve="all_point",
        )
        above = score > operating_score
        num_det, found = int(above.sum()), int(is_tp[above].sum())
        precision = found / num_det if num_det else math.nan
        recall = found / num_gt if num_gt else math.nan
        result[name, cls_name] = Slice(curve.ap, precision, recall, num_gt, num_det)
    return result


def calibration(
    data: EvaluationSet, space: str, iou: float, *, num_bins: int = 10
) -> dict[str, dict[str, list]]:
    """How often predictions of a score are right, per class and for "all".

    Returns:
        Per class: "low" and "high" edges of the score bins, "count", mean "score" and
        "precision" per bin (NaN where empty), and "error", the mean of
        |precision - score| weighted by count (expected calibration error).
    """
    # Here, for it loads matplotlib, and the numbers of a training run need none of that.
    from radejax.visualize.curves import calibration_bins

    is_match = matched_objects(data, space, iou) >= 0
    edges = np.linspace(0, 1, num_bins + 1)
    result = {}
    for cls, name in [(None, "all"), *enumerate(data.classes)]:
        rows = np.ones(len(data.pred), bool) if cls is None else data.pred.cls == cls
        score, precision, count = calibration_bins(
            data.pred.score[rows], is_match[rows], num_bins
        )
        total = int(count.sum())
        error = float(np.nansum(np.abs(precision - score) * count))
        result[name] = {
            "low": edges[:-1].tolist(),
            "high": edges[1:].tolist(),
            "count": count.tolist(),
            "score": score.tolist(),
            "precision": precision.tolist(),
            "error": error / total if total else math.nan,
        }
    return result


def box_errors(
    data: EvaluationSet, space: str, iou: float, *, operating_score: float = 0.0
) -> dict[str, dict[str, float]]:
    """Errors of matched boxes per class: medians and means over the matches.

    Returns:
        Per class "count" and, as "<what>_mean" and "<what>_median": center_m (distance in
        the ground plane), z_m (absolute), length_m, width_m, height_m (absolute),
        heading_deg (absolute, 0 to 180), axis_deg (heading up to a half turn, 0 to 90),
        and "reversed", the share of headings off by more than 90 degrees. NaN without
        matches.
    """
    match = matched_objects(data, space, iou)
    rows = np.flatnonzero((match >= 0) & (data.pred.score > operating_score))
    found, truth = data.pred.box[rows], data.gt.box[match[rows]]
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
    result = {}
    for cls, name in enumerate(data.classes):
        mine = data.pred.cls[rows] == cls
        numbers: dict[str, float] = {"count": int(mine.sum())}
        for what, values in errors.items():
            numbers[f"{what}_mean"] = _or_nan(np.mean, values[mine])
            numbers[f"{what}_median"] = _or_nan(np.median, values[mine])
        numbers["reversed"] = _or_nan(np.mean, turn[mine] > np.pi / 2)
        result[name] = numbers
    return result


def _or_nan(
    statistic: Callable[[np.ndarray], float], values: Shaped[np.ndarray, " K"]
) -> float:
    return float(statistic(values)) if values.size else math.nan


def confusion(
    data: EvaluationSet, space: str, iou: float, *, operating_score: float = 0.3
) -> Int[np.ndarray, "true predicted"]:
    """Counts: C + 1 true classes by as many predicted, last row and column "none".

    Predictions above the operating score are matched to objects of any class, by falling
    score to the best free object. Row C counts predictions on nothing, column C objects
    that were not found.
    """
    num_classes = len(data.classes)
    pred = data.pred.take(data.pred.score > operating_score)
    first, second = overlap.candidate_pairs(
        pred.frame, data.gt.frame, pred.box, data.gt.box
    )
    ious = overlap.pair_iou(pred.box[first], data.gt.box[second])
    pairs = matching.Pairs(first, second, ious[SPACES.index(space)])
    match = matching.match_free(pairs, pred.score, pred.frame, len(data.gt), iou)
    table = np.zeros((num_classes + 1, num_classes + 1), np.int64)
    hit = match >= 0
    np.add.at(table, (data.gt.cls[match[hit]], pred.cls[hit]), 1)
    np.add.at(table[num_classes], pred.cls[~hit], 1)
    missed = np.ones(len(data.gt), bool)
    missed[match[hit]] = False
    np.add.at(table[:, num_classes], data.gt.cls[missed], 1)
    return table


def worst_frames(
    data: EvaluationSet,
    space: str,
    iou: float,
    *,
    count: int = 10,
    operating_score: float = 0.3,
) -> list[dict[str, int]]:
    """Frames with the most mistakes above the operating score.

    Returns:
        Up to `count` entries, worst first: "index" in the frame table, "frame" id,
        "missed" objects, "false" predictions, "found". Ties: more missed first, then the
        order of the frame table. Frames without a mistake are never listed.
    """
    match = matched_objects(data, space, iou)
    above = data.pred.score > operating_score
    num = data.frame.size
    found = np.bincount(data.pred.frame[above & (match >= 0)], minlength=num)
    false = np.bincount(data.pred.frame[above & (match < 0)], minlength=num)
    missed = data.gt_count.sum(axis=1) - found
    order = np.lexsort((np.arange(num), -missed, -(missed + false)))[:count]
    columns = {
        "index": np.arange(num),
        "frame": data.frame,
        "missed": missed,
        "false": false,
        "found": found,
    }
    return [
        {name: int(column[i]) for name, column in columns.items()}
        for i in order
        if missed[i] + false[i] > 0
    ]
