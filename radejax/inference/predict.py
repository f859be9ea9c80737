"""Detections on whole data sets, on all devices of all processes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
import tqdm
from jaxtyping import Int, Shaped

from radejax import models
from radejax.core.errors import UserError
from radejax.core.structures import Array, Batch, Detections
from radejax.data.cameras import CameraInputs
from radejax.data.dataset import FrameSequence
from radejax.data.frame_table import make_table
from radejax.data.pipeline import LoaderOptions, make_loader
from radejax.data.records.projections import RecordSource
from radejax.geometry.radar_grid import AzimuthMapping, RadarGrid
from radejax.inference.detector import Detector
from radejax.inference.inputs import check_backbone
from radejax.inference.program import detect
from radejax.training import processes, sharding

Found = tuple[Detections, Int[Array, " B"]]


class Predictor:
    """A model with decoding and NMS, compiled once for the devices of a mesh.

    It needs `update` with the model's variables before its first call.

    Args:
        model: Radar or radar-camera detector.
        grid: Of the sensor.
        classes: Names in the order of the heatmap's channels.
        decode: Keyword arguments of `radejax.detection.decode.decode`.
        azimuth_mapping: "true", or "stretched" for official checkpoints.
        mesh: All devices if None.
    """

    def __init__(
        self,
        model: nn.Module,
        grid: RadarGrid,
        *,
        classes: Sequence[str],
        decode: Mapping[str, Any],
        azimuth_mapping: AzimuthMapping = "true",
        mesh: jax.sharding.Mesh | None = None,
    ) -> None:
        self.mesh = sharding.make_mesh() if mesh is None else mesh
        self.classes = tuple(classes)
        self.update(None)
        map_grid = models.map_grid(grid, model, azimuth_mapping)

        def predict(variables: Any, batch: Batch) -> Found:
            inputs = batch.projection, batch.image, batch.camera
            return detect(model, map_grid, decode, variables, *inputs), batch.frame

        # Every process gets all detections: they are small.
        self._run = jax.jit(predict, out_shardings=sharding.replicated(self.mesh))

    def update(self, variables: Mapping[str, Any] | None) -> None:
        """Takes other variables of the same shapes; nothing is compiled again."""
        self._variables = jax.device_put(variables, sharding.replicated(self.mesh))

    def rows(self, batch_size: int) -> int:
        """Frames that one process reads for a batch of at least `batch_size`."""
        devices = self.mesh.devices.size
        return -(-batch_size // devices) * devices // jax.process_count()

    def __call__(self, batch: Batch) -> Found:
        """Detections of a global batch, of which each process gives its rows.

        Args:
            batch: NumPy arrays `[rows, ...]`.

        Returns:
            Detections and int32 `Batch.frame`, of the rows of all processes.

        Raises:
            UserError: Images are given, and the variables are without the weights of
                the image backbone.
        """
        check_backbone(batch.image, self._variables)
        # Ground truth is not looked at; its shapes must not make it compile again.
        none = np.zeros((len(batch.frame), 0), np.float32)
        batch = batch.replace(boxes=none, classes=none, is_valid=none)
        batch = sharding.put_batch(batch, self.mesh)
        with jax.transfer_guard("disallow"):
            found = self._run(self._variables, batch)
        if jax.default_backend() == "cpu" and self.mesh.devices.size > 1:
            # Devices that share cores miss each other where batches pile up.
            jax.block_until_ready(found)
        return found


def predict_dataset(
    detector: Predictor | Detector,
    records: RecordSource,
    frames: FrameSequence,
    batch_size: int = 8,
    *,
    images: CameraInputs | None = None,
    progress: bool = True,
    should_stop: Callable[[], bool] | None = None,
) -> dict[str, Shaped[np.ndarray, "N ..."]]:
    """Detections on every frame of a data set; the same on every process.

    Args:
        detector: A `Predictor` works on all devices, a `Detector` on its own one.
        records: Projections of the frames.
        frames: Which frames, in which order.
        batch_size: Frames at once; rounded up to a multiple of the devices.
        images: Of these frames, for a radar-camera model, see `data.cameras`.
        progress: Show a bar.
        should_stop: Asked before every batch.

    Returns:
        Columns "frame" (position in `frames`), "box", "cls", "score", by frame and
        falling score.

    Raises:
        UserError: There are no frames.
        processes.Stopped: `should_stop` said so.
    """
    if not len(frames):
        raise UserError("no frames to detect objects in")
    on_mesh = isinstance(detector, Predictor)
    table = make_table(
        records,
        frames,
        max_objects=max(len(frame.boxes) for frame in frames) or 1,
        classes=detector.classes,
        images=images,
    )
    if isinstance(detector, Predictor):
        batch_size = detector.rows(batch_size)
    options = LoaderOptions(
        batch_size=batch_size,
        shuffle=False,
        num_epochs=1,
        drop_remainder=False,
        pad_remainder=on_mesh,  # a `Detector` does it itself
        process_index=None if on_mesh else 0,
        process_count=None if on_mesh else 1,
    )
    loader = make_loader(table, options)

    def start(batch: Batch) -> Found:
        if isinstance(detector, Predictor):
            return detector(batch)
        return detector(batch.projection, batch.image, batch.camera), batch.frame

    parts: list[dict[str, np.ndarray]] = []
    with tqdm.tqdm(
        total=len(frames),
        desc="detect",
        unit="frame",
        disable=not (progress and processes.is_main()),
    ) as bar:
        pending: Found | None = None
        for batch in loader:
            if should_stop is not None and should_stop():
                raise processes.Stopped
            started = start(batch)
            # The devices work on this batch while the one before is taken apart.
            if pending is not None:
                bar.update(_collect(parts, *pending, detector.classes))
            pending = started
        assert pending is not None  # there is a frame
        bar.update(_collect(parts, *pending, detector.classes))
    return {
        name: np.concatenate([part[name] for part in parts])
        for name in ("frame", "box", "cls", "score")
    }


def _collect(
    parts: list[dict[str, np.ndarray]],
    detections: Detections,
    frames: Int[Array, " B"],
    classes: Sequence[str],
) -> int:
    """Adds the columns of a batch; returns its number of real frames."""
    frame = np.asarray(frames)  # -1 where a batch was filled up
    columns = detections.to_columns(classes)
    columns["frame"] = frame[columns["frame"]]
    is_real = columns["frame"] >= 0
    parts.append({name: column[is_real] for name, column in columns.items()})
    return int((frame >= 0).sum())
