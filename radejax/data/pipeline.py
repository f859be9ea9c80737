"""Data pipeline from records and labels to shuffled, sharded and padded batches.

Frames are drawn by index, so that a batch depends only on (seed, epoch, position) and
never on the number of threads. The pipeline can be resumed: the state of the iterator is
one number.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import logging
import re
from collections.abc import Iterable, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Float, Int, Real

from radejax.core.errors import UserError, require
from radejax.core.grain_import import grain
from radejax.core.structures import CLASSES, Array, Batch
from radejax.core.workers import usable_cpus
from radejax.data.augment import Augmentation, Sample
from radejax.data.cameras import CameraInputs, no_camera
from radejax.data.dataset import FrameSequence
from radejax.data.projection import stack_frames
from radejax.data.records import Records
from radejax.geometry.boxes import boxes8_from_7
from radejax.geometry.camera import Camera, stack_cameras

_log = logging.getLogger(__name__)

# Consecutive frames ------------------------------------------------------------------


def frame_histories(keys: Iterable[str], num_frames: int) -> dict[str, tuple[str, ...]]:
    """Returns the keys of the frames of every sample, oldest first.

    A sample is a frame and the `num_frames - 1` frames that precede it in its sequence,
    where the number at the start of the names increases by one. If one of them is missing,
    the frame that follows it is repeated in place of it and of all earlier frames.

    Args:
        keys: Keys of all frames that there are.
        num_frames: Number of frames of a sample.

    Raises:
        UserError: A name does not start with a number.

    Examples:
        >>> frame_histories(["1/00007_00001", "1/00008_00002"], 2)["1/00008_00002"]
        ('1/00007_00001', '1/00008_00002')
    """
    numbered = []
    for key in keys:
        sequence, _, name = key.rpartition("/")
        number = re.match("[0-9]+", name)
        if number is None:
            raise UserError(
                f"frame {key}: config.data.num_frames={num_frames} needs names that start "
                "with the number of the frame in its sequence, such as 00033_00001"
            )
        numbered.append((sequence, int(number[0]), key))
    histories = {}
    latest = dict[tuple[str, int], tuple[str, ...]]()
    for sequence, index, key in sorted(numbered):
        before = latest.get((sequence, index - 1), (key,) * num_frames)
        histories[key] = latest[sequence, index] = (*before[1:], key)
    return histories


def sample_keys(
    records: Records, frames: FrameSequence, num_frames: int
) -> tuple[tuple[str, ...], ...]:
    """Returns the keys of the records of every sample, oldest first.

    A preceding frame may be any frame that has a record, such as one of another split.
    The number of samples that repeat a frame is logged.
    """
    if num_frames == 1:
        return tuple((frame.key,) for frame in frames)
    histories = frame_histories(records.keys(), num_frames)
    keys = tuple(histories[frame.key] for frame in frames)
    text = "%d of %d samples of %d frames repeat one, as a preceding frame is missing"
    num_repeating = sum(len(set(sample)) < num_frames for sample in keys)
    _log.info(text, num_repeating, len(keys), num_frames)
    return keys


def read_sample(records: Records, keys: Sequence[str]) -> Real[np.ndarray, "R A C"]:
    """Reads the projections of the frames of a sample and concatenates their channels."""
    return stack_frames([records[key] for key in keys], records.grid.num_doppler)


# Batches -----------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class FrameTable:
    """Labels of a dataset as arrays of fixed shape: F frames with up to N objects.

    Attributes:
        records: Projections of these frames and possibly others.
        keys: Keys of the records of each frame's sample, see `sample_keys`.
        boxes: float32 x, y, z, l, w, h, sin yaw, cos yaw, padded with zeros.
        classes: int32 class indices, padded with -1.
        images: Images and cameras of the frames, or None for radar-only models.
        targets: float32 columns of the objects by name, NaN where a value is unknown.
    """

    records: Records
    keys: tuple[tuple[str, ...], ...]
    boxes: Float[np.ndarray, "F N 8"]
    classes: Int[np.ndarray, "F N"]
    images: CameraInputs | None = None
    targets: Mapping[str, Float[np.ndarray, "F N ..."]] = dataclasses.field(
        default_factory=dict
    )

    def __len__(self) -> int:
        return len(self.keys)


def make_table(
    records: Records,
    frames: FrameSequence,
    *,
    max_objects: int,
    classes: Sequence[str] = CLASSES,
    images: CameraInputs | None = None,
    num_frames: int = 1,
    targets: Sequence[str] = (),
) -> FrameTable:
    """Builds the padded label table of the frames, with their records.

    Args:
        records: Projections of these frames and possibly others.
        frames: Labeled frames, normally a split of a `KRadar`.
        max_objects: Number of rows N of every frame.
        classes: Class names in the order of the class indices. Objects of other classes
            are not targets and are left out.
        images: Camera inputs of the same frames in the same order (see
            `camera_inputs`), or None for radar-only models.
        num_frames: Number of frames of a sample, see `frame_histories`.
        targets: Names of further columns of the objects.

    Raises:
        UserError: A frame has more than `max_objects` objects (the message states the
            required number), a frame has no record, there are no frames, or no frame has
            one of the `targets`.
    """
    if not len(frames):
        raise UserError("no frames: the dataset or the split is empty")
    records.require(frames)
    if images is not None and len(images.cameras) != len(frames):
        raise UserError(f"{len(images.cameras)} cameras for {len(frames)} frames")
    class_index = {cls: index for index, cls in enumerate(classes)}
    kept = [[cls in class_index for cls in frame.classes] for frame in frames]
    counts = [sum(row) for row in kept]
    if (most := max(counts)) > max_objects:
        raise UserError(
            f"frame {frames[counts.index(most)].key} has {most} objects, but "
            f"config.data.max_objects is {max_objects}; {most} would do for all "
            f"{len(frames)} frames"
        )
    shape = (len(frames), max_objects)
    boxes = np.zeros((*shape, 8), np.float32)
    indices = np.full(shape, -1, np.int32)
    columns = {name: _empty_column(frames, name, shape) for name in targets}
    for i, frame in enumerate(frames):
        rows = np.flatnonzero(kept[i])
        if not rows.size:
            continue  # columns of frames without objects may have another shape
        boxes[i, : len(rows)] = boxes8_from_7(frame.boxes[rows])
        indices[i, : len(rows)] = [class_index[frame.classes[row]] for row in rows]
        for name in columns.keys() & frame.columns.keys():
            columns[name][i, : len(rows)] = frame.columns[name][rows]
    keys = sample_keys(records, frames, num_frames)
    return FrameTable(records, keys, boxes, indices, images, columns)


def _empty_column(
    frames: FrameSequence, name: str, shape: tuple[int, int]
) -> Float[np.ndarray, "F N ..."]:
    """Returns a column of the objects of all frames without known values."""
    # The last frame counts, as columns of frames without objects may have another shape.
    ordered = sorted(frames, key=lambda frame: len(frame.boxes))
    columns = {key: x for frame in ordered for key, x in frame.columns.items()}
    columns = {key: x for key, x in columns.items() if x.dtype.kind in "biuf"}
    known = ", ".join(sorted(columns)) or "they have none"
    expected = f"a column of numbers of the labels: {known}"
    require(name in columns, "config.data.targets", name, expected)
    return np.full((*shape, *columns[name].shape[1:]), np.nan, np.float32)


@dataclasses.dataclass(frozen=True)
class LoaderOptions:
    """Options for drawing frames and preparing batches.

    Attributes:
        batch_size: Number of frames per batch of this process.
        seed: Seed of the order and the augmentation.
        shuffle: Whether every epoch has a new random order; otherwise the frames are
            drawn in the order of the table.
        num_epochs: Number of epochs, or None to repeat without end.
        pad_remainder: Whether to fill the last, smaller batch of an epoch with empty
            frames of index -1, instead of leaving it out.
        num_threads: Number of threads that read frames, or None for one per CPU that
            the process may use; 0 reads them in the calling thread.
        process_index: Index of this process, by default that of JAX.
        process_count: Number of processes, by default that of JAX.
    """

    batch_size: int
    seed: int = 0
    shuffle: bool = True
    num_epochs: int | None = None
    pad_remainder: bool = False
    num_threads: int | None = None
    process_index: int = dataclasses.field(default_factory=jax.process_index)
    process_count: int = dataclasses.field(default_factory=jax.process_count)


def make_loader(
    table: FrameTable, options: LoaderOptions, *, augment: Augmentation | None = None
) -> grain.DatasetIterator[Batch]:
    """Returns a checkpointable iterator over batches of NumPy arrays.

    `Batch.projection` has the dtype of the records; `structures.to_float` converts it to
    the network input on the device. `Batch.frame` is the index into the table's frames.

    A batch never contains frames of two epochs. By default every epoch leaves out the
    last frames of its order that do not fill a batch of all processes.

    Args:
        table: Records, labels and images (see `make_table`).
        options: Batch size, order and threads.
        augment: Augmentation that is applied to every frame, or None.

    Returns:
        An iterator with `get_state` and `set_state`, which
        `grain.checkpoint.CheckpointSave` saves with orbax. A restored iterator continues
        with exactly the next batch, for any number of threads.

    Raises:
        UserError: There are fewer frames than one batch of all processes, and the
            remainder is not padded.
    """
    num_threads = options.num_threads
    if num_threads is None:
        num_threads = usable_cpus()
    # One batch more than it takes to occupy all threads: none waits for a batch to end.
    num_batches = 1 + -(-num_threads // options.batch_size) if num_threads else 0
    reading = grain.ReadOptions(
        num_threads=num_batches, prefetch_buffer_size=num_batches
    )
    order = _make_order(len(table), options).repeat(options.num_epochs)
    batches: grain.MapDataset[Batch] = order.map(
        _LoadBatch(table, augment, num_threads)
    )
    return iter(batches.to_iter_dataset(reading))


def check_enough(num_frames: int, batch_size: int, count: int = 1) -> None:
    """Raises a `UserError` if there are fewer frames than one batch of all processes.

    Args:
        num_frames: Number of frames.
        batch_size: Batch size of one process.
        count: Number of processes.
    """
    if num_frames < batch_size * count:
        each = f" ({batch_size} on each of {count} processes)" if count > 1 else ""
        raise UserError(
            f"{num_frames} frames are fewer than one batch of {batch_size * count}{each}; "
            "lower --config.train.batch_size"
        )


def _make_order(
    num_frames: int, options: LoaderOptions
) -> grain.MapDataset[Int[np.ndarray, "B 2"]]:
    """Returns the batches of one process as pairs of frame index and augmentation seed.

    Frame indices of `num_frames` and above are padding.
    """
    count = options.process_count
    rows = options.batch_size * count
    total = num_frames
    if options.pad_remainder:
        total = -(-num_frames // rows) * rows
    else:
        check_enough(num_frames, options.batch_size, count)
    # grain shuffles epoch e of seed s in the same way as epoch e - 1 of seed s + 1. The
    # seed is therefore hashed, so that runs with consecutive seeds have unrelated orders.
    spread = np.random.SeedSequence(options.seed).generate_state(2)
    dataset = grain.MapDataset.range(total).seed(int(spread[0]))
    if options.shuffle:
        dataset = dataset.shuffle(seed=int(spread[1]))
    seeded: grain.MapDataset[np.ndarray] = dataset.random_map(_add_seed)
    batches = seeded.batch(rows, drop_remainder=True, batch_fn=np.stack)
    # Every process takes its own rows of each global batch, so that the frames of a
    # training step and their order do not depend on the number of processes.
    return batches.map(lambda rows: np.array_split(rows, count)[options.process_index])


def _add_seed(frame: int, rng: np.random.Generator) -> Int[np.ndarray, "2"]:
    """Returns the index of a drawn frame and a random seed for its augmentation."""
    return np.array([frame, rng.integers(2**62)], np.int64)


class _LoadBatch(grain.transforms.Map):
    """Reads the frames of a batch in parallel, directly into the arrays of the batch."""

    def __init__(
        self, table: FrameTable, augment: Augmentation | None, num_threads: int
    ) -> None:
        self._table = table
        self._augment = augment
        self._pool = None
        if num_threads:
            self._pool = concurrent.futures.ThreadPoolExecutor(num_threads)

    def __repr__(self) -> str:
        return "_LoadBatch()"

    def map(self, element: Int[np.ndarray, "B 2"]) -> Batch:
        batch = self._empty(len(element))
        fill = functools.partial(self._fill, batch)
        indices, seeds = element.T.tolist()
        apply = self._pool.map if self._pool else map
        rows = apply(fill, range(len(element)), indices, seeds)
        cameras = [camera for camera in rows if camera is not None]
        return batch.replace(camera=stack_cameras(cameras)) if cameras else batch

    def _fill(self, batch: Batch, row: int, index: int, seed: int) -> Camera | None:
        """Reads one frame into a row of a batch; returns its camera, if there are any."""
        images = self._table.images
        if index >= len(self._table):  # the row is padding and stays empty
            return None if images is None else no_camera(images.image_size)
        sample = self._sample(index)
        if self._augment is not None:
            sample = self._augment(sample, np.random.default_rng(seed))
            _check_augmented(sample.projection, batch.projection[row])
        batch.projection[row] = sample.projection
        batch.boxes[row] = sample.boxes
        batch.classes[row] = sample.classes
        batch.is_valid[row] = sample.classes >= 0
        for name, values in batch.targets.items():
            values[row] = sample.targets[name]
        batch.frame[row] = index
        if batch.image is not None:
            batch.image[row] = sample.image
        return sample.camera

    def _sample(self, index: int) -> Sample:
        """Returns the sample of one frame."""
        table = self._table
        images = table.images
        return Sample(
            projection=read_sample(table.records, table.keys[index]),
            boxes=table.boxes[index],
            classes=table.classes[index],
            image=None if images is None else images.image(index),
            camera=None if images is None else images.cameras[index],
            targets={name: values[index] for name, values in table.targets.items()},
        )

    def _empty(self, size: int) -> Batch:
        """Returns a batch that contains only padding."""
        records = self._table.records
        images = self._table.images
        rows = (size, self._table.boxes.shape[1])
        *bins, channels = records.shape
        channels *= len(self._table.keys[0])
        return Batch(
            projection=np.zeros((size, *bins, channels), records.dtype),
            boxes=np.zeros((*rows, 8), np.float32),
            classes=np.full(rows, -1, np.int32),
            is_valid=np.zeros(rows, bool),
            frame=np.full(size, -1, np.int32),
            image=None if images is None else images.empty_images(size),
            targets={
                name: np.zeros((size, *values.shape[1:]), np.float32)
                for name, values in self._table.targets.items()
            },
        )


def _check_augmented(found: Real[Array, "..."], usual: Real[Array, "R A C"]) -> None:
    """Raises `UserError` if an augmentation returned another kind of projection."""
    is_same = found.shape == usual.shape
    if not (is_same and np.can_cast(found.dtype, usual.dtype, "same_kind")):
        raise UserError(
            f"config.data.augmentation returned a projection {found.shape} {found.dtype}, "
            f"expected {usual.shape} {usual.dtype}, as in the records"
        )
