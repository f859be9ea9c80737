"""Labels of a data set as arrays of fixed shape, next to its records and images."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from radejax.core.errors import DataError, UserError
from radejax.core.structures import CLASSES
from radejax.data.kradar.frame import Frame
from radejax.data.records.arrays import ArrayRecords
from radejax.data.records.projections import RecordSource

IMAGE_SIZE = (720, 1280)
"""Height and width of the left half of K-Radar's 2560 x 720 stereo images."""


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
        image_size: Height and width of the images.
        resize: Images of another size are resized.
        features: What an image backbone made of the images, in their place, or None.
        feature_record: `[F]` index of each frame's features; -1: it has no image.
    """

    record: np.ndarray
    boxes: np.ndarray
    classes: np.ndarray
    is_valid: np.ndarray
    image_paths: tuple[pathlib.Path | None, ...] | None = None
    cameras: tuple[Any, ...] | None = None
    image_size: tuple[int, int] = IMAGE_SIZE
    resize: bool = False
    features: ArrayRecords | None = None
    feature_record: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.record)

    def empty_images(self, count: int) -> np.ndarray | None:
        """Black images (or zero features) of a batch; None without images."""
        if self.features is not None:
            return np.zeros((count, *self.features.shape), self.features.dtype)
        if self.image_paths is not None:
            return np.zeros((count, *self.image_size, 3), np.uint8)
        return None

    def image(self, index: int) -> np.ndarray | None:
        """Image (or features) of a frame, black where missing; None without images."""
        if not self.has_image(index):
            empty = self.empty_images(1)
            return None if empty is None else empty[0]
        if self.features is not None:
            return self.features.read(int(self.feature_record[index]))
        return read_left_image(
            self.image_paths[index], self.image_size, resize=self.resize
        )

    def camera(self, index: int, is_valid: bool = True) -> Any:
        """Camera of a frame, not valid where its image is missing."""
        if self.cameras is None:
            return None
        camera = self.cameras[index]
        with_images = self.features is not None or self.image_paths is not None
        if not is_valid or (with_images and not self.has_image(index)):
            camera = camera.replace(is_valid=np.bool_(False))
        return camera

    def has_image(self, index: int) -> bool:
        """Whether there is an image or its features."""
        if self.features is not None:
            return bool(self.feature_record[index] >= 0)
        return self.image_paths is not None and self.image_paths[index] is not None


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
    image_size: tuple[int, int] = IMAGE_SIZE,
    resize: bool = False,
    features: ArrayRecords | None = None,
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
        image_size: Height and width of the images.
        resize: Resize images of another size; otherwise one is an error when read.
        features: Of the frames that have an image; see `FrameTable`.

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
    feature_record = None
    if features is not None:
        position = features.index_of()
        feature_record = np.array([position.get(f.key, -1) for f in frames], np.int64)
        _check_embedded(frames, feature_record, features)
        _check_images(frames, feature_record < 0, allow_missing_images)
    return FrameTable(
        record,
        boxes,
        indices,
        indices >= 0,
        paths,
        cameras,
        tuple(image_size),
        resize,
        features,
        feature_record,
    )


def read_left_image(
    path: pathlib.Path, size: tuple[int, int] = IMAGE_SIZE, *, resize: bool = False
) -> np.ndarray:
    """`[H, W, 3]` uint8 left half of a front image (a stereo pair, or left only).

    Args:
        path: Of the picture file. More than twice as wide as high: a stereo pair.
        size: Height and width of the result.
        resize: Bring other sizes to `size`, averaging where they are larger.

    Raises:
        DataError: The file is damaged, or of another size and not `resize`.
    """
    from PIL import Image, UnidentifiedImageError

    height, width = size
    try:
        with Image.open(path) as file:
            found = file.size
            if not resize and found not in ((2 * width, height), (width, height)):
                raise DataError(
                    f"{path}: {found[0]} x {found[1]} pixels, expected "
                    f"{2 * width} x {height} (stereo) or {width} x {height}"
                )
            is_pair = found[0] > 2 * found[1] if resize else found[0] == 2 * width
            left = (0, 0, found[0] // 2 if is_pair else found[0], found[1])
            image = file.convert("RGB").crop(left)
            if image.size != (width, height):
                image = image.resize((width, height), Image.Resampling.BOX)
            return np.asarray(image)
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
    paths = tuple(frame.camera_path for frame in frames)
    _check_images(frames, [path is None for path in paths], allow_missing)
    return paths


def _check_embedded(
    frames: Sequence[Frame], record: np.ndarray, features: ArrayRecords
) -> None:
    """`UserError` for frames whose image is there but was not embedded."""
    forgotten = [
        frame.key
        for frame, position in zip(frames, record, strict=True)
        if position < 0 and frame.camera_path is not None
    ]
    if forgotten:
        raise UserError(
            f"{features.folder}: {len(forgotten)} of {len(frames)} frames have an image "
            f"that is not embedded, the first is {forgotten[0]}; embed all of the data: "
            "`radejax embed`"
        )


def _check_images(
    frames: Sequence[Frame], is_missing: Sequence[bool], allow_missing: bool
) -> None:
    missing = [f.key for f, gone in zip(frames, is_missing, strict=True) if gone]
    if missing and not allow_missing:
        raise UserError(
            f"{len(missing)} of {len(frames)} frames have no front image "
            f"(cam-front_*.png), the first is {missing[0]}; allow_missing_images takes "
            "black ones instead"
        )
