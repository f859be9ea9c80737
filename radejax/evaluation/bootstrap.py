"""Confidence intervals and comparisons by resampling whole sequences.

Frames of one sequence show the same few cars, so they are not independent; sequences
are. A resample draws as many sequences as there are, with replacement, and every frame
counts as often as its sequence was drawn, which all protocols handle exactly.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, Shaped

from radejax.core.errors import UserError
from radejax.evaluation import protocols
from radejax.evaluation.evaluation_set import SPACES, EvaluationSet

LEVEL = 0.95


def sequence_weights(
    sequence: Shaped[np.ndarray, " F"], *, resamples: int, seed: int
) -> Int[np.ndarray, "B F"]:
    """How often each frame counts in each resample; int16.

    Args:
        sequence: Sequence of every frame.
        resamples: Number of resamples B.
        seed: Of the drawing; the same seed draws the same sequences.

    Raises:
        UserError: Fewer than two sequences: there is nothing to resample.
    """
    names, inverse = np.unique(np.asarray(sequence), return_inverse=True)
    if names.size < 2:
        raise UserError(
            f"intervals need at least 2 sequences to resample, found {names.size}"
        )
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(names.size, np.full(names.size, 1 / names.size), resamples)
    return drawn.astype(np.int16)[:, inverse]


def resample(
    data: EvaluationSet,
    weights: Int[np.ndarray, "B F"],
    protocol: str,
    space: str,
    iou: float,
    *,
    empty_frames: str = "protocol",
    score_threshold: float = 0.0,
) -> Float[np.ndarray, "B _"]:
    """`[B, C + 1]` AP of every class, then their mean, in every resample.

    NaN where a resample has no object of a class; the mean is over classes that occur.
    """
    chosen = protocols.get_protocol(protocol)
    empty_frames = chosen.resolve_empty_frames(empty_frames)
    ap = np.full((len(weights), len(data.classes) + 1), np.nan)
    for row, weight in enumerate(weights):
        by_class = data.frame_weights(empty_frames, weight)
        for cls in range(len(data.classes)):
            curve = data.curve(
                chosen, space, iou, float(score_threshold), cls, by_class[:, cls]
            )
            if curve.num_gt:
                ap[row, cls] = curve.ap
        present = ap[row, ~np.isnan(ap[row])]
        ap[row, -1] = present.mean() if present.size else np.nan
    return ap


def interval(samples: Float[np.ndarray, " B"]) -> tuple[float, float]:
    """95 % percentile interval of the samples that are defined; NaN if none is."""
    samples = samples[~np.isnan(samples)]
    if not samples.size:
        return float("nan"), float("nan")
    low, high = np.quantile(samples, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Run B against run A in one metric.

    Attributes:
        cls: Class name or "mean".
        space: "bev" or "3d".
        iou: IoU threshold.
        protocol: Name of the protocol.
        ap_a: AP of run A, all frames.
        ap_b: AP of run B.
        difference: B minus A.
        low: Lower end of the 95 % interval of the difference.
        high: Upper end.
        p_value: Two-sided, from the share of resamples in which the sign turns.
        p_adjusted: The same after Holm's correction over all rows compared together.
        is_significant: Whether `p_adjusted` is below 0.05.
    """

    cls: str
    space: str
    iou: float
    protocol: str
    ap_a: float
    ap_b: float
    difference: float
    low: float
    high: float
    p_value: float
    p_adjusted: float
    is_significant: bool = False


def compare(
    data_a: EvaluationSet,
    data_b: EvaluationSet,
    sequence: Shaped[np.ndarray, " F"],
    *,
    protocol_names: Sequence[str] = (protocols.RECOMMENDED, "kradar_r40"),
    iou_thresholds: Sequence[float] = (0.3,),
    spaces: Sequence[str] = SPACES,
    score_threshold: float = 0.0,
    resamples: int = 2000,
    seed: int = 0,
) -> list[Comparison]:
    """Paired comparison of two runs: both see the same resampled sequences.

    Args:
        data_a: Run A.
        data_b: Run B on the same ground truth and frames.
        sequence: Sequence of every frame.
        protocol_names: Protocols to compare in.
        iou_thresholds: IoU thresholds.
        spaces: "bev", "3d".
        score_threshold: Score threshold of both.
        resamples: Number of resamples.
        seed: Seed of the resampling.

    Raises:
        UserError: The runs differ in classes, frames or ground truth.
    """
    _check_same_truth(data_a, data_b)
    weights = sequence_weights(sequence, resamples=resamples, seed=seed)
    # The first row weights every frame once: the APs themselves.
    weights = np.concatenate([np.ones_like(weights[:1]), weights])
    rows = []
    for metric in itertools.product(protocol_names, spaces, map(float, iou_thresholds)):
        samples_a, samples_b = (
            resample(data, weights, *metric, score_threshold=score_threshold)
            for data in (data_a, data_b)
        )
        for index, name in enumerate((*data_a.classes, "mean")):
            if not np.isnan(samples_a[0, index]):
                pair = samples_a[:, index], samples_b[:, index]
                rows.append(_compare_class(name, metric, *pair))
    return _holm(rows)


def _compare_class(
    cls: str,
    metric: tuple[str, str, float],
    samples_a: Float[np.ndarray, " B"],
    samples_b: Float[np.ndarray, " B"],
) -> Comparison:
    """Comparison of one class from its APs; the first of each is over all frames."""
    protocol, space, iou = metric
    ap_a, ap_b = float(samples_a[0]), float(samples_b[0])
    gaps = samples_b[1:] - samples_a[1:]
    gaps = gaps[~np.isnan(gaps)]
    low, high = interval(gaps)
    # One is added so that no finite number of resamples gives a p-value of 0.
    below, above = (
        (side.sum() + 1) / (gaps.size + 1) for side in (gaps <= 0, gaps >= 0)
    )
    p_value = float(min(1.0, 2 * min(below, above)))
    return Comparison(
        cls, space, iou, protocol, ap_a, ap_b, ap_b - ap_a, low, high, p_value, p_value
    )


def _holm(rows: list[Comparison]) -> list[Comparison]:
    """Adjusts p-values for the number of rows (Holm's step-down)."""
    p_values = np.array([row.p_value for row in rows])
    order = np.argsort(p_values, kind="stable")
    scaled = np.minimum(1, np.arange(len(rows), 0, -1) * p_values[order])
    adjusted = np.empty(len(rows))
    adjusted[order] = np.maximum.accumulate(scaled)
    return [
        dataclasses.replace(row, p_adjusted=p, is_significant=p < 1 - LEVEL)
        for row, p in zip(rows, adjusted.tolist(), strict=True)
    ]


def _check_same_truth(data_a: EvaluationSet, data_b: EvaluationSet) -> None:
    """Raises unless two sets have the same classes, frames and ground truth."""
    for name, one, other in (
        ("classes", data_a.classes, data_b.classes),
        ("frames", data_a.frame, data_b.frame),
        ("objects", data_a.gt.box, data_b.gt.box),
        ("classes of objects", data_a.gt.cls, data_b.gt.cls),
    ):
        if not np.array_equal(one, other):
            counts = f"{len(one)} and {len(other)}"
            raise UserError(
                f"the runs have different {name} ({counts}), expected equal"
            )
