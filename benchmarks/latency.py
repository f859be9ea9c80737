"""Measures the latency and memory of a model and its exports, one process per variant.

    python benchmarks/latency.py runs/quickstart
    python benchmarks/latency.py radejax/cli/demo_model --data data/simulated

Exports the model, runs frames of the test split one by one in `radejax.Detector`, in `load.py` with
StableHLO, and in ONNX Runtime with float32 and int8 and several numbers of threads. Writes
`docs/reports/latency.json` and the table of `docs/exports.md`. Calls follow each other without a
pause, so that other processes on the machine count.
"""

import argparse
import datetime
import json
import os
import pathlib
import subprocess
import sys
import tempfile
from importlib import metadata
from typing import NamedTuple

import numpy as np
from run import processor_name

from radejax import Detector, __version__
from radejax.data.projection import decode
from radejax.inference.export import export
from radejax.runs.data import data_of_run
from radejax.runs.figures import spread
from radejax.runs.quantize import export_int8

ROOT = pathlib.Path(__file__).resolve().parents[1]
RESULT = ROOT / "docs" / "reports" / "latency.json"
PAGE = ROOT / "docs" / "exports.md"
BEGIN, END = "<!-- table: benchmarks/latency.py -->", "<!-- end of table -->"
NUM_FRAMES = 64

_CHILD = """
import json, pathlib, re, sys, time
import numpy as np
kind, folder, threads, path, count = sys.argv[1:]
frames = np.load(path)
if kind == "Detector":
    from radejax import Detector
    detector = Detector.from_workdir(folder, batch_sizes=(1,))
    detect = lambda x: vars(detector(x))
else:
    sys.path.insert(0, folder)
    from load import load
    options = None
    if threads != "default":
        import onnxruntime
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = int(threads)
    detect = load(session_options=options)
seconds = []
for i in range(int(count)):
    began = time.perf_counter()
    np.asarray(detect(frames[i % len(frames)][None])["boxes"])
    seconds.append(time.perf_counter() - began)
# `resource.getrusage` counts the process that started this one, before it was replaced.
status = pathlib.Path("/proc/self/status").read_text()
peak = int(re.search("VmHWM: *([0-9]+)", status.replace("\\t", " "))[1])
print(json.dumps({"seconds": seconds, "peak_kib": peak}))
"""


class Variant(NamedTuple):
    """A way to run the model: its name, its folder, and threads of ONNX Runtime."""

    name: str
    folder: str
    threads: str = "default"

    @property
    def is_onnx(self):
        return self.folder in ("float32", "int8")


VARIANTS = [
    Variant("Detector", "stablehlo"),
    Variant("load.py, StableHLO", "stablehlo"),
    *(
        Variant(f"load.py, ONNX {dtype}", dtype, threads)
        for dtype in ("float32", "int8")
        for threads in ("1", "2", "default")
    ),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="a run, or another source of `radejax export`")
    parser.add_argument("--data", nargs="+", help="roots; default: those of the run")
    parser.add_argument("--calls", type=int, default=300, help="calls per variant")
    parser.add_argument("--out", type=pathlib.Path, default=RESULT)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        export_all(pathlib.Path(name), arguments)
        rows = measure(pathlib.Path(name), arguments.calls)
        card = pathlib.Path(name, "int8", "README.md").read_text()
    packages = ("jax", "onnxruntime", "numpy")
    result = {
        "device": f"{processor_name()}, {os.cpu_count()} cores",
        "date": datetime.date.today().isoformat(),
        "model": pathlib.Path(arguments.model).name,
        "calls": arguments.calls,
        "load": os.getloadavg()[0],
        "versions": {"radejax": __version__}
        | {package: metadata.version(package) for package in packages},
        "rows": rows,
        "int8": card.partition("\nConvolutions are")[2].splitlines(),
    }
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    print(table(result))
    if arguments.out == RESULT:
        before, rest = PAGE.read_text().split(BEGIN)
        after = rest.split(END)[1]
        PAGE.write_text(f"{before}{BEGIN}\n\n{table(result)}\n\n{END}{after}")


def export_all(folder, arguments):
    """Writes frames and exports below a folder."""
    detector = Detector.from_workdir(arguments.model)
    roots = {"roots": arguments.data} if arguments.data else None
    _, data = data_of_run(detector.saved, roots)
    data.preprocess()
    frames = spread(data.split("test"), NUM_FRAMES)
    np.save(folder / "frames.npy", [decode(data.records[x.key]) for x in frames])
    onnx = {"kind": "onnx", "radar_input": "projection", "batch_size": 1}
    export(detector, folder / "stablehlo")
    export(detector, folder / "float32", **onnx)
    export_int8(detector, folder / "int8", arguments.data, **onnx)


def measure(folder, calls):
    """Returns the rows of the table from what `export_all` wrote."""
    rows = []
    for variant in VARIANTS:
        print(variant, file=sys.stderr)
        first = None
        if not variant.is_onnx:  # fills the cache
            first = run(variant, folder, 1)["seconds"][0]
        found = run(variant, folder, calls)
        later = np.array(found["seconds"][1:])
        rows.append(
            {
                "name": variant.name,
                "threads": variant.threads if variant.is_onnx else None,
                "first_s": first or found["seconds"][0],
                "cached_first_s": first and found["seconds"][0],
                "median_s": float(np.median(later)),
                "p99_s": float(np.quantile(later, 0.99)),
                "peak_mib": found["peak_kib"] / 1024,
            }
        )
    return rows


def run(variant, folder, calls):
    """Runs a variant in a process of its own, which prints its seconds and its peak memory."""
    cache = folder / f"cache of {variant.name}"
    words = (
        variant.name,
        folder / variant.folder,
        variant.threads,
        folder / "frames.npy",
    )
    printed = subprocess.check_output(
        [sys.executable, "-c", _CHILD, *map(str, words), str(calls)],
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)},
    )
    return json.loads(printed)


def table(result):
    """Returns the table as Markdown."""
    lines = [
        "| | threads | first call | with `JAX_COMPILATION_CACHE_DIR` | median | 99th percentile "
        "| peak memory |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        cached = row["cached_first_s"]
        cells = [
            row["name"],
            row["threads"] or "-",
            f"{row['first_s']:.2f} s",
            f"{cached:.2f} s" if cached else "-",
            *(f"{1e3 * row[name]:.0f} ms" for name in ("median_s", "p99_s")),
            f"{row['peak_mib']:.0f} MiB",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    versions = ", ".join(f"{name} {x}" for name, x in result["versions"].items())
    lines += [
        "",
        f"{result['device']}, shared with other processes (load {result['load']:.0f}); model "
        f"{result['model']}, one frame per call, {result['calls']} calls; {versions}; "
        f"{result['date']}.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
