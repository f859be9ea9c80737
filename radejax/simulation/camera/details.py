"""Details of vehicles and people, and the flat shapes beside the road.

A detail (window, wheel, light, plate, hair) is a rectangle on a face of a block of
`shapes.BLOCKS`, in fractions of that face. It lies within the object's box and is painted
directly after its block. Trees, poles, guard rails and facades are drawn at the reflectors
that also scatter radar waves, so that image and radar map agree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from radejax.simulation.world.scene import REFLECTOR_KINDS, SceneFrame

Quads = Float[np.ndarray, "F 4 3"]
Spans = Float[np.ndarray, "F 2"]
Span = tuple[float, float]
Color = tuple[float, float, float]

FRONT, REAR, LEFT, RIGHT, TOP = range(5)
"""Indices of the faces of a block, in the order of `shapes`."""


class Detail(NamedTuple):
    """A rectangle on a face.

    Attributes:
        block: Index of the block.
        face: `FRONT`, `REAR`, `LEFT`, `RIGHT` or `TOP`.
        u: Start and end, from 0 at the face's first corner to 1 at its second.
        v: Start and end, from 0 at the bottom of the face to 1 at its top. They may be
            outside of [0, 1] where an adjacent block continues the face.
        color: Red, green, blue.
    """

    block: int
    face: int
    u: Span
    v: Span
    color: Color


_GLASS = (44.0, 54.0, 68.0)
_TYRE = (24.0, 24.0, 26.0)
_RIM = (150.0, 152.0, 156.0)
_LAMP = (238.0, 236.0, 214.0)
_RED = (168.0, 26.0, 24.0)
_PLATE = (226.0, 226.0, 218.0)
_DARK = (36.0, 38.0, 42.0)
_HAIR = (48.0, 38.0, 32.0)


def _pair(block: int, face: int, u: Span, v: Span, color: Color) -> list[Detail]:
    """Returns a detail and its mirror image, which is on the right for the left face."""
    opposite = RIGHT if face == LEFT else face
    mirrored = Detail(block, opposite, (1.0 - u[1], 1.0 - u[0]), v, color)
    return [Detail(block, face, u, v, color), mirrored]


def _wheel(block: int, center: float, half_u: float, whole_v: Span) -> list[Detail]:
    """Returns wheels on both sides: two overlapping rectangles each, and one for the rim."""
    low, high = whole_v
    middle = (low + high) / 2.0
    half_v = (high - low) / 2.0
    result = []
    for share_u, share_v, color in (
        (1.0, 0.55, _TYRE),
        (0.55, 1.0, _TYRE),
        (0.42, 0.42, _RIM),
    ):
        u = (center - half_u * share_u, center + half_u * share_u)
        v = (middle - half_v * share_v, middle + half_v * share_v)
        result += _pair(block, LEFT, u, v, color)
    return result


DETAILS: dict[str, tuple[Detail, ...]] = {
    "Sedan": (
        *_wheel(1, 0.19, 0.072, (-0.333, 0.56)),
        *_wheel(1, 0.82, 0.072, (-0.333, 0.56)),
        *_pair(1, FRONT, (0.04, 0.26), (0.5, 0.76), _LAMP),
        *_pair(1, REAR, (0.03, 0.22), (0.5, 0.8), _RED),
        Detail(1, FRONT, (0.32, 0.68), (0.4, 0.7), _DARK),
        Detail(1, FRONT, (0.38, 0.62), (0.1, 0.28), _PLATE),
        Detail(1, REAR, (0.36, 0.64), (0.48, 0.7), _PLATE),
        *_pair(2, LEFT, (0.08, 0.49), (0.12, 0.84), _GLASS),
        *_pair(2, LEFT, (0.53, 0.92), (0.12, 0.84), _GLASS),
        Detail(2, FRONT, (0.06, 0.94), (0.06, 0.9), _GLASS),
        Detail(2, REAR, (0.07, 0.93), (0.1, 0.86), _GLASS),
    ),
    "Bus or Truck": (
        *_wheel(1, 0.16, 0.07, (-0.12, 0.22)),
        *_wheel(1, 0.34, 0.07, (-0.12, 0.22)),
        *_wheel(2, 0.5, 0.33, (-0.155, 0.28)),
        *_pair(1, LEFT, (0.02, 0.98), (0.5, 0.58), _PLATE),
        *_pair(1, REAR, (0.04, 0.14), (0.06, 0.14), _RED),
        Detail(1, REAR, (0.4, 0.6), (0.06, 0.12), _PLATE),
        Detail(1, REAR, (0.49, 0.51), (0.18, 0.96), _DARK),
        Detail(2, FRONT, (0.06, 0.94), (0.52, 0.93), _GLASS),
        *_pair(2, FRONT, (0.05, 0.2), (0.1, 0.2), _LAMP),
        Detail(2, FRONT, (0.4, 0.6), (0.06, 0.15), _PLATE),
        *_pair(2, LEFT, (0.3, 0.85), (0.52, 0.9), _GLASS),
    ),
    "Pedestrian": (
        Detail(3, REAR, (0.0, 1.0), (0.15, 1.0), _HAIR),
        *_pair(3, LEFT, (0.0, 1.0), (0.55, 1.0), _HAIR),
        Detail(3, FRONT, (0.0, 1.0), (0.75, 1.0), _HAIR),
        Detail(3, TOP, (0.0, 1.0), (0.0, 1.0), _HAIR),
        *_pair(2, FRONT, (0.0, 0.16), (0.1, 0.95), _DARK),
        *_pair(2, REAR, (0.0, 0.16), (0.1, 0.95), _DARK),
    ),
    "Motorcycle": (
        *_pair(0, LEFT, (0.3, 0.7), (0.3, 0.7), _RIM),
        *_pair(1, LEFT, (0.3, 0.7), (0.3, 0.7), _RIM),
        Detail(2, FRONT, (0.3, 0.7), (0.45, 0.95), _LAMP),
        Detail(2, REAR, (0.3, 0.7), (0.6, 0.9), _RED),
        Detail(2, REAR, (0.3, 0.7), (0.2, 0.5), _PLATE),
    ),
    "Bicycle": (
        *_pair(0, LEFT, (0.25, 0.75), (0.25, 0.75), _RIM),
        *_pair(1, LEFT, (0.25, 0.75), (0.25, 0.75), _RIM),
        Detail(4, REAR, (0.0, 1.0), (0.2, 1.0), _HAIR),
        Detail(4, TOP, (0.0, 1.0), (0.0, 1.0), _HAIR),
    ),
}


def on_faces(faces: Quads, u: Spans, v: Spans) -> Quads:
    """Computes the corners of rectangles on quadrilateral faces.

    Args:
        faces: Corners of the faces: lower first, lower second, upper second, upper first.
        u: Start and end along the lower edge.
        v: Start and end in the upward direction.

    Returns:
        Corners in the same order, interpolated bilinearly between the corners of the face.
    """
    u, v = u[:, [0, 1, 1, 0], None], v[:, [0, 0, 1, 1], None]  # [F, 4, 1]
    a, b, c, d = (faces[:, None, i] for i in range(4))
    corners: Quads = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * d + u * c)
    return corners


_FACADES = np.array(
    [(168, 158, 146), (142, 120, 106), (186, 184, 178), (120, 126, 134)], float
)
_TREES = np.array([(58, 84, 48), (70, 92, 52), (48, 74, 50)], float)
_SNOWY = np.array([206, 210, 214.0])
_FAR_M = 110.0


class Faces(NamedTuple):
    """Quadrilaterals in the radar's frame.

    Attributes:
        corners: x, y, z.
        color: Red, green, blue in white light.
        depth_m: Distance of the object from the camera.
        block_depth_m: Distance of the block from the camera.
        box: Index of the box, -1 for none.
    """

    corners: Quads
    color: Float[np.ndarray, "F 3"]
    depth_m: Float[np.ndarray, " F"]
    block_depth_m: Float[np.ndarray, " F"]
    box: Int[np.ndarray, " F"]


def make_panels(
    frame: SceneFrame, origin: Float[np.ndarray, "3"], ground_m: float, white: float
) -> Faces:
    """Creates upright rectangles for the surroundings in one frame.

    Args:
        frame: Scene of the frame, which contains the reflectors to draw.
        origin: Camera position, which trees and poles face.
        ground_m: Height of the ground.
        white: Amount of snow on trees and poles, from 0 to 1.
    """
    fixed = frame.reflectors
    near = np.hypot(fixed.position_m[:, 0], fixed.position_m[:, 1]) < _FAR_M
    panels = []
    colors = []
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
        a, b = position[:, :2] - side, position[:, :2] + side
        z = np.broadcast_to([ground_m + low, ground_m + high], a.shape)
        flat = np.stack([a, b, b, a], 1)
        panels.append(np.concatenate([flat, z[:, [0, 0, 1, 1], None]], -1))
        color = palette[frame.reflector_idx[chosen] * 7919 % len(palette)]
        if name in ("tree", "pole"):
            color = color + white * 0.6 * (_SNOWY - color)
        colors.append(color)
    corners = np.concatenate(panels)
    depth = np.linalg.norm(corners.mean(1) - origin, axis=1)
    no_box = np.full(len(depth), -1)
    return Faces(corners, np.concatenate(colors), depth, depth, no_box)
