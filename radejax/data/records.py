"""Projections as records: random access by index, without labels.

A folder of records has a `manifest.json`: sensor grid, format version, encoding,
sources, and of every file its frames and checksum. Labels stay in their text files, so
that a label revision can be swapped without projecting again.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import json
import os
import pathlib
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from radejax.data.encoding import MAX_ERROR_DB, check_encoding
from radejax.data.record_files import READER_OPTIONS, RecordFile, sha256
from radejax.errors import DataError, UserError
from radejax.files import atomic_write
from radejax.geometry.radar_grid import RadarGrid

FORMAT = "radejax-projections"
FORMAT_VERSION = 1
MANIFEST = "manifest.json"


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a folder of records holds.

    Attributes:
        grid: Sensor axes of the projections.
        encoding: "float16", "uint8" or "float32".
        sources: Where the projections come from.
        files: Files of records; record i of the folder is the i-th of their frames.
    """

    grid: RadarGrid
    encoding: str
    sources: dict[str, Any]
    files: list[RecordFile]

    @property
    def frames(self) -> list[str]:
        """Key of every record, such as `"1/00033_00001"`."""
        return list(itertools.chain.from_iterable(f.frames for f in self.files))

    @property
    def skipped(self) -> dict[str, str]:
        """Frames that were left out on request: key to reason."""
        return {key: why for f in self.files for key, why in f.skipped.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "grid": self.grid.to_dict(),
            "encoding": {
                "dtype": self.encoding,
                "max_error_db": MAX_ERROR_DB[self.encoding],
                "num_clipped": sum(f.num_clipped for f in self.files),
            },
            "sources": self.sources,
            "num_frames": sum(len(f.frames) for f in self.files),
            "num_skipped": len(self.skipped),
            "files": [dataclasses.asdict(f) for f in self.files],
        }


def write_manifest(folder: str | os.PathLike, manifest: Manifest) -> None:
    """Writes `manifest.json`."""
    with atomic_write(pathlib.Path(folder) / MANIFEST) as file:
        file.write(json.dumps(manifest.to_dict(), indent=1).encode("ascii"))


def read_manifest(folder: str | os.PathLike) -> Manifest:
    """Reads `manifest.json`.

    Raises:
        FileNotFoundError: There is no such folder, or no manifest in it.
        DataError: The manifest is damaged or of another version.
    """
    folder = pathlib.Path(folder)
    path = folder / MANIFEST
    if not path.is_file():
        started = len(list(folder.glob("projections-*.json")))
        hint = (
            f"; {started} files of records are finished: run the same projection again "
            "to finish the rest"
            if started
            else "; expected a folder that `radejax project` wrote"
        )
        raise FileNotFoundError(
            f"{folder}: no {MANIFEST}{hint if folder.is_dir() else ''}"
        )
    try:
        fields = json.loads(path.read_bytes())
        if fields["format"] != FORMAT:
            raise DataError(f"{path}: format {fields['format']!r}, expected {FORMAT!r}")
        if fields["version"] != FORMAT_VERSION:
            raise DataError(
                f"{path}: version {fields['version']} of the record format, this radejax "
                f"reads version {FORMAT_VERSION}"
            )
        return Manifest(
            RadarGrid.from_dict(fields["grid"]),
            check_encoding(fields["encoding"]["dtype"]),
            fields["sources"],
            [RecordFile.from_dict(entry) for entry in fields["files"]],
        )
    except DataError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: damaged manifest ({error!r})") from None


class RecordSource(Sequence[dict[str, Any]]):
    """Random access to the projections of a folder; a source for grain.

    Element i is `{"projection": [R, A, D+E] array, "frame": i}`: the array in the type
    of the records, read-only; `frames[i]` is its key.

    Args:
        folder: What `radejax project` wrote.
        grid: Grid that the records must have; None takes any.
        verify: Compare the checksums of all files (reads them whole). Their sizes and
            record counts are always checked.

    Raises:
        FileNotFoundError: There is no such folder, or it is not finished.
        DataError: A file is missing, damaged, or of another version or size.
        UserError: The records are of another grid.
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        *,
        grid: RadarGrid | None = None,
        verify: bool = False,
    ) -> None:
        self.folder = pathlib.Path(folder)
        self.manifest = read_manifest(self.folder)
        self.grid = self.manifest.grid
        if grid is not None and grid != self.grid:
            raise UserError(
                f"{self.folder}: records of a grid of {_describe(self.grid)}, expected "
                f"{_describe(grid)}"
            )
        self.frames = self.manifest.frames
        self.dtype = np.dtype(self.manifest.encoding)
        self._ends = list(
            itertools.accumulate(len(f.frames) for f in self.manifest.files)
        )
        self._open()
        for index in range(len(self.manifest.files)):
            self._check_file(index, verify)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> dict[str, Any]:
        index = int(index)
        if not 0 <= index < len(self):
            raise IndexError(f"record {index} of {len(self)}")
        number = bisect.bisect_right(self._ends, index)
        entry = self.manifest.files[number]
        position = index - (self._ends[number] - len(entry.frames))
        shape = self.grid.projection_shape
        try:
            content = self._reader(number).read([position])[0]
        except Exception as error:  # the reader raises several types
            raise self._damaged(number, position, str(error)) from None
        if len(content) != self.dtype.itemsize * int(np.prod(shape)):
            raise self._damaged(number, position, f"{len(content)} bytes")
        projection = np.frombuffer(content, self.dtype).reshape(shape)
        return {"projection": projection, "frame": index}

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
        return f"RecordSource({len(self)} frames, {self.dtype})"

    def _open(self) -> None:
        self._readers: dict[int, Any] = {}
        self._lock = threading.Lock()

    def _reader(self, number: int) -> Any:
        """The reader of a file; readers may be shared by threads."""
        with self._lock:
            if number not in self._readers:
                from array_record.python.array_record_module import ArrayRecordReader

                path = str(self.folder / self.manifest.files[number].name)
                self._readers[number] = ArrayRecordReader(path, READER_OPTIONS)
            return self._readers[number]

    def _check_file(self, number: int, verify: bool) -> None:
        """`DataError` unless a file is there, whole, and (with `verify`) unchanged."""
        entry = self.manifest.files[number]
        path = self.folder / entry.name
        if not path.is_file():
            raise DataError(f"{path}: missing, but named in {MANIFEST}")
        if (size := path.stat().st_size) != entry.num_bytes:
            raise DataError(
                f"{path}: {size} bytes, {MANIFEST} says {entry.num_bytes}: damaged; "
                "delete it and run the projection again"
            )
        if verify and sha256(path) != entry.sha256:
            raise DataError(
                f"{path}: checksum differs from {MANIFEST}: damaged; delete it and run "
                "the projection again"
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
        entry = self.manifest.files[number]
        return DataError(
            f"{self.folder / entry.name}: record {position} (frame "
            f"{entry.frames[position]}) is damaged: {reason}"
        )


def _describe(grid: RadarGrid) -> str:
    """Sizes and extent of a grid, short."""
    sizes = " x ".join(map(str, grid.shape_drea))
    return (
        f"{sizes} bins (Doppler, range, elevation, azimuth) to {grid.range_m[-1]:.2f} m, "
        f"azimuth {np.rad2deg(grid.azimuth_rad[0]):.1f} to "
        f"{np.rad2deg(grid.azimuth_rad[-1]):.1f} deg"
    )
