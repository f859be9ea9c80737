"""Point scatterers of road users and surroundings.

Every object gets scattering centers on its faces once per sequence. In each frame, they are
transformed to the pose of the object, attenuated if their face is turned away from the
radar or if another object blocks them, and wheels, legs and pedals move (micro-Doppler).

The cross-sections are our choice, with one mean and one standard deviation per class. They
are of the order of measurements at 77 GHz. There is no single source for all five classes.

References:
    Pedestrians: Fortuny-Guasch and Chareau, "Radar cross section measurements of
    pedestrian dummies and humans in the 24/77 GHz frequency bands", JRC report EUR
    25762, 2013; Marchetti et al., "Radar cross-section of pedestrians in the low-THz
    band", IET Radar, Sonar and Navigation 2018 (with values reported at 77 GHz).
    Bicycles: Belgiovane and Chen, "Surrogate bicycle design for millimeter-wave
    automotive radar pre-collision testing", IEEE T-ITS 2017; -7 to 5 dBsm
    from behind (ACEA 2018, as quoted at apnielsen.com/bike-corner-relfector).
    Log-normal spread of vehicles: Lee et al., "Radar cross section measurement with
    77 GHz automotive FMCW radar", IEEE 2016.
    Objects as scattering centers: Schuler, Becker and Wiesbeck, "Extraction of virtual
    scattering centers of vehicles by ray-tracing simulations", IEEE TAP 2008.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.random import Generator

from radejax.core.structures import CLASSES
from radejax.simulation.radar import sensor
from radejax.simulation.radar.tensor import RadarParameters, Scatterers
from radejax.simulation.world import scene
from radejax.simulation.world.scene import SceneFrame

Vectors = Float[np.ndarray, "S 3"]
Values = Float[np.ndarray, " S"]
Indices = Int[np.ndarray, " S"]


class ClassScattering(NamedTuple):
    """Scattering properties of one class.

    Attributes:
        rcs_dbsm: Radar cross-section, averaged in square meters over aspects and objects
            and converted to dB.
        spread_db: Standard deviation of the cross-section between objects.
        num_points: Number of scattering centers on the whole surface.
        glint: Power of the specular flash of a flat face at normal incidence, relative to
            its diffuse power.
        micro: Fraction of the scattering centers that are on moving parts.
    """

    rcs_dbsm: float
    spread_db: float
    num_points: int
    glint: float
    micro: float


CLASS_SCATTERING = {
    "Sedan": ClassScattering(10.0, 3.0, 36, 6.0, 0.08),
    "Bus or Truck": ClassScattering(18.0, 4.0, 64, 8.0, 0.05),
    "Pedestrian": ClassScattering(-7.0, 2.5, 10, 0.0, 0.45),
    "Motorcycle": ClassScattering(2.0, 3.0, 14, 1.0, 0.2),
    "Bicycle": ClassScattering(-2.0, 3.0, 14, 1.0, 0.35),
}
"""All values are our choice; see the docstring of the module."""

OCCLUDED_DB = -22.0
"""Two-way gain in dB behind another object. Our choice: some power is diffracted around it or
reflected under it."""

_SIDES = np.array([(1.0, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
"""Normals of the front, rear, left and right face."""

_GLINT_WIDTH_RAD = np.deg2rad(6.0)
_BACK_LEAK = 0.02
"""Relative power of a scatterer on a face that is turned away from the radar."""


class ObjectScatterers(NamedTuple):
    """Scattering centers of all objects in one sequence, in the frames of their boxes.

    Attributes:
        track: Index of the track of each scattering center, in ascending order.
        position: Position in units of the half extents of the box.
        normal: Unit normal of the face.
        power_m2: Radar cross-section at normal incidence, without glint.
        glint: Power of the specular flash, relative to the diffuse power.
        phase_rad: Phase of the reflection.
        micro: Amplitude of the velocity swing relative to the object's speed, 0 for the
            body.
        micro_phase_rad: Phase of the velocity swing at time 0.
    """

    track: Indices
    position: Vectors
    normal: Vectors
    power_m2: Values
    glint: Values
    phase_rad: Values
    micro: Values
    micro_phase_rad: Values


def make_object_scatterers(
    cls: Int[np.ndarray, " N"], size_m: Float[np.ndarray, "N 3"], rng: Generator
) -> ObjectScatterers:
    """Draws the scattering centers of objects.

    Args:
        cls: Class indices.
        size_m: Length, width and height of each object.
        rng: Random generator for the scattering centers and the cross-sections.

    Returns:
        Scattering centers of all objects, ordered by object. The cross-section of an
        object, averaged over aspects, is the mean of its class times a log-normal factor.
    """
    flat = np.zeros(0)
    vector = np.zeros((0, 3))
    none = ObjectScatterers(flat.astype(int), vector, vector, *[flat] * 5)
    objects = enumerate(zip(cls, size_m, strict=True))
    parts = (_one_object(i, CLASSES[c], size, rng) for i, (c, size) in objects)
    return ObjectScatterers(*map(np.concatenate, zip(none, *parts, strict=True)))


def _one_object(
    index: int, cls: str, size_m: Float[np.ndarray, "3"], rng: Generator
) -> ObjectScatterers:
    """Draws the scattering centers of one object."""
    law = CLASS_SCATTERING[cls]
    length, width, height = size_m
    count = law.num_points
    # Front, rear, left and right face in proportion to their area. Roofs are left out,
    # as the radar hardly sees them.
    area = np.array([width, width, length, length]) * height
    face = rng.choice(4, count, p=area / area.sum())
    face[:4] = np.arange(4)  # every side has at least one
    normal = _SIDES[face]
    along = rng.uniform(-1.0, 1.0, count)
    # Half of the points are moved outward, as edges and corners scatter more.
    along = np.where(rng.random(count) < 0.5, np.sign(along) * abs(along) ** 0.3, along)
    # Most of the power comes from low parts: bumpers, wheels and their reflection in the
    # road.
    up = rng.beta(1.6, 2.4, count) * 2.0 - 1.0
    position = np.where(normal == 0.0, along[:, None], normal)
    position[:, 2] = up
    weight = rng.exponential(1.0, count)
    is_micro = rng.random(count) < law.micro
    micro = np.where(is_micro, rng.uniform(0.4, 1.0, count), 0.0)
    # Mean total cross-section over all horizontal aspects.
    angle = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    cosine = normal[:, :2] @ np.stack([np.cos(angle), np.sin(angle)])  # [S, aspects]
    mean = (weight[:, None] * face_gain(cosine, law.glint)).sum(0).mean()
    rcs_db = law.rcs_dbsm + law.spread_db * rng.normal()
    # Divide by the mean exp(s^2 / 2) of the log-normal factor to keep the class's mean.
    rcs_db -= law.spread_db**2 * np.log(10.0) / 20.0
    return ObjectScatterers(
        track=np.full(count, index),
        position=position,
        normal=normal,
        power_m2=weight / mean * 10.0 ** (rcs_db / 10.0),
        glint=np.full(count, law.glint),
        phase_rad=rng.uniform(0.0, 2.0 * np.pi, count),
        micro=micro,
        micro_phase_rad=rng.uniform(0.0, 2.0 * np.pi, count),
    )


def face_gain(
    cosine: Float[np.ndarray, "*faces"], glint: Float[np.ndarray, "*#faces"] | float
) -> Float[np.ndarray, "*faces"]:
    """Computes the relative power of a scatterer from the aspect angle of its face.

    The power is the sum of a diffuse part `cos^2`, a Gaussian specular flash near the
    normal, and a small constant, which is all that faces turned away return.

    Args:
        cosine: Cosine of the angle between the normal and the direction to the radar.
        glint: Power of the flash relative to the diffuse part at normal incidence.
    """
    facing = np.clip(cosine, 0.0, 1.0)
    off_normal = np.arccos(facing)
    flash = glint * np.exp(-((off_normal / _GLINT_WIDTH_RAD) ** 2))
    return np.where(cosine > 0, facing**2 + flash, 0.0) + _BACK_LEAK


class FrameScattering(NamedTuple):
    """Scatterers of one frame in Cartesian coordinates.

    Attributes:
        position_m: Position in the radar frame.
        velocity_mps: Velocity over ground, along the axes of the radar frame.
        power: Linear received power.
        phase_rad: Phase of the reflection, without the phase of the two-way path.
        owner: Index of the box in the frame, -1 for surroundings and ghosts.
    """

    position_m: Vectors
    velocity_mps: Float[np.ndarray, "S 2"]
    power: Values
    phase_rad: Values
    owner: Indices


def scatter_objects(
    frame: SceneFrame, centers: ObjectScatterers, parameters: RadarParameters
) -> tuple[FrameScattering, Float[np.ndarray, " N"]]:
    """Computes the scatterers of the objects in one frame.

    Returns:
        The scatterers, and the fraction of each box's power that no other box blocks.
    """
    boxes = frame.boxes
    owner_of_track = np.full(int(centers.track.max(initial=-1)) + 1, -1)
    owner_of_track[frame.track] = np.arange(len(boxes))
    used = np.flatnonzero(owner_of_track[centers.track] >= 0)
    owner = owner_of_track[centers.track[used]]
    box = boxes[owner]  # [S, 7]
    inside = centers.position[used] * box[:, 3:6] / 2.0
    position = box[:, :3] + scene.turned(inside, box[:, 6])
    normal = scene.turned(centers.normal[used], box[:, 6])
    distance = np.linalg.norm(position, axis=1)
    cosine = -(normal * position).sum(1) / np.maximum(distance, 1e-6)
    rcs = centers.power_m2[used] * face_gain(cosine, centers.glint[used])
    blocked = scene.is_blocked(position, boxes, owner)
    power = received_power(position, rcs, parameters)
    lit = np.bincount(owner, power * ~blocked, len(boxes))
    total = np.bincount(owner, power, len(boxes))
    power = np.where(blocked, power * 10.0 ** (OCCLUDED_DB / 10.0), power)

    # Wheel rims, legs and pedals move at 0 to 2 times the speed of the body.
    speed = np.hypot(*frame.velocity_mps.T)[owner]
    is_walking = frame.cls[owner] == CLASSES.index("Pedestrian")
    turning = np.where(is_walking, 1.8, speed / 0.33)
    swing = centers.micro[used] * np.sin(
        turning * (frame.index * scene.FRAME_PERIOD_S) + centers.micro_phase_rad[used]
    )
    velocity = frame.velocity_mps[owner] * (1.0 + swing[:, None])
    phase_rad = centers.phase_rad[used]
    scattering = FrameScattering(position, velocity, power, phase_rad, owner)
    return scattering, lit / np.maximum(total, 1e-30)


def received_power(
    position_m: Vectors, rcs_m2: Values, parameters: RadarParameters
) -> Values:
    """Computes linear power by the radar equation, gain x cross-section x pattern / R^4.

    The gain includes the receiver's high-pass filter. Nearer than 1 m, R is 1 m.
    """
    true = np.linalg.norm(position_m, axis=1)
    forward = np.clip(position_m[:, 0] / np.maximum(true, 1e-3), 0.0, 1.0)
    distance = np.maximum(true, 1.0)
    pattern = forward**parameters.pattern_exponent
    gain = 10.0 ** ((parameters.gain_db + parameters.receiver_db) / 10.0)
    passed = sensor.high_pass(distance, parameters.high_pass_m)
    power: Values = gain * rcs_m2 * pattern / distance**4 * passed
    return power


CAPACITY_STEP = 512
"""`Scatterers` are padded to a multiple of this, so that frames share compiled executables."""


def to_scatterers(
    found: FrameScattering,
    ego_velocity_mps: Float[np.ndarray, "2"],
    wavelength_m: float,
) -> Scatterers:
    """Converts scatterers to polar positions, range rates and complex amplitudes.

    Args:
        found: Scatterers of objects, surroundings and ghosts.
        ego_velocity_mps: Velocity of the radar over ground.
        wavelength_m: Wavelength of the sensor.

    Returns:
        float32 NumPy arrays, padded to a multiple of `CAPACITY_STEP`. The phase of an
        amplitude is the phase of the reflection plus `4 pi R / wavelength`. It changes as
        the object moves, so adjacent scatterers of an object add up in some frames and
        cancel in others.
    """
    position = found.position_m
    velocity = found.velocity_mps - ego_velocity_mps
    distance = np.maximum(np.linalg.norm(position, axis=1), 1e-3)
    way = np.mod(4.0 * np.pi * distance / wavelength_m, 2 * np.pi)
    phase = found.phase_rad + way
    amplitude = np.sqrt(found.power)
    missing = -len(distance) % CAPACITY_STEP if len(distance) else CAPACITY_STEP
    columns = (
        distance,
        -np.arctan2(position[:, 1], position[:, 0]),
        np.arcsin(np.clip(position[:, 2] / distance, -1.0, 1.0)),
        (velocity * position[:, :2]).sum(1) / distance,
        amplitude * np.cos(phase),
        amplitude * np.sin(phase),
    )
    padded = np.pad(columns, ((0, 0), (0, missing))).astype(np.float32)
    range_m, azimuth_rad, elevation_rad, velocity_mps = padded[:4]
    return Scatterers(
        range_m, azimuth_rad, elevation_rad, velocity_mps, amplitude=padded[4:].T
    )


def scatter_surroundings(
    frame: SceneFrame, phase_rad: Float[np.ndarray, " M"], parameters: RadarParameters
) -> FrameScattering:
    """Computes the scatterers of ground, guard rails, walls, poles and trees.

    Args:
        frame: Scene of the frame, which contains the reflectors.
        phase_rad: Phases of all reflectors of the sequence.
        parameters: Parameters of the sensor.
    """
    fixed = frame.reflectors
    position = fixed.position_m
    toward = np.arctan2(-position[:, 1], -position[:, 0])
    cosine = np.cos(toward - fixed.normal_rad)
    gain = np.where(np.isnan(fixed.normal_rad), 1.0, face_gain(np.abs(cosine), 4.0))
    power = received_power(position, 10.0 ** (fixed.rcs_dbsm / 10.0) * gain, parameters)
    no_owner = np.full(len(position), -1)
    blocked = scene.is_blocked(position, frame.boxes, no_owner)
    return FrameScattering(
        position_m=position,
        velocity_mps=np.zeros((len(position), 2)),
        power=np.where(blocked, power * 10.0 ** (OCCLUDED_DB / 10.0), power),
        phase_rad=phase_rad[frame.reflector_idx],
        owner=no_owner,
    )


MIRROR_DB = -18.0
"""Gain in dB of two reflections at a rail or wall, which has gaps and posts."""

_MIRROR_REACH_M = 45.0


def scatter_ghosts(
    objects: FrameScattering, mirrors_m: Sequence[float]
) -> FrameScattering:
    """Computes the ghosts of objects, mirrored at guard rails and walls beside the road.

    The path radar - wall - object - wall - radar gives an echo at the mirrored position
    with the mirrored velocity, known in the literature as a third-order ghost.

    Args:
        objects: Scatterers of the objects of the frame.
        mirrors_m: Lateral positions of rails and walls in meters left of the ego vehicle.
            They are assumed to be parallel to x.

    References:
        Ghosts: Kraus et al., "Using machine learning to detect ghost images in
        automotive radar", ITSC 2020, arXiv:2007.05280. The loss is our choice.
    """
    forward, left, _ = objects.position_m.T
    planes = np.array(mirrors_m, float)
    is_near = np.hypot(forward, left) < _MIRROR_REACH_M
    is_on_our_side = np.sign(planes)[:, None] * (planes[:, None] - left) > 0
    mirror, chosen = np.nonzero(is_near & is_on_our_side)  # of [mirrors, S]
    plane = planes[mirror]
    position = objects.position_m[chosen]
    direct = np.linalg.norm(position, axis=1)
    position[:, 1] = 2.0 * plane - position[:, 1]
    mirrored = np.linalg.norm(position, axis=1)
    loss = 10.0 ** (MIRROR_DB / 10.0) * (direct / mirrored) ** 4
    velocity = objects.velocity_mps[chosen] * (1.0, -1.0)
    power = objects.power[chosen] * loss
    phase_rad = objects.phase_rad[chosen] + plane
    no_owner = np.full(len(chosen), -1)
    return FrameScattering(position, velocity, power, phase_rad, no_owner)
