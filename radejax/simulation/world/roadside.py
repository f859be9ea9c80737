"""Static surroundings beside the road: where they stand, how strongly they scatter."""

from __future__ import annotations

import numpy as np

from radejax.simulation.world.environments import Environment
from radejax.simulation.world.scene import REFLECTOR_KINDS, Reflectors, Road


def make_surroundings(
    law: Environment,
    road: Road,
    length_m: float,
    edges: tuple[float, float],
    rng: np.random.Generator,
    ground_m: float,
) -> tuple[Reflectors, tuple[float, ...]]:
    """Static scatterers along the road: ground, rails, walls, trees and poles.

    Args:
        law: Road type.
        road: Centerline.
        length_m: How far they reach.
        edges: Right and left edge, metres left of the centerline.
        rng: Source of everything random.
        ground_m: Height of the ground in the radar's frame.

    Returns:
        The scatterers in the world frame, and the lateral positions of the rails and
        walls, which mirror objects.
    """
    parts: list[tuple] = []
    mirrors: list[float] = []

    def add(kind, along, left, height, dbsm, side=None) -> None:
        """Reflectors over the road; `side` is where their normal points, if anywhere."""
        x, y, heading = road.position(along, left)
        turn = np.nan if side is None else side * np.pi / 2.0
        kinds = np.full(len(x), REFLECTOR_KINDS.index(kind))
        position = np.stack([x, y, ground_m + height], 1)
        parts.append((position, dbsm, heading + turn, kinds))

    right, left = edges
    count = int(length_m * 1.2)
    add(
        "ground", rng.uniform(0, length_m, count),
        rng.uniform(right - 15.0, left + 15.0, count), np.zeros(count),
        rng.normal(-24.0, 5.0, count),
    )  # fmt: skip
    for side, edge in ((-1.0, right), (1.0, left)):
        if rng.random() < law.rails:
            along = np.arange(0.0, length_m, 2.0)  # posts
            mirrors.append(edge + side * 0.6)
            dbsm = rng.normal(-9.0, 3.0, along.size)
            add("rail", along, mirrors[-1], np.full(along.size, 0.6), dbsm, -side)
        if rng.random() < law.walls:
            along = rng.uniform(0.0, length_m, int(length_m * 0.8))
            along = along[np.sin(along / rng.uniform(6.0, 14.0)) > -0.6]  # gaps
            mirrors.append(edge + side * law.wall_m)
            height = rng.uniform(0.2, 6.0, along.size)
            dbsm = rng.normal(-7.0, 4.0, along.size)
            add("wall", along, mirrors[-1], height, dbsm, -side)
        count = rng.poisson(law.trees_per_100m * length_m / 100.0)
        add(
            "tree" if rng.random() < 0.5 else "pole", rng.uniform(0.0, length_m, count),
            edge + side * rng.uniform(0.5, 6.0, count), rng.uniform(0.3, 3.0, count),
            rng.normal(-5.0, 4.0, count),
        )  # fmt: skip
    return Reflectors(*map(np.concatenate, zip(*parts, strict=True))), tuple(mirrors)
