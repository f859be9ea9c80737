"""Recordings for the rerun viewer: radar, boxes, tracks and camera over time.

Needs the extra `viewer` (`pip install radejax[viewer]`); nothing else does.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import shutil
import subprocess
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from radejax.core.errors import UserError
from radejax.core.files import atomic_path
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize.canvas import COLOR_MAP, Objects, color_limits_of, label_texts
from radejax.visualize.overlays import both_sets
from radejax.visualize.projections import check_projection, range_azimuth

if TYPE_CHECKING:
    from radejax.geometry.calibration import CameraCalibration

_GROUND_TRUTH_RGB = (255, 255, 255)
_PREDICTION_RGB = (255, 77, 64)
_INSTALL = (
    "the viewer needs rerun, which is not installed: pip install 'radejax[viewer]' "
    "(or pip install rerun-sdk)"
)


@dataclasses.dataclass(frozen=True)
class ViewerFrame:
    """What one frame of a recording shows.

    Attributes:
        projection: `[R, A, D+E]` normalised log power.
        ground_truth: Boxes with classes, see `canvas.as_objects`, or None.
        predictions: Boxes with scores and classes, or None.
        track_ids: One hashable id per ground truth box, None for a box without trail; or
            None.
        image: `[H, W, 3]` uint8 camera image, or None.
        calibration: Of the image, to draw boxes on it, or None.
        time_s: Seconds since the Unix epoch, or None.
        name: Shown as text, or None.
    """

    projection: Any
    ground_truth: Any = None
    predictions: Any = None
    track_ids: Any = None
    image: Any = None
    calibration: CameraCalibration | None = None
    time_s: float | None = None
    name: str | None = None


def write_recording(
    frames: Iterable[ViewerFrame],
    grid: RadarGrid,
    path: str | os.PathLike,
    *,
    num_points: int = 3000,
    elevation_sign: int = 1,
    trail_length: int = 20,
) -> pathlib.Path:
    """Writes frames into a recording (.rrd) that `rerun PATH` opens.

    Args:
        frames: In time order; an iterator keeps memory constant.
        grid: The grid of all projections.
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
        for count, frame in enumerate(frames, 1):
            _log_frame(stream, frame, grid, count - 1, num_points, elevation_sign)
            _log_trails(stream, frame, trails, trail_length)
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
) -> tuple[np.ndarray, np.ndarray]:
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
        Points `[P, 3]` in the ego frame and their strength `[P]` above the median.
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


def ground_mesh(grid: RadarGrid) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `[R * A, 3]` at bin centers on z = -2 m and triangles `[T, 3]`."""
    centers = grid.cell_centers_ego().reshape(-1, 2)
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


def _log_frame(
    stream: Any,
    frame: ViewerFrame,
    grid: RadarGrid,
    index: int,
    num_points: int,
    elevation_sign: int,
) -> None:
    """One frame's radar, boxes, image and name."""
    import rerun as rr

    stream.set_time("frame", sequence=index)
    if frame.time_s is not None:
        stream.set_time("time", timestamp=frame.time_s)
    if frame.name is not None:
        stream.log("frame", rr.TextDocument(frame.name))
    power = range_azimuth(frame.projection, grid)
    low, high = color_limits_of(power)
    vertices, triangles = ground_mesh(grid)
    stream.log(
        "world/bev",
        rr.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=triangles,
            vertex_colors=_colors((power.ravel() - low) / (high - low)),
        ),
    )
    points, strength = echo_points(
        frame.projection, grid, num_points, elevation_sign=elevation_sign
    )
    brightest = max(float(strength.max()), 1e-6)
    stream.log(
        "world/echoes",
        rr.Points3D(points, colors=_colors(strength / brightest), radii=0.12),
    )
    truth, found = both_sets(frame.ground_truth, frame.predictions, None)
    for name, objects, color in (
        ("ground_truth", truth, _GROUND_TRUTH_RGB),
        ("predictions", found, _PREDICTION_RGB),
    ):
        if objects is not None:
            stream.log(f"world/{name}", _boxes(objects, color))
    if frame.image is not None:
        stream.log("camera", rr.Image(np.asarray(frame.image)))
        if frame.calibration is not None:
            _log_overlay(stream, frame.calibration, truth, found)


def _boxes(objects: Objects, color: tuple[int, int, int]) -> Any:
    """Boxes as rerun draws them."""
    import rerun as rr

    boxes = objects.boxes
    return rr.Boxes3D(
        centers=boxes[:, :3],
        half_sizes=boxes[:, 3:6] / 2,
        quaternions=yaw_quaternions(boxes[:, 6]),
        labels=label_texts(objects),
        colors=[color] * len(boxes),
    )


def yaw_quaternions(yaw_rad: np.ndarray) -> np.ndarray:
    """`[N, 4]` x, y, z, w of rotations about z."""
    zero = np.zeros_like(yaw_rad)
    return np.stack([zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)], -1)


def _log_overlay(
    stream: Any,
    calibration: CameraCalibration,
    truth: Objects | None,
    found: Objects | None,
) -> None:
    """Edges of the boxes on the image."""
    import rerun as rr

    for name, objects, color in (
        ("ground_truth", truth, _GROUND_TRUTH_RGB),
        ("predictions", found, _PREDICTION_RGB),
    ):
        if objects is None:
            continue
        segments, is_visible = calibration.project_boxes(objects.boxes)
        stream.log(
            f"camera/{name}",
            rr.LineStrips2D(segments[is_visible], colors=[color] * is_visible.sum()),
        )


def _log_trails(
    stream: Any,
    frame: ViewerFrame,
    trails: dict[Any, list[np.ndarray]],
    trail_length: int,
) -> None:
    """Where each tracked object was, in the moving ego frame."""
    import rerun as rr

    if frame.track_ids is None or frame.ground_truth is None:
        return
    truth, _ = both_sets(frame.ground_truth, None, None)
    if len(frame.track_ids) != len(truth.boxes):
        raise UserError(
            f"{len(truth.boxes)} boxes but {len(frame.track_ids)} track_ids"
        )
    seen = {
        track: box[:3]
        for track, box in zip(frame.track_ids, truth.boxes, strict=True)
        if track is not None
    }
    for track in [t for t in trails if t not in seen]:
        del trails[track]
    for track, center in seen.items():
        trails[track] = [*trails.get(track, []), center][-trail_length:]
    strips = [np.array(t) for t in trails.values() if len(t) > 1]
    stream.log("world/tracks", rr.LineStrips3D(strips, radii=0.05))


def _colors(values: np.ndarray) -> np.ndarray:
    """`[N, 3]` uint8 colours of values in [0, 1]."""
    return np.round(255 * COLOR_MAP(np.clip(values, 0, 1))[:, :3]).astype(np.uint8)
