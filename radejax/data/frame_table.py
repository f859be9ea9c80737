"""Labels of a data set as arrays of fixed shape, next to its records and images."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import chex
import numpy as np
from jaxtyping import Bool, Float, Int

from radejax.core.errors import UserError
from radejax.core.structures import CLASSES
from radejax.data.cameras import CameraInputs
from radejax.data.dataset import FrameSequence
from radejax.data.records.projections import RecordSource, record_positions
from radejax.geometry.boxes import boxes8_from_7


@dataclasses.dataclass(frozen=True)
class FrameTable:
    """Labels of a data set as arrays of fixed shape, F frames with up to N objects.

    Attributes:
        records: Projections, of these frames at least.
        record: int64 index of each frame's record.
        boxes: float32 x, y, z, l, w, h, sin yaw, cos yaw; zeros as padding.
        classes: int32 class indices; -1 as padding.
        images: Images and cameras of the frames, or None for the radar alone.
    """

    records: RecordSource
    record: Int[np.ndarray, " F"]
    boxes: Float[np.ndarray, "F N 8"]
    classes: Int[np.ndarray, "F N"]
    images: CameraInputs | None = None

    def __post_init__(self) -> None:
        chex.assert_rank([self.record, self.boxes, self.classes], [1, 3, 2])
        chex.assert_equal_shape_prefix([self.boxes, self.classes], 2)
        chex.assert_equal_shape_prefix([self.record, self.boxes], 1)
        chex.assert_axis_dimension(self.boxes, -1, 8)

    def __len__(self) -> int:
        return len(self.record)

    @property
    def is_valid(self) -> Bool[np.ndarray, "F N"]:
        """True where a row is an object."""
        return self.classes >= 0


def make_table(
    records: RecordSource,
    frames: FrameSequence,
    *,
    max_objects: int,
    classes: Sequence[str] = CLASSES,
    images: CameraInputs | None = None,
    label_permutation_seed: int | None = None,
) -> FrameTable:
    """Labels of the frames, padded, next to the indices of their records.

    Args:
        records: Projections, of these frames at least.
        frames: Labelled frames, normally a split of a `KRadar`.
        max_objects: Rows N of every frame; more objects are an error.
        classes: Class names in the order of the class indices; objects of other
            classes are not targets and are left out.
        images: Of the same frames in the same order, see `camera_inputs`; None for the
            radar alone.
        label_permutation_seed: Exchange the labels of the frames at random. Training
            on such labels must fail: a check that a result is not an accident.

    Raises:
        UserError: A frame has more than `max_objects` objects (the message says how
            many would do), or has no record, or there are no frames.
    """
    if not len(frames):
        raise UserError("no frames: the data set or the split is empty")
    record = np.array(record_positions(records, frames), np.int64)
    if images is not None and len(images.cameras) != len(frames):
        raise UserError(f"{len(images.cameras)} cameras for {len(frames)} frames")
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
        boxes[i, : len(rows)] = boxes8_from_7(frame.boxes[rows])
        indices[i, : len(rows)] = [class_index[frame.classes[row]] for row in rows]
    if label_permutation_seed is not None:
        order = np.random.default_rng(label_permutation_seed).permutation(len(frames))
        boxes, indices = boxes[order], indices[order]
    return FrameTable(records, record, boxes, indices, images)
