"""K-Radar label files: one text file per frame, in four versions.

| version | comma-separated fields, the leading `*` included |
|---|---|
| v1.0 | `*`, id, previous id, class, x, y, z, yaw, l/2, w/2, h/2 (some: a single id) |
| v1.1 | `*`, visibility, id, previous id, class, x, y, z, yaw, l/2, w/2, h/2 |
| v2.0 | `*`, id, class, x, y, z, yaw, l/2, w/2, h/2 |
| v2.1 | `*`, visibility, id, class, x, y, z, yaw, l/2, w/2, h/2 |

Yaw is in degrees and extents are halved in the files; a `Label` has radians and full
extents. Positions are in the frame of the OS2-64 LiDAR.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
import re
import zipfile
from collections.abc import Iterator

from radejax.core import files
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike

Key = tuple[int, str]
"""Sequence number and frame name, such as `(1, "00033_00001")`."""

LabelPath = pathlib.Path | zipfile.Path
"""A label file, or one in a zip archive."""

MEDIAN_SIZES_M = {
    "Sedan": (4.61, 2.18, 1.91),
    "Bus or Truck": (10.11, 3.07, 3.68),
    "Pedestrian": (0.76, 0.71, 2.00),
    "Motorcycle": (1.89, 0.88, 1.60),
    "Bicycle": (1.96, 0.95, 1.60),
    "Pedestrian Group": (0.95, 1.64, 2.60),
    "Bicycle Group": (2.42, 9.15, 1.60),
}
"""Median length, width and height of every class in all of K-Radar's labels v2.1."""

LABEL_CLASSES = tuple(MEDIAN_SIZES_M)
"""Every class that occurs in K-Radar's labels; detectors use the first five."""

MAX_SIZE_RATIO = 5.0
"""Largest plausible ratio of a size and its median. In K-Radar's labels v2.1, 25 of 115,229
objects exceed it: three sedans that are 0.1, 0.6 or 0.24 m long or high, and a group that is
labeled as a pedestrian of 4.4 m."""

MIN_DISTANCE_M = 0.1
"""Smallest plausible distance of two centers. In K-Radar's labels v2.1, 26 pairs are
closer: 10 copies of a line, and 16 pairs of labels of one object."""

VERSIONS = ("v1.0", "v1.1", "v2.0", "v2.1")
VISIBILITY_FLAGS = ("R", "L", "L1")

_MAX_BYTES = 1 << 18  # K-Radar's largest label files have 3 kB
_MAX_NUMBER = 1e4  # meters or degrees

# Every pattern matches in linear time.
_NUMBER = r"([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)"
_SEPARATOR = r"\s*,\s*"
_FLAG = r"(?P<visibility>[A-Za-z]\w*)"
_ID = r"(?P<track_id>-?\d{1,9})"
_PREVIOUS_ID = r"-?\d{1,9}"  # identity in the previous frame, not used
_CLASS = f"(?P<cls>{'|'.join(LABEL_CLASSES)})"
_FIELDS = {
    "v1.0": (_ID + rf"(?:{_SEPARATOR}{_PREVIOUS_ID})?", _CLASS),  # with one or two ids
    "v1.1": (_FLAG, _ID, _PREVIOUS_ID, _CLASS),
    "v2.0": (_ID, _CLASS),
    "v2.1": (_FLAG, _ID, _CLASS),
}
_OBJECT = {
    version: re.compile(
        _SEPARATOR.join((r"\s*\*", *fields, *[_NUMBER] * 7)) + r"\s*", re.ASCII
    )
    for version, fields in _FIELDS.items()
}
_HEADERS = (
    re.compile(
        r"\*\s*idx\([^)]*\)=(\d{1,9})_(\d{1,9})_(\d{1,9})_(\d{1,9})_(\d{1,9}),"
        r"\s*timestamp=(\d{1,12}(?:\.\d*)?)\s*",
        re.ASCII,
    ),
    re.compile(  # format of the early annotation tool
        r"\*\s*radar idx: (\d{1,9}), lidar idx: (\d{1,9}), camera idx: (\d{1,9}), "
        r"time: (\d{1,12}(?:\.\d*)?)(?:,.*)?",
        re.DOTALL | re.ASCII,
    ),
)
_LINE_END = re.compile(r"\r\n|\n|\r")


@dataclasses.dataclass(frozen=True, slots=True)
class Label:
    """One labeled object.

    Attributes:
        cls: One of `LABEL_CLASSES`.
        box: x, y, z, l, w, h, yaw in the LiDAR frame: center and full extents in meters,
            heading in radians, not normalized.
        visibility: `R` if the object is visible to the radar, `L` if it is visible to
            the LiDAR only, `L1` if this was not judged. All objects of versions without
            the flag (v1.0, v2.0) have `R`.
        track_id: Identity within the sequence.
        velocity_mps: x and y of the velocity relative to the radar, or None as in all
            label files.
    """

    cls: str
    box: tuple[float, float, float, float, float, float, float]
    visibility: str = "R"
    track_id: int = -1
    velocity_mps: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class LabelHeader:
    """First line of a label file, which lists the sensor frames that belong together.

    Attributes:
        timestamp_s: Unix time of the OS2-64 scan.
        radar: Frame number of the radar tensor.
        lidar: Frame number of the OS2-64 LiDAR.
        camera_front: Frame number of the front camera.
        lidar_long: Frame number of the OS1-128 LiDAR, or None if unknown.
        camera_lrr: Frame number of the left, right and rear cameras, or None if unknown.
    """

    timestamp_s: float
    radar: int
    lidar: int
    camera_front: int
    lidar_long: int | None = None
    camera_lrr: int | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class LabelFile:
    """Content of one label file.

    Attributes:
        header: Content of the first line.
        labels: Objects of the file.
        problems: Messages on malformed lines, with file and line.
        doubts: Kinds and messages of objects that cannot be meant, which are kept.
        num_unstarred: Number of v1.x lines without a `*` that were left out.
    """

    header: LabelHeader
    labels: list[Label]
    problems: list[str]
    doubts: list[tuple[str, str]]
    num_unstarred: int


def normalize_version(version: str) -> str:
    """Converts names of a version, such as `"2.1"` and `"v2_1"`, to the form `"v2.1"`.

    Raises:
        UserError: There is no such version.
    """
    name = "v" + str(version).lower().removeprefix("v").replace("_", ".")
    if name not in VERSIONS:
        raise UserError(
            f"label version {version!r} does not exist; choose from {', '.join(VERSIONS)}"
        )
    return name


def read_labels(path: PathLike, version: str = "v2.1") -> list[Label]:
    """Reads the objects of one label file in the order of its lines.

    Args:
        path: Label file, `<radar index>_<lidar index>.txt`.
        version: Label version of the file.

    Returns:
        Labels in the LiDAR frame, with full extents in meters and yaw in radians.

    Raises:
        DataError: The file is malformed; the message names file and line.
        FileNotFoundError: There is no such file.
        UserError: There is no such version.
    """
    file = read_label_file(pathlib.Path(path), normalize_version(version))
    if file.problems:
        raise DataError(file.problems[0])
    return file.labels


def read_label_file(
    path: LabelPath, version: str, *, include_unstarred: bool = False
) -> LabelFile:
    """Reads a label file; malformed lines are skipped and described in `problems`.

    Args:
        path: Label file.
        version: Label version, such as "v2.1".
        include_unstarred: Whether lines of v1.x without a `*` are objects too if they
            have the fields of an object, as in the authors' code.

    Raises:
        DataError: The header is malformed, or the file is not text.
        FileNotFoundError: There is no such file.
    """
    with wrap_read_errors(str(path), "a label file"), path.open("rb") as file:
        content = file.read(_MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise DataError(f"{path}: more than {_MAX_BYTES} bytes, not a label file")
    first, *lines = _LINE_END.split(files.decoded(content, str(path)))
    # Some v2.0 files have their first object on the same line as the header.
    second = first.find("*", first.find("*") + 1)
    header = _parse_header(first if second < 0 else first[:second], f"{path}:1")
    lines.insert(0, "" if second < 0 else first[second:])
    labels: list[Label] = []
    problems: list[str] = []
    doubts: list[tuple[str, str]] = []
    num_unstarred = 0
    for number, line in enumerate(lines, start=1):
        if not line or line.isspace():
            continue
        if version.startswith("v1") and not line.lstrip().startswith("*"):
            line = "*," + line.partition(",")[2]
            if not (include_unstarred and _OBJECT[version].fullmatch(line)):
                num_unstarred += 1
                continue
        try:
            label = _parse_object(line, version)
        except DataError as error:
            problems.append(f"{path}:{number}: {error}")
            continue
        doubts += [(x, f"{path}:{number}: {why}") for x, why in _doubts(label, labels)]
        labels.append(label)
    return LabelFile(header, labels, problems, doubts, num_unstarred)


def _doubts(label: Label, others: list[Label]) -> Iterator[tuple[str, str]]:
    """Yields kind and message of what cannot be meant of a label, among those before it."""
    usual = MEDIAN_SIZES_M[label.cls]
    ratios = [size / x for size, x in zip(label.box[3:6], usual, strict=True)]
    if max(ratios) > MAX_SIZE_RATIO or min(ratios) < 1 / MAX_SIZE_RATIO:
        text = "{} of {:.3g} x {:.3g} x {:.3g} m, expected about {} x {} x {} m"
        yield "object size", text.format(label.cls, *label.box[3:6], *usual)
    if any(math.dist(label.box[:3], x.box[:3]) < MIN_DISTANCE_M for x in others):
        yield "object twice", f"{label.cls} at the center of another object"


def _parse_header(line: str, where: str) -> LabelHeader:
    for pattern in _HEADERS:
        if match := pattern.fullmatch(line):
            *numbers, timestamp = match.groups()
            return LabelHeader(float(timestamp), *map(int, numbers))
    raise DataError(
        f"{where}: {line[:80]!r} is not a header, expected "
        "'* idx(...)=00033_00001_00002_00001_00004, timestamp=...'"
    )


def _parse_object(line: str, version: str) -> Label:
    pattern = _OBJECT[version]
    match = pattern.fullmatch(line)
    if match is None:
        raise DataError(
            f"{line[:80]!r} is not an object of {version} labels, expected "
            f"*, {', '.join(pattern.groupindex)}, x, y, z, yaw, l/2, w/2, h/2"
        )
    numbers = x, y, z, yaw_deg, *half_extents = list(map(float, match.groups()[-7:]))
    if min(half_extents) <= 0 or max(map(abs, numbers)) > _MAX_NUMBER:
        raise DataError(
            f"box {numbers}, expected x, y, z, yaw in degrees and positive half extents, "
            f"all up to {_MAX_NUMBER:g}"
        )
    length, width, height = (2.0 * half for half in half_extents)
    box = (x, y, z, length, width, height, math.radians(yaw_deg))
    fields = match.groupdict()
    visibility = fields.get("visibility", "R")
    return Label(fields["cls"], box, visibility, int(fields["track_id"]))
