"""Runs all benchmarks that fit this machine, in alternation with PyTorch and the authors' code.

    python benchmarks/run.py                       # everything
    python benchmarks/run.py --only radenet projection    # some
    python benchmarks/run.py --minutes 15          # what did not fit is listed; again: the rest
    python benchmarks/run.py --tables              # only write the tables again

radejax and, if it is installed, torch (eager, and with `torch.compile` on a GPU) run in two
processes that alternate. Results are compared first; a case whose results differ is not measured,
and the exit code is 1. Writes `docs/reports/benchmarks/DEVICE.json` and the tables of
`docs/reports/benchmarks.md`. Times are medians of wall and CPU time per frame. Speedups are ratios
of CPU times on a CPU, where other processes may run, and of wall times otherwise.

What is stored of the same device and versions is not measured again, unless `--again` is given: a
call continues where an earlier one ended. The version of radejax includes a checksum of its code.
New measurements replace those of the same benchmarks with other versions.
"""

import argparse
import datetime
import functools
import hashlib
import os
import pathlib
import platform
import re
import shlex
import statistics
import sys
import time
import traceback
from importlib import metadata

# By default, JAX would reserve most of the GPU's memory, which torch needs as well.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import page
import rival
from cases import BENCHMARKS

import radejax

MAX_REPEATS = 20
SECONDS_A_CASE = 30.0  # the first repeats are slower, as they still allocate memory


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(BENCHMARKS), metavar="NAME",
                        help=f"of {', '.join(BENCHMARKS)}")  # fmt: skip
    parser.add_argument(
        "--minutes", type=float, default=20.0, help="after which no case is started"
    )
    parser.add_argument(
        "--batch", type=int, help="frames per call of the networks (default: several)"
    )
    parser.add_argument(
        "--again", action="store_true", help="also what is stored of these versions"
    )
    parser.add_argument(
        "--out", type=pathlib.Path, default=page.RESULTS, help="JSON file's folder"
    )
    parser.add_argument("--tables", action="store_true", help="measure nothing")
    arguments = parser.parse_args()
    is_whole = True
    if not arguments.tables:
        is_whole = measure(arguments)
    if arguments.out == page.RESULTS:
        page.write_page()
    sys.exit(not is_whole)


def measure(arguments):
    """Runs and stores what the arguments select; returns whether no case was refused."""
    jax.config.update("jax_enable_compilation_cache", False)
    machine = machine_of(arguments.batch)
    complete = set()
    if not arguments.again:
        machine["measured"], complete = page.measured(facts(machine), arguments.out)
    if arguments.batch:
        complete = set()
    chosen = {
        name: BENCHMARKS[name]
        for name in arguments.only or BENCHMARKS
        if name not in complete
    }
    result = run(
        chosen,
        60 * arguments.minutes,
        machine,
        lambda so_far: page.store(so_far, arguments.out),
    )
    print(page.devices_table([result]))
    return not any("refused" in row for row in result["rows"])


def machine_of(batch=None):
    """Returns what benchmarks are given: device, PyTorch if it is there, and what to measure."""
    device = jax.devices()[0]
    return {
        "device": device,
        "platform": device.platform,
        "rival": rival.start(device.platform),
        "batch": batch,
        "measured": set(),
    }


def run(chosen, seconds, machine, store=lambda so_far: None):
    """Runs the benchmarks that fit into the time and returns the results of the run.

    They are passed to `store` after each case, so that an interrupted run keeps its results.
    """
    began = time.perf_counter()
    rows, not_run, complete = [], [], []

    def so_far():
        return facts(machine) | {
            "minutes": round((time.perf_counter() - began) / 60, 1),
            "rows": rows,
            "not_run": not_run,
            "complete": complete,
        }

    for name, cases in chosen.items():
        if time.perf_counter() - began > seconds:
            not_run.append(name)
            continue
        not_run.append(page.FURTHER + name)  # a run that is interrupted says so
        try:
            for case in cases(machine):
                if case.key in machine["measured"]:
                    continue
                sys.stderr.write(f"{case.name}, {case.dtype}, {case.frames}\n")
                left = seconds - (time.perf_counter() - began)
                rows.append({"benchmark": name} | measured(case, left))
                store(so_far())
                if time.perf_counter() - began > seconds:
                    break
                del case  # free its arrays before the next case is built
            else:
                if not machine["batch"]:
                    not_run.pop()
                    complete.append(name)
                store(so_far())
        except Exception as error:  # the table lists it; others still run
            traceback.print_exc()
            not_run.pop()
            rows.append({"benchmark": name, "name": name, "refused": repr(error)[:300]})
            store(so_far())
    if machine["rival"]:
        machine["rival"].close()
    result = so_far()
    store(result)
    return result


def measured(case, seconds_left):
    """Returns a row with medians by column of interleaved calls after a first call of each."""
    row = {"name": case.name, "dtype": case.dtype, "frames": case.frames}
    row |= {"error": case.error, "mib": case.mib, "compile_s": case.compile_s}
    if case.error is not None and not case.error <= case.tolerance:
        return row | {
            "refused": f"results differ by {case.error:.2e} of the greatest value, "
            f"expected at most {case.tolerance:.0e}"
        }
    times = {name: [] for name in case.columns}
    first = {name: function()[0] for name, function in case.columns.items()}
    until = time.perf_counter() + min(SECONDS_A_CASE, max(seconds_left, 0.0))
    while not times["radejax"] or (
        len(times["radejax"]) < MAX_REPEATS and time.perf_counter() < until
    ):
        for name, function in case.columns.items():
            times[name].append(function())
    return row | {
        "repeats": len(times["radejax"]),
        "note": case.note if isinstance(case.note, str) else case.note(),
        "first_s": first,
        "wall_s": {n: statistics.median(w for w, _ in t) for n, t in times.items()},
        "processor_s": {
            n: statistics.median(p for _, p in t) for n, t in times.items()
        },
    }


def facts(machine):
    """Returns device, date, versions, load and command of a run."""
    packages = ["jax", "numpy"] + ["torch"] * (machine["rival"] is not None)
    name = machine["device"].device_kind
    if machine["platform"] == "cpu":
        name = f"{processor_name()}, {os.cpu_count()} cores"
    versions = {"radejax": f"{radejax.__version__}+{checksum()}"}
    script = pathlib.Path(sys.argv[0]).name
    return {
        "device": name,
        "platform": machine["platform"],
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        "versions": versions | {p: metadata.version(p) for p in packages},
        "load": os.getloadavg()[0],
        "command": shlex.join(["python", f"benchmarks/{script}", *sys.argv[1:]]),
    }


@functools.cache
def checksum():
    """Returns eight digits of the SHA-256 of radejax's code."""
    folder = pathlib.Path(radejax.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def processor_name(path=pathlib.Path("/proc/cpuinfo")):
    """Returns the name of the CPU, or its architecture if Linux does not list a name.

    The name includes family and model, as virtual machines may call every generation "AMD EPYC".
    """
    text = path.read_text() if path.is_file() else ""
    said = dict(re.findall(r"^([\w ]+?)\s*: (.+)$", text, re.MULTILINE))
    if not {"model name", "cpu family", "model"} <= said.keys():
        return platform.machine()
    return f"{said['model name']} family {said['cpu family']} model {said['model']}"


if __name__ == "__main__":
    main()
