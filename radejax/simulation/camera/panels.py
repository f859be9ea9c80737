"""What stands beside the road, as flat shapes: trees, poles, guard rails, house fronts.

The same reflectors that scatter radar waves are drawn, so that an image shows what the
radar map shows.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from radejax.simulation.world.scene import REFLECTOR_KINDS, SceneFrame

_FACADES = np.array(
    [(168, 158, 146), (142, 120, 106), (186, 184, 178), (120, 126, 134)], float
)
_TREES = np.array([(58, 84, 48), (70, 92, 52), (48, 74, 50)], float)
_SNOWY = np.array([206, 210, 214.0])
_FAR_M = 110.0

Panels = tuple[
    Float[np.ndarray, "P 4 3"], Float[np.ndarray, " P"], Float[np.ndarray, "P 3"]
]


def make_panels(
    frame: SceneFrame, origin: Float[np.ndarray, "3"], ground_m: float, white: float
) -> Panels:
    """Upright rectangles of the surroundings of a frame.

    Args:
        frame: Its reflectors are drawn.
        origin: Camera position; trees and poles turn their face to it.
        ground_m: Height of the ground.
        white: Snow on everything, 0 to 1.

    Returns:
        Corners, distances and colours.
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
        facing = fixed.normal_rad[chosen]
        if name in ("tree", "pole"):
            facing = np.arctan2(position[:, 1] - origin[1], position[:, 0] - origin[0])
        angle = facing + np.pi / 2.0
        side = half_width * np.stack([np.cos(angle), np.sin(angle)], 1)
        panels.append(_upright(position[:, :2], side, ground_m + low, ground_m + high))
        color = palette[frame.reflector_idx[chosen] * 7919 % len(palette)]
        if name in ("tree", "pole"):
            color = color + white * 0.6 * (_SNOWY - color)
        colors.append(color)
    corners = np.concatenate(panels)
    depth = np.linalg.norm(corners.mean(1) - origin, axis=1)
    return corners, depth, np.concatenate(colors)


def _upright(
    center: Float[np.ndarray, "P 2"],
    side: Float[np.ndarray, "P 2"],
    low: float,
    high: float,
) -> Float[np.ndarray, "P 4 3"]:
    """Rectangles around ground points."""
    a, b = center - side, center + side
    flat = np.stack([a, b, b, a], 1)
    height = np.broadcast_to([[low], [low], [high], [high]], (len(center), 4, 1))
    return np.concatenate([flat, height], -1)
