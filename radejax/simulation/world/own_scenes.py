"""Own scenes: boxes, velocities and conditions of every frame, in a CSV file or as a list."""

from __future__ import annotations

import csv
import itertools
import logging
import re
from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
import pydantic
from annotated_types import Ge, Le

from radejax.core import files
from radejax.core.errors import DataError, UserError, require
from radejax.core.options import Options, Positive
from radejax.data.kradar import Frame
from radejax.data.kradar.conditions import Weather
from radejax.data.kradar.labels import Label, LabelHeader
from radejax.simulation.world import scene
from radejax.simulation.world.replay import Shift

_log = logging.getLogger(__name__)

_Surroundings = Literal[
    "urban", "highway", "alleyway", "university", "countryside", "mountain",
    "parkinglots", "shoulder", "indoor",
]  # fmt: skip


class SceneObject(Options, section="column"):
    """One object in one frame, which is a row of a CSV file of scenes.

    Times, speeds of the radar and conditions are the same in all rows of their frame or
    sequence. The lower sides of the boxes are on the ground.
    """

    model_config = pydantic.ConfigDict(strict=False)  # cells are text

    frame: Annotated[str, pydantic.Field(pattern=r"^\d{1,6}/\d{1,9}(_\d{1,9})?$")]
    """Sequence and frame, such as 1/12, or 1/00033_00001 as in predictions."""
    cls: Literal["Sedan", "Bus or Truck", "Pedestrian", "Motorcycle", "Bicycle"]
    """Class, which decides how the object reflects."""
    x: float
    """Center in the radar frame: forward."""
    y: float
    """To the left."""
    z: float
    """Upward, from the height of the LiDAR, as in predictions. The radar is 0.7 m below it, or as
    `simulation.radar_from_lidar_m` says."""
    l: Positive  # noqa: E741, the name in files of predictions
    """Length in meters."""
    w: Positive
    """Width in meters."""
    h: Positive
    """Height in meters."""
    yaw: Annotated[float, Ge(-10), Le(10)]
    """Heading in radians, 0 forward and positive to the left."""
    track_id: Annotated[int, Ge(-1)] = -1
    """Identity of the object in its sequence; -1 for none."""
    vx_mps: float = 0.0
    """Change of x over time. With neither vx_mps nor vy_mps, the velocity follows from the
    positions of the track, and is 0 without a track."""
    vy_mps: float = 0.0
    """Change of y over time."""
    timestamp_s: float | None = None
    """Time of the frame; by default, its number times 0.1 s."""
    ego_speed_mps: float = 0.0
    """Speed of the radar over ground in the frame, straight ahead."""
    environment: _Surroundings = "urban"
    """Surroundings of the sequence: a road type of K-Radar, or indoor for floor and walls."""
    time: Literal["day", "night"] = "day"
    """Time of the sequence."""
    weather: Weather = "normal"
    """Weather of the sequence, one of K-Radar's."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """Sequence, and frame numbers of radar and LiDAR in the names of files."""
        sequence, radar, *lidar = map(int, re.split("[/_]", self.frame))
        return sequence, radar, *(lidar or [radar])

    @property
    def clock_s(self) -> float:
        """Time of the frame."""
        default = self.numbers[1] * scene.FRAME_PERIOD_S
        return default if self.timestamp_s is None else self.timestamp_s


def write_scenes(path: files.PathLike, objects: Iterable[SceneObject]) -> None:
    """Writes a CSV file of scenes, which `SimulationOptions.scenes` may name."""
    with files.atomic_path(path) as temporary, open(temporary, "w") as file:
        writer = csv.DictWriter(file, SceneObject.model_fields, lineterminator="\n")
        writer.writeheader()
        writer.writerows(one.model_dump(exclude_unset=True) for one in objects)


def read_scenes(path: files.PathLike) -> list[SceneObject]:
    """Reads a CSV file of scenes: one row per object and frame.

    The columns are the fields of `SceneObject`. Empty cells have the default, and other
    columns, such as the scores of predictions, are not used and logged.

    Returns:
        Objects by sequence and time.

    Raises:
        DataError: A row is malformed, or contradicts an earlier one; the message names file,
            line and column.
    """
    lines = files.read_text(path).splitlines()
    reader = csv.DictReader(lines, restkey="without a name")
    columns = set(reader.fieldnames or ())
    if unused := columns - SceneObject.model_fields.keys():
        _log.warning("%s: columns %s are not used", path, ", ".join(sorted(unused)))
    objects: list[SceneObject] = []
    shared: dict[object, dict[str, object]] = {}
    for cells in reader:
        where = f"{path}, line {reader.line_num}"
        used = {name: x for name, x in cells.items() if x and name not in unused}
        try:
            one = SceneObject(**used)  # type: ignore[arg-type]
        except UserError as error:
            raise DataError(f"{where}: {error}") from None
        objects.append(one)
        of_frame = {"timestamp_s", "ego_speed_mps"}
        of_sequence = {"environment", "time", "weather"}
        for key, names in ((one.numbers, of_frame), (one.numbers[0], of_sequence)):
            values = one.model_dump(include=names)
            if (first := shared.setdefault(key, values)) != values:
                raise DataError(
                    f"{where}: {values}, expected {first} as in earlier rows"
                )
    require(bool(objects), str(path), "empty", "a row per object and frame")
    return sorted(objects, key=lambda one: (one.numbers[0], one.clock_s, one.numbers))


def read_frames(path: files.PathLike, radar_from_lidar_m: Shift) -> list[Frame]:
    """Reads the frames of own scenes, with labels in the LiDAR frame."""
    frames: list[Frame] = []
    for numbers, group in itertools.groupby(read_scenes(path), lambda one: one.numbers):
        rows = list(group)
        one = rows[0]
        boxes = np.array([(x.x, x.y, x.z, x.l, x.w, x.h, x.yaw) for x in rows])
        boxes[:, :2] -= radar_from_lidar_m[:2]  # z of boxes is the LiDAR's
        labels: list[Label] = []
        for row, box in zip(rows, boxes.tolist(), strict=True):
            is_moving = bool(row.model_fields_set & {"vx_mps", "vy_mps"})
            velocity = (row.vx_mps, row.vy_mps) if is_moving else None
            labels.append(Label(row.cls, tuple(box), "R", row.track_id, velocity))
        sequence, radar, lidar = numbers
        frame = Frame(
            sequence=sequence,
            name=f"{radar:05d}_{lidar:05d}",
            boxes=np.zeros((0, 7)),
            classes=np.zeros(0),
            environment=one.environment,
            time=one.time,
            weather=one.weather,
            header=LabelHeader(one.clock_s, radar, lidar, lidar),
            labels=tuple(labels),
            tesseract_path=None,
            projection_path=None,
            ego_speed_mps=one.ego_speed_mps,
        )
        frames.append(frame)
    return frames
