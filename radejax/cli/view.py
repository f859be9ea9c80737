"""A rerun recording of sequences: radar, labels with tracks, camera, detections."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
import tqdm

from radejax.core.errors import UserError
from radejax.data.images import front_view
from radejax.data.kradar import KRadar
from radejax.data.kradar.frame import Frame
from radejax.data.tesseract import read_projection
from radejax.visualize.viewer import ViewerFrame, write_recording


def write_view(
    roots: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    *,
    sequence: int | None = None,
    labels: str | os.PathLike | None = None,
    version: str = "v2.1",
    workdir: str | os.PathLike | None = None,
    max_frames: int | None = None,
    elevation_sign: int = 1,
) -> dict[str, int]:
    """Records frames for the rerun viewer.

    Args:
        roots: K-Radar folders.
        out: Recording to write, `.rrd`.
        sequence: The only one to record; all by default.
        labels: Label revision, see `KRadar`.
        version: Of the labels.
        workdir: Run whose detections are shown as well, or None.
        max_frames: Record only the first so many.
        elevation_sign: See `visualize.viewer.echo_points`.

    Returns:
        Counts "frames" recorded and "without_radar": left out, having neither tesseract
        nor projection.

    Raises:
        UserError: rerun is not installed, or no frame has a tesseract or a
            projection.
    """
    numbers = None if sequence is None else [sequence]
    frames = KRadar(
        roots, labels, version=version, sequence_numbers=numbers, visibility=None
    )
    complete = [f for f in frames if f.tesseract_path or f.projection_path]
    if not complete:
        raise UserError(
            f"no tesseract or projection for any of {len(frames)} labelled frames"
        )
    shown = complete[:max_frames]
    detector = None
    if workdir is not None:
        from radejax.inference.detector import Detector

        detector = Detector.from_workdir(pathlib.Path(workdir))
    entries = viewer_frames(
        tqdm.tqdm(shown, desc="record", unit="frame"), frames.grid, detector
    )
    write_recording(entries, frames.grid, out, elevation_sign=elevation_sign)
    return {
        "frames": len(shown),
        "without_radar": len(frames) - len(complete),
    }


def viewer_frames(
    frames: Any, grid: Any, detector: Any = None
) -> Iterator[ViewerFrame]:
    """What the viewer shows of each frame, read as it is needed."""
    for frame in frames:
        projection = read_projection(frame, grid)
        image, calibration = front_view(frame)
        found = None
        if detector is not None:
            inputs = (projection,)
            if detector.takes_camera and calibration is not None:
                inputs += frame.camera_path, calibration
            found = jax.tree.map(lambda x: np.asarray(x[0]), detector(*inputs))
        yield ViewerFrame(
            projection,
            ground_truth=frame,
            predictions=found,
            track_ids=track_ids(frame),
            image=image,
            calibration=calibration,
            time_s=frame.header.timestamp_s,
            name=f"sequence {frame.sequence}, {frame.name}, {frame.weather}",
        )


def track_ids(frame: Frame) -> list[tuple[int, int] | None]:
    """Sequence and track id of each box that the data set keeps: `[N]`.

    Boxes are those of some labels, moved to the radar's frame. None where the label
    has no id.
    """
    if not len(frame.boxes):
        return []
    centers = np.array([label.box[:3] for label in frame.labels])
    centers = centers + np.asarray(frame.radar_from_lidar_m)
    gaps = np.linalg.norm(frame.boxes[:, None, :3] - centers[None], axis=-1)  # [N, L]
    ids = [frame.labels[i].track_id for i in gaps.argmin(1)]
    return [(frame.sequence, i) if i >= 0 else None for i in ids]
