"""Front images and cameras of frames for models and figures."""

from __future__ import annotations

import dataclasses
import io
import math
import pathlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8

from radejax.core import errors
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, one_of, or_none
from radejax.geometry.camera import (
    LOOKING_AHEAD,
    Camera,
    CameraCalibration,
    ImageKind,
    stack_cameras,
)

_FINITE: errors.Range = math.isfinite, "a finite number"
_OPTIONS = {
    "projection": one_of("raw", "pinhole"),
    "calibration": one_of("sequence", "common"),
    "radar_from_lidar_m": or_none(errors.several(_FINITE, "three finite numbers", 3)),
    "radar_from_lidar_z_m": or_none(_FINITE),
}

IMAGE_SIZE = (720, 1280)
"""Height and width of the left half of K-Radar's 2560 x 720 stereo images."""


def read_left_image(
    path: pathlib.Path,
    size: tuple[int, int] = IMAGE_SIZE,
    *,
    resize: bool = False,
    calibrated_size: tuple[int, int] | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """Reads the left image from a front image file (a stereo pair or the left image only).

    Args:
        path: Image file. 16-bit gray levels are divided by 256.
        size: Height and width of the result.
        resize: Whether to resize images of other sizes to `size` with a box filter.
        calibrated_size: Height and width of the images of the camera calibration, or None
            if they are `size`. An image whose aspect ratio is closer to twice that of
            these images is a stereo pair.

    Raises:
        DataError: The file is corrupted, or the image has another size and `resize` is
            False.
    """
    from PIL import Image

    height, width = size
    with (
        wrap_read_errors(path, "a readable image"),
        # Pillow decodes from memory: reading from a file, it would try to allocate the
        # size that a corrupted chunk claims, up to 4 GB.
        Image.open(io.BytesIO(path.read_bytes())) as file,
    ):
        found = file.size
        if not resize and found not in ((2 * width, height), (width, height)):
            raise DataError(
                f"{path}: {found[0]} x {found[1]} pixels, expected "
                f"{2 * width} x {height} (stereo) or {width} x {height}"
            )
        high, wide = calibrated_size or size
        is_pair = found[0] * high > math.sqrt(2) * wide * found[1]
        left = (0, 0, found[0] // 2 if is_pair else found[0], found[1])
        if file.mode.startswith("I"):  # 16 bits, which Pillow would clip to 255
            levels = np.asarray(file) >> 8
            image = Image.fromarray(levels.astype(np.uint8)).convert("RGB")
        else:
            image = file.convert("RGB")
        image = image.crop(left)
        if image.size != (width, height):
            image = image.resize((width, height), Image.Resampling.BOX)
        return np.asarray(image)


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """Options for images and calibrations (`config.data.camera`).

    Attributes:
        projection: "raw" or "pinhole" (see `CameraCalibration.camera`).
        radar_from_lidar_m: Translation t of `p_radar = p_lidar + t` for all frames, or
            None for each frame's own.
        radar_from_lidar_z_m: z of each frame's own t in the camera projection, or None
            for the z of the mounting positions. The boxes are not moved by it. Unused
            with `radar_from_lidar_m`.
        calibration: "sequence" for the calibration file of each sequence, if it has one;
            "common" for `cam_front0.yml` in all sequences, as in the released code.
        resize: Whether to resize images (and their calibrations) of another size than
            the model's; otherwise such an image is an error.
        allow_missing: Whether frames without an image or a calibration are predicted
            from the radar only; otherwise such a frame is an error.

    Raises:
        UserError: An option has an invalid value.
    """

    projection: ImageKind = "raw"
    radar_from_lidar_m: tuple[float, float, float] | None = None
    radar_from_lidar_z_m: float | None = None
    calibration: Literal["sequence", "common"] = "sequence"
    resize: bool = False
    allow_missing: bool = True

    def __post_init__(self) -> None:
        errors.check_options(vars(self), "config.data.camera", _OPTIONS)

    @classmethod
    def from_config(cls, data: Mapping[str, Any]) -> CameraOptions:
        """Returns the options in `config.data`, or the defaults if it has no camera."""
        return cls(**data.get("camera", {}))

    def shift(self, own_m: Any, own_z_m: float) -> tuple[float, ...]:
        """Returns the translation t of `p_radar = p_lidar + t` for one frame.

        Args:
            own_m: The frame's own t.
            own_z_m: z of the frame's t according to the mounting positions.
        """
        if self.radar_from_lidar_m is not None:
            return tuple(map(float, self.radar_from_lidar_m))
        z = self.radar_from_lidar_z_m
        return tuple(map(float, (*own_m[:2], own_z_m if z is None else z)))


def no_camera(image_size: tuple[int, int]) -> Camera:
    """Returns a placeholder camera for frames without one.

    All its values are finite, and its `is_valid` is False.
    """
    height, width = image_size
    calibration = CameraCalibration(
        intrinsics=np.array([width, width, width / 2, height / 2]),
        distortion=np.zeros(5),
        rotation=LOOKING_AHEAD,
        translation_m=np.zeros(3),
        width=width,
        height=height,
    )
    return calibration.camera("raw", is_valid=False)


def no_images(
    count: int, image_size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "{count} H W 3"], Camera]:
    """Returns black images and a batch of invalid cameras in the shapes of real ones."""
    image = np.zeros((count, *image_size, 3), np.uint8)
    return image, stack_cameras([no_camera(image_size)] * count)
