"""Overlap of predicted and true boxes of the same frame, for all frames at once."""

from __future__ import annotations

import itertools

import numpy as np

PAIRS_PER_CHUNK = 2_000_000


def candidate_pairs(
    group_a: np.ndarray, group_b: np.ndarray, box_a: np.ndarray, box_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (a, b) of one group whose rectangles can possibly touch.

    Args:
        group_a: `[N]` group of every box a, for instance frame and class in one number.
        group_b: `[M]` groups of the boxes b, sorted.
        box_a: `[N, 7]` boxes.
        box_b: `[M, 7]` boxes.

    Returns:
        Two `[P]` index arrays, ordered by a, then b.
    """
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
    parts_a, parts_b = [], []
    for low, high in itertools.pairwise(bounds):
        part = count[low:high]
        a = np.repeat(np.arange(low, high), part)
        b = np.arange(a.size) - np.repeat(np.cumsum(part) - part, part)
        b += np.repeat(first[low:high], part)
        gap = box_a[a, :2] - box_b[b, :2]
        near = np.hypot(gap[:, 0], gap[:, 1]) <= reach_a[a] + reach_b[b]
        parts_a.append(a[near])
        parts_b.append(b[near])
    if not parts_a:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(parts_a), np.concatenate(parts_b)


def bev_intersection(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Area shared by rotated rectangles, pair by pair, in float64.

    In the frame of rectangle a, the vertical line at x cuts rectangle b in an interval;
    what of it lies in [-w/2, w/2] is the difference of its clamped ends. The area is
    therefore the contour integral of clamp(y) dx around b over |x| <= l/2. Nothing has
    to be sorted and no case is special: coinciding edges are as good as any.

    Args:
        a: `[P, 7]` boxes x, y, z, l, w, h, yaw.
        b: `[P, 7]` boxes.

    Returns:
        `[P]` areas in square metres.
    """
    half = 0.5 * a[:, None, 3:5]  # [P, 1, 2]
    cos_a, sin_a = np.cos(a[:, 6]), np.sin(a[:, 6])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    center = np.stack([cos_a * dx + sin_a * dy, cos_a * dy - sin_a * dx], -1)
    turn = b[:, 6] - a[:, 6]
    axis = np.stack([np.cos(turn), np.sin(turn)], -1)  # [P, 2]
    side = np.stack([-axis[:, 1], axis[:, 0]], -1)
    along = 0.5 * b[:, 3, None] * axis
    across = 0.5 * b[:, 4, None] * side
    corners = center[:, None] + np.stack(
        [along + across, across - along, -along - across, along - across], 1
    )  # [P, 4, 2], counter-clockwise
    start, stop = corners, np.roll(corners, -1, axis=1)
    x0, x1 = (np.clip(p[..., 0], -half[..., 0], half[..., 0]) for p in (start, stop))
    run = stop[..., 0] - start[..., 0]
    rise = stop[..., 1] - start[..., 1]
    slope = np.divide(rise, run, out=np.zeros_like(run), where=run != 0)
    # Beyond the ends of the edge y is extrapolated by nothing: x0, x1 lie on it, or
    # the edge is outside and x0 == x1.
    y0 = start[..., 1] + slope * (x0 - start[..., 0])
    y1 = start[..., 1] + slope * (x1 - start[..., 0])
    return np.maximum(-((x1 - x0) * _mean_clamped(y0, y1, half[..., 1])).sum(-1), 0.0)


def _mean_clamped(y0: np.ndarray, y1: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Mean of clamp(y, -bound, bound) for y running evenly from y0 to y1."""
    step = y1 - y0
    safe = np.where(step == 0, 1.0, step)
    with np.errstate(over="ignore"):
        t_low = np.clip(np.where(step == 0, 0.0, (-bound - y0) / safe), 0.0, 1.0)
        t_high = np.clip(np.where(step == 0, 0.0, (bound - y0) / safe), 0.0, 1.0)
    t1, t2 = np.minimum(t_low, t_high), np.maximum(t_low, t_high)
    v0, v3 = np.clip(y0, -bound, bound), np.clip(y1, -bound, bound)
    v1 = np.clip(y0 + t1 * step, -bound, bound)
    v2 = np.clip(y0 + t2 * step, -bound, bound)
    # Linear on each of the three pieces, so the trapezoid rule is exact.
    return 0.5 * (t1 * (v0 + v1) + (t2 - t1) * (v1 + v2) + (1 - t2) * (v2 + v3))


def pair_iou(
    a: np.ndarray, b: np.ndarray, *, z_center: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """BEV and 3D intersection over union of boxes, pair by pair.

    Args:
        a: `[P, 7]` boxes x, y, z, l, w, h, yaw.
        b: `[P, 7]` boxes.
        z_center: Where z lies in the height of a box: 0.5 in the middle, 1 at the top.

    Returns:
        `[P]` BEV IoU and `[P]` 3D IoU, float64.
    """
    bev, iou_3d = np.zeros(len(a)), np.zeros(len(a))
    for low in range(0, len(a), PAIRS_PER_CHUNK // 8):
        part = slice(low, low + PAIRS_PER_CHUNK // 8)
        bev[part], iou_3d[part] = _pair_iou(a[part], b[part], z_center)
    return bev, iou_3d


def _pair_iou(
    a: np.ndarray, b: np.ndarray, z_center: float
) -> tuple[np.ndarray, np.ndarray]:
    area = bev_intersection(a, b)
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    top = np.minimum(
        a[:, 2] + (1 - z_center) * a[:, 5], b[:, 2] + (1 - z_center) * b[:, 5]
    )
    bottom = np.maximum(a[:, 2] - z_center * a[:, 5], b[:, 2] - z_center * b[:, 5])
    volume = area * np.maximum(top - bottom, 0.0)
    volumes = area_a * a[:, 5] + area_b * b[:, 5]
    return area / (area_a + area_b - area), volume / (volumes - volume)
