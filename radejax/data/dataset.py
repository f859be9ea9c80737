"""Interface of datasets: frames with their radar data, images and labels.

A reader of a format is a class that is derived from `LabeledFrames`, with frames that are
derived from `LabeledFrame`. `radejax.data.kradar` is the reader of K-Radar;
docs/own_radar.md shows another one.
"""

from __future__ import annotations

import collections
import copy
import dataclasses
import itertools
import pathlib
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Self, TypeVar, overload

import numpy as np
from jaxtyping import Bool, Float, Shaped

from radejax.core.errors import DataError, UserError, require
from radejax.core.files import JsonObject
from radejax.core.options import find_part
from radejax.data.options import DataOptions
from radejax.data.projection import PROBLEMS, find_problems
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid

_MAX_YAW_RAD = 10.0  # larger angles are taken to be degrees
_BEV_Z_AND_HEIGHT_M = (0.0, 1.5)  # of boxes whose labels have neither


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

    def report(self, kind: str, message: str) -> None:
        """Adds a problem."""
        self.problems.append((kind, message))

    def plus(self, other: Summary) -> Summary:
        """Returns a summary of both."""
        counts = self.counts.copy()
        counts.update(other.counts)
        return Summary(counts, self.problems + other.problems, self.notes + other.notes)

    def problem_counts(self) -> dict[str, int]:
        """Returns the number of problems of every kind."""
        return dict(collections.Counter(kind for kind, _ in self.problems))

    def to_dict(self) -> JsonObject:
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
class LabeledFrame:
    """One labeled frame.

    Frames must be picklable, as other processes compute their projections.

    Attributes:
        sequence: Number of the sequence.
        name: Name that is unique in the sequence.
        boxes: x, y, z, l, w, h, yaw in the radar frame, in meters and radians. Boxes of
            x, y, l, w, yaw get the height of the radar as z, and a height of 1.5 m.
        classes: Class names of `boxes`.
        columns: Further values of the objects by name, one row per box. K-Radar's reader
            has "track_id", "velocity_mps", "speed_mps" and "visibility".
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
    columns: Mapping[str, Shaped[np.ndarray, "N ..."]] = dataclasses.field(
        default_factory=dict
    )
    environment: str = "unknown"
    time: str = "unknown"
    weather: str = "unknown"
    radar_path: pathlib.Path | None = None
    camera_path: pathlib.Path | None = None
    camera_calibration_path: pathlib.Path | None = None
    radar_from_lidar_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radar_from_lidar_z_m: float = 0.0
    is_simulated: bool = False

    def __post_init__(self) -> None:
        boxes = np.asarray(self.boxes, np.float64)
        classes = np.asarray(self.classes)
        if not boxes.size:  # np.array([]) has other shapes and types
            boxes = np.zeros((0, 7))
        elif boxes.ndim == 2 and boxes.shape[1] == 5:
            boxes = np.insert(boxes, (2, 4), _BEV_Z_AND_HEIGHT_M, axis=1)
        if not classes.size:
            classes = np.zeros(0, str)
        object.__setattr__(self, "boxes", boxes)
        object.__setattr__(self, "classes", classes)

    @property
    def key(self) -> str:
        """Name that is unique in a dataset, such as `"1/00033_00001"`."""
        return f"{self.sequence}/{self.name}"

    def with_objects(self, rows: Bool[np.ndarray, " N"]) -> Self:
        """Returns the frame with some of its objects.

        Args:
            rows: True for the objects to keep.
        """
        return dataclasses.replace(
            self,
            boxes=self.boxes[rows],
            classes=self.classes[rows],
            columns={name: values[rows] for name, values in self.columns.items()},
        )

    def read_projection(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """Reads the radar data and computes their projection, see `project_tensor`.

        The files of K-Radar are read by `read_frame` in `kradar/tesseract.py`.

        Args:
            grid: Sensor axes, those of the dataset.

        Raises:
            FileNotFoundError: The frame has no radar file.
            DataError: The file is corrupted, or its shape does not match the grid.
        """
        raise NotImplementedError

    def read_checked(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """Calls `read_projection` and checks shape and values.

        Raises:
            FileNotFoundError: The frame has no radar file.
            DataError: The projection has another shape than the grid, or values that do not
                come from linear power.
        """
        projection = self.read_projection(grid)
        shape = grid.projection_shape
        if projection.shape != shape:
            raise DataError(f"projection of shape {projection.shape}, not {shape}")
        found = find_problems(projection.max(axis=0)[None], projection.min()[None])
        for problem in itertools.compress(PROBLEMS, found):
            raise DataError(f"projection: {problem}")
        return projection

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Reads the camera calibration.

        It is called only if there is a `camera_calibration_path`.

        Args:
            radar_from_lidar_m: Translation x, y, z in meters from the LiDAR to the radar
                frame; that of the frame if None.

        Raises:
            DataError: The file is corrupted.
        """
        raise NotImplementedError

    def calibrated_size(self) -> tuple[int, int] | None:
        """Returns height and width of the calibration's images, or None without one."""
        if self.camera_calibration_path is None:
            return None
        calibration = self.read_calibration()
        return calibration.height, calibration.width


FrameSequence = Sequence[LabeledFrame]
"""A dataset, or a part of one, of which only the frames are read."""

_F = TypeVar("_F", bound=LabeledFrame, covariant=True)


class LabeledFrames(Sequence[_F]):
    """The frames of a dataset in a fixed order.

    Readers of a format are subclasses with the methods `from_options` and `of_split`.

    Args:
        frames: The frames.
        grid: Sensor axes of the radar.
        summary: Summary of reading them.
        is_simulated: Whether the dataset is simulated.

    Attributes:
        grid, is_simulated: As given.
        release: Reduced release from which the projections are computed (one of
            `radejax.data.kradar.reduced.RELEASES`), or None.
        reader_version: Text that a reader changes when it computes other projections from
            the same files; records of another version are not used. None if the reader
            never changes.
        has_label_versions: Whether `config.data.label_version` applies to the format.
        license: License of the data, which exported models state.
    """

    license = "not stated by the reader"
    release: str | None = None
    reader_version: str | None = ""
    has_label_versions = False

    def __init__(
        self,
        frames: Sequence[_F],
        grid: RadarGrid,
        summary: Summary | None = None,
        *,
        is_simulated: bool = False,
    ) -> None:
        self.grid = grid
        self.is_simulated = is_simulated
        self._frames = frames
        self._summary = summary or Summary()

    @classmethod
    def from_options(cls, options: DataOptions, classes: Sequence[str]) -> Self:
        """Reads all frames of a dataset.

        Args:
            options: The section `config.data`. `sequences` and `weather` are applied
                afterwards if the reader ignores them.
            classes: Classes to detect. Objects of other classes may be left out.

        Raises:
            UserError: There are no frames, or an option has an invalid value.
            DataError: A file is corrupted.
        """
        raise NotImplementedError

    @classmethod
    def check_options(cls, options: DataOptions, classes: Sequence[str]) -> None:
        """Raises `UserError` if the format has no such options or classes.

        Args:
            options: The section `config.data`.
            classes: Classes to detect.
        """

    def of_split(self, split: str | None) -> Self:
        """Returns the frames of a split.

        Args:
            split: Name of the split, such as "train" or "test"; None for all frames.

        Raises:
            UserError: There is no such split.
        """
        raise NotImplementedError

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> _F: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[_F]: ...

    def __getitem__(self, index: int | slice) -> _F | Sequence[_F]:
        return self._frames[index]

    def summary(self) -> Summary:
        """Returns a summary of what was read, skipped, missing and malformed."""
        return self._summary

    @property
    def counts(self) -> collections.Counter[str]:
        """Numbers of items that were read and skipped, by reason (`summary().counts`)."""
        return self._summary.counts

    def _with(self, frames: Sequence[Any], summary: Summary) -> Self:
        """Returns the dataset with other frames."""
        other = copy.copy(self)
        other._frames = frames
        other._summary = summary
        return other

    def without(self, left_out: Collection[str], reason: str) -> Self:
        """Returns the dataset without some frames.

        Args:
            left_out: Keys of the frames to leave out.
            reason: Reason under which they are counted in the summary.
        """
        frames = [frame for frame in self if frame.key not in left_out]
        counts = {f"frames left out: {reason}": len(self) - len(frames)}
        return self._with(
            frames, self._summary.plus(Summary(collections.Counter(counts)))
        )

    def part(
        self, sequences: Collection[int] | None, weather: Collection[str] | None
    ) -> Self:
        """Returns the frames of some sequences and weathers.

        Args:
            sequences: Sequences of the frames to keep; all if None or empty.
            weather: Weathers of the frames to keep; all if None or empty.
        """
        left_out = {
            frame.key
            for frame in self
            if (sequences and frame.sequence not in sequences)
            or (weather and frame.weather not in weather)
        }
        if not left_out:
            return self
        return self.without(left_out, "other sequences or weather")

    def with_valid_boxes(self, classes: Collection[str]) -> Self:
        """Returns the dataset without objects that no detector can learn.

        These are objects of other classes than `classes`, boxes with values that are not
        finite or sizes that are not above 0, and those whose center is outside the field of
        view. The summary counts them.

        Args:
            classes: Classes to detect.

        Raises:
            UserError: Frames have the same key, boxes are of another shape, yaws are in
                degrees, or classes or a column have not one row per box.
        """
        keys = collections.Counter(frame.key for frame in self)
        for key, number in keys.most_common(1):
            expected = "1: other names or sequences"
            require(number == 1, f"number of frames {key}", number, expected)
        counts = collections.Counter[str]()
        frames: list[LabeledFrame] = []
        for frame in self:
            boxes = frame.boxes
            names = frame.classes
            what = f"frame {frame.key}: shape of boxes"
            expected = "(N, 7): x, y, z, l, w, h, yaw; or (N, 5): x, y, l, w, yaw"
            require(boxes.shape[1:] == (7,), what, boxes.shape, expected)
            what = f"frame {frame.key}: shape of classes"
            expected = f"({len(boxes)},), one name per box"
            require(names.shape == (len(boxes),), what, names.shape, expected)
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
                    f"frame {frame.key}: yaw is {yaw[np.abs(yaw).argmax()]:g}, expected "
                    "radians"
                )
            for name, values in frame.columns.items():
                what = f"frame {frame.key}: number of rows of column {name!r}"
                is_equal = len(values) == len(boxes)
                require(is_equal, what, len(values), f"{len(boxes)}, one per box")
            frames.append(frame if kept.all() else frame.with_objects(kept))
        lacking = "frames with a camera_path and no camera_calibration_path"
        for frame in self:
            is_lacking = frame.camera_path and not frame.camera_calibration_path
            counts[f"{lacking}: read_calibration is not called"] += bool(is_lacking)
        return self._with(frames, self._summary.plus(Summary(counts)))


def read_frames(
    options: DataOptions, classes: Sequence[str]
) -> LabeledFrames[LabeledFrame]:
    """Reads the frames of the chosen sequences and weathers by the reader of a config.

    Args:
        options: The section `config.data`, of which `format` names the reader.
        classes: Classes of the objects to keep.

    Raises:
        UserError: There is no such reader, there are no frames, or boxes or columns are
            wrong, see `LabeledFrames.with_valid_boxes`.
    """
    frames = find_reader(options.format).from_options(options, classes)
    frames = frames.with_valid_boxes(classes).part(options.sequences, options.weather)
    if not len(frames):
        chosen = options.sequences or options.weather
        part = " of these sequences and weathers" if chosen else ""
        raise UserError(
            f"no frames{part} in {', '.join(options.roots)}: give the roots of the dataset"
        )
    return frames


def find_reader(name: str) -> type[LabeledFrames[LabeledFrame]]:
    """Returns the reader of a format.

    Args:
        name: "kradar", or "module:Class" for another reader.

    Raises:
        UserError: There is no such name, or the class cannot be imported.
    """
    place = "radejax.data.kradar:KRadar" if name == "kradar" else name
    reader: type[LabeledFrames[LabeledFrame]] = find_part(
        place, "config.data.format", {"kradar": None}, LabeledFrames
    )
    return reader


def held_out(
    sequences: Collection[int], validation: Sequence[float], seed: int
) -> list[int]:
    """Returns the sequences of the train split that are held out for validation.

    Args:
        sequences: Numbers of the sequences that have training frames.
        validation: Numbers of the sequences to hold out; or a single fraction between 0
            and 1 of the sequences, of which at least one is drawn at random; or () for
            none.
        seed: Seed of the random draw.

    Returns:
        The sorted numbers of the held-out sequences.

    Raises:
        UserError: A sequence has no training frames, or none is left to train on.

    Examples:
        >>> held_out({1, 2, 5}, (5,), 0)
        [5]
        >>> len(held_out(range(1, 59), (0.1,), 0))
        6
    """
    here = sorted(set(sequences))
    if len(validation) == 1 and 0 < validation[0] < 1:
        count = max(1, round(validation[0] * len(here)))
        chosen = {int(n) for n in np.random.default_rng(seed).permutation(here)[:count]}
    else:
        chosen = {int(number) for number in validation}
    if absent := sorted(chosen.difference(here)):
        raise UserError(
            f"config.data.validation holds out sequences {absent}, which have no frames in "
            f"the train split; there are {here}"
        )
    if chosen and len(chosen) == len(here):
        raise UserError(
            f"config.data.validation is {tuple(validation)}, which holds out every "
            f"sequence of the train split ({here}); leave at least one"
        )
    return sorted(chosen)
