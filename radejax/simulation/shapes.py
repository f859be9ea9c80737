"""Vehicles and people as a few flat faces each, in the frame of their box."""

from __future__ import annotations

import dataclasses

import numpy as np

from radejax.geometry.camera import CameraCalibration

# A block in units of the half extents: x, y, z ranges; colour role; share kept of the
# length and width at its top (a taper).
_Block = tuple[
    tuple[float, float], tuple[float, float], tuple[float, float], str, tuple[float, float]
]

_STRAIGHT = (1.0, 1.0)
BLOCKS: dict[str, tuple[_Block, ...]] = {
    "Sedan": (
        ((-0.96, 0.96), (-0.92, 0.92), (-1.0, -0.72), "dark", _STRAIGHT),
        ((-1.0, 1.0), (-1.0, 1.0), (-0.72, 0.12), "body", (0.98, 0.97)),
        ((-0.82, 0.42), (-0.9, 0.9), (0.12, 1.0), "cabin", (0.72, 0.86)),
    ),
    "Bus or Truck": (
        ((-0.98, 0.98), (-0.95, 0.95), (-1.0, -0.78), "dark", _STRAIGHT),
        ((-1.0, 0.62), (-1.0, 1.0), (-0.78, 1.0), "body", _STRAIGHT),
        ((0.64, 1.0), (-0.97, 0.97), (-0.78, 0.62), "cabin", (0.9, 0.98)),
    ),
    "Pedestrian": (
        ((-0.45, 0.45), (-0.6, -0.05), (-1.0, -0.1), "legs", _STRAIGHT),
        ((-0.45, 0.45), (0.05, 0.6), (-1.0, -0.1), "legs", _STRAIGHT),
        ((-0.7, 0.7), (-1.0, 1.0), (-0.1, 0.68), "body", (0.8, 0.8)),
        ((-0.4, 0.4), (-0.35, 0.35), (0.7, 1.0), "skin", (0.7, 0.7)),
    ),
    "Motorcycle": (
        ((0.4, 1.0), (-0.16, 0.16), (-1.0, -0.3), "dark", _STRAIGHT),
        ((-1.0, -0.4), (-0.16, 0.16), (-1.0, -0.3), "dark", _STRAIGHT),
        ((-0.75, 0.75), (-0.45, 0.45), (-0.6, 0.0), "body", (0.8, 0.7)),
        ((-0.35, 0.15), (-1.0, 1.0), (0.0, 0.66), "legs", (0.8, 0.8)),
        ((-0.2, 0.1), (-0.35, 0.35), (0.68, 1.0), "dark", (0.8, 0.8)),
    ),
    "Bicycle": (
        ((0.3, 1.0), (-0.1, 0.1), (-1.0, -0.25), "dark", (0.6, 1.0)),
        ((-1.0, -0.3), (-0.1, 0.1), (-1.0, -0.25), "dark", (0.6, 1.0)),
        ((-0.5, 0.5), (-0.15, 0.15), (-0.5, -0.1), "body", _STRAIGHT),
        ((-0.35, 0.2), (-1.0, 1.0), (-0.1, 0.66), "legs", (0.8, 0.8)),
        ((-0.15, 0.15), (-0.35, 0.35), (0.68, 1.0), "skin", (0.7, 0.7)),
    ),
}

_ROLE_COLORS = {
    "dark": (34.0, 34.0, 38.0),
    "cabin": (52.0, 60.0, 72.0),
    "skin": (196.0, 160.0, 136.0),
}
_PAINT = np.array(
    [(236, 236, 236), (40, 42, 46), (126, 130, 136), (178, 182, 188), (150, 32, 34),
     (36, 62, 120), (58, 92, 66), (206, 178, 92)], float,
)  # fmt: skip
_CLOTHES = np.array(
    [(40, 44, 60), (120, 30, 40), (60, 90, 130), (190, 190, 186), (200, 140, 40)], float
)
_FACES = (
    ((0, 3, 7, 4), (1.0, 0.0, 0.0)),  # front
    ((2, 1, 5, 6), (-1.0, 0.0, 0.0)),  # rear
    ((1, 0, 4, 5), (0.0, 1.0, 0.0)),  # left
    ((3, 2, 6, 7), (0.0, -1.0, 0.0)),  # right
    ((4, 7, 6, 5), (0.0, 0.0, 1.0)),  # top
)
_SUN = np.array([0.35, 0.45, 0.82])


@dataclasses.dataclass(frozen=True)
class Polygon:
    """A face on the image.

    Attributes:
        points: Pixels (u, v) in order.
        color: Red, green, blue.
        depth_m: Distance of its object; `visible_polygons` sorts by it.
        box: Index of its box in the frame.
    """

    points: list[tuple[float, float]]
    color: tuple[int, int, int]
    depth_m: float
    box: int


def object_colors(cls: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """`[N, 2, 3]` body colour and second colour (legs) of objects by class index."""
    paint = _PAINT[rng.integers(len(_PAINT), size=len(cls))]
    clothes = _CLOTHES[rng.integers(len(_CLOTHES), size=len(cls))]
    is_person = np.asarray(cls)[:, None] == 2
    return np.stack([np.where(is_person, clothes, paint), clothes * 0.7], 1)


def blocks_of(cls: str) -> np.ndarray:
    """`[K, 8, 3]` corners of a class's blocks in half extents: 4 below, 4 above."""
    corners = []
    for (x0, x1), (y0, y1), (z0, z1), _, (keep_x, keep_y) in BLOCKS[cls]:
        cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
        flat = np.array([(x1, y1), (x0, y1), (x0, y0), (x1, y0)])
        top = (flat - (cx, cy)) * (keep_x, keep_y) + (cx, cy)
        corners.append(
            np.concatenate([np.c_[flat, np.full(4, z0)], np.c_[top, np.full(4, z1)]])
        )
    return np.stack(corners)


def visible_polygons(
    boxes: np.ndarray,
    classes: list[str],
    colors: np.ndarray,
    calibration: CameraCalibration,
    *,
    near_m: float,
    light: float,
) -> list[Polygon]:
    """Faces that look at the camera, far objects first.

    Args:
        boxes: `[N, 7]` in the radar's frame.
        classes: Names, one a box.
        colors: `[N, 2, 3]` of `object_colors`.
        calibration: The camera.
        near_m: Faces nearer than this are cut away.
        light: Brightness, 1 by day.
    """
    origin = calibration.ego_from_lidar_m - (
        calibration.rotation.T @ calibration.translation_m
    )
    order = np.argsort(-np.linalg.norm(boxes[:, :3] - origin, axis=1))
    polygons: list[Polygon] = []
    for index in order:
        if boxes[index, 0] > -3.0:
            polygons += _object_polygons(
                int(index), boxes[index], classes[index], colors[index], calibration,
                origin, near_m, light,
            )  # fmt: skip
    return polygons


def _object_polygons(
    index, box, cls, colors, calibration, origin, near_m, light
) -> list[Polygon]:
    """Faces of one object, its far blocks first."""
    cos, sin = np.cos(box[6]), np.sin(box[6])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    corners = (blocks_of(cls) * box[3:6] / 2.0) @ turn.T + box[:3]  # [K, 8, 3]
    far_first = np.argsort(-np.linalg.norm(corners.mean(1) - origin, axis=1))
    depth = float(np.linalg.norm(box[:3] - origin))
    result = []
    for block in far_first:
        role = BLOCKS[cls][block][3]
        for vertices, normal in _FACES:
            face = corners[block, list(vertices)]  # [4, 3]
            outward = turn @ np.array(normal)
            if (face.mean(0) - origin) @ outward >= 0:
                continue
            points = _project_face(face, calibration, near_m)
            if points:
                color = _shade(role, normal, outward, colors, light)
                result.append(Polygon(points, color, depth, index))
    return result


def _project_face(face, calibration, near_m) -> list[tuple[float, float]]:
    """Pixels of a face cut at the near plane; its edges bend with the lens."""
    following = np.roll(face, -1, axis=0)
    part = np.linspace(0.0, 1.0, 4, endpoint=False)[None, :, None]
    outline = (face[:, None] + part * (following - face)[:, None]).reshape(-1, 3)
    pixels, depth = calibration.project_ego(outline)
    if depth.max() < near_m:
        return []
    if depth.min() < near_m:
        outline = _cut_near(outline, depth, near_m)
        pixels, _ = calibration.project_ego(outline)
    low = np.array([-2.0 * calibration.width, -2.0 * calibration.height])
    pixels = np.clip(pixels, low, -low + [calibration.width, calibration.height])
    return [tuple(p) for p in pixels.tolist()]


def _cut_near(outline, depth, near_m) -> np.ndarray:
    """Polygon `[P, 3]` cut at a depth (Sutherland and Hodgman)."""
    kept = []
    for i in range(len(outline)):
        j = (i + 1) % len(outline)
        if depth[i] >= near_m:
            kept.append(outline[i])
        if (depth[i] >= near_m) != (depth[j] >= near_m):
            part = (near_m - depth[i]) / (depth[j] - depth[i])
            kept.append(outline[i] + part * (outline[j] - outline[i]))
    return np.array(kept)


def _shade(role, normal, outward, colors, light) -> tuple[int, int, int]:
    """Colour of a face under a fixed sun."""
    base = {"body": colors[0], "legs": colors[1]}.get(role)
    base = np.array(_ROLE_COLORS[role]) if base is None else base
    brightness = light * (0.62 + 0.38 * max(float(outward @ _SUN), 0.0))
    return tuple(int(c) for c in np.clip(base * brightness, 0, 255))
