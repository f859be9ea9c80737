"""Recordings for the rerun viewer: radar, boxes, tracks and camera over time.

Needs the extra `viewer` (`pip install radejax[viewer]`); nothing else does.
"""

from __future__ import annotations

import os
import pathlib
import shutil
import subprocess
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.colors import to_rgb

from radejax.core.errors import UserError
from radejax.core.files import atomic_path
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import (
    COLOR_MAP,
    GROUND_TRUTH,
    PREDICTION,
    Objects,
    Scene,
    Style,
    color_limits_of,
    label_texts,
)
from radejax.visualize.projections import check_projection, range_azimuth

_INSTALL = (
    "the viewer needs rerun, which is not installed: pip install 'radejax[viewer]' "
    "(or pip install rerun-sdk)"
)

_ENTITIES = {GROUND_TRUTH.name: "ground_truth", PREDICTION.name: "predictions"}


def write_recording(
    scenes: Iterable[Scene],
    path: str | os.PathLike,
    *,
    num_points: int = 3000,
    elevation_sign: int = 1,
    trail_length: int = 20,
) -> pathlib.Path:
    """Writes scenes into a recording (.rrd) that `rerun PATH` opens.

    Args:
        scenes: Frames in time order; an iterator keeps memory constant.
        path: Target, written completely or not at all.
        num_points: Strongest echoes shown as points.
        elevation_sign: See `echo_points`.
        trail_length: Frames that a track's trail reaches back.

    Returns:
        The path written.

    Raises:
        UserError: rerun is not installed; the suffix is not .rrd; no frames.
    """
    path = pathlib.Path(path)
    if path.suffix != ".rrd":
        raise UserError(f"recordings are written as .rrd, got {path.name!r}")
    rr = _import_rerun()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary:
        stream = rr.RecordingStream("radejax")
        stream.save(temporary, default_blueprint=_blueprint())
        stream.log("world", rr.ViewCoordinates.FLU, static=True)
        trails: dict[Any, list[np.ndarray]] = {}
        count = 0
        for count, scene in enumerate(scenes, 1):
            _log_scene(stream, scene, count - 1, num_points, elevation_sign)
            _log_trails(stream, scene, trails, trail_length)
        if not count:
            raise UserError("no frames to record")
        stream.flush()
        del stream  # closes the file before it takes its name
    return path


def open_viewer(path: str | os.PathLike) -> None:
    """Opens a recording in the rerun viewer and returns at once.

    Raises:
        FileNotFoundError: There is no such recording.
        UserError: The rerun program is not installed.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    program = shutil.which("rerun")
    if program is None:
        raise UserError(_INSTALL)
    subprocess.Popen([program, str(path)], start_new_session=True)


def echo_points(
    projection: Any,
    grid: RadarGrid,
    num_points: int = 3000,
    *,
    elevation_sign: int = 1,
) -> tuple[Float[np.ndarray, "P 3"], Float[np.ndarray, " P"]]:
    """The strongest range-azimuth bins as points in space.

    Range weakens echoes, and near clutter would take all the points: strength is
    measured above the median of the bin's range row. The height comes from the
    strongest elevation channel.

    Args:
        projection: `[R, A, D+E]` normalised log power.
        grid: The grid of the projection.
        num_points: How many bins.
        elevation_sign: 1 if positive elevation bins look up, -1 if down. Published
            code bases disagree about K-Radar's axis; check it against data.

    Returns:
        Points in the ego frame and their strength above the median.
    """
    if elevation_sign not in (-1, 1):
        raise UserError(f"elevation_sign must be 1 or -1, got {elevation_sign}")
    values = check_projection(projection, grid)
    power = values.max(-1)
    strength = power - np.median(power, axis=1, keepdims=True)
    num_points = min(num_points, power.size)
    flat = np.argpartition(strength.ravel(), -num_points)[-num_points:]
    range_idx, azimuth_idx = np.unravel_index(flat, power.shape)
    echoes = values[range_idx, azimuth_idx, grid.num_doppler :]
    elevation = elevation_sign * grid.elevation_rad[echoes.argmax(-1)]
    range_m, azimuth = grid.range_m[range_idx], grid.azimuth_rad[azimuth_idx]
    ground_m = range_m * np.cos(elevation)
    points = np.stack(
        [
            ground_m * np.cos(azimuth),
            -ground_m * np.sin(azimuth),
            range_m * np.sin(elevation),
        ],
        -1,
    )
    return points, strength.ravel()[flat]


def ground_mesh(
    grid: RadarGrid,
) -> tuple[Float[np.ndarray, "bins 3"], Int[np.ndarray, "T 3"]]:
    """Vertices at bin centers on z = -2 m and triangles."""
    centers = grid.bin_centers_ego().reshape(-1, 2)
    vertices = np.concatenate([centers, np.full((len(centers), 1), -2.0)], 1)
    first = (
        np.arange(grid.num_range - 1)[:, None] * grid.num_azimuth
        + np.arange(grid.num_azimuth - 1)
    ).ravel()
    a, b = first, first + 1
    c, d = first + grid.num_azimuth, first + grid.num_azimuth + 1
    triangles = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    return vertices, triangles


def _import_rerun() -> Any:
    """The rerun module, or a `UserError` that says how to get it."""
    try:
        import rerun
    except ImportError as error:
        raise UserError(_INSTALL) from error
    return rerun


def _blueprint() -> Any:
    """3D view beside the camera image."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="world", name="Radar"),
            rrb.Vertical(
                rrb.Spatial2DView(origin="camera", name="Camera"),
                rrb.TextDocumentView(origin="frame", name="Frame"),
                row_shares=[4, 1],
            ),
            column_shares=[3, 2],
        )
    )


def _log_scene(
    stream: Any, scene: Scene, index: int, num_points: int, elevation_sign: int
) -> None:
    """One frame's radar, boxes, image and title."""
    import rerun as rr

    stream.set_time("frame", sequence=index)
    if scene.time_s is not None:
        stream.set_time("time", timestamp=scene.time_s)
    if scene.title:
        stream.log("frame", rr.TextDocument(scene.title))
    power = range_azimuth(scene.projection, scene.grid)
    low, high = color_limits_of(power)
    vertices, triangles = ground_mesh(scene.grid)
    stream.log(
        "world/bev",
        rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=triangles,
            vertex_colors=_colors((power.ravel() - low) / (high - low)),
        ),
    )
    points, strength = echo_points(
        scene.projection, scene.grid, num_points, elevation_sign=elevation_sign
    )
    brightest = max(float(strength.max()), 1e-6)
    stream.log(
        "world/echoes",
        rr.Points3D(points, colors=_colors(strength / brightest), radii=0.12),
    )
    if scene.image is not None:
        stream.log("camera", rr.Image(np.asarray(scene.image)))
    for style, objects in scene.sets:
        name = _ENTITIES[style.name]
        stream.log(f"world/{name}", _boxes(objects, style))
        if scene.image is not None and scene.camera is not None:
            segments, is_visible = scene.camera.project_boxes(objects.boxes)
            strips = segments[is_visible]
            lines = rr.LineStrips2D(strips, colors=[_rgb(style)] * len(strips))
            stream.log(f"camera/{name}", lines)


def _boxes(objects: Objects, style: Style) -> Any:
    """Boxes as rerun draws them."""
    import rerun as rr

    boxes = objects.boxes
    return rr.Boxes3D(
        centers=boxes[:, :3],
        half_sizes=boxes[:, 3:6] / 2,
        quaternions=yaw_quaternions(boxes[:, 6]),
        labels=label_texts(objects),
        colors=[_rgb(style)] * len(boxes),
    )


def yaw_quaternions(yaw_rad: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 4"]:
    """x, y, z, w of rotations about z."""
    zero = np.zeros_like(yaw_rad)
    return np.stack([zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)], -1)


def _log_trails(
    stream: Any,
    scene: Scene,
    trails: dict[Any, list[np.ndarray]],
    trail_length: int,
) -> None:
    """Where each tracked object was, in the moving ego frame."""
    import rerun as rr

    if scene.track_ids is None or scene.ground_truth is None:
        return
    boxes = scene.sets[0][1].boxes
    if len(scene.track_ids) != len(boxes):
        raise UserError(f"{len(boxes)} boxes but {len(scene.track_ids)} track_ids")
    seen = {
        track: box[:3]
        for track, box in zip(scene.track_ids, boxes, strict=True)
        if track is not None
    }
    for track in [t for t in trails if t not in seen]:
        del trails[track]
    for track, center in seen.items():
        trails[track] = [*trails.get(track, []), center][-trail_length:]
    strips = [np.array(t) for t in trails.values() if len(t) > 1]
    stream.log("world/tracks", rr.LineStrips3D(strips, radii=0.05))


def _rgb(style: Style) -> tuple[int, ...]:
    """The style's colour, 0 to 255."""
    return tuple(round(255 * share) for share in to_rgb(style.color))


def _colors(values: Float[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours of values in [0, 1]."""
    return np.round(255 * COLOR_MAP(np.clip(values, 0, 1))[:, :3]).astype(np.uint8)
