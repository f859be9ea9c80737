"""Frames, images and calibrations as users have them, made into arrays of a model.

The results are what `data.pipeline` puts into `Batch.image` and `Batch.camera`.
"""

from __future__ import annotations

import dataclasses
import logging
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Real, UInt8

from radejax.core.errors import UserError
from radejax.core.structures import ROIS, Array
from radejax.data.cameras import CameraOptions, no_camera, read_left_image
from radejax.data.projection import MAX_LEVEL
from radejax.data.tesseract import read_frame
from radejax.geometry.camera import (
    KRADAR_RADAR_FROM_LIDAR_Z_M,
    Camera,
    CameraCalibration,
    stack_cameras,
)
from radejax.geometry.radar_grid import RadarGrid
from radejax.models.dinorade import IMAGE_BACKBONE
from radejax.models.lifting import ReferencePoints

_log = logging.getLogger(__name__)

PathLike = str | pathlib.Path
Frames = Array | PathLike | Sequence[Array | PathLike]
Images = Array | Sequence[Array | PathLike | None]
Calibration = CameraCalibration | Camera | PathLike
Calibrations = Calibration | ReferencePoints | Sequence[Calibration | None]


def radar_batch(frames: Frames, grid: RadarGrid) -> tuple[Real[Any, "B ..."], bool]:
    """Radar frames as one array with a leading axis of B.

    Args:
        frames: Projections or tesseracts, one array or a list of them, or the path of
            a file or several; see `Detector`.
        grid: Axes of the sensor.

    Returns:
        `[B, R, A, D+E]` or `[B, D, R, E, A]`, and whether they are tesseracts.

    Raises:
        UserError: The shape is of neither, or there is no frame.
    """
    if isinstance(frames, PathLike):
        frames = [frames]
    if isinstance(frames, Sequence):
        if not frames:
            raise UserError("no frames: the list is empty")
        frames = np.stack(
            [read_frame(x, grid) if isinstance(x, PathLike) else x for x in frames]
        )
    shape = tuple(np.shape(frames))
    projection, tesseract = grid.projection_shape, grid.shape_drea
    for expected, is_tesseract in ((projection, False), (tesseract, True)):
        if shape == expected:
            return frames[None], is_tesseract
        if shape[1:] == expected and shape[0]:
            return frames, is_tesseract
    raise UserError(
        f"frames have shape {list(shape)}; expected projections [B, R, A, D+E] = "
        f"[B, {', '.join(map(str, projection))}] or tesseracts [B, D, R, E, A] = "
        f"[B, {', '.join(map(str, tesseract))}]"
    )


_MAX_DECIBELS = 300.0


def count_invalid(
    frames: Real[Any, "B ..."], is_tesseract: bool, *, warn: bool = True
) -> int:
    """Number of frames whose values are not a linear power, or a level of a projection.

    Decibels are neither: noise alone spans more than they do, with bins below 1. Arrays
    on a device are not checked, nor is uint8, of which every value is a level.
    """
    if not isinstance(frames, np.ndarray) or frames.dtype == np.uint8:
        return 0
    axes = tuple(range(1, frames.ndim))
    low, high = frames.min(axes), frames.max(axes)  # NaN if one is in it
    limit = np.finfo(np.float32).max if is_tesseract else MAX_LEVEL
    lowest = 0.0 if is_tesseract else -MAX_LEVEL
    is_decibels = (low > 1.0) & (high <= _MAX_DECIBELS)
    count = int((~((low >= lowest) & (high <= limit)) | is_decibels).sum())
    if count and warn:
        _log.warning(
            "%d of %d frames contain NaN, Inf or out-of-range values (expected linear "
            "power or its projection; is the input in decibels?). Their detections are "
            "meaningless; further ones are counted in num_invalid_frames",
            count,
            len(frames),
        )
    return count


def prepare(
    image: Images | None,
    camera: Calibrations | None,
    num_frames: int,
    model: Any,
    options: CameraOptions,
) -> tuple[Real[Array, "B _ _ _"] | None, Camera | ReferencePoints | None, int]:
    """Arrays for a radar-camera model, and how many frames have no image.

    Args:
        image: `[B, H, W, 3]` uint8 (or `[H, W, 3]` of the only frame), what
            `model.embed` made of it, or a list with one image, path or None per frame.
        camera: One calibration for all frames or a list with one (or None) per frame:
            `CameraCalibration`, path of a file of K-Radar, or `Camera`. Also a batch of
            `Camera`, or `ReferencePoints`.
        num_frames: B.
        model: Has `image_size` and `feature_shape`.
        options: How calibrations are used.

    Returns:
        Images `[B, ...]`, a `Camera` or `ReferencePoints` with leading axes of B, and
        the number of frames without an image. Without any image both are None.

    Raises:
        UserError: A size or number is not as expected, image or camera is given without
            the other, or an image is missing where that is not allowed.
    """
    if (image is None) != (camera is None):
        given, lacking = ("image", "camera") if camera is None else ("camera", "image")
        raise UserError(f"{given} is given without {lacking}: give both or none")
    if image is None:
        _check_missing(np.ones(num_frames, bool), options)
        return None, None, num_frames
    image, has_image = _images(image, num_frames, model, options.resize)
    camera = _cameras(camera, num_frames, model, options)
    name = "has_image" if isinstance(camera, ReferencePoints) else "is_valid"
    own = getattr(camera, name)
    if own is not None:
        has_image = has_image & np.asarray(own, bool).reshape(num_frames)
    _check_missing(~has_image, options)
    camera = camera.replace(**{name: has_image})
    return image, camera, int((~has_image).sum())


def placeholder(
    num_frames: int, model: Any
) -> tuple[UInt8[np.ndarray, "{num_frames} H W 3"], Camera]:
    """Black images and a camera that sees nothing, of the shapes of real ones."""
    image = np.zeros((num_frames, *model.image_size, 3), np.uint8)
    return image, stack_cameras([no_camera(model.image_size)] * num_frames)


def check_backbone(
    image: Real[Array, "B _ _ _"] | None, variables: Mapping[str, Any]
) -> None:
    """`UserError` for images if the variables lack the weights of the backbone.

    Args:
        image: `[B, H, W, 3]`, what the backbone made of it, or None.
        variables: Variables of a model.
    """
    is_raw = image is not None and image.shape[-1] == 3
    if is_raw and IMAGE_BACKBONE not in variables["params"]:
        raise UserError(
            "these weights are without the image backbone: give image_backbone=FOLDER "
            "(--image-backbone FOLDER) with the weights of DINOv3, or embedded images"
        )


def _check_missing(is_missing: Bool[np.ndarray, " B"], options: CameraOptions) -> None:
    if is_missing.any() and not options.allow_missing:
        raise UserError(
            f"{int(is_missing.sum())} of {is_missing.size} frames have no image or "
            f"calibration, the first is frame {int(is_missing.argmax())} of the batch; "
            "config.data.camera.allow_missing=True predicts them from the radar only"
        )


def _images(
    image: Any, num_frames: int, model: Any, resize: bool
) -> tuple[Real[Array, "B _ _ _"], Bool[np.ndarray, " B"]]:
    """Images as one array, and which of them are not None."""
    has_image = np.ones(num_frames, bool)
    if isinstance(image, PathLike):
        image = [image]
    if isinstance(image, Sequence):
        _check_count("images", len(image), num_frames)
        has_image = np.array([one is not None for one in image])
        images = [
            read_left_image(pathlib.Path(one), model.image_size, resize=resize)
            if isinstance(one, PathLike)
            else one
            for one in image
        ]
        black = np.zeros((*model.image_size, 3), np.uint8)
        like = next((np.asarray(one) for one in images if one is not None), black)
        empty = np.zeros_like(like)
        image = np.stack([empty if one is None else one for one in images])
    if np.ndim(image) == 3:
        image = image[None]
    possible = ((*model.image_size, 3), model.feature_shape)
    if tuple(image.shape[1:]) not in possible:
        raise UserError(
            f"image has shape {list(np.shape(image))}, expected images [B, H, W, 3] = "
            f"[B, {', '.join(map(str, possible[0]))}] or embedded ones "
            f"[B, {', '.join(map(str, possible[1]))}]"
        )
    _check_count("images", image.shape[0], num_frames)
    is_float = np.issubdtype(image.dtype, np.floating) or image.dtype == "bfloat16"
    if image.dtype != np.uint8 and not is_float:
        raise UserError(f"image has dtype {image.dtype}, expected uint8")
    return image, has_image


def _cameras(
    camera: Any, num_frames: int, model: Any, options: CameraOptions
) -> Camera | ReferencePoints:
    """A batch of cameras or reference points with leading axes B."""
    if isinstance(camera, ReferencePoints):
        if camera.is_valid.shape[0] == num_frames:
            return camera
        _check_count("reference points", camera.is_valid.shape[0], 1)
        return jax.tree.map(
            lambda x: np.broadcast_to(x, (num_frames, *x.shape[1:])), camera
        )
    if isinstance(camera, Camera) and np.ndim(camera.max_radius) == 1:
        _check_count("cameras", np.shape(camera.max_radius)[0], num_frames)
        return camera
    if not isinstance(camera, list | tuple):
        camera = [camera] * num_frames
    _check_count("cameras", len(camera), num_frames)
    return stack_cameras(
        [
            no_camera(model.image_size) if one is None else _one_camera(one, options)
            for one in camera
        ]
    )


def _one_camera(camera: Any, options: CameraOptions) -> Camera:
    z = options.radar_from_lidar_z_m
    if isinstance(camera, PathLike):
        camera = CameraCalibration.from_kradar(camera)
        z = KRADAR_RADAR_FROM_LIDAR_Z_M if z is None else z
    if isinstance(camera, CameraCalibration):
        shift = camera.radar_from_lidar_m
        if options.radar_from_lidar_m is not None:
            shift = np.asarray(options.radar_from_lidar_m)
        elif z is not None:
            shift = np.array([*shift[:2], z])
        camera = dataclasses.replace(camera, radar_from_lidar_m=shift)
        return camera.camera(options.projection)
    if isinstance(camera, Camera) and np.ndim(camera.max_radius) == 0:
        return camera
    raise UserError(
        f"camera is a {type(camera).__name__}, expected a CameraCalibration, a Camera, "
        "the path of a cam_*.yml file of K-Radar or None, one for all frames or one "
        "per frame"
    )


def _check_count(what: str, found: int, expected: int) -> None:
    if found != expected:
        raise UserError(f"{found} {what} for {expected} frames")


def named_region(roi: Sequence[float] | str) -> tuple[float, ...]:
    """Limits of a region that may be named."""
    if isinstance(roi, str) and roi in ROIS:
        return tuple(ROIS[roi])
    if isinstance(roi, str) or len(roi) != 6:
        raise UserError(f"roi {roi!r}, expected narrow, wide or x0, x1, y0, y1, z0, z1")
    return tuple(roi)
