"""Returns of what nobody labels: static surroundings, and ghosts mirrored in them."""

from __future__ import annotations

import dataclasses

import numpy as np

from radejax.simulation.radar.scattering import (
    OCCLUDED_DB,
    FrameScattering,
    face_gain,
    received_power,
)
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.scene import SceneFrame, Sequence, is_blocked


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
    for plane in sequence.mirrors_m:
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
                objects.phase_rad[chosen] + plane,
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
