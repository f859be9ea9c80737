"""Front images and cameras of frames, as models and drawings want them."""

from __future__ import annotations

import dataclasses
import io
import math
import pathlib
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import UInt8

from radejax.core.errors import (
    DataError,
    Range,
    check_options,
    one_of,
    or_none,
    several,
)
from radejax.geometry.camera import Camera, CameraCalibration, ImageKind

_FINITE: Range = math.isfinite, "a finite number"
_OPTIONS = {
    "projection": one_of("raw", "pinhole"),
    "calibration": one_of("sequence", "common"),
    "radar_from_lidar_m": or_none(several(_FINITE, "three finite numbers", 3)),
    "radar_from_lidar_z_m": or_none(_FINITE),
}

IMAGE_SIZE = (720, 1280)
"""Height and width of the left half of K-Radar's 2560 x 720 stereo images."""


def read_left_image(
    path: pathlib.Path, size: tuple[int, int] = IMAGE_SIZE, *, resize: bool = False
) -> UInt8[np.ndarray, "H W 3"]:
    """Left half of a front image (a stereo pair, or left only).

    Args:
        path: Image file. An image more than twice as wide as high is a stereo pair.
        size: Height and width of the result.
        resize: Bring other sizes to `size`, averaging where they are larger.

    Raises:
        DataError: The file is corrupted, or of another size and not `resize`.
    """
    from PIL import Image

    height, width = size
    try:
        # From memory: of a file, a chunk that claims 4 GB is asked for whole.
        with Image.open(io.BytesIO(path.read_bytes())) as file:
            found = file.size
            if not resize and found not in ((2 * width, height), (width, height)):
                raise DataError(
                    f"{path}: {found[0]} x {found[1]} pixels, expected "
                    f"{2 * width} x {height} (stereo) or {width} x {height}"
                )
            is_pair = found[0] > 2 * found[1] if resize else found[0] == 2 * width
            left = (0, 0, found[0] // 2 if is_pair else found[0], found[1])
            image = file.convert("RGB").crop(left)
            if image.size != (width, height):
                image = image.resize((width, height), Image.Resampling.BOX)
            return np.asarray(image)
    except DataError:
        raise
    except Exception as error:  # Pillow's decoders raise nearly anything
        raise DataError(f"{path}: corrupted image ({error})") from None


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """How images and calibrations are used: `config.data.camera`.

    Attributes:
        projection: "raw" or "pinhole", see `CameraCalibration.camera`.
        radar_from_lidar_m: t of `p_radar = p_lidar + t` for all frames; None: each
            frame's own.
        radar_from_lidar_z_m: z of each frame's own t, which boxes are not moved by;
            None: as the sensors are mounted. Unused with `radar_from_lidar_m`.
        calibration: "sequence" for each sequence's own file, where it has one;
            "common" for `cam_front0.yml` everywhere, as released.
        resize: Image files of another size than the model's are resized, and their
            calibration with them; otherwise they are an error.
        allow_missing: Frames without an image are predicted from the radar only and
            counted; otherwise they are an error.

    Raises:
        UserError: An option is out of its range.
    """

    projection: ImageKind = "raw"
    radar_from_lidar_m: tuple[float, float, float] | None = None
    radar_from_lidar_z_m: float | None = None
    calibration: Literal["sequence", "common"] = "sequence"
    resize: bool = False
    allow_missing: bool = True

    def __post_init__(self) -> None:
        check_options(vars(self), "config.data.camera", _OPTIONS)

    @classmethod
    def from_config(cls, data: Mapping[str, Any]) -> CameraOptions:
        """Options of `config.data`; the defaults where it has no camera."""
        return cls(**data.get("camera", {}))

    def shift(self, own_m: Any, own_z_m: float) -> tuple[float, ...]:
        """t of `p_radar = p_lidar + t` from a frame's own t and the height in it."""
        if self.radar_from_lidar_m is not None:
            return tuple(map(float, self.radar_from_lidar_m))
        z = self.radar_from_lidar_z_m
        return tuple(map(float, (*own_m[:2], own_z_m if z is None else z)))


def no_camera(image_size: tuple[int, int]) -> Camera:
    """Stands for the camera of a frame that has none: finite numbers, not valid."""
    height, width = image_size
    calibration = CameraCalibration(
        intrinsics=np.array([width, width, width / 2, height / 2]),
        distortion=np.zeros(5),
        rotation=np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        translation_m=np.zeros(3),
        width=width,
        height=height,
    )
    return calibration.camera("raw", is_valid=False)
