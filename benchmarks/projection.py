"""Time of the tensor max projection of one full-size tesseract.

    python benchmarks/projection.py [--repeats 5] [--shape 64 256 37 107] [--folder DIR]

Compares, interleaved in one process, `project` with the released formula (logarithm of
every cell, transpose, two maxima) on a float32 tensor laid out as scipy's `loadmat`
returns it, and with the memory bandwidth of one pass (the sum of all cells). Then times
projecting from files in the page cache, and says which share of it is reading.
"""

import argparse
import pathlib
import statistics
import tempfile
import time
from collections.abc import Callable

import numpy as np
import scipy.io

from radejax.data.kradar.write import write_tesseract
from radejax.data.projection import project, project_plain
from radejax.data.tesseract import project_file


def time_interleaved(
    functions: dict[str, Callable[[], object]], repeats: int
) -> dict[str, float]:
    """Median seconds of every function, taken in turns."""
    seconds = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            began = time.perf_counter()
            function()
            seconds[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in seconds.items()}


def make_tesseract(shape: tuple[int, ...]) -> np.ndarray:
    """Column-major noise with K-Radar's order of magnitude, `[D, R, E, A]`."""
    rng = np.random.default_rng(0)
    noise = rng.standard_exponential(shape[::-1], np.float32)
    return (noise * np.float32(1e10)).T


def benchmark_memory(tesseract: np.ndarray, repeats: int) -> None:
    row_major = np.ascontiguousarray(tesseract)
    times = time_interleaved(
        {
            "released formula": lambda: project_plain(tesseract),
            "maxima first (numpy)": lambda: maxima_first(tesseract),
            "project": lambda: project(tesseract),
            "project, float16": lambda: project(tesseract, dtype=np.float16),
            "project, row-major": lambda: project(row_major),
            "one pass (sum)": lambda: tesseract.sum(),
        },
        repeats,
    )
    error = np.abs(project(tesseract) - project_plain(tesseract.astype(np.float64)))
    megabytes = tesseract.nbytes / 1e6
    print(
        f"{tesseract.shape} float32, {megabytes:.0f} MB; largest error {error.max():.1e}\n"
    )
    print(f"{'':24}{'ms':>8}{'times faster':>15}{'GB/s':>8}{'of one pass':>13}")
    for name, seconds in times.items():
        print(
            f"{name:24}{1e3 * seconds:8.1f}{times['released formula'] / seconds:15.1f}"
            f"{megabytes / 1e3 / seconds:8.1f}{times['one pass (sum)'] / seconds:13.0%}"
        )


def maxima_first(tesseract: np.ndarray) -> np.ndarray:
    """The straightforward fast way: two reductions, then the logarithm."""
    power = [tesseract.max(2).transpose(1, 2, 0), tesseract.max(0).transpose(0, 2, 1)]
    return (10 * np.log10(np.concatenate(power, -1) + 1e-10) + 1.2) / 184.3


def benchmark_files(tesseract: np.ndarray, folder: pathlib.Path, repeats: int) -> None:
    plain, compressed = folder / "plain.mat", folder / "compressed.mat"
    write_tesseract(plain, tesseract)
    write_tesseract(compressed, tesseract, compress=True)
    timings = {"reading": 0.0}
    times = time_interleaved(
        {
            "loadmat, released formula": lambda: project_plain(
                scipy.io.loadmat(plain)["arrDREA"]
            ),
            "loadmat, project": lambda: project(scipy.io.loadmat(plain)["arrDREA"]),
            "project_file": lambda: project_file(plain, timings=timings),
        },
        repeats,
    )
    share = timings["reading"] / repeats / times["project_file"]
    timings["reading"] = 0.0
    once = time_interleaved(
        {"project_file, compressed": lambda: project_file(compressed, timings=timings)},
        1,
    )
    print(f"\n{'from a file (cached)':28}{'ms':>8}{'reading':>10}")
    for name, seconds in times.items():
        shown = f"{share:.0%}" if name == "project_file" else ""
        print(f"{name:28}{1e3 * seconds:8.1f}{shown:>10}")
    for name, seconds in once.items():
        print(f"{name:28}{1e3 * seconds:8.1f}{timings['reading'] / seconds:10.0%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--shape", type=int, nargs=4, default=(64, 256, 37, 107))
    parser.add_argument("--folder", type=pathlib.Path, help="Where to put test files.")
    arguments = parser.parse_args()
    tesseract = make_tesseract(tuple(arguments.shape))
    benchmark_memory(tesseract, arguments.repeats)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        benchmark_files(tesseract, pathlib.Path(folder), arguments.repeats)


if __name__ == "__main__":
    main()
