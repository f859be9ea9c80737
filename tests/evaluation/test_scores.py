"""Rates at score thresholds, their choice, and the calibration of scores."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit

from radejax.evaluation import scores
from radejax.evaluation.evaluation_set import EvaluationSet
from radejax.evaluation.protocols import pooled_curve

SCORE = np.array([0.9, 0.8, 0.6, 0.4, 0.2])
IS_TP = np.array([True, True, False, True, False])
CURVE = pooled_curve(SCORE, IS_TP, np.ones(5), 4, "all_point")


def test_rates_by_hand():
    rates = scores.rates_at(CURVE, [0.0, 0.4, 0.41, 0.85, 0.95])
    np.testing.assert_allclose(rates["precision"], [3 / 5, 3 / 4, 2 / 3, 1, math.nan])
    np.testing.assert_allclose(rates["recall"], [3 / 4, 3 / 4, 2 / 4, 1 / 4, 0])
    # F1 = 2 TP / (predictions + objects)
    np.testing.assert_allclose(rates["f1"], [6 / 9, 6 / 8, 4 / 7, 2 / 5, math.nan])


def test_thresholds_by_hand():
    # F1 is best with four predictions, and the precision 1 with the first two.
    expected = {"best_f1": 0.21, "wanted_precision": 0.61}
    assert scores.choose_thresholds(CURVE, 0.9) == expected
    assert scores.choose_thresholds(CURVE, 0.7)["wanted_precision"] == 0.21
    no_match = pooled_curve(SCORE, ~np.ones(5, bool), np.ones(5), 4, "all_point")
    nothing = pooled_curve(SCORE[:0], IS_TP[:0], np.ones(0), 4, "all_point")
    for curve in (no_match, nothing):
        assert scores.choose_thresholds(curve, 0.0) == {}
    first_false = pooled_curve(SCORE, ~IS_TP, np.ones(5), 4, "all_point")
    assert [*scores.choose_thresholds(first_false, 0.9)] == ["best_f1"]


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_no_threshold_is_better_than_the_chosen_ones(seed):
    rng = np.random.default_rng(seed)
    score = np.sort(rng.integers(1, 20, 30) / 20)[::-1]
    is_tp = rng.random(30) < score
    is_tp[0] = True
    curve = pooled_curve(score, is_tp, np.ones(30), 40, "all_point")
    chosen = scores.choose_thresholds(curve, 0.8)
    every = scores.rates_at(curve, score)
    (best,) = scores.rates_at(curve, [chosen["best_f1"]])["f1"]
    assert best == pytest.approx(np.nanmax(every["f1"]))
    is_kept = score >= chosen["best_f1"]
    assert best == pytest.approx(2 * is_tp[is_kept].sum() / (is_kept.sum() + 40))
    has_precision = every["precision"] >= 0.8
    assert ("wanted_precision" in chosen) == has_precision.any()
    if has_precision.any():
        found = scores.rates_at(curve, [chosen["wanted_precision"]])
        assert found["precision"] >= 0.8
        assert found["recall"] == every["recall"][has_precision].max()


def test_calibration_error_by_hand():
    # Bins of 0.05 and 0.07, of 0.32, and of 0.95 and 1.0, which is in the last one.
    confidence = np.array([0.05, 0.07, 0.32, 0.95, 1.0])
    is_matched = np.array([False, True, True, True, True])
    found = scores.reliability(confidence, is_matched)
    np.testing.assert_array_equal(found.number, [2, 1, 2])
    np.testing.assert_allclose(found.confidence, [0.06, 0.32, 0.975])
    np.testing.assert_allclose(found.precision, [0.5, 1, 1])
    assert found.error == pytest.approx((2 * 0.44 + 0.68 + 2 * 0.025) / 5)
    nothing = scores.reliability(confidence[:0], is_matched[:0])
    assert nothing.number.size == 0
    assert math.isnan(nothing.error)


def _calibrated(score, temperature, offset):
    return expit(logit(score) / temperature + offset)


def _drawn(rng, temperature, offset, size=20_000):
    """Scores, and matches with the probabilities of this temperature and offset."""
    score = rng.uniform(0.05, 0.95, size)
    return score, rng.random(size) < _calibrated(score, temperature, offset)


@pytest.mark.parametrize(("temperature", "offset"), [(0.4, -1.0), (1.0, 0.0), (3, 2)])
def test_fitted_temperature_and_offset_are_those_of_the_matches(temperature, offset):
    rng = np.random.default_rng(0)
    found = scores.fit_calibration(*_drawn(rng, temperature, offset))
    np.testing.assert_allclose(found, (temperature, offset), atol=0.1, rtol=0.1)
    score, is_matched = _drawn(rng, temperature, offset)
    probability = _calibrated(score, *found)
    assert scores.reliability(probability, is_matched).error < 0.015
    np.testing.assert_array_equal(np.argsort(probability), np.argsort(score))


def test_fits_of_few_predictions_are_finite():
    score = np.array([0.2, 0.3, 0.9, 1.0])
    for is_matched in (np.ones(4, bool), np.zeros(4, bool), score < 0.5):
        temperature, offset = scores.fit_calibration(score, is_matched)
        assert temperature > 0  # also if high scores match less often
        probability = _calibrated(score[:3], temperature, offset)
        assert np.abs(probability - is_matched[:3].mean()).max() < 0.55
        assert ((probability > 0) & (probability < 1)).all()
    assert scores.fit_calibration(score[:0], score[:0] > 0) == (1.0, 0.0)


def test_every_class_is_fitted_to_its_own_predictions():
    count = 200
    rng = np.random.default_rng(0)
    box = np.array([20.0, 0, 0, 4, 2, 1.5, 0])
    truth = {
        "frame": np.arange(count),
        "box": np.tile(box, (count, 1)),
        "cls": np.repeat(["Sedan", "Bicycle"], count // 2),
    }
    is_matched = rng.random(count) < np.where(truth["cls"] == "Sedan", 0.9, 0.2)
    far = np.where(is_matched, 0.0, 30.0)[:, None] * [0, 1, 0, 0, 0, 0, 0]
    found = {**truth, "box": truth["box"] + far, "score": rng.uniform(0.4, 0.6, count)}
    data = EvaluationSet(truth, found, classes=["Bicycle", "Sedan"], roi=None)
    fits = scores.fit_calibrations(data, 0.5)
    assert [*fits] == ["Bicycle", "Sedan"]
    for cls, expected in (("Sedan", 0.9), ("Bicycle", 0.2)):
        probability = _calibrated(found["score"], *fits[cls])
        assert probability.mean() == pytest.approx(expected, abs=0.1)
