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


def pairs(*triples):
    pred, gt, iou = (np.array(column) for column in zip(*triples, strict=True))
    return matching.Pairs(pred.astype(int), gt.astype(int), iou.astype(float))


def naive_greedy(claimant, target, preference, group):
    taken, chosen = set(), []
    for c in sorted(set(zip(group.tolist(), claimant.tolist(), strict=True))):
        rows = [
            i
            for i in range(claimant.size)
            if (group[i], claimant[i]) == c and target[i] not in taken
        ]
        if rows:
            best = max(rows, key=lambda i: (preference[i], -target[i]))
            taken.add(target[best])
            chosen.append(best)
    return sorted(chosen)


@pytest.mark.parametrize("seed", range(5))
def test_greedy_equals_a_loop(seed):
    rng = np.random.default_rng(seed)
    num = 200
    # Claimants may occur in several groups (as levels do), targets in one only.
    group = rng.integers(0, 10, num)
    claimant = rng.integers(0, 6, num)
    target = group * 8 + rng.integers(0, 8, num)
    _, first = np.unique(np.stack([group, claimant, target]), axis=1, return_index=True)
    group, claimant, target = group[first], claimant[first], target[first]
    preference = rng.integers(0, 4, group.size) / 4
    chosen = matching.greedy(claimant, target, preference, group, 80)
    assert sorted(chosen.tolist()) == naive_greedy(claimant, target, preference, group)


def second_pass_loop(pred, gt, iou, score, threshold):
    """True positives at one score threshold."""
    taken, found = set(), 0
    for g in sorted(set(gt.tolist())):
        rows = [
            i
            for i in np.flatnonzero(gt == g)
            if score[pred[i]] >= threshold and pred[i] not in taken
        ]
        if rows:
            best = max(rows, key=lambda i: (iou[i], -pred[i]))
            taken.add(pred[best])
            found += 1
    return found


@pytest.mark.parametrize("chunk", [1, 7, 10**6])
@pytest.mark.parametrize("seed", range(3))
def test_second_pass_equals_a_loop_at_every_threshold(monkeypatch, seed, chunk):
    monkeypatch.setattr(matching, "PAIRS_PER_CHUNK", chunk)
    rng = np.random.default_rng(seed)
    num_pred, num_gt = 25, 18
    grid = np.stack(np.meshgrid(np.arange(num_pred), np.arange(num_gt), indexing="ij"))
    pred, gt = grid.reshape(2, -1)[:, rng.random(num_pred * num_gt) < 0.12]
    iou = np.round(rng.uniform(0.1, 1, pred.size), 1)
    score = np.round(rng.random(num_pred), 1)
    chosen = matching.Pairs(pred, gt, iou)
    match = matching.match_kradar(chosen, score, np.zeros(num_gt, int), 0.3)
    keep = iou > 0.3
    for threshold in np.unique(score):
        steps = match.event_delta[score[match.event_pred] >= threshold].sum()
        expected = second_pass_loop(pred[keep], gt[keep], iou[keep], score, threshold)
        assert steps == expected


def test_higher_score_wins_and_first_row_breaks_ties():
    chosen = pairs((0, 0, 0.9), (1, 0, 0.5), (2, 0, 0.6))
    score = np.array([0.4, 0.8, 0.8])
    assert matching.match_best(chosen, score, 0.3).tolist() == [-1, 0, -1]
    free = matching.match_free(chosen, score, np.zeros(3, int), 1, 0.3)
    assert free.tolist() == [-1, 0, -1]
