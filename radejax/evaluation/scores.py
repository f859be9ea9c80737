"""What scores mean: the rates at a score threshold, and the calibration of scores."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.special import logit

from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import EPSILON, Curve

RULES = ("best_f1", "wanted_precision")
"""Rules by which score thresholds are chosen, see `choose_thresholds`."""

NUM_BINS = 10
"""Number of bins of equal width of a reliability diagram."""


# Thresholds ---------------------------------------------------------------------------


def rates_at(curve: Curve, thresholds: ArrayLike) -> dict[str, Float[np.ndarray, " T"]]:
    """Computes "precision", "recall" and "f1" of the predictions that reach thresholds.

    Without predictions, precision and F1 are NaN.

    Args:
        curve: Curve of one class in `all_point`.
        thresholds: Score thresholds `[T]`.

    Examples:
        >>> curve = Curve(75.0, 2, 2, np.ones(2), np.array([0.5, 1]), np.array([0.9, 0.4]))
        >>> rates_at(curve, [0.5])["f1"].round(3).tolist()
        [0.667]
    """
    last = np.searchsorted(-curve.score, -np.asarray(thresholds), side="right") - 1
    # -1 selects the appended values, which are those above all scores.
    precision = np.append(curve.precision, np.nan)[last]
    recall = np.append(curve.recall, 0.0)[last]
    f1 = 2 * precision * recall / np.maximum(precision + recall, EPSILON)
    return {"precision": precision, "recall": recall, "f1": f1}


def choose_thresholds(curve: Curve, precision: float) -> dict[str, float]:
    """Chooses score thresholds of 0.01, 0.02 to 0.99 by rule.

    Args:
        curve: Curve of one class in `all_point`.
        precision: Wanted precision.

    Returns:
        "best_f1": the threshold with the highest F1; and "wanted_precision": of those with
        the wanted precision, the one with the highest recall. Of equal ones, it is the
        lowest. Rules that no threshold with a match fulfills are left out.

    Examples:
        >>> curve = Curve(75.0, 2, 2, np.array([1, 0.5]), np.full(2, 0.5), np.array([0.9, 0.4]))
        >>> choose_thresholds(curve, 0.9)
        {'best_f1': 0.41, 'wanted_precision': 0.41}
    """
    thresholds = np.arange(1, 100) / 100
    rates = rates_at(curve, thresholds)
    f1 = np.nan_to_num(rates["f1"])
    fulfill = [f1 == f1.max(), rates["precision"] >= precision]
    rows = dict(zip(RULES, [x & (f1 > 0) for x in fulfill], strict=True))
    return {n: float(thresholds[x.argmax()]) for n, x in rows.items() if x.any()}


# Calibration --------------------------------------------------------------------------


class Reliability(NamedTuple):
    """Reliability diagram of predictions, whose bins without predictions are left out.

    Attributes:
        number: Number of predictions.
        confidence: Their mean confidence.
        precision: Fraction of them that match an object.
    """

    number: Float[np.ndarray, " K"]
    confidence: Float[np.ndarray, " K"]
    precision: Float[np.ndarray, " K"]

    @property
    def error(self) -> float:
        """Expected calibration error (Guo et al., 2017), or NaN without predictions."""
        gap = np.abs(self.confidence - self.precision)
        return float(np.average(gap, weights=self.number)) if gap.size else math.nan


def reliability(
    confidence: Float[np.ndarray, " M"], is_matched: Bool[np.ndarray, " M"]
) -> Reliability:
    """Computes the reliability diagram of scores or probabilities.

    Examples:
        >>> round(reliability(np.array([0.7, 0.72]), np.array([True, False])).error, 2)
        0.21
    """
    bins = np.minimum((confidence * NUM_BINS).astype(np.int64), NUM_BINS - 1)
    columns = np.ones_like(confidence), confidence, is_matched
    count, *sums = (np.bincount(bins, column) for column in columns)
    has = count > 0
    return Reliability(count[has], *(x[has] / count[has] for x in sums))


def fit_calibrations(data: EvaluationSet, iou: float) -> dict[str, tuple[float, float]]:
    """Fits temperature and offset of every class, see `fit_calibration`.

    Args:
        data: Predictions and objects, which match in 3D as in `all_point`.
        iou: IoU threshold of a match.

    Examples:
        >>> car = {"frame": [0], "box": [[20.0, 0, 0, 4, 2, 1.5, 0]], "cls": ["Sedan"]}
        >>> data = EvaluationSet(car, {**car, "score": [0.9]}, classes=["Sedan"])
        >>> list(fit_calibrations(data, 0.5))
        ['Sedan']
    """
    is_matched = data.matched_objects("plain", "free", "3d", iou) >= 0
    rows = [data.pred.cls == cls for cls in range(len(data.classes))]
    fits = [fit_calibration(data.score[x], is_matched[x]) for x in rows]
    return dict(zip(data.classes, fits, strict=True))


def fit_calibration(
    score: Float[np.ndarray, " M"], is_matched: Bool[np.ndarray, " M"]
) -> tuple[float, float]:
    """Fits temperature and offset of one class by maximum likelihood.

    The probability of a box is expit(logit(score) / temperature + offset), see `decode`. The
    targets are smoothed as Platt does, so that the fit is finite if all predictions are
    right or wrong. Without predictions, scores do not change.

    References:
        Platt, "Probabilistic Outputs for Support Vector Machines", 1999; Guo et al., "On
        Calibration of Modern Neural Networks", 2017.

    Examples:
        >>> score = np.repeat([0.4, 0.6], 500)
        >>> is_matched = np.arange(1000) % 500 < np.repeat([100, 400], 500)
        >>> temperature, offset = fit_calibration(score, is_matched)
        >>> round(temperature, 2), round(abs(offset), 2)
        (0.29, 0.0)
    """
    from scipy.optimize import minimize  # slow to import, and only needed here

    num = is_matched.sum()
    target = np.where(is_matched, (num + 1) / (num + 2), 1 / (score.size - num + 2))
    levels = logit(np.clip(score, 1e-6, 1 - 1e-6))

    def loss(values: Float[np.ndarray, " 2"]) -> float:
        x = values[0] * levels + values[1]
        return float((np.logaddexp(0, x) - target * x).sum())

    # The temperature is positive, so that the order of the scores of a class is kept.
    found = minimize(loss, np.array([1.0, 0.0]), bounds=[(0.01, 100), (-50, 50)])
    slope, offset = found.x.tolist()
    return 1 / slope, offset
