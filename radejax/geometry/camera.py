"""Where points of the radar's world appear in the camera image.

Frames: LiDAR and ego (radar) have parallel axes, x forward, y left, z up, and differ by
a translation; the camera frame is x right, y down, z forward (depth). Pixels count from
the upper left corner of the image, u to the right and v down. Host code uses
`CameraCalibration` (NumPy, float64); jitted code gets the same numbers as a `Camera`.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from radejax.errors import DataError, UserError

ImageKind = Literal["raw", "rectified", "pinhole"]

EGO_FROM_LIDAR_M = (-2.54, 0.3, 0.0)
"""Ego = LiDAR + this, as in every sequence's `calib_radar_lidar.txt`; dz as RADE-Net.
K-Radar's loaders use dz = 0.7."""

KRADAR_RECTIFIED = (520.08203125, 562.506958008, 597.921967403, 374.688782302)
"""fx, fy, cx, cy of the undistorted front image as K-Radar stores them. Each version of
OpenCV computes other values: image and projection must use the same."""

_ANGLES = ("yaw_ldr2cam", "pitch_ldr2cam", "roll_ldr2cam")
_SHIFTS = ("x_ldr2cam", "y_ldr2cam", "z_ldr2cam")
_LENS = ("k1", "k2", "k3", "k4", "k5")
_PINHOLE = ("fx", "fy", "px", "py")

# Lower square, then upper square, counter-clockwise from the front left corner.
_SQUARE = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))
_UNIT_CORNERS = np.array([(x, y, z) for z in (-0.5, 0.5) for x, y in _SQUARE])
_BOX_EDGES = np.array(
    [(i, (i + 1) % 4) for i in range(4)]
    + [(4 + i, 4 + (i + 1) % 4) for i in range(4)]
    + [(i, 4 + i) for i in range(4)]
)


@struct.dataclass
class Camera:
    """A calibrated camera as arrays, one or a batch of them: a pytree for jitted code.

    Attributes:
        cam_from_ego: `[..., 3, 4]` rotation and translation, metres.
        intrinsics: `[..., 4]` fx, fy, cx, cy in pixels.
        distortion: `[..., 5]` k1, k2, p1, p2, k3 (OpenCV's order); zeros for none.
        max_radius: `[...]` largest tangent of the viewing angle at which the distortion
            is still one-to-one.
        size_px: `[..., 2]` width and height of the image.
        is_valid: `[...]` bool, False where the frame has no usable image.
    """

    cam_from_ego: Any
    intrinsics: Any
    distortion: Any
    max_radius: Any
    size_px: Any
    is_valid: Any


@dataclasses.dataclass(frozen=True, eq=False)
class CameraCalibration:
    """One camera's calibration, in float64. Compares and hashes by value.

    Attributes:
        intrinsics: `[4]` fx, fy, cx, cy of the raw image, pixels.
        distortion: `[5]` k1, k2, p1, p2, k3 in OpenCV's order.
        rotation: `[3, 3]` camera from LiDAR (or ego) axes.
        translation_m: `[3]` in camera axes: `p_cam = rotation @ p_lidar + translation`.
        width: Image width in pixels.
        height: Image height in pixels.
        ego_from_lidar_m: `[3]` shift with `p_ego = p_lidar + shift`.
        rectified: `[4]` fx, fy, cx, cy of the undistorted image.
    """

    intrinsics: np.ndarray
    distortion: np.ndarray
    rotation: np.ndarray
    translation_m: np.ndarray
    width: int = 1280
    height: int = 720
    ego_from_lidar_m: np.ndarray = EGO_FROM_LIDAR_M
    rectified: np.ndarray = KRADAR_RECTIFIED

    def __post_init__(self) -> None:
        shapes = {
            "intrinsics": (4,),
            "distortion": (5,),
            "rotation": (3, 3),
            "translation_m": (3,),
            "ego_from_lidar_m": (3,),
            "rectified": (4,),
        }
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise UserError(
                    f"{name} must be {shape} finite numbers, got {value.tolist()}"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)

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
        """Calibration from K-Radar's angles: rotation = Rx(roll) Ry(pitch) Rz(yaw).

        A camera that looks straight ahead has yaw 90, pitch 0 and roll 90 degrees.
        """
        rotation = (
            _rotation(0, math.radians(roll_deg))
            @ _rotation(1, math.radians(pitch_deg))
            @ _rotation(2, math.radians(yaw_deg))
        )
        return cls(
            intrinsics=np.asarray(intrinsics),
            distortion=np.asarray(distortion),
            rotation=rotation,
            translation_m=np.asarray(translation_m),
            **fields,
        )

    @classmethod
    def from_kradar(cls, path: str | pathlib.Path, **fields: Any) -> CameraCalibration:
        """Reads one of K-Radar's `cam_*.yml` files, per sequence or common.

        Args:
            path: The file: one `key: number` a line.
            **fields: Values for the remaining attributes, e.g. `ego_from_lidar_m`.

        Raises:
            FileNotFoundError: There is no such file.
            DataError: A line is not `key: number`, or a key is missing.
        """
        path = pathlib.Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"camera calibration {path} does not exist")
        values = _read_numbers(path)
        missing = [
            key for key in _PINHOLE + _LENS + _ANGLES + _SHIFTS if key not in values
        ]
        if missing:
            raise DataError(f"{path}: camera calibration lacks {', '.join(missing)}")
        yaw, pitch, roll = (values[key] for key in _ANGLES)
        size = {
            "width": int(values.get("img_size_w", 1280)),
            "height": int(values.get("img_size_h", 720)),
        }
        return cls.from_angles(
            intrinsics=[values[key] for key in _PINHOLE],
            distortion=[values[key] for key in _LENS],
            yaw_deg=yaw,
            pitch_deg=pitch,
            roll_deg=roll,
            translation_m=[values[key] for key in _SHIFTS],
            **(size | fields),
        )

    def to_kradar_text(self) -> str:
        """The content of a K-Radar calibration file; `from_kradar` reads it back."""
        pitch = math.asin(np.clip(self.rotation[0, 2], -1.0, 1.0))
        yaw = math.atan2(-self.rotation[0, 1], self.rotation[0, 0])
        roll = math.atan2(-self.rotation[1, 2], self.rotation[2, 2])
        keys = _PINHOLE + _LENS + _ANGLES + _SHIFTS
        numbers = [
            *self.intrinsics,
            *self.distortion,
            *np.degrees([yaw, pitch, roll]),
            *self.translation_m,
        ]
        lines = [f"{k}: {float(v)!r}" for k, v in zip(keys, numbers, strict=True)]
        lines += [f"img_size_h: {self.height}", f"img_size_w: {self.width}"]
        return "\n".join(lines) + "\n"

    def resized(self, width: int, height: int) -> CameraCalibration:
        """Calibration of the same image resized, edges onto edges."""
        scale = np.array([width / self.width, height / self.height] * 2)
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            intrinsics=self.intrinsics * scale,
            rectified=self.rectified * scale,
        )

    # Use -----------------------------------------------------------------------------

    def camera(self, image: ImageKind = "raw", *, is_valid: bool = True) -> Camera:
        """The numbers jitted code needs to project onto one kind of image.

        Args:
            image: "raw" is the image as recorded, with lens distortion; "rectified" one
                undistorted to the `rectified` matrix; "pinhole" the raw matrix without
                distortion, as the released DinoRADE projects.
            is_valid: False marks a frame without an image.
        """
        rotation, shift = self.rotation, self.translation_m
        shift = shift - rotation @ self.ego_from_lidar_m
        distortion = self.distortion if image == "raw" else np.zeros(5)
        return Camera(
            cam_from_ego=np.concatenate([rotation, shift[:, None]], 1),
            intrinsics=_choose(
                image,
                raw=self.intrinsics,
                rectified=self.rectified,
                pinhole=self.intrinsics,
            ),
            distortion=distortion,
            max_radius=np.float64(_fold_radius(distortion)),
            size_px=np.array([self.width, self.height], np.float64),
            is_valid=np.bool_(is_valid),
        )

    def project_ego(
        self, points_ego: np.ndarray, image: ImageKind = "raw"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pixels `[..., 2]` and depth `[...]` in metres of ego-frame points `[..., 3]`.

        Pixels mean nothing where the depth is not positive; see `in_image`.
        """
        return project(np.asarray(points_ego, np.float64), self.camera(image))

    def project_lidar(
        self, points_lidar: np.ndarray, image: ImageKind = "raw"
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `project_ego`, for points in the frame of K-Radar's label files."""
        points = np.asarray(points_lidar, np.float64) + self.ego_from_lidar_m
        return self.project_ego(points, image)

    def in_image(self, pixels: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
        """True where projected points lie in front of the camera and in the image."""
        inside = (pixels >= 0) & (pixels < np.array([self.width, self.height]))
        return inside.all(-1) & (depth_m > 0)

    def project_boxes(
        self, boxes: np.ndarray, image: ImageKind = "raw", near_m: float = 0.1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Edges of boxes as line segments on the image, for drawing.

        Edges that pass behind the camera are cut at the near plane.

        Args:
            boxes: `[N, 7]` x, y, z, l, w, h, yaw in the ego frame, full extents.
            image: Kind of image to draw on.
            near_m: Smallest depth that is drawn.

        Returns:
            Segments `[N, 12, 2, 2]` in pixels (edge, end, u and v; straight lines also
            on the raw image), and `[N, 12]` bool, False for edges out of sight.
        """
        camera = self.camera(image)
        corners = _box_corners(np.asarray(boxes, np.float64))
        corners_cam = _to_camera(corners, camera)
        ends = corners_cam[:, _BOX_EDGES]  # [N, 12, 2, 3]
        depth = ends[..., 2]
        is_visible = (depth > near_m).any(-1)
        # Move an end behind the near plane along its edge, onto the plane.
        span = depth[..., ::-1] - depth
        safe = np.where(span == 0, 1.0, span)
        part = np.where(depth < near_m, (near_m - depth) / safe, 0.0)
        ends = ends + np.clip(part, 0, 1)[..., None] * (ends[..., ::-1, :] - ends)
        return _to_pixels(ends, camera, 0.0), is_visible

    # Value semantics -----------------------------------------------------------------

    def _key(self) -> tuple:
        return tuple(
            v.tobytes() if isinstance(v, np.ndarray) else v
            for v in (getattr(self, f.name) for f in dataclasses.fields(self))
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CameraCalibration) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


# Projection, NumPy or JAX ------------------------------------------------------------


def project(
    points_ego: Any, camera: Camera, *, depth_offset_m: float = 0.0
) -> tuple[Any, Any]:
    """Pixels and depth of points in the ego frame.

    With `(x, y, z) = cam_from_ego (p, 1)`, the pixel is `fx d(x/z) + cx` and likewise
    for v, where d is the lens distortion (Brown's model as in OpenCV).

    Args:
        points_ego: `[..., 3]` metres.
        camera: A single camera, or a batch of them whose axes are the points' first.
        depth_offset_m: Added to the depth before the division; the released DinoRADE
            adds 1e-6.

    Returns:
        Pixels `[..., 2]` (u, v) and depth `[...]` in metres. Where the depth is not
        positive the pixels are finite but mean nothing.
    """
    points_cam = _to_camera(points_ego, camera)
    return _to_pixels(points_cam, camera, depth_offset_m), points_cam[..., 2]


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """A batch from single cameras, float32 as the accelerator computes."""

    def stack(*leaves: Any) -> np.ndarray:
        stacked = np.stack(leaves)
        return stacked if stacked.dtype == bool else stacked.astype(np.float32)

    return jax.tree.map(stack, *cameras)


def _to_camera(points: Any, camera: Camera) -> Any:
    xp = _array_module(points, camera.cam_from_ego)
    rotation, shift = camera.cam_from_ego[..., :3], camera.cam_from_ego[..., 3]
    batch = shift.shape[:-1]
    ones = (1,) * (points.ndim - shift.ndim)  # several points a camera
    rotation = xp.reshape(rotation, batch + ones + (3, 3))
    shift = xp.reshape(shift, batch + ones + (3,))
    # Products and sums rather than a matrix product, which accelerators may round.
    return xp.sum(rotation * points[..., None, :], -1) + shift


def _to_pixels(points_cam: Any, camera: Camera, depth_offset_m: float) -> Any:
    xp = _array_module(points_cam, camera.intrinsics)
    depth = points_cam[..., 2] + depth_offset_m
    depth = xp.where(depth == 0, 1e-12, depth)
    extra = depth.ndim - np.ndim(camera.max_radius)

    def spread(value: Any) -> Any:  # batch axes of the camera to the front
        return xp.reshape(value, np.shape(value) + (1,) * extra)

    fx, fy, cx, cy = (spread(camera.intrinsics[..., i]) for i in range(4))
    k1, k2, p1, p2, k3 = (spread(camera.distortion[..., i]) for i in range(5))
    x, y = points_cam[..., 0] / depth, points_cam[..., 1] / depth
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    x_seen = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    y_seen = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    # Past the fold the polynomial brings points back into the image: leave them out.
    folds = square > spread(camera.max_radius) ** 2
    x_seen, y_seen = xp.where(folds, x * 1e3, x_seen), xp.where(folds, y * 1e3, y_seen)
    return xp.stack([fx * x_seen + cx, fy * y_seen + cy], -1)


def _fold_radius(distortion: np.ndarray) -> float:
    """Smallest radius at which the radial distortion stops growing; large for none."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
    return math.sqrt(real.min()) if real.size else 1e6


def _box_corners(boxes: np.ndarray) -> np.ndarray:
    """Corners `[N, 8, 3]` of boxes `[N, 7]`."""
    local = _UNIT_CORNERS * boxes[:, None, 3:6]
    sin, cos = np.sin(boxes[:, 6:7]), np.cos(boxes[:, 6:7])
    x = local[..., 0] * cos - local[..., 1] * sin
    y = local[..., 0] * sin + local[..., 1] * cos
    return np.stack([x, y, local[..., 2]], -1) + boxes[:, None, :3]


def _rotation(axis: int, angle: float) -> np.ndarray:
    """Right-handed rotation about a coordinate axis (0 x, 1 y, 2 z)."""
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i], matrix[i, j] = math.sin(angle), -math.sin(angle)
    return matrix


def _read_numbers(path: pathlib.Path) -> dict[str, float]:
    values = {}
    for number, line in enumerate(path.read_text().splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        key, separator, value = line.partition(":")
        try:
            if not separator:
                raise ValueError
            values[key.strip()] = float(value)
        except ValueError:
            raise DataError(
                f"{path}:{number}: expected 'key: number', found {line!r}"
            ) from None
    return values


def _choose(name: str, **options: Any) -> Any:
    if name not in options:
        raise UserError(f"image must be one of {', '.join(options)}, got {name!r}")
    return options[name]


def _array_module(*values: Any) -> Any:
    on_host = all(isinstance(v, np.ndarray | np.generic | float | int) for v in values)
    return np if on_host else jnp
