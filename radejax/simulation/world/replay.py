"""Sequences with the objects and motion of real K-Radar label files.

Labels contain positions relative to the ego vehicle. Their change between frames gives the
relative velocity, from which the radar's range rate follows. The speed of the ego vehicle,
which the surroundings require, is inferred from the tracks. The surroundings are procedural
and depend on the road type of the sequence.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter  # type: ignore[attr-defined]

from radejax.data.kradar import Frame, motion
from radejax.simulation.world import environments, scene
from radejax.simulation.world.scene import Road, Sequence, Tracks

Shift = tuple[float, float, float]


def make_real_sequence(
    frames: list[Frame], radar_from_lidar_m: Shift, rng: np.random.Generator
) -> Sequence:
    """Creates a scene from the labels of one sequence.

    Args:
        frames: Consecutive frames of one sequence in order, with all their labels. If they
            have the speed of the radar, their ground is at the lower sides of the boxes.
        radar_from_lidar_m: Translation in meters from LiDAR to radar positions.
        rng: Random generator for the surroundings.

    Returns:
        Scene whose objects have the boxes of the labels in every frame.
    """
    tracks = collect_tracks(frames, radar_from_lidar_m)
    clock = np.array([f.header.timestamp_s for f in frames])
    estimated = relative_velocity(tracks, clock)
    is_known = np.isfinite(tracks.velocity_mps)
    relative = np.where(is_known, tracks.velocity_mps, estimated)
    environment = frames[0].environment
    laws = environments.SURROUNDINGS
    law = laws.get(environment, laws["urban"])
    ground = _ground_height(tracks)
    speeds = [f.ego_speed_mps for f in frames if f.ego_speed_mps is not None]
    speed = np.array(speeds)
    if not speeds:
        speed = infer_ego_speed(tracks, relative, law.speed_mps)
        # A few boxes on a slope would give a wrong height.
        ground = float(np.clip(ground, -1.4, -0.4))
    periods = np.diff(clock, append=clock[-1] + scene.FRAME_PERIOD_S).clip(0.02, 1.0)
    along = scene.traveled(speed, periods)
    edges = _road_edges(tracks, law)
    reflectors, mirrors = environments.make_surroundings(
        law, Road(), along[-1] + environments.SIGHT_M, edges, rng, ground
    )
    # The road is straight along x, so the labels' frame only moves along x.
    world = tracks.position_m + along[:, None, None] * (1.0, 0.0, 0.0)
    velocity = relative + speed[:, None, None] * (1.0, 0.0)
    lanes = np.arange(-law.lanes_right - 0.5, law.lanes_left + 1.0)
    return Sequence(
        name=frames[0].sequence,
        environment=environment,
        time=frames[0].time,
        weather=frames[0].weather,
        ego_along_m=along,
        ego_speed_mps=speed,
        tracks=dataclasses.replace(tracks, position_m=world, velocity_mps=velocity),
        reflectors=reflectors,
        road=Road(),
        lanes_m=tuple((lanes * law.lane_width_m).tolist()),
        ground_m=ground,
        mirrors_m=mirrors,
    )


def collect_tracks(frames: list[Frame], radar_from_lidar_m: Shift) -> Tracks:
    """Collects the labels of all frames as tracks with positions in the radar frame.

    The tracks are those of `motion.number_tracks`. Velocities are those of the labels,
    relative to the radar, and NaN where they are not known.
    """
    labels = [label for frame in frames for label in frame.labels]
    counts = [len(frame.labels) for frame in frames]
    frame_idx = np.repeat(np.arange(len(frames)), counts)
    rows, track_idx = np.unique(
        motion.number_tracks(labels, frame_idx), return_inverse=True
    )
    first = [labels[row] for row in rows]
    boxes = np.zeros((len(frames), len(first), 7))
    boxes[..., 3:6] = np.reshape([label.box for label in first], (-1, 7))[:, 3:6]
    boxes[frame_idx, track_idx] = np.reshape([x.box for x in labels], (-1, 7))
    present = np.zeros(boxes.shape[:2], bool)
    present[frame_idx, track_idx] = True
    boxes[..., :3] += radar_from_lidar_m
    velocity = np.full((*present.shape, 2), np.nan)
    known = [label.velocity_mps or (np.nan, np.nan) for label in labels]
    velocity[frame_idx, track_idx] = np.reshape(known, (-1, 2))
    return Tracks(
        position_m=boxes[..., :3],
        yaw_rad=boxes[..., 6],
        velocity_mps=velocity,
        is_present=present,
        size_m=boxes[..., 3:6],
        cls=np.array([scene.class_index(label.cls) for label in first], int),
        track_id=np.array([label.track_id for label in first], int),
        label_cls=tuple(label.cls for label in first),
    )


def relative_velocity(
    tracks: Tracks, clock: Float[np.ndarray, " F"]
) -> Float[np.ndarray, "F N 2"]:
    """Computes velocities relative to the radar from the motion of the labels.

    They are those of `motion.track_velocities`, and zero where these are NaN.
    """
    frame, track = np.nonzero(tracks.is_present)
    position_m = tracks.position_m[frame, track, :2]
    velocity = np.zeros((*tracks.is_present.shape, 2))
    found = motion.track_velocities(position_m, track, frame, clock[frame])
    velocity[frame, track] = np.nan_to_num(found)
    return velocity


def infer_ego_speed(
    tracks: Tracks, relative: Float[np.ndarray, "F N 2"], prior_mps: tuple[float, float]
) -> Float[np.ndarray, " F"]:
    """Infers the speed of the ego vehicle from the tracks.

    Vehicles with the heading of the ego vehicle do not drive backward, so the speed is at
    least the highest speed at which one of them approaches, and equal to it if that vehicle
    is parked. Oncoming traffic approaches at least at the speed of the ego vehicle, which
    gives an upper bound. Without evidence from the tracks, the mean of `prior_mps` is used.
    The result is a median over two seconds.
    """
    heading = np.cos(tracks.yaw_rad)
    seen = tracks.is_present & (np.abs(relative).sum(-1) > 0)
    approach = -relative[..., 0]
    lower = np.where(seen & (heading > 0.9), approach, -np.inf).max(1, initial=-np.inf)
    upper = np.where(seen & (heading < -0.9), approach, np.inf).min(1, initial=np.inf)
    usual = float(np.mean(prior_mps))
    known = lower > 0.3 * usual  # slow vehicles ahead are weak evidence
    speed = np.where(known, lower, usual)
    speed = np.clip(speed, 0.0, np.maximum(np.minimum(upper, 40.0), 0.0))
    smooth: Float[np.ndarray, " F"] = median_filter(speed, 21, mode="nearest")
    return smooth


def _ground_height(tracks: Tracks) -> float:
    """Estimates the height of the ground from boxes near the ego, in the radar frame."""
    bottom = tracks.position_m[..., 2] - tracks.size_m[..., 2] / 2.0
    distance = np.hypot(tracks.position_m[..., 0], tracks.position_m[..., 1])
    near = tracks.is_present & (distance < 30.0)
    if not near.any():
        return environments.GROUND_M
    return float(np.median(bottom[near]))


def _road_edges(tracks: Tracks, law: environments.Environment) -> tuple[float, float]:
    """Returns the right and left edge of the road, including the labeled objects near it."""
    left = tracks.position_m[..., 1][tracks.is_present]
    left = left[np.abs(left) < 18.0]
    right_edge = -(law.lanes_right + 0.5) * law.lane_width_m - 1.0
    left_edge = (law.lanes_left + 0.5) * law.lane_width_m + 1.0
    if left.size:
        low, high = np.percentile(left, (2.0, 98.0))
        right_edge = min(right_edge, low - 2.0)
        left_edge = max(left_edge, high + 2.0)
    return right_edge, left_edge
