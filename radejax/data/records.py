"""Records: one array per frame, `FOLDER/<key>.npy`; `records.json` describes them.

Projections of radar tensors (`preprocess`) and embeddings of front images
(`radejax embed`) are kept in this way. A file is written under a temporary name and
renamed: where it exists, its frame is done. Records have no labels, so another label
revision only preprocesses the frames that are missing.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import json
import math
import os
import pathlib
import time
from collections.abc import Generator, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Real
from tqdm import tqdm

from radejax.core import files
from radejax.core.errors import DataError, UserError, one_line, require
from radejax.core.workers import process_pool
from radejax.data.dataset import FrameSequence, LabelledFrame, LabelledFrames
from radejax.data.projection import ENCODINGS, encode
from radejax.geometry.radar_grid import RadarGrid

_DESCRIPTION = "records.json"
_MAX_LISTED = 20
_SMALL_JOB_BINS = 3e9  # about 50 of K-Radar's tensors, a few seconds


@dataclasses.dataclass(frozen=True)
class Records:
    """The records of a folder; may be shared by threads and pickled.

    Attributes:
        folder: Where they are.
        shape: Shape of every array.
        dtype: Type of every array: "float16", "float32" or "uint8".
        source: What they were made with, as JSON has it: the radar's "grid" of
            projections, configuration and weights of embeddings.
    """

    folder: pathlib.Path
    shape: tuple[int, ...]
    dtype: str
    source: Mapping[str, Any]

    @classmethod
    def open(cls, folder: files.PathLike) -> Records:
        """Records that exist.

        Raises:
            FileNotFoundError: There is no such folder.
            DataError: `records.json` is corrupted.
        """
        path = pathlib.Path(folder) / _DESCRIPTION
        if not path.is_file():
            raise FileNotFoundError(
                f"{folder}: no {_DESCRIPTION}; expected a folder that `radejax "
                "preprocess` or `radejax embed` wrote"
            )
        content = files.read_json(path)
        try:
            shape, dtype = tuple(map(int, content["shape"])), content["dtype"]
            if dtype not in ENCODINGS:
                raise ValueError(f"dtype is {dtype!r:.80}")
            return cls(path.parent, shape, dtype, dict(content["source"]))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(
                f"{path}: corrupted ({error!r:.200}); delete the folder and write it again"
            ) from None

    @classmethod
    def create(
        cls,
        folder: files.PathLike,
        shape: Sequence[int],
        dtype: str,
        source: Mapping[str, Any],
    ) -> Records:
        """Records of a new folder, or of one that has the same kind of records.

        Raises:
            UserError: The folder has other records; names what differs.
        """
        require(dtype in ENCODINGS, "dtype", dtype, f"one of {', '.join(ENCODINGS)}")
        wanted = {"shape": list(shape), "dtype": dtype, "source": source}
        files.claim(pathlib.Path(folder) / _DESCRIPTION, wanted, "other records")
        return cls.open(folder)

    @functools.cached_property
    def grid(self) -> RadarGrid:
        """Sensor axes of projections.

        Raises:
            DataError: The records are not projections, or `records.json` is corrupted.
        """
        try:
            grid = RadarGrid.from_dict(self.source["grid"])
            if grid.projection_shape != self.shape:
                raise ValueError(f"arrays of shape {self.shape}")
            return grid
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise DataError(
                f"{self.folder / _DESCRIPTION}: not the records of a radar ({error!r:.200})"
            ) from None

    def keys(self) -> set[str]:
        """Keys of the frames that have a record now; reads the folder."""
        return {
            path.relative_to(self.folder).as_posix().removesuffix(".npy")
            for path in self.folder.rglob("*.npy")
            if not path.name.startswith(".")
        }

    def path(self, key: str) -> pathlib.Path:
        """File of the record of the frame `key`."""
        return self.folder / f"{key}.npy"

    def __getitem__(self, key: str) -> Real[np.ndarray, "..."]:
        """Array of the frame `key`.

        Raises:
            FileNotFoundError: The frame has no record.
            DataError: The file is corrupted.
        """
        path = self.path(key)
        try:
            with open(path, "rb") as file:
                array = np.lib.format.read_array(file, allow_pickle=False)
            if array.shape != self.shape or array.dtype.name != self.dtype:
                raise ValueError(f"{array.dtype} array of shape {array.shape}")
            return array
        except FileNotFoundError:
            raise
        except Exception as error:  # NumPy raises nearly anything
            raise DataError(
                f"{path}: corrupted record ({one_line(error)}), expected a {self.dtype} "
                f"array of shape {self.shape}; delete the file and write it again"
            ) from None

    def write(self, key: str, array: Real[np.ndarray, "..."]) -> None:
        """Writes the record of a frame: whole or not at all."""
        with files.atomic_write(self.path(key)) as file:
            np.save(file, array, allow_pickle=False)

    def require(self, frames: FrameSequence) -> None:
        """`UserError` unless every frame has a record; names the first without one."""
        keys = self.keys()
        missing = [frame.key for frame in frames if frame.key not in keys]
        if missing:
            raise UserError(
                f"{self.folder}: {len(missing)} of {len(frames)} frames have no record, "
                f"the first is {missing[0]}: run `radejax preprocess` again"
            )


def open_projections(folder: files.PathLike, grid: RadarGrid | None = None) -> Records:
    """Projections of a folder.

    Args:
        folder: What `preprocess` wrote.
        grid: Grid that they must have; None takes any.

    Raises:
        FileNotFoundError: There is no such folder.
        DataError: `records.json` is corrupted.
        UserError: The projections have another grid.
    """
    records = Records.open(folder)
    if grid is not None and grid != records.grid:
        raise UserError(
            f"{folder}: records of a grid of {describe_grid(records.grid)}, expected "
            f"{describe_grid(grid)}"
        )
    return records


def open_embeddings(
    folder: files.PathLike, image_config: Mapping[str, Any] | None = None
) -> Records:
    """Features `[h, w, C]` of the front images of a folder.

    Args:
        folder: What `radejax embed` wrote.
        image_config: `config.model.image` that they must fit, or None.

    Raises:
        FileNotFoundError: There is no such folder.
        DataError: `records.json` is corrupted, or describes other records.
        UserError: Another backbone made the embeddings.
    """
    records = Records.open(folder)
    image: Any = records.source.get("image")
    is_complete = isinstance(image, dict) and "weights_sha256" in records.source
    if not is_complete or len(records.shape) != 3:
        raise DataError(f"{records.folder / _DESCRIPTION}: not embeddings of images")
    wanted = embedding_fields(image_config or image)
    if lines := files.differences(image, wanted, "config.model.image"):
        raise UserError(
            f"{folder}: embeddings of another backbone: {'; '.join(lines)}; embed the "
            "images again"
        )
    return records


def embedding_fields(image_config: Mapping[str, Any]) -> dict[str, Any]:
    """The part of `config.model.image` that embeddings depend on, as JSON has it."""
    irrelevant = ("freeze", "attention", "layer_scale")
    plain = {k: v for k, v in dict(image_config).items() if k not in irrelevant}
    return json.loads(json.dumps(plain))


def describe_grid(grid: RadarGrid) -> str:
    """Sizes and extent of a grid in a few words."""
    sizes = " x ".join(map(str, grid.shape_drea))
    return (
        f"{sizes} bins (Doppler, range, elevation, azimuth) to {grid.range_m[-1]:.2f} m, "
        f"azimuth {np.rad2deg(grid.azimuth_rad[0]):.1f} to "
        f"{np.rad2deg(grid.azimuth_rad[-1]):.1f} deg"
    )


# Preprocessing -----------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class PreprocessReport:
    """What one call of `preprocess` did.

    Attributes:
        num_frames: Frames of this shard.
        num_found: Of these, done earlier.
        skipped: Frames whose radar tensor is missing or corrupted: key to reason.
        seconds: Wall time.
    """

    num_frames: int
    num_found: int
    skipped: Mapping[str, str]
    seconds: float

    @property
    def num_written(self) -> int:
        """Records that were written."""
        return self.num_frames - self.num_found - len(self.skipped)

    def to_text(self) -> str:
        """Lines for a terminal."""
        rate = self.num_written / self.seconds if self.seconds else 0.0
        lines = [
            f"{self.num_frames:,} frames: {self.num_found:,} were done, "
            f"{self.num_written:,} preprocessed, {len(self.skipped):,} skipped; "
            f"{self.seconds:.1f} s, {rate:.1f} frames/s"
        ]
        listed = itertools.islice(self.skipped.items(), _MAX_LISTED)
        lines += [f"skipped {key}: {reason}" for key, reason in listed]
        if (more := len(self.skipped) - _MAX_LISTED) > 0:
            lines.append(f"... and {more:,} more skipped")
        return "\n".join(lines)


def preprocess(
    frames: LabelledFrames,
    folder: files.PathLike,
    *,
    dtype: str | None = None,
    shard: tuple[int, int] = (0, 1),
    num_workers: int | None = None,
    progress: bool = True,
) -> PreprocessReport:
    """Writes the projection of every frame that has no record yet.

    Frames whose radar tensor is missing or corrupted are skipped and reported; the next
    call tries them again. Several processes may work on different shards of a folder.

    Args:
        frames: Normally a `KRadar` without a split: records serve every split and label
            revision.
        folder: Folder of the records; made if needed.
        dtype: "float16", "uint8" or "float32"; None takes that of the records that
            exist, else "float16".
        shard: `(i, n)` takes every n-th frame from the i-th on, i from 0.
        num_workers: Processes; 0 works in this one. None takes one per core, or this
            process where the work is done before others have started.
        progress: Show a progress bar.

    Raises:
        UserError: The folder has other records, a wrong shard, no frames, or a worker
            process was killed.
    """
    began, folder = time.perf_counter(), pathlib.Path(folder)
    if not len(frames):
        raise UserError("no frames to preprocess")
    index, count = shard
    require(0 <= index < count, "shard", shard, "(i, n) with i from 0 to n - 1")
    if dtype is None:
        exists = (folder / _DESCRIPTION).is_file()
        dtype = Records.open(folder).dtype if exists else "float16"
    grid = frames.grid
    source = {"grid": grid.to_dict()}
    records = Records.create(folder, grid.projection_shape, dtype, source)
    keys, mine = records.keys(), list(frames)[index::count]
    missing = [frame for frame in mine if frame.key not in keys]
    if num_workers is None:
        is_small = len(missing) * math.prod(grid.shape_drea) < _SMALL_JOB_BINS
        num_workers = 0 if is_small else os.cpu_count() or 1
    with contextlib.closing(_write_all(records, missing, num_workers)) as results:
        bar = tqdm(
            results,
            "preprocess",
            len(missing),
            unit="frame",
            disable=not (progress and missing),
        )
        skipped = dict(sorted((key, reason) for key, reason in bar if reason))
    num_found = len(mine) - len(missing)
    return PreprocessReport(len(mine), num_found, skipped, time.perf_counter() - began)


def _write_all(
    records: Records, frames: Sequence[LabelledFrame], num_workers: int
) -> Generator[tuple[str, str], None, None]:
    """Key of every frame, and why it was skipped, in the order in which they end."""
    if not num_workers or not frames:
        yield from (_write(records, frame) for frame in frames)
        return
    num_workers = min(num_workers, len(frames))
    with process_pool(num_workers) as submit:
        work = [submit(_write, records, frame) for frame in frames]
        for future in concurrent.futures.as_completed(work):
            yield future.result()


def _write(records: Records, frame: LabelledFrame) -> tuple[str, str]:
    """Writes the record of one frame; returns its key and why it was skipped, or ""."""
    try:
        projection = frame.read_projection(records.grid)
    except (DataError, OSError) as error:
        return frame.key, str(error)
    records.write(frame.key, encode(projection, records.dtype))
    return frame.key, ""
