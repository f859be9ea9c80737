"""Frames, images and calibrations as people hold them, made into a model's arrays.

What comes out is what `data.pipeline` puts into `Batch.image` and `Batch.camera`.
"""

from __future__ import annotations

import dataclasses
import logging
import pathlib
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Real, Shaped, UInt8

from radejax.core.errors import UserError
from radejax.core.structures import ROIS, Array
from radejax.data.cameras import CameraOptions, no_camera
from radejax.data.images import read_left_image
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
        grid: Of the sensor.

    Returns:
        `[B, R, A, D+E]` or `[B, D, R, E, A]`, and whether they are tesseracts.

    Raises:
        UserError: The shape fits neither, a list is empty, or its shapes differ.
    """
    if isinstance(frames, PathLike):
        frames = [frames]
    if isinstance(frames, Sequence):
        frames = _stack_frames(frames, grid)
    shape = tuple(np.shape(frames))
    projection, tesseract = grid.projection_shape, grid.shape_drea
    for expected, is_tesseract in ((projection, False), (tesseract, True)):
        if shape[-len(expected) :] == expected and len(shape) - len(expected) < 2:
            is_batch = len(shape) > len(expected)
            return frames if is_batch else frames[None], is_tesseract
    raise UserError(
        f"frames have shape {list(shape)}; expected projections [B, R, A, D+E] = "
        f"[B, {', '.join(map(str, projection))}] or tesseracts [B, D, R, E, A] = "
        f"[B, {', '.join(map(str, tesseract))}]"
    )


_MAX_DECIBELS = 300.0


def _num_impossible(frames: Real[Array, "B ..."], is_tesseract: bool) -> Any:
    """Number of frames that are no linear power (a tesseract), or no level of it.

    Decibels are neither: noise alone spans more than they do, with cells below 1.
    """
    axes = tuple(range(1, frames.ndim))
    low, high = frames.min(axes), frames.max(axes)  # NaN if one is in it
    limits = (
        (0.0, np.finfo(np.float32).max) if is_tesseract else (-MAX_LEVEL, MAX_LEVEL)
    )
    is_power = (low >= limits[0]) & (high <= limits[1])
    is_decibels = (low > 1.0) & (high <= _MAX_DECIBELS)
    return (~is_power | is_decibels).sum()


_num_on_device = jax.jit(_num_impossible, static_argnums=1)


class ImpossibleFrames:
    """Counts frames with cells that no power gives, NaN for example; warns of the first.

    Arrays on a device are looked at there and nothing waits for them: their number is
    fetched in a later call that finds it computed, or when the total is asked for.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._total, self._started = 0, list[tuple[Any, int]]()

    def look(self, frames: Real[Any, "B ..."], is_tesseract: bool) -> None:
        """Looks at the frames of `radar_batch`; traced ones (`jit`) have no values."""
        if frames.dtype == np.uint8:  # of records: every value is a level
            return
        if isinstance(frames, np.ndarray):
            count = _num_impossible(frames, is_tesseract)
        elif isinstance(frames, jax.Array) and not isinstance(frames, jax.core.Tracer):
            count = _num_on_device(frames, is_tesseract)
        else:
            return
        with self._lock:
            self._started.append((count, len(frames)))
        self.total(waits=False)

    def total(self, *, waits: bool = True) -> int:
        """Number so far; without waiting, of what is computed."""
        with self._lock:
            started, self._started = self._started, []
            for count, num_frames in started:
                # Its type lacks `is_ready`.
                if not waits and isinstance(count, jax.Array) and not count.is_ready():  # type: ignore[attr-defined]
                    self._started.append((count, num_frames))
                elif found := int(count):
                    if self._total == 0:
                        _log.warning(
                            "%d of %d frames have cells that are NaN, infinite or "
                            "otherwise no linear radar power (decibels?), or level "
                            "of a projection: their boxes mean nothing "
                            "(further ones are counted in num_impossible)",
                            found,
                            num_frames,
                        )
                    self._total += found
            return self._total


def _stack_frames(
    frames: Sequence[Any], grid: RadarGrid
) -> Shaped[np.ndarray, "B ..."]:
    """One array of the frames of a list: paths or arrays."""
    arrays = [
        read_frame(frame, grid) if isinstance(frame, PathLike) else np.asarray(frame)
        for frame in frames
    ]
    if not arrays:
        raise UserError("no frames: the list is empty")
    shapes = {array.shape: i for i, array in reversed(list(enumerate(arrays)))}
    if len(shapes) > 1:
        first, *_, other = sorted(shapes, key=shapes.__getitem__)
        raise UserError(
            f"frames of one call must have one shape: frame 0 has {list(first)}, "
            f"frame {shapes[other]} has {list(other)}"
        )
    return np.stack(arrays)


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
            `model.embed` made of it, or a list with one image, path or None a frame.
        camera: One calibration for all frames or a list with one (or None) a frame:
            `CameraCalibration`, path of K-Radar's file of one, or `Camera`. Also a
            batch of `Camera`, or `ReferencePoints`.
        num_frames: B.
        model: Has `image_size` and `feature_shape`.
        options: How calibrations are used.

    Returns:
        Images `[B, ...]`, a `Camera` or `ReferencePoints` with leading axes of B, and
        the number of frames without an image. Without any image both are None.

    Raises:
        UserError: A size or number is not what was expected, image or camera is given
            alone, or an image is missing where that is not allowed.
    """
    if (image is None) != (camera is None):
        given, lacking = ("image", "camera") if camera is None else ("camera", "image")
        raise UserError(f"{given} is given without {lacking}: give both or none")
    if image is None:
        _check_missing(np.ones(num_frames, bool), options)
        return None, None, num_frames
    image, has_image = _images(image, num_frames, model, options.resize)
    camera = _cameras(camera, num_frames, model, options)
    if isinstance(camera, ReferencePoints):
        has_image = has_image & _host(camera.has_image, num_frames)
        camera = camera.replace(has_image=has_image)
    else:
        has_image = has_image & _host(camera.is_valid, num_frames)
        camera = camera.replace(is_valid=has_image)
    _check_missing(~has_image, options)
    return image, camera, int((~has_image).sum())


def placeholder(
    num_frames: int, model: Any
) -> tuple[UInt8[np.ndarray, "{num_frames} H W 3"], Camera]:
    """Black images and a camera that looks nowhere, of the shapes of real ones."""
    image = np.zeros((num_frames, *model.image_size, 3), np.uint8)
    return image, stack_cameras([no_camera(model.image_size)] * num_frames)


def check_backbone(
    image: Real[Array, "B _ _ _"] | None, variables: Mapping[str, Any]
) -> None:
    """`UserError` for images themselves where variables lack the backbone's weights.

    Args:
        image: `[B, H, W, 3]`, what the backbone made of it, or None.
        variables: Of a model.
    """
    is_raw = image is not None and image.shape[-1] == 3
    if is_raw and IMAGE_BACKBONE not in variables["params"]:
        raise UserError(
            "these weights are without the image backbone: give "
            "image_backbone=FOLDER with DINOv3's, or embedded images"
        )


def _check_missing(is_missing: Bool[np.ndarray, " B"], options: CameraOptions) -> None:
    if is_missing.any() and not options.allow_missing:
        raise UserError(
            f"{int(is_missing.sum())} of {is_missing.size} frames have no image or "
            f"calibration, the first is frame {int(is_missing.argmax())} of the batch; "
            "config.data.camera.allow_missing takes the radar alone instead"
        )


def _host(mask: Any, num_frames: int) -> Bool[np.ndarray, " {num_frames}"]:
    """A mask on the host; None is True for all."""
    if mask is None:
        return np.ones(num_frames, bool)
    return np.asarray(mask, bool).reshape(num_frames)


def _images(
    image: Any, num_frames: int, model: Any, resize: bool
) -> tuple[Real[Array, "B _ _ _"], Bool[np.ndarray, " B"]]:
    has_image = np.ones(num_frames, bool)
    if isinstance(image, PathLike):
        image = [image]
    if isinstance(image, Sequence):
        _check_count("images", len(image), num_frames)
        images = [
            read_left_image(pathlib.Path(one), model.image_size, resize=resize)
            if isinstance(one, PathLike)
            else one
            for one in image
        ]
        has_image = np.array([one is not None for one in images])
        if not has_image.any():
            return placeholder(num_frames, model)[0], has_image
        like = np.asarray(images[int(has_image.argmax())])
        images = [np.zeros_like(like) if one is None else one for one in images]
        if shapes := {np.shape(one) for one in images} - {like.shape}:
            raise UserError(
                f"images of different sizes: {like.shape} and {shapes.pop()}"
            )
        image = np.stack(images)
    if np.ndim(image) == 3:
        image = image[None]
    possible = ((*model.image_size, 3), model.feature_shape)
    if np.ndim(image) != 4 or tuple(image.shape[1:]) not in possible:
        expected = " or embedded ".join(str(["B", *shape]) for shape in possible)
        raise UserError(
            f"image has shape {list(np.shape(image))}, expected {expected}".replace(
                "'", ""
            )
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
        "the path of K-Radar's cam_*.yml or None, one for all frames or one a frame"
    )


def _check_count(what: str, found: int, expected: int) -> None:
    if found != expected:
        raise UserError(f"{found} {what} for {expected} frames")


def named_region(roi: Sequence[float] | str | None) -> Sequence[float] | None:
    """Limits of a region that may be named."""
    if isinstance(roi, str) and roi in ROIS:
        return ROIS[roi]
    if roi is not None and (isinstance(roi, str) or len(roi) != 6):
        raise UserError(f"roi {roi!r}, expected narrow, wide or x0, x1, y0, y1, z0, z1")
    return roi


def named_device(device: jax.Device | str | None) -> jax.Device:
    """A device that may be named by its platform."""
    try:
        return jax.devices(device)[0] if not isinstance(device, jax.Device) else device
    except RuntimeError as error:
        there = ", ".join(sorted({d.platform for d in jax.devices()}))
        raise UserError(f"device {device!r} is not there, found {there}") from error


def checked_sizes(sizes: Sequence[int]) -> tuple[int, ...]:
    """Batch sizes in order; `UserError` for none, or one that is not positive."""
    if not isinstance(sizes, Sequence) or not sizes or min(sizes) < 1:
        raise UserError(f"batch_sizes {sizes}, expected numbers of at least 1: (1, 8)")
    return tuple(sorted(sizes))


def pad_batch(x: Shaped[Array, "b ..."], size: int) -> Shaped[Array, "{size} ..."]:
    """Repeats the last frame up to a batch size."""
    missing = size - x.shape[0]
    if missing == 0:
        return x
    xp = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([x, xp.repeat(x[-1:], missing, 0)])
