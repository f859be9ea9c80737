"""The front stereo camera's image of a scene, drawn through the calibration.

Ground and sky are computed per pixel from the viewing rays; objects are boxes of
simple parts (`shapes`), painted from far to near. It is a drawing, not a photograph:
enough for a network to find vehicles and people at the pixels the labels say.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from PIL import Image, ImageDraw

from radejax.geometry.camera import CameraCalibration
from radejax.simulation import shapes
from radejax.simulation.scene import SceneFrame, Sequence
from radejax.structures import CLASSES

# K-Radar's values for the pair (see the calibration files of the data set).
_INTRINSICS = (567.7208, 577.2137, 628.7208, 369.3069)
_DISTORTION = (-0.028874, 0.000602, 0.003957, -0.005047, 0.0)
_ANGLES = {"yaw_deg": 88.6, "pitch_deg": 0.6, "roll_deg": 89.6}
_TRANSLATIONS = ((0.18, -0.13, 0.0), (0.06, -0.13, 0.0))

_NEAR_M = 0.3
_SKY = {"day": np.array([168, 196, 226.0]), "night": np.array([14, 16, 26.0])}
_GREY_SKY = {"day": np.array([196, 199, 203.0]), "night": np.array([22, 23, 28.0])}
_ASPHALT = np.array([86, 88, 92.0])
_VERGE = {
    "urban": np.array([142, 138, 130.0]),
    "alleyway": np.array([132, 128, 122.0]),
    "parkinglots": np.array([100, 102, 105.0]),
}
_GRASS = np.array([96, 112, 66.0])
_MARKING = np.array([226, 226, 220.0])


def stereo_calibration(
    lidar_to_radar_m: tuple[float, float, float], width: int = 1280, height: int = 720
) -> tuple[CameraCalibration, CameraCalibration]:
    """Left and right front camera with K-Radar's intrinsics, scaled to an image size.

    Args:
        lidar_to_radar_m: Metres to add to LiDAR positions to get radar positions.
        width: Width of one of the two images.
        height: Height.
    """
    return tuple(
        CameraCalibration.from_angles(
            intrinsics=_INTRINSICS,
            distortion=_DISTORTION,
            translation_m=translation,
            ego_from_lidar_m=np.array(lidar_to_radar_m),
            **_ANGLES,
        ).resized(width, height)
        for translation in _TRANSLATIONS
    )


@dataclasses.dataclass(frozen=True)
class Ground:
    """Viewing rays of a camera where they meet the ground, per pixel.

    Attributes:
        x_m: `[H, W]` forward in the radar's frame; infinite above the horizon.
        y_m: `[H, W]` left.
        depth_m: `[H, W]` distance.
        up: `[H, W]` vertical component of the unit ray (the sky's gradient).
    """

    x_m: np.ndarray
    y_m: np.ndarray
    depth_m: np.ndarray
    up: np.ndarray


def trace_ground(calibration: CameraCalibration, ground_m: float) -> Ground:
    """Where every pixel's ray meets the ground plane `z = ground_m` (radar frame)."""
    fx, fy, cx, cy = calibration.intrinsics
    u, v = np.meshgrid(
        np.arange(calibration.width) + 0.5, np.arange(calibration.height) + 0.5
    )
    seen = np.stack([(u - cx) / fx, (v - cy) / fy], -1)
    ideal = undistort(seen, calibration.distortion)
    rays = np.concatenate([ideal, np.ones_like(u)[..., None]], -1)
    rays = rays @ calibration.rotation  # camera to ego axes: R^T p
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    shift = -calibration.rotation.T @ calibration.translation_m
    origin = shift + calibration.ego_from_lidar_m
    down = np.minimum(rays[..., 2], -1e-6)
    distance = (ground_m - origin[2]) / down
    hits = (rays[..., 2] < -1e-4) & (distance < 1e4)
    distance = np.where(hits, distance, np.inf)
    safe = np.where(hits, distance, 0.0)
    return Ground(
        x_m=np.where(hits, origin[0] + safe * rays[..., 0], np.inf),
        y_m=np.where(hits, origin[1] + safe * rays[..., 1], 0.0),
        depth_m=distance,
        up=rays[..., 2],
    )


def undistort(seen: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Inverse of the lens model by fixed-point iteration; normalised coordinates."""
    k1, k2, p1, p2, k3 = distortion
    ideal = seen.copy()
    for _ in range(12):
        x, y = ideal[..., 0], ideal[..., 1]
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        shift_x = 2 * p1 * x * y + p2 * (square + 2 * x * x)
        shift_y = p1 * (square + 2 * y * y) + 2 * p2 * x * y
        ideal = (seen - np.stack([shift_x, shift_y], -1)) / radial[..., None]
    return ideal


class CameraRenderer:
    """Draws the front stereo image of frames of one sequence.

    Args:
        sequence: Scene; its conditions choose light and colours.
        calibrations: Left and right camera.
        seed: Colours of the objects.
    """

    def __init__(
        self,
        sequence: Sequence,
        calibrations: tuple[CameraCalibration, CameraCalibration],
        seed: int,
    ) -> None:
        self.sequence = sequence
        self.calibrations = calibrations
        self.grounds = [trace_ground(c, sequence.ground_m) for c in calibrations]
        rng = np.random.default_rng([seed, sequence.name, 7])
        self.colors = shapes.object_colors(sequence.tracks.cls, rng)

    def render(self, frame: SceneFrame) -> np.ndarray:
        """`[H, 2 W, 3]` uint8 image of the pair, left half first."""
        halves = [
            self._one(frame, c, g)
            for c, g in zip(self.calibrations, self.grounds, strict=True)
        ]
        return np.concatenate(halves, axis=1)

    def object_mask(self, frame: SceneFrame, side: int = 0) -> np.ndarray:
        """`[H, W]` int32: which box of the frame each pixel shows, -1 for none."""
        calibration = self.calibrations[side]
        canvas = Image.new("I", (calibration.width, calibration.height), -1)
        draw = ImageDraw.Draw(canvas)
        for polygon in self._polygons(frame, calibration):
            draw.polygon(polygon.points, fill=int(polygon.box))
        return np.asarray(canvas)

    def _one(self, frame, calibration, ground) -> np.ndarray:
        canvas = Image.fromarray(self._background(frame, ground))
        draw = ImageDraw.Draw(canvas)
        for polygon in self._polygons(frame, calibration):
            draw.polygon(polygon.points, fill=polygon.color)
        return np.asarray(canvas)

    def _polygons(self, frame, calibration) -> list[shapes.Polygon]:
        return shapes.visible_polygons(
            frame.boxes,
            [CLASSES[c] for c in frame.cls],
            self.colors[frame.track],
            calibration,
            near_m=_NEAR_M,
            light=1.0 if self.sequence.time == "day" else 0.35,
        )

    def _background(self, frame: SceneFrame, ground: Ground) -> np.ndarray:
        """`[H, W, 3]` uint8 ground, road with markings, and sky."""
        sequence = self.sequence
        clear = sequence.weather == "normal"
        sky = (_SKY if clear else _GREY_SKY)[sequence.time]
        fade = np.clip(ground.up * 2.5, 0.0, 1.0)[..., None]
        image = sky * (1.0 - 0.35 * fade) + 20.0 * (1.0 - fade)
        hits = np.isfinite(ground.depth_m)
        x, y = ground.x_m[hits], ground.y_m[hits]
        image[hits] = self._ground_color(frame, x, y, ground.depth_m[hits])
        return np.clip(image, 0, 255).astype(np.uint8)

    def _ground_color(self, frame, x, y, depth) -> np.ndarray:
        """`[P, 3]` colours of ground points given in the radar's frame."""
        sequence, lanes = self.sequence, self.sequence.lanes_m
        light = 1.0 if sequence.time == "day" else 0.3
        verge = _VERGE.get(sequence.environment, _GRASS)
        left = y - 0.5 * sequence.road.curvature_per_m * x * x + sequence.ego_left_m
        along = x + frame.ego_along_m
        grain = _hash_noise(np.floor(along * 3.0), np.floor(left * 3.0))[:, None]
        color = np.broadcast_to(verge, (x.size, 3)) + 24.0 * (grain - 0.5)
        if lanes:
            on_road = (left > min(lanes) - 0.4) & (left < max(lanes) + 0.4)
            color = np.where(on_road[:, None], _ASPHALT + 14.0 * (grain - 0.5), color)
            dashed = np.mod(along, 12.0) < 5.0
            for border in lanes:
                is_edge = border in (min(lanes), max(lanes))
                width = 0.09 + depth * 0.0012  # a pixel far away
                on_line = (np.abs(left - border) < width) & (dashed | is_edge)
                color = np.where(on_line[:, None], _MARKING, color)
        haze = np.exp(-depth / 400.0)[:, None]
        horizon = (_SKY if sequence.weather == "normal" else _GREY_SKY)[sequence.time]
        return color * light * haze + horizon * (1.0 - haze)


def _hash_noise(i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Uniform numbers in [0, 1) that depend on two integers only."""
    bits = (
        i.astype(np.int64) * 374761393 + j.astype(np.int64) * 668265263
    ) & 0xFFFFFFFF
    bits = ((bits ^ (bits >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((bits ^ (bits >> 16)) & 0xFFFF) / 65536.0
