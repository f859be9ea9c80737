"""`Detector` computes boxes from radar tensors in one jitted call."""

from __future__ import annotations

import collections
import copy
import dataclasses
import functools
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import VariableDict
from jax.sharding import NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import Bool, Float, Int, PyTree, Real, Shaped

from radejax import models
from radejax.core.errors import require
from radejax.core.files import PathLike
from radejax.core.options import ClassThresholds
from radejax.core.structures import Array, Batch, Detections, to_float
from radejax.data import projection
from radejax.data.cameras import no_images
from radejax.data.projection import (
    find_invalid,
    project_jax,
    project_tensor,
    stack_frames,
    unstack_frames,
)
from radejax.detection.decode import DecodeOptions, decode
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference import inputs as reading
from radejax.inference.inputs import (
    Calibrations,
    Frames,
    Images,
    InputReader,
    Inputs,
    Settings,
)
from radejax.inference.saved import SavedModel, Step, load_model, load_torch
from radejax.weights.convert import StateDict

_log = logging.getLogger(__name__)

_NUM_UNCOUNTED = 8
"""Calls with arrays on a device whose invalid frames may not be counted yet."""

Item = Frames | Batch | tuple[Frames, Images | None, Calibrations | None]
"""Item of `Detector.stream`: frames, or a tuple of frames, image and camera."""


def network_input(
    frames: Real[Array, "B _ _ _"] | Real[Array, "B _ _ _ _"], grid: RadarGrid
) -> Float[jax.Array, "B R A DE"]:
    """Computes the network's input from projections as they are stored, or from tensors.

    Args:
        frames: `[B, R, A, DE]` projections, or `[B, D, R, E, A]` tensors in linear power.
        grid: Grid of the sensor or of the model's maps.
    """
    if frames.ndim == 5:
        frames = grid.measured_channels(project_jax(frames))
    return to_float(frames)


def check_frames(
    frames: Real[jax.Array, "B _ _ _"] | Real[jax.Array, "B _ _ _ _"], grid: RadarGrid
) -> tuple[Bool[jax.Array, "P B T"], Int[jax.Array, " B"]]:
    """Checks whether the values of samples can be radar data.

    Args:
        frames: `[B, R, A, C]` projections of T frames, see `stack_frames`, or
            `[B, D, R, E, A]` radar tensors (T is 1).
        grid: Grid of the sensor.

    Returns:
        A mask that is True where a frame has one of the P `projection.PROBLEMS`, and the
        int32 number of frames of each sample that have any.
    """
    if are_tensors := frames.ndim == 5:
        single = frames[:, None]
    else:
        num_frames = frames.shape[-1] // grid.projection_shape[-1]
        single = unstack_frames(frames, num_frames, grid.num_doppler)
    problems = jnp.stack(find_invalid(single, are_tensors=are_tensors))
    return problems, problems.any(axis=0).sum(axis=-1, dtype=jnp.int32)


def detect(
    model: nn.Module,
    grid: RadarGrid,
    options: DecodeOptions,
    variables: VariableDict,
    frames: Real[Array, "B R A DE"] | Real[Array, "B D R E A"],
    image: Real[Array, "B _ _ _"] | None = None,
    camera: PyTree[Array] | None = None,
    settings: Settings | None = None,
) -> Detections:
    """Computes detections from a batch of radar tensors.

    This is a pure function that can be jitted.

    Args:
        model: Radar or radar-camera detector.
        grid: Grid of the model's maps, see `models.map_grid`.
        options: Options of the decoding.
        variables: Variables of the model.
        frames: Projections as they are stored, or radar tensors in linear power.
        image: Images for a radar-camera model, or None to use the radar only.
        camera: Cameras of the images, or None without images.
        settings: Values that replace those in `options`; they may be traced.
    """
    inputs = () if image is None else (image, camera)
    maps: Any = model.apply(
        variables, network_input(frames, grid), *inputs, train=False
    )
    values = {} if settings is None else settings._asdict()
    return decode(maps, grid, options, **values)


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
        score_threshold: Default score threshold of calls: one, one per class, or those of
            some classes by name, such as `{"Pedestrian": 0.2}`; the config's if None.
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

    Examples:
        >>> detector = Detector.from_workdir("runs/quickstart")  # doctest: +SKIP
        >>> projection = project_file("tesseract_00033.mat")  # doctest: +SKIP
        >>> detector(projection).to_list()  # doctest: +SKIP
        >>> fusion = Detector.from_workdir("runs/quickstart_fusion")  # doctest: +SKIP
        >>> fusion(projection, ["cam-front_00001.png"], "cam_front0.yml")  # doctest: +SKIP
    """

    def __init__(
        self,
        saved: SavedModel,
        sharding: Sharding | None = None,
        *,
        score_threshold: ClassThresholds | None = None,
        nms_iou: float | None = None,
        roi: Sequence[float] | str | None = None,
        dtype: str | None = None,
        batch_sizes: Sequence[int] = (1, 2, 4, 8, 16, 32),
    ) -> None:
        changes = reading.check_settings(saved.config, score_threshold, nms_iou, roi)
        config = saved.config.replace(decode=changes)
        if dtype is not None:
            config = config.replace(model={"dtype": dtype})
        self.saved = dataclasses.replace(saved, config=config)
        self.grid = saved.grid
        self.model = self.saved.model
        self.num_frames = self.model.num_frames
        self.takes_camera = models.has_camera(self.model)
        self.camera_options = config.data.used_camera
        self.reader = InputReader(self.model, self.grid, config.data)
        self.classes = config.classes
        self.decode_options = config.decode
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
        self._reset_counters()
        self._num_unchecked = 3 if saved.usual_input else 0  # calls
        self._lock = threading.Lock()
        # Every process gets all detections: they are small.
        self._run = jax.jit(run, out_shardings=self.replicated)
        self._check = jax.jit(
            check_frames, static_argnames="grid", out_shardings=self.replicated
        )

    @classmethod
    def from_workdir(
        cls,
        path: PathLike,
        step: Step = None,
        *,
        image_backbone: PathLike | None = None,
        **options: Any,
    ) -> Detector:
        """Creates a detector from a training run or another model that `load_model` takes.

        Args:
            path: Workdir of `train.py`, its `checkpoints` or one of them, a folder of
                `radejax export`, or a checkpoint file of the authors' code.
            step: Step of the checkpoint, or "best"; the latest if None.
            image_backbone: Weights of a frozen image backbone. They are needed if the
                file that the run was trained with has moved, or if the exported folder
                does not contain them.
            **options: Keyword arguments of `Detector`.

        Raises:
            FileNotFoundError: There is no model, or no such checkpoint.
            UserError: An option or the image backbone does not fit the model.
            DataError: A file is corrupted.
        """
        saved = load_model(path, step=step, image_backbone=image_backbone)
        return cls(saved, **options)

    @classmethod
    def from_torch(
        cls,
        path_or_state_dict: PathLike | StateDict,
        *,
        image_backbone: PathLike | None = None,
        **options: Any,
    ) -> Detector:
        """Creates a detector from an official RADE-Net or DinoRADE checkpoint.

        Args:
            path_or_state_dict: File, or mapping of names to arrays, see `load_torch`.
            image_backbone: Folder of DINOv3, for DinoRADE files without its weights.
            **options: Keyword arguments of `Detector`.

        Raises:
            FileNotFoundError: There is no such file.
            UserError: The file needs weights of DINOv3, or an option is wrong.
            DataError: The file is corrupted, or of another network.
        """
        saved = load_torch(path_or_state_dict, image_backbone=image_backbone)
        return cls(saved, **options)

    def replace(
        self,
        *,
        variables: VariableDict | None = None,
        batch_sizes: Sequence[int] | None = None,
    ) -> Detector:
        """Returns a copy with other variables or batch sizes that shares compiled programs.

        The counters of the copy start at zero.

        Args:
            variables: Variables of the same shapes; those of this detector if None.
            batch_sizes: Batch sizes as for `Detector`; those of this detector if None.
        """
        other = copy.copy(self)
        other._lock = threading.Lock()
        other._reset_counters()
        if variables is not None:
            other.variables = jax.device_put(variables, self.replicated)
        if batch_sizes is not None:
            other._set_batch_sizes(batch_sizes)
        return other

    def _reset_counters(self) -> None:
        self.num_radar_only = self._num_invalid = 0
        self._uncounted = collections.deque[tuple[jax.Array, int]]()

    def _set_batch_sizes(self, sizes: Sequence[int]) -> None:
        """Sets the batch sizes, rounded up to multiples of the devices of this process."""
        is_possible = len(sizes) > 0 and min(sizes, default=0) >= 1
        require(is_possible, "batch_sizes", sizes, "integers of at least 1")
        count = len(self.sharding.addressable_devices)
        self._batch_sizes = sorted({-(-size // count) * count for size in sizes})

    # Use -----------------------------------------------------------------------------

    def __call__(
        self,
        frames: Frames | Batch | Inputs,
        image: Images | None = None,
        camera: Calibrations | None = None,
        *,
        score_threshold: ClassThresholds | None = None,
        nms_iou: float | None = None,
        roi: Sequence[float] | str | None = None,
    ) -> Detections:
        """Detects the objects in one or more frames.

        Args:
            frames: Projections `[B, R, A, D+E]` or radar tensors `[B, D, R, E, A]` in linear
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
        config = self.saved.config
        changes = reading.check_settings(config, score_threshold, nms_iou, roi)
        settings = Settings.of(config, changes)
        is_counted = True  # the content of a batch was checked when it was created
        if isinstance(frames, Batch):
            inputs = Inputs(frames.projection, frames.image, frames.camera)
        else:
            if isinstance(frames, Inputs):  # samples of `stream`
                radar = frames.radar
            elif self.num_frames > 1:
                single = self._projections(self._read_radar(frames, self.num_frames))
                radar = self._stacked(
                    single.reshape(-1, self.num_frames, *single.shape[1:])
                )
            else:
                radar = self._read_radar(frames)
                is_counted = False
            images, cameras, missing = self.reader.read_cameras(
                image, camera, len(radar)
            )
            inputs = Inputs(radar, images, cameras)
            with self._lock:
                self.num_radar_only += missing
        reading.check_backbone(inputs.image, self.variables)
        parts = list[Detections]()
        largest = self._batch_sizes[-1]
        for start in range(0, len(inputs.radar), largest):
            chunk = jax.tree.map(lambda x, s=start: x[s : s + largest], inputs)
            parts.append(self._detect(chunk, settings, is_counted))
        if len(parts) == 1:
            return parts[0]
        found: Detections = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        return found

    def _read_radar(self, frames: Frames, num_frames: int = 1) -> Real[Any, "B ..."]:
        """Reads radar data, and compares a frame of the first calls with the training's."""
        radar = self.reader.read_radar(frames, num_frames)
        if self._num_unchecked and isinstance(radar, np.ndarray):
            if radar.ndim == 5:  # on the host, as compiling takes longer
                levels = self.grid.measured_channels(project_tensor(radar[0]))
            else:
                levels = projection.decode(radar[0])
            is_usual = self.saved.check_input(float(levels.mean()), float(levels.std()))
            self._num_unchecked = self._num_unchecked - 1 if is_usual else 0
        return radar

    def _detect(
        self, inputs: Inputs, settings: Settings, is_counted: bool
    ) -> Detections:
        """Detects objects in at most as many frames as the largest batch size."""
        count = len(inputs.radar)
        is_host = isinstance(inputs.radar, np.ndarray)
        size = next(size for size in self._batch_sizes if size >= count)
        inputs = jax.tree.map(lambda x: self.put(_padded(x, size)), inputs)
        problems, num_invalid = self._check(inputs.radar, self.grid)
        found: Detections = self._run(self.variables, *inputs, settings)
        found = found.replace(num_invalid=num_invalid)
        if not is_counted:
            # The check of NumPy arrays is awaited after the network was started, so that
            # the device is not idle meanwhile. That of arrays on a device is awaited later.
            self._uncounted.append((problems, count))
            self._count_invalid(num_left=0 if is_host else _NUM_UNCOUNTED)
        if jax.default_backend() == "cpu" and len(self.sharding.device_set) > 1:
            # With several batches in flight, CPU devices that share cores can fail to
            # synchronize.
            jax.block_until_ready(found)
        if count < size:
            found = jax.tree.map(lambda x: x[:count], found)
        return found.replace(class_names=self.classes)

    @property
    def num_invalid_frames(self) -> int:
        """Number of frames so far whose values cannot be radar data.

        Their detections are meaningless. Frames in a `Batch` are not counted.
        """
        self._count_invalid(num_left=0)
        return self._num_invalid

    def _count_invalid(self, num_left: int) -> None:
        """Counts invalid frames, and warns of the first ones.

        Args:
            num_left: Number of the newest checks that are not awaited.
        """
        with self._lock:
            while len(self._uncounted) > num_left:
                problems, count = self._uncounted.popleft()
                found = np.asarray(problems)[:, :count]
                is_invalid = found.any(axis=0)
                num_invalid = int(is_invalid.sum())
                if num_invalid and not self._num_invalid:
                    first = found[:, is_invalid][:, 0]
                    _log.warning(
                        "%d of %d frames are not linear power or its projection: %s. "
                        "Their detections are meaningless; further ones are counted in "
                        "num_invalid_frames",
                        num_invalid,
                        is_invalid.size,
                        projection.PROBLEMS[first.argmax()],
                    )
                self._num_invalid += num_invalid

    # Consecutive frames --------------------------------------------------------------

    def _projections(
        self, radar: Real[Array, "B ..."]
    ) -> Float[np.ndarray, "B R A DE"]:
        """Computes float32 projections of any radar data, and counts invalid frames."""
        placed = jnp.asarray(radar)
        self._uncounted.append((self._check(placed, self.grid)[0], len(placed)))
        if placed.ndim == 5:
            # The maxima of a projection would hide negative power, and can ignore NaN.
            placed = jnp.where(placed >= 0, placed, jnp.inf)
        projections = np.asarray(network_input(placed, self.grid))
        self._count_invalid(num_left=0)
        return projections

    def _stacked(
        self, samples: Float[np.ndarray, "B T R A DE"]
    ) -> Float[np.ndarray, "B R A C"]:
        """Computes the network input of samples."""
        return stack_frames(list(np.moveaxis(samples, 1, 0)), self.grid.num_doppler)

    def _samples(
        self, frames: Frames, history: Float[np.ndarray, "T1 R A DE"] | None
    ) -> tuple[Inputs, Float[np.ndarray, "T1 R A DE"]]:
        """Returns the samples of consecutive frames, and the preceding ones of the next.

        Args:
            frames: Single frames as arrays or paths.
            history: The last T - 1 projections, or None before the first frame.
        """
        new = self._projections(self._read_radar(frames))
        past = self.num_frames - 1
        if history is None:
            history = np.repeat(new[:1], past, axis=0)
        known = np.concatenate([history, new])
        rows = np.arange(len(new))[:, None] + np.arange(self.num_frames)
        return Inputs(self._stacked(known[rows])), known[-past:]

    def stream(self, frames: Iterable[Item], **settings: Any) -> Iterator[Detections]:
        """Yields the detections of items in order, with up to two items in flight.

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

        Yields:
            Detections of one item, on the device.

        Raises:
            UserError: As `__call__`.
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

    def warmup(
        self,
        sample: int | Frames | Batch = 1,
        image: Images | None = None,
        camera: Calibrations | None = None,
    ) -> Detector:
        """Compiles the model, so that the first call is fast.

        Args:
            sample: Frames like those of later calls, such as one radar tensor; or the batch
                size of projections (and images, for a radar-camera model).
            image: Images like those of later calls.
            camera: Calibrations like those of later calls.

        Returns:
            The detector itself.
        """
        made = self
        if isinstance(sample, int):
            made = self.replace()
            made._num_unchecked = 0
            made._num_invalid = 1  # no warning of the frames, which are empty
            count = sample
            steps = (self.num_frames,) if self.num_frames > 1 else ()
            sample = np.zeros((count, *steps, *self.grid.projection_shape), np.float32)
            if models.has_camera(self.model):
                image, blank = no_images(count, self.model.options.image.size)
                camera = blank.replace(is_valid=np.ones(count, bool))
        jax.block_until_ready(made(sample, image, camera))
        return self

    def detect_function(self) -> Callable[..., Detections]:
        """Returns the pure function that is jitted: `detect` with this model and options."""
        mapping = self.saved.config.data.azimuth_mapping
        grid = models.map_grid(self.grid, self.model, mapping)
        return functools.partial(detect, self.model, grid, self.decode_options)

    def put(self, x: Shaped[Array, "b ..."]) -> Shaped[jax.Array, "B ..."]:
        """Copies the rows of this process to the devices; the caller may then reuse `x`.

        NumPy arrays need care: on CPU, `device_put` shares aligned memory regardless of
        `may_alias`, so the array is copied first; on other platforms the transfer is
        asynchronous, so the call waits for it.

        Args:
            x: The rows of this process.

        Returns:
            The rows of all processes, as the sharding places them.
        """
        placed: jax.Array
        is_cpu = jax.default_backend() == "cpu"
        if not isinstance(x, np.ndarray):
            placed = jax.device_put(x, self.sharding)
        elif not x.flags.c_contiguous and _reversed(x).flags.c_contiguous:
            # Frames of column-major tensors, such as `scipy.io.loadmat` returns, are copied
            # as they are stored: the device reorders them faster than the host.
            placed = _reverse(self.put(_reversed(x)))
        elif is_cpu:
            placed = jax.make_array_from_process_local_data(self.sharding, x.copy())
        else:
            placed = jax.make_array_from_process_local_data(self.sharding, x)
            jax.block_until_ready(placed)
        return placed


def _reversed(x: Shaped[Any, "B ..."]) -> Shaped[Any, "B ..."]:
    """Reverses the order of all axes but the first."""
    return x.transpose(0, *range(x.ndim - 1, 0, -1))


_reverse = jax.jit(_reversed)


def _padded(x: Shaped[Array, "b ..."], size: int) -> Shaped[Array, "{size} ..."]:
    """Pads a batch to a batch size by repeating its last frame."""
    count = x.shape[0]
    return x if count == size else x[np.minimum(np.arange(size), count - 1)]
