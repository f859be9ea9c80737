"""Commands that draw frames, labels and detections: `overlay`, `view` and `demo`."""

from __future__ import annotations

import dataclasses
import pathlib
import tempfile
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

import radejax
from radejax.cli import entry
from radejax.core.errors import UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from radejax.data.dataset import LabeledFrame, LabeledFrames

MODEL = pathlib.Path(__file__).with_name("demo_model")
"""Model of the quickstart with seed 0; docs/detector.md lists the commands that made it."""

_detections = entry.together(
    click.option(
        "--workdir", type=entry.EXISTING, help="Run whose detections are drawn."
    ),
    entry.score_threshold(
        "Their score threshold, or some by class. Default: the run's."
    ),
)


@click.command(cls=entry.Command)
@click.argument("name", metavar="[FRAME]", default="")
@entry.several("--data", "roots", required=True, help="Roots of K-Radar.")
@entry.labeled_frames
@entry.camera_calibration
@entry.out_file("overlay.png", "Image file, or .gif for several frames.")
@click.option(
    "--slices",
    is_flag=True,
    help="Draw range-azimuth, range-Doppler and azimuth-elevation maxima.",
)
@click.option(
    "--lidar",
    is_flag=True,
    help="Draw the points of os2-64/*.pcd on radar map and image, to check calibrations.",
)
@click.option(
    "--roi",
    type=click.Choice(["narrow", "wide", "none"]),
    default="narrow",
    help="Region of interest to draw.",
)
@_detections
@entry.max_frames
def overlay(
    name: str,
    roots: tuple[str, ...],
    out: pathlib.Path,
    slices: bool,
    lidar: bool,
    roi: str,
    config: str | None,
    workdir: str | None,
    max_frames: int | None,
    **part: Any,
) -> None:
    """Draw one frame's labels on radar and camera: the first look at new data.

    FRAME is sequence/radar_lidar, sequence/radar, or one sequence, of which the first
    frame is drawn. All frames are drawn where --out ends in .gif.
    --sequences and --weather select frames without a FRAME. Labels of every visibility
    are drawn, also those that training leaves out. Without radar data, the image is drawn.

    Example: radejax overlay 1/00033_00001 --data ROOT
    """
    import tqdm

    from radejax.core.structures import frame_key
    from radejax.visualize.recordings import animate
    from radejax.visualize.style import save_figure

    sequence, _, frame_name = name.partition("/")
    frame_name = frame_key(frame_name)
    if sequence.isdecimal():
        part["sequences"] = (int(sequence),)
    elif name or not (part["sequences"] or part["weather"]):
        raise UserError(f"frame {name!r}, expected sequence/radar_lidar: 1/00033_00001")
    if slices and lidar:
        raise UserError("--slices shows no LiDAR points: leave out --lidar or --slices")
    if slices and workdir:
        raise UserError("--slices shows no detections: leave out --workdir or --slices")
    frames, detector = _open(roots, config, workdir, **part)
    found = [
        frame
        for frame in frames
        if frame_name in ("", (key := frame_key(frame.name)), key.partition("_")[0])
    ]
    if not found:
        raise UserError(
            f"no frame {frame_name} in sequence {sequence}; there are "
            f"{frames[0].name} to {frames[-1].name}"
        )
    is_animation = out.suffix.lower() == ".gif"
    found = found[: max_frames if is_animation else 1]
    bar = tqdm.tqdm(found, "draw", unit="frame", disable=not is_animation)
    figures = (_draw(frames, frame, slices, lidar, roi, detector) for frame in bar)
    if is_animation:
        animate(figures, out)
    else:
        save_figure(next(figures), out)
    click.echo(f"drew {out}{'' if slices else _undrawn(found)}")


def _undrawn(frames: Sequence[LabeledFrame]) -> str:
    """Says for how many frames no radar data, or no boxes on an image, are drawn, and why."""
    radar = sum(not (x.radar_path and x.radar_path.exists()) for x in frames)
    shown = [frame for frame in frames if frame.camera_path is not None]
    calibrations = sum(frame.camera_calibration_path is None for frame in shown)
    text = f"; {radar} of {len(frames)} frames have no radar data" if radar else ""
    images = len(frames) - len(shown)
    if not images + calibrations:
        return text
    option = (
        " (--camera-calibration FOLDER, or camera_calibration_path of an own reader)"
    )
    return (
        f"{text}; not all have boxes on the image: {images} of {len(frames)} frames have no "
        f"front image, {calibrations} no camera calibration{option if calibrations else ''}"
    )


def _draw(
    frames: LabeledFrames[LabeledFrame],
    frame: LabeledFrame,
    slices: bool,
    lidar: bool,
    roi: str,
    detector: radejax.Detector | None,
) -> Figure:
    """Draws one frame: slices of the projection, or the radar map and camera image.

    Raises:
        FileNotFoundError: The frame has neither a tensor nor a projection, or no LiDAR scan
            is there that is to be drawn.
    """
    from radejax.data.kradar import Frame, KRadar
    from radejax.data.kradar.points import read_lidar
    from radejax.visualize.draw import draw_slices

    region = None if roi == "none" else roi
    scene = _scene(frames, frame, detector, may_lack_radar=not slices, roi=region)
    if lidar:
        if not isinstance(frames, KRadar) or not isinstance(frame, Frame):
            raise UserError("--lidar draws K-Radar's os2-64/*.pcd: leave it out")
        points_m = read_lidar(frames.lidar_path(frame)) + frame.radar_from_lidar_m
        scene = dataclasses.replace(scene, lidar_m=points_m)
    return draw_slices(scene) if slices else radejax.draw_frame(scene)


@click.command(cls=entry.Command)
@entry.roots
@entry.out_file("recording.rrd", "File of the recording.")
@entry.labeled_frames
@entry.camera_calibration
@_detections
@entry.max_frames
def view(
    roots: tuple[str, ...],
    out: pathlib.Path,
    config: str | None,
    workdir: str | None,
    max_frames: int | None,
    **part: Any,
) -> None:
    """Record frames, by default all, for the rerun viewer (extra "viewer").

    Frames without radar tensor and projection are skipped and counted. `rerun five.rrd`
    opens the recording.

    Example: radejax view data/kradar --sequences 5 --out five.rrd
    """
    import tqdm

    from radejax.visualize.recordings import check_recording, write_recording

    check_recording(out)
    frames, detector = _open(roots, config, workdir, **part)
    complete = [frame for frame in frames if frame.radar_path]
    if not complete:
        raise UserError(
            f"no radar tensor or projection for any of {len(frames)} labeled frames"
        )
    shown = complete[:max_frames]
    bar = tqdm.tqdm(shown, desc="record", unit="frame")
    write_recording((_scene(frames, frame, detector) for frame in bar), out)
    text = f"{len(shown)} frames written to {out}"
    if lacking := len(frames) - len(complete):
        text += f"; {lacking} without radar tensor or projection skipped"
    click.echo(text + _undrawn(shown))


def _open(
    roots: Sequence[str],
    config: str | None,
    workdir: str | None,
    score_threshold: str | None,
    **part: Any,
) -> tuple[LabeledFrames[LabeledFrame], radejax.Detector | None]:
    """Returns the frames to draw, and the detector of a run on such data, or None.

    The reader is that of the config, or else of the run.
    """
    from radejax.data.dataset import find_reader
    from radejax.data.kradar.reduced import check_release

    if workdir is None:
        if score_threshold is not None:
            raise UserError("--score-threshold selects detections: give --workdir RUN")
        return entry.read_frames(roots, config, any_visibility=True, **part), None
    entry.set_up_jax()
    detector = radejax.Detector.from_workdir(workdir, score_threshold=score_threshold)
    settings = detector.saved.config
    is_kradar = find_reader(settings.data.format) is radejax.KRadar
    reader = config if config or is_kradar else settings
    frames = entry.read_frames(roots, reader, any_visibility=True, **part)
    check_release(frames.release, settings.data.release, "radar data to draw")
    return frames, detector


def _scene(
    frames: LabeledFrames[LabeledFrame],
    frame: LabeledFrame,
    detector: radejax.Detector | None,
    *,
    may_lack_radar: bool = False,
    **fields: Any,
) -> radejax.Scene:
    """Reads a frame and returns its scene, with detections if there is a detector.

    Instead of missing radar data, there may be a map of NaN if there is an image.
    """
    import numpy as np

    from radejax.data.kradar import Frame

    grid = frames.grid if detector is None else detector.grid
    try:
        projection = frame.read_projection(grid)
    except FileNotFoundError:
        if not may_lack_radar or frame.camera_path is None or detector is not None:
            raise
        projection = np.full(grid.projection_shape, np.nan, np.float32)
    if detector is not None:
        _, camera = radejax.front_view(frame) if detector.takes_camera else (None, None)
        image = None if camera is None else [frame.camera_path]
        fields["predictions"] = detector(projection, image, camera).to_boxes()
        fields["score_threshold"] = detector.decode_options.score_threshold
    if isinstance(frame, Frame):
        fields["time_s"] = frame.header.timestamp_s
    return radejax.frame_scene(frame, projection, grid, **fields)


@click.command(cls=entry.Command)
@entry.out_file("demo.png", "Image file of the figure.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=1000,
    help="Seed of the scene; the model was trained on scenes of seed 0.",
)
def demo(out: pathlib.Path, seed: int) -> None:
    """Simulate one frame, detect its objects with a bundled model and draw the result.

    Only this package is needed. The model is that of a longer quickstart: it was trained
    on simulated frames of a coarse radar, not on K-Radar's.

    Example: radejax demo --out demo.png
    """
    from radejax.core.structures import WIDE_ROI
    from radejax.simulation.config import SimulationOptions
    from radejax.visualize.style import figure_format, save_figure

    figure_format(out)  # checks the ending before the frame is simulated
    entry.set_up_jax()
    simulation = SimulationOptions(
        seed=seed,
        train_sequences=0,
        test_sequences=1,
        frames_per_sequence=1,
        image_width=1280,
        image_height=720,
    )
    with tempfile.TemporaryDirectory() as folder:
        frames = radejax.KRadar([radejax.simulate(simulation, folder)])
        (frame,) = frames
        detector = radejax.Detector.from_workdir(MODEL)
        title = f"simulated frame, seed {seed}, {frame.weather}"
        scene = _scene(frames, frame, detector, roi=WIDE_ROI, title=title)
    assert scene.predictions is not None
    num_found = len(scene.predictions)
    save_figure(radejax.draw_frame(scene), out)
    num_labeled = len(frame.boxes)
    click.echo(f"{num_found} boxes found, {num_labeled} labeled objects: see {out}")
