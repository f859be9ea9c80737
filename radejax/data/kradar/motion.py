"""Velocities of labelled objects: from the file of a simulated sequence, or from tracks.

K-Radar's files contain no velocities. The labels of one track id and class are a track, and
the change of its position over time is its velocity relative to the radar.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError
from radejax.core.files import PathLike, read_text
from radejax.core.structures import frame_key
from radejax.data.kradar.labels import Key, LabelFile

OBJECT_COLUMNS = ("frame", "class", "track_id", "vx_mps", "vy_mps")
"""Columns of `info_motion/objects.csv`; see docs/file_formats.md."""

MAX_SPEED_MPS = 60.0
"""Relative speed above which motion is assumed to be a swap of track identities."""

MAX_GAP_S = 0.5
"""Longest time between two labels of a track from which a velocity is estimated."""


def read_velocities(path: PathLike) -> dict[tuple[str, str, int], tuple[float, float]]:
    """Reads `info_motion/objects.csv` of a sequence.

    Returns:
        x and y of the velocity in m/s, by name of the frame, class and track id.

    Raises:
        DataError: The file is malformed.
    """
    with wrap_read_errors(path, "a table of velocities"):
        header, *rows = csv.reader(read_text(path).splitlines())
        if tuple(header) != OBJECT_COLUMNS:
            expected = ",".join(OBJECT_COLUMNS)
            raise DataError(f"{path}:1: {','.join(header)!r}, expected {expected}")
        return {
            (frame_key(name), cls, int(track_id)): (float(vx_mps), float(vy_mps))
            for name, cls, track_id, vx_mps, vy_mps in rows
        }


def estimate_velocities(
    files: Mapping[Key, LabelFile],
) -> dict[Key, Float[np.ndarray, "N 2"]]:
    """Estimates the velocities of labelled objects relative to the radar.

    Args:
        files: Label files of consecutive frames, sorted by sequence and frame.

    Returns:
        x and y in m/s of the labels of every file, along the axes of its radar frame. NaN
        for labels without a track id, with the id and class of an earlier label of the
        file, or without a label of the same track at most `MAX_GAP_S` before or after.
    """
    labels = [label for file in files.values() for label in file.labels]
    counts = [len(file.labels) for file in files.values()]
    frame_idx = np.repeat(np.arange(len(counts)), counts)
    numbers: dict[tuple[int, str, int], int] = {}
    last_seen: dict[int, int] = {}
    track_idx = np.arange(len(labels)) + len(labels)  # tracks of one label
    sequences = [key[0] for key in files]
    for row, (label, frame) in enumerate(zip(labels, frame_idx.tolist(), strict=True)):
        identity = sequences[frame], label.cls, label.track_id
        number = numbers.setdefault(identity, len(numbers))
        if label.track_id >= 0 and last_seen.get(number) != frame:
            track_idx[row] = number
            last_seen[number] = frame
    position_m = np.array([label.box[:2] for label in labels]).reshape(-1, 2)
    clock_s = np.array([file.header.timestamp_s for file in files.values()])
    velocity = track_velocities(position_m, track_idx, frame_idx, clock_s, MAX_GAP_S)
    split = np.split(velocity, np.cumsum(counts, dtype=int))
    return dict(zip(files, split[:-1], strict=True))


def track_velocities(
    position_m: Float[np.ndarray, "M 2"],
    track_idx: Int[np.ndarray, " M"],
    frame_idx: Int[np.ndarray, " M"],
    clock_s: Float[np.ndarray, " F"],
    max_gap_s: float = np.inf,
) -> Float[np.ndarray, "M 2"]:
    """Computes velocities by differences of positions along tracks.

    Velocities are central differences where the track is present in both adjacent frames
    and one-sided differences at its ends. As labels jitter by some centimeters, three
    successive velocities are averaged.

    Args:
        position_m: x and y of objects.
        track_idx: Their tracks.
        frame_idx: Their frames, with one object of a track per frame.
        clock_s: Times of the frames.
        max_gap_s: Longest time between adjacent frames.

    Returns:
        x and y in m/s. NaN for tracks of one frame and above `MAX_SPEED_MPS`.
    """
    order = np.lexsort((frame_idx, track_idx))
    track, frame, position = track_idx[order], frame_idx[order], position_m[order]
    joined = (np.diff(track) == 0) & (np.diff(frame) == 1)
    joined &= np.diff(clock_s[frame]) <= max_gap_s
    rows = np.arange(len(order))
    first = rows - np.pad(joined, (1, 0))[: len(rows)]
    last = rows + np.pad(joined, (0, 1))[: len(rows)]
    period = clock_s[frame[last]] - clock_s[frame[first]]
    is_known = period > 1e-3
    step = position[last] - position[first]
    velocity = step / np.where(is_known, period, 1.0)[:, None]
    is_known &= np.hypot(*velocity.T) <= MAX_SPEED_MPS
    velocity[~is_known] = 0.0

    def sum_of_three(values: np.ndarray) -> np.ndarray:
        before, after = np.zeros_like(values), np.zeros_like(values)
        before[1:][joined] = values[:-1][joined]
        after[:-1][joined] = values[1:][joined]
        total: np.ndarray = before + values + after
        return total

    count = np.maximum(sum_of_three(is_known.astype(float)), 1.0)[:, None]
    result = np.zeros((len(order), 2))
    result[order] = np.where(is_known[:, None], sum_of_three(velocity) / count, np.nan)
    return result
