"""Animated sequences: GIF, or MP4 where ffmpeg is installed."""

from __future__ import annotations

import itertools
import os
import pathlib
import subprocess
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radejax.core.errors import UserError
from radejax.core.files import atomic_path


def render(figure: Figure) -> UInt8[np.ndarray, "H W 3"]:
    """Pixels of a figure at its own resolution."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def animate(
    figures: Iterable[Figure],
    path: str | os.PathLike,
    *,
    frames_per_second: float = 10.0,
) -> pathlib.Path:
    """Write figures as the frames of a GIF or MP4, completely or not at all.

    Args:
        figures: Figures, at the size and resolution of the first; may be a generator.
        path: Target; the suffix decides: .gif, or .mp4, which needs ffmpeg.
        frames_per_second: K-Radar's sensors run at 10.

    Returns:
        The path written.

    Raises:
        UserError: Another suffix, no figures, or ffmpeg is missing or fails.
    """
    path = pathlib.Path(path)
    writer: PillowWriter | FFMpegWriter
    if path.suffix.lower() == ".gif":
        writer = PillowWriter(frames_per_second)  # type: ignore[arg-type]
    elif path.suffix.lower() != ".mp4":
        raise UserError(f"animations are written as .gif or .mp4, got {path.name!r}")
    elif not FFMpegWriter.isAvailable():
        raise UserError(
            "writing .mp4 needs the ffmpeg program, which is not on the PATH; install "
            "it (apt install ffmpeg, conda install ffmpeg) or write a .gif"
        )
    else:
        writer = FFMpegWriter(frames_per_second, "h264")  # type: ignore[arg-type]
    remaining = iter(figures)
    first = next(remaining, None)
    if first is None:
        raise UserError("no frames to animate")
    with atomic_path(path) as temporary:
        # Both writers choose the format by the suffix.
        target = temporary.with_name(f"{temporary.name}{path.suffix.lower()}")
        try:
            with writer.saving(first, str(target), first.dpi):
                for figure in itertools.chain([first], remaining):
                    figure.set_size_inches(*first.get_size_inches())
                    writer.fig = figure
                    writer.grab_frame()
            os.replace(target, temporary)
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines() or ["no message"]
            raise UserError(f"ffmpeg could not write the video: {lines[-1]}") from error
        finally:
            target.unlink(missing_ok=True)
    return path
