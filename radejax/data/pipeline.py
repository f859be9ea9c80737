"""From records and labels to batches: shuffled, sharded, padded, resumable.

Frames are drawn by index, so that a batch depends only on (seed, epoch, position) and
never on threads or workers; the state of the iterator is one number.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import grain
import numpy as np

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES, Batch
from radejax.data.frame_table import (
    IMAGE_SIZE,
    FrameTable,
    frames_with_records,
    make_table,
    read_left_image,
)
from radejax.data.kradar.frame import Frame
from radejax.data.records.arrays import ArrayRecords
from radejax.data.records.projections import RecordSource
from radejax.geometry.camera import stack_cameras

__all__ = [
    "FrameTable",
    "frames_with_records",
    "make_loader",
    "make_table",
    "read_left_image",
    "steps_per_epoch",
]


def make_loader(
    records: RecordSource,
    frames: Sequence[Frame],
    *,
    batch_size: int,
    max_objects: int,
    seed: int = 0,
    shuffle: bool = True,
    num_epochs: int | None = None,
    drop_remainder: bool = True,
    pad_remainder: bool = False,
    classes: Sequence[str] = CLASSES,
    num_threads: int = 2,
    prefetch: int = 2,
    num_workers: int = 0,
    process_index: int | None = None,
    process_count: int | None = None,
    augment: Any = None,
    images: bool = False,
    cameras: Sequence[Any] | None = None,
    allow_missing_images: bool = False,
    image_size: tuple[int, int] = IMAGE_SIZE,
    resize_images: bool = False,
    features: ArrayRecords | None = None,
    device: Any = None,
    label_permutation_seed: int | None = None,
) -> grain.DatasetIterator[Batch]:
    """A checkpointable iterator over batches of NumPy arrays.

    `Batch.projection` has the type of the records; `encoding.to_float` turns it into
    network input on the device. `Batch.frame` is the index into `frames`.

    Epochs do not mix: with `drop_remainder` every epoch leaves out the last
    `len(frames) % batch_size` frames of its own order.

    Args:
        records: Projections, of these frames at least.
        frames: Labelled frames, normally a split of a `KRadar`.
        batch_size: Frames of a batch of this process.
        max_objects: Rows of boxes in every frame; more objects are an error.
        seed: Of order and augmentation.
        shuffle: A new order every epoch; otherwise the order of `frames`.
        num_epochs: None repeats without end.
        drop_remainder: Leave out the last, smaller batch of an epoch.
        pad_remainder: Instead fill it with empty frames of index -1, so that all
            batches have one shape and all processes have as many.
        classes: Class names in the order of the class indices.
        num_threads: Threads that prepare batches; 0: the caller's.
        prefetch: Batches prepared ahead.
        num_workers: Worker processes, each with its threads; 0: threads alone, which
            are faster for large frames (see benchmarks/pipeline.py).
        process_index: This host of several; None asks jax.
        process_count: Number of hosts; None asks jax.
        augment: `augment.Augmentation` applied to every frame, or None.
        images: Fill `Batch.image` with left front images, uint8.
        cameras: Fill `Batch.camera` from one `geometry.camera.Camera` a frame.
        allow_missing_images: As in `make_table`.
        image_size: Height and width of the images.
        resize_images: Resize images of another size instead of raising.
        features: What `radejax embed` made of the images, to fill `Batch.image` with
            in their place.
        device: Device or sharding to put batches on ahead of use; None: host arrays.
        label_permutation_seed: As in `make_table`.

    Returns:
        Iterator with `get_state` and `set_state`; `grain.checkpoint.CheckpointSave`
        saves it with orbax. Restored, it continues with exactly the next batch, with
        any number of threads or workers.

    Raises:
        UserError: As `make_table`; or there are fewer frames than one batch needs.
    """
    table = make_table(
        records,
        frames,
        max_objects=max_objects,
        classes=classes,
        images=images,
        cameras=cameras,
        allow_missing_images=allow_missing_images,
        label_permutation_seed=label_permutation_seed,
        image_size=image_size,
        resize=resize_images,
        features=features,
    )
    if process_count is None or process_index is None:
        import jax

        process_index, process_count = jax.process_index(), jax.process_count()
    order = _make_order(
        len(table),
        batch_size,
        seed,
        shuffle,
        drop_remainder and not pad_remainder,
        pad_remainder,
        (process_index, process_count),
    )
    dataset = order.repeat(num_epochs).map(_LoadBatch(records, table, augment))
    threads = grain.ReadOptions(
        num_threads=num_threads, prefetch_buffer_size=max(prefetch, num_threads)
    )
    dataset = dataset.to_iter_dataset(threads)
    if num_workers:
        dataset = dataset.mp_prefetch(
            grain.MultiprocessingOptions(
                num_workers=num_workers, per_worker_buffer_size=max(1, prefetch)
            )
        )
    if device is not None:
        dataset = grain.experimental.device_put(
            dataset, device, cpu_buffer_size=prefetch, device_buffer_size=2
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


def _make_order(
    num_frames: int,
    batch_size: int,
    seed: int,
    shuffle: bool,
    drop_remainder: bool,
    pad_remainder: bool,
    process: tuple[int, int],
) -> grain.MapDataset[np.ndarray]:
    """Batches of `[B, 2]` frame index and augmentation seed of one process.

    Frame indices from `num_frames` on are padding.
    """
    index, count = process
    if batch_size < 1:
        raise UserError(f"batch_size must be at least 1, got {batch_size}")
    if drop_remainder and num_frames < batch_size * count:
        raise UserError(
            f"{num_frames} frames are fewer than one batch ({batch_size} frames on each "
            f"of {count} processes); lower batch_size or keep the remainder"
        )
    total = num_frames
    if pad_remainder:
        total = -(-num_frames // (batch_size * count)) * batch_size * count
    # grain's shuffle in epoch e of seed s is that of epoch e - 1 of seed s + 1.
    spread = np.random.SeedSequence(seed).generate_state(2)
    dataset = grain.MapDataset.range(total).seed(int(spread[0]))
    if shuffle:
        dataset = dataset.shuffle(seed=int(spread[1]))
    dataset = dataset.random_map(_AddSeed()).batch(
        batch_size * count, drop_remainder=drop_remainder, batch_fn=np.stack
    )
    # Of every global batch, its own rows: what is trained on, and in which order, does
    # not depend on the number of processes.
    return dataset if count == 1 else dataset.map(_Share(index, count))


class _AddSeed(grain.transforms.RandomMap):
    """Gives every drawn frame a seed of its own for augmentation."""

    def random_map(self, element: int, rng: np.random.Generator) -> np.ndarray:
        return np.array([element, rng.integers(2**62)], np.int64)


class _Share(grain.transforms.Map):
    """The rows of one process of a global batch."""

    def __init__(self, index: int, count: int) -> None:
        self._index, self._count = index, count

    def __repr__(self) -> str:
        return "_Share()"

    def map(self, element: np.ndarray) -> np.ndarray:
        return np.array_split(element, self._count)[self._index]


class _LoadBatch(grain.transforms.Map):
    """Reads the frames of a batch, each straight into its place."""

    def __init__(self, records: RecordSource, table: FrameTable, augment: Any) -> None:
        self._records, self._table, self._augment = records, table, augment

    def __repr__(self) -> str:
        return "_LoadBatch()"

    def map(self, element: np.ndarray) -> Batch:
        batch = self._empty(len(element))
        cameras = []
        for row, (index, seed) in enumerate(element):
            if index >= len(self._table):
                cameras.append(self._table.camera(0, is_valid=False))
                continue
            sample = self._sample(index)
            if self._augment is not None:
                sample = self._augment(sample, np.random.default_rng(int(seed)))
            batch.projection[row] = sample["projection"]
            batch.boxes[row] = sample["boxes"]
            batch.classes[row] = self._table.classes[index]
            batch.is_valid[row] = self._table.is_valid[index]
            batch.frame[row] = index
            cameras.append(sample["camera"])
            if batch.image is not None:
                batch.image[row] = sample["image"]
        if self._table.cameras is None:
            return batch
        return batch.replace(camera=stack_cameras(cameras))

    def _sample(self, index: int) -> dict[str, Any]:
        """One frame; images and cameras None where they are not asked for."""
        record = self._records[int(self._table.record[index])]
        return {
            "projection": record["projection"],
            "boxes": self._table.boxes[index],
            "image": self._table.image(index),
            "camera": self._table.camera(index),
        }

    def _empty(self, size: int) -> Batch:
        """Nothing but padding."""
        shape, dtype = self._records.grid.projection_shape, self._records.dtype
        rows = (size, self._table.boxes.shape[1])
        return Batch(
            projection=np.zeros((size, *shape), dtype),
            boxes=np.zeros((*rows, 8), np.float32),
            classes=np.full(rows, -1, np.int32),
            is_valid=np.zeros(rows, bool),
            frame=np.full(size, -1, np.int32),
            image=self._table.empty_images(size),
        )
