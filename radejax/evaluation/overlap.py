"""Overlap of predicted and true boxes of the same frame, for all frames at once."""

from __future__ import annotations

import itertools

import chex
import numpy as np
from jaxtyping import Float, Int, Real

from radejax.geometry.rotated_iou import bev_intersection, shared_height

PAIRS_PER_CHUNK = 2_000_000


def candidate_pairs(
    group_a: Real[np.ndarray, " N"],
    group_b: Real[np.ndarray, " M"],
    box_a: Float[np.ndarray, "N 7"],
    box_b: Float[np.ndarray, "M 7"],
) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """Pairs (a, b) of one group whose rectangles can possibly touch.

    Args:
        group_a: `[N]` group of every box a, for instance frame and class in one number.
        group_b: `[M]` groups of the boxes b, sorted.
        box_a: `[N, 7]` boxes.
        box_b: `[M, 7]` boxes.

    Returns:
        Two `[P]` index arrays, ordered by a, then b.

    Examples:
        >>> cars = np.array([[20.0, 0, 0, 4, 2, 1.5, 0], [60.0, 0, 0, 4, 2, 1.5, 0]])
        >>> a, b = candidate_pairs(np.zeros(2), np.zeros(2), cars, cars)
        >>> a.tolist(), b.tolist()
        ([0, 1], [0, 1])
    """
    chex.assert_shape([box_a, box_b], (None, 7))
    first = np.searchsorted(group_b, group_a, side="left")
    count = np.searchsorted(group_b, group_a, side="right") - first
    # Half diagonals; 3 cm of slack for boxes that a protocol rounds to centimetres.
    reach_a = 0.5 * np.hypot(box_a[:, 3], box_a[:, 4]) + 0.03
    reach_b = 0.5 * np.hypot(box_b[:, 3], box_b[:, 4])
    ends = np.cumsum(count)
    cuts = np.searchsorted(
        ends, np.arange(0, ends[-1] if ends.size else 0, PAIRS_PER_CHUNK)
    )
    bounds = np.unique(np.concatenate([[0], cuts, [count.size]]))
    parts_a, parts_b = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for low, high in itertools.pairwise(bounds):
        a, b = ranges(first[low:high], count[low:high])
        a += low
        gap = box_a[a, :2] - box_b[b, :2]
        near = np.hypot(gap[:, 0], gap[:, 1]) <= reach_a[a] + reach_b[b]
        parts_a.append(a[near])
        parts_b.append(b[near])
    return np.concatenate(parts_a), np.concatenate(parts_b)


def ranges(
    first: Int[np.ndarray, " R"], count: Int[np.ndarray, " R"]
) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"]]:
    """Which range, and index, of everything in the ranges [first, first + count).

    Examples:
        >>> owner, index = ranges(np.array([5, 0]), np.array([2, 3]))
        >>> owner.tolist(), index.tolist()
        ([0, 0, 1, 1, 1], [5, 6, 0, 1, 2])
    """
    owner = np.repeat(np.arange(count.size), count)
    before = np.cumsum(count) - count
    return owner, np.arange(owner.size) + (first - before)[owner]


def pair_iou(
    a: Float[np.ndarray, "P 7"], b: Float[np.ndarray, "P 7"], *, z_center: float = 0.5
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """BEV and 3D intersection over union of boxes, pair by pair.

    Args:
        a: `[P, 7]` boxes x, y, z, l, w, h, yaw.
        b: `[P, 7]` boxes.
        z_center: Where z lies in the height of a box: 0.5 in the middle, 1 at the top.

    Returns:
        `[P]` BEV IoU and `[P]` 3D IoU, float64.

    Examples:
        >>> car, ahead = np.array([[0.0, 0, 0, 4, 2, 1, 0]]), np.array([[2.0, 0, 0, 4, 2, 1, 0]])
        >>> [overlap.round(4).tolist() for overlap in pair_iou(car, ahead)]
        [[0.3333], [0.3333]]
    """
    chex.assert_equal_shape((a, b))
    bev, iou_3d = np.zeros(len(a)), np.zeros(len(a))
    for low in range(0, len(a), PAIRS_PER_CHUNK // 32):
        part = slice(low, low + PAIRS_PER_CHUNK // 32)
        bev[part], iou_3d[part] = _pair_iou(a[part], b[part], z_center)
    return bev, iou_3d


def _pair_iou(
    a: Float[np.ndarray, "P 7"], b: Float[np.ndarray, "P 7"], z_center: float
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    area = bev_intersection(a, b)
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    volume = area * shared_height(a, b, z_center)
    volumes = area_a * a[:, 5] + area_b * b[:, 5]
    return area / (area_a + area_b - area), volume / (volumes - volume)
