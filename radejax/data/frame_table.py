"""Labels of a data set as arrays of fixed shape, next to its records and images."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from radejax.data.frame import Frame
from radejax.data.records import RecordSource
from radejax.errors import DataError, UserError
from radejax.structures import CLASSES

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
        image_paths: Front image of every frame (None: missing), or None when images
            are not loaded.
        cameras: `geometry.camera.Camera` of every frame, or None.
    """

    record: np.ndarray
    boxes: np.ndarray
    classes: np.ndarray
    is_valid: np.ndarray
    image_paths: tuple[pathlib.Path | None, ...] | None = None
    cameras: tuple[Any, ...] | None = None

    def __len__(self) -> int:
        return len(self.record)


def make_table(
    records: RecordSource,
    frames: Sequence[Frame],
    *,
    max_objects: int,
    classes: Sequence[str] = CLASSES,
    images: bool = False,
    cameras: Sequence[Any] | None = None,
    allow_missing_images: bool = False,
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
        cameras: `geometry.camera.Camera` (NumPy) of every frame, in the same order.
        allow_missing_images: A frame without a front image gets a black one and a
            camera whose `is_valid` is False. Otherwise it raises.
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
    paths = _image_paths(frames, allow_missing_images) if images else None
    if cameras is not None and len(cameras) != len(frames):
        raise UserError(f"{len(cameras)} cameras for {len(frames)} frames")
    cameras = None if cameras is None else tuple(cameras)
    return FrameTable(record, boxes, indices, indices >= 0, paths, cameras)


def read_left_image(path: pathlib.Path) -> np.ndarray:
    """`[720, 1280, 3]` uint8 left half of a front image (a stereo pair, or left only).

    Raises:
        DataError: The file is damaged or of another size.
    """
    from PIL import Image, UnidentifiedImageError

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
            "frames_with_records"
        )
    return np.array([index_of[frame.key] for frame in frames], np.int64)


def frames_with_records(
    records: RecordSource, frames: Sequence[Frame]
) -> tuple[list[Frame], list[str]]:
    """Frames that have a record, and the keys of those that have none."""
    index_of = records.index_of()
    missing = [frame.key for frame in frames if frame.key not in index_of]
    return [frame for frame in frames if frame.key in index_of], missing


def _image_paths(
    frames: Sequence[Frame], allow_missing: bool
) -> tuple[pathlib.Path | None, ...]:
    """Front images; `UserError` for a missing one unless that is allowed."""
    missing = [frame.key for frame in frames if frame.camera_path is None]
    if missing and not allow_missing:
        raise UserError(
            f"{len(missing)} of {len(frames)} frames have no front image "
            f"(cam-front_*.png), the first is {missing[0]}; allow_missing_images takes "
            "black ones instead"
        )
    return tuple(frame.camera_path for frame in frames)
