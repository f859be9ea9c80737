"""Arrays of one shape in files of records: random access by index, checked on opening."""

from __future__ import annotations

import bisect
import collections
import itertools
import math
import os
import pathlib
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from radejax.core.errors import DataError
from radejax.core.files import read_json
from radejax.data.records.files import (
    MEND,
    READER_OPTIONS,
    RecordFile,
    sha256,
    unshuffled,
)

MANIFEST = "manifest.json"


def read_manifest_json(
    folder: pathlib.Path, kind: tuple[str, int], hint: Mapping[str, Any]
) -> dict[str, Any]:
    """What `manifest.json` of a folder says, of a format up to a version.

    Args:
        folder: Of records.
        kind: Format and version.
        hint: What it must hold beside these and its `files`, see `schema.check`.

    Raises:
        DataError: It is damaged or of another format or version.
    """
    path = folder / MANIFEST
    content = read_json(path, {"format": str, "version": int}, mend=MEND)
    found = content["format"], content["version"]
    if found[0] != kind[0] or not 1 <= found[1] <= kind[1]:
        raise DataError(
            f"{path}: {found[0][:80]} version {found[1]}, this radejax reads {kind[0]} "
            f"up to version {kind[1]}"
        )
    return read_json(path, {**hint, "files": list[RecordFile]}, mend=MEND)


class ArrayRecords(Sequence[Any]):
    """The arrays of a folder, one a frame; may be shared by threads and pickled.

    Args:
        folder: Where the files are.
        files: What its manifest says about them.
        shape: Of every array.
        dtype: Of every array.
        compressed: Their bytes are shuffled, see `files.shuffled`.
        verify: Compare the checksums of all files (reads them whole). Their sizes and
            record counts are always checked.

    Raises:
        DataError: A file is missing, damaged, or of another size.
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        files: Sequence[RecordFile],
        shape: tuple[int, ...],
        dtype: np.dtype,
        *,
        compressed: bool = False,
        verify: bool = False,
    ) -> None:
        self.folder, self._compressed = pathlib.Path(folder), compressed
        self.shape, self.dtype = tuple(shape), np.dtype(dtype)
        self.frames = list(itertools.chain.from_iterable(f.frames for f in files))
        if len(set(self.frames)) < len(self.frames):
            counts = collections.Counter(self.frames)
            raise DataError(
                f"{self.folder / MANIFEST}: frame {counts.most_common(1)[0][0][:80]} is "
                "there twice"
            )
        self._files = list(files)
        self._ends = list(itertools.accumulate(len(f.frames) for f in files))
        self._open()
        for number in range(len(self._files)):
            self._check_file(number, verify)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> Any:
        return self.read(int(index))

    def read(self, index: int) -> np.ndarray:
        """Array of a record, read-only.

        Raises:
            IndexError: There is no such record.
            DataError: It is damaged; names file and frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"record {index} of {len(self)}")
        number = bisect.bisect_right(self._ends, index)
        entry = self._files[number]
        position = index - (self._ends[number] - len(entry.frames))
        try:
            content = self._reader(number).read([position])[0]
        except Exception as error:  # the reader raises several types
            raise self._damaged(number, position, str(error)) from None
        if len(content) != self.dtype.itemsize * math.prod(self.shape):
            raise self._damaged(number, position, f"{len(content)} bytes")
        decode = unshuffled if self._compressed else np.frombuffer
        return decode(content, self.dtype).reshape(self.shape)

    def index_of(self) -> dict[str, int]:
        """Record index by frame key."""
        return {key: index for index, key in enumerate(self.frames)}

    # Readers are opened on first use and stay behind when the source is pickled.

    def __getstate__(self) -> dict[str, Any]:
        return {
            k: v for k, v in self.__dict__.items() if k not in ("_readers", "_lock")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._open()

    def __repr__(self) -> str:
        # grain names sources by it, also in checkpoints: no addresses, no paths.
        return f"{type(self).__name__}({len(self)} frames, {self.dtype})"

    def _open(self) -> None:
        self._readers: dict[int, Any] = {}
        self._lock = threading.Lock()

    def _reader(self, number: int) -> Any:
        """The reader of a file; readers may be shared by threads."""
        with self._lock:
            if number not in self._readers:
                from array_record.python.array_record_module import ArrayRecordReader

                path = str(self.folder / self._files[number].name)
                self._readers[number] = ArrayRecordReader(path, READER_OPTIONS)
            return self._readers[number]

    def _check_file(self, number: int, verify: bool) -> None:
        """`DataError` unless a file is there, whole, and (with `verify`) unchanged."""
        entry = self._files[number]
        path = self.folder / entry.name
        if not path.is_file():
            raise DataError(f"{path}: missing, but named in {MANIFEST}")
        if (size := path.stat().st_size) != entry.num_bytes:
            raise DataError(
                f"{path}: {size} bytes, {MANIFEST} says {entry.num_bytes}: damaged; "
                "delete it and write the records again"
            )
        if verify and sha256(path) != entry.sha256:
            raise DataError(
                f"{path}: checksum differs from {MANIFEST}: damaged; delete it and "
                "write the records again"
            )
        if not entry.frames:
            return
        try:
            count = self._reader(number).num_records()
        except Exception as error:
            raise DataError(f"{path}: damaged: {error}") from None
        if count != len(entry.frames):
            raise DataError(
                f"{path}: {count} records, {MANIFEST} says {len(entry.frames)}: damaged"
            )

    def _damaged(self, number: int, position: int, reason: str) -> DataError:
        entry = self._files[number]
        return DataError(
            f"{self.folder / entry.name}: record {position} (frame "
            f"{entry.frames[position]}) is damaged: {reason}"
        )
