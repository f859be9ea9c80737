"""Animated sequences: GIF through Pillow, MP4 through matplotlib and ffmpeg.

matplotlib's own GIF writer keeps every frame in memory and gives each a palette of its
own, which flickers; Pillow writes them one by one.
"""

from __future__ import annotations

import itertools
import os
import pathlib
import subprocess
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import UInt8
from matplotlib.animation import FFMpegWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from radejax.core.errors import UserError
from radejax.core.files import atomic_path
from radejax.visualize.canvas import COLOR_MAP, GROUND_TRUTH, PREDICTION, new_figure

_LINE_COLORS = ("black", GROUND_TRUTH.color, PREDICTION.color, PREDICTION.text_color)
_MAP_COLORS = 32


def render(figure: Figure) -> UInt8[np.ndarray, "H W 3"]:
    """Pixels of a figure at its own resolution."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def animate(
    figures: Iterable[Figure | np.ndarray],
    path: str | os.PathLike,
    *,
    frames_per_second: float = 10.0,
    num_colors: int = 128,
) -> pathlib.Path:
    """Writes figures one after another into a GIF or MP4, completely or not at all.

    Frames are drawn as they are needed, so a generator keeps memory constant::

        animate((draw_frame(scene) for scene in scenes), "sequence.gif")

    Args:
        figures: Figures, or images `[H, W, 3]` uint8, of one size.
        path: Target; the suffix decides: .gif, or .mp4, which needs ffmpeg.
        frames_per_second: K-Radar's sensors run at 10.
        num_colors: Of a GIF's palette, which is common to all frames; at most 256.

    Returns:
        The path written.

    Raises:
        UserError: Another suffix, no frames, frames of different sizes, no ffmpeg.
    """
    path = pathlib.Path(path)
    writers = {".gif": _write_gif, ".mp4": _write_mp4}
    suffix = path.suffix.lower()
    if suffix not in writers:
        raise UserError(f"animations are written as .gif or .mp4, got {path.name!r}")
    if not frames_per_second > 0:
        raise UserError(f"frames_per_second must be positive, got {frames_per_second}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        writers[suffix](_pictures(figures), temporary, frames_per_second, num_colors)
    return path


def _pictures(figures: Iterable[Figure | np.ndarray]) -> Iterator[np.ndarray]:
    """Rendered frames, checked to have one size; at least one."""
    shape = None
    for i, figure in enumerate(figures):
        pixels = render(figure) if isinstance(figure, Figure) else np.asarray(figure)
        shape = shape or pixels.shape
        if pixels.shape != shape or pixels.ndim != 3 or pixels.shape[-1] != 3:
            raise UserError(
                f"frame {i} has shape {pixels.shape}, expected {shape} as the first"
                if i
                else f"frames must be [H, W, 3], got {pixels.shape}"
            )
        yield pixels
    if shape is None:
        raise UserError("no frames to animate")


def _write_gif(
    pictures: Iterator[np.ndarray], path: pathlib.Path, rate: float, num_colors: int
) -> None:
    """One palette for all frames: per-frame palettes flicker."""
    first = Image.fromarray(next(pictures))
    palette = make_palette(first, num_colors)
    frames = (
        Image.fromarray(pixels).quantize(palette=palette, dither=Image.Dither.NONE)
        for pixels in pictures
    )
    first.quantize(palette=palette, dither=Image.Dither.NONE).save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames,
        duration=round(1000 / rate),
        loop=0,
    )


def make_palette(first: Image.Image, num_colors: int) -> Image.Image:
    """Colours of a picture, of the radar map and of lines that may come later.

    Args:
        first: The picture, RGB.
        num_colors: Of the palette; 256 at most.

    Returns:
        An image whose palette serves `Image.quantize(palette=...)`.
    """
    lines = np.array([to_rgb(c) for c in _LINE_COLORS])
    lines = np.concatenate([lines, COLOR_MAP(np.linspace(0, 1, _MAP_COLORS))[:, :3]])
    # Half for smooth shades of large areas, half for rare but vivid colours.
    kept = max(2, (min(num_colors, 256) - len(lines)) // 2)
    colors: list[int] = []
    for method in (Image.Quantize.MEDIANCUT, Image.Quantize.MAXCOVERAGE):
        chosen = first.quantize(kept, method=method).getpalette()
        assert chosen is not None  # quantized images have one
        colors += chosen[: 3 * kept]
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors + np.round(255 * lines).astype(int).ravel().tolist())
    return palette


def _write_mp4(
    pictures: Iterator[np.ndarray], path: pathlib.Path, rate: float, _: int
) -> None:
    """H.264 with the pixel format that browsers play."""
    if not FFMpegWriter.isAvailable():
        raise UserError(
            "writing .mp4 needs the ffmpeg program, which is not on the PATH; install "
            "it (apt install ffmpeg, conda install ffmpeg) or write a .gif"
        )
    # The pixel format halves colour resolution, so sizes must be even.
    options = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"]
    options += ["-pix_fmt", "yuv420p", "-f", "mp4"]
    # `fps` may be a fraction.
    writer = FFMpegWriter(rate, "libx264", extra_args=options)  # type: ignore[arg-type]
    first = next(pictures)
    height, width = first.shape[:2]
    figure = new_figure(width / 100, height / 100, dpi=100)
    shown = figure.figimage(first)
    try:
        with writer.saving(figure, str(path), dpi=100):
            for picture in itertools.chain([first], pictures):
                shown.set_data(picture)
                writer.grab_frame()
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines() or ["no message"]
        raise UserError(f"ffmpeg could not write the video: {lines[-1]}") from error
