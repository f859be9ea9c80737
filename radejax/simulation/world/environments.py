"""K-Radar's road types: traffic, parked vehicles, people and static reflectors."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Int

from radejax.simulation.world.scene import (
    REFLECTOR_KINDS,
    Broadcast,
    Reflectors,
    Road,
    Values,
)

GROUND_M = -0.9
"""Height of the ground in the radar frame. K-Radar's radar is mounted at bumper height."""

SIGHT_M = 130.0
"""Distance ahead of the ego vehicle up to which objects are placed."""


@dataclasses.dataclass(frozen=True)
class Environment:
    """One of K-Radar's road types.

    Attributes:
        speed_mps: Range of ego speeds.
        lane_width_m: Width of a lane.
        lanes_left: Number of lanes left of the ego lane in the direction of the ego.
        lanes_right: Number of lanes right of the ego lane in the direction of the ego.
        lanes_oncoming: Number of lanes in the opposite direction.
        median_m: Width of the strip between the directions.
        gap_m: Mean of the exponentially distributed part of the gaps in a lane.
        trucks: Fraction of buses and trucks in traffic.
        two_wheelers: Fraction of motorcycles in traffic.
        parked_per_100m: Number of parked vehicles on each side per 100 m.
        pedestrians_per_100m: Number of pedestrians on both pavements together per 100 m.
        bicycles_per_100m: Number of bicycles along the right edge per 100 m.
        max_curvature: Maximum curvature of the road in 1/m.
        walls: Probability of a wall or facade on each side.
        wall_m: Distance of walls from the edge of the road.
        rails: Probability of a guard rail on each side.
        trees_per_100m: Number of trees or poles on each side per 100 m.
        perpendicular: Whether vehicles park perpendicular to the road.
    """

    speed_mps: tuple[float, float]
    lane_width_m: float = 3.3
    lanes_left: int = 0
    lanes_right: int = 0
    lanes_oncoming: int = 1
    median_m: float = 0.5
    gap_m: float = 22.0
    trucks: float = 0.15
    two_wheelers: float = 0.08
    parked_per_100m: float = 3.0
    pedestrians_per_100m: float = 3.0
    bicycles_per_100m: float = 1.0
    max_curvature: float = 0.001
    walls: float = 0.3
    wall_m: float = 8.0
    rails: float = 0.0
    trees_per_100m: float = 6.0
    perpendicular: bool = False

    def with_vulnerable(self, times: float) -> Environment:
        """Returns a copy with the numbers of VRUs multiplied by `times`."""
        names = ("two_wheelers", "pedestrians_per_100m", "bicycles_per_100m")
        return dataclasses.replace(self, **{n: times * getattr(self, n) for n in names})


ENVIRONMENTS = {
    "urban": Environment(
        (6.0, 14.0), lanes_left=1, lanes_oncoming=2, walls=0.6, parked_per_100m=4.0
    ),
    "highway": Environment(
        (21.0, 28.0), 3.5, 1, 1, 3, 2.0, 28.0, 0.22, 0.05, 0.0, 0.0, 0.0, 0.0006,
        0.2, 8.0, 0.9, 3.0,
    ),
    "alleyway": Environment(
        (2.0, 5.0), 3.0, gap_m=30.0, trucks=0.1, parked_per_100m=7.0,
        pedestrians_per_100m=6.0, bicycles_per_100m=2.0, walls=0.95, wall_m=3.5,
        trees_per_100m=4.0,
    ),
    "university": Environment(
        (3.0, 8.0), 3.0, gap_m=30.0, trucks=0.12, parked_per_100m=4.0,
        pedestrians_per_100m=7.0, bicycles_per_100m=3.0, walls=0.4, wall_m=14.0,
        trees_per_100m=9.0,
    ),
    "countryside": Environment(
        (11.0, 17.0), gap_m=30.0, parked_per_100m=0.7, pedestrians_per_100m=0.8,
        walls=0.05, trees_per_100m=8.0, max_curvature=0.002,
    ),
    "mountain": Environment(
        (8.0, 14.0), gap_m=30.0, parked_per_100m=0.7, pedestrians_per_100m=0.5,
        walls=0.5, wall_m=5.0, rails=0.6, max_curvature=0.006,
    ),
    "parkinglots": Environment(
        (1.0, 3.0), 3.4, gap_m=35.0, trucks=0.08, parked_per_100m=20.0,
        pedestrians_per_100m=4.0, walls=0.3, wall_m=12.0, perpendicular=True,
    ),
    "shoulder": Environment(
        (0.0, 0.0), 3.5, 2, 0, 2, 2.0, 30.0, 0.25, 0.05, 0.7, 0.7, 0.0, 0.0006,
        0.2, 10.0, 0.7, 4.0,
    ),
}  # fmt: skip
"""K-Radar's eight road types."""

SURROUNDINGS = ENVIRONMENTS | {
    "indoor": Environment((0.0, 0.0), walls=1.0, wall_m=0.5, trees_per_100m=0.0)
}
"""Those of own scenes: K-Radar's road types, or floor and walls."""

# Mean and standard deviation of the radar cross-section of each kind of reflector in dBsm.
_DBSM = {
    "ground": (-24.0, 5.0),
    "rail": (-9.0, 3.0),
    "wall": (-7.0, 4.0),
    "pole": (-5.0, 4.0),
    "tree": (-5.0, 4.0),
}


def make_surroundings(
    law: Environment,
    road: Road,
    length_m: float,
    edges: tuple[float, float],
    rng: np.random.Generator,
    ground_m: float,
) -> tuple[Reflectors, tuple[float, ...]]:
    """Draws the static reflectors along the road: ground, rails, walls, trees and poles.

    Args:
        law: Road type.
        road: Centerline.
        length_m: Length of the road along which reflectors are placed.
        edges: Right and left edge of the road in meters left of the centerline.
        rng: Random generator.
        ground_m: Height of the ground in the radar frame.

    Returns:
        The reflectors in the world frame, and the lateral positions of the rails and
        walls, which mirror objects.
    """
    parts: list[tuple[Values, Values, Values, Int[np.ndarray, " M"]]] = []
    mirrors: list[float] = []

    def add(
        kind: str, along: Values, left: Broadcast, up: Broadcast, side: float = np.nan
    ) -> None:
        """Adds reflectors whose normal points left (1) or right (-1), or isotropic ones."""
        x, y, heading = road.position(along, left)
        position = np.stack([x, y, np.broadcast_to(ground_m + up, x.shape)], 1)
        dbsm = rng.normal(*_DBSM[kind], len(x))
        kinds = np.full(len(x), REFLECTOR_KINDS.index(kind))
        parts.append((position, dbsm, heading + side * np.pi / 2.0, kinds))

    right, left = edges
    count = int(length_m * 1.2)
    along = rng.uniform(0, length_m, count)
    add("ground", along, rng.uniform(right - 15.0, left + 15.0, count), 0.0)
    for side, edge in ((-1.0, right), (1.0, left)):
        if rng.random() < law.rails:
            along = np.arange(0.0, length_m, 2.0)  # posts
            mirrors.append(edge + side * 0.6)
            add("rail", along, mirrors[-1], 0.6, -side)
        if rng.random() < law.walls:
            along = rng.uniform(0.0, length_m, int(length_m * 0.8))
            along = along[np.sin(along / rng.uniform(6.0, 14.0)) > -0.6]  # gaps
            mirrors.append(edge + side * law.wall_m)
            add("wall", along, mirrors[-1], rng.uniform(0.2, 6.0, along.size), -side)
        count = rng.poisson(law.trees_per_100m * length_m / 100.0)
        kind = "tree" if rng.random() < 0.5 else "pole"
        along = rng.uniform(0.0, length_m, count)
        lateral = edge + side * rng.uniform(0.5, 6.0, count)
        add(kind, along, lateral, rng.uniform(0.3, 3.0, count))
    return Reflectors(*map(np.concatenate, zip(*parts, strict=True))), tuple(mirrors)
