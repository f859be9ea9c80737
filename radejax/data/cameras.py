"""The camera of every frame of a data set, as the model wants it."""

from __future__ import annotations

import functools
import logging
from collections.abc import Container, Sequence

import numpy as np

from radejax.core.errors import UserError
from radejax.data.kradar.frame import Frame
from radejax.geometry.calibration import CameraCalibration, ImageKind
from radejax.geometry.camera import Camera

_log = logging.getLogger(__name__)


def frame_cameras(
    frames: Sequence[Frame],
    image_size: tuple[int, int],
    *,
    projection: ImageKind = "raw",
    ego_from_lidar_m: Sequence[float] | None = None,
    resize: bool = False,
    allow_missing: bool = False,
    embedded: Container[str] = (),
) -> list[Camera]:
    """Cameras of left front images, each calibration file read once.

    Args:
        frames: Of a data set.
        image_size: Height and width of the images that the model sees.
        projection: Kind of image, see `CameraCalibration.camera`.
        ego_from_lidar_m: Shift from LiDAR to radar; None takes each frame's own, the
            one that its boxes were moved by.
        resize: Images of another size are resized, and their calibration with them.
        allow_missing: Frames without an image or a calibration get a camera whose
            `is_valid` is False; how many is logged. Otherwise they are an error.
        embedded: Keys of frames whose image is not needed, being embedded already.

    Returns:
        One camera a frame, NumPy float64.

    Raises:
        UserError: A frame has no image or calibration, and not `allow_missing`; or the
            calibration is of images of another size, and not `resize`.
        DataError: A calibration file is damaged.
    """
    height, width = image_size

    def has_none(frame: Frame) -> bool:
        has_image = frame.camera_path is not None or frame.key in embedded
        return not has_image or frame.camera_calibration_path is None

    missing = [frame.key for frame in frames if has_none(frame)]
    if missing and not allow_missing:
        raise UserError(
            f"{len(missing)} of {len(frames)} frames have no front image or no camera "
            f"calibration, the first is {missing[0]}; "
            "config.data.camera.allow_missing=True goes by the radar alone there"
        )
    if missing:
        _log.warning(
            "%d of %d frames have no front image or no camera calibration: radar alone",
            len(missing),
            len(frames),
        )

    @functools.cache
    def read(path: str, shift: tuple[float, ...]) -> Camera:
        calibration = CameraCalibration.from_kradar(path, ego_from_lidar_m=shift)
        if (calibration.height, calibration.width) != (height, width):
            if not resize:
                raise UserError(
                    f"{path}: calibration of {calibration.width} x "
                    f"{calibration.height} images, the model sees {width} x {height} "
                    "(config.model.image.size); config.data.camera.resize=True resizes"
                )
            calibration = calibration.resized(width, height)
        return calibration.camera(projection)

    def camera(frame: Frame) -> Camera:
        if has_none(frame):
            return no_camera(image_size)
        shift = ego_from_lidar_m or frame.radar_from_lidar_m
        return read(str(frame.camera_calibration_path), tuple(map(float, shift)))

    return [camera(frame) for frame in frames]


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
