"""Frames per second from records to host batches, and memory over many frames.

    python benchmarks/pipeline.py [--frames 128] [--batch_size 8] [--folder DIR]
    python benchmarks/pipeline.py --memory_frames 10000

Full-size frames (256 x 107 x 101) that lie in the page cache: the pipeline's own cost,
not the disk's. Compared with reading the released projections, float64 `.npy`, frame by
frame into batches of the same size.
"""

import argparse
import functools
import itertools
import os
import pathlib
import statistics
import tempfile
import time
import types

import numpy as np
from absl import flags

from radejax.data.frame_table import make_table
from radejax.data.pipeline import LoaderOptions, make_loader
from radejax.data.records.files import RecordFileWriter, file_name
from radejax.data.records.projections import Manifest, RecordSource, write_manifest
from radejax.geometry.radar_grid import RadarGrid

FRAMES_PER_FILE = 64


def write_records(
    folder: pathlib.Path, num_frames: int, grid: RadarGrid, dtype: str
) -> RecordSource:
    """Random projections as records."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    levels = rng.random(grid.projection_shape, np.float32)
    stored = (levels * 255).astype(dtype) if dtype == "uint8" else levels.astype(dtype)
    files = []
    count = -(-num_frames // FRAMES_PER_FILE)
    for i in range(count):
        writer = RecordFileWriter(folder, file_name(i, count))
        for k in range(i * FRAMES_PER_FILE, min((i + 1) * FRAMES_PER_FILE, num_frames)):
            writer.write(f"1/{k:05d}", stored)
        files.append(writer.commit())
    write_manifest(folder, Manifest(grid, dtype, {}, files))
    return RecordSource(folder, grid=grid)


def write_npy(folder: pathlib.Path, num_frames: int, grid: RadarGrid) -> list:
    """Random projections as the released code stores them."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    r, a, c = grid.projection_shape
    paths = [folder / f"DERA_tesseract_{i:05d}.npy" for i in range(num_frames)]
    stored = rng.random((c, r, a))
    for path in paths:
        np.save(path, stored)
    return paths


def make_frames(records: RecordSource) -> list:
    """Frames with five boxes each."""
    box = np.array([[20.0, 1, 0, 4, 2, 1.5, 0.3]])
    return [
        types.SimpleNamespace(
            key=key, boxes=np.repeat(box, 5, 0), classes=np.array(["Sedan"] * 5)
        )
        for key in records.frames
    ]


def time_npy(paths: list, batch_size: int, num_frames: int) -> float:
    """Frames per second of np.load and stack."""
    names = itertools.cycle(paths)
    began = time.perf_counter()
    for _ in range(num_frames // batch_size):
        np.stack([np.load(path) for path in itertools.islice(names, batch_size)])
    return num_frames // batch_size * batch_size / (time.perf_counter() - began)


def time_loader(
    records: RecordSource, batch_size: int, num_frames: int, **how
) -> float:
    """Frames per second of the pipeline, after the first batches."""
    table = make_table(records, make_frames(records), max_objects=32)
    loader = make_loader(table, LoaderOptions(batch_size, **how))
    for _ in range(3):
        next(loader)
    steps = num_frames // batch_size
    began = time.perf_counter()
    for _ in range(steps):
        next(loader)
    return steps * batch_size / (time.perf_counter() - began)


def watch_memory(records: RecordSource, batch_size: int, num_frames: int) -> None:
    """Prints resident memory every tenth of a long run."""
    table = make_table(records, make_frames(records), max_objects=32)
    loader = make_loader(table, LoaderOptions(batch_size))
    steps = num_frames // batch_size
    began = time.perf_counter()
    for step in range(steps):
        next(loader)
        if step % max(1, steps // 10) == 0 or step == steps - 1:
            seconds = time.perf_counter() - began
            print(
                f"{(step + 1) * batch_size:>7} frames {seconds:7.1f} s  {resident()} MiB"
            )


def resident() -> int:
    """Resident memory of this process in MiB (Linux)."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 2**20


def main() -> None:
    flags.FLAGS.mark_as_parsed()  # grain's worker processes read one
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=128, help="Frames in the files.")
    parser.add_argument("--timed_frames", type=int, default=160, help="A round.")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--batch_size", type=int, default=8)
    parser.add_argument("--memory_frames", type=int, default=0)
    parser.add_argument("--folder", type=pathlib.Path, help="Where to put test files.")
    parser.add_argument(
        "--small", action="store_true", help="Small frames, for a check."
    )
    arguments = parser.parse_args()
    grid = RadarGrid.kradar()
    if arguments.small:
        grid = RadarGrid.reduced(
            num_doppler=4, num_range=16, num_elevation=3, num_azimuth=12
        )
    size, timed = arguments.batch_size, arguments.timed_frames
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = pathlib.Path(name)
        records = write_records(folder / "f2", arguments.frames, grid, "float16")
        if arguments.memory_frames:
            watch_memory(records, size, arguments.memory_frames)
            return
        bytes_ = write_records(folder / "u1", arguments.frames, grid, "uint8")
        paths = write_npy(folder / "npy", max(size, arguments.frames // 4), grid)
        variants = {
            "float16, no threads": (records, {"num_threads": 0}),
            "float16, 1 thread": (records, {"num_threads": 1}),
            "float16, 2 threads (default)": (records, {}),
            "float16, 1 worker process": (records, {"num_workers": 1}),
            "float16, 2 worker processes": (records, {"num_workers": 2}),
            "uint8, 2 threads": (bytes_, {}),
        }
        functions = {
            title: functools.partial(time_loader, source, size, timed, **how)
            for title, (source, how) in variants.items()
        }
        functions["released float64 .npy"] = functools.partial(
            time_npy, paths, size, timed
        )
        rates = {title: [] for title in functions}
        for _ in range(arguments.rounds):  # in turns: machines are shared
            for title, function in functions.items():
                rates[title].append(function())
        print(f"frames of {grid.projection_shape}, batches of {size}; frames/s")
        print(f"{'':32}{'median':>8}{'best':>8}")
        for title, values in rates.items():
            print(f"{title:32}{statistics.median(values):8.0f}{max(values):8.0f}")


if __name__ == "__main__":
    main()
