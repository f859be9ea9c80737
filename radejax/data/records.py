"""Records: one array per frame in `FOLDER/<key>.npy`, described by a manifest.

Projections of radar tensors (`preprocess`) and embeddings of front images
(`radejax embed`) are stored as records. A file is written under a temporary name and
renamed, so that the record of a frame is complete if its file exists. The manifest
(`core.manifest`) has the options and the state of the file that each record was made from.
Records contain no labels. For another label revision, only frames without a record are
preprocessed.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import itertools
import json
import logging
import math
import pathlib
import threading
import time
from collections.abc import Generator, Mapping, Sequence

import numpy as np
from jaxtyping import Real
from tqdm import tqdm

from radejax.core import files, manifest
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, UserError, require
from radejax.core.workers import default_workers, end_rerun, process_pool
from radejax.data.dataset import FrameSequence, LabeledFrame, LabeledFrames
from radejax.data.projection import ENCODINGS, decode, encode
from radejax.geometry.radar_grid import RadarGrid, is_uniform

_log = logging.getLogger(__name__)

_MAX_LISTED = 20
_SMALL_JOB_BINS = 3e9  # about 50 of K-Radar's tensors, a few seconds
# In CPython before 3.11.8, NumPy cannot parse the headers of files in several threads: this
# fails now and then with "AST constructor recursion depth mismatch" (its issue 106905).
_HEADER = threading.Lock()


@dataclasses.dataclass(frozen=True)
class Records:
    """The records of a folder, which can be shared by threads and pickled.

    Attributes:
        folder: Folder of the records.
        shape: Shape of every array.
        dtype: Type of every array: "float16", "float32" or "uint8".
        source: JSON values that describe how the records were created: the radar "grid"
            for projections, and the "release" if it is a reduced one; the configuration
            and weights of the backbone for embeddings.
    """

    folder: pathlib.Path
    shape: tuple[int, ...]
    dtype: str
    source: files.JsonObject

    @classmethod
    def open(cls, folder: files.PathLike) -> Records:
        """Opens existing records.

        Raises:
            FileNotFoundError: There is no such folder.
            DataError: The manifest is corrupted.
        """
        path = files.as_path(folder) / manifest.FILE
        if not path.is_file():
            raise FileNotFoundError(
                f"{folder}: no {manifest.FILE}; expected a folder that `radejax "
                "preprocess` or `radejax embed` wrote"
            )
        content = files.read_object(path, "options")["options"]
        what = "a description of records: delete the folder and write it again"
        with wrap_read_errors(path, what):
            dtype = content["dtype"]
            if dtype not in ENCODINGS:
                raise ValueError(f"dtype is {dtype!r:.80}")
            shape = tuple(map(int, content["shape"]))
            return cls(path.parent, shape, dtype, dict(content["source"]))

    @classmethod
    def create(
        cls,
        folder: files.PathLike,
        shape: Sequence[int],
        dtype: str | None,
        source: files.JsonObject,
        default_dtype: str = "float16",
    ) -> Records:
        """Creates records in a new folder, or opens existing ones of the same kind.

        A folder in which nothing was written yet becomes one of the wanted kind.

        Args:
            folder: Folder of the records.
            shape: Shape of every array.
            dtype: Type of every array; None for that of existing records.
            source: JSON values that describe how the records are created.
            default_dtype: Type of new records if `dtype` is None.

        Raises:
            UserError: The dtype is unknown, or the folder has records of another kind;
                the message lists the differences. Or it has arrays without a manifest.
        """
        path = files.as_path(folder) / manifest.FILE
        if dtype is None:
            dtype = cls.open(folder).dtype if path.is_file() else default_dtype
        require(dtype in ENCODINGS, "dtype", dtype, f"one of {', '.join(ENCODINGS)}")
        options = {"shape": list(shape), "dtype": dtype, "source": source}
        manifest.Manifest.claim(
            folder,
            "records",
            options,
            patterns=["*.npy"],
            option=" (--records, or --out)",
        )
        return cls.open(folder)

    @functools.cached_property
    def grid(self) -> RadarGrid:
        """The sensor axes of projections.

        Raises:
            DataError: The records are not projections, or the manifest is corrupted.
        """
        path = self.folder / manifest.FILE
        if "grid" not in self.source:
            raise DataError(f"{path}: not the records of a radar")
        with wrap_read_errors(path, "the records of a radar"):
            grid = RadarGrid.from_dict(self.source["grid"])
            if grid.projection_shape != self.shape:
                raise ValueError(f"arrays of shape {self.shape}")
            return grid

    def keys(self) -> set[str]:
        """Lists the folder and returns the keys of all frames that have a record."""
        return {
            path.relative_to(self.folder).as_posix().removesuffix(".npy")
            for path in files.find_files(self.folder, "*.npy")
            if not path.name.startswith(".")
        }

    def path(self, key: str) -> pathlib.Path:
        """Returns the file of the record of the frame `key`."""
        return self.folder / f"{key}.npy"

    def __getitem__(self, key: str) -> Real[np.ndarray, "..."]:
        """Reads the array of the frame `key`.

        Raises:
            FileNotFoundError: The frame has no record.
            DataError: The file is corrupted.
        """
        path = self.path(key)
        expected = f"a {self.dtype} array of shape {self.shape}"
        with (
            wrap_read_errors(path, f"{expected}; delete it and write it again"),
            open(path, "rb") as file,
        ):
            with _HEADER:
                np.lib.format.read_magic(file)
                shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
            if shape != self.shape or dtype.name != self.dtype:
                raise ValueError(f"{dtype} array of shape {shape}")
            array = np.fromfile(file, dtype, math.prod(shape))
            return array.reshape(shape, order="F" if is_fortran else "C")

    def write(
        self,
        key: str,
        array: Real[np.ndarray, "..."],
        sources: manifest.State | None = None,
    ) -> None:
        """Writes the record of a frame atomically.

        Args:
            key: Key of the frame.
            array: Content of the record.
            sources: State of the file that it was made from, when it was read.
        """
        if sources:
            manifest.add(self.folder, key, sources)
        with files.atomic_write(self.path(key)) as file:
            np.save(file, array, allow_pickle=False)

    def require(self, frames: FrameSequence) -> None:
        """Raises a `UserError` that names the first frame without a record, if any."""
        keys = self.keys()
        missing = [frame.key for frame in frames if frame.key not in keys]
        if missing:
            raise UserError(
                f"{self.folder}: {len(missing)} of {len(frames)} frames have no record, "
                f"the first is {missing[0]}: run `radejax preprocess` again"
            )


def open_projections(folder: files.PathLike, grid: RadarGrid | None = None) -> Records:
    """Opens the projections in a folder.

    Args:
        folder: Folder that `preprocess` wrote.
        grid: Required grid, or None for any grid.

    Raises:
        FileNotFoundError: There is no such folder.
        DataError: The manifest is corrupted or, if a grid is required, describes other
            records.
        UserError: The projections have another grid.
    """
    records = Records.open(folder)
    if grid is not None and grid != records.grid:
        raise UserError(
            f"{folder}: records of a grid of {describe_grid(records.grid)}, expected "
            f"{describe_grid(grid)}: choose another folder (--records), or delete that one"
        )
    return records


def open_embeddings(
    folder: files.PathLike, image_config: files.JsonObject | None = None
) -> Records:
    """Opens the front image features `[h, w, C]` in a folder.

    Args:
        folder: Folder that `radejax embed` wrote.
        image_config: `config.model.image` that the features must match, or None.

    Raises:
        FileNotFoundError: There is no such folder.
        DataError: The manifest is corrupted, or describes other records.
        UserError: Another backbone made the embeddings.
    """
    records = Records.open(folder)
    image = records.source.get("image")
    is_whole = "weights_sha256" in records.source and len(records.shape) == 3
    if not isinstance(image, dict) or not is_whole:
        raise DataError(f"{records.folder / manifest.FILE}: not embeddings of images")
    wanted = embedding_fields(image_config or image)
    if lines := files.differences(image, wanted, "config.model.image"):
        raise UserError(
            f"{folder}: embeddings of another backbone: {'; '.join(lines)}; embed the "
            "images again"
        )
    return records


def embedding_fields(image_config: files.JsonObject) -> files.JsonObject:
    """Returns the part of `config.model.image` that embeddings depend on, in JSON types."""
    irrelevant = ("freeze", "attention", "layer_scale")
    relevant = {k: v for k, v in image_config.items() if k not in irrelevant}
    plain: files.JsonObject = json.loads(json.dumps(relevant))
    return plain


def describe_grid(grid: RadarGrid) -> str:
    """Returns a short description of the size and extent of a grid."""
    axes = grid.doppler_mps, grid.range_m, grid.elevation_rad, grid.azimuth_rad
    sizes = " x ".join(str(axis.size) for axis in axes)
    is_even = is_uniform(grid.range_m) and is_uniform(grid.azimuth_rad)
    return (
        f"{sizes} bins (Doppler, range, elevation, azimuth) to {grid.range_m[-1]:.2f} m, "
        f"azimuth {np.rad2deg(grid.azimuth_rad[0]):.1f} to "
        f"{np.rad2deg(grid.azimuth_rad[-1]):.1f} deg{'' if is_even else ', not uniform'}"
    )


# Preprocessing -----------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class PreprocessReport:
    """Result of one call of `preprocess`.

    Attributes:
        num_frames: Number of frames in this shard.
        num_found: Number of these frames that already had a record.
        skipped: Reasons for skipping frames (their radar tensor is missing or
            corrupted), by key.
        seconds: Wall time.
    """

    num_frames: int
    num_found: int
    skipped: Mapping[str, str]
    seconds: float

    @property
    def num_written(self) -> int:
        """Number of records that were written."""
        return self.num_frames - self.num_found - len(self.skipped)

    def to_text(self) -> str:
        """Returns the report as text for a terminal."""
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
    frames: LabeledFrames[LabeledFrame],
    folder: files.PathLike,
    *,
    dtype: str | None = None,
    shard: tuple[int, int] = (0, 1),
    num_workers: int | None = None,
    progress: bool = True,
) -> PreprocessReport:
    """Writes the projection of every frame that has no record yet.

    Frames whose radar tensor is missing or corrupted are skipped and reported; the next
    call tries them again. Existing records whose radar file has changed since are counted
    in a warning. Several processes may work on different shards of a folder.

    Args:
        frames: Labeled frames, normally a `KRadar` without a split, as the records can
            be used for every split and label revision.
        folder: Folder of the records, which is created if needed.
        dtype: "float16", "uint8" or "float32". None uses the dtype of existing records,
            or "float16" without any.
        shard: `(i, n)` selects every n-th frame starting with frame i, counted from 0.
        num_workers: Number of worker processes; 0 works in the calling process. None
            starts as many as CPUs and memory allow, or none for small jobs that would
            end before the workers have started.
        progress: Whether to show a progress bar.

    Raises:
        UserError: There are no frames, the shard or the dtype is invalid, the folder has
            records of another kind, or a worker process was killed.
        DataError: The manifest is corrupted.
    """
    end_rerun()
    began = time.perf_counter()
    if not len(frames):
        raise UserError("no frames to preprocess")
    index, count = shard
    require(0 <= index < count, "shard", shard, "(i, n) with i from 0 to n - 1")
    grid = frames.grid
    source: files.JsonObject = {"grid": grid.to_dict()}
    if frames.reader_version is not None:
        name = f"{type(frames).__module__}:{type(frames).__qualname__}"
        source["reader"] = [name, frames.reader_version]
    if frames.release is not None:
        source["release"] = frames.release
    records = Records.create(folder, grid.projection_shape, dtype, source)
    keys = records.keys()
    mine = list(frames)[index::count]
    _check(records, [frame for frame in mine if frame.key in keys])
    missing = [frame for frame in mine if frame.key not in keys]
    if num_workers is None:
        is_small = len(missing) * math.prod(grid.shape_drea) < _SMALL_JOB_BINS
        num_workers = 0 if is_small else default_workers()
    with contextlib.closing(_write_all(records, missing, num_workers)) as results:
        is_hidden = not (progress and missing)
        bar = tqdm(results, "preprocess", len(missing), unit="frame", disable=is_hidden)
        skipped = dict(sorted((key, reason) for key, reason in bar if reason))
    num_found = len(mine) - len(missing)
    return PreprocessReport(len(mine), num_found, skipped, time.perf_counter() - began)


def _check(records: Records, frames: FrameSequence) -> None:
    """Logs how many records are used and how many of their radar files have changed.

    Raises:
        UserError: A reader that has versions computes another projection for a file that
            has not changed.
    """
    _log.info("%d records in %s are used", len(frames), records.folder)
    sources = {frame.key: frame.radar_path for frame in frames}
    changed = set(manifest.warn_of_changes(records.folder, sources))
    # Files may be missing, as records suffice for a training.
    same = (
        frame
        for frame in frames
        if frame.key not in changed and manifest.state_of([frame.radar_path])
    )
    for frame in itertools.islice(same, "reader" in records.source):
        now = encode(frame.read_projection(records.grid), records.dtype)
        if not np.allclose(decode(now), decode(records[frame.key]), atol=0.01):
            raise UserError(
                f"{records.folder}: the record of frame {frame.key} is not what the reader "
                "computes now: delete the folder to preprocess again"
            )


def _write_all(
    records: Records, frames: Sequence[LabeledFrame], num_workers: int
) -> Generator[tuple[str, str], None, None]:
    """Writes the records of frames.

    Yields:
        The key of every frame and the reason if it was skipped (otherwise ""), in the
        order of completion.
    """
    if not num_workers or not frames:
        yield from (_write(records, frame) for frame in frames)
        return
    num_workers = min(num_workers, len(frames))
    with process_pool(num_workers) as submit:
        work = [submit(_write, records, frame) for frame in frames]
        for future in concurrent.futures.as_completed(work):
            yield future.result()


def _write(records: Records, frame: LabeledFrame) -> tuple[str, str]:
    """Writes the record of one frame; returns its key and the reason if it was skipped."""
    state = manifest.state_of([frame.radar_path])
    try:
        projection = frame.read_checked(records.grid)
    except (DataError, OSError) as error:
        return frame.key, str(error)
    records.write(frame.key, encode(projection, records.dtype), state)
    return frame.key, ""
