"""Labels on radar and camera: the first look at new data, a frame or a sequence."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence
from typing import Any

import tqdm

from radejax.core.errors import UserError
from radejax.core.structures import WIDE_ROI
from radejax.data.images import front_view
from radejax.data.kradar import KRadar
from radejax.data.kradar.frame import Frame
from radejax.data.tesseract import read_projection
from radejax.visualize import animate, bev, projections

ANIMATIONS = (".gif", ".mp4")


def draw_overlay(
    name: str,
    roots: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    *,
    labels: str | os.PathLike | None = None,
    version: str = "v2.1",
    slices: bool = False,
    max_frames: int | None = None,
) -> int:
    """Draws radar map, boxes and camera image of a frame, or of a sequence in motion.

    Args:
        name: Sequence and frame, such as "1/00033_00001", or the sequence alone for
            its first frame, or for all of them if `out` is an animation.
        roots: K-Radar folders.
        out: Picture to write; an animation if it ends in .gif or .mp4.
        labels: Label revision, see `KRadar`.
        version: Of the labels.
        slices: Instead draw range-azimuth, range-Doppler and azimuth-elevation planes.
        max_frames: Of an animation; None: all.

    Returns:
        Number of frames drawn.

    Raises:
        UserError: There is no such frame, or it has neither tesseract nor
            projection.
    """
    sequence, _, frame_name = name.partition("/")
    if not sequence.isdigit():
        raise UserError(f"frame {name!r}, expected sequence/radar_lidar: 1/00033_00001")
    frames = KRadar(
        roots,
        labels,
        version=version,
        sequence_numbers=[int(sequence)],
        visibility=None,
    )
    found = [f for f in frames if frame_name in ("", f.name)]
    if not found:
        raise UserError(
            f"no frame {frame_name} in sequence {sequence}; there are "
            f"{frames[0].name} to {frames[-1].name}"
        )

    def draw(frame: Frame) -> Any:
        projection = read_projection(frame, frames.grid)
        title = f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}"
        if slices:
            figure = projections.draw_slices(projection, frames.grid)
            figure.suptitle(title)
            return figure
        image, camera = front_view(frame)
        return bev.draw_frame(
            projection,
            frames.grid,
            ground_truth=(frame.boxes, list(frame.classes)),
            image=image,
            camera=camera,
            roi=WIDE_ROI,
            title=title,
        )

    if pathlib.Path(out).suffix.lower() not in ANIMATIONS:
        bev.save_figure(draw(found[0]), out)
        return 1
    found = found[:max_frames]
    animate.animate(map(draw, tqdm.tqdm(found, desc="draw", unit="frame")), out)
    return len(found)
