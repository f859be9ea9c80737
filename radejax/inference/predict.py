"""The loop over frames, and detection in whole datasets."""

from __future__ import annotations

import collections
import itertools
from collections.abc import Callable, Iterable, Iterator

import jax
import numpy as np
import tqdm
from jaxtyping import Int

from radejax.core.devices import Stopped, is_main
from radejax.core.structures import Array, Batch, Boxes, Detections
from radejax.data.cameras import CameraInputs
from radejax.data.dataset import FrameSequence
from radejax.data.pipeline import LoaderOptions, make_loader, make_table
from radejax.data.records import Records
from radejax.inference.detector import Detector, Item

Batches = Iterable[tuple[Int[Array, " B"], Item]]
"""Indices of the frames of batches (-1 for padding), and items of `Detector.stream`."""


def detect_batches(
    detector: Detector, parts: Iterable[Batches], num_frames: int, *, progress: bool
) -> Iterator[tuple[Int[np.ndarray, " B"], Detections]]:
    """Detects the objects in batches of frames by `Detector.stream`, two in flight.

    Args:
        detector: Detector.
        parts: Batches of consecutive frames. For a model of several frames, the first frame
            of a part has no preceding one.
        num_frames: Number of all frames, for the progress bar.
        progress: Show a progress bar.

    Yields:
        Indices of the frames of a batch (-1 for padding), and their detections.
    """
    started = collections.deque[Array]()

    def items(part: Batches) -> Iterator[Item]:
        for frame, item in part:
            started.append(frame)
            yield item

    streams = (detector.stream(items(part)) for part in parts)
    bar = tqdm.tqdm(total=num_frames, desc="detect", unit="frame", disable=not progress)
    with bar:
        for found in itertools.chain.from_iterable(streams):
            frame = np.asarray(started.popleft())
            yield frame, found
            bar.update(np.count_nonzero(frame >= 0))


def predict_dataset(
    detector: Detector,
    records: Records,
    frames: FrameSequence,
    batch_size: int = 8,
    *,
    images: CameraInputs | None = None,
    progress: bool = True,
    should_stop: Callable[[], bool] | None = None,
    each_batch: Callable[[Batch], None] | None = None,
) -> Boxes:
    """Detects the objects in every frame on the devices of the detector.

    Every process returns the detections of all frames.

    Args:
        detector: Detector. If its devices belong to several processes, each process reads
            its part of every batch.
        records: Projections of the frames.
        frames: Frames, in the order of the results.
        batch_size: Number of frames per batch over all processes; rounded up to a multiple
            of the number of devices.
        images: Images of the frames for a radar-camera model, see `camera_inputs`.
        progress: Show a progress bar.
        should_stop: Function that is called before every batch; returning True ends the
            detection.
        each_batch: Function that is called with every batch with its labels, on the
            devices of the detector.

    Returns:
        Boxes with scores, whose `frame` is the position in `frames`, sorted by frame, then
        by descending score.

    Raises:
        UserError: There are no frames.
        Stopped: `should_stop` returned True.
    """
    table = make_table(
        records,
        frames,
        max_objects=max([1, *(len(frame.boxes) for frame in frames)]),
        classes=detector.classes,
        images=images,
        num_frames=detector.num_frames,
        targets=detector.saved.config.data.targets if each_batch else (),
    )
    devices: set[jax.Device] = detector.sharding.device_set
    num_processes = len({device.process_index for device in devices})
    rows = -(-batch_size // len(devices)) * len(devices) // num_processes
    options = LoaderOptions(
        batch_size=rows,
        shuffle=False,
        num_epochs=1,
        pad_remainder=True,
        process_index=jax.process_index() % num_processes,
        process_count=num_processes,
    )
    detector = detector.replace(batch_sizes=(rows,))
    gather = jax.jit(lambda x: x, out_shardings=detector.replicated)

    def batches() -> Iterator[tuple[jax.Array, Batch]]:
        for batch in make_loader(table, options):
            if should_stop is not None and should_stop():
                raise Stopped
            if each_batch is not None:
                each_batch(jax.tree.map(detector.put, batch))
            yield gather(detector.put(batch.frame)), batch

    progress = progress and is_main()
    parts = detect_batches(detector, [batches()], len(frames), progress=progress)
    return Boxes.concatenate([found.to_boxes(frame) for frame, found in parts])
