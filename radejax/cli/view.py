"""`radejax view`: a recording of radar, labels, camera and detections."""

from __future__ import annotations

import dataclasses
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
    "--workdir", type=options.EXISTING, help="Run whose detections are shown."
)
@click.option(
    "--max-frames", type=options.COUNT, help="Frames to record. Default: all."
)
@click.option(
    "--open", "open_it", is_flag=True, help="Open the recording in the viewer."
)
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

    Frames without radar tensor and projection are skipped and counted.

    Example: radejax view data/kradar --sequences 5 --out five.rrd --open
    """
    import tqdm

    from radejax.data.kradar import KRadar
    from radejax.inference.detector import Detector
    from radejax.visualize.recordings import open_viewer, write_recording

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
            f"no radar tensor or projection for any of {len(frames)} labelled frames"
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
        text += f"; {lacking} without radar tensor or projection skipped"
    values = {"frames": len(shown), "without_radar": lacking, "recording": str(out)}
    options.echo_result(as_json, values, text)


def viewer_scenes(frames: Any, grid: Any, detector: Any = None) -> Iterator[Any]:
    """`Scene` of each frame with radar data, read as it is needed."""
    from radejax.core.structures import Boxes
    from radejax.runs.figures import frame_scene

    for frame in frames:
        scene = frame_scene(
            frame,
            frame.read_projection(grid),
            grid,
            time_s=frame.header.timestamp_s,
        )
        if detector is not None:
            inputs = [scene.projection]
            if detector.takes_camera and scene.camera is not None:
                inputs += [frame.camera_path, scene.camera]
            found = Boxes(**detector(*inputs).to_columns())
            scene = dataclasses.replace(scene, predictions=found)
        yield scene
