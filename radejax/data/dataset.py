"""What a run asks of a data set: its frames, their radar, images and labels.

K-Radar (`radejax.data.kradar`) gives it, and so can another; docs/extending.md has a
whole one. Nothing has to inherit from anything.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Shaped

from radejax.core.errors import UserError
from radejax.data.kradar.dataset import KRadar, Summary
from radejax.geometry.camera import CameraCalibration
from radejax.geometry.radar_grid import RadarGrid


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
        camera_path: Picture of the (left) front camera; None where there is none.
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

DATA_SETS: dict[str, Callable[..., LabelledFrames]] = {"kradar": KRadar}
"""What `config.data.format` may name: called with roots, labels and the options of
`KRadar`, of which another may ignore those that it has no use for."""


def data_set(name: str) -> Callable[..., LabelledFrames]:
    """What opens data sets of a format; `UserError` for one that there is not."""
    if name not in DATA_SETS:
        raise UserError(
            f"config.data.format is {name!r}, expected one of {', '.join(DATA_SETS)}"
        )
    return DATA_SETS[name]
