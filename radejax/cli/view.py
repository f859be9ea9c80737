"""`radejax view`: a recording of radar, labels with tracks, camera and detections."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from typing import Any

import click

from radejax.cli import options
from radejax.core.errors import UserError


@click.command(cls=options.Command)
@options.roots
@click.option("--out", type=options.FILE, default="recording.rrd", show_default=True)
@options.sequences
@options.weather
@options.labels
@options.label_version
@click.option(
    "--workdir", type=options.EXISTING, help="Run whose detections are shown too."
)
@click.option("--max-frames", type=options.COUNT, help="All by default.")
@click.option("--open", "open_it", is_flag=True, help="Open it in the viewer.")
def view(
    roots: tuple[pathlib.Path, ...],
    out: pathlib.Path,
    labels: pathlib.Path | None,
    label_version: str,
    workdir: pathlib.Path | None,
    max_frames: int | None,
    open_it: bool,
    as_json: bool,
    **part: Any,
) -> None:
    """Record a sequence for the rerun viewer (extra "viewer").

    Frames without tesseract and projection are left out and counted.

    Example: radejax view data/kradar --sequence 5 --out five.rrd --open
    """
    import tqdm

    from radejax.data.kradar import KRadar
    from radejax.inference.detector import Detector
    from radejax.visualize.viewer import open_viewer, write_recording

    frames = KRadar(
        roots,
        labels,
        version=label_version,
        visibility=None,
        **part,
    )
    complete = [frame for frame in frames if frame.radar_path]
    if not complete:
        raise UserError(
            f"no tesseract or projection for any of {len(frames)} labelled frames"
        )
    shown = complete[:max_frames]
    detector = None if workdir is None else Detector.from_workdir(workdir)
    bar = tqdm.tqdm(shown, desc="record", unit="frame")
    write_recording(viewer_scenes(bar, frames.grid, detector), out)
    if open_it:
        open_viewer(out)
    text = f"{len(shown)} frames written to {out}"
    lacking = len(frames) - len(complete)
    if lacking:
        text += f"; {lacking} without tesseract or projection left out"
    values = {"frames": len(shown), "without_radar": lacking, "recording": str(out)}
    options.echo_result(as_json, values, text)


def viewer_scenes(frames: Any, grid: Any, detector: Any = None) -> Iterator[Any]:
    """`Scene` of each frame with radar data, read as it is needed."""
    import jax
    import numpy as np

    from radejax.data.images import front_view
    from radejax.visualize.canvas import Scene

    for frame in frames:
        projection = frame.read_projection(grid)
        image, calibration = front_view(frame)
        found = None
        if detector is not None:
            inputs = [projection]
            if detector.takes_camera and calibration is not None:
                inputs += [frame.camera_path, calibration]
            found = jax.tree.map(lambda x: np.asarray(x[0]), detector(*inputs))
        yield Scene(
            projection,
            grid,
            ground_truth=frame,
            predictions=found,
            track_ids=track_ids(frame),
            image=image,
            camera=calibration,
            time_s=frame.header.timestamp_s,
            title=f"sequence {frame.sequence}, {frame.name}, {frame.weather}",
        )


def track_ids(frame: Any) -> list[tuple[int, int] | None]:
    """Sequence and track id of each box that the data set keeps: `[N]`.

    Boxes are those of some labels, moved to the radar's frame. None where the label
    has no id.
    """
    import numpy as np

    if not len(frame.boxes):
        return []
    centers = np.array([label.box[:3] for label in frame.labels])
    centers = centers + np.asarray(frame.radar_from_lidar_m)
    gaps = np.linalg.norm(frame.boxes[:, None, :3] - centers[None], axis=-1)  # [N, L]
    ids = [frame.labels[i].track_id for i in gaps.argmin(1)]
    return [(frame.sequence, i) if i >= 0 else None for i in ids]
