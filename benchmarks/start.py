"""Measures the time from the start of a process to its first training step or first boxes.

Each time is that of a new process. The column "radejax" uses the compilation cache of an earlier
start, and the column "first start" uses an empty cache.
"""

import functools
import itertools
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import time

from case import Case

_ROOT = pathlib.Path(__file__).resolve().parents[1]
FIRST_STEP = ("train: ", "| 1/")  # the progress bar contains it after the first step
_DETECT = f"""
import sys
sys.path.append({str(_ROOT / "benchmarks")!r})
import numpy as np
from radejax.config import load_config
from stages import untrained
found = untrained(load_config("radenet"), batch_sizes=(1,), score_threshold=0.0)
x = np.zeros((1, *found.grid.projection_shape), np.float32)
print("found:", np.asarray(found(x).scores).shape)
"""


def start(machine):
    """Starts of `train.py` until its first step, and of a detector until its first boxes."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        numbers = itertools.count()

        def train(programs):
            arguments = [str(_ROOT / "train.py"), "--config", "quickstart:short"]
            arguments += ["--workdir", str(folder / f"run{next(numbers)}")]
            (_, wall), processor = until(FIRST_STEP, arguments, folder, programs)
            return wall, processor

        def detect(programs):
            arguments = ["-c", _DETECT]
            (wall,), processor = until(["found:"], arguments, folder, programs)
            return wall, processor

        def anew(run):
            return run(folder / f"programs{next(numbers)}")

        for what, run in (
            ("train.py, quickstart:short, to its first step", train),
            ("detector of RADE-Net, to its first boxes", detect),
        ):
            kept = folder / f"programs{next(numbers)}"
            run(kept)  # fills the cache; for training, also makes the data
            yield Case(
                name=what,
                columns={
                    "radejax": functools.partial(run, kept),
                    "first start": functools.partial(anew, run),
                },
                note="of a whole process; data and records are there",
            )


def until(texts, arguments, folder, programs):
    """Returns wall seconds of a Python process until each of several texts, and its CPU seconds.

    Args:
        texts: Texts that the process writes one after the other. The last one ends the
            measurement; the process is killed then.
        arguments: Arguments of the interpreter.
        folder: Working directory.
        programs: Folder of the compilation cache.

    Raises:
        RuntimeError: The process ended without writing a text.
    """
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(programs)}
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-u", *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    output, end, seconds = b"", 0, []
    # The output is not read by lines, because the progress bar does not end its line.
    while len(seconds) < len(texts) and (chunk := process.stdout.read1()):
        output += chunk
        for text in texts[len(seconds) :]:
            if (place := output.find(text.encode(), end)) < 0:
                break
            end = place + len(text)
            seconds.append(time.perf_counter() - began)
    # `Popen.kill` would take the exit status, and with it the CPU time, of an ended process.
    os.kill(process.pid, signal.SIGKILL)
    _, process.returncode, usage = os.wait4(process.pid, 0)
    process.stdout.close()
    if len(seconds) < len(texts):
        text = output[-2000:].decode(errors="replace")
        raise RuntimeError(f"no {texts[len(seconds)]!r} from {arguments}: {text}")
    return seconds, usage.ru_utime + usage.ru_stime
