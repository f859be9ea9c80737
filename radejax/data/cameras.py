"""Front images and cameras of frames, as models and drawings want them."""

from __future__ import annotations

import dataclasses
import io
import logging
import math
import pathlib
from collections.abc import Collection, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Real, UInt8

from radejax.core.errors import DataError, UserError, require
from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.records import Records
from radejax.geometry.camera import Camera, CameraCalibration, ImageKind

_log = logging.getLogger(__name__)

_MAX_SIDE, _MAX_PIXELS = 8192, 1 << 25

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
            if max(found) > _MAX_SIDE or found[0] * found[1] > _MAX_PIXELS:
                raise DataError(
                    f"{path}: {found[0]} x {found[1]} pixels, expected at most "
                    f"{_MAX_SIDE} in each direction and {_MAX_PIXELS} in all"
                )
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
    except (
        Exception
    ) as error:  # Pillow's decoders raise nearly anything on corrupted files
        raise DataError(f"{path}: corrupted image ({error})") from None


def front_view(
    frame: LabelledFrame,
) -> tuple[UInt8[np.ndarray, "H W 3"] | None, CameraCalibration | None]:
    """Left front image of a frame and its calibration, to draw.

    Images of another size than the calibration's are resized to it. None where there is
    none.

    Raises:
        DataError: A file is corrupted.
    """
    if frame.camera_path is None:
        return None, None
    camera = None
    if frame.camera_calibration_path is not None:
        camera = frame.read_calibration()
    size = IMAGE_SIZE if camera is None else (camera.height, camera.width)
    return read_left_image(frame.camera_path, size, resize=True), camera


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
        shift, z = self.radar_from_lidar_m, self.radar_from_lidar_z_m
        is_shift = shift is None or (len(shift) == 3 and all(map(math.isfinite, shift)))
        for name, is_valid, expected in (
            ("projection", self.projection in ("raw", "pinhole"), "raw or pinhole"),
            (
                "calibration",
                self.calibration in ("sequence", "common"),
                "sequence or common",
            ),
            ("radar_from_lidar_m", is_shift, "three finite numbers or None"),
            (
                "radar_from_lidar_z_m",
                z is None or math.isfinite(z),
                "a finite number or None",
            ),
        ):
            field = f"config.data.camera.{name}"
            require(is_valid, field, getattr(self, name), expected)

    @classmethod
    def from_config(cls, data: Mapping[str, Any]) -> CameraOptions:
        """Options of `config.data`; the defaults where it has no camera."""
        return cls(**data.get("camera", {}))

    def shift(self, frame: LabelledFrame) -> tuple[float, ...]:
        """Metres to add to LiDAR positions to get where the radar sees them."""
        if self.radar_from_lidar_m is not None:
            return tuple(map(float, self.radar_from_lidar_m))
        z = self.radar_from_lidar_z_m
        z = frame.radar_from_lidar_z_m if z is None else z
        return tuple(map(float, (*frame.radar_from_lidar_m[:2], z)))


@dataclasses.dataclass(frozen=True)
class CameraInputs:
    """What a model sees beside the radar: an image and a camera for every frame.

    Attributes:
        cameras: One per frame, NumPy float64; `is_valid` is False where there is none.
        image_size: Height and width of the images that the model sees.
        options: That they were made with.
        features: What an image backbone made of the images, in their place, or None.
        image_paths: Front image of every frame, None where it is missing.
        feature_keys: Key of each frame's features, None where it has none.
    """

    cameras: tuple[Camera, ...]
    image_size: tuple[int, int]
    options: CameraOptions
    features: Records | None
    image_paths: tuple[pathlib.Path | None, ...]
    feature_keys: tuple[str | None, ...]

    def empty_images(self, count: int) -> Real[np.ndarray, "{count} _ _ _"]:
        """Black images `[count, H, W, 3]` uint8, or zero features."""
        if self.features is not None:
            return np.zeros((count, *self.features.shape), self.features.dtype)
        return np.zeros((count, *self.image_size, 3), np.uint8)

    def image(self, index: int) -> Real[np.ndarray, "_ _ _"]:
        """Image (or features) of one frame; black if it is missing."""
        key, path = self.feature_keys[index], self.image_paths[index]
        if self.features is None and path is not None:
            return read_left_image(path, self.image_size, resize=self.options.resize)
        if self.features is not None and key is not None:
            return self.features[key]
        return self.empty_images(1)[0]


def camera_inputs(
    frames: FrameSequence,
    image_size: tuple[int, int],
    options: CameraOptions,
    features: Records | None = None,
) -> CameraInputs:
    """Cameras of left front images, each calibration file read once.

    Args:
        frames: Frames of a data set.
        image_size: Height and width of the images that the model sees.
        options: With `allow_missing`, frames without an image or a calibration get a
            black image and a camera whose `is_valid` is False, and how many is logged.
        features: Output of `radejax embed`, see `open_embeddings`; the image files may
            then be gone.

    Raises:
        UserError: A frame has no image or calibration, and not `allow_missing`; the
            calibration is of images of another size, and not `resize`; or an image is
            not among the features.
        DataError: A calibration file is corrupted.
    """
    has_image = [frame.camera_path is not None for frame in frames]
    embedded: Collection[str] = ()
    if features is not None:
        embedded = features.keys()
        files = zip(frames, has_image, strict=True)
        has_image = [frame.key in embedded for frame in frames]
        if absent := [f.key for f, has in files if has and f.key not in embedded]:
            raise UserError(
                f"{features.folder}: {len(absent)} of {len(frames)} frames have an image "
                f"that is not embedded, the first is {absent[0]}; embed all of the data: "
                "`radejax embed`"
            )
    cameras: list[Camera] = []
    missing: list[str] = []
    known: dict[Any, Camera] = {}
    for frame, has in zip(frames, has_image, strict=True):
        if not has or frame.camera_calibration_path is None:
            missing.append(frame.key)
            cameras.append(no_camera(image_size))
            continue
        source = frame.camera_calibration_path, options.shift(frame)
        if source not in known:
            known[source] = _read_camera(frame, image_size, options)
        cameras.append(known[source])
    if missing and not options.allow_missing:
        raise UserError(
            f"{len(missing)} of {len(frames)} frames have no front image or no camera "
            f"calibration, the first is {missing[0]}; "
            "config.data.camera.allow_missing=True uses only the radar there"
        )
    if missing:
        _log.warning(
            "%d of %d frames have no front image or no camera calibration: radar only",
            len(missing),
            len(frames),
        )
    return CameraInputs(
        tuple(cameras),
        (*image_size,),
        options,
        features,
        tuple(frame.camera_path for frame in frames),
        tuple(frame.key if frame.key in embedded else None for frame in frames),
    )


def _read_camera(
    frame: LabelledFrame, image_size: tuple[int, int], options: CameraOptions
) -> Camera:
    """The camera of one frame, for images of the model's size."""
    calibration = frame.read_calibration(options.shift(frame))
    height, width = image_size
    if (calibration.height, calibration.width) != (height, width):
        if not options.resize:
            raise UserError(
                f"{frame.camera_calibration_path}: calibration of {calibration.width} x "
                f"{calibration.height} images, the model sees {width} x {height} "
                "(config.model.image.size); config.data.camera.resize=True resizes"
            )
        calibration = calibration.resized(width, height)
    return calibration.camera(options.projection)


def check_embeddable(*, freeze: bool, mirror_probability: float) -> None:
    """`UserError` where embeddings cannot replace the images."""
    require(freeze, "config.model.image.freeze", freeze, "True with embeddings")
    require(
        not mirror_probability,
        "config.data.mirror_probability",
        mirror_probability,
        "0 with embeddings, which cannot be mirrored",
    )


def require_images(
    frames: FrameSequence, inputs: CameraInputs | None, split: str = "train"
) -> None:
    """`UserError` if no frame has both an image and a calibration.

    Args:
        frames: Frames of the split.
        inputs: Inputs of these frames; None for models without a camera.
        split: Its name, for the message.
    """
    if inputs is None or any(camera.is_valid for camera in inputs.cameras):
        return
    images = sum(frame.camera_path is None for frame in frames)
    calibrations = sum(frame.camera_calibration_path is None for frame in frames)
    raise UserError(
        f"no frame of the {split} split ({len(frames)}) can use the camera: {images} have "
        f"no front image (cam-front/cam-front_*.png), {calibrations} no camera calibration "
        "(calib_seq_v2/seq_*/cam_1.yml or common/cam_front0.yml of K-Radar's repository: "
        "--camera-calibration FOLDER)"
    )


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
