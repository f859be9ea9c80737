"""Renders the image of the front stereo camera for a scene and a camera calibration.

Ground and sky are computed for each pixel from its viewing ray. Objects consist of simple
parts (`shapes`) and are painted from far to near. The images are not photorealistic, but
vehicles and people appear at the pixels that correspond to their labels.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int32, UInt8
from PIL import Image, ImageDraw

from radejax.core.structures import CLASSES
from radejax.geometry.camera import CameraCalibration
from radejax.simulation.camera import details, lens, shapes
from radejax.simulation.config import SimulationOptions
from radejax.simulation.world.scene import SceneFrame, Sequence, is_blocked, turned

# K-Radar's values for the pair (see the calibration files of the dataset).
_front_camera = functools.partial(
    CameraCalibration.from_angles,
    intrinsics=(567.7208, 577.2137, 628.7208, 369.3069),
    distortion=(-0.028874, 0.000602, 0.003957, -0.005047, 0.0),
    yaw_deg=88.6,
    pitch_deg=0.6,
    roll_deg=89.6,
)
_TRANSLATIONS = ((0.18, -0.13, 0.0), (0.06, -0.13, 0.0))

_SKY = {"day": np.array([168, 196, 226.0]), "night": np.array([14, 16, 26.0])}
_GREY_SKY = {"day": np.array([196, 199, 203.0]), "night": np.array([22, 23, 28.0])}
_ASPHALT = np.array([86, 88, 92.0])
_VERGE = {
    "urban": np.array([142, 138, 130.0]),
    "alleyway": np.array([132, 128, 122.0]),
    "parkinglots": np.array([100, 102, 105.0]),
}
_GRASS = np.array([96, 112, 66.0])
_WITH_LAMPS = [CLASSES.index(name) for name in ("Sedan", "Bus or Truck", "Motorcycle")]
_SNOW = np.array([214, 218, 222.0])
_MARKING = np.array([226, 226, 220.0])
_HEADLIGHT = (0.16, (255, 250, 225))
_REAR_LIGHT = (0.05, (230, 40, 30))
_CLASS_COLORS = np.array(  # of silhouettes, in the order of `CLASSES`
    [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0), (0, 255, 255)], float
)
_HALF_BRIGHT_M = 20.0


def stereo_calibration(options: SimulationOptions) -> list[CameraCalibration]:
    """Returns the left and right front camera of K-Radar, scaled to an image size."""
    shift = options.radar_from_lidar_m
    pair = (
        _front_camera(translation_m=t, radar_from_lidar_m=shift) for t in _TRANSLATIONS
    )
    return [c.resized(options.image_width, options.image_height) for c in pair]


Values = Float[np.ndarray, "*all"]
Pixels = Float[np.ndarray, "*points 2"]


class Ground(NamedTuple):
    """Intersections of a camera's viewing rays with the ground.

    Attributes:
        hits: Mask of the P pixels that show ground.
        x_m: Forward coordinate of the intersection in the radar frame.
        y_m: Left coordinate of the intersection in the radar frame.
        depth_m: Distance of the intersection from the camera.
        up: Vertical component of the unit ray, for the gradient of the sky.
    """

    hits: Bool[np.ndarray, "H W"]
    x_m: Float[np.ndarray, " P"]
    y_m: Float[np.ndarray, " P"]
    depth_m: Float[np.ndarray, " P"]
    up: Float[np.ndarray, "H W"]


@functools.lru_cache(maxsize=4)  # all sequences of a dataset share their cameras
def trace_ground(calibration: CameraCalibration, ground_m: float) -> Ground:
    """Intersects the ray of every pixel with the plane `z = ground_m` (radar frame)."""
    fx, fy, cx, cy = calibration.intrinsics
    columns = np.arange(calibration.width) + 0.5
    u, v = np.meshgrid(columns, np.arange(calibration.height) + 0.5)
    seen = np.stack([(u - cx) / fx, (v - cy) / fy], -1)
    ideal = undistort(seen, calibration.distortion)
    rays = np.concatenate([ideal, np.ones_like(u)[..., None]], -1)
    rays = rays @ calibration.rotation  # camera to ego axes: R^T p
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    origin = shapes.camera_position(calibration)
    hits = rays[..., 2] < -1e-3
    down = rays[hits]
    distance = (ground_m - origin[2]) / down[:, 2]
    return Ground(
        hits=hits,
        x_m=origin[0] + distance * down[:, 0],
        y_m=origin[1] + distance * down[:, 1],
        depth_m=distance,
        up=rays[..., 2],
    )


def undistort(seen: Pixels, distortion: Float[np.ndarray, "5"]) -> Pixels:
    """Removes lens distortion from normalized coordinates by fixed-point iteration."""
    k1, k2, p1, p2, k3 = distortion
    ideal = seen.copy()
    for _ in range(12):
        x, y = np.moveaxis(ideal, -1, 0)
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        shift_x = 2 * p1 * x * y + p2 * (square + 2 * x * x)
        shift_y = p1 * (square + 2 * y * y) + 2 * p2 * x * y
        ideal = (seen - np.stack([shift_x, shift_y], -1)) / radial[..., None]
    return ideal


class CameraRenderer:
    """Renders the front stereo images of one sequence.

    Args:
        sequence: Scene, whose conditions determine light, colors and weather.
        options: Options of the dataset. Their seed determines object colors, precipitation
            and lens cover.
    """

    def __init__(self, sequence: Sequence, options: SimulationOptions) -> None:
        self.sequence = sequence
        self.options = options
        self.calibrations = calibrations = stereo_calibration(options)
        self.grounds = [trace_ground(c, sequence.ground_m) for c in calibrations]
        rng = np.random.default_rng([options.seed, sequence.name, 7])
        self.colors = shapes.object_colors(sequence.tracks.cls, rng)
        self.air = lens.AIR[sequence.weather]
        clear = sequence.weather == "normal"
        self.sky = (_SKY if clear else _GREY_SKY)[sequence.time]
        is_night = sequence.time == "night"
        self.light = shapes.Light(
            ambient=0.22 if is_night else 1.0,
            veil=self.sky,
            extinction_per_m=self.air.extinction_per_m,
            headlights=is_night,
        )

    def render(self, frame: SceneFrame) -> UInt8[np.ndarray, "H W2 3"]:
        """Renders the images of both cameras side by side, the left camera first."""
        return np.concatenate([self.view(frame, side) for side in (0, 1)], axis=1)

    def view(self, frame: SceneFrame, side: int) -> UInt8[np.ndarray, "H W 3"]:
        """Renders the image of the left (0) or right (1) camera."""
        if self.options.camera_mode == "oracle":
            return self.silhouettes(frame, side)
        canvas = Image.fromarray(self._background(frame, self.grounds[side]))
        draw = ImageDraw.Draw(canvas)
        for polygon in self.polygons(frame, side):
            draw.polygon(polygon.points, fill=polygon.color)
        if self.light.headlights:
            self._lamps(frame, side, draw)
        seed = self.options.seed
        name = self.sequence.name
        brightness = 0.45 if self.light.headlights else 1.0
        rng = np.random.default_rng([seed, name, side, frame.index, 5])
        canvas = lens.add_precipitation(canvas, self.air, brightness, rng)
        if self.options.cover_lens:
            level = lens.cover_level(seed, name, frame.index, self.sequence.weather)
            block = frame.index // lens.BLOCK_FRAMES
            rng = np.random.default_rng([seed, name, side, block, 6])
            canvas = lens.cover_lens(canvas, level, self.air.is_snow, brightness, rng)
        return np.asarray(canvas)

    def silhouettes(self, frame: SceneFrame, side: int) -> UInt8[np.ndarray, "H W 3"]:
        """Renders the objects as silhouettes in the color of their class on black.

        Brightness decreases with distance, to one half at 20 m, and near objects cover far
        ones. Weather and light have no effect. The image encodes the class and distance of
        every visible object.
        """
        calibration = self.calibrations[side]
        canvas = Image.new("RGB", (calibration.width, calibration.height))
        draw = ImageDraw.Draw(canvas)
        for polygon in self.polygons(frame, side):
            if polygon.box >= 0:  # not the roadside
                share = _HALF_BRIGHT_M / (_HALF_BRIGHT_M + polygon.depth_m)
                color = _CLASS_COLORS[frame.cls[polygon.box]] * share
                draw.polygon(polygon.points, fill=tuple(color.astype(int).tolist()))
        return np.asarray(canvas)

    def shown_boxes(self, frame: SceneFrame, side: int) -> Int32[np.ndarray, "H W"]:
        """Returns the index of the box that each pixel shows, -1 for none.

        Air and lens are assumed to be clear. Roadside shapes cover the objects behind them.
        """
        calibration = self.calibrations[side]
        canvas = Image.new("I", (calibration.width, calibration.height), -1)
        draw = ImageDraw.Draw(canvas)
        for polygon in self.polygons(frame, side):
            draw.polygon(polygon.points, fill=polygon.box)
        return np.asarray(canvas)

    def polygons(self, frame: SceneFrame, side: int) -> list[shapes.Polygon]:
        """Returns the polygons of objects and roadside in one camera, far ones first."""
        calibration = self.calibrations[side]
        origin = shapes.camera_position(calibration)
        ground_m = self.sequence.ground_m
        roadside = details.make_panels(frame, origin, ground_m, self.air.white)
        colors = self.colors[frame.track]
        return shapes.visible_polygons(frame, colors, calibration, self.light, roadside)

    def _lamps(self, frame: SceneFrame, side: int, draw: ImageDraw.ImageDraw) -> None:
        """Draws the visible headlights and rear lights of vehicles at night."""
        calibration = self.calibrations[side]
        vehicles = np.flatnonzero(np.isin(frame.cls, _WITH_LAMPS))
        boxes = frame.boxes[np.repeat(vehicles, 2)]
        length, width, height, yaw = boxes[:, 3:].T
        is_front = turned(boxes[:, :3], -yaw)[:, 0] < 0  # the front faces the radar
        along = np.where(is_front, 1.0, -1.0) * length / 2.0
        across = np.tile([-0.75, 0.75], len(vehicles)) * width / 2.0
        inside = np.stack([along, across, -0.15 * height], 1)
        lamps = boxes[:, :3] + turned(inside, yaw)
        origin = shapes.camera_position(calibration)
        obstacles = frame.boxes - np.r_[origin, np.zeros(4)]
        hidden = is_blocked(lamps - origin, obstacles, np.repeat(vehicles, 2))
        pixels, depth = calibration.project_ego(lamps)
        shown = calibration.in_image(pixels, depth) & (depth < 90.0) & ~hidden
        for i in np.flatnonzero(shown):
            size, color = _HEADLIGHT if is_front[i] else _REAR_LIGHT
            radius = calibration.intrinsics[0] * size / (depth[i] + 2.0) + 0.4
            u, v = pixels[i].tolist()
            draw.ellipse((u - radius, v - radius, u + radius, v + radius), fill=color)

    def _background(
        self, frame: SceneFrame, ground: Ground
    ) -> UInt8[np.ndarray, "H W 3"]:
        """Renders ground, road with markings, and sky."""
        fade = np.clip(ground.up * 2.5, 0.0, 1.0)[..., None]
        image = self.sky * (1.0 - 0.35 * fade)
        image[ground.hits] = self._ground_color(frame, ground)
        return np.clip(image, 0, 255).astype(np.uint8)

    def _ground_color(
        self, frame: SceneFrame, ground: Ground
    ) -> Float[np.ndarray, "P 3"]:
        """Computes the colors of the pixels that show ground."""
        sequence = self.sequence
        lanes = sequence.lanes_m
        x, y = ground.x_m, ground.y_m
        verge = _VERGE.get(sequence.environment, _GRASS)
        verge = verge + self.air.white * (_SNOW - verge)
        left = y - 0.5 * sequence.road.curvature_per_m * x * x
        along = x + sequence.ego_along_m[frame.index]
        grain = _hash_noise(np.floor(along * 3.0), np.floor(left * 3.0)) - 0.5
        color = np.broadcast_to(verge, (x.size, 3)) + 24.0 * grain[:, None]
        on_road = (left > min(lanes) - 0.4) & (left < max(lanes) + 0.4)
        # Tire tracks have less snow.
        tracks = 0.5 + 0.5 * np.cos(left * 2.0 * np.pi / 1.7)
        snow = (self.air.white * (0.35 + 0.65 * tracks))[:, None]
        asphalt = _ASPHALT * (1.0 - 0.3 * self.air.wetness)
        asphalt = asphalt + 14.0 * grain[:, None]
        surface = asphalt + snow * (_SNOW - asphalt)
        color = np.where(on_road[:, None], surface, color)
        dashed = np.mod(along, 12.0) < 5.0
        width = 0.09 + ground.depth_m * 0.0012  # at least a pixel far away
        on_line = np.zeros(x.size, bool)
        for border in lanes:
            is_edge = border in (min(lanes), max(lanes))
            on_line |= (np.abs(left - border) < width) & (dashed | is_edge)
        paint = _MARKING * (1.0 - 0.5 * self.air.white)
        color = np.where(on_line[:, None], paint + self.air.white * 100.0, color)
        return self.light.apply(color, x, y, ground.depth_m)


def _hash_noise(i: Values, j: Values) -> Values:
    """Computes uniform numbers in [0, 1) as a hash of two integers."""
    bits = i.astype(np.int64) * 374761393 + j.astype(np.int64) * 668265263
    bits &= 0xFFFFFFFF
    bits = ((bits ^ (bits >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((bits ^ (bits >> 16)) & 0xFFFF) / 65536.0
