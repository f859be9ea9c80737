"""Velocities of labeled objects: from the file of a simulated sequence, or from tracks.

K-Radar's files contain no velocities. The labels of one track id and class are a track, and
the change of its position over time is its velocity relative to the radar.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError
from radejax.core.files import PathLike, read_text
from radejax.core.structures import frame_key
from radejax.data.kradar.labels import Key, Label, LabelFile

OBJECT_HEADER = "frame,class,track_id,vx_mps,vy_mps,speed_mps"
"""First line of `info_motion/objects.csv`; see docs/file_formats.md."""

EGO_HEADER = "frame,timestamp_s,x_m,y_m,heading_rad,speed_mps,yaw_rate_radps"
"""First line of `info_motion/ego.csv`; see docs/file_formats.md."""

MAX_SPEED_MPS = 60.0
"""Relative speed above which motion is assumed to be a swap of track identities."""

MAX_GAP_S = 0.5
"""Longest time between two labels of a track from which a velocity is estimated."""


Motion = tuple[float, float, float]
"""x and y of the velocity relative to the radar, and speed over ground, in m/s."""


def read_motion(path: PathLike) -> dict[tuple[str, str, int], Motion]:
    """Reads `info_motion/objects.csv` of a sequence.

    Returns:
        Motion by name of the frame, class and track id.

    Raises:
        DataError: The file is malformed.
    """
    with wrap_read_errors(path, "a table of velocities"):
        header, *lines = read_text(path).splitlines()
        if header != OBJECT_HEADER:
            raise DataError(f"{path}:1: {header[:80]!r}, expected {OBJECT_HEADER!r}")
        return {
            (frame_key(name), cls, int(track_id)): (float(vx), float(vy), float(speed))
            for name, cls, track_id, vx, vy, speed in (x.split(",") for x in lines)
        }


def estimate_velocities(
    files: Mapping[Key, LabelFile],
) -> dict[Key, Float[np.ndarray, "N 2"]]:
    """Estimates the velocities of labeled objects relative to the radar.

    Args:
        files: Label files of consecutive frames, sorted by sequence and frame.

    Returns:
        x and y in m/s of the labels of every file, along the axes of its radar frame. NaN
        for labels without a track id, with the id and class of an earlier label of the
        file, or without a label of the same track at most `MAX_GAP_S` before or after.
    """
    labels = [label for file in files.values() for label in file.labels]
    counts = [len(file.labels) for file in files.values()]
    sequence = np.array([key[0] for key in files])
    clock_s = np.array([file.header.timestamp_s for file in files.values()])
    is_gap = np.diff(clock_s, prepend=clock_s[:1]) > MAX_GAP_S
    is_gap |= np.diff(sequence, prepend=sequence[:1]) > 0
    frame_idx = np.repeat(np.arange(len(files)) + np.cumsum(is_gap), counts)
    velocity = track_velocities(
        np.reshape([label.box[:2] for label in labels], (-1, 2)),
        number_tracks(labels, frame_idx),
        frame_idx,
        np.repeat(clock_s, counts),
    )
    split = np.split(velocity, np.cumsum(counts, dtype=int))
    return dict(zip(files, split[:-1], strict=True))


def number_tracks(
    labels: Sequence[Label], frame_idx: Int[np.ndarray, " M"]
) -> Int[np.ndarray, " M"]:
    """Returns the index of the first label of the track of each label.

    Labels with the same track id and class form a track. A label without an id (-1), or
    with the id and class of an earlier label in the same frame, is a track of its own.

    Args:
        labels: Labels of all frames of a sequence, in order.
        frame_idx: Their frames.
    """
    first_idx = np.arange(len(labels))
    last: dict[tuple[str, int], int] = {}
    for row, label in enumerate(labels):
        identity = label.cls, label.track_id
        before = last.get(identity, row)
        is_free = before == row or frame_idx[before] != frame_idx[row]
        if label.track_id >= 0 and is_free:
            first_idx[row] = first_idx[before]
            last[identity] = row
    return first_idx


def track_velocities(
    position_m: Float[np.ndarray, "M 2"],
    track_idx: Int[np.ndarray, " M"],
    frame_idx: Int[np.ndarray, " M"],
    time_s: Float[np.ndarray, " M"],
) -> Float[np.ndarray, "M 2"]:
    """Computes velocities by differences of positions along tracks.

    Velocities are central differences where the track is present in both adjacent frames
    and one-sided differences at its ends. As labels jitter by some centimeters, three
    successive velocities are averaged.

    Args:
        position_m: x and y of objects.
        track_idx: Their tracks.
        frame_idx: Their frames, with one object of a track per frame.
        time_s: Times of the frames.

    Returns:
        x and y in m/s. NaN for tracks of one frame and above `MAX_SPEED_MPS`.
    """
    order = np.lexsort((frame_idx, track_idx))
    joined = (np.diff(track_idx[order]) == 0) & (np.diff(frame_idx[order]) == 1)
    rows = np.arange(len(order))
    first = order[rows - np.pad(joined, (1, 0))[: len(rows)]]
    last = order[rows + np.pad(joined, (0, 1))[: len(rows)]]
    period = time_s[last] - time_s[first]
    is_known = period > 1e-3
    moved_m = position_m[last] - position_m[first]
    velocity = moved_m / np.where(is_known, period, 1)[:, None]
    is_known &= np.hypot(*velocity.T) <= MAX_SPEED_MPS
    velocity[~is_known] = 0.0
    values = np.column_stack([velocity, is_known])
    total = values.copy()  # sums of three
    total[1:][joined] += values[:-1][joined]
    total[:-1][joined] += values[1:][joined]
    mean = total[:, :2] / np.maximum(total[:, 2:], 1.0)
    result = np.zeros((len(order), 2))
    result[order] = np.where(is_known[:, None], mean, np.nan)
    return result
