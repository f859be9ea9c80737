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

from radejax.core import files
from radejax.core.errors import DataError, UserError
from radejax.core.files import PathLike

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
"""Size limit of a label file; K-Radar's largest have 3 kB."""

_MAX_LINE = 1000  # characters; K-Radar's longest lines have 150
_MAX_NUMBER = 1e4  # metres or degrees

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SEPARATOR = r"\s*,\s*"
_FLAG, _ID, _CLASS = r"([A-Za-z]\w*)", r"(-?\d{1,9})", r"([A-Za-z][^,*]*?)"
_FIELDS = {
    "v1.0": (_ID + rf"(?:{_SEPARATOR}{_ID})?", _CLASS),  # with one or two ids
    "v1.1": (_FLAG, _ID, _ID, _CLASS),
    "v2.0": (_ID, _CLASS),
    "v2.1": (_FLAG, _ID, _CLASS),
}
_OBJECT = {
    version: re.compile(
        _SEPARATOR.join((r"\s*\*", *fields, *[f"({_NUMBER})"] * 7)) + r"\s*", re.ASCII
    )
    for version, fields in _FIELDS.items()
}
_HEADER = re.compile(
    r"\*\s*idx\([^)]*\)=(\d{1,9})_(\d{1,9})_(\d{1,9})_(\d{1,9})_(\d{1,9}),"
    r"\s*timestamp=(\d{1,12}(?:\.\d*)?)\s*",
    re.ASCII,
)
_TOOL_HEADER = re.compile(  # of the early annotation tool
    r"\*\s*radar idx: (\d{1,9}), lidar idx: (\d{1,9}), camera idx: (\d{1,9}), "
    r"time: (\d{1,12}(?:\.\d*)?)(?:,.*)?",
    re.DOTALL | re.ASCII,
)
_LINE_END = re.compile(r"\r\n|\n|\r")


@dataclasses.dataclass(frozen=True, slots=True)
class Label:
    """One labelled object.

    Attributes:
        cls: One of `LABEL_CLASSES`.
        box: x, y, z, l, w, h, yaw: center and full extents in metres in the LiDAR
            frame, heading in radians, not normalized.
        visibility: `R` is visible to the radar, `L` to the LiDAR only, `L1` not judged.
            Versions without the flag (v1.0, v2.0) read `R`: every object counts.
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
        radar: Frame number of the radar tensor.
        lidar: Frame number of the OS2-64 LiDAR.
        camera_front: Frame number of the front camera.
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
class LabelFile:
    """Content of one label file.

    Attributes:
        header: Its first line.
        labels: Its objects.
        num_unstarred: Lines of v1.x without a `*` that are not among the objects.
    """

    header: LabelHeader
    labels: list[Label]
    num_unstarred: int


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


def read_labels(path: PathLike, version: str = "v2.1") -> list[Label]:
    """Read the objects of one label file, in the order of its lines.

    Args:
        path: Label file, `<radar index>_<lidar index>.txt`.
        version: Label version of the file.

    Returns:
        Labels in the LiDAR frame, with full extents and radians.

    Raises:
        DataError: The file is malformed; the message names file and line.
        FileNotFoundError: There is no such file.
        UserError: There is no such version.
    """
    version, path = normalize_version(version), pathlib.Path(path)
    return parse_label_file(read_label_bytes(path), version, where=str(path)).labels


def read_label_bytes(path: pathlib.Path) -> bytes:
    """Read the content of a label file; errors as `read_labels`."""
    try:
        with open(path, "rb") as file:
            content = file.read(MAX_LABEL_BYTES + 1)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such label file") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder, expected a label file") from None
    if len(content) > MAX_LABEL_BYTES:
        raise DataError(f"{path}: more than {MAX_LABEL_BYTES} bytes, not a label file")
    return content


def parse_label_file(
    content: bytes,
    version: str = "v2.1",
    *,
    where: str = "<labels>",
    problems: list[str] | None = None,
    include_unstarred: bool = False,
) -> LabelFile:
    """Parse the content of a label file.

    Args:
        content: Bytes of the file.
        version: Label version, such as "v2.1".
        where: Name of the file in messages.
        problems: Without it the first malformed line raises. With it malformed lines
            are skipped and described in this list.
        include_unstarred: Lines of v1.x without a `*` are objects too where they have
            the fields of one, as the reference implementation reads them.

    Raises:
        DataError: The header is malformed or the file is not text, also with
            `problems`; or a line is malformed, without.
    """
    if not content.strip():
        raise DataError(f"{where}:1: the file is empty, expected a header line")
    first, *lines = _LINE_END.split(files.decoded(content, where))
    # Some files of v2.0 have their first object on the line of the header.
    second = first.find("*", first.find("*") + 1)
    header = _parse_header(first if second < 0 else first[:second], f"{where}:1")
    numbered = [(1, first[second:])] if second >= 0 else []
    labels: list[Label] = []
    num_unstarred = 0
    for number, line in [*numbered, *enumerate(lines, start=2)]:
        if not line or line.isspace():
            continue
        if version.startswith("v1") and not line.lstrip().startswith("*"):
            line = "*," + line.partition(",")[2]
            if not (include_unstarred and _OBJECT[version].fullmatch(line)):
                num_unstarred += 1
                continue
        try:
            labels.append(_parse_object(line, version, f"{where}:{number}"))
        except DataError as error:
            if problems is None:
                raise
            problems.append(str(error))
    return LabelFile(header, labels, num_unstarred)


def _parse_header(line: str, where: str) -> LabelHeader:
    """Parse both forms of headers."""
    if match := _HEADER.fullmatch(line):
        radar, lidar, camera, long_lidar, cameras = map(int, match.groups()[:5])
        return LabelHeader(radar, lidar, camera, long_lidar, cameras, float(match[6]))
    if match := _TOOL_HEADER.fullmatch(line):
        radar, lidar, camera = map(int, match.groups()[:3])
        return LabelHeader(radar, lidar, camera, None, None, float(match[4]))
    raise DataError(
        f"{where}: {_short(line)} is not a header, expected "
        "'* idx(...)=00033_00001_00002_00001_00004, timestamp=...'"
    )


def _parse_object(line: str, version: str, where: str) -> Label:
    """Parse one object line."""
    if len(line) > _MAX_LINE:
        raise DataError(f"{where}: {len(line)} characters, not an object line")
    match = _OBJECT[version].fullmatch(line)
    if match is None:
        others = [name for name in VERSIONS if _OBJECT[name].fullmatch(line)]
        if others:
            raise DataError(
                f"{where}: {_short(line)} has the layout of {others[0]} labels, not of "
                f"{version}"
            )
        num_fields = line.count(",") + 1
        raise DataError(
            f"{where}: {num_fields} fields in {_short(line)}, which is not an object "
            f"line of {version} labels"
        )
    *leading, cls = match.groups()[:-7]
    numbers = x, y, z, yaw_deg, *half_extents = list(map(float, match.groups()[-7:]))
    if cls not in LABEL_CLASSES:
        expected = ", ".join(LABEL_CLASSES)
        raise DataError(
            f"{where}: class {cls!r} is unknown, expected one of {expected}"
        )
    if min(half_extents) <= 0 or max(map(abs, numbers)) > _MAX_NUMBER:
        raise DataError(
            f"{where}: box {numbers}, expected x, y, z, yaw in degrees and positive half "
            f"extents, all up to {_MAX_NUMBER:g}"
        )
    length, width, height = (2.0 * half for half in half_extents)
    visibility = leading.pop(0) if version in ("v1.1", "v2.1") else "R"
    has_previous = version.startswith("v1") and leading[1] is not None
    return Label(
        cls,
        (x, y, z, length, width, height, math.radians(yaw_deg)),
        visibility,
        int(leading[0]),
        int(leading[1]) if has_previous else None,
    )


def _short(text: str) -> str:
    """A quotation that fits in a message."""
    return repr(text if len(text) <= 80 else text[:77] + "...")
