"""Projecting a data set: parallel, sharded over machines, resumable after a kill.

The frames are cut into files of records. A file is one task: a worker projects its
frames, writes under a temporary name, renames, and writes the file's manifest. Running
the same command again does only the files that are not there. Whoever finishes the last
file writes the manifest of the folder.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import hashlib
import itertools
import math
import os
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

from radejax.core.errors import DataError, UserError
from radejax.core.workers import CONTEXT, process_pool
from radejax.data.dataset import FrameSequence, LabelledFrame
from radejax.data.encoding import check_encoding, encode, num_clipped
from radejax.data.records import files
from radejax.data.records.plan import claim_folder, encoding_there
from radejax.data.records.projections import (
    Manifest,
    write_manifest,
)
from radejax.geometry.radar_grid import RadarGrid

_MAX_LISTED = 10
_SMALL_JOB_CELLS = 3e9  # some 50 of K-Radar's tesseracts, a few seconds


@dataclasses.dataclass
class ProjectionReport:
    """What one run of `project_dataset` did.

    Attributes:
        num_frames: Frames of this shard of the job.
        num_found: Of these, finished by earlier runs.
        num_projected: Projected by this run.
        skipped: Frames left out, by this or earlier runs: key to reason.
        seconds: Wall time.
        reading_share: Part of the workers' time spent in reading files.
        is_complete: True when every file of every shard is there.
    """

    num_frames: int
    num_found: int = 0
    num_projected: int = 0
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)
    seconds: float = 0.0
    reading_share: float = 0.0
    is_complete: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return dataclasses.asdict(self)

    def to_text(self) -> str:
        """Lines for a terminal."""
        rate = self.num_projected / self.seconds if self.seconds else 0.0
        lines = [
            f"{self.num_frames:,} frames: {self.num_projected:,} projected, "
            f"{self.num_found:,} found finished, {len(self.skipped):,} left out",
            f"{self.seconds:.1f} s, {rate:.1f} frames/s, "
            f"{100 * self.reading_share:.0f} % of the workers' time in reading",
        ]
        lines += [
            f"left out: {key}: {why}"
            for key, why in itertools.islice(self.skipped.items(), _MAX_LISTED)
        ]
        if (more := len(self.skipped) - _MAX_LISTED) > 0:
            lines.append(f"... and {more:,} more left out: manifest.json has them all")
        if not self.is_complete:
            lines.append("other shards are not finished: no manifest.json yet")
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True)
class _Task:
    """One file of records, to be pickled; `kind` is the manifest as yet without files."""

    folder: pathlib.Path
    name: str
    frames: list[LabelledFrame]
    kind: Manifest
    skip_bad: bool


def project_dataset(
    frames: FrameSequence,
    out_dir: str | os.PathLike,
    *,
    grid: RadarGrid | None = None,
    dtype: str | None = None,
    compress: bool | None = None,
    shard: str | tuple[int, int] = (0, 1),
    num_workers: int | None = None,
    frames_per_file: int = 64,
    skip_bad: bool = False,
    retry_skipped: bool = True,
    progress: bool = True,
) -> ProjectionReport:
    """Projects the tesseracts of a data set into a folder of records.

    Args:
        frames: Frames to project, normally a `KRadar` without a split: records serve
            every split and label revision. The records are in their order.
        out_dir: Folder of the records; made if needed.
        grid: Sensor axes; None takes those of `frames`.
        dtype: Type of the records: "float16", "uint8" or "float32"; None: of those that
            are there, else "float16".
        compress: Byte-shuffled zstd: a third of the bytes, read in more time; None: as
            what is there, else not.
        shard: `(i, n)` or `"i/n"`, i from 0: this run does every n-th file.
        num_workers: Processes; 0: this one; None: one a core, or for a job that is done
            before they have started, this one.
        frames_per_file: Frames of one file of records (64 of K-Radar: 350 MB).
        skip_bad: Leave out frames whose tesseract is missing or damaged, and report
            them. Otherwise the first one raises.
        retry_skipped: Without `skip_bad`, frames that an earlier run left out are tried
            again, and raise if they are as they were. Otherwise they stay left out.
        progress: Show a progress bar with rate and time left.

    Returns:
        What was done.

    Raises:
        UserError: The folder holds another projection, a wrong shard, or a full disk.
        DataError: A tesseract is missing or damaged, and not `skip_bad`.
    """
    began = time.perf_counter()
    grid = grid or getattr(frames, "grid", None)
    if grid is None:
        raise UserError("a plain list of frames has no grid: give grid=")
    index, count = parse_shard(shard)
    out_dir = pathlib.Path(out_dir)
    kind = _empty_manifest(out_dir, grid, dtype, compress)
    sources = list(frames)
    if not sources:
        raise UserError("no frames to project")
    if frames_per_file < 1:
        raise UserError(f"frames_per_file must be at least 1, got {frames_per_file}")
    keys = "\n".join(frame.key for frame in sources)
    plan = {
        "dtype": kind.encoding,
        "compress": kind.compressed,
        "num_frames": len(sources),
        "frames_per_file": frames_per_file,
        "frames_sha256": hashlib.sha256(keys.encode()).hexdigest(),
        "grid": grid.to_dict(),
    }
    report = ProjectionReport(num_frames=0)
    earlier, what = claim_folder(out_dir, plan)
    if earlier is not None:
        sources = _count_earlier(sources, earlier, report)
    starts = range(0, len(sources), frames_per_file)
    names = [files.file_name(i, len(starts), what) for i in range(len(starts))]
    tasks = [
        _Task(out_dir, name, sources[i : i + frames_per_file], kind, skip_bad)
        for name, i in zip(names, starts, strict=True)
    ][index::count]
    report.num_frames += sum(len(task.frames) for task in tasks)
    keep = skip_bad or not retry_skipped
    todo = [task for task in tasks if not _count_finished(task, report, keep)]
    _run(todo, report, num_workers, progress)
    report.is_complete = not names or _finish(out_dir, names, kind, sources, earlier)
    report.seconds = time.perf_counter() - began
    return report


def _empty_manifest(
    folder: pathlib.Path, grid: RadarGrid, dtype: str | None, compress: bool | None
) -> Manifest:
    """Grid and encoding of what is written; None: as what is there."""
    there = encoding_there(folder)
    if compress is None:
        compress = there["compress"]
    return Manifest(grid, check_encoding(dtype or there["dtype"]), {}, [], compress)


def parse_shard(shard: str | tuple[int, int]) -> tuple[int, int]:
    """`(i, n)` of "i/n"; `UserError` unless 0 <= i < n."""
    try:
        index, count = shard.split("/") if isinstance(shard, str) else shard
        index, count = int(index), int(count)
    except (TypeError, ValueError):
        raise UserError(f"shard {shard!r}, expected i/n such as 0/8") from None
    if not 0 <= index < count:
        raise UserError(f"shard {index}/{count}: i must be from 0 to n - 1")
    return index, count


def _count_earlier(
    frames: list[LabelledFrame], earlier: Manifest, report: ProjectionReport
) -> list[LabelledFrame]:
    """The frames of which a finished job has nothing; the others are counted."""
    recorded, skipped = set(earlier.frames), earlier.skipped
    report.skipped = {f.key: skipped[f.key] for f in frames if f.key in skipped}
    report.num_found = sum(frame.key in recorded for frame in frames)
    report.num_frames = report.num_found + len(report.skipped)
    return [f for f in frames if f.key not in recorded and f.key not in skipped]


def _count_finished(task: _Task, report: ProjectionReport, keep_skipped: bool) -> bool:
    """True if an earlier run finished the file; its frames are then counted."""
    entry = files.read_manifest_of(task.folder, task.name)
    if entry is None or (entry.skipped and not keep_skipped):
        return False
    report.num_found += len(entry.frames)
    report.skipped.update(entry.skipped)
    return True


# Workers -----------------------------------------------------------------------------


def _run(
    tasks: list[_Task],
    report: ProjectionReport,
    num_workers: int | None,
    progress: bool,
) -> None:
    """Does the tasks and adds them up in the report."""
    total = sum(len(task.frames) for task in tasks)
    bar = tqdm(
        total=total, unit="frame", desc="project", disable=not (progress and total)
    )
    if num_workers is None:
        cells = sum(
            len(task.frames) * math.prod(task.kind.grid.shape_drea) for task in tasks
        )
        num_workers = (os.cpu_count() or 1) if cells > _SMALL_JOB_CELLS else 0
    reading = working = 0.0
    with bar:
        if num_workers == 0:
            results: Iterator = (_project_task(task, bar.update) for task in tasks)
        else:
            results = _run_in_processes(tasks, num_workers, bar)
        for entry, read_s, work_s in results:
            report.num_projected += len(entry.frames)
            report.skipped.update(entry.skipped)
            reading, working = reading + read_s, working + work_s
    report.reading_share = reading / working if working else 0.0


def _run_in_processes(tasks: list[_Task], num_workers: int, bar: tqdm) -> Iterator:
    """Results in the order in which they come; the bar moves with every frame."""
    # Without locks: a killed worker could hold one for ever. Each slot has one writer.
    done, stop = CONTEXT.RawArray("q", max(len(tasks), 1)), CONTEXT.RawValue("b", 0)
    num_workers = min(num_workers, max(len(tasks), 1))
    with process_pool(num_workers, _start_worker, done, stop) as submit:
        try:
            pending = {
                submit(_project_in_worker, task, slot)
                for slot, task in enumerate(tasks)
            }
            while pending:
                finished, pending = concurrent.futures.wait(
                    pending, 0.2, concurrent.futures.FIRST_COMPLETED
                )
                bar.update(sum(done) - bar.n)
                for future in finished:
                    yield future.result()
        except BaseException:
            stop.value = 1  # the others need not finish their files first
            raise


class _StoppedError(Exception):
    """Another worker failed: this one's file is given up."""


_done: Any = None
_stop: Any = None


def _start_worker(done: Any, stop: Any) -> None:
    """Shares the counters of frames."""
    global _done, _stop
    _done, _stop = done, stop


def _project_in_worker(task: _Task, slot: int) -> tuple:
    """`_project_task` that moves the parent's progress bar and can be stopped by it."""

    def count_frame(number: int) -> None:
        if _stop.value:
            raise _StoppedError
        _done[slot] += number

    return _project_task(task, count_frame)


def _project_task(
    task: _Task, count_frame: Callable[[int], Any]
) -> tuple[files.RecordFile, float, float]:
    """Projects one file of records; returns its manifest, reading and working time."""
    began = time.perf_counter()
    reading_s = 0.0
    grid, encoding, compress = task.kind.grid, task.kind.encoding, task.kind.compressed
    with files.RecordFileWriter(task.folder, task.name, compress=compress) as writer:
        for frame in task.frames:
            key = frame.key
            try:
                projection = frame.read_projection(grid)
            except (DataError, FileNotFoundError, OSError) as error:
                if not task.skip_bad:
                    raise DataError(
                        f"frame {key}: {error} (`radejax project --skip-bad` into "
                        f"{task.folder} leaves such frames out)"
                    ) from None
                writer.skipped[key] = str(error)
            else:
                writer.num_clipped += num_clipped(projection, encoding)
                writer.write(key, encode(projection, encoding))
            count_frame(1)
        entry = writer.commit()
    return entry, reading_s, time.perf_counter() - began


def _finish(
    out_dir: pathlib.Path,
    names: list[str],
    kind: Manifest,
    frames: list[LabelledFrame],
    earlier: Manifest | None,
) -> bool:
    """Writes the manifest of the folder, after an earlier one's, if every file is there."""
    found = (files.read_manifest_of(out_dir, name) for name in names)
    entries = [entry for entry in found if entry is not None]
    if len(entries) < len(names):
        return False
    paths = [frame.radar_path for frame in frames if frame.radar_path is not None]
    num_released = sum(path.suffix == ".npy" for path in paths)
    described: dict[str, Any] = {
        "tesseracts": len(paths) - num_released,
        "released_projections": num_released,
        "folders": sorted({str([path, *path.parents][:4][-1]) for path in paths}),
    }
    if earlier is not None:
        for name, value in described.items():
            described[name] = value + earlier.sources.get(name, type(value)())
        described["folders"] = sorted(set(described["folders"]))
        entries = [*earlier.files, *entries]
    write_manifest(out_dir, dataclasses.replace(kind, sources=described, files=entries))
    return True
