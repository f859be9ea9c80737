"""Calibration of a camera: from K-Radar's files to what projects points onto an image.

Frames: LiDAR and ego (radar) have parallel axes, x forward, y left, z up, and differ by
a translation; the camera frame is x right, y down, z forward (depth). Pixels count from
the upper left corner of the image, u to the right and v down. Host code uses
`CameraCalibration` (NumPy, float64); jitted code gets the same numbers as a
`camera_projection.Camera`.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Real

from radejax.geometry.boxes import corners
from radejax.geometry.camera import Camera, project, to_camera, to_pixels

ImageKind = Literal["raw", "rectified", "pinhole"]

EGO_FROM_LIDAR_M = (-2.54, 0.3, 0.0)
"""Ego = LiDAR + this, as in every sequence's `calib_radar_lidar.txt`; dz as RADE-Net.
the loaders of K-Radar have it for boxes too, see `KRADAR_LIDAR_TO_RADAR_Z_M`."""

KRADAR_LIDAR_TO_RADAR_Z_M = 0.7
"""Metres by which K-Radar's radar is below its LiDAR, as in K-Radar's own loaders: what
radar directions are projected with, whatever z boxes are counted from."""

KRADAR_RECTIFIED = (520.08203125, 562.506958008, 597.921967403, 374.688782302)
"""fx, fy, cx, cy of the undistorted front image as K-Radar stores them. Each version of
OpenCV computes other values: image and projection must use the same."""

_ANGLES = ("yaw_ldr2cam", "pitch_ldr2cam", "roll_ldr2cam")
_SHIFTS = ("x_ldr2cam", "y_ldr2cam", "z_ldr2cam")
_LENS = ("k1", "k2", "k3", "k4", "k5")
_PINHOLE = ("fx", "fy", "px", "py")

_MAX_PIXELS = 1 << 16
_MAX_NUMBER = 1e9  # in a file
_LIMITS = {  # far beyond what cameras have: pixels, coefficients, metres
    "intrinsics": 1e6,
    "distortion": 1e3,
    "rotation": 1.0 + 1e-6,
    "translation_m": 1e3,
    "ego_from_lidar_m": 1e3,
    "rectified": 1e6,
}

# Between the corners of `boxes.corners`.
_BOX_EDGES = np.array(
    [(i, (i + 1) % 4) for i in range(4)]
    + [(4 + i, 4 + (i + 1) % 4) for i in range(4)]
    + [(i, 4 + i) for i in range(4)]
)


class CalibrationError(ValueError):
    """No numbers or kind of image of a camera: of the user, see `core.errors`."""

    exit_code = 2


class CalibrationFileError(CalibrationError):
    """A calibration file that is malformed or incomplete; the message names it."""

    exit_code = 1


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

    intrinsics: Float[np.ndarray, "4"]
    distortion: Float[np.ndarray, "5"]
    rotation: Float[np.ndarray, "3 3"]
    translation_m: Float[np.ndarray, "3"]
    width: int = 1280
    height: int = 720
    # Arrays like the others once __post_init__ is through.
    ego_from_lidar_m: Float[np.ndarray, "3"] = EGO_FROM_LIDAR_M  # type: ignore[assignment]
    rectified: Float[np.ndarray, "4"] = KRADAR_RECTIFIED  # type: ignore[assignment]

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
            limit = _LIMITS[name]
            if value.shape != shape or not (np.abs(value) <= limit).all():
                raise CalibrationError(
                    f"{name} must be {shape} finite numbers up to {limit:g}, got "
                    f"{value.tolist()}"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if not (0 < self.width <= _MAX_PIXELS and 0 < self.height <= _MAX_PIXELS):
            raise CalibrationError(
                f"width and height must be 1 to {_MAX_PIXELS} pixels, got {self.width} x "
                f"{self.height}"
            )
        if min(*self.intrinsics[:2], *self.rectified[:2]) <= 0:
            raise CalibrationError(
                f"focal lengths must be positive, got {self.intrinsics[:2].tolist()} and "
                f"{self.rectified[:2].tolist()}"
            )

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
            CalibrationFileError: A line is not `key: number`, or a key is missing.
        """
        path = pathlib.Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"camera calibration {path} does not exist")
        values = _read_numbers(path)
        missing = [
            key for key in _PINHOLE + _LENS + _ANGLES + _SHIFTS if key not in values
        ]
        if missing:
            raise CalibrationFileError(
                f"{path}: camera calibration lacks {', '.join(missing)}"
            )
        yaw, pitch, roll = (values[key] for key in _ANGLES)
        size = {
            "width": int(values.get("img_size_w", 1280)),
            "height": int(values.get("img_size_h", 720)),
        }
        try:
            return cls.from_angles(
                intrinsics=[values[key] for key in _PINHOLE],
                distortion=[values[key] for key in _LENS],
                yaw_deg=yaw,
                pitch_deg=pitch,
                roll_deg=roll,
                translation_m=[values[key] for key in _SHIFTS],
                **(size | fields),
            )
        except CalibrationError as error:
            raise CalibrationFileError(f"{path}: {error}") from None

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
        self, points_ego: Real[np.ndarray, "*points 3"], image: ImageKind = "raw"
    ) -> tuple[Float[np.ndarray, "*points 2"], Float[np.ndarray, "*points"]]:
        """Pixels `[..., 2]` and depth `[...]` in metres of ego-frame points `[..., 3]`.

        Pixels mean nothing where the depth is not positive; see `in_image`.
        """
        return project(np.asarray(points_ego, np.float64), self.camera(image))

    def project_lidar(
        self, points_lidar: Real[np.ndarray, "*points 3"], image: ImageKind = "raw"
    ) -> tuple[Float[np.ndarray, "*points 2"], Float[np.ndarray, "*points"]]:
        """As `project_ego`, for points in the frame of K-Radar's label files."""
        points = np.asarray(points_lidar, np.float64) + self.ego_from_lidar_m
        return self.project_ego(points, image)

    def in_image(
        self,
        pixels: Real[np.ndarray, "*points 2"],
        depth_m: Real[np.ndarray, "*points"],
    ) -> Bool[Any, "*points"]:
        """True where projected points lie in front of the camera and in the image."""
        inside = (pixels >= 0) & (pixels < np.array([self.width, self.height]))
        return inside.all(-1) & (depth_m > 0)

    def project_boxes(
        self,
        boxes: Real[np.ndarray, "N 7"],
        image: ImageKind = "raw",
        near_m: float = 0.1,
    ) -> tuple[Float[np.ndarray, "N 12 2 2"], Bool[np.ndarray, "N 12"]]:
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
        corners_cam = to_camera(corners(np.asarray(boxes, np.float64)), camera)
        ends = corners_cam[:, _BOX_EDGES]  # [N, 12, 2, 3]
        depth = ends[..., 2]
        is_visible = (depth > near_m).any(-1)
        # Move an end behind the near plane along its edge, onto the plane.
        span = depth[..., ::-1] - depth
        safe = np.where(span == 0, 1.0, span)
        part = np.where(depth < near_m, (near_m - depth) / safe, 0.0)
        ends = ends + np.clip(part, 0, 1)[..., None] * (ends[..., ::-1, :] - ends)
        return to_pixels(ends, camera, 0.0), is_visible

    # Value semantics -----------------------------------------------------------------

    def _key(self) -> tuple[object, ...]:
        return tuple(
            v.tobytes() if isinstance(v, np.ndarray) else v
            for v in (getattr(self, f.name) for f in dataclasses.fields(self))
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, CameraCalibration) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


def _fold_radius(distortion: Float[np.ndarray, "5"]) -> float:
    """Smallest radius at which the radial distortion stops growing; large for none."""
    k1, k2, _, _, k3 = distortion
    # In 1 / radius^2: the first coefficient is one, however small the others are.
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-12)]
    return 1 / math.sqrt(real.max()) if real.size else 1e6


def _rotation(axis: int, angle: float) -> Float[np.ndarray, "3 3"]:
    """Right-handed rotation about a coordinate axis (0 x, 1 y, 2 z)."""
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = math.cos(angle)
    matrix[j, i], matrix[i, j] = math.sin(angle), -math.sin(angle)
    return matrix


def _read_numbers(path: pathlib.Path) -> dict[str, float]:
    values = {}
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CalibrationFileError(f"{path}: not a UTF-8 text file") from None
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        key, separator, value = line.partition(":")
        try:
            if not separator:
                raise ValueError
            values[key.strip()] = float(value)
            if not abs(values[key.strip()]) <= _MAX_NUMBER:
                raise ValueError
        except ValueError:
            raise CalibrationFileError(
                f"{path}:{number}: expected 'key: number' up to {_MAX_NUMBER:g}, found "
                f"{line[:80]!r}"
            ) from None
    return values


def _choose(name: str, **options: Any) -> Any:
    if name not in options:
        raise CalibrationError(
            f"image must be one of {', '.join(options)}, got {name!r}"
        )
    return options[name]
