"""Files of records: written whole or not at all, described by a manifest each.

`projections-00003-of-00270.arrayrecord` holds one record a frame, the bytes of its
projection; `projections-00003-of-00270.json` beside it says which frames, with size
and SHA-256. The second is written after the first: where it is, the first is whole.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import pathlib

import numpy as np

from radejax.core import files as core_files

MEND = "delete it, and write the records again"
"""What to do with a damaged manifest."""

# One record a group: random access then reads one frame, not its neighbours.
WRITER_OPTIONS = {False: "group_size:1,uncompressed", True: "group_size:1,zstd:1"}
"""By whether records are compressed; higher levels save 2 % and write 5 times slower."""

READER_OPTIONS = "readahead_buffer_size:0,max_parallelism:0"


@dataclasses.dataclass(frozen=True)
class RecordFile:
    """What the manifest says about one file of records.

    Attributes:
        name: File name.
        frames: Keys of the frames, in the order of the records.
        skipped: Frames that were left out: key to reason.
        num_bytes: Size of the file.
        sha256: Checksum of the file, hexadecimal.
        num_clipped: Values that the encoding clipped.
    """

    name: str
    frames: list[str]
    skipped: dict[str, str]
    num_bytes: int
    sha256: str
    num_clipped: int

    def __post_init__(self) -> None:
        is_plain = pathlib.PurePath(self.name).name == self.name
        if not is_plain or "\0" in self.name or len(self.name) > 100:
            raise ValueError(f"{self.name[:80]!r} is no name of a file")


def file_name(index: int, count: int, what: str = "projections") -> str:
    """Name of file `index` of `count`."""
    return f"{what}-{index:05d}-of-{count:05d}.arrayrecord"


def manifest_path(folder: pathlib.Path, name: str) -> pathlib.Path:
    """Where the manifest of a file of records is."""
    return folder / f"{name.removesuffix('.arrayrecord')}.json"


class RecordFileWriter:
    """Writes one file of records under a temporary name; `commit` makes it real.

    A `with` block that ends in an error leaves nothing behind.

    Args:
        folder: Where it goes.
        name: Of the file.
        compress: Shuffle the bytes of records and compress them.
    """

    def __init__(
        self, folder: pathlib.Path, name: str, *, compress: bool = False
    ) -> None:
        from array_record.python.array_record_module import ArrayRecordWriter

        self._folder, self._name, self._compress = folder, name, compress
        self._temporary = core_files.temporary_path(folder / name)
        self._frames: list[str] = []
        self.skipped: dict[str, str] = {}
        self.num_clipped = 0
        core_files.remove_stale(folder, name)
        with core_files.disk_full(folder / name):
            self._writer = ArrayRecordWriter(
                str(self._temporary), WRITER_OPTIONS[compress]
            )

    def write(self, key: str, stored: np.ndarray) -> None:
        """Appends the projection of one frame."""
        stored = np.ascontiguousarray(stored)
        with core_files.disk_full(self._folder / self._name):
            self._writer.write(shuffled(stored) if self._compress else stored.tobytes())
        self._frames.append(key)

    def commit(self) -> RecordFile:
        """Closes, checks, renames, and writes the manifest of the file."""
        with core_files.disk_full(self._folder / self._name):
            self._writer.close()
            with open(self._temporary, "rb+") as file:
                os.fsync(file.fileno())
            entry = RecordFile(
                self._name,
                self._frames,
                self.skipped,
                self._temporary.stat().st_size,
                sha256(self._temporary),
                self.num_clipped,
            )
            os.replace(self._temporary, self._folder / self._name)
        path = manifest_path(self._folder, self._name)
        core_files.write_text(path, json.dumps(dataclasses.asdict(entry), indent=1))
        return entry

    def __enter__(self) -> RecordFileWriter:
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        if kind is not None:
            self.discard()

    def discard(self) -> None:
        """Removes what was written so far."""
        with contextlib.suppress(Exception):  # a full disk also fails to close
            self._writer.close()
        self._temporary.unlink(missing_ok=True)


def shuffled(stored: np.ndarray) -> bytes:
    """First bytes of all numbers, then second bytes, ...: like beside like compresses.

    Signs and exponents of neighbours are much the same, last digits are noise.
    """
    return stored.reshape(-1, 1).view(np.uint8).T.tobytes()


def unshuffled(content: bytes, dtype: np.dtype) -> np.ndarray:
    """Inverse of `shuffled`: the numbers in a row, read-only where nothing is moved."""
    planes = np.frombuffer(content, np.uint8).reshape(dtype.itemsize, -1)
    if dtype.itemsize == 1:
        return planes[0].view(dtype)
    wide = np.dtype(f"<u{dtype.itemsize}")
    numbers = planes[-1].astype(wide)
    for plane in planes[-2::-1]:
        numbers <<= 8
        numbers |= plane
    return numbers.view(dtype)


def read_manifest_of(folder: pathlib.Path, name: str) -> RecordFile | None:
    """Manifest of a file of records; None unless the file is there in its full size.

    Raises:
        DataError: The manifest is damaged.
    """
    path = manifest_path(folder, name)
    try:
        entry: RecordFile = core_files.read_json(path, RecordFile, mend=MEND)
        size = (folder / name).stat().st_size
    except FileNotFoundError:
        return None
    return entry if size == entry.num_bytes else None


def sha256(path: pathlib.Path) -> str:
    """Checksum of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
