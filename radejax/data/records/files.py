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
import re
import socket
from collections.abc import Iterator
from typing import Any

import numpy as np

from radejax.core.errors import DataError
from radejax.core.files import atomic_write, is_no_space, no_space_error

# One record a group: random access then reads one frame, not its neighbours.
WRITER_OPTIONS = "group_size:1,uncompressed"
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

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> RecordFile:
        """Inverse of `dataclasses.asdict`; `KeyError` for a missing field."""
        return cls(**{f.name: fields[f.name] for f in dataclasses.fields(cls)})


def file_name(index: int, count: int, what: str = "projections") -> str:
    """Name of file `index` of `count`."""
    return f"{what}-{index:05d}-of-{count:05d}.arrayrecord"


def manifest_path(folder: pathlib.Path, name: str) -> pathlib.Path:
    """Where the manifest of a file of records is."""
    return folder / f"{name.removesuffix('.arrayrecord')}.json"


class RecordFileWriter:
    """Writes one file of records under a temporary name; `commit` makes it real."""

    def __init__(self, folder: pathlib.Path, name: str) -> None:
        from array_record.python.array_record_module import ArrayRecordWriter

        self._folder, self._name = folder, name
        self._temporary = folder / f".{name}.{socket.gethostname()}.{os.getpid()}.tmp"
        self._frames: list[str] = []
        self.skipped: dict[str, str] = {}
        self.num_clipped = 0
        remove_stale(folder, name)
        with self._no_space_named():
            self._writer = ArrayRecordWriter(str(self._temporary), WRITER_OPTIONS)

    def write(self, key: str, stored: np.ndarray) -> None:
        """Appends the projection of one frame."""
        with self._no_space_named():
            self._writer.write(np.ascontiguousarray(stored).tobytes())
        self._frames.append(key)

    def commit(self) -> RecordFile:
        """Closes, checks, renames, and writes the manifest of the file."""
        with self._no_space_named():
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
        with atomic_write(manifest_path(self._folder, self._name)) as file:
            file.write(json.dumps(dataclasses.asdict(entry), indent=1).encode())
        return entry

    def discard(self) -> None:
        """Removes what was written so far."""
        with contextlib.suppress(Exception):  # a full disk also fails to close
            self._writer.close()
        self._temporary.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _no_space_named(self) -> Iterator[None]:
        """Turns the writer's errors on a full disk into a `UserError`."""
        try:
            yield
        except Exception as error:
            if is_no_space(error):
                raise no_space_error(self._folder / self._name) from error
            raise


def read_manifest_of(folder: pathlib.Path, name: str) -> RecordFile | None:
    """Manifest of a file of records; None unless the file is there in its full size.

    Raises:
        DataError: The manifest is damaged.
    """
    path = manifest_path(folder, name)
    try:
        entry = RecordFile.from_dict(json.loads(path.read_bytes()))
        size = (folder / name).stat().st_size
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: damaged manifest ({error!r}); delete it") from None
    return entry if size == entry.num_bytes else None


def remove_stale(folder: pathlib.Path, name: str) -> None:
    """Removes what killed processes of this machine left of a file."""
    host = re.escape(socket.gethostname())
    pattern = re.compile(rf"\.{re.escape(name)}\.{host}\.(\d+)\.tmp")
    for path in folder.glob(f".{name}.*.tmp"):
        match = pattern.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            path.unlink(missing_ok=True)


def sha256(path: pathlib.Path) -> str:
    """Checksum of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_running(pid: int) -> bool:
    """True if a process of this machine could still be writing."""
    try:
        os.kill(pid, 0)
        stat = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except ProcessLookupError:
        return False
    except OSError:  # not ours, or no /proc here
        return True
    # In containers nobody may collect the dead: "pid (name) Z ..." is one of them.
    return stat.rpartition(")")[2].split()[0] != "Z"
