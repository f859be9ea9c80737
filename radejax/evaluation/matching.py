"""Assigning predictions to ground truth: every frame and class at the same time.

Pairs are given as two index arrays (prediction, ground truth) with an IoU each. Boxes
of different groups (a group is one class in one frame) never meet in a pair, so one
round serves the r-th box of every group at once, and the number of rounds is the
largest number of boxes in a group, not the number of boxes.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy import sparse

VIRTUAL_PAIRS_PER_CHUNK = 2_000_000


def greedy(
    claimant: np.ndarray,
    target: np.ndarray,
    preference: np.ndarray,
    group: np.ndarray,
    num_targets: int,
) -> np.ndarray:
    """Claimants take, one after the other, the best target that is still free.

    Args:
        claimant: `[P]` claimant of every pair; the smaller number chooses first.
        target: `[P]` target of every pair.
        preference: `[P]` the larger, the better; the smaller target wins a tie.
        group: `[P]` group of the claimant; no target occurs in two groups.
        num_targets: Number of targets.

    Returns:
        `[K]` positions of the chosen pairs.
    """
    if claimant.size == 0:
        return np.zeros(0, np.int64)
    order = np.lexsort((target, -preference, claimant, group))
    new_group = np.ones(order.size, bool)
    new_group[1:] = group[order][1:] != group[order][:-1]
    first = new_group.copy()  # a claimant may occur in several groups
    first[1:] |= claimant[order][1:] != claimant[order][:-1]
    number = np.cumsum(first) - 1  # [P] running number of the claimant
    rank = number - np.maximum.accumulate(np.where(new_group, number, 0))
    by_rank = np.argsort(rank, kind="stable")
    order, first, rank = order[by_rank], first[by_rank], rank[by_rank]
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


@dataclasses.dataclass(frozen=True)
class KradarMatches:
    """K-Radar's two passes over all frames, independent of score thresholds.

    Attributes:
        first_gt: `[S]` ground truths matched in the first pass.
        first_pred: `[S]` the prediction each of them took.
        event_pred: `[E]` predictions at whose score the number of true positives of the
            second pass changes when the score threshold sinks to it.
        event_delta: `[E]` by how much.
    """

    first_gt: np.ndarray
    first_pred: np.ndarray
    event_pred: np.ndarray
    event_delta: np.ndarray


def match_kradar(
    pred: np.ndarray,
    gt: np.ndarray,
    iou: np.ndarray,
    score: np.ndarray,
    gt_group: np.ndarray,
    threshold: float,
) -> KradarMatches:
    """Both passes of K-Radar's matching.

    First pass: ground truths in order, each takes the free prediction with the highest
    score among those above the IoU threshold. Second pass, for every score threshold t:
    the same with the largest IoU among the predictions that score at least t. The number
    of true positives as a function of t is returned as steps, so that any set of
    thresholds, frames or frame weights costs only a sum.

    Args:
        pred: `[P]` prediction of every pair.
        gt: `[P]` ground truth of every pair.
        iou: `[P]` overlap of every pair.
        score: `[M]` scores of the predictions.
        gt_group: `[N]` group of every ground truth.
        threshold: A match needs an IoU above this.
    """
    keep = iou > threshold
    pred, gt, iou = pred[keep], gt[keep], iou[keep]
    chosen = greedy(gt, pred, score[pred], gt_group[gt], score.size)
    event_pred, event_delta = _second_pass(pred, gt, iou, score)
    return KradarMatches(gt[chosen], pred[chosen], event_pred, event_delta)


def _second_pass(
    pred: np.ndarray, gt: np.ndarray, iou: np.ndarray, score: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """True positives as steps over the score threshold."""
    if pred.size == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    component, num_gt = _components(pred, gt)
    lone = num_gt[component] == 1
    # A ground truth that shares no prediction is found once its best score is reached.
    order = np.lexsort((-score[pred[lone]], gt[lone]))
    first = np.unique(gt[lone][order], return_index=True)[1]
    lone_pred = pred[lone][order][first]
    shared = ~lone
    step_pred, step_delta = _steps(
        pred[shared], gt[shared], iou[shared], score, component[shared]
    )
    return (
        np.concatenate([lone_pred, step_pred]),
        np.concatenate([np.ones(lone_pred.size, np.int64), step_delta]),
    )


def _components(pred: np.ndarray, gt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Connected parts of the pair graph: `[P]` label, `[labels]` ground truths in it."""
    gts, gt_node = np.unique(gt, return_inverse=True)
    preds, pred_node = np.unique(pred, return_inverse=True)
    size = gts.size + preds.size
    graph = sparse.coo_array(
        (np.ones(pred.size, bool), (gt_node, gts.size + pred_node)), shape=(size, size)
    )
    num, label = sparse.csgraph.connected_components(graph, directed=False)
    return label[gt_node], np.bincount(label[: gts.size], minlength=num)


def _steps(
    pred: np.ndarray,
    gt: np.ndarray,
    iou: np.ndarray,
    score: np.ndarray,
    component: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Second pass where ground truths compete: once per distinct score in a component."""
    if pred.size == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order = np.argsort(component, kind="stable")
    pred, gt, iou, component = pred[order], gt[order], iou[order], component[order]
    # Levels: distinct (component, score), scores falling.
    rows = np.lexsort((pred, -score[pred], component))
    new = np.ones(rows.size, bool)
    new[1:] = (component[rows][1:] != component[rows][:-1]) | (
        score[pred[rows]][1:] != score[pred[rows]][:-1]
    )
    level_pred, level_component = pred[rows][new], component[rows][new]
    first = np.searchsorted(component, level_component, side="left")
    count = np.searchsorted(component, level_component, side="right") - first
    true_positives = np.zeros(level_pred.size, np.int64)
    chunk = np.cumsum(count) // VIRTUAL_PAIRS_PER_CHUNK
    bounds = np.flatnonzero(np.diff(chunk, prepend=-1, append=chunk[-1] + 1))
    for low, high in itertools.pairwise(bounds):
        part = count[low:high]
        level = np.repeat(np.arange(high - low), part)
        pair = np.arange(level.size) - np.repeat(np.cumsum(part) - part, part)
        pair += np.repeat(first[low:high], part)
        enters = score[pred[pair]] >= score[level_pred[low:high]][level]
        level, pair = level[enters], pair[enters]
        # Every level is a world of its own: number its predictions anew.
        target = np.unique(level * score.size + pred[pair], return_inverse=True)[1]
        won = greedy(gt[pair], target, iou[pair], level, target.max() + 1)
        true_positives[low:high] = np.bincount(level[won], minlength=high - low)
    same = np.zeros(level_pred.size, bool)
    same[1:] = level_component[1:] == level_component[:-1]
    before = np.where(same, np.roll(true_positives, 1), 0)
    return level_pred, true_positives - before


def match_best(
    pred: np.ndarray,
    gt: np.ndarray,
    iou: np.ndarray,
    score: np.ndarray,
    threshold: float,
) -> np.ndarray:
    """RADE-Net's rule: a prediction may only take its own best ground truth.

    Args:
        pred: `[P]` prediction of every pair.
        gt: `[P]` ground truth of every pair.
        iou: `[P]` overlap of every pair.
        score: `[M]` scores of the predictions.
        threshold: A match needs an IoU above this.

    Returns:
        `[M]` matched ground truth or -1. The best ground truth is the one of largest IoU
        (the first on a tie), taken or not; of the predictions that want the same one,
        the highest score gets it (the first on a tie).
    """
    matched = np.full(score.size, -1)
    order = np.lexsort((gt, -iou, pred))
    best = order[np.unique(pred[order], return_index=True)[1]]
    best = best[iou[best] > threshold]
    order = np.lexsort((pred[best], -score[pred[best]], gt[best]))
    best = best[order]
    winner = best[np.unique(gt[best], return_index=True)[1]]
    matched[pred[winner]] = gt[winner]
    return matched


def match_free(
    pred: np.ndarray,
    gt: np.ndarray,
    iou: np.ndarray,
    score: np.ndarray,
    pred_group: np.ndarray,
    num_gt: int,
    threshold: float,
) -> np.ndarray:
    """The plain rule: by falling score, each prediction takes the best free object.

    Args:
        pred: `[P]` prediction of every pair.
        gt: `[P]` ground truth of every pair.
        iou: `[P]` overlap of every pair.
        score: `[M]` scores of the predictions.
        pred_group: `[M]` group (frame and class) of every prediction.
        num_gt: Number of ground truths.
        threshold: A match needs an IoU above this.

    Returns:
        `[M]` matched ground truth or -1.
    """
    keep = iou > threshold
    pred, gt, iou = pred[keep], gt[keep], iou[keep]
    turn = np.empty(score.size, np.int64)
    turn[np.argsort(-score, kind="stable")] = np.arange(score.size)
    chosen = greedy(turn[pred], gt, iou, pred_group[pred], num_gt)
    matched = np.full(score.size, -1)
    matched[pred[chosen]] = gt[chosen]
    return matched
