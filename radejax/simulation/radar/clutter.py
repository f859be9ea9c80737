"""Returns of what nobody labels: static surroundings, and ghosts mirrored in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from radejax.simulation.radar.scattering import (
    OCCLUDED_DB,
    FrameScattering,
    face_gain,
    join,
    received_power,
)
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.scene import SceneFrame, is_blocked


def scatter_surroundings(
    frame: SceneFrame,
    phase_rad: Float[np.ndarray, " M"],
    parameters: RadarParameters,
) -> FrameScattering:
    """Scatterers of the static surroundings: ground, rails, walls, poles, trees.

    Args:
        frame: Its reflectors are used.
        phase_rad: Phases of all reflectors of its sequence.
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
    objects: FrameScattering, mirrors_m: Sequence[float]
) -> FrameScattering:
    """Mirror images of objects behind rails and walls beside the road.

    The way radar - wall - object - wall - radar looks like an object at the mirrored
    position with the mirrored velocity (the third-order ghost of the literature).

    Args:
        objects: Scatterers of the objects of the frame.
        mirrors_m: Rails and walls, metres left of the ego; near it they run along x.

    References:
        Ghosts: Kraus et al., "Using machine learning to detect ghost images in
        automotive radar", ITSC 2020, arXiv:2007.05280. The loss is our choice.
    """
    parts = []
    near = np.flatnonzero(
        np.hypot(objects.position_m[:, 0], objects.position_m[:, 1]) < _MIRROR_REACH_M
    )
    for plane in mirrors_m:
        position = objects.position_m[near].copy()
        inside = np.sign(plane) * (plane - position[:, 1]) > 0  # on our side of it
        chosen, position = near[inside], position[inside]
        direct = np.linalg.norm(position, axis=1)
        position[:, 1] = 2.0 * plane - position[:, 1]
        mirrored = np.linalg.norm(position, axis=1)
        loss = 10.0 ** (MIRROR_DB / 10.0) * (direct / mirrored) ** 4
        parts.append(
            FrameScattering(
                position,
                objects.velocity_mps[chosen] * (1.0, -1.0),
                objects.power[chosen] * loss,
                objects.phase_rad[chosen] + plane,
                np.full(len(chosen), -1),
            )
        )
    return join(parts)
