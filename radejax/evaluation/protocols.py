"""Evaluation protocols: their treatment of boxes, frames, matches and curves.

All computations are exact for weighted frames: a weight of 0 ignores a frame, a weight of
2 counts it twice. Conditions (weathers) and bootstrap resamples are frame weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Real

from radejax.core.errors import require
from radejax.core.options import find_part

EMPTY_FRAMES = ("protocol", "class", "frame", "none")
"""Rules for the frames to ignore, see `evaluate`."""

EPSILON = 1e-12  # of RADE-Net's evaluator, in both precision and recall

Geometry = Literal["plain", "rounded", "swapped_lw", "swapped_lw_z_top"]
CurveKind = Literal["r40", "r11", "voc11", "recall41", "coco101", "auc", "all_point"]


@dataclasses.dataclass(frozen=True)
class Protocol:
    """Definition of an average precision.

    Attributes:
        name: Name in results and reports.
        geometry: Boxes that are compared: "plain" for boxes as given; "rounded" for
            ground truth rounded to 2 decimals; "swapped_lw" for rounded ground truth and
            l and w swapped (K-Radar's export); "swapped_lw_z_top" for the same with z
            taken as the top of the box.
        matching: "kradar" for two passes in ground-truth order; "best" if each prediction
            can only be matched to its own best object; "free" if predictions are matched
            by descending score to their best unmatched object.
        curve: Method to compute the AP from the precisions.
        empty_frames: Frames to ignore by default: "class" for frames without an object of
            the class, "frame" for frames without an object of any class, "none" for no
            frames.
        is_fixed: Whether reports evaluate every prediction and every frame in this
            protocol, regardless of their score threshold and empty-frame rule.
    """

    name: str
    geometry: Geometry
    matching: Literal["kradar", "best", "free"]
    curve: CurveKind
    empty_frames: Literal["class", "frame", "none"]
    is_fixed: bool = False

    def resolve_empty_frames(self, empty_frames: str) -> str:
        """Returns the empty-frame rule, which is the protocol's own for "protocol"."""
        expected = f"one of {', '.join(EMPTY_FRAMES)}"
        require(empty_frames in EMPTY_FRAMES, "empty_frames", empty_frames, expected)
        return self.empty_frames if empty_frames == "protocol" else empty_frames


AUTHORS_PROTOCOL = "coco101"
"""Protocol of RADE-Net's and DinoRADE's own results: RADE-Net's evaluator at 101 recall levels,
without frames that lack the class. An AP printed as 0.99 is its lower bound, 100 / 101."""

RECOMMENDED = "all_point"
"""Recommended protocol, for the reasons in docs/evaluation.md."""


_ALL = (
    # K-Radar's revised evaluation as published, with length and width swapped.
    Protocol("kradar_r40", "swapped_lw", "kradar", "r40", "frame"),
    # K-Radar's revised evaluation without the swap, so that the yaw is correct.
    Protocol("kradar_r40_corrected", "rounded", "kradar", "r40", "frame"),
    # K-Radar's older evaluation: 11 of 41 samples, z as the top of a box.
    Protocol("kradar_r11", "swapped_lw_z_top", "kradar", "r11", "frame"),
    # RADE-Net's evaluator: 11, 41 or 101 recall levels, or the area under the raw curve.
    Protocol("voc11", "plain", "best", "voc11", "class"),
    Protocol("recall41", "plain", "best", "recall41", "class"),
    Protocol("coco101", "plain", "best", "coco101", "class"),
    Protocol("auc", "plain", "best", "auc", "class"),
    # The exact area under the interpolated curve; every frame counts.
    Protocol(RECOMMENDED, "plain", "free", "all_point", "none", is_fixed=True),
)
PROTOCOLS = {protocol.name: protocol for protocol in _ALL}


def get_protocol(name: str, field: str = "protocols") -> Protocol:
    """Returns the protocol of a name, or of "module:Object", which is then its name.

    Args:
        name: Name of the protocol.
        field: Name of the option for the error message.

    Raises:
        UserError: There is no such protocol; the message lists all.

    Examples:
        >>> get_protocol("kradar_r40").name
        'kradar_r40'
    """
    found = find_part(name, field, PROTOCOLS, Protocol)
    return dataclasses.replace(found, name=name)


@dataclasses.dataclass(frozen=True)
class Curve:
    """An average precision and its precision-recall curve.

    Attributes:
        ap: Average precision, 0 to 100. Without objects, it is 0 in K-Radar's protocols
            and NaN in the others.
        num_gt: Number of objects in the frames that are evaluated.
        num_det: Number of predictions in these frames above the score threshold.
        precision: Precision at each sample, monotone in K-Radar's protocols and raw in
            the others.
        recall: Recall at each sample.
        score: Score threshold of each sample, descending.
    """

    ap: float
    num_gt: int
    num_det: int
    precision: Float[np.ndarray, " K"] = dataclasses.field(repr=False)
    recall: Float[np.ndarray, " K"] = dataclasses.field(repr=False)
    score: Float[np.ndarray, " K"] = dataclasses.field(repr=False)

    @property
    def is_defined(self) -> bool:
        """Whether the class occurs; otherwise reports show `-`."""
        return self.num_gt > 0

    @property
    def ap_or_none(self) -> float | None:
        """AP, or None in every protocol if the class does not occur."""
        return self.ap if self.is_defined else None


def mean_curve(
    curves: Sequence[Curve],
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, " K"]]:
    """Computes recall and interpolated precision of the mean curve, as of several seeds.

    The area under the mean is the mean AP in `all_point`.

    Examples:
        >>> one = Curve(50.0, 2, 1, np.ones(1), np.array([0.5]), np.ones(1))
        >>> all_found = Curve(100.0, 2, 2, np.ones(2), np.array([0.5, 1.0]), np.ones(2))
        >>> mean_curve([one, all_found])[1].tolist()
        [1.0, 0.5]
    """
    recall = np.unique(np.concatenate([curve.recall for curve in curves]))
    heights = []
    for curve in curves:
        height = np.maximum.accumulate(curve.precision[::-1])[::-1]
        at = np.searchsorted(curve.recall, recall)
        heights.append(np.append(height, 0.0)[at])
    return recall, np.mean(heights, axis=0)


def score_thresholds(
    sampled: Float[np.ndarray, " S"], weight: Real[np.ndarray, " S"], num_gt: int
) -> Float[np.ndarray, " K"]:
    """Computes K-Radar's score thresholds, at most 41 at recall steps of 1/40.

    K-Radar's code goes through the matched scores in descending order, starting with c =
    0. The i-th score is skipped if (i+2)/n - c < c - (i+1)/n and it is not the last one;
    otherwise it is kept and c is increased by 1/40. Both sides are monotone in i even
    after rounding, so the first score that is not skipped for a given c is found by
    counting. The k-th kept score is this one or the score after the (k-1)-th kept one,
    whichever comes later.

    Args:
        sampled: Scores of the matched predictions, descending.
        weight: Number of times that each score counts.
        num_gt: Number of ground truths n.

    Returns:
        K <= 41 thresholds in descending order; none without matches.

    References:
        K-Radar, utils/kitti_eval/eval_revised.py: get_thresholds.

    Examples:
        >>> score_thresholds(np.array([0.9, 0.8, 0.6]), np.ones(3), 3).tolist()
        [0.9, 0.8, 0.6]
    """
    ends = np.cumsum(weight)
    total = int(ends[-1]) if ends.size else 0
    if total == 0 or num_gt == 0:
        return np.zeros(0)
    current = np.cumsum([0.0, *[1.0 / 40.0] * 40])  # sequential, as in the original
    # The inequality changes at i = c n - 3/2. The exact index is found by evaluating it
    # with the original rounding in a window around this value.
    low = np.maximum(np.ceil(current * num_gt - 1.5).astype(np.int64) - 4, 0)
    index = low[:, None] + np.arange(9)
    left = (index + 1) / num_gt
    right = (index + 2) / num_gt
    skipped = (right - current[:, None]) < (current[:, None] - left)
    crossing = np.minimum(low + skipped.sum(axis=1), total - 1)
    steps = np.arange(crossing.size)
    kept = steps + np.maximum.accumulate(crossing - steps)
    kept = kept[kept < total]
    # The last score is always kept, and there is none after it.
    return sampled[np.searchsorted(ends, kept, side="right")]


def kradar_curve(
    matched: tuple[Float[np.ndarray, " S"], Real[np.ndarray, " S"]],
    events: tuple[Float[np.ndarray, " E"], Real[np.ndarray, " E"]],
    detections: tuple[Float[np.ndarray, " M"], Real[np.ndarray, " M"]],
    num_gt: int,
    samples: CurveKind,
) -> Curve:
    """Computes the AP in K-Radar's protocols from the steps of `matching.match_kradar`.

    Args:
        matched: Scores of the predictions matched in the first pass, descending, and the
            weights of their frames.
        events: Scores at which the number of true positives changes, descending, and the
            changes times the weights of their frames.
        detections: Scores of all predictions, descending, and the weights of their frames.
        num_gt: Number of ground truths.
        samples: "r40" for all 41 precision samples, "r11" for every fourth.

    Examples:
        >>> both = np.array([0.9, 0.6]), np.ones(2)
        >>> curve = kradar_curve(both, both, both, 2, "r40")
        >>> round(curve.ap, 2), curve.recall.tolist()
        (4.88, [0.5, 1.0])
    """
    thresholds = score_thresholds(*matched, num_gt)
    found = _sum_at_least(*events, thresholds)
    made = _sum_at_least(*detections, thresholds)
    precision = np.zeros(41)
    precision[: thresholds.size] = found / np.maximum(made, 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    taken = precision[:: 1 if samples == "r40" else 4]
    return Curve(
        ap=float(taken.sum() / taken.size * 100),
        num_gt=int(num_gt),
        num_det=int(detections[1].sum()),
        precision=precision[: thresholds.size],
        recall=found / max(num_gt, 1),
        score=thresholds,
    )


def _sum_at_least(
    score: Float[np.ndarray, " E"],
    value: Real[np.ndarray, " E"],
    at: Float[np.ndarray, " K"],
) -> Real[np.ndarray, " K"]:
    """Sums `value` over the entries with score >= `at`; the scores are descending."""
    total = np.concatenate([[0], np.cumsum(value)])
    return total[np.searchsorted(-score, -at, side="right")]


def pooled_curve(
    score: Float[np.ndarray, " M"],
    is_tp: Bool[np.ndarray, " M"],
    weight: Real[np.ndarray, " M"],
    num_gt: int,
    curve: str,
) -> Curve:
    """Computes the AP from all predictions in descending order of their scores.

    Args:
        score: Scores of the predictions, descending.
        is_tp: Whether each prediction is a true positive.
        weight: Weights of the frames of the predictions.
        num_gt: Number of ground truths.
        curve: "voc11", "recall41", "coco101", "auc" (RADE-Net) or "all_point".

    Examples:
        >>> score, is_tp = np.array([0.9, 0.8, 0.6]), np.array([True, False, True])
        >>> round(pooled_curve(score, is_tp, np.ones(3), 2, "all_point").ap, 2)
        83.33
    """
    counts = weight > 0  # an excluded frame must not leave a point at recall 0
    score = score[counts]
    is_tp = is_tp[counts]
    weight = weight[counts]
    num_det = int(weight.sum())
    found = np.cumsum(is_tp * weight)
    made = np.cumsum(weight)
    if curve == "all_point":
        # Equal scores are one threshold, so that their order does not matter.
        last = np.diff(score, append=-np.inf) != 0
        score = score[last]
        found = found[last]
        precision = found / made[last]
        recall = found / max(num_gt, 1)
    else:
        precision = found / (made + EPSILON)
        recall = found / (num_gt + EPSILON)
    if num_gt == 0:
        ap = float("nan")
    elif num_det == 0:
        ap = 0.0
    else:
        ap = 100 * _pooled_ap(precision, recall, curve)
    return Curve(ap, int(num_gt), num_det, precision, recall, score)


def _pooled_ap(
    precision: Float[np.ndarray, " K"], recall: Float[np.ndarray, " K"], curve: str
) -> float:
    """Computes the AP in [0, 1] of a curve with increasing recall."""
    if curve == "all_point":
        height = np.maximum.accumulate(precision[::-1])[::-1]
        return float((np.diff(recall, prepend=0.0) * height).sum())
    precision = np.concatenate([[1.0], precision])
    recall = np.concatenate([[0.0], recall])
    if curve == "auc":
        return float(np.trapezoid(precision, recall))
    levels = np.linspace(0.0, 1.0, {"voc11": 11, "recall41": 41, "coco101": 101}[curve])
    height = np.concatenate([np.maximum.accumulate(precision[::-1])[::-1], [0.0]])
    return float(height[np.searchsorted(recall, levels, side="left")].mean())
