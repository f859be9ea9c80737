"""Matching of predictions and ground truth for all frames and classes at once.

A group is one class in one frame, and only boxes of the same group can form a pair.
Therefore each round of the matching processes one box of every group, and the number of
rounds is the largest number of boxes in a group instead of the total number of boxes.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Real, Shaped

PAIRS_PER_CHUNK = 2_000_000
"""Approximate number of pairs compared at once, which bounds the memory."""


def candidate_pairs(
    group_a: Real[np.ndarray, " N"],
    group_b: Real[np.ndarray, " M"],
    box_a: Float[np.ndarray, "N 7"],
    box_b: Float[np.ndarray, "M 7"],
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """Finds the pairs (a, b) of the same group whose rectangles can overlap.

    Args:
        group_a: `[N]` group of every box a, such as one number for frame and class.
        group_b: `[M]` sorted groups of the boxes b.
        box_a: `[N, 7]` boxes a.
        box_b: `[M, 7]` boxes b.

    Returns:
        Two `[P]` index arrays, ordered by a, then b.

    Examples:
        >>> cars = np.array([[20.0, 0, 0, 4, 2, 1.5, 0], [60.0, 0, 0, 4, 2, 1.5, 0]])
        >>> a, b = candidate_pairs(np.zeros(2), np.zeros(2), cars, cars)
        >>> a.tolist(), b.tolist()
        ([0, 1], [0, 1])
    """
    first = np.searchsorted(group_b, group_a)
    count = np.searchsorted(group_b, group_a, side="right") - first
    # Two boxes can only overlap if their distance is at most the sum of their half
    # diagonals. 3 cm are added because some protocols round boxes to centimeters.
    reach_a = 0.5 * np.hypot(box_a[:, 3], box_a[:, 4]) + 0.03
    reach_b = 0.5 * np.hypot(box_b[:, 3], box_b[:, 4])
    parts = []
    for rows in chunks(count):
        owner, b = ranges(first[rows], count[rows])
        a = rows[owner]
        gap = box_a[a, :2] - box_b[b, :2]
        near = np.hypot(gap[:, 0], gap[:, 1]) <= reach_a[a] + reach_b[b]
        parts.append((a[near], b[near]))
    return np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])


def chunks(count: Int[np.ndarray, " R"]) -> list[Int[np.ndarray, " _"]]:
    """Splits rows into parts with about `PAIRS_PER_CHUNK` pairs each.

    Examples:
        >>> [rows.tolist() for rows in chunks(np.array([10**6, 2 * 10**6]))]
        [[0], [1]]
    """
    num_chunks = 1 + int(count.sum()) // PAIRS_PER_CHUNK
    return np.array_split(np.arange(count.size), num_chunks)


def ranges(
    first: Int[np.ndarray, " R"], count: Int[np.ndarray, " R"]
) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Returns the range and the index of every element of the ranges [first, first + count).

    Examples:
        >>> owner, index = ranges(np.array([5, 0]), np.array([2, 3]))
        >>> owner.tolist(), index.tolist()
        ([0, 0, 1, 1, 1], [5, 6, 0, 1, 2])
    """
    owner = np.repeat(np.arange(count.size), count)
    before = np.cumsum(count) - count
    return owner, np.arange(owner.size) + (first - before)[owner]


class Pairs(NamedTuple):
    """Pairs of a prediction and a ground truth of the same group that may overlap.

    Attributes:
        pred: `[P]` prediction of every pair.
        gt: `[P]` ground truth of every pair.
        iou: `[P]` IoU of every pair.
    """

    pred: Int[np.ndarray, " P"]
    gt: Int[np.ndarray, " P"]
    iou: Float[np.ndarray, " P"]

    def take(self, index: Int[np.ndarray, " K"] | Bool[np.ndarray, " P"]) -> Pairs:
        """Returns the pairs that `index` (positions or a mask) selects."""
        return Pairs(*(column[index] for column in self))


def greedy(
    claimant: Int[np.ndarray, " P"],
    target: Int[np.ndarray, " P"],
    preference: Real[np.ndarray, " P"],
    group: Real[np.ndarray, " P"],
    num_targets: int,
) -> Int[np.ndarray, " K"]:
    """Matches each claimant in turn to its best target that is not matched yet.

    Args:
        claimant: `[P]` claimant of every pair. Claimants are processed in ascending order.
        target: `[P]` target of every pair.
        preference: `[P]` preference of every pair; larger is better, and the smaller
            target is preferred in a tie.
        group: `[P]` group of every pair. A target must not occur in two groups.
        num_targets: Number of targets.

    Returns:
        `[K]` positions of the matched pairs.

    Examples:
        >>> claimant, target = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
        >>> chosen = greedy(claimant, target, np.array([0.4, 0.9, 0.3, 0.8]), 0 * target, 2)
        >>> target[chosen].tolist()  # the second finds its best target taken
        [1, 0]
    """
    if claimant.size == 0:
        return np.zeros(0, np.int64)
    order = np.lexsort((target, -preference, claimant, group))
    new_group = _is_new(group[order])
    first = new_group | _is_new(claimant[order])  # a claimant may be in several groups
    number = np.cumsum(first) - 1  # [P] running number of the claimant
    rank = number - np.maximum.accumulate(np.where(new_group, number, 0))
    by_rank = np.argsort(rank, kind="stable")
    order = order[by_rank]
    first = first[by_rank]
    rank = rank[by_rank]
    bounds = np.searchsorted(rank, np.arange(rank[-1] + 2))
    taken = np.zeros(num_targets, bool)
    chosen = []
    for low, high in itertools.pairwise(bounds):
        pairs = order[low:high]
        position = np.where(taken[target[pairs]], pairs.size, np.arange(pairs.size))
        best = np.minimum.reduceat(position, np.flatnonzero(first[low:high]))
        won = pairs[best[best < pairs.size]]
        taken[target[won]] = True
        chosen.append(won)
    return np.concatenate(chosen)


def _is_new(*columns: Shaped[np.ndarray, " K"]) -> Bool[np.ndarray, " K"]:
    """Returns a mask of the entries that differ from the previous one in any column."""
    new = np.zeros(columns[0].size, bool)
    new[:1] = True
    for column in columns:
        new[1:] |= column[1:] != column[:-1]
    return new


class KradarMatches(NamedTuple):
    """Matches of K-Radar's two passes over all frames for any score threshold.

    Attributes:
        first_pred: `[S]` predictions matched in the first pass, within a group in the order
            of their ground truths.
        event_pred: `[E]` predictions at whose score the number of true positives of the
            second pass changes as the score threshold decreases.
        event_delta: `[E]` change of the number of true positives at each of them.
    """

    first_pred: Int[np.ndarray, " S"]
    event_pred: Int[np.ndarray, " E"]
    event_delta: Int[np.ndarray, " E"]


def match_kradar(
    pairs: Pairs,
    score: Real[np.ndarray, " M"],
    gt_group: Real[np.ndarray, " N"],
    threshold: float,
) -> KradarMatches:
    """Computes both passes of K-Radar's matching.

    In the first pass, each ground truth in order is matched to the unmatched prediction
    with the highest score among those above the IoU threshold. The second pass is run for
    every score threshold t and uses the largest IoU among the predictions with a score of
    at least t instead. The number of true positives as a function of t is returned as
    steps, so that any set of thresholds, frames or frame weights only needs a sum.

    Args:
        pairs: Predictions and ground truths that may overlap.
        score: `[M]` scores of the predictions.
        gt_group: `[N]` group of every ground truth.
        threshold: A match needs an IoU above this.

    Examples:
        >>> pairs = Pairs(np.array([0, 1]), np.array([0, 0]), np.array([0.7, 0.8]))
        >>> found = match_kradar(pairs, np.array([0.9, 0.5]), np.array([0]), 0.5)
        >>> found.first_pred.tolist(), found.event_pred.tolist()
        ([0], [0])
    """
    pairs = pairs.take(pairs.iou > threshold)
    preference = score[pairs.pred]
    chosen = greedy(pairs.gt, pairs.pred, preference, gt_group[pairs.gt], score.size)
    # A ground truth that shares none of its predictions with another one is a true
    # positive for all thresholds up to its best score.
    has_rival = np.zeros(gt_group.size, bool)
    has_rival[pairs.gt[np.bincount(pairs.pred)[pairs.pred] > 1]] = True
    alone = pairs.take(~has_rival[pairs.gt])
    alone = alone.take(np.lexsort((-score[alone.pred], alone.gt)))
    best = alone.pred[_is_new(alone.gt)]
    rivals = pairs.take(has_rival[pairs.gt])
    step_pred, step_delta = _steps(rivals, score, gt_group[rivals.gt])
    event_pred = np.concatenate([best, step_pred])
    event_delta = np.concatenate([np.ones(best.size, np.int64), step_delta])
    return KradarMatches(pairs.pred[chosen], event_pred, event_delta)


def _steps(
    pairs: Pairs, score: Real[np.ndarray, " M"], group: Real[np.ndarray, " P"]
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Computes the true positives of the second pass as steps over the score threshold.

    The matching is computed once per level, which is a distinct score in a group.
    """
    order = np.argsort(group, kind="stable")
    pred, gt, iou = pairs.take(order)
    group = group[order]
    # Levels: distinct (group, score), by descending score.
    start = np.lexsort((pred, -score[pred], group))
    start = start[_is_new(group[start], score[pred[start]])]
    level_pred = pred[start]
    level_group = group[start]
    first = np.searchsorted(group, level_group)
    count = np.searchsorted(group, level_group, side="right") - first
    true_positives = np.zeros(level_pred.size, np.int64)
    for rows in chunks(count):
        level, pair = ranges(first[rows], count[rows])
        enters = score[pred[pair]] >= score[level_pred[rows]][level]
        level, pair = level[enters], pair[enters]
        # Levels are independent, so the predictions of each level are renumbered.
        target = np.unique(level * score.size + pred[pair], return_inverse=True)[1]
        won = greedy(gt[pair], target, iou[pair], level, target.size)
        true_positives[rows] = np.bincount(level[won], minlength=rows.size)
    before = np.where(_is_new(level_group), 0, np.roll(true_positives, 1))
    return level_pred, true_positives - before


def match_best(
    pairs: Pairs, score: Real[np.ndarray, " M"], threshold: float
) -> Int[np.ndarray, " M"]:
    """Matches predictions by RADE-Net's rule, only to their own best ground truth.

    Args:
        pairs: Predictions and ground truths that may overlap.
        score: `[M]` scores of the predictions.
        threshold: A match needs an IoU above this.

    Returns:
        `[M]` matched ground truth or -1. The best ground truth has the largest IoU (the
        first in a tie), even if it is matched to another prediction. Among predictions
        with the same best ground truth, the one with the highest score is matched (the
        first in a tie).

    Examples:
        >>> pairs = Pairs(np.array([0, 1]), np.array([0, 0]), np.array([0.7, 0.8]))
        >>> match_best(pairs, np.array([0.9, 0.5]), 0.5).tolist()
        [0, -1]
    """
    best = pairs.take(np.lexsort((pairs.gt, -pairs.iou, pairs.pred)))
    best = best.take(_is_new(best.pred) & (best.iou > threshold))
    best = best.take(np.lexsort((best.pred, -score[best.pred], best.gt)))
    return _matched(best.take(_is_new(best.gt)), score.size)


def match_free(
    pairs: Pairs,
    score: Real[np.ndarray, " M"],
    pred_group: Real[np.ndarray, " M"],
    num_gt: int,
    threshold: float,
) -> Int[np.ndarray, " M"]:
    """Matches predictions by descending score to the best unmatched ground truth.

    Args:
        pairs: Predictions and ground truths that may overlap.
        score: `[M]` scores of the predictions.
        pred_group: `[M]` group (frame and class) of every prediction.
        num_gt: Number of ground truths.
        threshold: A match needs an IoU above this.

    Returns:
        `[M]` matched ground truth or -1.

    Examples:
        >>> pairs = Pairs(np.array([0, 1]), np.array([0, 0]), np.array([0.7, 0.8]))
        >>> match_free(pairs, np.array([0.5, 0.9]), np.array([0, 0]), 1, 0.5).tolist()
        [-1, 0]
    """
    pairs = pairs.take(pairs.iou > threshold)
    turn = np.empty(score.size, np.int64)
    turn[np.argsort(-score, kind="stable")] = np.arange(score.size)
    group = pred_group[pairs.pred]
    chosen = greedy(turn[pairs.pred], pairs.gt, pairs.iou, group, num_gt)
    return _matched(pairs.take(chosen), score.size)


def _matched(pairs: Pairs, num_pred: int) -> Int[np.ndarray, " M"]:
    """Returns the ground truth of each prediction in the pairs, and -1 for all others."""
    matched = np.full(num_pred, -1)
    matched[pairs.pred] = pairs.gt
    return matched
