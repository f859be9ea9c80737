"""Conversion of what users pass to a detector into arrays of one batch.

Shapes, dtypes and counts are checked here, on the host, once per call.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict
from jaxtyping import Bool, Float, PyTree, Real, UInt8

from radejax import models
from radejax.config import Config
from radejax.core.errors import UserError, require
from radejax.core.files import PathLike, as_path
from radejax.core.options import ClassThresholds, class_thresholds
from radejax.core.structures import ROIS, Array
from radejax.data.cameras import no_camera, read_left_image
from radejax.data.kradar import reduced
from radejax.data.kradar.tesseract import read_frame
from radejax.data.options import CameraOptions, DataOptions
from radejax.detection.decode import ROI_LIMITS, is_roi
from radejax.geometry.camera import (
    KRADAR_RADAR_FROM_LIDAR_Z_M,
    RADAR_FROM_LIDAR_M,
    Camera,
    CameraCalibration,
    stack_cameras,
)
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.dinorade import IMAGE_BACKBONE, DinoRade
from radejax.models.radenet import RadeNet

Frames = Array | PathLike | Sequence[Array | PathLike]
Images = Array | Sequence[Array | PathLike | None]
Calibration = CameraCalibration | PathLike
Calibrations = Camera | Calibration | Sequence[Camera | Calibration | None]

_PATH = (str, os.PathLike)
_KRADAR_FROM_LIDAR_M = (*RADAR_FROM_LIDAR_M[:2], KRADAR_RADAR_FROM_LIDAR_Z_M)


class Inputs(NamedTuple):
    """Inputs of a detector for B frames.

    Attributes:
        radar: Projections `[B, R, A, D+E]` or tensors `[B, D, R, E, A]`.
        image: Images or features of them; None for the radar only.
        camera: Cameras of the images with a leading axis B, or None.
    """

    radar: Real[Array, "B ..."]
    image: Real[Array, "B _ _ _"] | None = None
    camera: PyTree[Array] | None = None


@dataclasses.dataclass(frozen=True)
class InputReader:
    """Converts the arguments of a detector to arrays.

    Args:
        model: The detector's model; a radar-only model takes neither images nor cameras.
        grid: Axes of the sensor.
        data: Options of the data that the model is for.
    """

    model: RadeNet
    grid: RadarGrid
    data: DataOptions

    def read_radar(self, frames: Frames, num_frames: int = 1) -> Real[Array, "B ..."]:
        """Combines radar frames into one array with a leading axis B.

        Args:
            frames: Radar data: an array, a path, or a list of arrays and paths, see
                `Detector.__call__`. Arrays of projections may be of any release.
            num_frames: Number T of frames of a sample.

        Returns:
            Projections `[B T, R, A, D+E]` or tensors `[B T, D, R, E, A]`.

        Raises:
            UserError: The shape is not that of radar data, the data have another form than
                those that the model is for, or there is no frame.
            DataError: A file is corrupted, or shape, dtype or values of a frame differ from
                those of its reduced release.
        """
        found = _read_paths(frames, self._read_file)
        if isinstance(found, list):
            if not found:
                raise UserError("no frames: the list is empty")
            found = np.stack([self._projected(frame) for frame in found])
        radar = self._projected(found)
        shape = tuple(radar.shape)
        steps = () if num_frames == 1 else (num_frames,)
        projection = self.grid.projection_shape
        tensor = self.grid.shape_drea
        for frame in (projection, tensor):
            if shape in ((*steps, *frame), (*shape[:1], *steps, *frame)) and shape[0]:
                if frame == tensor:
                    reduced.check_release(None, self.data.release, "frames")
                return radar.reshape(-1, *frame)
        axes = ", ".join(["B", *map(str, steps)])
        hint = ""
        if steps:
            hint = (
                f" of {num_frames} consecutive frames (config.data.num_frames), oldest "
                "first; Detector.stream takes single frames and keeps preceding ones"
            )
        raise UserError(
            f"frames have shape {list(shape)}; expected projections [{axes}, R, A, D+E] = "
            f"[{axes}, {', '.join(map(str, projection))}] or radar tensors [{axes}, D, R, "
            f"E, A] = [{axes}, {', '.join(map(str, tensor))}], or single frames [2, R, A, "
            f"E] or [N, 11] of a reduced release{hint}"
        )

    def _read_file(self, path: pathlib.Path, _: int) -> Real[np.ndarray, "..."]:
        # Records have projections of any form.
        if path.suffix != ".npy" or path.name.startswith(("DERA_", *reduced.RELEASES)):
            reduced.check_release(
                reduced.release_of_file(path), self.data.release, str(path)
            )
        return read_frame(path, self.grid)

    def _projected(self, frames: object) -> Real[Array, "..."]:
        """Converts to an array that JAX accepts; frames of a reduced release become projections."""
        array = as_numbers(frames, "frames")
        if reduced.is_reduced(array, self.grid):
            if array.shape[1] != 4:  # an error below explains points [N, 4]
                found = "rpc" if array.ndim == 2 else "polar3d"
                reduced.check_release(found, self.data.release, "frames")
            return reduced.project_reduced(np.asarray(array), self.grid)
        return array

    def read_cameras(
        self, image: Images | None, camera: Calibrations | None, num_frames: int
    ) -> tuple[Real[Array, "B _ _ _"] | None, Camera | None, int]:
        """Converts images and cameras to arrays, as the data pipeline makes them.

        Args:
            image: Images `[B, H, W, 3]` uint8 (or `[H, W, 3]` for a single frame), the
                output of `model.embed` for them, or a list with one image, path or None
                per frame.
            camera: One calibration for all frames, or a list with one (or None) per frame.
                A calibration is a `CameraCalibration`, the path of a K-Radar calibration
                file, or a `Camera`. A batched `Camera` is also accepted.
            num_frames: Number of frames B.

        Returns:
            Images `[B, ...]` and a `Camera` with leading axes B, both None if no images
            are given, and the number of frames that a radar-camera model predicts without
            an image.

        Raises:
            UserError: A size or number is not as expected, only one of image and camera is
                given, or an image is missing where that is not allowed.
        """
        if not models.has_camera(self.model):
            if image is None and camera is None:
                return None, None, 0
            raise UserError("image and camera are given, but the model is radar-only")
        if (image is None) != (camera is None):
            raise UserError("image and camera belong together: give both or none")
        options = self.data.used_camera
        images = cameras = None
        has_image = np.zeros(num_frames, bool)
        if image is not None:
            none = no_camera(self.model.options.image.size)
            cameras = _batched(camera, num_frames, none, options)
            images, has_image = _images(image, cameras, self.model, options.resize)
            given = len(images), len(cameras.is_valid)
            if given != (num_frames, num_frames):
                raise UserError(
                    f"{given[0]} images and {given[1]} cameras for {num_frames} frames"
                )
            has_image = has_image & np.asarray(cameras.is_valid, bool)
            cameras = cameras.replace(is_valid=has_image)
        num_missing = int((~has_image).sum())
        if num_missing and not options.allow_missing:
            raise UserError(
                f"{num_missing} of {num_frames} frames have no image or calibration, the "
                f"first is frame {int(has_image.argmin())} of the batch; "
                "config.data.camera.allow_missing=True predicts them from the radar only"
            )
        return images, cameras, num_missing


def _images(
    given: Images, cameras: Camera, model: DinoRade, resize: bool
) -> tuple[Real[Array, "B _ _ _"], Bool[np.ndarray, " B"]]:
    """Returns the images as one array, and a mask that is True where one is given."""
    size = model.options.image.size
    calibrated_px = np.asarray(cameras.size_px, int)

    def read(path: pathlib.Path, index: int) -> UInt8[np.ndarray, "H W 3"]:
        # A wrong number of images is reported later.
        width, height = calibrated_px[min(index, len(calibrated_px) - 1)]
        return read_left_image(
            path, size, resize=resize, calibrated_size=(height, width)
        )

    found = _read_paths(given, read)
    if isinstance(found, list):
        has_image = np.array([one is not None for one in found])
        empty = np.zeros((*size, 3), np.uint8)
        if has_image.any():
            empty = np.zeros_like(np.asarray(found[has_image.argmax()]))
        image: Array = np.stack([empty if one is None else one for one in found])
    else:
        image = as_numbers(found, "image")
        image = image[None] if image.ndim == 3 else image
        has_image = np.ones(len(image), bool)
    shapes = (*size, 3), model.options.image.feature_shape
    if image.shape[1:] not in shapes:
        expected = " or embedded ones ".join(f"[B, {str(s)[1:-1]}]" for s in shapes)
        raise UserError(f"image has shape {list(image.shape)}, expected {expected}")
    if image.dtype != np.uint8 and not jnp.issubdtype(image.dtype, jnp.floating):
        raise UserError(f"image has dtype {image.dtype}, expected uint8")
    return image, has_image


def _batched(
    given: Calibrations | None, num_frames: int, none: Camera, options: CameraOptions
) -> Camera:
    """Combines the cameras of all frames, `none` for missing ones, into one `Camera`."""
    if isinstance(given, Camera) and np.ndim(given.is_valid) == 1:
        return given
    if given is None or isinstance(given, (Camera, CameraCalibration, _PATH)):
        given = [given] * num_frames
    return stack_cameras(
        [none if one is None else _one_camera(one, options) for one in given]
    )


def _one_camera(camera: Camera | Calibration, options: CameraOptions) -> Camera:
    if isinstance(camera, Camera):
        return camera
    if not isinstance(camera, CameraCalibration):
        path = as_path(camera)
        camera = CameraCalibration.from_kradar(
            path, radar_from_lidar_m=_KRADAR_FROM_LIDAR_M
        )
        camera.require_view_ahead(path)
    own_m = camera.radar_from_lidar_m
    shift_m = np.array(options.shift(own_m, own_m[2]))
    camera = dataclasses.replace(camera, radar_from_lidar_m=shift_m)
    return camera.camera(options.projection)


def _read_paths(
    given: Frames | Images, read: Callable[[pathlib.Path, int], np.ndarray]
) -> Array | list[Array | None]:
    """Replaces paths by the arrays that they contain.

    An array is returned unchanged. A path or a list becomes a list of arrays and None.
    `read` is called with the path and its position in the list.
    """
    if not isinstance(given, (_PATH, Sequence)):
        return given
    entries = [given] if isinstance(given, _PATH) else given
    return [
        read(as_path(entry), index) if isinstance(entry, _PATH) else entry
        for index, entry in enumerate(entries)
    ]


def as_numbers(values: object, name: str) -> Real[Array, "..."]:
    """Converts an array of any kind of real numbers to one that JAX accepts.

    Args:
        values: Array; those on a device are returned unchanged.
        name: Name of the array for the error message.

    Raises:
        UserError: The values are masked, or are not real numbers.
    """
    if isinstance(values, jax.Array):
        return values
    if isinstance(values, np.ma.MaskedArray) and (count := np.sum(values.mask)):
        raise UserError(
            f"{name}: {count} values are masked; fill them: array.filled(x)"
        )
    array = np.asarray(values)
    if array.dtype == object:
        with contextlib.suppress(TypeError, ValueError):
            array = array.astype(np.float64)
    if not (array.dtype.kind in "iu" or jnp.issubdtype(array.dtype, jnp.floating)):
        raise UserError(f"{name}: array of {array.dtype}, expected real numbers")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def check_backbone(
    image: Real[Array, "B _ _ _"] | None, variables: VariableDict
) -> None:
    """Checks that the variables contain the image backbone if images require it.

    Args:
        image: Images `[B, H, W, 3]`, embedded images, or None.
        variables: Variables of the model.

    Raises:
        UserError: Images are given, and the weights of the image backbone are missing.
    """
    is_raw = image is not None and image.shape[-1] == 3
    if is_raw and IMAGE_BACKBONE not in variables["params"]:
        raise UserError(
            "these weights are without the image backbone: give image_backbone=FOLDER "
            "(--image-backbone FOLDER) with the weights of DINOv3, or embedded images"
        )


# Settings ----------------------------------------------------------------------------

UNBOUNDED_ROI = (-np.inf, np.inf, -np.inf, np.inf, -np.inf, np.inf)


class Settings(NamedTuple):
    """The values of a call that can change without recompilation, see `decode`."""

    score_threshold: Float[Array, " C"]
    nms_iou: Float[Array, ""]
    roi: Float[Array, "6"]

    @classmethod
    def of(cls, config: Config, changes: dict[str, object]) -> Settings:
        """Returns the values of a config, and those that replace them, as float32 arrays."""
        values: dict[str, Any] = dict(config.decode) | changes
        least = np.asarray(values["score_threshold"], np.float32)
        return cls(
            score_threshold=np.broadcast_to(least, len(config.classes)),
            nms_iou=np.asarray(values["nms_iou"], np.float32),
            roi=np.asarray(values["roi"] or UNBOUNDED_ROI, np.float32),
        )


def check_settings(
    config: Config,
    score_threshold: ClassThresholds | None,
    nms_iou: float | None,
    roi: Sequence[float] | str | None,
) -> dict[str, object]:
    """Returns the given values as fields of `config.decode`, without those that are None.

    Raises:
        UserError: A value is out of its range, or a class is unknown.
    """
    given: dict[str, object] = {}
    if score_threshold is not None:
        usual = config.decode.score_threshold
        least = class_thresholds(score_threshold, config.classes, usual)
        given["score_threshold"] = least
    if nms_iou is not None:
        given["nms_iou"] = iou = float(nms_iou)
        require(0 <= iou <= 1, "nms_iou", iou, "a number from 0 to 1")
    if roi is not None:
        limits = ROIS.get(roi, ()) if isinstance(roi, str) else tuple(roi)
        require(is_roi(limits), "roi", roi, f"narrow, wide or {ROI_LIMITS}")
        given["roi"] = limits
    return given
