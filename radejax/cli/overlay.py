"""`radejax overlay`: labels on radar and camera, for a frame or a sequence."""

from __future__ import annotations

import pathlib
from typing import Any

import click

from radejax.cli import options
from radejax.core.errors import UserError

ANIMATIONS = (".gif", ".mp4")


@click.command(cls=options.Command)
@click.argument("name", metavar="[FRAME]", default="")
@options.data_roots
@options.labels
@options.label_version
@options.sequences
@options.weather
@click.option("--out", type=options.FILE, default="overlay.png", show_default=True)
@click.option(
    "--slices",
    is_flag=True,
    help="Draw slices of the projection.",
)
@click.option(
    "--roi",
    type=click.Choice(["narrow", "wide", "none"]),
    default="narrow",
    show_default=True,
    help="Region of interest to draw.",
)
@click.option(
    "--max-frames", type=options.COUNT, help="Frames of an animation. Default: all."
)
def overlay(
    name: str,
    roots: tuple[pathlib.Path, ...],
    labels: pathlib.Path | None,
    label_version: str,
    sequence_numbers: tuple[int, ...] | None,
    weather: tuple[str, ...] | None,
    out: pathlib.Path,
    slices: bool,
    roi: str,
    max_frames: int | None,
    as_json: bool,
) -> None:
    """Draw one frame's labels on radar and camera: the first look at new data.

    FRAME is sequence/radar_lidar, sequence/radar, or a sequence, of which the first
    frame is drawn. All frames are drawn where --out ends in .gif or .mp4.
    --sequences and --weather select frames without a FRAME.

    Example: radejax overlay 1/00033_00001 --data ROOT
    """
    import tqdm

    from radejax.data.kradar import KRadar
    from radejax.visualize.recordings import animate
    from radejax.visualize.style import save_figure

    sequence, _, frame_name = name.partition("/")
    if sequence.isdecimal():
        sequence_numbers = (int(sequence),)
    elif name or not (sequence_numbers or weather):
        raise UserError(f"frame {name!r}, expected sequence/radar_lidar: 1/00033_00001")
    frames = KRadar(
        roots,
        labels,
        version=label_version,
        sequence_numbers=sequence_numbers,
        weather=weather,
        visibility=None,
    )
    if not len(frames):
        raise UserError("no frames of these sequences and weathers")
    found = [
        frame
        for frame in frames
        if frame_name in ("", frame.name, frame.name.partition("_")[0])
    ]
    if not found:
        raise UserError(
            f"no frame {frame_name} in sequence {sequence}; there are "
            f"{frames[0].name} to {frames[-1].name}"
        )
    if out.suffix.lower() in ANIMATIONS:
        found = found[:max_frames]
        drawn = (_draw(frame, frames.grid, slices, roi) for frame in found)
        total = len(found)
        animate(tqdm.tqdm(drawn, "draw", total, unit="frame"), out)
    else:
        found = found[:1]
        save_figure(_draw(found[0], frames.grid, slices, roi), out)
    options.echo_result(
        as_json, {"figure": str(out), "frames": len(found)}, f"drew {out}"
    )


def _draw(frame: Any, grid: Any, slices: bool, roi: str) -> Any:
    """Figure of one frame: slices of the projection, or radar map and camera image.

    Raises:
        UserError: It has neither tensor nor projection.
    """
    from radejax.core.structures import ROIS
    from radejax.runs.figures import frame_scene
    from radejax.visualize.draw import draw_frame
    from radejax.visualize.slices import draw_slices

    projection = frame.read_projection(grid)
    scene = frame_scene(frame, projection, grid, roi=ROIS.get(roi))
    if not slices:
        return draw_frame(scene)
    figure = draw_slices(projection, grid, ground_truth=scene.ground_truth)
    figure.suptitle(scene.title)
    return figure
