"""Projections as records: random access by index, without labels.

A folder of records has a `manifest.json`: sensor grid, format version, encoding,
sources, and of every file its frames and checksum. Labels stay in their text files, so
that a label revision can be swapped without projecting again.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import pathlib
from typing import Any

import numpy as np

from radejax.core.errors import UserError
from radejax.core.files import write_text
from radejax.data.dataset import FrameSequence
from radejax.data.encoding import MAX_ERROR_DB, Encoding
from radejax.data.records.arrays import MANIFEST, ArrayRecords, read_manifest_json
from radejax.data.records.files import RecordFile
from radejax.geometry.radar_grid import RadarGrid

FORMAT = "radejax-projections"
FORMAT_VERSION = 2
"""The newest that is read. Records that are not compressed are version 1."""


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a folder of records holds.

    Attributes:
        grid: Sensor axes of the projections.
        encoding: "float16", "uint8" or "float32".
        sources: Where the projections come from.
        files: Files of records; record i of the folder is the i-th of their frames.
        compressed: Records are byte-shuffled and compressed, see `files.shuffled`.
    """

    grid: RadarGrid
    encoding: str
    sources: dict[str, Any]
    files: list[RecordFile]
    compressed: bool = False

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
            "version": 2 if self.compressed else 1,
            "grid": self.grid.to_dict(),
            "encoding": {
                "dtype": self.encoding,
                "compressed": self.compressed,
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
    text = json.dumps(manifest.to_dict(), indent=1)
    write_text(pathlib.Path(folder) / MANIFEST, text)


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
        advice = (
            f"; {started} files of records are finished: run the same projection again "
            "to finish the rest"
            if started
            else "; expected a folder that `radejax project` wrote"
        )
        raise FileNotFoundError(
            f"{folder}: no {MANIFEST}{advice if folder.is_dir() else ''}"
        )
    hint = {
        "grid": RadarGrid,
        "encoding": {"dtype": Encoding, "compressed?": bool},
        "sources": {
            "tesseracts?": int,
            "released_projections?": int,
            "folders?": list[str],
        },
    }
    fields = read_manifest_json(folder, (FORMAT, FORMAT_VERSION), hint)
    encoding = fields["encoding"]
    return Manifest(
        fields["grid"],
        encoding["dtype"],
        fields["sources"],
        fields["files"],
        encoding.get("compressed", False),
    )


def skipped_frames(folder: str | os.PathLike) -> dict[str, str]:
    """Frames that were left out of a folder: key to reason; none of an unfinished one."""
    if not (pathlib.Path(folder) / MANIFEST).is_file():
        return {}
    return read_manifest(folder).skipped


class RecordSource(ArrayRecords):
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
        self.manifest = read_manifest(folder)
        self.grid = self.manifest.grid
        if grid is not None and grid != self.grid:
            raise UserError(
                f"{folder}: records of a grid of {describe_grid(self.grid)}, expected "
                f"{describe_grid(grid)}"
            )
        super().__init__(
            folder,
            self.manifest.files,
            self.grid.projection_shape,
            np.dtype(self.manifest.encoding),
            compressed=self.manifest.compressed,
            verify=verify,
        )

    def __getitem__(self, index: Any) -> Any:
        return {"projection": self.read(int(index)), "frame": int(index)}


def record_positions(records: RecordSource, frames: FrameSequence) -> list[int]:
    """Index of the record of every frame.

    Raises:
        UserError: Frames have no record; says how many and names the first.
    """
    index_of = records.index_of()
    missing = [frame.key for frame in frames if frame.key not in index_of]
    if missing:
        skipped = records.manifest.skipped
        reason = f" ({skipped[missing[0]]})" if missing[0] in skipped else ""
        raise UserError(
            f"{records.folder}: {len(missing)} of {len(frames)} frames have no record, "
            f"the first is {missing[0]}{reason}: project the data set again"
        )
    return [index_of[frame.key] for frame in frames]


def describe_grid(grid: RadarGrid) -> str:
    """Sizes and extent of a grid, short."""
    sizes = " x ".join(map(str, grid.shape_drea))
    return (
        f"{sizes} bins (Doppler, range, elevation, azimuth) to {grid.range_m[-1]:.2f} m, "
        f"azimuth {np.rad2deg(grid.azimuth_rad[0]):.1f} to "
        f"{np.rad2deg(grid.azimuth_rad[-1]):.1f} deg"
    )
