"""Front images and cameras of frames for models and figures."""

from __future__ import annotations

import dataclasses
import io
import logging
import math
import pathlib
from collections.abc import Sequence

import numpy as np
from jaxtyping import Real, UInt8

from radejax.core import manifest
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, UserError
from radejax.data.dataset import FrameSequence, LabeledFrame
from radejax.data.options import CameraOptions
from radejax.data.records import Records
from radejax.geometry.camera import (
    LOOKING_AHEAD,
    Camera,
    CameraCalibration,
    stack_cameras,
)

_log = logging.getLogger(__name__)

IMAGE_SIZE = (720, 1280)
"""Height and width of the left half of K-Radar's 2560 x 720 stereo images."""

_MAX_STRETCH = 0.02  # of the aspect ratio of images that were resized


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
        DataError: The file is corrupted, the image has another size and `resize` is
            False, or another aspect ratio than the calibration.
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
        if (
            calibrated_size
            and abs(left[2] * high / (wide * left[3]) - 1) > _MAX_STRETCH
        ):
            raise DataError(
                f"{path}: {left[2]} x {left[3]} pixels, but its camera calibration is for "
                f"{wide} x {high}, of another aspect ratio: give width, height and intrinsics "
                "of the image as it is stored"
            )
        if file.mode.startswith("I"):  # 16 bits, which Pillow would clip to 255
            levels = np.asarray(file) >> 8
            image = Image.fromarray(levels.astype(np.uint8)).convert("RGB")
        else:
            image = file.convert("RGB")
        image = image.crop(left)
        if image.size != (width, height):
            image = image.resize((width, height), Image.Resampling.BOX)
        return np.asarray(image)


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


def front_view(
    frame: LabeledFrame,
) -> tuple[UInt8[np.ndarray, "H W 3"] | None, CameraCalibration | None]:
    """Returns the left front image of a frame and its calibration for drawing.

    Args:
        frame: Frame of a dataset.

    Returns:
        The image, resized to the image size of the calibration, or to `IMAGE_SIZE` without
        one; and the calibration. Missing items are None, and both are None without an image.

    Raises:
        DataError: A file is corrupted, or the principal point is far from the middle.
    """
    if frame.camera_path is None:
        return None, None
    camera = None
    if frame.camera_calibration_path is not None:
        camera = frame.read_calibration()
        camera.require_centered(frame.camera_calibration_path)
    size = None if camera is None else (camera.height, camera.width)
    return read_left_image(
        frame.camera_path, size or IMAGE_SIZE, resize=True, calibrated_size=size
    ), camera


# Inputs of a model --------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class CameraInputs:
    """Camera inputs of a model: an image and a camera for every frame.

    Attributes:
        cameras: One camera per frame, NumPy float64. `is_valid` is False if the frame
            has no image or no calibration.
        image_size: Height and width of the images that the model receives.
        options: Options that the cameras were created with.
        features: Features from an image backbone that replace the images, or None.
        sources: For every frame, the path of its front image or the key of its
            features; None for frames without either.
        calibrated_sizes: For every frame, height and width of the images of its
            calibration; None for frames without one.
    """

    cameras: tuple[Camera, ...]
    image_size: tuple[int, int]
    options: CameraOptions
    features: Records | None
    sources: Sequence[pathlib.Path | str | None]
    calibrated_sizes: Sequence[tuple[int, int] | None]

    def empty_images(self, count: int) -> Real[np.ndarray, "{count} _ _ _"]:
        """Returns black images `[count, H, W, 3]` uint8, or features that are zero."""
        if self.features is not None:
            return np.zeros((count, *self.features.shape), self.features.dtype)
        return np.zeros((count, *self.image_size, 3), np.uint8)

    def image(self, index: int) -> Real[np.ndarray, "_ _ _"]:
        """Returns the image or features of one frame; zeros if they are missing."""
        source = self.sources[index]
        if source is None:
            return self.empty_images(1).squeeze(axis=0)
        if self.features is not None:
            return self.features[str(source)]
        return read_left_image(
            pathlib.Path(source),
            self.image_size,
            resize=self.options.resize,
            calibrated_size=self.calibrated_sizes[index],
        )


def camera_inputs(
    frames: FrameSequence,
    image_size: tuple[int, int],
    options: CameraOptions,
    features: Records | None = None,
) -> CameraInputs:
    """Returns the left front images and cameras of frames.

    Every calibration file is read only once.

    Args:
        frames: Frames of a dataset.
        image_size: Height and width of the images that the model receives.
        options: Camera options. With `allow_missing`, frames without an image or a
            calibration have a camera whose `is_valid` is False and, without an image, a
            black image; their number is logged.
        features: Output of `radejax embed` (see `open_embeddings`), or None. With
            features, the image files are not read.

    Raises:
        UserError: A frame has no image or calibration and `allow_missing` is False; a
            calibration is for another image size and `resize` is False; or an image is
            not among the features.
        DataError: A calibration file is corrupted, or its principal point is far from the
            middle of the image.
    """
    sources: list[pathlib.Path | str | None] = [frame.camera_path for frame in frames]
    if features is not None:
        keys = features.keys()
        sources = [frame.key if frame.key in keys else None for frame in frames]
        paths = {frame.key: frame.camera_path for frame in frames}
        manifest.warn_of_changes(features.folder, paths)
        with_image = [frame.key for frame in frames if frame.camera_path is not None]
        if absent := [key for key in with_image if key not in keys]:
            raise UserError(
                f"{features.folder}: {len(absent)} of {len(frames)} frames have an image "
                f"that is not embedded, the first is {absent[0]}; embed all of the data: "
                "`radejax embed`"
            )
    views: list[tuple[Camera, tuple[int, int] | None]] = []
    missing: list[str] = []
    known: dict[tuple[pathlib.Path, tuple[float, ...]], tuple[Camera, tuple[int, int]]]
    known = {}
    for frame, image in zip(frames, sources, strict=True):
        path = frame.camera_calibration_path
        if image is None or path is None:
            missing.append(frame.key)
            views.append((no_camera(image_size), None))
            continue
        shift = options.shift(frame.radar_from_lidar_m, frame.radar_from_lidar_z_m)
        if (path, shift) not in known:
            known[path, shift] = _camera(frame, shift, image_size, options)
        views.append(known[path, shift])
    if missing:
        what = (
            f"{len(missing)} of {len(frames)} frames have no front image or no camera "
            "calibration"
        )
        if not options.allow_missing:
            raise UserError(
                f"{what}, the first is {missing[0]}; "
                "config.data.camera.allow_missing=True uses only the radar there"
            )
        _log.warning("%s: radar only", what)
    cameras = tuple(camera for camera, _ in views)
    sizes = [size for _, size in views]
    return CameraInputs(cameras, image_size, options, features, sources, sizes)


def _camera(
    frame: LabeledFrame,
    radar_from_lidar_m: tuple[float, ...],
    image_size: tuple[int, int],
    options: CameraOptions,
) -> tuple[Camera, tuple[int, int]]:
    """Returns the camera of one frame for images of the model's size.

    Returns:
        The camera, and the height and width of the images of the calibration file.
    """
    calibration = frame.read_calibration(radar_from_lidar_m)
    calibration.require_centered(frame.camera_calibration_path)
    height, width = image_size
    size = calibration.height, calibration.width
    if size != image_size:
        if not options.resize:
            raise UserError(
                f"{frame.camera_calibration_path}: calibration of {calibration.width} x "
                f"{calibration.height} images, the model sees {width} x {height} "
                "(config.model.image.size); config.data.camera.resize=True resizes"
            )
        calibration = calibration.resized(width, height)
    return calibration.camera(options.projection), size


def require_images(
    frames: FrameSequence, inputs: CameraInputs | None, name: str = "train split"
) -> None:
    """Raises a `UserError` if no frame has both an image and a calibration.

    Args:
        frames: Frames of a split.
        inputs: Camera inputs of these frames, or None for models without a camera.
        name: Name of the frames for the error message.
    """
    if inputs is None or any(camera.is_valid for camera in inputs.cameras):
        return
    images = sum(frame.camera_path is None for frame in frames)
    calibrations = sum(frame.camera_calibration_path is None for frame in frames)
    raise UserError(
        f"no frame of the {name} ({len(frames)}) can use the camera: {images} have "
        f"no front image (cam-front/cam-front_*.png), {calibrations} no camera calibration "
        "(calib_seq_v2/seq_*/cam_1.yml or common/cam_front0.yml of K-Radar's repository: "
        "--camera-calibration FOLDER)"
    )
