"""Images and cameras of the frames of a data set, as the model wants them."""

from __future__ import annotations

import dataclasses
import logging
import os
import pathlib
from collections.abc import Collection, Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Real

from radejax.core import schema
from radejax.core.errors import UserError
from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.images import read_left_image
from radejax.data.records import Records
from radejax.geometry.camera import Camera, CameraCalibration, ImageKind

_log = logging.getLogger(__name__)


BEFORE = {"radar_from_lidar_z_m": 0.0, "calibration": "sequence"}
"""What models were trained with when these were no fields yet."""


@dataclasses.dataclass(frozen=True)
class CameraOptions:
    """How images and calibrations are used; `config.data.camera` states the same.

    Attributes:
        projection: "raw" or "pinhole", see `CameraCalibration.camera`.
        radar_from_lidar_m: Shift from LiDAR to radar in place of each frame's own; or
            None.
        radar_from_lidar_z_m: Its z, which boxes are not moved by; None for what the
            sensors' set-up says. No part of `radar_from_lidar_m` where that is given.
        calibration: "sequence" for each sequence's own file, where it has one;
            "common" for `cam_front0.yml` everywhere, as released.
        resize: Image files of another size than the model's are resized, and their
            calibration with them; otherwise they are an error.
        allow_missing: Frames without an image are predicted from the radar alone and
            counted; otherwise they are an error.
    """

    projection: ImageKind = "raw"
    radar_from_lidar_m: tuple[float, float, float] | None = None
    radar_from_lidar_z_m: float | None = None
    calibration: Literal["sequence", "common"] = "sequence"
    resize: bool = False
    allow_missing: bool = True

    @classmethod
    def of_config(cls, data: Mapping[str, Any]) -> CameraOptions:
        """Options of `config.data`; the defaults where it has no camera."""
        return cls.of_fields(data["camera"]) if "camera" in data else cls()

    @classmethod
    def of_fields(
        cls, fields: Mapping[str, Any], where: str | os.PathLike = ""
    ) -> CameraOptions:
        """Options by name, also of a model of before that lacks some.

        Raises:
            DataError: One is of another type; names the file `where` they are from.
        """
        return schema.check(BEFORE | dict(fields), cls, str(where), "camera")

    def shift(self, frame: LabelledFrame) -> tuple[float, ...]:
        """Metres to add to LiDAR positions to get where the radar sees them."""
        if self.radar_from_lidar_m is not None:
            return self.radar_from_lidar_m
        z = self.radar_from_lidar_z_m
        z = frame.radar_from_lidar_z_m if z is None else z
        return (*frame.radar_from_lidar_m[:2], z)


@dataclasses.dataclass(frozen=True)
class CameraInputs:
    """What a model sees beside the radar: an image and a camera for every frame.

    Attributes:
        cameras: One a frame, NumPy float64; `is_valid` is False where there is none.
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
        """Image (or features) of a frame, black where it is missing."""
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
        frames: Of a data set.
        image_size: Height and width of the images that the model sees.
        options: With `allow_missing`, frames without an image or a calibration get a
            black image and a camera whose `is_valid` is False, and how many is logged.
        features: What `radejax embed` made of the images, see `open_embeddings`; the
            image files may then be gone.

    Raises:
        UserError: A frame has no image or calibration, and not `allow_missing`; the
            calibration is of images of another size, and not `resize`; or an image is
            not among the features.
        DataError: A calibration file is damaged.
    """
    embedded: Collection[str] = ()
    if features is not None:
        embedded = features.keys()
        _check_embedded(frames, embedded, features)
    has_none = [
        frame.camera_calibration_path is None
        or (
            frame.camera_path is None if features is None else frame.key not in embedded
        )
        for frame in frames
    ]
    missing = [f.key for f, gone in zip(frames, has_none, strict=True) if gone]
    if missing and not options.allow_missing:
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

    cameras: dict[Any, Camera] = {}

    def read(frame: LabelledFrame, shift: tuple[float, ...]) -> Camera:
        path, calibration = frame.camera_calibration_path, frame.read_calibration(shift)
        if (calibration.height, calibration.width) != tuple(image_size):
            height, width = image_size
            if not options.resize:
                raise UserError(
                    f"{path}: calibration of {calibration.width} x "
                    f"{calibration.height} images, the model sees {width} x {height} "
                    "(config.model.image.size); config.data.camera.resize=True resizes"
                )
            calibration = calibration.resized(width, height)
        return calibration.camera(options.projection)

    def camera(frame: LabelledFrame) -> Camera:
        shift = tuple(map(float, options.shift(frame)))
        place = frame.camera_calibration_path, shift
        if place not in cameras:
            cameras[place] = read(frame, shift)
        return cameras[place]

    return CameraInputs(
        tuple(
            no_camera(image_size) if gone else camera(frame)
            for frame, gone in zip(frames, has_none, strict=True)
        ),
        (*image_size,),
        options,
        features,
        tuple(frame.camera_path for frame in frames),
        tuple(frame.key if frame.key in embedded else None for frame in frames),
    )


def _check_embedded(
    frames: FrameSequence, embedded: Collection[str], features: Records
) -> None:
    """`UserError` for frames whose image is there but was not embedded."""
    forgotten = [
        frame.key
        for frame in frames
        if frame.key not in embedded and frame.camera_path is not None
    ]
    if forgotten:
        raise UserError(
            f"{features.folder}: {len(forgotten)} of {len(frames)} frames have an image "
            f"that is not embedded, the first is {forgotten[0]}; embed all of the data: "
            "`radejax embed`"
        )


def check_embeddable(*, freeze: bool, mirror_probability: float) -> None:
    """`UserError` where embeddings cannot stand for the images.

    Args:
        freeze: Whether the image backbone is not trained.
        mirror_probability: Of training frames.
    """
    if not freeze:
        raise UserError(
            "embeddings are what a frozen backbone makes of images, but "
            "config.model.image.freeze is False"
        )
    if mirror_probability:
        raise UserError(
            "embeddings cannot be mirrored: set config.data.mirror_probability to 0"
        )


def require_images(
    frames: FrameSequence, inputs: CameraInputs | None, split: str = "train"
) -> None:
    """`UserError` if no frame has both an image and a calibration.

    Args:
        frames: Of the split.
        inputs: Of these frames; None for models without a camera.
        split: Its name, for the message.
    """
    if inputs is None or any(camera.is_valid for camera in inputs.cameras):
        return
    lacking = {
        "front image (cam-front/cam-front_*.png)": sum(
            frame.camera_path is None for frame in frames
        ),
        "camera calibration (calib_seq_v2/seq_*/cam_1.yml or common/cam_front0.yml of "
        "K-Radar's repository: --camera_calibration FOLDER)": sum(
            frame.camera_calibration_path is None for frame in frames
        ),
    }
    reasons = "; ".join(f"{n} have no {what}" for what, n in lacking.items() if n)
    raise UserError(
        f"no frame of the {split} split ({len(frames)}) can use the camera: {reasons}"
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
