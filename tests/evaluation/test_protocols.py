import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.evaluation import protocols


def slow_thresholds(matched, num_gt):
    """K-Radar's score thresholds of the scores that are matched."""
    matched = sorted(matched, reverse=True)
    current, kept = 0.0, []
    for i, score in enumerate(matched):
        is_last = i == len(matched) - 1
        left = (i + 1) / num_gt
        right = left if is_last else (i + 2) / num_gt
        if is_last or right - current >= current - left:
            kept.append(score)
            current += 1 / 40.0
    return kept


def test_thresholds_for_every_small_count():
    """Ties at half a step are decided by rounding: every (found, objects) must agree."""
    for num_gt in [*range(1, 130), 155, 161, 615, 999, 1000, 1001, 2047]:
        for found in {1, 2, num_gt // 3, num_gt // 2, num_gt - 1, num_gt} - {0}:
            scores = np.linspace(1, 0, found + 1)[1:]
            expected = slow_thresholds(scores, num_gt)
            kept = protocols.score_thresholds(scores, np.ones(found, int), num_gt)
            assert kept.tolist() == expected, (num_gt, found)
            assert len(expected) <= 41


@settings(deadline=None, max_examples=30, derandomize=True)
@given(
    weight=st.lists(st.integers(0, 4), max_size=60),
    missed=st.integers(0, 200),
)
def test_thresholds_of_weighted_scores(weight, missed):
    scores = np.linspace(1, 0, len(weight) + 1)[1:]
    repeated = np.repeat(scores, weight)
    num_gt = repeated.size + missed
    expected = slow_thresholds(repeated, num_gt)
    kept = protocols.score_thresholds(scores, np.array(weight, int), num_gt)
    assert kept.tolist() == expected


@pytest.mark.parametrize(
    ("curve", "expected"),
    [
        # Points (0, 1), (1/2, 1), (1/2, 1/2), (1, 2/3), up to 1e-12.
        ("voc11", (5 * 1 + 5 * 2 / 3) / 11),
        ("recall41", (20 * 1 + 20 * 2 / 3) / 41),
        ("coco101", (50 * 1 + 50 * 2 / 3) / 101),
        ("auc", 0.5 + 0.5 * (1 / 2 + 2 / 3) / 2),
        ("all_point", 0.5 + 0.5 * 2 / 3),
    ],
)
def test_pooled_curves_by_hand(curve, expected):
    score, is_tp = np.array([0.9, 0.8, 0.7]), np.array([True, False, True])
    result = protocols.pooled_curve(score, is_tp, np.ones(3, int), 2, curve)
    assert result.ap == pytest.approx(100 * expected, abs=1e-8)
    assert (result.num_gt, result.num_det) == (2, 3)
