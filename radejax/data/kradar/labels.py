"""K-Radar label files: one text file a frame, four versions with their oddities.

| version | comma-separated fields, the leading `*` included |
|---|---|
| v1.0 | `*`, id, previous id, class, x, y, z, yaw, l/2, w/2, h/2 (some: a single id) |
| v1.1 | `*`, availability, id, previous id, class, x, y, z, yaw, l/2, w/2, h/2 |
| v2.0 | `*`, id, class, x, y, z, yaw, l/2, w/2, h/2 |
| v2.1 | `*`, availability, id, class, x, y, z, yaw, l/2, w/2, h/2 |

Yaw is in degrees and extents are halved in the files; a `Label` has radians and full
extents. Positions are in the frame of the OS2-64 LiDAR.
"""

from __future__ import annotations

import dataclasses
import math
import os
import pathlib
import re

from radejax.core import files
from radejax.core.errors import DataError, UserError

LABEL_CLASSES = (
    "Sedan",
    "Bus or Truck",
    "Pedestrian",
    "Motorcycle",
    "Bicycle",
    "Pedestrian Group",
    "Bicycle Group",
)
"""Every class that occurs in K-Radar's labels; detectors use the first five."""

VERSIONS = ("v1.0", "v1.1", "v2.0", "v2.1")
VISIBILITY_FLAGS = ("R", "L", "L1")

MAX_LABEL_BYTES = 1 << 18
"""Of a label file; K-Radar's largest have 3 kB."""

_MAX_LINE = 1000  # characters; K-Radar's longest lines have 150
_MAX_DISTANCE_M, _MAX_HALF_EXTENT_M, _MAX_YAW_DEG = 1000.0, 50.0, 3600.0
_MAX_INDEX, _MAX_TIME_S = 2**31, 1e11

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SEPARATOR = r"\s*,\s*"
_BOX = _SEPARATOR.join(rf"({_NUMBER})" for _ in range(7))
_FLAG, _ID, _CLASS = r"([A-Za-z]\w*)", r"(-?\d+)", r"([A-Za-z][^,*]*?)"
_LEADING_FIELDS = {
    "v1.0": (_ID + rf"(?:{_SEPARATOR}{_ID})?", _CLASS),  # with one or two ids
    "v1.1": (_FLAG, _ID, _ID, _CLASS),
    "v2.0": (_ID, _CLASS),
    "v2.1": (_FLAG, _ID, _CLASS),
}
_LINES = {
    version: re.compile(
        _SEPARATOR.join((r"\s*\*", *fields, _BOX)) + r"\s*", flags=re.ASCII
    )
    for version, fields in _LEADING_FIELDS.items()
}
_HEADER = re.compile(r"\*\s*idx\(([^)]*)\)=([\d_]+),\s*timestamp=([\d.]+)\s*", re.ASCII)
_TOOL_HEADER = re.compile(
    r"\*\s*radar idx: (\d+), lidar idx: (\d+), camera idx: (\d+), time: ([\d.]+)"
    r"(?:,.*)?",
    flags=re.DOTALL | re.ASCII,
)
_LINE_END = re.compile(r"\r\n|\n|\r")


@dataclasses.dataclass(frozen=True, slots=True)
class Label:
    """One labelled object.

    Attributes:
        cls: One of `LABEL_CLASSES`.
        box: x, y, z, l, w, h, yaw: center and full extents in metres in the LiDAR
            frame, heading in radians, not normalised.
        visibility: Availability flag; `R` is visible to the radar, `L` to the LiDAR
            only, `L1` not judged. Versions without the flag (v1.0, v2.0) read `R`:
            every object counts.
        track_id: Identity within the sequence; -1 where the file has none.
        previous_track_id: Identity in the frame before (v1.x), -1 or None: none.
    """

    cls: str
    box: tuple[float, float, float, float, float, float, float]
    visibility: str = "R"
    track_id: int = -1
    previous_track_id: int | None = None


@dataclasses.dataclass(frozen=True, slots=True)
class LabelHeader:
    """First line of a label file: which frames of the sensors belong together.

    Attributes:
        radar: Frame number of the tesseract.
        lidar: Frame number of the OS2-64 LiDAR.
        camera_front: Frame number of the front camera, None where unknown.
        lidar_long: Frame number of the OS1-128 LiDAR, None where unknown.
        camera_lrr: Frame number of the left, right and rear cameras, None: unknown.
        timestamp_s: Unix time of the OS2-64 scan.
    """

    radar: int
    lidar: int
    camera_front: int | None
    lidar_long: int | None
    camera_lrr: int | None
    timestamp_s: float


@dataclasses.dataclass(frozen=True, slots=True)
class Problem:
    """Something missing or malformed: where it is and what was expected."""

    kind: str
    where: str
    message: str

    def __str__(self) -> str:
        if self.message.startswith(self.where):
            return self.message
        return f"{self.where}: {self.message}"


@dataclasses.dataclass(frozen=True, slots=True)
class LabelFile:
    """All of one label file.

    Attributes:
        header: Its first line.
        labels: Its objects.
        num_disabled: v1.x lines without a `*` that are no objects of these.
    """

    header: LabelHeader
    labels: list[Label]
    num_disabled: int


def normalize_version(version: str) -> str:
    """`"2.1"`, `"v2_1"` and `"v2.1"` all name version `"v2.1"`.

    Raises:
        UserError: There is no such version.
    """
    name = "v" + str(version).lower().removeprefix("v").replace("_", ".")
    if name not in VERSIONS:
        raise UserError(
            f"label version {version!r} does not exist; choose from {', '.join(VERSIONS)}"
        )
    return name


def read_labels(
    path: str | os.PathLike,
    version: str = "v2.1",
    *,
    problems: list[Problem] | None = None,
) -> list[Label]:
    """Objects of one label file, in the order of its lines.

    Args:
        path: Label file, `<radar index>_<lidar index>.txt`.
        version: Label version of the file.
        problems: Without it the first malformed line raises. With it malformed lines
            are left out and appended to this list.

    Returns:
        Labels in the LiDAR frame, with full extents and radians.

    Raises:
        DataError: The file is malformed; the message names file and line.
        FileNotFoundError: There is no such file.
        UserError: There is no such version.
    """
    return read_label_file(path, version, problems=problems).labels


def read_label_file(
    path: str | os.PathLike,
    version: str = "v2.1",
    *,
    problems: list[Problem] | None = None,
) -> LabelFile:
    """Header and objects of one label file; arguments as in `read_labels`."""
    version, path = normalize_version(version), pathlib.Path(path)
    content = read_label_bytes(path)
    return parse_label_file(content, version, where=str(path), problems=problems)


def read_label_bytes(path: pathlib.Path) -> bytes:
    """Content of a label file; errors as `read_labels`, also for a far too large one."""
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_LABEL_BYTES + 1)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such label file") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, expected a label file") from None
    if len(content) > MAX_LABEL_BYTES:
        raise DataError(f"{path}: more than {MAX_LABEL_BYTES} bytes, no label file")
    return content


def parse_label_file(
    content: bytes,
    version: str = "v2.1",
    *,
    where: str = "<labels>",
    problems: list[Problem] | None = None,
    include_unstarred_v11_labels: bool = False,
) -> LabelFile:
    """Like `read_label_file` for the content of a file; `where` names it in errors.

    With `include_unstarred_v11_labels` v1.x lines without a `*` are objects like others where they
    have the fields of one, as the released code reads them.

    A damaged header or an undecodable file raises even with `problems`: nothing in
    such a file can be trusted.
    """
    version = normalize_version(version)
    lines = _LINE_END.split(_decode(content, where))
    if len(lines[0]) > 2 * _MAX_LINE:  # of v2.0 also with an object
        raise DataError(f"{where}:1: {_short(lines[0])} is too long for a header")
    header_line, joined = _split_header(lines[0])
    header = _parse_header(header_line, where)
    labels: list[Label] = []
    num_disabled = 0
    numbered = [(1, joined)] if joined else []
    numbered += list(enumerate(lines[1:], start=2))
    for number, line in numbered:
        if not line or line.isspace():
            continue
        if version.startswith("v1") and not line.lstrip().startswith("*"):
            line = "*," + line.partition(",")[2]
            if not (include_unstarred_v11_labels and _LINES[version].fullmatch(line)):
                num_disabled += 1
                continue
        try:
            labels.append(_parse_object(line, version, f"{where}:{number}"))
        except DataError as error:
            if problems is None:
                raise
            message = str(error).removeprefix(f"{where}:{number}: ")
            problems.append(Problem("label line", f"{where}:{number}", message))
    return LabelFile(header, labels, num_disabled)


def _decode(content: bytes, where: str) -> str:
    """The text of a file, without a byte order mark."""
    if not content.strip():
        raise DataError(f"{where}:1: the file is empty, expected a header line")
    return files.decoded(content, where)


def _split_header(line: str) -> tuple[str, str]:
    """The header and what follows a second `*` (the merged lines of v2.0)."""
    second = line.find("*", line.find("*") + 1)
    return (line, "") if second < 0 else (line[:second], line[second:])


def _parse_header(line: str, where: str) -> LabelHeader:
    """Both header forms: of the data set and of the early annotation tool."""
    if match := _HEADER.fullmatch(line):
        indices = match[2].split("_")
        if len(indices) != 5 or not all(indices):
            raise DataError(
                f"{where}:1: the header has indices {match[2]!r}, expected five: "
                "radar, LiDAR OS2-64, front camera, LiDAR OS1-128, other cameras"
            )
        time_text, numbers = match[3], indices
    elif match := _TOOL_HEADER.fullmatch(line):
        time_text, numbers = match[4], [match[1], match[2], match[3]]
    else:
        raise DataError(
            f"{where}:1: {_short(line)} is no header, expected "
            "'* idx(...)=00033_00001_00002_00001_00004, timestamp=...'"
        )
    radar, lidar, *others = map(int, numbers)
    if max(radar, lidar, *others) >= _MAX_INDEX:
        raise DataError(f"{where}:1: {_short(line)} has frame numbers of {_MAX_INDEX}")
    try:
        timestamp_s = float(time_text)
    except ValueError:
        raise DataError(f"{where}:1: timestamp {time_text!r} is not a number") from None
    if timestamp_s > _MAX_TIME_S:
        raise DataError(
            f"{where}:1: timestamp {_short(time_text)} is no Unix time in s"
        )
    camera, long_lidar, cameras = [*others, None, None][:3]
    return LabelHeader(radar, lidar, camera, long_lidar, cameras, timestamp_s)


def _parse_object(line: str, version: str, where: str) -> Label:
    """One object line; a `DataError` says what is wrong with it."""
    if len(line) > _MAX_LINE:
        raise DataError(
            f"{where}: {len(line)} characters, expected at most {_MAX_LINE}: {_short(line)}"
        )
    match = _LINES[version].fullmatch(line)
    if match is None:
        raise DataError(f"{where}: {_explain(line, version)}")
    *leading, cls = match.groups()[:-7]
    x, y, z, yaw_deg, *half_extents = map(float, match.groups()[-7:])
    if cls not in LABEL_CLASSES:
        raise DataError(
            f"{where}: class {cls!r} is unknown, expected one of "
            + ", ".join(LABEL_CLASSES)
        )
    length, width, height = (2.0 * half for half in half_extents)
    box = (x, y, z, length, width, height, math.radians(yaw_deg))
    if not (
        all(abs(value) <= _MAX_DISTANCE_M for value in (x, y, z))
        and all(0 < half <= _MAX_HALF_EXTENT_M for half in half_extents)
        and abs(yaw_deg) <= _MAX_YAW_DEG
    ):
        raise DataError(
            f"{where}: position {x!r}, {y!r}, {z!r} m, yaw {yaw_deg!r} deg, half extents "
            f"{', '.join(map(repr, half_extents))} m: all must be finite, positions up to "
            f"{_MAX_DISTANCE_M:g} m, half extents positive up to {_MAX_HALF_EXTENT_M:g} "
            f"m, yaw up to {_MAX_YAW_DEG:g} deg"
        )
    visibility = leading.pop(0) if version in ("v1.1", "v2.1") else "R"
    previous = None
    if version.startswith("v1") and leading[1] is not None:
        previous = int(leading[1])
    track = int(leading[0])
    if max(abs(track), abs(previous or 0)) >= _MAX_INDEX:
        raise DataError(f"{where}: track id in {_short(line)}, expected below 2**31")
    return Label(cls, box, visibility, track, previous)


def _explain(line: str, version: str) -> str:
    """What is wrong with an object line that does not have the layout of a version."""
    for other in VERSIONS:
        if other != version and _LINES[other].fullmatch(line):
            return f"{_short(line)} has the layout of {other} labels, not of {version}"
    fields = [field.strip() for field in line.split(",")]
    expected = len(_LEADING_FIELDS[version]) + 8 + (version == "v1.0")
    if not line.lstrip().startswith("*"):
        return f"{_short(line)} does not start with '*'"
    if len(fields) != expected:
        return (
            f"{len(fields)} fields in {_short(line)}, expected {expected} ({version})"
        )
    for field in fields[-7:]:
        if not re.fullmatch(_NUMBER, field, flags=re.ASCII):
            return f"{_short(field)} is not a number, in {_short(line)}"
    return f"{_short(line)} is not an object line of {version} labels"


def _short(text: str) -> str:
    """A quotation that fits in a message."""
    return repr(text if len(text) <= 80 else text[:77] + "...")
