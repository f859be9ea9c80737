"""`Detector`: radar tensors in, boxes out, in one jitted call."""

from __future__ import annotations

import copy
import dataclasses
import functools
import logging
import os
import pathlib
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import Bool, Real, Shaped, UInt8

from radejax import models
from radejax.core.errors import UserError, require
from radejax.core.files import PathLike
from radejax.core.structures import ROIS, Array, Batch, Detections, to_float
from radejax.data.cameras import CameraOptions, no_camera, read_left_image
from radejax.data.projection import MAX_LEVEL, project_jax
from radejax.data.tesseract import read_frame
from radejax.detection.decode import DecodeOptions, decode
from radejax.geometry.camera import (
    KRADAR_RADAR_FROM_LIDAR_Z_M,
    RADAR_FROM_LIDAR_M,
    Camera,
    CameraCalibration,
    stack_cameras,
)
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference.saved import SavedModel, Step, load_model, load_torch
from radejax.models.dinorade import IMAGE_BACKBONE

_log = logging.getLogger(__name__)

UNBOUNDED_ROI = (-np.inf, np.inf, -np.inf, np.inf, -np.inf, np.inf)
SETTINGS = {"score_threshold": (), "nms_iou": (), "roi": (6,)}
"""Shapes of the arguments of `decode` that change without compiling again."""

Frames = Array | PathLike | Sequence[Array | PathLike]
Images = Array | Sequence[Array | PathLike | None]
Calibration = CameraCalibration | PathLike
Calibrations = Camera | Calibration | Sequence[Camera | Calibration | None]

_PATH = (str, os.PathLike)
_KRADAR_FROM_LIDAR_M = (*RADAR_FROM_LIDAR_M[:2], KRADAR_RADAR_FROM_LIDAR_Z_M)


def detect(
    model: nn.Module,
    grid: RadarGrid,
    options: Mapping[str, Any],
    variables: Any,
    frames: Real[Array, "B R A DE"] | Real[Array, "B D R E A"],
    image: Real[Array, "B _ _ _"] | None = None,
    camera: Any = None,
    settings: Mapping[str, Array] | None = None,
) -> Detections:
    """From a batch of radar tensors to detections; pure, to be jitted.

    Args:
        model: Radar or radar-camera detector.
        grid: Of its maps, see `models.map_grid`.
        options: Keyword arguments of `radejax.detection.decode.decode`.
        variables: Of the model.
        frames: Projections as they are stored, or tesseracts, linear power.
        image: Of a radar-camera model, or None for the radar only.
        camera: Likewise.
        settings: Options that replace those in `options`, of `SETTINGS`, traced.
    """
    if frames.ndim == 5:
        frames = project_jax(frames)
    inputs = (to_float(frames),) if image is None else (to_float(frames), image, camera)
    maps: Any = model.apply(variables, *inputs, train=False)
    return decode(maps, grid, **{**options, **(settings or {})})


class Detector:
    """A trained model with everything between a radar tensor and boxes.

    One object may be shared by threads. Batches are padded to a few fixed sizes, so
    that any number of frames compiles at most `len(batch_sizes)` programs per kind of
    input; thresholds and region can change without compiling again.

    Args:
        saved: From `load_model`.
        sharding: Where batches are computed: `batch_sharding` of a mesh splits each over
            its devices, on which the variables are replicated; JAX's default device if
            None. In several processes each passes the same number of frames, a multiple
            of its devices, and gets the detections of all.
        score_threshold: Default of calls; of the config if None, as the next two.
        nms_iou: Default of calls.
        roi: Default of calls: x, y, z limits `(x0, x1, y0, y1, z0, z1)`, "narrow" or
            "wide".
        dtype: Of the computation, "float32" or "bfloat16"; of the config if None.
        batch_sizes: Sizes that are compiled, each per process.

    Attributes:
        num_radar_only: Frames so far, except of a `Batch`, that a radar-camera model
            predicted without an image.
        num_invalid_frames: Frames so far, of NumPy arrays, with values that no radar
            power gives (NaN, infinite, decibels): their detections are meaningless.

    Examples:
        >>> detector = Detector.from_workdir("runs/quickstart")  # doctest: +SKIP
        >>> detector(projection).to_list()  # doctest: +SKIP
        >>> fusion(projection, images, calibration)  # doctest: +SKIP
    """

    def __init__(
        self,
        saved: SavedModel,
        sharding: Sharding | None = None,
        *,
        score_threshold: float | None = None,
        nms_iou: float | None = None,
        roi: Sequence[float] | str | None = None,
        dtype: str | None = None,
        batch_sizes: Sequence[int] = (1, 2, 4, 8, 16, 32),
    ) -> None:
        config = saved.config.copy_and_resolve_references()
        config.decode.update(_settings(score_threshold, nms_iou, roi))
        if dtype is not None:
            config.model.dtype = dtype
        self.saved = dataclasses.replace(saved, config=config)
        self.grid = saved.grid
        self.model: Any = self.saved.model
        self.takes_camera = models.has_camera(self.model)
        self.camera_options = CameraOptions.from_config(config.data)
        self.classes = tuple(config.classes)
        self.decode_options = dataclasses.asdict(DecodeOptions(**config.decode))
        self.sharding = sharding or SingleDeviceSharding(jax.devices()[0])
        self.replicated = (
            NamedSharding(self.sharding.mesh, PartitionSpec())
            if isinstance(self.sharding, NamedSharding)
            else self.sharding
        )
        self._set_batch_sizes(batch_sizes)
        self.variables = jax.device_put(saved.variables, self.replicated)
        self.num_radar_only = self.num_invalid_frames = 0
        self._lock = threading.Lock()
        # Every process gets all detections: they are small.
        self._run = jax.jit(self.detect_function(), out_shardings=self.replicated)

    @classmethod
    def from_workdir(
        cls,
        path: PathLike,
        step: Step = None,
        *,
        image_backbone: PathLike | None = None,
        **options: Any,
    ) -> Detector:
        """Detector of a training run, or of anything else that `load_model` takes.

        Args:
            path: Workdir of `train.py`, its `checkpoints` or one of them, a folder of
                `radejax export`, or an official file.
            step: Step of the checkpoint, or "best"; the latest if None.
            image_backbone: Weights of a frozen image backbone, if they are not where
                the run was trained from, or the exported folder has none.
            **options: Arguments of `Detector`.

        Raises:
            FileNotFoundError: There is no run, or no such checkpoint.
        """
        saved = load_model(path, step=step, image_backbone=image_backbone)
        return cls(saved, **options)

    @classmethod
    def from_torch(
        cls,
        path_or_state_dict: PathLike | Mapping[str, Any],
        *,
        image_backbone: PathLike | None = None,
        **options: Any,
    ) -> Detector:
        """Detector of an official RADE-Net or DinoRADE checkpoint.

        Args:
            path_or_state_dict: File, or mapping of names to arrays, see `load_torch`.
            image_backbone: Folder of DINOv3, for DinoRADE files without its weights.
            **options: Arguments of `Detector`.
        """
        saved = load_torch(path_or_state_dict, image_backbone=image_backbone)
        return cls(saved, **options)

    def replace(
        self,
        *,
        variables: Mapping[str, Any] | None = None,
        batch_sizes: Sequence[int] | None = None,
    ) -> Detector:
        """The same detector with other variables or batch sizes, compiled together."""
        other = copy.copy(self)
        other._lock = threading.Lock()
        other.num_radar_only = other.num_invalid_frames = 0
        if variables is not None:
            other.variables = jax.device_put(variables, self.replicated)
        if batch_sizes is not None:
            other._set_batch_sizes(batch_sizes)
        return other

    def _set_batch_sizes(self, sizes: Sequence[int]) -> None:
        """Each rounded up to a multiple of the devices of this process."""
        is_possible = len(sizes) > 0 and min(sizes, default=0) >= 1
        require(is_possible, "batch_sizes", sizes, "integers of at least 1")
        count = len(self.sharding.addressable_devices)
        self._batch_sizes = sorted({-(-size // count) * count for size in sizes})

    # Use -----------------------------------------------------------------------------

    def __call__(
        self,
        frames: Frames | Batch,
        image: Images | None = None,
        camera: Calibrations | None = None,
        *,
        score_threshold: float | None = None,
        nms_iou: float | None = None,
        roi: Sequence[float] | str | None = None,
    ) -> Detections:
        """Detect the objects in one frame or many.

        Args:
            frames: Projections `[B, R, A, D+E]` or tesseracts `[B, D, R, E, A]` in
                linear power, or one without B; paths of either, or a list of those; or
                a `Batch`, whose image and camera are used.
            image: For a radar-camera model: `[B, H, W, 3]` uint8, embedded images, or a
                list of arrays, paths and None.
            camera: One calibration for all frames, or a list of one per frame.
            score_threshold: Of this call.
            nms_iou: Of this call.
            roi: Of this call.

        Returns:
            Detections of B frames, on the device.

        Raises:
            UserError: A shape or number is not as expected.
        """
        inputs: Any
        if isinstance(frames, Batch):  # checked when it was made
            inputs = frames.projection, frames.image, frames.camera
        else:
            radar = radar_batch(frames, self.grid)
            image, camera, num_radar_only = camera_batch(
                image, camera, len(radar), self.model, self.camera_options
            )
            inputs = radar, image, camera
            num_invalid = count_invalid(radar, warn=not self.num_invalid_frames)
            with self._lock:
                self.num_invalid_frames += num_invalid
                self.num_radar_only += num_radar_only
        check_backbone(inputs[1], self.variables)
        options = {**self.decode_options, **_settings(score_threshold, nms_iou, roi)}
        options["roi"] = options["roi"] or UNBOUNDED_ROI
        settings = {name: np.asarray(options[name], np.float32) for name in SETTINGS}
        parts = []
        largest = self._batch_sizes[-1]
        for start in range(0, len(inputs[0]), largest):
            chunk = jax.tree.map(lambda x, s=start: x[s : s + largest], inputs)
            parts.append(self._detect(chunk, settings))
        if len(parts) == 1:
            return parts[0]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)

    def _detect(self, inputs: Any, settings: Any) -> Detections:
        """Detections of at most the largest batch size."""
        count = inputs[0].shape[0]
        size = next(size for size in self._batch_sizes if size >= count)
        inputs = jax.tree.map(lambda x: self.put(_padded(x, size)), inputs)
        found = self._run(self.variables, *inputs, settings)
        if jax.default_backend() == "cpu" and len(self.sharding.device_set) > 1:
            # Devices that share cores miss each other where batches pile up.
            jax.block_until_ready(found)
        found = found.replace(class_names=self.classes)
        return found if count == size else jax.tree.map(lambda x: x[:count], found)

    def stream(self, frames: Iterable[Any], **settings: Any) -> Iterator[Detections]:
        """Detections of one item after the other, each started before the last ends.

        Reading and projecting the next item overlap with the work of the device.

        Args:
            frames: Items as `__call__` takes them first; a tuple is frames, image and
                camera.
            **settings: Keyword arguments of `__call__`.
        """
        started: list[Detections] = []
        for item in frames:
            inputs = item if isinstance(item, tuple) else (item,)
            started.append(self(*inputs, **settings))
            if len(started) > 1:
                yield started.pop(0)
        yield from started

    def warmup(self, batch_size: int = 1) -> Detector:
        """Compile for a batch size of projections, so that the first call is fast.

        A radar-camera model is compiled for frames with images.
        """
        shape = (batch_size, *self.grid.projection_shape)
        inputs: tuple[Any, ...] = (np.zeros(shape, np.float32),)
        if self.takes_camera:
            images, camera = placeholder(batch_size, self.model)
            inputs += images, camera.replace(is_valid=np.ones(batch_size, bool))
        jax.block_until_ready(self(*inputs))
        return self

    def detect_function(self) -> Callable[..., Detections]:
        """The pure function that is jitted: `detect` of this model and its options."""
        mapping = self.saved.config.data.azimuth_mapping
        grid = models.map_grid(self.grid, self.model, mapping)
        return functools.partial(detect, self.model, grid, self.decode_options)

    def put(self, x: Shaped[Any, "b ..."]) -> Shaped[jax.Array, "B ..."]:
        """Copy the rows of this process to the devices; the caller may then reuse `x`.

        On CPU `device_put` shares aligned memory whatever `may_alias` says; elsewhere
        the transfer reads it after the call returns.
        """
        if not isinstance(x, np.ndarray):
            return jax.device_put(x, self.sharding)
        is_cpu = jax.default_backend() == "cpu"
        x = x.copy() if is_cpu else x
        placed = jax.make_array_from_process_local_data(self.sharding, x)
        return placed if is_cpu else jax.block_until_ready(placed)


def _padded(x: Shaped[Array, "b ..."], size: int) -> Shaped[Array, "{size} ..."]:
    """Repeat the last frame up to a batch size."""
    count = x.shape[0]
    return x if count == size else x[np.minimum(np.arange(size), count - 1)]


# Inputs ------------------------------------------------------------------------------


def _read_paths(given: Any, read: Callable[[pathlib.Path], np.ndarray]) -> Any:
    """An array as it is; a path, or a list with paths, as a list of arrays and None."""
    if not isinstance(given, str | os.PathLike | Sequence):
        return given
    entries = [given] if isinstance(given, _PATH) else given
    return [read(pathlib.Path(x)) if isinstance(x, _PATH) else x for x in entries]


def radar_batch(frames: Frames, grid: RadarGrid) -> Real[Any, "B ..."]:
    """Radar frames as one array with a leading axis of B.

    Args:
        frames: Projections or tesseracts, one array or a list of them, or the path of
            a file or several; see `Detector`.
        grid: Axes of the sensor.

    Returns:
        `[B, R, A, D+E]` or `[B, D, R, E, A]`.

    Raises:
        UserError: The shape is of neither, or there is no frame.
    """
    radar = _read_paths(frames, lambda path: read_frame(path, grid))
    if isinstance(radar, list):
        if not radar:
            raise UserError("no frames: the list is empty")
        radar = np.stack(radar)
    shape = tuple(np.shape(radar))
    projection, tesseract = grid.projection_shape, grid.shape_drea
    if shape in (projection, tesseract):
        return radar[None]
    if shape[1:] in (projection, tesseract) and shape[0]:
        return radar
    raise UserError(
        f"frames have shape {list(shape)}; expected projections [B, R, A, D+E] = "
        f"[B, {', '.join(map(str, projection))}] or tesseracts [B, D, R, E, A] = "
        f"[B, {', '.join(map(str, tesseract))}]"
    )


_MAX_DECIBELS = 300.0


def count_invalid(frames: Real[Any, "B ..."], *, warn: bool) -> int:
    """Number of frames whose values are not a linear power, or a level of a projection.

    Decibels are neither: noise alone spans more than they do, with bins below 1. Arrays
    on a device are not checked, nor is uint8, of which every value is a level.
    """
    if not isinstance(frames, np.ndarray) or frames.dtype == np.uint8:
        return 0
    axes = tuple(range(1, frames.ndim))
    low, high = frames.min(axes), frames.max(axes)  # NaN if one is in it
    lowest, limit = -MAX_LEVEL, MAX_LEVEL
    if frames.ndim == 5:
        lowest, limit = 0.0, float(np.finfo(np.float32).max)
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


def camera_batch(
    image: Images | None,
    camera: Calibrations | None,
    num_frames: int,
    model: Any,
    options: CameraOptions,
) -> tuple[Real[Array, "B _ _ _"] | None, Camera | None, int]:
    """Images and cameras as arrays, as `data.pipeline` puts them into a `Batch`.

    Args:
        image: `[B, H, W, 3]` uint8 (or `[H, W, 3]` of the only frame), what
            `model.embed` made of it, or a list with one image, path or None per frame.
        camera: One calibration for all frames or a list with one (or None) per frame:
            `CameraCalibration`, path of a file of K-Radar, or `Camera`. Also a batch of
            `Camera`.
        num_frames: B.
        model: A radar-only model takes neither.
        options: How calibrations are used.

    Returns:
        Images `[B, ...]`, a `Camera` with leading axes of B (both None without any
        image), and the number of frames that a radar-camera model predicts without one.

    Raises:
        UserError: A size or number is not as expected, image or camera is given without
            the other, or an image is missing where that is not allowed.
    """
    if not models.has_camera(model):
        if image is None and camera is None:
            return None, None, 0
        raise UserError("image and camera are given, but the model is radar-only")
    if (image is None) != (camera is None):
        raise UserError("image and camera belong together: give both or none")
    images, cameras, has_image = None, None, np.zeros(num_frames, bool)
    if image is not None:
        images, has_image = _images(image, model, options.resize)
        cameras = _cameras(camera, num_frames, model, options)
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
    image: Any, model: Any, resize: bool
) -> tuple[Real[Array, "B _ _ _"], Bool[np.ndarray, " B"]]:
    """Images as one array, and which of them are not None."""
    sizes = ((*model.image_size, 3), model.feature_shape)
    image = _read_paths(
        image, lambda path: read_left_image(path, model.image_size, resize=resize)
    )
    if isinstance(image, list):
        has_image = np.array([one is not None for one in image])
        empty = np.zeros(sizes[0], np.uint8)
        if has_image.any():
            empty = np.zeros_like(np.asarray(image[has_image.argmax()]))
        image = np.stack([empty if one is None else one for one in image])
    else:
        image = image[None] if np.ndim(image) == 3 else image
        has_image = np.ones(len(image), bool)
    if image.shape[1:] not in sizes:
        expected = " or embedded ones ".join(f"[B, {str(s)[1:-1]}]" for s in sizes)
        raise UserError(f"image has shape {list(image.shape)}, expected {expected}")
    if image.dtype != np.uint8 and not jnp.issubdtype(image.dtype, jnp.floating):
        raise UserError(f"image has dtype {image.dtype}, expected uint8")
    return image, has_image


def _cameras(
    camera: Any, num_frames: int, model: Any, options: CameraOptions
) -> Camera:
    """A batch of cameras."""
    if isinstance(camera, Camera) and np.ndim(camera.is_valid) == 1:
        return camera
    if not isinstance(camera, list | tuple):
        camera = [camera] * num_frames
    return stack_cameras(
        [
            no_camera(model.image_size) if one is None else _one_camera(one, options)
            for one in camera
        ]
    )


def _one_camera(camera: Camera | Calibration, options: CameraOptions) -> Camera:
    if isinstance(camera, Camera):
        return camera
    if not isinstance(camera, CameraCalibration):
        camera = CameraCalibration.from_kradar(
            pathlib.Path(camera), radar_from_lidar_m=_KRADAR_FROM_LIDAR_M
        )
    own_m = camera.radar_from_lidar_m
    shift_m = np.array(options.shift(own_m, own_m[2]))
    camera = dataclasses.replace(camera, radar_from_lidar_m=shift_m)
    return camera.camera(options.projection)


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


def _settings(
    score_threshold: float | None,
    nms_iou: float | None,
    roi: Sequence[float] | str | None,
) -> dict[str, Any]:
    """Those of `SETTINGS` that are given."""
    given = {"score_threshold": score_threshold, "nms_iou": nms_iou}
    settings: dict[str, Any] = {k: float(v) for k, v in given.items() if v is not None}
    if roi is not None:
        limits = ROIS.get(roi, ()) if isinstance(roi, str) else tuple(roi)
        require(len(limits) == 6, "roi", roi, "narrow, wide or x0, x1, y0, y1, z0, z1")
        settings["roi"] = limits
    return settings
