"""Procedural sequences with lanes, traffic, parked vehicles, people and surroundings.

All random values are drawn once per sequence from its seed, and its frames differ only in
time. All vehicles in a lane have the same speed, so the distances between them are constant.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from radejax.simulation.world import environments, scene
from radejax.simulation.world.scene import Broadcast, PerFrame, Road, Sequence, Tracks

Size = Float[np.ndarray, "3"]

# Mean and standard deviation of length, width and height in meters.
SIZES = {
    "Sedan": ((4.6, 1.87, 1.55), (0.3, 0.07, 0.12)),
    "Bus or Truck": ((8.2, 2.4, 2.9), (1.9, 0.12, 0.35)),
    "Pedestrian": ((0.6, 0.6, 1.72), (0.05, 0.05, 0.09)),
    "Motorcycle": ((2.1, 0.8, 1.55), (0.12, 0.06, 0.1)),
    "Bicycle": ((1.75, 0.6, 1.65), (0.08, 0.05, 0.08)),
}


def make_sequence(
    name: int,
    conditions: scene.Conditions,
    num_frames: int,
    rng: np.random.Generator,
    vru_density_scale: float = 1.0,
) -> Sequence:
    """Creates a procedural sequence. The same generator state gives the same sequence.

    Args:
        name: Number of the sequence.
        conditions: A key of `ENVIRONMENTS`, "day" or "night", and one of K-Radar's seven
            weather conditions.
        num_frames: Number of frames, at 10 frames per second.
        rng: Random generator.
        vru_density_scale: Factor on the environment's number of pedestrians, motorcycles
            and bicycles.
    """
    law = environments.ENVIRONMENTS[conditions[0]].with_vulnerable(vru_density_scale)
    road = Road(float(rng.uniform(-1.0, 1.0) * law.max_curvature))
    clock = np.arange(num_frames) * scene.FRAME_PERIOD_S
    mean_speed = rng.uniform(*law.speed_mps)
    waves = clock / rng.uniform(8.0, 25.0) + rng.random()  # the speed varies slowly
    speed = mean_speed * (1.0 + 0.12 * np.sin(2 * np.pi * waves))
    along = scene.traveled(speed)
    traffic = _Traffic(law, road, clock, along, speed, rng)
    edges = traffic.fill()
    reflectors, mirrors = environments.make_surroundings(
        law, road, along[-1] + environments.SIGHT_M, edges, rng, environments.GROUND_M
    )
    return Sequence(
        name,
        *conditions,
        ego_along_m=along,
        ego_speed_mps=speed,
        tracks=traffic.tracks(),
        reflectors=reflectors,
        road=road,
        lanes_m=traffic.lane_borders,
        ground_m=environments.GROUND_M,
        mirrors_m=mirrors,
    )


class _Path(NamedTuple):
    """An object and its way; positions and speeds are one number or one per frame."""

    cls: str
    size: Size
    along: Broadcast
    left: Broadcast
    speed: Broadcast
    turn: float


@dataclasses.dataclass
class _Traffic:
    """Collects the objects of one sequence, each as a path along the road."""

    law: environments.Environment
    road: Road
    clock: PerFrame
    ego_along: PerFrame
    ego_speed: PerFrame
    rng: np.random.Generator
    paths: list[_Path] = dataclasses.field(default_factory=list)
    lane_borders: tuple[float, ...] = ()

    def fill(self) -> tuple[float, float]:
        """Adds all objects and returns the right and left edge of the road."""
        law = self.law
        rng = self.rng
        width = law.lane_width_m
        stands = self.ego_speed.max() == 0.0  # on the shoulder
        lanes = range(-law.lanes_right, law.lanes_left + 1)
        for lane in lanes:
            factor = 1.0 if lane == 0 else 1.0 + 0.08 * lane + rng.normal() * 0.05
            speed = self.ego_speed * factor
            if stands:
                speed = np.full_like(self.clock, 0.0 if lane == 0 else 23.0 + 2 * lane)
            self._lane(lane * width, speed, 1.0)
        border = (law.lanes_left + 0.5) * width + law.median_m
        mean = 23.0 if stands else max(float(self.ego_speed.mean()), 4.0)
        for lane in range(law.lanes_oncoming):
            speed = np.full_like(self.clock, mean * rng.uniform(0.85, 1.15))
            self._lane(border + (lane + 0.5) * width, speed, -1.0)
        right = -(law.lanes_right + 0.5) * width
        left = border + law.lanes_oncoming * width
        self.lane_borders = tuple(
            [right + i * width for i in range(len(lanes) + 1)]
            + [border + i * width for i in range(law.lanes_oncoming + 1)]
        )
        reach = 5.2 if law.perpendicular else 2.4
        pavement = 1.2
        if law.parked_per_100m > 0.0:
            self._parked(right - reach / 2, -1.0)
            self._parked(left + reach / 2, 1.0)
            pavement += reach
        self._walkers(right - pavement, left + pavement)
        self._cyclists(right + 0.5)
        return right - pavement - 1.0, left + pavement + 1.0

    def _size(self, cls: str) -> Size:
        mean, deviation = np.array(SIZES[cls])
        size: Size = mean + deviation * self.rng.normal(size=3).clip(-2, 2)
        return size

    def _vehicle_class(self) -> str:
        law = self.law
        draw = self.rng.random()
        if draw < law.trucks:
            return "Bus or Truck"
        return "Motorcycle" if draw < law.trucks + law.two_wheelers else "Sedan"

    def _lane(self, left_m: float, speed: PerFrame, direction: float) -> None:
        """Adds the vehicles of one lane, with constant distances between them.

        The lane at 0 is that of the ego vehicle, near which it is empty.
        """
        rng = self.rng
        way = scene.traveled(speed) * direction
        relative = way - self.ego_along
        along = -30.0 - max(relative.max(), 0.0) + rng.uniform(0.0, 20.0)
        last = environments.SIGHT_M - min(relative.min(), 0.0)
        while along < last:
            cls = self._vehicle_class()
            size = self._size(cls)
            rear = along
            along += size[0] / 2.0
            if left_m != 0.0 or not (-8.0 < rear < 7.0 or -8.0 < along < 7.0):
                sway = 0.15 * np.sin(self.clock * 0.7 + rng.uniform(0, 6.3))
                shift = rng.normal() * 0.2
                if cls == "Motorcycle":
                    shift += rng.uniform(-0.8, 0.8)
                turn = 0.0 if direction > 0 else np.pi
                left = left_m + shift + sway
                self.paths.append(_Path(cls, size, along + way, left, speed, turn))
            along += size[0] / 2.0 + 4.0 + rng.exponential(self.law.gap_m)

    def _parked(self, left_m: float, side: float) -> None:
        """Adds parked vehicles along one edge of the road."""
        rng = self.rng
        along = rng.uniform(-20.0, 0.0)
        while along < self.ego_along[-1] + environments.SIGHT_M:
            cls = "Bus or Truck" if rng.random() < 0.1 else "Sedan"
            size = self._size(cls)
            if self.law.perpendicular:
                cls = "Sedan"
                size = self._size(cls)
                turn = side * np.pi / 2
                footprint = size[1]
            else:
                turn = 0.0 if side < 0 or rng.random() < 0.3 else np.pi
                footprint = size[0]
            turn += rng.normal() * 0.04 + (np.pi if rng.random() < 0.15 else 0.0)
            along += footprint / 2.0
            self.paths.append(_Path(cls, size, along, left_m, 0.0, turn))
            spacing = 100.0 / self.law.parked_per_100m - footprint
            along += footprint / 2 + 0.7 + rng.exponential(max(spacing, 0.3))

    def _walkers(self, right_m: float, left_m: float) -> None:
        """Adds pedestrians on the pavements, some of whom cross the road."""
        rng = self.rng
        length = self.ego_along[-1] + 80.0
        for _ in range(rng.poisson(self.law.pedestrians_per_100m * length / 100.0)):
            along = rng.uniform(6.0, length)
            pace = rng.uniform(0.9, 1.7)
            size = self._size("Pedestrian")
            walked = pace * self.clock
            crosses = rng.random() < 0.15 and along > 25.0
            side = rng.choice([-1.0, 1.0])
            if crosses:
                left = (right_m if side > 0 else left_m) + side * walked
                turn = side * np.pi / 2
            else:
                left = rng.choice([right_m, left_m]) + rng.normal() * 0.4
                turn = 0.0 if side > 0 else np.pi
                along = along + side * walked
            self.paths.append(_Path("Pedestrian", size, along, left, pace, turn))

    def _cyclists(self, left_m: float) -> None:
        """Adds bicycles along the right edge of the road."""
        rng = self.rng
        length = self.ego_along[-1] + 80.0
        for _ in range(rng.poisson(self.law.bicycles_per_100m * length / 100.0)):
            pace = rng.uniform(3.0, 6.0)
            along = rng.uniform(8.0, length) + pace * self.clock
            left = left_m + rng.normal() * 0.2
            size = self._size("Bicycle")
            self.paths.append(_Path("Bicycle", size, along, left, pace, 0.0))

    def tracks(self) -> Tracks:
        """Returns all paths as boxes in the world frame, sorted by initial distance.

        There is at least one path, because every road type has oncoming traffic.
        """
        paths = sorted(self.paths, key=lambda path: abs(np.ravel(path.along)[0]))
        cls, sizes, *motion, turn = zip(*paths, strict=True)
        size = np.stack(sizes)
        along, left, speed = (
            np.stack([np.broadcast_to(value, self.clock.shape) for value in column], 1)
            for column in motion
        )  # [F, N]
        x, y, heading = self.road.position(along, left)
        yaw = heading + np.array(turn)[None]
        distance = np.abs(along - self.ego_along[:, None])
        z = np.broadcast_to(environments.GROUND_M + size[:, 2] / 2.0, x.shape)
        return Tracks(
            position_m=np.stack([x, y, z], -1),
            yaw_rad=yaw,
            velocity_mps=np.stack([speed * np.cos(yaw), speed * np.sin(yaw)], -1),
            is_present=distance < environments.SIGHT_M + 20.0,
            size_m=np.broadcast_to(size, (len(x), *size.shape)),
            cls=np.array([scene.class_index(c) for c in cls]),
            track_id=np.arange(1, len(paths) + 1),
            label_cls=cls,
        )
