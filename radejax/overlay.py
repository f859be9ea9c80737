"""One frame's labels on radar and camera: the first look at new data."""

from __future__ import annotations

import os
from collections.abc import Sequence

from radejax.data.kradar import KRadar
from radejax.data.tesseract import project_file
from radejax.errors import UserError
from radejax.evaluate_run import read_camera, read_left_image
from radejax.structures import WIDE_ROI
from radejax.visualize import bev


def draw_overlay(
    name: str,
    roots: Sequence[str | os.PathLike],
    out: str | os.PathLike,
    *,
    labels: str | os.PathLike | None = None,
    version: str = "v2.1",
) -> None:
    """Draws radar map, boxes and camera image of a frame into a picture.

    Args:
        name: Sequence and frame, such as "1/00033_00001", or the sequence alone for
            its first frame.
        roots: K-Radar folders.
        out: Picture to write.
        labels: Label revision, see `KRadar`.
        version: Of the labels.

    Raises:
        UserError: There is no such frame, or it has no tesseract.
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
    frame = found[0]
    if frame.tesseract_path is None:
        raise UserError(f"frame {frame.key} has no tesseract")
    figure = bev.draw_frame(
        project_file(frame.tesseract_path, shape_drea=frames.grid.shape_drea),
        frames.grid,
        ground_truth=(frame.boxes, list(frame.classes)),
        image=read_left_image(frame.camera_path),
        camera=read_camera(frame),
        roi=WIDE_ROI,
        title=f"sequence {frame.sequence}, frame {frame.name}, {frame.weather}",
    )
    bev.save_figure(figure, out)
