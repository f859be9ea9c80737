"""Static surroundings: where they stand, how they scatter, and what they mirror."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from radejax.simulation.radar.scattering import (
    OCCLUDED_DB,
    FrameScattering,
    face_gain,
    is_blocked,
    received_power,
)
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.scene import (
    REFLECTOR_KINDS,
    Reflectors,
    Road,
    SceneFrame,
    Sequence,
)

if TYPE_CHECKING:
    from radejax.simulation.world.traffic import Environment


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
    parts: list[tuple] = []  # (kind, along, left, height over ground, dBsm, normal)
    mirrors: list[float] = []
    right, left = edges
    count = int(length_m * 1.2)
    parts.append(
        ("ground", rng.uniform(0, length_m, count),
         rng.uniform(right - 15.0, left + 15.0, count), np.zeros(count),
         rng.normal(-24.0, 5.0, count), None)
    )  # fmt: skip
    for side, edge in ((-1.0, right), (1.0, left)):
        if rng.random() < law.rails:
            along = np.arange(0.0, length_m, 2.0)  # posts
            mirrors.append(edge + side * 0.6)
            parts.append(
                ("rail", along, mirrors[-1] + 0 * along, 0.6 + 0 * along,
                 rng.normal(-9.0, 3.0, along.size), -side)
            )  # fmt: skip
        if rng.random() < law.walls:
            count = int(length_m * 0.8)
            along = rng.uniform(0.0, length_m, count)
            along = along[np.sin(along / rng.uniform(6.0, 14.0)) > -0.6]  # gaps
            mirrors.append(edge + side * law.wall_m)
            parts.append(
                ("wall", along, mirrors[-1] + 0 * along,
                 rng.uniform(0.2, 6.0, along.size), rng.normal(-7.0, 4.0, along.size),
                 -side)
            )  # fmt: skip
        count = rng.poisson(law.trees_per_100m * length_m / 100.0)
        kind = "tree" if rng.random() < 0.5 else "pole"
        parts.append(
            (kind, rng.uniform(0.0, length_m, count),
             edge + side * rng.uniform(0.5, 6.0, count), rng.uniform(0.3, 3.0, count),
             rng.normal(-5.0, 4.0, count), None)
        )  # fmt: skip
    return _to_world(parts, road, ground_m), tuple(mirrors)


def _to_world(parts: list[tuple], road: Road, ground_m: float) -> Reflectors:
    kind, position, rcs, normal = [], [], [], []
    for name, along, left, height, dbsm, side in parts:
        x, y, heading = road.position(along, left)
        position.append(np.stack([x, y, ground_m + height], 1))
        rcs.append(dbsm)
        kind.append(np.full(len(x), REFLECTOR_KINDS.index(name)))
        facing = heading + (0.0 if side is None else side * np.pi / 2.0)
        normal.append(np.full(len(x), np.nan) if side is None else facing)
    return Reflectors(
        np.concatenate(position),
        np.concatenate(rcs),
        np.concatenate(normal),
        np.concatenate(kind),
    )


def scatter_surroundings(
    frame: SceneFrame,
    sequence: Sequence,
    phase_rad: np.ndarray,
    parameters: RadarParameters,
) -> FrameScattering:
    """Scatterers of the static surroundings: ground, rails, walls, poles, trees.

    Args:
        frame: Its reflectors are used.
        sequence: Where they come from.
        phase_rad: `[M]` phases of all reflectors of the sequence.
        parameters: The sensor.
    """
    fixed = frame.reflectors
    position = fixed.position_m
    toward = np.arctan2(-position[:, 1], -position[:, 0])
    cosine = np.cos(toward - fixed.normal_rad)
    gain = np.where(np.isnan(fixed.normal_rad), 1.0, face_gain(np.abs(cosine), 4.0))
    power = received_power(position, 10.0 ** (fixed.rcs_dbsm / 10.0) * gain, parameters)
    owner = np.full(len(position), -1)
    blocked = is_blocked(position, frame.boxes, owner)
    power = np.where(blocked, power * 10.0 ** (OCCLUDED_DB / 10.0), power)
    return FrameScattering(
        position,
        np.zeros((len(position), 2)),
        power,
        phase_rad[frame.reflector_idx],
        owner,
    )


MIRROR_DB = -18.0
"""Two reflections on a rail or wall, there and back, with all its gaps and posts."""

_MIRROR_REACH_M = 45.0


def scatter_ghosts(
    objects: FrameScattering, frame: SceneFrame, sequence: Sequence
) -> FrameScattering:
    """Mirror images of objects behind rails and walls beside the road.

    The way radar - wall - object - wall - radar looks like an object at the mirrored
    position with the mirrored velocity (the third-order ghost of the literature).

    Args:
        objects: Scatterers of the objects of the frame.
        frame: The frame; the walls run along its x axis near the ego.
        sequence: Whose `mirrors_m` are used.

    References:
        Ghosts: Kraus et al., "Using machine learning to detect ghost images in
        automotive radar", ITSC 2020, arXiv:2007.05280. The loss is our choice.
    """
    parts = []
    near = np.flatnonzero(
        np.hypot(objects.position_m[:, 0], objects.position_m[:, 1]) < _MIRROR_REACH_M
    )
    for mirror in sequence.mirrors_m:
        plane = mirror - sequence.ego_left_m
        position = objects.position_m[near].copy()
        inside = np.sign(plane) * (plane - position[:, 1]) > 0  # on our side of it
        chosen = near[inside]
        position = position[inside]
        direct = np.linalg.norm(position, axis=1)
        position[:, 1] = 2.0 * plane - position[:, 1]
        mirrored = np.linalg.norm(position, axis=1)
        velocity = objects.velocity_mps[chosen] * (1.0, -1.0)
        loss = 10.0 ** (MIRROR_DB / 10.0) * (direct / mirrored) ** 4
        parts.append(
            FrameScattering(
                position,
                velocity,
                objects.power[chosen] * loss,
                objects.phase_rad[chosen] + mirror,
                np.full(len(chosen), -1),
            )
        )
    if not parts:
        return FrameScattering(
            np.zeros((0, 3)),
            np.zeros((0, 2)),
            np.zeros(0),
            np.zeros(0),
            np.zeros(0, int),
        )
    return FrameScattering(
        *(
            np.concatenate([getattr(p, f.name) for p in parts])
            for f in dataclasses.fields(FrameScattering)
        )
    )
