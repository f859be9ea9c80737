"""Shapes of vehicles and people, which consist of a few flat faces in their box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from radejax.core.structures import CLASSES
from radejax.geometry.camera import CameraCalibration, project
from radejax.simulation.camera import details
from radejax.simulation.camera.details import Faces, Quads
from radejax.simulation.world.scene import SceneFrame

# A block in units of the half extents: x, y and z range, color role, and the taper, which is
# the fraction of length and width at its top.
_Pair = tuple[float, float]
_Block = tuple[_Pair, _Pair, _Pair, str, _Pair]

Colors = Float[np.ndarray, "N 3"]
Lengths = Float[np.ndarray, " N"]
Point = Float[np.ndarray, "3"]

_STRAIGHT = (1.0, 1.0)
BLOCKS: dict[str, tuple[_Block, ...]] = {
    "Sedan": (
        ((-0.96, 0.96), (-0.92, 0.92), (-1.0, -0.72), "dark", _STRAIGHT),
        ((-1.0, 1.0), (-1.0, 1.0), (-0.72, 0.12), "body", (0.98, 0.97)),
        ((-0.82, 0.42), (-0.9, 0.9), (0.12, 1.0), "body", (0.72, 0.86)),
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
_VERTICES = np.array(  # corners of a block: front, rear, left, right, top
    [(0, 3, 7, 4), (2, 1, 5, 6), (1, 0, 4, 5), (3, 2, 6, 7), (4, 7, 6, 5)]
)
_NORMALS = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)], float)
_EDGE_PARTS = 3
_DETAIL_M = 60.0
"""Distance from which objects have no details; a plate is two pixels wide there."""
_NEAR_M = 0.3
"""Distance of the near plane, at which faces are clipped."""
_SUN = np.array([0.35, 0.45, 0.82])


class Polygon(NamedTuple):
    """A face projected into the image.

    Attributes:
        points: Corners in order as a flat list u0, v0, u1, v1, ... in pixels.
        color: Red, green, blue.
        depth_m: Distance of the object, by which `visible_polygons` sorts.
        box: Index of the box in the frame, -1 for roadside shapes.
    """

    points: list[float]
    color: tuple[int, int, int]
    depth_m: float
    box: int


def object_colors(
    cls: Int[np.ndarray, " N"], rng: np.random.Generator
) -> Float[np.ndarray, "N 2 3"]:
    """Draws the body color and second color (legs) of objects given by class index."""
    paint = _PAINT[rng.integers(len(_PAINT), size=len(cls))]
    clothes = _CLOTHES[rng.integers(len(_CLOTHES), size=len(cls))]
    paint = paint * rng.uniform(0.82, 1.08, (len(cls), 1))
    is_person = np.asarray(cls)[:, None] == 2
    return np.stack([np.where(is_person, clothes, paint), clothes * 0.7], 1)


def blocks_of(cls: str) -> Float[np.ndarray, "K 8 3"]:
    """Returns the corners of a class's blocks in half extents, 4 lower then 4 upper."""
    corners = []
    for (x0, x1), (y0, y1), (z0, z1), _, (keep_x, keep_y) in BLOCKS[cls]:
        cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
        flat = np.array([(x1, y1), (x0, y1), (x0, y0), (x1, y0)])
        top = (flat - (cx, cy)) * (keep_x, keep_y) + (cx, cy)
        corners.append(
            np.concatenate([np.c_[flat, np.full(4, z0)], np.c_[top, np.full(4, z1)]])
        )
    return np.stack(corners)


class Light(NamedTuple):
    """Brightness and haze of a scene.

    Attributes:
        ambient: Brightness, 1 by day.
        veil: Color of the haze.
        extinction_per_m: Extinction coefficient of the haze.
        headlights: Whether the headlights of the ego vehicle are on.
    """

    ambient: float
    veil: Float[np.ndarray, "3"]
    extinction_per_m: float
    headlights: bool

    def apply(
        self, color: Colors, x_m: Lengths, y_m: Lengths, depth_m: Lengths
    ) -> Colors:
        """Computes the apparent colors of surfaces from their colors and positions."""
        brightness = np.full(np.shape(depth_m), self.ambient)
        if self.headlights:
            beam = np.exp(-np.square(y_m / (2.0 + 0.16 * np.abs(x_m))))
            brightness = brightness + 0.75 * beam * np.exp(-np.abs(x_m) / 28.0)
        clear = np.exp(-self.extinction_per_m * depth_m)[..., None]
        lit: Colors = color * brightness[..., None] * clear + self.veil * (1.0 - clear)
        return lit


def visible_polygons(
    frame: SceneFrame,
    colors: Float[np.ndarray, "N 2 3"],
    calibration: CameraCalibration,
    light: Light,
    roadside: Faces,
) -> list[Polygon]:
    """Returns the faces that are turned toward the camera as polygons, far objects first.

    Args:
        frame: Scene of the frame.
        colors: Colors as returned by `object_colors`.
        calibration: Calibration of the camera.
        light: Brightness and haze.
        roadside: Faces of the surroundings, from `details.make_panels`.
    """
    objects = _object_faces(frame, colors, camera_position(calibration))
    faces = Faces(*map(np.concatenate, zip(objects, roadside, strict=True)))
    order = np.lexsort((-faces.block_depth_m, -faces.depth_m))
    faces = Faces(*(column[order] for column in faces))
    center = faces.corners.mean(1)
    color = light.apply(faces.color, center[:, 0], center[:, 1], faces.depth_m)
    points = _project_faces(faces.corners, calibration)
    colors = np.clip(color, 0, 255).astype(int).tolist()
    columns = points, map(tuple, colors), faces.depth_m.tolist(), faces.box.tolist()
    return [Polygon(*row) for row in zip(*columns, strict=True) if row[0]]


def camera_position(calibration: CameraCalibration) -> Point:
    """Returns the position of the camera in the radar frame."""
    to_ego = calibration.rotation.T
    origin: Point = calibration.radar_from_lidar_m - to_ego @ calibration.translation_m
    return origin


def _object_faces(
    frame: SceneFrame, colors: Float[np.ndarray, "N 2 3"], origin: Point
) -> Faces:
    """Returns the faces of the objects that are turned toward the camera.

    Objects with their center more than 3 m behind the radar are left out.
    """
    flat = np.zeros(0)
    vector = np.zeros((0, 3))
    parts = [(np.zeros((0, 4, 3)), vector, flat, flat, flat.astype(int), vector)]
    for index in np.flatnonzero(frame.boxes[:, 0] > -3.0):
        box = frame.boxes[index]
        cls = CLASSES[frame.cls[index]]
        cos, sin = np.cos(box[6]), np.sin(box[6])
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        corners = _BLOCK_CORNERS[cls] * box[3:6] / 2.0 @ turn.T + box[:3]  # [K, 8, 3]
        depth = np.linalg.norm(box[:3] - origin)
        block = np.repeat(np.arange(len(corners)), len(_NORMALS))
        face = np.tile(np.arange(len(_NORMALS)), len(corners))
        quads = corners[:, _VERTICES].reshape(-1, 4, 3)
        roles = _ROLE_COLORS | {"body": colors[index, 0], "legs": colors[index, 1]}
        color = np.array([roles[role] for *_, role, _ in BLOCKS[cls]], float)[block]
        if depth < _DETAIL_M:  # appended, so that details are painted over their blocks
            on_block, on_face, u, v, paint = _DETAIL_TABLES[cls]
            chosen = quads[on_block * len(_NORMALS) + on_face]
            quads = np.concatenate([quads, details.on_faces(chosen, u, v)])
            block = np.r_[block, on_block]
            face = np.r_[face, on_face]
            color = np.concatenate([color, paint])
        block_depth = np.linalg.norm(corners.mean(1) - origin, axis=1)[block]
        depths = np.full(len(quads), depth)
        boxes = np.full(len(quads), index)
        parts.append(
            (quads, color, depths, block_depth, boxes, _NORMALS[face] @ turn.T)
        )
    *columns, normal = map(np.concatenate, zip(*parts, strict=True))
    faces = Faces(*columns)
    sunlit = 0.62 + 0.38 * np.maximum(normal @ _SUN, 0.0)
    faces = faces._replace(color=faces.color * sunlit[:, None])
    shown = ((faces.corners.mean(1) - origin) * normal).sum(1) < 0
    return Faces(*(column[shown] for column in faces))


def _project_faces(faces: Quads, calibration: CameraCalibration) -> list[list[float]]:
    """Projects faces to flat lists of pixels, clipped at the near plane.

    Edges are subdivided to follow the lens distortion. A face that is entirely nearer
    than the near plane or outside of the image gives an empty list.
    """
    camera = calibration.camera("raw")
    following = np.roll(faces, -1, axis=1)
    part = np.linspace(0.0, 1.0, _EDGE_PARTS, endpoint=False)[:, None]
    outlines = faces[:, :, None] + part * (following - faces)[:, :, None]
    outlines = outlines.reshape(len(faces), -1, 3)
    size = np.array([calibration.width, calibration.height], float)
    vicinity = -2.0 * size, 3.0 * size
    places, depth = project(outlines, camera)
    is_cut = depth.min(1) < _NEAR_M
    result: list[list[float]] = [[] for _ in faces]
    shown = ((places.max(1) >= 0) & (places.min(1) <= size)).all(1)
    # Flat lists of only the visible faces: creating tuples would take as long as drawing.
    whole = np.flatnonzero(shown & ~is_cut)
    flat = np.clip(places[whole], *vicinity).reshape(-1, 2 * places.shape[1]).tolist()
    for index, points in zip(whole, flat, strict=True):
        result[index] = points
    for index in np.flatnonzero(is_cut & (depth.max(1) >= _NEAR_M)):
        cut = project(_cut_near(outlines[index], depth[index]), camera)[0]
        if (cut.max(0) >= 0).all() and (cut.min(0) <= size).all():
            result[index] = np.clip(cut, *vicinity).ravel().tolist()
    return result


def _cut_near(
    outline: Float[np.ndarray, "P 3"], depth: Float[np.ndarray, " P"]
) -> Float[np.ndarray, "Q 3"]:
    """Clips a polygon at the near plane by the Sutherland-Hodgman algorithm."""
    kept = []
    for i in range(len(outline)):
        here, there = depth[i - 1], depth[i]
        if here >= _NEAR_M:
            kept.append(outline[i - 1])
        if (here >= _NEAR_M) != (there >= _NEAR_M):
            part = (_NEAR_M - here) / (there - here)
            kept.append(outline[i - 1] + part * (outline[i] - outline[i - 1]))
    return np.array(kept)


_BLOCK_CORNERS = {name: blocks_of(name) for name in BLOCKS}
_DETAIL_TABLES = {  # the fields of `Detail` as columns
    name: [np.array(column) for column in zip(*details.DETAILS[name], strict=True)]
    for name in BLOCKS
}
