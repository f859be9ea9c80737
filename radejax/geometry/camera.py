"""Camera calibration files and the projection of radar-frame points into the image.

The LiDAR frame and the ego (radar) frame have parallel axes (x forward, y left, z up) and
differ by a translation. In the camera frame, x points right, y down and z forward (depth).
Pixel coordinates start at the upper left corner of the image, with u to the right and v
down.

`CameraCalibration` (NumPy, float64) is used on the host; `Camera` is a pytree of the same
numbers for jitted code.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any, Literal, get_args

import chex
import jax
import numpy as np
from flax import struct
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Real

from radejax.core.errors import DataError, require
from radejax.core.files import as_path
from radejax.core.structures import Array
from radejax.geometry.boxes import ArrayT, array_module, corners
from radejax.geometry.radar_grid import ArrayValues

Pixels = Real[np.ndarray, "*points 2"]
Depths = Real[np.ndarray, "*points"]
IsInImage = Bool[np.ndarray, "*points"] | np.bool_  # the latter for a single point
ImageKind = Literal["raw", "pinhole"]
"""The recorded image with lens distortion, or a pinhole image with the same intrinsics."""

RADAR_FROM_LIDAR_M = (-2.54, 0.3, 0.0)
"""Translation from the LiDAR frame to the ego frame, `p_ego = p_lidar + translation`.

x and y are those of every sequence's `calib_radar_lidar.txt`, z is RADE-Net's. K-Radar's
loaders use `KRADAR_RADAR_FROM_LIDAR_Z_M` for the z of boxes too.
"""

KRADAR_RADAR_FROM_LIDAR_Z_M = 0.7
"""Height in meters of K-Radar's LiDAR above its radar, as in K-Radar's own loaders.

Radar directions are projected with this height, independently of the origin of the boxes' z.
"""

_ANGLES = ("yaw_ldr2cam", "pitch_ldr2cam", "roll_ldr2cam")
_SHIFTS = ("x_ldr2cam", "y_ldr2cam", "z_ldr2cam")
_LENS = ("k1", "k2", "k3", "k4", "k5")
_PINHOLE = ("fx", "fy", "px", "py")
_KEYS = _PINHOLE + _LENS + _ANGLES + _SHIFTS

LOOKING_AHEAD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""Rotation from LiDAR axes to the axes of a camera that looks straight ahead."""

_MAX_PIXELS = 1 << 16
_AZIMUTHS_DEG = range(-30, 31, 5)
_MAX_VALUE = 1e9  # far beyond pixels, coefficients and meters of any camera

# Pairs of corner indices in the order of `boxes.corners`.
_BOX_EDGES = np.array(
    [(i, (i + 1) % 4) for i in range(4)]
    + [(4 + i, 4 + (i + 1) % 4) for i in range(4)]
    + [(i, 4 + i) for i in range(4)]
)


class Camera(struct.PyTreeNode):
    """A pytree of one calibrated camera, or of a batch of them, for jitted code.

    Attributes:
        cam_from_ego: `[..., 3, 4]` rotation and translation, meters.
        intrinsics: `[..., 4]` fx, fy, cx, cy in pixels.
        distortion: `[..., 5]` k1, k2, p1, p2, k3 in OpenCV's order; zeros for an image
            without distortion.
        max_radius: `[...]` largest tangent of the viewing angle at which the distortion
            is still one-to-one.
        size_px: `[..., 2]` width and height of the image.
        is_valid: `[...]` bool, False where the frame has no usable image.
    """

    # Leaves are not validated: JAX also rebuilds the tree with shapes, specs or None.
    cam_from_ego: Array
    intrinsics: Array
    distortion: Array
    max_radius: Array
    size_px: Array
    is_valid: Array


def project(
    points_ego: Real[ArrayT, "*points 3"], camera: Camera, depth_offset_m: float = 0.0
) -> tuple[Float[ArrayT, "*points 2"], Float[ArrayT, "*points"]]:
    """Projects points of the ego frame into the image.

    With `(x, y, z) = cam_from_ego (p, 1)` and `(x', y') = d(x/z, y/z)`, the pixel is
    `u = fx x' + cx`, `v = fy y' + cy`, where d is the lens distortion (Brown's model as
    in OpenCV).

    Args:
        points_ego: `[..., 3]` meters.
        camera: A single camera, or a batch whose axes equal the leading axes of the points.
        depth_offset_m: Offset added to the depth before the division; the released
            DinoRADE adds 1e-6.

    Returns:
        Pixels `[..., 2]` (u, v) and depth `[...]` in meters. Where the depth is not
        positive, the pixels are finite but meaningless.

    Raises:
        AssertionError: The points are not `[..., 3]`, or their leading axes differ from
            those of the camera batch.

    Examples:
        >>> lens = np.array([100.0, 100, 320, 240])
        >>> camera = Camera(np.eye(3, 4), lens, np.zeros(5), 9.0, np.array([640, 480]), True)
        >>> pixels, depth = project(np.array([1.0, 0, 5]), camera)
        >>> pixels.tolist(), float(depth)
        ([340.0, 240.0], 5.0)
    """
    chex.assert_shape(points_ego, (*np.shape(camera.max_radius), ..., 3))
    points_cam = to_camera(points_ego, camera)
    return to_pixels(points_cam, camera, depth_offset_m), points_cam[..., 2]


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """Stacks single cameras into a batch, with float32 arrays (`is_valid` stays bool).

    Examples:
        >>> one = Camera(np.eye(3, 4), np.ones(4), np.zeros(5), 9.0, np.ones(2), True)
        >>> stack_cameras([one, one]).cam_from_ego.shape
        (2, 3, 4)
    """

    def stack(*leaves: ArrayLike) -> np.ndarray:
        stacked = np.stack(leaves)
        return stacked if stacked.dtype == bool else stacked.astype(np.float32)

    batch: Camera = jax.tree.map(stack, *cameras)
    return batch


def to_camera(
    points: Real[ArrayT, "*points 3"], camera: Camera
) -> Float[ArrayT, "*points 3"]:
    """Transforms points `[..., 3]` in meters from the ego frame to the camera frame.

    Args:
        points: Points x (forward), y (left), z (up) in the ego frame.
        camera: One camera or a batch, see `project`.

    Returns:
        Points x (right), y (down), z (depth) in meters in the camera frame.

    Examples:
        >>> raised = np.column_stack([np.eye(3), [0, 0, 2.0]])
        >>> one = Camera(raised, np.ones(4), np.zeros(5), 9.0, np.ones(2), True)
        >>> to_camera(np.array([1.0, 0, 5]), one).tolist()
        [1.0, 0.0, 7.0]
    """
    xp = array_module(points, camera.cam_from_ego)
    # Axes of several points of a camera come after those of a batch of cameras.
    axes = tuple(range(camera.cam_from_ego.ndim - 2, points.ndim - 1))
    transform = xp.expand_dims(camera.cam_from_ego, axes)
    # Accelerators may compute a matrix product in reduced precision, unlike this sum.
    turned = xp.sum(transform[..., :3] * points[..., None, :], -1)
    moved: ArrayT = turned + transform[..., 3]
    return moved


def to_pixels(
    points_cam: Float[ArrayT, "*points 3"], camera: Camera, depth_offset_m: float
) -> Float[ArrayT, "*points 2"]:
    """Projects points `[..., 3]` of the camera frame to pixels `[..., 2]`; see `project`.

    Args:
        points_cam: Points in meters, as `to_camera` returns them.
        camera: One camera or a batch, see `project`.
        depth_offset_m: Addend of the depth in the division, see `project`.

    Examples:
        >>> lens = np.array([100.0, 100, 320, 240])
        >>> one = Camera(np.eye(3, 4), lens, np.zeros(5), 9.0, np.array([640, 480]), True)
        >>> to_pixels(np.array([1.0, 0, 5]), one, 0.0).tolist()
        [340.0, 240.0]
    """
    xp = array_module(points_cam, camera.intrinsics)
    depth = points_cam[..., 2] + depth_offset_m
    depth = xp.where(depth == 0, 1e-12, depth)
    axes = tuple(range(np.ndim(camera.max_radius), depth.ndim))
    focal = xp.expand_dims(camera.intrinsics, axes)
    lens = xp.expand_dims(camera.distortion, axes)
    fx, fy, cx, cy = (focal[..., i] for i in range(4))
    k1, k2, p1, p2, k3 = (lens[..., i] for i in range(5))
    x = points_cam[..., 0] / depth
    y = points_cam[..., 1] / depth
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    x_seen = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    y_seen = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    # Beyond `max_radius` the distortion polynomial would map points back into the image, so
    # they are moved far outside it.
    folds = square > xp.expand_dims(camera.max_radius, axes) ** 2
    x_seen = xp.where(folds, x * 1e3, x_seen)
    y_seen = xp.where(folds, y * 1e3, y_seen)
    pixels: ArrayT = xp.stack([fx * x_seen + cx, fy * y_seen + cy], -1)
    return pixels


@dataclasses.dataclass(frozen=True, eq=False)
class CameraCalibration(ArrayValues):
    """The calibration of one camera in float64, compared and hashed by value.

    Attributes:
        intrinsics: `[4]` fx, fy, cx, cy of the raw image, pixels.
        distortion: `[5]` k1, k2, p1, p2, k3 in OpenCV's order.
        rotation: `[3, 3]` rotation from LiDAR (or ego) axes to camera axes.
        translation_m: `[3]` translation in camera axes, `p_cam = rotation @ p_lidar +
            translation_m`.
        width: Image width in pixels.
        height: Image height in pixels.
        radar_from_lidar_m: `[3]` translation, `p_ego = p_lidar + radar_from_lidar_m`.

    Raises:
        UserError: A value is not finite, or a size or focal length is not positive.
    """

    intrinsics: Float[np.ndarray, "4"]
    distortion: Float[np.ndarray, "5"]
    rotation: Float[np.ndarray, "3 3"]
    translation_m: Float[np.ndarray, "3"]
    width: int = 1280
    height: int = 720
    # `__post_init__` converts the tuple to an array.
    radar_from_lidar_m: Float[np.ndarray, "3"] = RADAR_FROM_LIDAR_M  # type: ignore[assignment]

    def __post_init__(self) -> None:
        shapes = {"intrinsics": (4,), "distortion": (5,), "rotation": (3, 3)}
        shapes |= dict.fromkeys(("translation_m", "radar_from_lidar_m"), (3,))
        for name, shape in shapes.items():
            value = self.freeze(name)
            is_fine = value.shape == shape and bool((np.abs(value) <= _MAX_VALUE).all())
            require(is_fine, name, value.tolist(), f"{shape} finite numbers")
        for name in ("width", "height"):
            size = getattr(self, name)
            require(0 < size <= _MAX_PIXELS, name, size, f"1 to {_MAX_PIXELS} pixels")
        focal = self.intrinsics[:2]
        require(bool((focal > 0).all()), "focal length", focal.tolist(), "above 0")

    # Construction --------------------------------------------------------------------

    @classmethod
    def from_angles(
        cls,
        *,
        intrinsics: Sequence[float],
        yaw_deg: float,
        pitch_deg: float,
        roll_deg: float,
        translation_m: Sequence[float],
        distortion: Sequence[float] = (0.0,) * 5,
        **fields: Any,
    ) -> CameraCalibration:
        """Creates a calibration from K-Radar's angles.

        The rotation is Rx(roll) Ry(pitch) Rz(yaw). A camera that looks straight ahead has
        yaw 90, pitch 0 and roll 90 degrees.
        """
        rx = _rotation(0, math.radians(roll_deg))
        ry = _rotation(1, math.radians(pitch_deg))
        rz = _rotation(2, math.radians(yaw_deg))
        return cls(
            intrinsics=np.asarray(intrinsics),
            distortion=np.asarray(distortion),
            rotation=rx @ ry @ rz,
            translation_m=np.asarray(translation_m),
            **fields,
        )

    @classmethod
    def from_kradar(
        cls,
        path: str | pathlib.Path,
        radar_from_lidar_m: Sequence[float] = RADAR_FROM_LIDAR_M,
    ) -> CameraCalibration:
        """Reads one of K-Radar's `cam_*.yml` files, of one sequence or of all.

        K-Radar's calibration tool writes angles relative to a camera that looks straight
        ahead (`cam_calib/from_gui_tool`). As the roll of an upright camera is about 90
        degrees otherwise, angles with a roll of less than 45 degrees are read as relative.

        Args:
            path: Path of the file, which has one `key: number` per line.
            radar_from_lidar_m: The attribute of the same name.

        Raises:
            FileNotFoundError: The file does not exist.
            DataError: A line is not `key: number`, a key is missing or a value is out of
                range. The message names the file.
        """
        values = _read_numbers(as_path(path))
        if missing := [key for key in _KEYS if key not in values]:
            raise DataError(f"{path}: camera calibration lacks {', '.join(missing)}")
        yaw, pitch, roll = (values[key] for key in _ANGLES)
        try:
            calibration = cls.from_angles(
                intrinsics=[values[key] for key in _PINHOLE],
                distortion=[values[key] for key in _LENS],
                yaw_deg=yaw,
                pitch_deg=pitch,
                roll_deg=roll,
                translation_m=[values[key] for key in _SHIFTS],
                width=int(values.get("img_size_w", 1280)),
                height=int(values.get("img_size_h", 720)),
                radar_from_lidar_m=radar_from_lidar_m,
            )
        except ValueError as error:
            raise DataError(f"{path}: {error}") from None
        if abs(roll) >= 45:
            return calibration
        rotation = calibration.rotation @ LOOKING_AHEAD
        return dataclasses.replace(calibration, rotation=rotation)

    def to_kradar_text(self) -> str:
        """Returns the content of a K-Radar calibration file, which `from_kradar` reads."""
        pitch = math.asin(np.clip(self.rotation[0, 2], -1.0, 1.0))
        yaw = math.atan2(-self.rotation[0, 1], self.rotation[0, 0])
        roll = math.atan2(-self.rotation[1, 2], self.rotation[2, 2])
        angles_deg = np.degrees([yaw, pitch, roll])
        numbers = *self.intrinsics, *self.distortion, *angles_deg, *self.translation_m
        lines = [f"{k}: {float(v)!r}" for k, v in zip(_KEYS, numbers, strict=True)]
        lines += [f"img_size_h: {self.height}", f"img_size_w: {self.width}"]
        return "\n".join(lines) + "\n"

    def resized(self, width: int, height: int) -> CameraCalibration:
        """Returns the calibration of the image after resizing it, without cropping.

        Args:
            width: New width in pixels.
            height: New height in pixels.
        """
        scale = np.array([width / self.width, height / self.height] * 2)
        intrinsics = self.intrinsics * scale
        return dataclasses.replace(
            self, width=width, height=height, intrinsics=intrinsics
        )

    # Use -----------------------------------------------------------------------------

    def require_centered(self, source: object) -> None:
        """Raises a `DataError` if intrinsics and size seem to be of different images.

        The principal point must be in the middle third of the width and within the height,
        of which a part above or below may have been cut off.

        Args:
            source: Name of the calibration for the error message.
        """
        cx, cy = self.intrinsics[2:].tolist()
        if not (abs(cx / self.width - 0.5) <= 1 / 6 and 0 <= cy <= self.height):
            raise DataError(
                f"{source}: principal point {cx:.5g}, {cy:.5g} in an image of {self.width} x "
                f"{self.height} pixels, expected one in the middle third of the width and "
                "within the height: give intrinsics and size of the same image"
            )

    def require_view_ahead(self, source: object) -> None:
        """Raises a `DataError` unless a front camera can see objects ahead of the radar.

        Intrinsics and size must also fit together, see `require_centered`.

        Args:
            source: Name of the calibration for the error message.
        """
        self.require_centered(source)
        range_m, azimuth_rad = np.meshgrid(
            np.arange(5.0, 61), np.deg2rad(_AZIMUTHS_DEG)
        )
        x_m = range_m * np.cos(azimuth_rad)
        ahead = np.stack([x_m, range_m * np.sin(azimuth_rad), np.zeros_like(x_m)], -1)
        if not self.in_image(*self.project_ego(ahead)).any():
            raise DataError(
                f"{source}: not the calibration of a front camera: nothing that is 5 to "
                "60 m ahead is in the image"
            )

    def camera(self, image: ImageKind = "raw", *, is_valid: bool = True) -> Camera:
        """Returns the pytree with which jitted code projects onto one kind of image.

        Args:
            image: "raw" is the image as recorded, with lens distortion; "pinhole" uses the
                same intrinsics without distortion, as the released DinoRADE does.
            is_valid: False marks a frame without an image.

        Raises:
            UserError: There is no such kind of image.
        """
        kinds = get_args(ImageKind)
        require(image in kinds, "image", image, f"one of {', '.join(kinds)}")
        shift = self.translation_m - self.rotation @ self.radar_from_lidar_m
        distortion = self.distortion if image == "raw" else np.zeros(5)
        return Camera(
            cam_from_ego=np.concatenate([self.rotation, shift[:, None]], 1),
            intrinsics=self.intrinsics,
            distortion=distortion,
            max_radius=np.array(_fold_radius(distortion)),
            size_px=np.array([self.width, self.height], np.float64),
            is_valid=np.array(is_valid),
        )

    def project_ego(
        self, points_ego: Real[np.ndarray, "*points 3"], image: ImageKind = "raw"
    ) -> tuple[Pixels, Depths]:
        """Projects ego-frame points `[..., 3]` to pixels `[..., 2]` and depth `[...]` in meters.

        Pixels are meaningless where the depth is not positive; see `in_image`.
        """
        return project(np.asarray(points_ego, np.float64), self.camera(image))

    def in_image(self, pixels: Pixels, depth_m: Depths) -> IsInImage:
        """Returns True where projected points lie in front of the camera and in the image."""
        inside = (pixels >= 0) & (pixels < np.array([self.width, self.height]))
        return inside.all(-1) & (depth_m > 0)

    def project_boxes(
        self, boxes: Real[np.ndarray, "N 7"], near_m: float = 0.1
    ) -> tuple[Float[np.ndarray, "N 12 2 2"], Bool[np.ndarray, "N 12"]]:
        """Projects the edges of boxes to line segments on the raw image, for drawing.

        Edges that pass behind the camera are clipped at the near plane.

        Args:
            boxes: `[N, 7]` x, y, z, l, w, h, yaw in the ego frame, full extents.
            near_m: Depth of the near plane in meters.

        Returns:
            Segments `[N, 12, 2, 2]` (box, edge, end, u and v) in pixels of the raw image,
            and `[N, 12]` bool, False for edges entirely behind the near plane. Lens
            distortion applies to the ends only; the segments between them are straight.
        """
        camera = self.camera()
        corners_cam = to_camera(corners(np.asarray(boxes, np.float64)), camera)
        ends = corners_cam[:, _BOX_EDGES]  # [N, 12, 2, 3]
        depth = ends[..., 2]
        is_visible = np.any(depth > near_m, axis=-1)
        # Ends behind the near plane move along their edge onto the plane.
        span = depth[..., ::-1] - depth
        safe = np.where(span == 0, 1.0, span)
        part = np.where(depth < near_m, (near_m - depth) / safe, 0.0)
        ends = ends + np.clip(part, 0, 1)[..., None] * (ends[..., ::-1, :] - ends)
        return to_pixels(ends, camera, 0.0), is_visible


def _fold_radius(distortion: Float[np.ndarray, "5"]) -> float:
    """Returns the smallest radius at which the distorted radius stops growing.

    If it grows everywhere, the result is 1e6.
    """
    k1, k2, _, _, k3 = distortion
    # The polynomial is written in 1 / radius^2, so that its leading coefficient is 1 even
    # if all the others are 0.
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-12)]
    return 1 / math.sqrt(real.max()) if real.size else 1e6


def _rotation(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    """Returns the right-handed rotation by `angle` radians about axis 0 (x), 1 (y) or 2 (z)."""
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i] = math.sin(angle)
    matrix[i, j] = -math.sin(angle)
    return matrix


def _read_numbers(path: pathlib.Path) -> dict[str, float]:
    """Reads a file of `key: number` lines.

    The files are not read with a YAML library because YAML 1.1 reads `1e-05` as text.
    """
    values = {}
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        key, _, value = line.partition(":")
        try:
            values[key.strip()] = float(value)
        except ValueError:
            raise DataError(
                f"{path}:{number}: expected 'key: number', found {line[:80]!r}"
            ) from None
    if bad := [key for key, value in values.items() if not abs(value) <= _MAX_VALUE]:
        raise DataError(f"{path}: {bad[0]} is {values[bad[0]]}, not a finite number")
    return values
