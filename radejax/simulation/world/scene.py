"""The objects and surroundings of the ego vehicle in one sequence.

A `Sequence` contains tracks (moving or parked boxes with an identity) and static reflectors
in a fixed world frame, and the path of the ego vehicle. `Sequence.frame` returns the objects
and reflectors at one time in the ego frame. Sequences are created procedurally (`traffic`)
or from real labels (`replay`).
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from jaxtyping import Bool, Float, Int

from radejax.core.structures import CLASSES

FRAME_PERIOD_S = 0.1
"""Time between two frames: K-Radar records 10 frames per second."""

Conditions = tuple[str, str, str]
"""Environment, time and weather."""

PerFrame = Float[np.ndarray, " F"]
Values = Float[np.ndarray, "*all"]
Broadcast = float | Float[np.ndarray, "..."]
"""A value for all points, or an array that is broadcast to them."""


@dataclasses.dataclass(frozen=True)
class Road:
    """Centerline of a road: an arc of constant curvature that starts at the origin along x.

    Attributes:
        curvature_per_m: Inverse radius, positive for left turns and 0 for a straight road.
    """

    curvature_per_m: float = 0.0

    def position(
        self, along_m: Values, left_m: Broadcast
    ) -> tuple[Values, Values, Values]:
        """Returns world x, y and road heading at a point relative to the centerline.

        Args:
            along_m: Distance along the centerline.
            left_m: Distance to the left of the centerline.
        """
        k = self.curvature_per_m
        heading = k * along_m
        is_straight = abs(k) < 1e-9
        x = along_m if is_straight else np.sin(heading) / k
        y = np.zeros_like(along_m) if is_straight else (1.0 - np.cos(heading)) / k
        return x - left_m * np.sin(heading), y + left_m * np.cos(heading), heading


@dataclasses.dataclass(frozen=True)
class Tracks:
    """All objects of one sequence in every frame, in the world frame.

    Attributes:
        position_m: Box centers.
        yaw_rad: Headings.
        velocity_mps: Velocity over ground.
        is_present: True where an object is present.
        size_m: Length, width, height.
        cls: Index into `CLASSES`.
        track_id: Identity written to the labels.
        label_cls: Class names written to the labels.
    """

    position_m: Float[np.ndarray, "F N 3"]
    yaw_rad: Float[np.ndarray, "F N"]
    velocity_mps: Float[np.ndarray, "F N 2"]
    is_present: Bool[np.ndarray, "F N"]
    size_m: Float[np.ndarray, "F N 3"]
    cls: Int[np.ndarray, " N"]
    track_id: Int[np.ndarray, " N"]
    label_cls: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Reflectors:
    """Static scatterers of the surroundings in the world frame.

    Attributes:
        position_m: x, y, z.
        rcs_dbsm: Radar cross-section.
        normal_rad: Direction of the surface's normal in the ground plane, or NaN for an
            isotropic reflector.
        kind: Index into `REFLECTOR_KINDS`.
    """

    position_m: Float[np.ndarray, "M 3"]
    rcs_dbsm: Float[np.ndarray, " M"]
    normal_rad: Float[np.ndarray, " M"]
    kind: Int[np.ndarray, " M"]


REFLECTOR_KINDS = ("ground", "rail", "wall", "pole", "tree")


@dataclasses.dataclass(frozen=True)
class SceneFrame:
    """Objects and surroundings in one frame, in the radar frame (x forward, y left, z up).

    Attributes:
        boxes: x, y, z, l, w, h, yaw.
        velocity_mps: Velocity over ground, along the axes of the radar frame.
        cls: Index into `CLASSES`.
        track: Index into the tracks of the sequence.
        ego_velocity_mps: Velocity of the radar over ground, along its own axes.
        reflectors: Static surroundings near the ego, in this frame.
        reflector_idx: Indices of these reflectors in the sequence.
        index: Index of the frame in its sequence.
        ego_yaw_rate_radps: Turning rate of the radar, positive to the left.
    """

    boxes: Float[np.ndarray, "N 7"]
    velocity_mps: Float[np.ndarray, "N 2"]
    cls: Int[np.ndarray, " N"]
    track: Int[np.ndarray, " N"]
    ego_velocity_mps: Float[np.ndarray, "2"]
    reflectors: Reflectors
    reflector_idx: Int[np.ndarray, " M"]
    index: int
    ego_yaw_rate_radps: float = 0.0

    @property
    def relative_velocity_mps(self) -> Float[np.ndarray, "N 2"]:
        """Change of the boxes' x and y over time in the turning radar frame."""
        x_m, y_m = self.boxes[:, :2].T
        turning = self.ego_yaw_rate_radps * np.stack([-y_m, x_m], 1)
        relative: np.ndarray = self.velocity_mps - self.ego_velocity_mps - turning
        return relative


@dataclasses.dataclass(frozen=True)
class Sequence:
    """A whole sequence: conditions, ego path, objects and surroundings.

    Attributes:
        name: Number of the sequence.
        environment: K-Radar's road type.
        time: "day" or "night".
        weather: One of K-Radar's seven weather conditions.
        ego_along_m: Position of the radar along the road's centerline.
        ego_speed_mps: Speed of the ego vehicle, which drives straight ahead.
        tracks: Objects.
        reflectors: Static surroundings.
        road: Centerline of the road, along which the ego vehicle drives.
        lanes_m: Borders of the lanes in meters left of the centerline.
        ground_m: Height of the ground in the radar frame (negative).
        mirrors_m: Positions of the rails and walls that mirror objects, in meters left of
            the centerline.
    """

    name: int
    environment: str
    time: str
    weather: str
    ego_along_m: PerFrame
    ego_speed_mps: PerFrame
    tracks: Tracks
    reflectors: Reflectors
    road: Road
    lanes_m: tuple[float, ...]
    ground_m: float
    mirrors_m: tuple[float, ...] = ()

    @functools.cached_property
    def ego_pose(self) -> Float[np.ndarray, "F 3"]:
        """World x, y and heading of the radar."""
        return np.stack(self.road.position(self.ego_along_m, 0.0), 1)

    def frame(self, index: int, max_distance_m: float = 150.0) -> SceneFrame:
        """Returns the objects and reflectors at frame `index` up to a maximum distance."""
        tracks = self.tracks
        fixed = self.reflectors
        x_m, y_m, heading = self.ego_pose[index]
        origin = np.array([x_m, y_m, 0.0])
        centers = turned(tracks.position_m[index] - origin, -heading)
        is_near = np.hypot(centers[:, 0], centers[:, 1]) < max_distance_m
        chosen = np.flatnonzero(tracks.is_present[index] & is_near)
        turn = tracks.yaw_rad[index] - heading
        yaw = (turn + np.pi) % (2.0 * np.pi) - np.pi  # in [-pi, pi)
        boxes = np.concatenate([centers, tracks.size_m[index], yaw[:, None]], 1)
        points = turned(fixed.position_m - origin, -heading)
        distance = np.hypot(points[:, 0], points[:, 1])
        # The ego vehicle blocks the view to the rear, and nothing is within 2 m of the radar.
        is_near = (distance > 2.0) & (distance < max_distance_m)
        seen = np.flatnonzero((points[:, 0] > 0) & is_near)
        return SceneFrame(
            boxes=boxes[chosen],
            velocity_mps=turned(tracks.velocity_mps[index, chosen], -heading),
            cls=tracks.cls[chosen],
            track=chosen,
            ego_velocity_mps=np.array([self.ego_speed_mps[index], 0.0]),
            reflectors=Reflectors(
                position_m=points[seen],
                rcs_dbsm=fixed.rcs_dbsm[seen],
                normal_rad=fixed.normal_rad[seen] - heading,
                kind=fixed.kind[seen],
            ),
            reflector_idx=seen,
            index=index,
            ego_yaw_rate_radps=self.ego_speed_mps[index] * self.road.curvature_per_m,
        )


def traveled(
    speed_mps: PerFrame, period_s: float | PerFrame = FRAME_PERIOD_S
) -> PerFrame:
    """Returns the distance since the first frame if each speed is held for one period."""
    return np.concatenate([[0.0], np.cumsum((speed_mps * period_s)[:-1])])


def class_index(name: str) -> int:
    """Returns the index of a class name, where a group counts as its class."""
    return CLASSES.index(name.removesuffix(" Group"))


def is_blocked(
    targets: Float[np.ndarray, "S 3"],
    boxes: Float[np.ndarray, "N 7"],
    owner: Int[np.ndarray, " S"],
) -> Bool[np.ndarray, " S"]:
    """Returns True for points whose line of sight from the origin enters a box.

    Boxes that contain the origin do not block.

    Args:
        targets: Points.
        boxes: Boxes that can block.
        owner: Index of the box that the point belongs to, which does not block it, or -1.
    """
    start = turned(0.0 - boxes[None, :, :3], -boxes[:, 6])  # in the frames of the boxes
    ray = turned(targets[:, None] - boxes[None, :, :3], -boxes[:, 6]) - start
    ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    half = boxes[:, 3:6] / 2.0
    near, far = (-half - start) / ray, (half - start) / ray
    enter = np.minimum(near, far).max(-1)
    leave = np.maximum(near, far).min(-1)
    crosses = (enter < leave) & (leave > 0) & (enter < 1.0) & (enter > 0)
    crosses &= np.arange(len(boxes))[None] != owner[:, None]
    blocked: Bool[np.ndarray, " S"] = crosses.any(1)
    return blocked


def turned(
    vectors: Float[np.ndarray, "*all D"], angle_rad: Broadcast
) -> Float[np.ndarray, "*all D"]:
    """Rotates vectors of two or three components counter-clockwise about the z axis."""
    x, y, *z = np.moveaxis(vectors, -1, 0)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([cos * x - sin * y, sin * x + cos * y, *z], -1)
