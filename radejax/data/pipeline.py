"""From records and labels to batches: shuffled, sharded, padded, resumable.

Frames are drawn by index, so that a batch depends only on (seed, epoch, position) and
never on threads or workers; the state of the iterator is one number.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import grain
import numpy as np

from radejax.data.kradar import Frame
from radejax.data.records import RecordSource
from radejax.errors import UserError
from radejax.structures import CLASSES, Batch

MIN_OBJECTS = 1
IMAGE_SHAPE = (720, 1280, 3)
"""Left half of K-Radar's 2560 x 720 stereo images."""


@dataclasses.dataclass(frozen=True)
class FrameTable:
    """Labels of a data set as arrays of fixed shape, F frames with up to N objects.

    Attributes:
        record: `[F]` int64 index of each frame's record.
        boxes: `[F, N, 8]` float32 x, y, z, l, w, h, sin yaw, cos yaw; zeros as padding.
        classes: `[F, N]` int32 class indices; -1 as padding.
        is_valid: `[F, N]` bool, True where a row is an object.
        image_paths: Front image of every frame, None when images are not loaded.
    """

    record: np.ndarray
    boxes: np.ndarray
    classes: np.ndarray
    is_valid: np.ndarray
    image_paths: tuple[pathlib.Path, ...] | None

    def __len__(self) -> int:
        return len(self.record)


def make_table(
    records: RecordSource,
    frames: Sequence[Frame],
    *,
    max_objects: int,
    classes: Sequence[str] = CLASSES,
    images: bool = False,
    label_permutation_seed: int | None = None,
) -> FrameTable:
    """Labels of the frames, padded, next to the indices of their records.

    Args:
        records: Projections, of these frames at least.
        frames: Labelled frames, normally a split of a `KRadar`.
        max_objects: Rows N of every frame.
        classes: Class names in the order of the class indices; objects of other
            classes are not targets and are left out.
        images: Also note the front images.
        label_permutation_seed: Exchange the labels of the frames at random. Training
            on such labels must fail: a check that a result is not an accident.

    Raises:
        UserError: A frame has more than `max_objects` objects (the message says how
            many would do), or has no record or image, or there are no frames.
    """
    if not len(frames):
        raise UserError("no frames: the data set or the split is empty")
    record = _record_indices(records, frames)
    class_index = {cls: index for index, cls in enumerate(classes)}
    kept = [[cls in class_index for cls in frame.classes] for frame in frames]
    largest = max(range(len(frames)), key=lambda i: sum(kept[i]))
    if sum(kept[largest]) > max_objects:
        raise UserError(
            f"frame {frames[largest].key} has {sum(kept[largest])} objects, but "
            f"max_objects is {max_objects}; {sum(kept[largest])} would do for all "
            f"{len(frames)} frames"
        )
    shape = (len(frames), max_objects)
    boxes = np.zeros((*shape, 8), np.float32)
    indices = np.full(shape, -1, np.int32)
    for i, frame in enumerate(frames):
        rows = np.flatnonzero(kept[i])
        yaw = frame.boxes[rows, 6:]
        boxes[i, : len(rows)] = np.concatenate(
            [frame.boxes[rows, :6], np.sin(yaw), np.cos(yaw)], axis=-1
        )
        indices[i, : len(rows)] = [class_index[frame.classes[row]] for row in rows]
    if label_permutation_seed is not None:
        order = np.random.default_rng(label_permutation_seed).permutation(len(frames))
        boxes, indices = boxes[order], indices[order]
    paths = tuple(_image_path(frame) for frame in frames) if images else None
    return FrameTable(record, boxes, indices, indices >= 0, paths)


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
        label_permutation_seed=label_permutation_seed,
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
    dataset = order.repeat(num_epochs).map(
        _LoadBatch(records, table, augment, max_objects)
    )
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
    per_process = num_frames // process_count
    if drop_remainder:
        return per_process // batch_size
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
    dataset = dataset.random_map(_AddSeed())
    if count > 1:
        # Equal shares: all processes must take the same number of steps.
        last = total // count * count if drop_remainder else total
        dataset = dataset[slice(index, last, count)]
    return dataset.batch(batch_size, drop_remainder=drop_remainder, batch_fn=np.stack)


class _AddSeed(grain.transforms.RandomMap):
    """Gives every drawn frame a seed of its own for augmentation."""

    def random_map(self, element: int, rng: np.random.Generator) -> np.ndarray:
        return np.array([element, rng.integers(2**62)], np.int64)


class _LoadBatch(grain.transforms.Map):
    """Reads the frames of a batch, each straight into its place."""

    def __init__(
        self, records: RecordSource, table: FrameTable, augment: Any, max_objects: int
    ) -> None:
        self._records, self._table = records, table
        self._augment, self._max_objects = augment, max_objects

    def __repr__(self) -> str:
        return "_LoadBatch()"

    def map(self, element: np.ndarray) -> Batch:
        batch = self._empty(len(element))
        for row, (index, seed) in enumerate(element):
            if index >= len(self._table):
                continue
            record = self._records[int(self._table.record[index])]
            frame = {
                "projection": record["projection"],
                "boxes": self._table.boxes[index],
                "image": self._image(index),
            }
            if self._augment is not None:
                frame = self._augment(frame, np.random.default_rng(int(seed)))
            batch.projection[row] = frame["projection"]
            batch.boxes[row] = frame["boxes"]
            batch.classes[row] = self._table.classes[index]
            batch.is_valid[row] = self._table.is_valid[index]
            batch.frame[row] = index
            if batch.image is not None:
                batch.image[row] = frame["image"]
        return batch

    def _empty(self, size: int) -> Batch:
        """Nothing but padding."""
        shape, dtype = self._records.grid.projection_shape, self._records.dtype
        image = None
        if self._table.image_paths is not None:
            image = np.zeros((size, *IMAGE_SHAPE), np.uint8)
        return Batch(
            projection=np.zeros((size, *shape), dtype),
            boxes=np.zeros((size, self._max_objects, 8), np.float32),
            classes=np.full((size, self._max_objects), -1, np.int32),
            is_valid=np.zeros((size, self._max_objects), bool),
            frame=np.full(size, -1, np.int32),
            image=image,
        )

    def _image(self, index: int) -> np.ndarray | None:
        if self._table.image_paths is None:
            return None
        return read_left_image(self._table.image_paths[index])


def read_left_image(path: pathlib.Path) -> np.ndarray:
    """`[720, 1280, 3]` uint8 left half of a front image (a stereo pair, or left only).

    Raises:
        DataError: The file is damaged or of another size.
    """
    from PIL import Image, UnidentifiedImageError

    from radejax.errors import DataError

    height, width, _ = IMAGE_SHAPE
    try:
        with Image.open(path) as file:
            if file.size not in ((2 * width, height), (width, height)):
                raise DataError(
                    f"{path}: {file.size[0]} x {file.size[1]} pixels, expected "
                    f"{2 * width} x {height} (stereo) or {width} x {height}"
                )
            return np.asarray(file.convert("RGB").crop((0, 0, width, height)))
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise DataError(f"{path}: damaged image ({error})") from None


def _record_indices(records: RecordSource, frames: Sequence[Frame]) -> np.ndarray:
    """`[F]` record of every frame; `UserError` if one has none."""
    index_of = records.index_of()
    missing = [frame.key for frame in frames if frame.key not in index_of]
    if missing:
        skipped = records.manifest.skipped
        reason = f" ({skipped[missing[0]]})" if missing[0] in skipped else ""
        raise UserError(
            f"{records.folder}: {len(missing)} of {len(frames)} frames have no record, "
            f"the first is {missing[0]}{reason}; project them, or leave them out with "
            "pipeline.frames_with_records"
        )
    return np.array([index_of[frame.key] for frame in frames], np.int64)


def frames_with_records(
    records: RecordSource, frames: Sequence[Frame]
) -> tuple[list[Frame], list[str]]:
    """Frames that have a record, and the keys of those that have none."""
    index_of = records.index_of()
    missing = [frame.key for frame in frames if frame.key not in index_of]
    return [frame for frame in frames if frame.key in index_of], missing


def _image_path(frame: Frame) -> pathlib.Path:
    if frame.camera_path is None:
        raise UserError(f"frame {frame.key} has no front image (cam-front_*.png)")
    return frame.camera_path
