"""`Detector`: radar tensors in, boxes out, in one jitted call."""

from __future__ import annotations

import copy
import dataclasses
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec, Sharding, SingleDeviceSharding
from jaxtyping import Real, Shaped

from radejax import models
from radejax.core.errors import UserError, require
from radejax.core.files import PathLike
from radejax.core.structures import Array, Batch, Detections, to_float
from radejax.data.cameras import CameraOptions
from radejax.data.projection import project_jax
from radejax.detection.decode import DecodeOptions, decode
from radejax.geometry.radar_grid import RadarGrid
from radejax.inference import inputs as detector_inputs
from radejax.inference.saved import SavedModel, Step, load_model, load_torch

UNBOUNDED_ROI = (-np.inf, np.inf, -np.inf, np.inf, -np.inf, np.inf)


def detect(
    model: nn.Module,
    grid: RadarGrid,
    options: Mapping[str, Any],
    variables: Any,
    frames: Real[Array, "B R A DE"] | Real[Array, "B D R E A"],
    image: Real[Array, "B _ _ _"] | None = None,
    camera: Any = None,
    *,
    is_tesseract: bool = False,
) -> Detections:
    """From a batch of radar tensors to detections; pure, to be jitted.

    Args:
        model: Radar or radar-camera detector.
        grid: Of its maps, see `models.map_grid`.
        options: Keyword arguments of `radejax.detection.decode.decode`.
        variables: Of the model.
        frames: Projections as they are stored, or tesseracts.
        image: Of a radar-camera model, or None for the radar alone.
        camera: Likewise.
        is_tesseract: `frames` are tesseracts, linear power.
    """
    if is_tesseract:
        frames = project_jax(frames)
    inputs = (to_float(frames),) if image is None else (to_float(frames), image, camera)
    maps: Any = model.apply(variables, *inputs, train=False)
    return decode(maps, grid, **options)


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
        if score_threshold is not None:
            config.decode.score_threshold = float(score_threshold)
        if nms_iou is not None:
            config.decode.nms_iou = float(nms_iou)
        if roi is not None:
            config.decode.roi = tuple(detector_inputs.named_region(roi))
        if dtype is not None:
            config.model.dtype = dtype
        self.saved = dataclasses.replace(saved, config=config)
        self.grid, self.step = saved.grid, saved.step
        self.model: Any = self.saved.model
        self.takes_camera = models.has_camera(self.model)
        self.camera_options = CameraOptions.from_config(config.data)
        self.classes = tuple(config.classes)
        options = dataclasses.asdict(DecodeOptions(**config.decode))
        self.score_threshold: float = options.pop("score_threshold")
        self.nms_iou: float = options.pop("nms_iou")
        self.roi = options.pop("roi")
        self.decode_options: dict[str, Any] = options
        self.sharding = sharding or SingleDeviceSharding(jax.devices()[0])
        self.replicated = (
            NamedSharding(self.sharding.mesh, PartitionSpec())
            if isinstance(self.sharding, NamedSharding)
            else self.sharding
        )
        devices: set[Any] = self.sharding.device_set
        self.num_processes = len({device.process_index for device in devices})
        self._set_batch_sizes(batch_sizes)
        self.variables = jax.device_put(saved.variables, self.replicated)
        self.num_radar_only = self.num_invalid_frames = 0
        self._lock = threading.Lock()
        # Every process gets all detections: they are small.
        self._run = jax.jit(
            self.detect_function(),
            static_argnames="is_tesseract",
            out_shardings=self.replicated,
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
        """Detector of a training run.

        Args:
            path: Workdir of `train.py`; or anything else that `load_model` takes.
            step: Step of the checkpoint, or "best"; the latest if None.
            image_backbone: Weights of a frozen image backbone, if they are not where
                the run was trained from.
            **options: Arguments of `Detector`.

        Raises:
            FileNotFoundError: There is no run, or no such checkpoint.
        """
        saved = load_model(path, step=step, image_backbone=image_backbone)
        return cls(saved, **options)

    @classmethod
    def from_checkpoint(
        cls, path: PathLike, *, image_backbone: PathLike | None = None, **options: Any
    ) -> Detector:
        """Detector of an exported folder, or of one checkpoint without its run.

        Args:
            path: See `load_model`.
            image_backbone: Weights of the image backbone, if the folder has none.
            **options: Arguments of `Detector`.
        """
        return cls(load_model(path, image_backbone=image_backbone), **options)

    @classmethod
    def from_torch(
        cls,
        path_or_state_dict: PathLike | Mapping[str, Any],
        *,
        image_backbone: PathLike | None = None,
        model_overrides: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> Detector:
        """Detector of an official RADE-Net or DinoRADE checkpoint.

        Args:
            path_or_state_dict: File, or mapping of names to arrays, see `load_torch`.
            image_backbone: Folder of DINOv3, for DinoRADE files without its weights.
            model_overrides: Fields of the model that names and shapes do not determine.
            **options: Arguments of `Detector`.
        """
        overrides = model_overrides or {}
        saved = load_torch(
            path_or_state_dict, image_backbone=image_backbone, **overrides
        )
        return cls(saved, **options)

    def __repr__(self) -> str:
        grid = " x ".join(map(str, self.grid.shape_drea))
        return (
            f"Detector({type(self.model).__name__}, grid {grid}, classes "
            f"{', '.join(self.classes)}, step {self.step}, on {self.sharding})"
        )

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
        frames: detector_inputs.Frames | Batch,
        image: detector_inputs.Images | None = None,
        camera: detector_inputs.Calibrations | None = None,
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
            is_tesseract = False
            inputs = frames.projection, frames.image, frames.camera
        else:
            radar, is_tesseract = detector_inputs.radar_batch(frames, self.grid)
            inputs = radar, *self._camera_inputs(image, camera, len(radar))
            num_invalid = detector_inputs.count_invalid(
                radar, is_tesseract, warn=not self.num_invalid_frames
            )
            with self._lock:
                self.num_invalid_frames += num_invalid
        detector_inputs.check_backbone(inputs[1], self.variables)
        roi = self.roi if roi is None else detector_inputs.named_region(roi)
        settings = (
            np.float32(
                self.score_threshold if score_threshold is None else score_threshold
            ),
            np.float32(self.nms_iou if nms_iou is None else nms_iou),
            np.asarray(UNBOUNDED_ROI if roi is None else roi, np.float32),
        )
        parts = []
        largest = self._batch_sizes[-1]
        for start in range(0, len(inputs[0]), largest):
            chunk = jax.tree.map(lambda x, s=start: x[s : s + largest], inputs)
            parts.append(self._detect(chunk, settings, is_tesseract))
        if len(parts) == 1:
            return parts[0]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)

    def _camera_inputs(self, image: Any, camera: Any, num_frames: int) -> Any:
        """Images and cameras as arrays; counts the frames without."""
        if not self.takes_camera:
            if image is None and camera is None:
                return None, None
            raise UserError("image and camera are given, but the model is radar-only")
        image, camera, num_missing = detector_inputs.prepare(
            image, camera, num_frames, self.model, self.camera_options
        )
        with self._lock:
            self.num_radar_only += num_missing
        return image, camera

    def _detect(self, inputs: Any, settings: Any, is_tesseract: bool) -> Detections:
        """Detections of at most the largest batch size."""
        count = inputs[0].shape[0]
        size = next(size for size in self._batch_sizes if size >= count)
        inputs = jax.tree.map(lambda x: self.put(_padded(x, size)), inputs)
        found = self._run(self.variables, *inputs, *settings, is_tesseract=is_tesseract)
        if jax.default_backend() == "cpu" and len(self.sharding.device_set) > 1:
            # Devices that share cores miss each other where batches pile up.
            jax.block_until_ready(found)
        return found if count == size else jax.tree.map(lambda x: x[:count], found)

    def stream(self, frames: Iterable[Any], **settings: Any) -> Iterator[Detections]:
        """Detections of one item after the other, each started before the last ends.

        Reading and projecting the next item overlap with the work of the device.

        Args:
            frames: Items as `__call__` takes them first; a tuple is frames, image and
                camera.
            **settings: Keyword arguments of `__call__`.
        """
        pending = None
        for item in frames:
            started = self(*(item if isinstance(item, tuple) else (item,)), **settings)
            if pending is not None:
                yield pending
            pending = started
        if pending is not None:
            yield pending

    def warmup(
        self, batch_size: int = 1, *, tesseract: bool = False, image: bool | None = None
    ) -> Detector:
        """Compile for a batch size, so that the first call is fast.

        Args:
            batch_size: Of the calls to come.
            tesseract: They pass tesseracts, not projections.
            image: They pass images; None: if the model takes them.
        """
        shape = self.grid.shape_drea if tesseract else self.grid.projection_shape
        inputs: tuple[Any, ...] = (np.zeros((batch_size, *shape), np.float32),)
        if self.takes_camera and image in (None, True):
            images, camera = detector_inputs.placeholder(batch_size, self.model)
            inputs += images, camera.replace(is_valid=np.ones(batch_size, bool))
        jax.block_until_ready(self(*inputs))
        return self

    def detect_function(self) -> Callable[..., Detections]:
        """The pure function that is jitted: `detect` of this model and options.

        Its arguments are variables, frames, image, camera (or None, None), score
        threshold, NMS IoU, region `[6]`, and the keyword `is_tesseract`.
        """
        mapping = self.saved.config.data.azimuth_mapping
        grid = models.map_grid(self.grid, self.model, mapping)

        def function(
            variables: Any,
            frames: jax.Array,
            image: jax.Array | None,
            camera: Any,
            score_threshold: jax.Array,
            nms_iou: jax.Array,
            roi: jax.Array,
            *,
            is_tesseract: bool,
        ) -> Detections:
            thresholds = {"score_threshold": score_threshold, "nms_iou": nms_iou}
            options = {**self.decode_options, **thresholds, "roi": roi}
            inputs = variables, frames, image, camera
            found = detect(
                self.model, grid, options, *inputs, is_tesseract=is_tesseract
            )
            return found.replace(class_names=self.classes)

        return function

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
    if x.shape[0] == size:
        return x
    xp: Any = np if isinstance(x, np.ndarray) else jnp
    return xp.concatenate([x, xp.repeat(x[-1:], size - x.shape[0], 0)])
