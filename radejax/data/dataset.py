"""Interface of datasets: frames with their radar tensors, images and labels.

`radejax.data.kradar` reads K-Radar; docs/extending.md shows another reader. Readers are
derived from `LabelledFrame` and `LabelledFrames`.
"""

from __future__ import annotations

import collections
import copy
import dataclasses
import pathlib
from collections.abc import Callable, Collection, Sequence
from typing import Any, Self, TypeVar

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from radejax.core.errors import UserError
from radejax.core.options import find_part
from radejax.data.cameras import IMAGE_SIZE, read_left_image
from radejax.data.tesseract import read_frame
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid

_MAX_YAW_RAD = 10.0  # larger angles are taken to be degrees


@dataclasses.dataclass
class Summary:
    """Summary of reading a dataset.

    Attributes:
        counts: Numbers of items that were read and skipped, by reason.
        problems: Kind and message (with file and line) of everything that is missing or
            malformed.
        notes: Assumptions about missing files, and other remarks that are not problems.
    """

    counts: collections.Counter[str] = dataclasses.field(
        default_factory=collections.Counter
    )
    problems: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)

    def problem_counts(self) -> dict[str, int]:
        """Returns the number of problems of every kind."""
        return dict(collections.Counter(kind for kind, _ in self.problems))

    def to_dict(self) -> dict[str, Any]:
        """Returns the summary as JSON values."""
        return {
            "counts": dict(self.counts),
            "problem_counts": self.problem_counts(),
            "problems": [message for _, message in self.problems],
            "notes": list(self.notes),
        }

    def to_text(self, max_problems: int = 3) -> str:
        """Returns all counts and the first problems of every kind as text."""
        lines = [f"{n:>9,}  {what}" for what, n in self.counts.items() if n]
        lines += [f"note: {note}" for note in self.notes]
        for kind, number in self.problem_counts().items():
            messages = [text for found, text in self.problems if found == kind]
            lines.append(f"problem: {kind}: {number:,}")
            lines += [f"    {message}" for message in messages[:max_problems]]
            if number > max_problems:
                lines.append(f"    ... and {number - max_problems:,} more")
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LabelledFrame:
    """One labelled frame.

    Frames must be picklable, as other processes compute their projections.

    Attributes:
        sequence: Number of the sequence.
        name: Name that is unique in the sequence.
        boxes: x, y, z, l, w, h, yaw in the radar frame, in meters and radians.
        classes: Class names of `boxes`.
        environment, time, weather: Conditions by which results are tabulated.
        radar_path: File of the radar tensor, or None if it is missing.
        camera_path: Image of the (left) front camera, or None if it is missing.
        camera_calibration_path: Calibration file of the camera, or None.
        radar_from_lidar_m: Translation x, y, z from the frame of the camera calibration
            to the frame of the boxes (`p_radar = p_lidar + t`); zeros if both are the
            same.
        radar_from_lidar_z_m: z of this translation according to the mounting positions
            of the sensors, which may differ from the z that was added to the boxes.
        is_simulated: Whether the frame is simulated.
    """

    sequence: int
    name: str
    boxes: Float[np.ndarray, "N 7"]
    classes: Shaped[np.ndarray, " N"]
    environment: str = "unknown"
    time: str = "unknown"
    weather: str = "unknown"
    radar_path: pathlib.Path | None = None
    camera_path: pathlib.Path | None = None
    camera_calibration_path: pathlib.Path | None = None
    radar_from_lidar_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radar_from_lidar_z_m: float = 0.0
    is_simulated: bool = False

    @property
    def key(self) -> str:
        """Name that is unique in a dataset, such as `"1/00033_00001"`."""
        return f"{self.sequence}/{self.name}"

    def read_projection(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """Reads the float32 projection (see `tesseract.read_frame`).

        Raises:
            FileNotFoundError: The frame has no radar file.
            DataError: The file is corrupted, or its shape does not match the grid.
        """
        if self.radar_path is None:
            raise FileNotFoundError("no radar tensor in any root")
        return read_frame(self.radar_path, grid)

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Reads the camera calibration, with the frame's own translation or a given one."""
        path = self.camera_calibration_path
        assert path is not None  # callers check it
        shift_m = radar_from_lidar_m or self.radar_from_lidar_m
        calibration = CameraCalibration.from_kradar(path, radar_from_lidar_m=shift_m)
        calibration.require_view_ahead(path)
        return calibration

    def calibrated_size(self) -> tuple[int, int] | None:
        """Returns height and width of the calibration's images, or None without one."""
        if self.camera_calibration_path is None:
            return None
        calibration = self.read_calibration()
        return calibration.height, calibration.width


FrameSequence = Sequence[LabelledFrame]
"""A dataset, or a part of one, of which only the frames are read."""

_F = TypeVar("_F", bound=LabelledFrame)


class LabelledFrames(Sequence[_F]):
    """The frames of a dataset in a fixed order.

    Readers of a format are subclasses that find and read the frames.

    Attributes:
        grid: Sensor axes of the radar.
        is_simulated: Whether the dataset is simulated.
        reader_version: Text that a reader changes when it computes other projections from
            the same files; records of another version are not used. None if neither the
            reader nor the files change, which are then not compared with their records.
        release: Reduced release from which the projections are computed (one of
            `radejax.data.reduced.RELEASES`), or None.
    """

    reader_version: str | None = ""
    release: str | None = None

    def __init__(
        self, frames: Sequence[_F], grid: RadarGrid, *, is_simulated: bool = False
    ) -> None:
        self.grid, self.is_simulated = grid, is_simulated
        self._frames, self._summary = frames, Summary()

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        return self._frames[index]

    def summary(self) -> Summary:
        """Returns a summary of what was read, skipped, missing and malformed."""
        return self._summary

    def of_split(self, split: str | None) -> Self:
        """Returns the frames of a split, such as "train" or "test".

        Raises:
            UserError: There is no such split.
        """
        raise NotImplementedError

    def without(self, left_out: Collection[str], reason: str) -> Self:
        """Returns the dataset without some frames.

        Args:
            left_out: Keys of the frames to leave out.
            reason: Reason under which they are counted in the summary.
        """
        other = copy.copy(self)
        other._summary = copy.deepcopy(self._summary)
        other._frames = [frame for frame in self if frame.key not in left_out]
        counts = other._summary.counts
        counts[f"frames left out: {reason}"] += len(self) - len(other)
        return other

    def part(
        self, sequences: Collection[int] | None, weather: Collection[str] | None
    ) -> Self:
        """Returns the frames of some sequences and weathers; None or empty for all."""
        left_out = {
            frame.key
            for frame in self
            if (sequences and frame.sequence not in sequences)
            or (weather and frame.weather not in weather)
        }
        return self.without(left_out, "other sequences or weather")

    def with_valid_boxes(self, classes: Collection[str]) -> Self:
        """Returns the dataset without objects that no detector can learn.

        These are objects of other classes than `classes`, boxes with values that are not
        finite or sizes that are not above 0, and those whose center is outside the field of
        view. The summary counts them.

        Raises:
            UserError: Yaws are in degrees.
        """
        other = copy.copy(self)
        other._summary = copy.deepcopy(self._summary)
        counts = other._summary.counts
        other._frames = [self._valid(frame, classes, counts) for frame in self]
        return other

    def _valid(
        self, frame: _F, classes: Collection[str], counts: collections.Counter[str]
    ) -> _F:
        boxes = np.asarray(frame.boxes, np.float64).reshape(-1, 7)
        names = np.asarray(frame.classes)
        others = set(names.tolist()).difference(classes)
        reasons = {f"class {name!r}": names == name for name in sorted(others)} | {
            "a value is not finite": ~np.isfinite(boxes).all(axis=1),
            "a size is not above 0": ~(boxes[:, 3:6] > 0).all(axis=1),
            "field of view": ~self.grid.in_field_of_view(*boxes[:, :2].T),
        }
        kept = np.ones(len(boxes), bool)
        for reason, is_wrong in reasons.items():
            counts[f"objects left out: {reason}"] += int((kept & is_wrong).sum())
            kept &= ~is_wrong
        yaw = boxes[kept, 6]
        if (np.abs(yaw) > _MAX_YAW_RAD).any():
            raise UserError(
                f"frame {frame.key}: yaw is {yaw[np.abs(yaw).argmax()]:g}, expected radians"
            )
        if kept.all():
            return frame
        return dataclasses.replace(frame, boxes=boxes[kept], classes=names[kept])


def data_set(name: str) -> Callable[..., LabelledFrames]:
    """Returns the reader of a format.

    It is called with the roots, the labels and the options of `KRadar`; another reader may
    ignore options that do not apply to it.

    Args:
        name: "kradar", or "module:Class" for another reader.

    Raises:
        UserError: There is no such name, or the class cannot be imported.
    """
    place = "radejax.data.kradar:KRadar" if name == "kradar" else name
    return find_part(place, "config.data.format", {"kradar": None}, LabelledFrames)


def front_view(
    frame: LabelledFrame,
) -> tuple[UInt8[np.ndarray, "H W 3"] | None, CameraCalibration | None]:
    """Returns the left front image of a frame and its calibration for drawing.

    The image is resized to the image size of the calibration, or to `IMAGE_SIZE` without
    one. Missing items are None, and both are None without an image.

    Raises:
        DataError: A file is corrupted.
    """
    if frame.camera_path is None:
        return None, None
    camera = None
    if frame.camera_calibration_path is not None:
        camera = frame.read_calibration()
    size = IMAGE_SIZE if camera is None else (camera.height, camera.width)
    return read_left_image(frame.camera_path, size, resize=True), camera
