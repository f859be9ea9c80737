"""What a run needs from a dataset: its frames, their radar, images and labels.

`radejax.data.kradar` reads K-Radar; docs/extending.md has another reader. Readers derive
from the two classes below.
"""

from __future__ import annotations

import collections
import copy
import dataclasses
import importlib
import pathlib
from collections.abc import Callable, Collection, Sequence
from typing import Any, Self, TypeVar

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from radejax.core.errors import UserError, require
from radejax.data.cameras import IMAGE_SIZE, read_left_image
from radejax.data.tesseract import read_frame
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid


@dataclasses.dataclass
class Summary:
    """What reading a dataset found.

    Attributes:
        counts: What was read and what was skipped, by reason.
        problems: Everything missing or malformed: kind, and message with file and line.
        notes: Assumptions that were made where a file is missing.
    """

    counts: collections.Counter[str] = dataclasses.field(
        default_factory=collections.Counter
    )
    problems: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)

    def problem_counts(self) -> dict[str, int]:
        """Number of problems of every kind."""
        return dict(collections.Counter(kind for kind, _ in self.problems))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "counts": dict(self.counts),
            "problem_counts": self.problem_counts(),
            "problems": [message for _, message in self.problems],
            "notes": list(self.notes),
        }

    def to_text(self, max_problems: int = 3) -> str:
        """Lines for a terminal: all counts, the first problems of every kind."""
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
    """One frame; it is pickled, as other processes project it.

    Attributes:
        sequence: Number of the sequence.
        name: Name that is unique in the sequence.
        boxes: x, y, z, l, w, h, yaw in the radar frame: meters, radians.
        classes: Class names of `boxes`.
        environment, time, weather: Conditions, by which results are tabulated.
        radar_path: File of the radar tensor; None where it is missing.
        camera_path: Image of the (left) front camera; None where it is missing.
        camera_calibration_path: Its calibration, or None.
        radar_from_lidar_m: Offset from where the calibration is measured to where boxes
            are (`p_radar = p_lidar + t`): x, y, z; zeros where the two are the same.
        radar_from_lidar_z_m: The z of the offset between the sensors as they are
            mounted, whatever z was added to the boxes.
        is_simulated: Nothing of the frame was measured.
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
        """Name that is unique in a dataset: `"1/00033_00001"`."""
        return f"{self.sequence}/{self.name}"

    def read_projection(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """Read the float32 projection; see `tesseract.read_frame`.

        Raises:
            FileNotFoundError: The frame has no radar file.
            DataError: It is corrupted, or of another shape than the grid.
        """
        if self.radar_path is None:
            raise FileNotFoundError("no radar tensor in any root")
        return read_frame(self.radar_path, grid)

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Read the camera's calibration, with the frame's own offset or another."""
        assert self.camera_calibration_path is not None  # callers check it
        return CameraCalibration.from_kradar(
            self.camera_calibration_path,
            radar_from_lidar_m=radar_from_lidar_m or self.radar_from_lidar_m,
        )


FrameSequence = Sequence[LabelledFrame]
"""A dataset or a part of one: where only its frames matter."""

_F = TypeVar("_F", bound=LabelledFrame)


class LabelledFrames(Sequence[_F]):
    """The frames of a dataset in a fixed order; a reader adds how they are found.

    Attributes:
        grid: Axes of the radar.
        is_simulated: The dataset is simulated.
    """

    def __init__(
        self,
        frames: Sequence[_F],
        grid: RadarGrid,
        summary: Summary | None = None,
        *,
        is_simulated: bool = False,
    ) -> None:
        self.grid, self.is_simulated = grid, is_simulated
        self._frames, self._summary = frames, summary or Summary()

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Any) -> Any:
        return self._frames[index]

    def summary(self) -> Summary:
        """What was read, skipped, missing and malformed."""
        return self._summary

    def of_split(self, split: str | None) -> Self:
        """The frames of "train", "test" or another part; `UserError` for none that is."""
        raise NotImplementedError

    def without(self, left_out: Collection[str], reason: str) -> Self:
        """Return all frames but those of some keys, which are counted for a reason."""
        other = copy.copy(self)
        other._summary = copy.deepcopy(self._summary)
        other._frames = [frame for frame in self if frame.key not in left_out]
        counts = other._summary.counts
        counts[f"frames left out: {reason}"] += len(self) - len(other)
        return other


DATA_SETS: dict[str, str | Callable[..., LabelledFrames]] = {
    "kradar": "radejax.data.kradar:KRadar"
}
"""Readers that `config.data.format` may name, as classes or as "module:Class".

They are called with roots, labels and the options of `KRadar`, of which another reader may
ignore those that it has no use for."""


def data_set(name: str) -> Callable[..., LabelledFrames]:
    """The reader of a format.

    Args:
        name: A name of `DATA_SETS`, or "module:Class".

    Raises:
        UserError: There is no such name, or the class cannot be imported.
    """
    reader = DATA_SETS.get(name, name)
    if not isinstance(reader, str):
        return reader
    module, _, attribute = reader.partition(":")
    expected = f"{', '.join(DATA_SETS)} or module:Class"
    require(bool(attribute), "config.data.format", name, expected)
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(f"config.data.format is {name!r}: {error}") from None


def front_view(
    frame: LabelledFrame,
) -> tuple[UInt8[np.ndarray, "H W 3"] | None, CameraCalibration | None]:
    """Left front image of a frame and its calibration, to draw.

    Images of another size than the calibration's are resized to it. None where there is
    none.

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
