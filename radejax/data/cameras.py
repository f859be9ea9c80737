"""Front images and cameras of frames for models and figures."""

from __future__ import annotations

import io
import math
import pathlib
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8

from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError
from radejax.core.options import Options
from radejax.geometry.camera import (
    LOOKING_AHEAD,
    Camera,
    CameraCalibration,
    ImageKind,
    stack_cameras,
)

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


class CameraOptions(Options, section="config.data.camera"):
    """Options of images and calibrations."""

    projection: ImageKind = "raw"
    """raw (with lens distortion) or pinhole (without, as released)."""
    radar_from_lidar_m: tuple[float, float, float] | None = None
    """Translation t of `p_radar = p_lidar + t` in meters for all frames; None: each
    frame's own."""
    radar_from_lidar_z_m: float | None = None
    """z of t in the camera projection, which does not move boxes; None: K-Radar's 0.7, or
    the simulation's. Unused with `radar_from_lidar_m`."""
    calibration: Literal["sequence", "common"] = "sequence"
    """sequence (each sequence's own) or common (cam_front0.yml, as released)."""
    resize: bool = False
    """Resize images, and their calibrations, of another size than `model.image.size`;
    otherwise such an image is an error."""
    allow_missing: bool = True
    """Predict frames without an image or a calibration from the radar only; otherwise such a
    frame is an error."""

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
