"""K-Radar's road types: what drives, stands and grows where, and how fast."""

from __future__ import annotations

import dataclasses

GROUND_M = -0.9
"""The ground in the radar's frame: K-Radar's radar is mounted at bumper height."""

SIGHT_M = 130.0
"""How far ahead of the ego objects are placed."""


@dataclasses.dataclass(frozen=True)
class Environment:
    """One of K-Radar's road types.

    Attributes:
        speed_mps: Range of ego speeds.
        lane_width_m: Width of a lane.
        lanes_left: Lanes of our direction left of the ego's.
        lanes_right: Lanes of our direction right of the ego's.
        lanes_oncoming: Lanes of the other direction.
        median_m: Strip between the directions.
        gap_m: Mean free distance between vehicles of a lane.
        trucks: Share of buses and trucks in traffic.
        two_wheelers: Share of motorcycles in traffic.
        parked_per_100m: Vehicles parked along each side.
        pedestrians_per_100m: People on both pavements together.
        bicycles_per_100m: Bicycles along the right edge.
        max_curvature: Largest curvature of the road in 1/m.
        walls: Probability of a wall or house front on each side.
        wall_m: Distance of walls from the edge of the road.
        rails: Probability of a guard rail on each side.
        trees_per_100m: Trees and poles on each side.
        perpendicular: True if parked vehicles stand across the road.
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
        """As many times the pedestrians, motorcycles and bicycles."""
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
