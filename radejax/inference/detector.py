"""`Detector`: tensors in, boxes out, in one jitted call."""

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

from radejax import models
from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, Array, Batch, Detections
from radejax.data.cameras import CameraOptions
from radejax.geometry.camera import Camera
from radejax.geometry.radar_grid import AzimuthMapping, RadarGrid
from radejax.inference import inputs as detector_inputs
from radejax.inference.open import (
    LoadedModel,
    PathLike,
    Step,
    load,
    load_torch,
    settings_of_config,
)
from radejax.inference.program import detect
from radejax.models.lifting import ReferencePoints

EVERYWHERE = (-np.inf, np.inf, -np.inf, np.inf, -np.inf, np.inf)


class Detector:
    """A trained model with everything between a radar tensor and boxes.

    One object may be shared by threads. Batches are padded to a few fixed sizes, so
    that any number of frames compiles at most `len(batch_sizes)` programs per input
    kind; thresholds and region can change without compiling again.

    Args:
        model: From `radejax.models.build`.
        variables: Its parameters and other collections.
        grid: Of the sensor.
        classes: Names in the order of the heatmap's channels.
        decode_options: Static keyword arguments of `radejax.detection.decode.decode`:
            max_detections, threshold_inclusive, per_class_nms, z0_m, raw_yaw,
            clip_sizes; and roi, for calls and a detector that give none.
        azimuth_mapping: "true", or "stretched" for official checkpoints.
        score_threshold: Default of calls.
        nms_iou: Default of calls.
        roi: Default of calls: x, y, z limits `(x0, x1, y0, y1, z0, z1)`, "narrow",
            "wide" or None.
        batch_sizes: Sizes that are compiled.
        device: Where to run: a device or a platform, "cpu" or "gpu"; JAX's default
            device if None.
        dtype: Of the computation, "float32" or "bfloat16"; the model's own if None.
        camera_options: How calibrations are used by a radar-camera model.

    Attributes:
        num_radar_alone: Frames that a radar-camera model has so far predicted without
            an image.

    Examples:
        >>> detector = Detector.from_workdir("runs/quickstart")  # doctest: +SKIP
        >>> detector(projection).to_list()  # doctest: +SKIP
        >>> fusion(projection, images, calibration)  # doctest: +SKIP
    """

    def __init__(
        self,
        model: nn.Module,
        variables: Mapping[str, Any],
        grid: RadarGrid,
        *,
        classes: Sequence[str] = CLASSES,
        decode_options: Mapping[str, Any] | None = None,
        azimuth_mapping: AzimuthMapping = "true",
        score_threshold: float = 0.3,
        nms_iou: float = 0.3,
        roi: Sequence[float] | str | None = None,
        batch_sizes: Sequence[int] = (1, 2, 4, 8, 16, 32),
        device: jax.Device | str | None = None,
        dtype: str | None = None,
        camera_options: CameraOptions = CameraOptions(),  # noqa: B008, frozen
    ) -> None:
        self.model = model = model if dtype is None else models.with_dtype(model, dtype)
        self.takes_camera = models.has_camera(model)
        self.camera_options = camera_options
        self.num_radar_alone = 0
        self._impossible = detector_inputs.ImpossibleFrames()
        self._lock = threading.Lock()
        self.grid = grid
        self.classes = tuple(classes)
        self.score_threshold = score_threshold
        self.nms_iou = nms_iou
        self.step: int | None = None
        self.device = detector_inputs.named_device(device)
        self.variables = jax.device_put(variables, self.device)
        self._batch_sizes = detector_inputs.checked_sizes(batch_sizes)
        self.azimuth_mapping = azimuth_mapping
        self.decode_options = {"max_detections": 100, **(decode_options or {})}
        roi = self.decode_options.get("roi") if roi is None else roi
        self.roi = detector_inputs.named_region(roi)
        self._run = jax.jit(self.detect_function(), static_argnames="is_tesseract")

    # Construction --------------------------------------------------------------------

    @classmethod
    def from_loaded(cls, loaded: LoadedModel, **overrides: Any) -> Detector:
        """Detector of what `radejax.inference.open.load` returned."""
        settings = {**loaded.settings, **overrides}
        detector = cls(loaded.model, loaded.variables, loaded.grid, **settings)
        detector.step = loaded.step
        return detector

    def __repr__(self) -> str:
        grid = " x ".join(map(str, self.grid.shape_drea))
        return (
            f"Detector({type(self.model).__name__}, grid {grid}, classes "
            f"{', '.join(self.classes)}, step {self.step}, on {self.device})"
        )

    @classmethod
    def from_workdir(
        cls,
        path: PathLike,
        step: Step = None,
        *,
        image_backbone: PathLike | None = None,
        **overrides: Any,
    ) -> Detector:
        """Detector of a training run.

        Args:
            path: Work folder of `train.py`.
            step: Of the checkpoint, or "best"; the newest if None.
            image_backbone: Weights of a frozen image backbone, where they are not at
                the place any more that the run was trained from.
            **overrides: Arguments of `Detector`.

        Raises:
            FileNotFoundError: No run or no such checkpoint there.
        """
        loaded = load(path, step=step, image_backbone=image_backbone)
        return cls.from_loaded(loaded, **overrides)

    @classmethod
    def from_checkpoint(
        cls,
        path: PathLike,
        *,
        image_backbone: PathLike | None = None,
        **overrides: Any,
    ) -> Detector:
        """Detector of a folder with a model, wherever it came from.

        Args:
            path: What `radejax export` wrote, in either format; the `checkpoints`
                folder of a run, or one step in it (without the rest of the run); or
                the run itself.
            image_backbone: Folder of DINOv3's weights, for packed radar-camera models,
                which are without them.
            **overrides: Arguments of `Detector`.

        Raises:
            FileNotFoundError: There is no model in that folder.
        """
        return cls.from_loaded(load(path, image_backbone=image_backbone), **overrides)

    @classmethod
    def from_torch(
        cls,
        path_or_state_dict: PathLike | Mapping[str, Any],
        *,
        grid: RadarGrid | None = None,
        image_backbone: PathLike | None = None,
        model_overrides: Mapping[str, Any] | None = None,
        **overrides: Any,
    ) -> Detector:
        """Detector of an official RADE-Net or DinoRADE checkpoint.

        Args:
            path_or_state_dict: `.pth` file, or mapping of names to arrays. Names with
                `rad_backbone.` are DinoRADE's.
            grid: K-Radar's if None.
            image_backbone: Folder of DINOv3's weights, for DinoRADE checkpoints
                without them.
            model_overrides: For what names and shapes cannot tell.
            **overrides: Arguments of `Detector`.
        """
        loaded = load_torch(
            path_or_state_dict, image_backbone=image_backbone, **(model_overrides or {})
        )
        if grid is not None:
            loaded = dataclasses.replace(loaded, grid=grid)
        return cls.from_loaded(loaded, **overrides)

    @classmethod
    def from_config(
        cls,
        config: Mapping[str, Any],
        variables: Mapping[str, Any],
        grid: RadarGrid,
        **overrides: Any,
    ) -> Detector:
        """Detector with the model, thresholds and mapping that a config states."""
        arguments = settings_of_config(config) | overrides
        return cls(models.build(config["model"]), variables, grid, **arguments)

    @property
    def num_impossible(self) -> int:
        """Frames so far with a cell that no power gives (NaN, infinite): their boxes mean
        nothing. The first is warned of, of arrays on a device at a later call or here.
        """
        return self._impossible.total()

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
        """Finds the objects in one frame or many.

        Args:
            frames: Projections `[B, R, A, D+E]` or `[R, A, D+E]` as
                `radejax.data.projection.project` makes them; tesseracts
                `[B, D, R, E, A]` or `[D, R, E, A]` in linear power, projected on the
                device; the path of a tesseract or projection file; a list of such
                arrays or paths; or a `Batch`, with its images and cameras. Arrays are
                copied: their memory may be refilled after the call.
            image: Left front images for radar-camera models: `[B, H, W, 3]` uint8, or
                a list with one image, path or None a frame.
            camera: Their calibration: one for all frames, or a list with one (or None)
                a frame; see `radejax.inference.inputs.prepare`. Frames without image or
                calibration are predicted from the radar alone and counted in
                `num_radar_alone`, or are an error, as `camera_options` say.
            score_threshold: Instead of the detector's own.
            nms_iou: Likewise.
            roi: Likewise; `(x0, x1, y0, y1, z0, z1)` in metres.

        Returns:
            Detections with a leading batch axis, also for a single frame.

        Raises:
            UserError: The shape fits neither, or frames of a list differ in shape;
                says what was expected.
        """
        if isinstance(frames, Batch):
            image, camera = frames.image, frames.camera
            frames = frames.projection
        radar, is_tesseract = detector_inputs.radar_batch(frames, self.grid)
        num_frames = radar.shape[0]
        if num_frames == 0:
            raise UserError("no frames: the batch is empty")
        self._impossible.look(radar, is_tesseract)
        given = radar, *self._camera_inputs(image, camera, num_frames)
        roi = self.roi if roi is None else detector_inputs.named_region(roi)
        settings = (
            np.float32(
                self.score_threshold if score_threshold is None else score_threshold
            ),
            np.float32(self.nms_iou if nms_iou is None else nms_iou),
            np.asarray(EVERYWHERE if roi is None else roi, np.float32),
        )
        largest = self._batch_sizes[-1]
        parts = []
        for start in range(0, num_frames, largest):
            chunk = jax.tree.map(lambda x, s=start: x[s : s + largest], given)
            count = chunk[0].shape[0]
            size = next(s for s in self._batch_sizes if s >= count)
            chunk = jax.tree.map(
                lambda x, s=size: detector_inputs.pad_batch(x, s), chunk
            )
            chunk = jax.tree.map(self._to_device, chunk)
            found = self._run(
                self.variables, *chunk, *settings, is_tesseract=is_tesseract
            )
            parts.append(jax.tree.map(lambda x, n=count: x[:n], found))
        if len(parts) == 1:
            return parts[0]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)

    def warmup(
        self, batch_size: int = 1, *, tesseract: bool = False, image: bool | None = None
    ) -> Detector:
        """Compiles for a batch size, so that the first real call is fast.

        Args:
            batch_size: Of the calls to come.
            tesseract: They give tesseracts, not projections.
            image: They give images; None: if the model takes them.
        """
        shape = self.grid.shape_drea if tesseract else self.grid.projection_shape
        inputs: tuple[Any, ...] = (np.zeros((batch_size, *shape), np.float32),)
        if self.takes_camera and image in (None, True):
            pictures, camera = detector_inputs.placeholder(batch_size, self.model)
            inputs += pictures, camera.replace(is_valid=np.ones(batch_size, bool))
        jax.block_until_ready(self(*inputs))
        return self

    def with_batch_sizes(self, batch_sizes: Sequence[int]) -> Detector:
        """The same detector compiling other batch sizes; weights are shared."""
        other = copy.copy(self)
        other._batch_sizes = detector_inputs.checked_sizes(batch_sizes)
        other._impossible = detector_inputs.ImpossibleFrames()
        return other

    def stream(self, frames: Iterable[Any], **settings: Any) -> Iterator[Detections]:
        """Detections of one item after the other, each started before the last ends.

        Reading and projecting the next item overlap with the device's work on this.

        Args:
            frames: Items as `__call__` takes them first; a tuple is frames, image and
                camera.
            **settings: Keyword arguments of `__call__`.
        """
        pending = None
        for item in frames:
            inputs = item if isinstance(item, tuple) else (item,)
            started = self(*inputs, **settings)
            if pending is not None:
                yield pending
            pending = started
        if pending is not None:
            yield pending

    # Inside --------------------------------------------------------------------------

    def detect_function(self) -> Callable[..., Detections]:
        """The pure function that is jitted: `detect` of this model and options.

        Its arguments are variables, frames, image, camera (or None, None), score
        threshold, NMS IoU, region `[6]`, and the keyword `is_tesseract`.
        """
        grid = models.map_grid(self.grid, self.model, self.azimuth_mapping)

        def function(
            variables: Mapping[str, Any],
            frames: jax.Array,
            image: jax.Array | None,
            camera: Camera | ReferencePoints | None,
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

    def _camera_inputs(
        self,
        image: detector_inputs.Images | None,
        camera: detector_inputs.Calibrations | None,
        num_frames: int,
    ) -> tuple[Array | None, Camera | ReferencePoints | None]:
        """Images and cameras as arrays; counts the frames without."""
        if not self.takes_camera:
            if image is None and camera is None:
                return None, None
            raise UserError("image and camera are given, but the model is radar alone")
        image, camera, num_missing = detector_inputs.prepare(
            image, camera, num_frames, self.model, self.camera_options
        )
        detector_inputs.check_backbone(image, self.variables)
        with self._lock:
            self.num_radar_alone += num_missing
        return image, camera

    def _to_device(self, x: Any) -> jax.Array:
        """Copy on the device: the caller may refill its memory at once.

        On CPU `device_put` shares aligned memory whatever `may_alias` says; elsewhere
        the transfer reads it after the call returns.
        """
        if not isinstance(x, np.ndarray):
            return jax.device_put(x, self.device)
        if self.device.platform == "cpu":
            return jax.device_put(x.copy(), self.device)
        return jax.block_until_ready(jax.device_put(x, self.device))
