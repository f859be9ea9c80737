import numpy as np
import pytest

from radejax.evaluation import matching
from radejax.geometry.rotated_iou import bev_iou


def boxes(rng, num):
    return np.column_stack(
        [
            rng.normal(0, 3, (num, 2)),
            rng.normal(0, 0.5, num),
            rng.uniform(0.3, 6, (num, 3)),
            rng.uniform(-7, 7, num),
        ]
    )


@pytest.mark.parametrize("chunk", [64, 10**6])
def test_candidates_are_all_overlapping_pairs_of_a_group(monkeypatch, chunk):
    monkeypatch.setattr(matching, "PAIRS_PER_CHUNK", chunk)
    rng = np.random.default_rng(3)
    a, b = boxes(rng, 80), boxes(rng, 90)
    group_a, group_b = rng.integers(0, 6, 80), np.sort(rng.integers(0, 6, 90))
    first, second = matching.candidate_pairs(group_a, group_b, a, b)
    order = np.lexsort((second, first))
    np.testing.assert_array_equal(order, np.arange(first.size))
    found = set(zip(first.tolist(), second.tolist(), strict=True))
    is_same = group_a[:, None] == group_b
    touching = set(zip(*np.nonzero((bev_iou(a, b) > 0) & is_same), strict=True))
    assert len(found) == first.size
    assert touching <= found < set(zip(*np.nonzero(is_same), strict=True))
    for one, other in ((0, 0), (0, 1), (1, 0)):
        few = group_a[:one], group_b[:other], a[:one], b[:other]
        assert [x.size for x in matching.candidate_pairs(*few)] == [0, 0]
