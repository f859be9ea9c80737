"""What stands beside the road, as flat shapes: trees, poles, guard rails, house fronts.

The same reflectors that scatter radar waves are drawn, so that an image shows what the
radar map shows.
"""

from __future__ import annotations

import numpy as np

from radejax.simulation.world.scene import REFLECTOR_KINDS, SceneFrame

_FACADES = np.array(
    [(168, 158, 146), (142, 120, 106), (186, 184, 178), (120, 126, 134)], float
)
_TREES = np.array([(58, 84, 48), (70, 92, 52), (48, 74, 50)], float)
_SNOWY = np.array([206, 210, 214.0])
_FAR_M = 110.0


def make_panels(
    frame: SceneFrame, origin: np.ndarray, ground_m: float, white: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Upright rectangles of the surroundings of a frame.

    Args:
        frame: Its reflectors are drawn.
        origin: `[3]` camera position; trees and poles turn their face to it.
        ground_m: Height of the ground.
        white: Snow on everything, 0 to 1.

    Returns:
        Corners `[P, 4, 3]`, distances `[P]` and colours `[P, 3]`.
    """
    fixed = frame.reflectors
    near = np.hypot(fixed.position_m[:, 0], fixed.position_m[:, 1]) < _FAR_M
    panels = [np.zeros((0, 4, 3))]
    colors = [np.zeros((0, 3))]
    for name, half_width, low, high, palette in (
        ("tree", 0.15, 0.0, 2.2, np.array([(74.0, 60.0, 46.0)])),
        ("tree", 1.5, 2.0, 6.0, _TREES),
        ("pole", 0.09, 0.0, 6.5, np.array([(96.0, 98.0, 102.0)])),
        ("rail", 1.05, 0.45, 0.8, np.array([(172.0, 174.0, 178.0)])),
        ("wall", 3.2, 0.0, 5.5, _FACADES),
    ):
        chosen = np.flatnonzero(near & (fixed.kind == REFLECTOR_KINDS.index(name)))
        position = fixed.position_m[chosen]
        if name in ("rail", "wall"):
            angle = fixed.normal_rad[chosen] + np.pi / 2.0
        else:
            sight = position - origin
            angle = np.arctan2(sight[:, 1], sight[:, 0]) + np.pi / 2.0
        side = half_width * np.stack([np.cos(angle), np.sin(angle)], 1)
        panels.append(_upright(position[:, :2], side, ground_m + low, ground_m + high))
        pick = frame.reflector_idx[chosen] * 7919 % len(palette)
        color = palette[pick]
        if name in ("tree", "pole"):
            color = color + white * 0.6 * (_SNOWY - color)
        colors.append(color)
    corners = np.concatenate(panels)
    depth = np.linalg.norm(corners.mean(1) - origin, axis=1)
    return corners, depth, np.concatenate(colors)


def _upright(center, side, low: float, high: float) -> np.ndarray:
    """`[P, 4, 3]` rectangles around ground points `[P, 2]`."""
    a, b = center - side, center + side
    count = len(center)
    bottom, top = np.full((count, 1), low), np.full((count, 1), high)
    return np.stack(
        [np.c_[a, bottom], np.c_[b, bottom], np.c_[b, top], np.c_[a, top]], axis=1
    )
