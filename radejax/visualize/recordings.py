"""Sequences of frames as GIF and rerun recordings.

Recordings show radar map, boxes and camera over time. Only they need the extra `viewer`
(`pip install radejax[viewer]`).
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from radejax.core.errors import UserError
from radejax.core.files import PathLike, as_path, atomic_path
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import style
from radejax.visualize.style import COLOR_MAP, Scene, color_limits_of, label_texts

if TYPE_CHECKING:
    import rerun


_STYLES = (
    style.GROUND_TRUTH,
    style.PREDICTION,
    style.MISSED,
    style.TRUE_POSITIVE,
    style.NOT_EVALUATED,
)
_LINE_COLORS = sorted({look.color for look in _STYLES})


def animate(
    figures: Iterable[Figure],
    path: PathLike,
    *,
    frames_per_second: float = 10.0,
) -> pathlib.Path:
    """Writes figures as the frames of a GIF file, which is replaced atomically.

    Args:
        figures: Figures or a generator of figures, written at the size of the first one.
        path: File to write, with the suffix .gif.
        frames_per_second: Frame rate; K-Radar's sensors have 10 frames per second.

    Returns:
        The path of the file.

    Raises:
        UserError: The suffix is not .gif, or there are no figures.
    """
    path = as_path(path)
    if path.suffix.lower() != ".gif":
        raise UserError(f"animations are written as .gif, got {path.name!r}")
    images = map(_image_of, figures)
    first = next(images, None)
    if first is None:
        raise UserError("no frames to animate")
    with atomic_path(path) as temporary:
        _to_palette(first).save(
            temporary,
            "gif",
            save_all=True,
            append_images=(_to_palette(image.resize(first.size)) for image in images),
            duration=1000.0 / frames_per_second,
            loop=0,
        )
    return path


def _image_of(figure: Figure) -> Image.Image:
    """Returns a figure as an image."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def _to_palette(image: Image.Image) -> Image.Image:
    """Reduces an image to 256 colors, among them those of boxes.

    A palette of the most frequent colors would lack them, as their lines are thin. The edges of
    lines and texts have darker shades of them.
    """
    rgb = np.array([to_rgb(color) for color in _LINE_COLORS])
    colors = np.round(255 * np.concatenate([rgb, 0.75 * rgb, 0.5 * rgb])).astype(int)
    others = image.quantize(256 - len(colors)).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette((colors.ravel().tolist() + others)[: 3 * 256])
    return image.quantize(palette=palette, dither=Image.Dither.NONE)


def check_recording(path: PathLike) -> None:
    """Raises `UserError` if recordings cannot be written to a file.

    Args:
        path: File to write.

    Raises:
        UserError: rerun is not installed, or the suffix is not .rrd.
    """
    path = as_path(path)
    if path.suffix != ".rrd":
        raise UserError(f"recordings are written as .rrd, got {path.name!r}")
    try:
        import rerun  # noqa: F401
    except ImportError as error:
        raise UserError(
            "recordings need rerun, which is not installed: pip install "
            "'radejax[viewer]' (or pip install rerun-sdk)"
        ) from error


def write_recording(scenes: Iterable[Scene], path: PathLike) -> None:
    """Writes scenes to a recording (.rrd) that `rerun PATH` opens.

    Args:
        scenes: Frames in time order; use an iterator for constant memory.
        path: File to write, which is replaced atomically.

    Raises:
        UserError: rerun is not installed, the suffix is not .rrd, or there are no frames.
    """
    check_recording(path)
    import rerun as rr

    with atomic_path(path) as temporary:
        stream = rr.RecordingStream("radejax")
        stream.save(temporary)
        stream.log("world", rr.ViewCoordinates.FLU, static=True)
        count = 0
        for count, scene in enumerate(scenes, 1):
            _log_scene(stream, scene, count - 1)
        if not count:
            raise UserError("no frames to record")
        stream.flush()
        del stream  # closes the file before it is renamed


def ground_mesh(
    grid: RadarGrid,
) -> tuple[Float[np.ndarray, "bins 3"], Int[np.ndarray, "T 3"]]:
    """Returns the vertices (bin centers at z = -2 m) and triangles of the ground mesh."""
    centers = grid.bin_centers_ego().reshape(-1, 2)
    vertices = np.concatenate([centers, np.full((len(centers), 1), -2.0)], 1)
    index = np.arange(len(centers)).reshape(grid.num_range, grid.num_azimuth)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    return vertices, triangles.reshape(-1, 3)


def yaw_quaternions(yaw_rad: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 4"]:
    """Returns the quaternions x, y, z, w of rotations about z."""
    zero = np.zeros_like(yaw_rad)
    return np.stack([zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)], -1)


def _log_scene(stream: rerun.RecordingStream, scene: Scene, index: int) -> None:
    """Logs one frame's radar map, boxes, image and title."""
    import rerun as rr

    stream.set_time("frame", sequence=index)
    if scene.time_s is not None:
        stream.set_time("time", timestamp=scene.time_s)
    stream.log("frame", rr.TextDocument(scene.title))
    power = scene.power.ravel()
    low, high = color_limits_of(power)
    colors = COLOR_MAP(np.clip((power - low) / (high - low), 0, 1))[:, :3]
    vertices, triangles = ground_mesh(scene.grid)
    mesh = rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=triangles,
        vertex_colors=np.round(255 * colors).astype(np.uint8),
    )
    stream.log("world/bev", mesh)
    if scene.image is not None:
        stream.log("camera", rr.Image(np.asarray(scene.image)))
    for look, boxes in scene.sets:
        name = look.name.replace(" ", "_")
        color = [round(255 * value) for value in to_rgb(look.color)]
        drawn = rr.Boxes3D(
            centers=boxes.box[:, :3],
            half_sizes=boxes.box[:, 3:6] / 2,
            quaternions=yaw_quaternions(boxes.box[:, 6]),
            labels=label_texts(boxes),
            colors=[color] * len(boxes),
        )
        stream.log(f"world/{name}", drawn)
        if scene.image is not None and scene.camera is not None:
            segments, is_visible = scene.camera.project_boxes(boxes.box)
            strips = segments[is_visible]
            lines = rr.LineStrips2D(strips, colors=[color] * len(strips))
            stream.log(f"camera/{name}", lines)
