"""From records and labels to batches: shuffled, sharded, padded, resumable.

Frames are drawn by index, so that a batch depends only on (seed, epoch, position) and
never on threads or workers; the state of the iterator is one number.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import grain
import jax
import numpy as np
from jaxtyping import Int

from radejax.core.errors import UserError
from radejax.core.structures import Batch
from radejax.data.augment import Augmentation
from radejax.data.cameras import no_camera
from radejax.data.frame_table import FrameTable
from radejax.geometry.camera import Camera, stack_cameras


@dataclasses.dataclass(frozen=True)
class LoaderOptions:
    """How frames are drawn, and how batches are prepared.

    Attributes:
        batch_size: Frames of a batch of this process.
        seed: Of order and augmentation.
        shuffle: A new order every epoch; otherwise the order of the table.
        num_epochs: None repeats without end.
        drop_remainder: Leave out the last, smaller batch of an epoch.
        pad_remainder: Instead fill it with empty frames of index -1, so that all
            batches have one shape and all processes have as many.
        num_threads: Threads that prepare batches; 0: the caller's.
        prefetch: Batches prepared ahead.
        num_workers: Worker processes, each with its threads; 0: threads alone, which
            are faster for large frames (two cores: 0.7 times the frames).
        process_index: This host of several; None asks jax.
        process_count: Number of hosts; None asks jax.
        device: Device or sharding to put batches on ahead of use; None: host arrays.
    """

    batch_size: int
    seed: int = 0
    shuffle: bool = True
    num_epochs: int | None = None
    drop_remainder: bool = True
    pad_remainder: bool = False
    num_threads: int = 2
    prefetch: int = 2
    num_workers: int = 0
    process_index: int | None = None
    process_count: int | None = None
    device: Any = None


def make_loader(
    table: FrameTable, options: LoaderOptions, *, augment: Augmentation | None = None
) -> grain.DatasetIterator[Batch]:
    """A checkpointable iterator over batches of NumPy arrays.

    `Batch.projection` has the type of the records; `encoding.to_float` turns it into
    network input on the device. `Batch.frame` is the index into the table's frames.

    Epochs do not mix: with `drop_remainder` every epoch leaves out the last
    `len(table) % batch_size` frames of its own order.

    Args:
        table: Records, labels and images, see `make_table`.
        options: Batch size, order, threads.
        augment: Applied to every frame, or None.

    Returns:
        Iterator with `get_state` and `set_state`; `grain.checkpoint.CheckpointSave`
        saves it with orbax. Restored, it continues with exactly the next batch, with
        any number of threads or workers.

    Raises:
        UserError: There are fewer frames than one batch needs.
    """
    threads = grain.ReadOptions(
        num_threads=options.num_threads,
        prefetch_buffer_size=max(options.prefetch, options.num_threads),
    )
    order = _make_order(len(table), options).repeat(options.num_epochs)
    batches: grain.MapDataset[Batch] = order.map(_LoadBatch(table, augment))
    dataset = batches.to_iter_dataset(threads)
    if options.num_workers:
        dataset = dataset.mp_prefetch(
            grain.MultiprocessingOptions(
                num_workers=options.num_workers,
                per_worker_buffer_size=max(1, options.prefetch),
            )
        )
    if options.device is not None:
        dataset = grain.experimental.device_put(
            dataset,
            options.device,
            cpu_buffer_size=options.prefetch,
            device_buffer_size=2,
        )
    return iter(dataset)


def steps_per_epoch(
    num_frames: int,
    batch_size: int,
    *,
    drop_remainder: bool = True,
    process_count: int = 1,
) -> int:
    """Number of batches that `make_loader` gives per epoch and process."""
    if drop_remainder:
        return num_frames // (process_count * batch_size)
    return -(-num_frames // (process_count * batch_size))


def check_enough(num_frames: int, batch_size: int, count: int = 1) -> None:
    """`UserError` for fewer frames than one batch.

    Args:
        num_frames: That there are.
        batch_size: Of one process.
        count: Of the processes.
    """
    if num_frames < batch_size * count:
        each = f" ({batch_size} on each of {count} processes)" if count > 1 else ""
        raise UserError(
            f"{num_frames} frames are fewer than one batch of {batch_size * count}{each}; "
            "lower --config.train.batch_size (of LoaderOptions, set pad_remainder)"
        )


def _make_order(
    num_frames: int, options: LoaderOptions
) -> grain.MapDataset[Int[np.ndarray, "B 2"]]:
    """Batches of frame index and augmentation seed of one process.

    Frame indices from `num_frames` on are padding.
    """
    index, count = options.process_index, options.process_count
    if index is None or count is None:
        index, count = jax.process_index(), jax.process_count()
    batch_size, seed = options.batch_size, options.seed
    drop_remainder = options.drop_remainder and not options.pad_remainder
    if batch_size < 1:
        raise UserError(f"batch_size must be at least 1, got {batch_size}")
    if drop_remainder:
        check_enough(num_frames, batch_size, count)
    total = num_frames
    if options.pad_remainder:
        total = -(-num_frames // (batch_size * count)) * batch_size * count
    # grain's shuffle in epoch e of seed s is that of epoch e - 1 of seed s + 1.
    spread = np.random.SeedSequence(seed).generate_state(2)
    dataset = grain.MapDataset.range(total).seed(int(spread[0]))
    if options.shuffle:
        dataset = dataset.shuffle(seed=int(spread[1]))
    seeded: grain.MapDataset[np.ndarray] = dataset.random_map(_AddSeed())
    batches = seeded.batch(
        batch_size * count, drop_remainder=drop_remainder, batch_fn=np.stack
    )
    # Of every global batch, its own rows: what is trained on, and in which order, does
    # not depend on the number of processes.
    return batches if count == 1 else batches.map(_Share(index, count))


class _AddSeed(grain.transforms.RandomMap):
    """Gives every drawn frame a seed of its own for augmentation."""

    def random_map(
        self, element: int, rng: np.random.Generator
    ) -> Int[np.ndarray, "2"]:
        return np.array([element, rng.integers(2**62)], np.int64)


class _Share(grain.transforms.Map):
    """The rows of one process of a global batch."""

    def __init__(self, index: int, count: int) -> None:
        self._index, self._count = index, count

    def __repr__(self) -> str:
        return "_Share()"

    def map(self, element: Int[np.ndarray, "B 2"]) -> Int[np.ndarray, "b 2"]:
        return np.array_split(element, self._count)[self._index]


class _LoadBatch(grain.transforms.Map):
    """Reads the frames of a batch, each straight into its place."""

    def __init__(self, table: FrameTable, augment: Augmentation | None) -> None:
        self._table, self._augment = table, augment
        images = table.images
        self._no_camera = no_camera(images.image_size if images else (1, 1))

    def __repr__(self) -> str:
        return "_LoadBatch()"

    def map(self, element: Int[np.ndarray, "B 2"]) -> Batch:
        cameras: list[Camera] = []
        batch = self._empty(len(element))
        for row, (index, seed) in enumerate(element.tolist()):
            if index >= len(self._table):
                cameras.append(self._no_camera)
                continue
            sample = self._sample(index)
            if self._augment is not None:
                sample = self._augment(sample, np.random.default_rng(seed))
            batch.projection[row] = sample["projection"]
            batch.boxes[row] = sample["boxes"]
            batch.classes[row] = self._table.classes[index]
            batch.is_valid[row] = batch.classes[row] >= 0
            batch.frame[row] = index
            cameras.append(sample["camera"])
            if batch.image is not None:
                batch.image[row] = sample["image"]
        if self._table.images is None:
            return batch
        return batch.replace(camera=stack_cameras(cameras))

    def _sample(self, index: int) -> dict[str, Any]:
        """One frame; image and camera None where they are not asked for."""
        table, images = self._table, self._table.images
        return {
            "projection": table.records[int(table.record[index])]["projection"],
            "boxes": table.boxes[index],
            "image": None if images is None else images.image(index),
            "camera": None if images is None else images.cameras[index],
        }

    def _empty(self, size: int) -> Batch:
        """Nothing but padding."""
        records, images = self._table.records, self._table.images
        rows = (size, self._table.boxes.shape[1])
        return Batch(
            projection=np.zeros((size, *records.shape), records.dtype),
            boxes=np.zeros((*rows, 8), np.float32),
            classes=np.full(rows, -1, np.int32),
            is_valid=np.zeros(rows, bool),
            frame=np.full(size, -1, np.int32),
            image=None if images is None else images.empty_images(size),
        )
