"""Detections on whole data sets, on all devices of all processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import numpy as np
import tqdm
from jaxtyping import Shaped

from radejax.core.errors import UserError
from radejax.core.structures import Batch
from radejax.data.dataset import FrameSequence
from radejax.data.pipeline import (
    CameraInputs,
    LoaderOptions,
    make_loader,
    make_table,
)
from radejax.data.records import Records
from radejax.inference.detector import Detector
from radejax.training import distributed


def predict_dataset(
    detector: Detector,
    records: Records,
    frames: FrameSequence,
    batch_size: int = 8,
    *,
    images: CameraInputs | None = None,
    progress: bool = True,
    should_stop: Callable[[], bool] | None = None,
) -> dict[str, Shaped[np.ndarray, "N ..."]]:
    """Detections on every frame of a data set; the same on every process.

    Args:
        detector: Over the devices of several processes each reads its part of a batch.
        records: Projections of the frames.
        frames: Which frames, in which order.
        batch_size: Frames at once; rounded up to a multiple of the devices.
        images: Images of these frames, for a radar-camera model, see `camera_inputs`.
        progress: Show a progress bar.
        should_stop: Asked before every batch.

    Returns:
        Columns "frame" (position in `frames`), "box", "cls", "score", by frame and
        descending score.

    Raises:
        UserError: There are no frames.
        distributed.Stopped: `should_stop` returned True.
    """
    if not len(frames):
        raise UserError("no frames to detect objects in")
    table = make_table(
        records,
        frames,
        max_objects=max(len(frame.boxes) for frame in frames) or 1,
        classes=detector.classes,
        images=images,
    )
    num_devices, count = len(detector.sharding.device_set), detector.num_processes
    rows = -(-batch_size // num_devices) * num_devices // count
    options = LoaderOptions(
        batch_size=rows,
        shuffle=False,
        num_epochs=1,
        drop_remainder=False,
        pad_remainder=num_devices > 1,  # one device pads by itself
        process_index=None if count > 1 else 0,
        process_count=None if count > 1 else 1,
    )
    detector = detector.replace(batch_sizes=(rows,))
    gather = jax.jit(lambda x: x, out_shardings=detector.replicated)
    started: list[jax.Array] = []

    def batches() -> Iterator[Batch]:
        for batch in make_loader(table, options):
            if should_stop is not None and should_stop():
                raise distributed.Stopped
            started.append(gather(detector.put(batch.frame)))
            yield batch

    parts: list[dict[str, np.ndarray]] = []
    show = progress and distributed.is_main()
    with tqdm.tqdm(total=len(frames), desc="detect", disable=not show) as bar:
        for found in detector.stream(batches()):
            frame = np.asarray(started.pop(0))  # -1 where a batch was padded
            columns = found.to_columns()
            columns["frame"] = frame[columns["frame"]]
            is_real = columns["frame"] >= 0
            parts.append({name: column[is_real] for name, column in columns.items()})
            bar.update(int((frame >= 0).sum()))
    return {
        name: np.concatenate([part[name] for part in parts])
        for name in ("frame", "box", "cls", "score")
    }
