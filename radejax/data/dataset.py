"""What a run needs from a dataset: its frames, their radar, images and labels.

`radejax.data.kradar` reads K-Radar; docs/extending.md has another reader. Readers satisfy
the protocols below and need not inherit from them.
"""

from __future__ import annotations

import collections
import dataclasses
import importlib
import pathlib
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from radejax.core.errors import UserError, require
from radejax.data.cameras import IMAGE_SIZE, read_left_image
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid


@dataclasses.dataclass
class Summary:
    """What reading a data set found.

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


@runtime_checkable
class LabelledFrame(Protocol):
    """One frame, a dataclass; to be pickled, as other processes project it.

    Attributes:
        key: Name that is unique in the data set; of `sequence` and `name`.
        environment, time, weather: Conditions, by which results are tabulated.
        is_simulated: Nothing of it was measured.
        boxes: x, y, z, l, w, h, yaw in the radar frame: metres, radians.
        classes: Class names of `boxes`.
        radar_path: File of the radar tensor; None where it is missing.
        camera_path: Image of the (left) front camera; None where there is none.
        camera_calibration_path: Its calibration, or None.
        radar_from_lidar_m: Offset from where the calibration is measured to where boxes
            are: x, y, z; zeros where the two are the same.
        radar_from_lidar_z_m: By which the radar itself is higher, whatever z boxes have.
    """

    @property
    def key(self) -> str: ...
    @property
    def sequence(self) -> int: ...
    @property
    def name(self) -> str: ...
    @property
    def environment(self) -> str: ...
    @property
    def time(self) -> str: ...
    @property
    def weather(self) -> str: ...
    @property
    def is_simulated(self) -> bool: ...
    @property
    def boxes(self) -> Float[np.ndarray, "N 7"]: ...
    @property
    def classes(self) -> Shaped[np.ndarray, " N"]: ...
    @property
    def radar_path(self) -> pathlib.Path | None: ...
    @property
    def camera_path(self) -> pathlib.Path | None: ...
    @property
    def camera_calibration_path(self) -> pathlib.Path | None: ...
    @property
    def radar_from_lidar_m(self) -> tuple[float, float, float]: ...
    @property
    def radar_from_lidar_z_m(self) -> float: ...

    def read_projection(self, grid: RadarGrid) -> Float[np.ndarray, "R A DE"]:
        """Projection; seconds of reading are added to "reading"."""

    def read_calibration(
        self, radar_from_lidar_m: tuple[float, ...] | None = None
    ) -> CameraCalibration:
        """Of the camera; `radar_from_lidar_m` stands where no offset is given."""


@runtime_checkable
class LabelledFrames(Protocol):
    """Frames in a fixed order.

    Attributes:
        grid: Axes of the radar.
        is_simulated: Nothing of them was measured.
    """

    @property
    def grid(self) -> RadarGrid: ...
    @property
    def is_simulated(self) -> bool: ...
    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> LabelledFrame: ...
    def __iter__(self) -> Iterator[LabelledFrame]: ...

    def of_split(self, split: str | None, /) -> LabelledFrames:
        """Those of "train", "test" or another part; `UserError` for none that is."""

    def without(self, left_out: Collection[str], reason: str) -> LabelledFrames:
        """All but those of some keys, which `summary` counts for the reason."""

    def summary(self) -> Summary:
        """What was read and left out."""


FrameSequence = LabelledFrames | Sequence[LabelledFrame]
"""Where it does not matter what else a data set can do."""

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
