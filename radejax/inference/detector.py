"""`Detector` computes boxes from radar tensors in one jitted call."""

from __future__ import annotations

import contextlib
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
from jaxtyping import Bool, Float, Real, Shaped, UInt8

from radejax import models
from radejax.core.errors import UserError, require
from radejax.core.files import PathLike, as_path
from radejax.core.structures import ROIS, Array, Batch, Detections, to_float
from radejax.data.cameras import CameraOptions, no_camera, no_images, read_left_image
from radejax.data.kradar.reduced import (
    RELEASES,
    check_release,
    is_reduced,
    project_reduced,
    release_of_file,
)
from radejax.data.kradar.tesseract import read_frame
from radejax.data.projection import (
    MAX_LEVEL,
    find_problem,
    project_jax,
    stack_frames,
    to_log_scale,
)
from radejax.detection.decode import ROI_LIMITS, decode, is_roi
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
"""Shapes of the arguments of `decode` that can change without recompilation."""

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
    """Compute detections from a batch of radar tensors.

    This is a pure function that can be jitted.

    Args:
        model: Radar or radar-camera detector.
        grid: Grid of the model's maps, see `models.map_grid`.
        options: Keyword arguments of `radejax.detection.decode.decode`.
        variables: Variables of the model.
        frames: Projections as they are stored, or tesseracts in linear power.
        image: Images for a radar-camera model, or None to use the radar only.
        camera: Cameras of the images, or None without images.
        settings: Values by the names in `SETTINGS`, which replace those in `options` and
            may be traced.
    """
    if frames.ndim == 5:
        frames = grid.measured_channels(project_jax(frames))
    inputs = (to_float(frames),) if image is None else (to_float(frames), image, camera)
    maps: Any = model.apply(variables, *inputs, train=False)
    return decode(maps, grid, **{**options, **(settings or {})})


class Detector:
    """A trained model with the preprocessing and decoding from radar tensors to boxes.

    One object may be shared by threads. Batches are padded to a few fixed sizes, so
    that any number of frames compiles at most `len(batch_sizes)` programs per kind of
    input. The thresholds and the region of interest can change without recompilation.

    Args:
        saved: The trained model, as `load_model` returns it.
        sharding: Placement of the batches. `batch_sharding` of a mesh splits each batch
            over the devices of the mesh, on which the variables are replicated. None
            places batches on JAX's default device. With several processes, each passes
            the same number of frames, a multiple of its devices, and gets the detections
            of all processes.
        score_threshold: Default score threshold of calls; the config's if None.
        nms_iou: Default IoU threshold of NMS of calls; the config's if None.
        roi: Default region of interest of calls, in meters: limits
            `(x0, x1, y0, y1, z0, z1)`, "narrow" or "wide"; the config's if None.
        dtype: Dtype of the computation, "float32" or "bfloat16"; the config's if None.
        batch_sizes: Batch sizes per process for which the model is compiled. Each is
            rounded up to a multiple of the process's devices.

    Attributes:
        num_frames: Number of frames of a sample, `config.data.num_frames`. Above 1, calls
            take samples, and `stream` single frames.
        num_radar_only: Number of frames so far that a radar-camera model predicted
            without an image and its calibration. Frames in a `Batch` are not counted.
        num_invalid_frames: Number of frames so far, passed as NumPy arrays, with values
            that cannot be radar power (NaN, infinity, decibels). Their detections are
            meaningless.

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
        config = saved.config.replace(decode=_settings(score_threshold, nms_iou, roi))
        if dtype is not None:
            config = config.replace(model={"dtype": dtype})
        self.saved = dataclasses.replace(saved, config=config)
        self.grid = saved.grid
        self.model: Any = self.saved.model
        self.num_frames: int = self.model.num_frames
        self.takes_camera = models.has_camera(self.model)
        self.camera_options = config.data.used_camera
        self.classes = tuple(config.classes)
        self.decode_options = config.decode.to_dict()
        self.sharding = sharding or SingleDeviceSharding(jax.devices()[0])
        self.replicated = self.sharding
        run = self.detect_function()
        if isinstance(self.sharding, NamedSharding):
            mesh = self.sharding.mesh
            frames = self.sharding.spec
            whole = PartitionSpec()
            self.replicated = NamedSharding(mesh, whole)
            # Each device computes its own frames. Partitioned by XLA, it would search the
            # peaks of all frames.
            run = jax.shard_map(
                run,
                mesh=mesh,
                in_specs=(whole, frames, frames, frames, whole),
                out_specs=frames,
                check_vma=False,
            )
        self._set_batch_sizes(batch_sizes)
        self.variables = jax.device_put(saved.variables, self.replicated)
        self.num_radar_only = self.num_invalid_frames = 0
        self._lock = threading.Lock()
        # Every process gets all detections: they are small.
        self._run = jax.jit(run, out_shardings=self.replicated)
        self._extremes = jax.jit(_extremes, out_shardings=self.replicated)

    @classmethod
    def from_workdir(
        cls,
        path: PathLike,
        step: Step = None,
        *,
        image_backbone: PathLike | None = None,
        **options: Any,
    ) -> Detector:
        """Create a detector from a training run or another model that `load_model` takes.

        Args:
            path: Workdir of `train.py`, its `checkpoints` or one of them, a folder of
                `radejax export`, or an official checkpoint file.
            step: Step of the checkpoint, or "best"; the latest if None.
            image_backbone: Weights of a frozen image backbone. They are needed if the
                file that the run was trained with has moved, or if the exported folder
                does not contain them.
            **options: Keyword arguments of `Detector`.

        Raises:
            FileNotFoundError: There is no model, or no such checkpoint.
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
        """Create a detector from an official RADE-Net or DinoRADE checkpoint.

        Args:
            path_or_state_dict: File, or mapping of names to arrays, see `load_torch`.
            image_backbone: Folder of DINOv3, for DinoRADE files without its weights.
            **options: Keyword arguments of `Detector`.
        """
        saved = load_torch(path_or_state_dict, image_backbone=image_backbone)
        return cls(saved, **options)

    def replace(
        self,
        *,
        variables: Mapping[str, Any] | None = None,
        batch_sizes: Sequence[int] | None = None,
    ) -> Detector:
        """Return a copy with other variables or batch sizes that shares compiled programs.

        The counters of the copy start at zero.
        """
        other = copy.copy(self)
        other._lock = threading.Lock()
        other.num_radar_only = other.num_invalid_frames = 0
        if variables is not None:
            other.variables = jax.device_put(variables, self.replicated)
        if batch_sizes is not None:
            other._set_batch_sizes(batch_sizes)
        return other

    def _set_batch_sizes(self, sizes: Sequence[int]) -> None:
        """Set the batch sizes, rounded up to multiples of the devices of this process."""
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
        """Detect the objects in one or more frames.

        Args:
            frames: Projections `[B, R, A, D+E]` or tesseracts `[B, D, R, E, A]` in linear
                power; a single frame without the axis B, which may also be of a reduced
                release, `[2, R, A, E]` or `[N, 11]`; the path of a file; or a list of
                such frames and paths. Alternatively a `Batch`, whose image and camera are
                used. A model of several frames takes consecutive frames, oldest first, on
                an axis of length `num_frames` after B; a list is one sample.
            image: Images for a radar-camera model: `[B, H, W, 3]` uint8, embedded images,
                or a list of arrays, paths and None.
            camera: One calibration for all frames, or a list with one per frame.
            score_threshold: Score threshold of this call; the detector's default if None.
            nms_iou: IoU threshold of NMS of this call; the detector's default if None.
            roi: Region of interest of this call; the detector's default if None.

        Returns:
            Detections of B frames, on the device.

        Raises:
            UserError: A shape, a number of images or cameras, or a setting is not as
                expected.
        """
        inputs: Any
        is_checked = True  # the content of a batch was checked when it was created
        if isinstance(frames, Batch):
            inputs = frames.projection, frames.image, frames.camera
        else:
            release = self.saved.config.data.release
            radar = radar_batch(frames, self.grid, self.num_frames, release)
            if self.num_frames > 1:
                shape = (-1, self.num_frames, *self.grid.projection_shape)
                samples = np.moveaxis(self._projections(radar).reshape(shape), 1, 0)
                radar = stack_frames(list(samples), self.grid.num_doppler)
            else:
                is_checked = not isinstance(radar, np.ndarray)
            image, camera, num_radar_only = camera_batch(
                image, camera, len(radar), self.model, self.camera_options
            )
            inputs = radar, image, camera
            with self._lock:
                self.num_radar_only += num_radar_only
        check_backbone(inputs[1], self.variables)
        options = {**self.decode_options, **_settings(score_threshold, nms_iou, roi)}
        options["roi"] = options["roi"] or UNBOUNDED_ROI
        settings = {name: np.asarray(options[name], np.float32) for name in SETTINGS}
        parts = []
        largest = self._batch_sizes[-1]
        for start in range(0, len(inputs[0]), largest):
            chunk = jax.tree.map(lambda x, s=start: x[s : s + largest], inputs)
            parts.append(self._detect(chunk, settings, is_checked))
        if len(parts) == 1:
            return parts[0]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)

    def _detect(self, inputs: Any, settings: Any, is_checked: bool) -> Detections:
        """Detect objects in at most as many frames as the largest batch size."""
        count = inputs[0].shape[0]
        size = next(size for size in self._batch_sizes if size >= count)
        inputs = jax.tree.map(lambda x: self.put(_padded(x, size)), inputs)
        # The check is awaited after the network was started, so that the device is not idle
        # meanwhile.
        extremes = None if is_checked else self._extremes(inputs[0])
        found = self._run(self.variables, *inputs, settings)
        if extremes is not None:
            self._count_invalid(inputs[0], extremes, count)
        if jax.default_backend() == "cpu" and len(self.sharding.device_set) > 1:
            # With several batches in flight, CPU devices that share cores can fail to
            # synchronize.
            jax.block_until_ready(found)
        found = found.replace(class_names=self.classes)
        return found if count == size else jax.tree.map(lambda x: x[:count], found)

    def _count_invalid(
        self, frames: Real[jax.Array, "B ..."], extremes: Any, count: int
    ) -> None:
        """Count invalid frames among the first `count`, and warn of the first ones.

        Invalid are values that cannot be linear power or levels of a projection, see
        `find_problem`. In uint8, every value is a valid level.
        """
        if frames.dtype == jnp.uint8:
            return
        lowest, beams = jax.device_get(extremes)
        find = functools.partial(_find_problem, frames.ndim - 1)
        problems = map(find, lowest[:count].tolist(), beams[:count])
        found = list(filter(None, problems))
        if found and not self.num_invalid_frames:
            _log.warning(
                "%d of %d frames are not linear power or its projection: %s. Their "
                "detections are meaningless; further ones are counted in "
                "num_invalid_frames",
                len(found),
                count,
                found[0],
            )
        with self._lock:
            self.num_invalid_frames += len(found)

    def _projections(
        self, radar: Real[Array, "B ..."]
    ) -> Float[np.ndarray, "B R A DE"]:
        """Compute float32 projections of any radar data, and count invalid NumPy arrays."""
        placed = jnp.asarray(radar)
        if isinstance(radar, np.ndarray):
            self._count_invalid(placed, self._extremes(placed), len(placed))
        if placed.ndim == 5:
            placed = self.grid.measured_channels(project_jax(placed))
        return np.asarray(to_float(placed))

    def stream(self, frames: Iterable[Any], **settings: Any) -> Iterator[Detections]:
        """Yield the detections of items in order, with up to two items in flight.

        The next item is read and prepared while the device processes the current one.
        Therefore a result is yielded after the next item was requested: for a live sensor,
        call the detector instead.

        For a model of several frames, the items are the frames of one sequence in their
        order, and the stream keeps the preceding ones. The first frame is repeated in place
        of those before it.

        Args:
            frames: Items that `__call__` of a model of one frame accepts as `frames`, or
                tuples of the frames, image and camera of an item.
            **settings: Keyword arguments of `__call__`.
        """
        started: list[Detections] = []
        history = None
        for item in frames:
            radar, *camera = item if isinstance(item, tuple) else (item,)
            if self.num_frames > 1 and not isinstance(radar, Batch):
                radar, history = self._samples(radar, history)
            started.append(self(radar, *camera, **settings))
            if len(started) > 1:
                yield started.pop(0)
        yield from started

    def _samples(
        self, frames: Frames, history: Float[np.ndarray, "T1 R A DE"] | None
    ) -> tuple[Float[jax.Array, "B T R A DE"], Float[np.ndarray, "T1 R A DE"]]:
        """Return the samples of consecutive frames, and the preceding ones of the next.

        Args:
            frames: Single frames as arrays or paths.
            history: The last T - 1 projections, or None before the first frame.
        """
        release = self.saved.config.data.release
        new = self._projections(radar_batch(frames, self.grid, release=release))
        past = self.num_frames - 1
        if history is None:
            history = np.repeat(new[:1], past, axis=0)
        known = np.concatenate([history, new])
        rows = np.arange(len(new))[:, None] + np.arange(self.num_frames)
        # Invalid frames were counted; those of arrays on a device are not counted again.
        return jnp.asarray(known[rows]), known[-past:]

    def warmup(self, *sample: Any) -> Detector:
        """Compile the model, so that the first call is fast.

        Args:
            *sample: Arguments of a call like those to come, such as one tesseract; or the
                batch size of projections (and images, for a radar-camera model), 1 by
                default.

        Returns:
            The detector itself.
        """
        if sample and not isinstance(sample[0], int):
            jax.block_until_ready(self(*sample))
            return self
        batch_size = sample[0] if sample else 1
        steps = (self.num_frames,) if self.num_frames > 1 else ()
        shape = (batch_size, *steps, *self.grid.projection_shape)
        inputs: tuple[Any, ...] = (np.zeros(shape, np.float32),)
        if self.takes_camera:
            images, camera = no_images(batch_size, self.model.options.image.size)
            inputs += images, camera.replace(is_valid=np.ones(batch_size, bool))
        jax.block_until_ready(self(*inputs))
        return self

    def detect_function(self) -> Callable[..., Detections]:
        """Return the pure function that is jitted: `detect` with this model and options."""
        mapping = self.saved.config.data.azimuth_mapping
        grid = models.map_grid(self.grid, self.model, mapping)
        return functools.partial(detect, self.model, grid, self.decode_options)

    def put(self, x: Shaped[Any, "b ..."]) -> Shaped[jax.Array, "B ..."]:
        """Copy the rows of this process to the devices; the caller may then reuse `x`.

        NumPy arrays need care: on CPU, `device_put` shares aligned memory regardless of
        `may_alias`, so the array is copied first; on other platforms the transfer is
        asynchronous, so the call waits for it.
        """
        if not isinstance(x, np.ndarray):
            return jax.device_put(x, self.sharding)
        if not x.flags.c_contiguous and _reversed(x).flags.c_contiguous:
            # Frames of column-major tensors, such as `scipy.io.loadmat` returns, are copied
            # as they are stored: the device reorders them faster than the host.
            return _reverse(self.put(_reversed(x)))
        is_cpu = jax.default_backend() == "cpu"
        x = x.copy() if is_cpu else x
        placed = jax.make_array_from_process_local_data(self.sharding, x)
        return placed if is_cpu else jax.block_until_ready(placed)


def _reversed(x: Shaped[Any, "B ..."]) -> Shaped[Any, "B ..."]:
    """Reverse the order of all axes but the first."""
    return x.transpose(0, *range(x.ndim - 1, 0, -1))


_reverse = jax.jit(_reversed)


def _padded(x: Shaped[Array, "b ..."], size: int) -> Shaped[Array, "{size} ..."]:
    """Pad a batch to a batch size by repeating its last frame."""
    count = x.shape[0]
    return x if count == size else x[np.minimum(np.arange(size), count - 1)]


# Inputs ------------------------------------------------------------------------------


def _read_paths(given: Any, read: Callable[[pathlib.Path, int], np.ndarray]) -> Any:
    """Replace paths by the arrays that they contain.

    An array is returned unchanged. A path or a list becomes a list of arrays and None.
    `read` is called with the path and its position in the list.
    """
    if not isinstance(given, str | os.PathLike | Sequence):
        return given
    entries = [given] if isinstance(given, _PATH) else given
    return [
        read(as_path(entry), index) if isinstance(entry, _PATH) else entry
        for index, entry in enumerate(entries)
    ]


def as_numbers(values: Any, name: str) -> Any:
    """Convert an array of any kind of real numbers to one that JAX accepts.

    Args:
        values: Array; those on a device are returned unchanged.
        name: Name of the array for the error message.

    Raises:
        UserError: The values are masked, or are not real numbers.
    """
    if isinstance(values, jax.Array):
        return values
    if np.ma.is_masked(values):
        count = np.ma.count_masked(values)
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


def radar_batch(
    frames: Frames, grid: RadarGrid, num_frames: int = 1, release: str | None = None
) -> Real[Any, "B ..."]:
    """Combine radar frames into one array with a leading axis B.

    Args:
        frames: Radar data: an array, a path, or a list of arrays and paths, see
            `Detector.__call__`.
        grid: Axes of the sensor.
        num_frames: Number T of frames of a sample.
        release: Form of the radar data that the model is for, `config.data.release`.
            Arrays of projections may be of any form.

    Returns:
        Projections `[B T, R, A, D+E]` or tesseracts `[B T, D, R, E, A]`.

    Raises:
        UserError: The shape is that of no radar data, the data have another form than
            `release`, or there is no frame.
        DataError: A file is corrupted, or one frame of a reduced release is not as in the
            release.
    """

    def read(path: pathlib.Path, _: int) -> np.ndarray:
        # Records have projections of any form.
        if path.suffix != ".npy" or path.name.startswith(("DERA_", *RELEASES)):
            check_release(release_of_file(path), release, str(path))
        return read_frame(path, grid)

    radar = _read_paths(frames, read)
    if isinstance(radar, list):
        if not radar:
            raise UserError("no frames: the list is empty")
        radar = np.stack([_projected(frame, grid, release) for frame in radar])
    radar = _projected(radar, grid, release)
    shape = tuple(np.shape(radar))
    projection, tesseract = grid.projection_shape, grid.shape_drea
    axes, steps = ("B", ()) if num_frames == 1 else (f"B, {num_frames}", (num_frames,))
    for frame in (projection, tesseract):
        if shape in ((*steps, *frame), (*shape[:1], *steps, *frame)) and shape[0]:
            if frame == tesseract:
                check_release(None, release, "frames")
            return radar.reshape(-1, *frame)
    text = (
        f"frames have shape {list(shape)}; expected projections [{axes}, R, A, D+E] = "
        f"[{axes}, {', '.join(map(str, projection))}] or tesseracts [{axes}, D, R, E, A] = "
        f"[{axes}, {', '.join(map(str, tesseract))}], or single frames [2, R, A, E] or "
        "[N, 11] of a reduced release"
    )
    if steps:
        text += f" of {num_frames} consecutive frames (config.data.num_frames), oldest "
        text += "first; Detector.stream takes single frames and keeps preceding ones"
    raise UserError(text)


def _projected(frames: Any, grid: RadarGrid, release: str | None) -> Any:
    """Convert an array to numbers, and frames of a reduced release to projections."""
    array = as_numbers(frames, "frames")
    if is_reduced(array, grid):
        if array.shape[1] != 4:  # an error below explains points [N, 4]
            found = "rpc" if array.ndim == 2 else "polar3d"
            check_release(found, release, "frames")
        return project_reduced(np.asarray(array), grid)
    return array


def _extremes(
    frames: Real[jax.Array, "B ..."],
) -> tuple[Float[jax.Array, " B"], Real[jax.Array, "B _ _"]]:
    """Compute the smallest value of each frame, and its maximum over range (and Doppler).

    The smallest value is -inf if the frame contains NaN or values below the valid ones. On
    a CPU, the compiler's minimum and maximum can ignore NaN, but comparisons do not.
    """
    axes, least = tuple(range(1, frames.ndim)), -MAX_LEVEL if frames.ndim == 4 else 0
    is_valid = (frames >= least).all(axes)
    lowest = jnp.where(is_valid, frames.min(axes).astype(jnp.float32), -jnp.inf)
    return lowest, frames.max(axis=1 if frames.ndim == 4 else (1, 2))


def _find_problem(
    num_axes: int, lowest: float, beams: Real[np.ndarray, "_ _"]
) -> str | None:
    """Describe why a frame of 3 axes (projection) or 4 is not valid; None if it is."""
    beams = beams.astype(np.float64)
    if num_axes == 3:
        return find_problem(beams, -1.0 if np.isneginf(lowest) else 0.0)
    with np.errstate(invalid="ignore"):  # the logarithm of a negative maximum
        return find_problem(to_log_scale(beams), lowest)


def camera_batch(
    image: Images | None,
    camera: Calibrations | None,
    num_frames: int,
    model: Any,
    options: CameraOptions,
) -> tuple[Real[Array, "B _ _ _"] | None, Camera | None, int]:
    """Convert images and cameras to arrays, as `data.pipeline` puts them into a `Batch`.

    Args:
        image: Images `[B, H, W, 3]` uint8 (or `[H, W, 3]` for a single frame), the output
            of `model.embed` for them, or a list with one image, path or None per frame.
        camera: One calibration for all frames, or a list with one (or None) per frame. A
            calibration is a `CameraCalibration`, the path of a K-Radar calibration file,
            or a `Camera`. A batched `Camera` is also accepted.
        num_frames: Number of frames B.
        model: The detector; a radar-only model takes neither images nor cameras.
        options: Options that define how calibrations are used.

    Returns:
        Images `[B, ...]` and a `Camera` with leading axes B, both None if no images are
        given, and the number of frames that a radar-camera model predicts without an
        image.

    Raises:
        UserError: A size or number is not as expected, only one of image and camera is
            given, or an image is missing where that is not allowed.
    """
    if not models.has_camera(model):
        if image is None and camera is None:
            return None, None, 0
        raise UserError("image and camera are given, but the model is radar-only")
    if (image is None) != (camera is None):
        raise UserError("image and camera belong together: give both or none")
    images, cameras, has_image = None, None, np.zeros(num_frames, bool)
    if image is not None:
        cameras = _cameras(camera, num_frames, model, options)
        images, has_image = _images(image, cameras, model, options.resize)
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
    image: Any, cameras: Camera, model: Any, resize: bool
) -> tuple[Real[Array, "B _ _ _"], Bool[np.ndarray, " B"]]:
    """Return the images as one array, and a mask that is True where an image is given."""
    sizes = ((*model.options.image.size, 3), model.feature_shape)
    sizes_px = np.asarray(cameras.size_px, int)

    def read(path: pathlib.Path, index: int) -> UInt8[np.ndarray, "H W 3"]:
        # A wrong number of images is reported later.
        width, height = sizes_px[min(index, len(sizes_px) - 1)]
        return read_left_image(
            path,
            model.options.image.size,
            resize=resize,
            calibrated_size=(height, width),
        )

    image = _read_paths(image, read)
    if isinstance(image, list):
        has_image = np.array([one is not None for one in image])
        empty = np.zeros(sizes[0], np.uint8)
        if has_image.any():
            empty = np.zeros_like(np.asarray(image[has_image.argmax()]))
        image = np.stack([empty if one is None else one for one in image])
    else:
        image = as_numbers(image, "image")
        image = image[None] if image.ndim == 3 else image
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
    """Combine the cameras of all frames into one batched `Camera`."""
    if isinstance(camera, Camera) and np.ndim(camera.is_valid) == 1:
        return camera
    if not isinstance(camera, list | tuple):
        camera = [camera] * num_frames
    none = no_camera(model.options.image.size)
    cameras = [none if one is None else _one_camera(one, options) for one in camera]
    return stack_cameras(cameras)


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


def check_backbone(
    image: Real[Array, "B _ _ _"] | None, variables: Mapping[str, Any]
) -> None:
    """Check that the variables contain the image backbone if images require it.

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


def _settings(
    score_threshold: float | None,
    nms_iou: float | None,
    roi: Sequence[float] | str | None,
) -> dict[str, Any]:
    """Return the given values by the names in `SETTINGS`, without those that are None."""
    given = {"score_threshold": score_threshold, "nms_iou": nms_iou}
    settings: dict[str, Any] = {k: float(v) for k, v in given.items() if v is not None}
    for name, value in settings.items():
        require(0 <= value <= 1, name, value, "a number from 0 to 1")
    if roi is not None:
        limits = ROIS.get(roi, ()) if isinstance(roi, str) else tuple(roi)
        require(is_roi(limits), "roi", roi, f"narrow, wide or {ROI_LIMITS}")
        settings["roi"] = limits
    return settings
