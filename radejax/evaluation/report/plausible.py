"""What a glance at predictions would tell: another unit, frame or height of boxes."""

from __future__ import annotations

import numpy as np

from radejax.evaluation.columns import Columns
from radejax.evaluation.evaluation_set import EvaluationSet

BEHIND = 0.01
"""More predictions than this share behind the sensor are no accident."""

OFFSET_M = 0.25
"""A median offset beyond this is told where it is nearly the same for all objects."""

FEWEST = 10
"""Objects with a prediction near them that an offset is taken from at least."""


def warnings(predictions: Columns, data: EvaluationSet) -> list[str]:
    """Lines on what is wrong with boxes as a whole.

    Args:
        predictions: Columns as in `average_precision.evaluate`.
        data: The evaluation set of them.
    """
    box = np.asarray(predictions["box"], np.float64).reshape(-1, 7)
    lines = []
    turns = np.abs(box[:, 6]) > 2 * np.pi
    if turns.any():
        lines.append(
            f"{turns.sum()} of {len(box)} predictions have |yaw| > 2 pi, up to "
            f"{np.abs(box[:, 6]).max():.4g}: yaw is in radians; --yaw_degrees reads degrees"
        )
    behind = int((box[:, 0] < 0).sum())
    if behind > BEHIND * len(box):
        lines.append(
            f"{behind} of {len(box)} predictions lie behind the sensor (x < 0): boxes are "
            "in the radar frame, x forward, y left, z up"
        )
    return lines + _constant_offset(data)


def _constant_offset(data: EvaluationSet) -> list[str]:
    """The median offset of the best prediction near each object, if it is constant."""
    by_score = np.argsort(data.pred.score[data.pair_pred], kind="stable")
    best = np.full(len(data.gt), -1)
    best[data.pair_gt[by_score]] = data.pair_pred[by_score]
    has = best >= 0
    if has.sum() < FEWEST:
        return []
    gap = data.pred.box[best[has], :3] - data.gt.box[has, :3]
    median = np.median(gap, axis=0)
    spread = np.median(np.abs(gap - median), axis=0)
    is_constant = (np.abs(median) > OFFSET_M) & (np.abs(median) > 1.5 * spread)
    if not is_constant.any():
        return []
    x, y, z = (f"{value:+.2f}" for value in median)
    hint = f"; --z_offset {-median[2]:.2f} moves them" if is_constant[2] else ""
    return [
        f"predictions lie ({x}, {y}, {z}) m from their objects (x, y, z; median of "
        f"{has.sum()}), nearly all alike: boxes are in the radar frame, which is K-Radar's "
        f"LiDAR frame + (-2.54, 0.3, 0), with z at mid-height{hint}"
    ]
