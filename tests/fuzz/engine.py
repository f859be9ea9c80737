"""Readers on corrupted inputs: a child process reads them, and its parent counts outcomes.

A crash or hang ends only the child, and the parent notes the input.
Input number n of a reader is made of `Random(f"{reader}/{n}")`, so that it is the same in
every process.
"""

import collections
import os
import pathlib
import random
import re
import resource
import select
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

from .mutate import mutate

ROOT = pathlib.Path(__file__).resolve().parents[2]
CORPUS = pathlib.Path(__file__).with_name("corpus")
"""Inputs that once broke a reader, `<reader>/<file>...`, which are read first."""

MAX_SECONDS = 120.0  # of wall time, also for the start of a child
MAX_CPU_SECONDS = 3.0
MAX_BYTES = 384 << 20  # of memory for one input, the largest of which have 4 MiB
MAX_MESSAGE = 2500  # characters

Job = tuple[str, int, int]
"""Reader, number of its first input, and how many."""

Outcome = tuple[str, int, str, str]
"""Reader; number of the input; "read", "refused CLASS", or what is wrong; and the message."""


class Reader(NamedTuple):
    """One reader of the package.

    Attributes:
        make: Writes a folder of valid files.
        read: Reads it.
        pattern: Pattern of the files that are corrupted, one at a time.
        count: Number of inputs in the test suite.
    """

    make: Callable[[pathlib.Path], object]
    read: Callable[[pathlib.Path], object]
    pattern: str
    count: int = 100


class Case:
    """A reader with its folder, in the child."""

    def __init__(self, name: str, reader: Reader, folder: pathlib.Path) -> None:
        self._name, self._reader, self._folder = name, reader, folder
        reader.make(folder)
        reader.read(folder)  # imports and compiles what is needed
        paths = sorted(path for path in folder.glob(reader.pattern) if path.is_file())
        self._seeds = [(path, path.read_bytes()) for path in paths]
        known = sorted((CORPUS / name).glob("*"))
        self._known = [(self._target(path.name), path.read_bytes()) for path in known]

    def _target(self, name: str) -> pathlib.Path:
        stem = re.sub(r"\.\d+$", "", name)
        return next((p for p, _ in self._seeds if p.name == stem), self._seeds[0][0])

    def content(self, number: int) -> tuple[pathlib.Path, bytes]:
        """File and content of an input."""
        if number < len(self._known):
            return self._known[number]
        rng = random.Random(f"{self._name}/{number}")
        path, content = rng.choice([*self._seeds * 9, *self._known])
        return path, mutate(rng, content)

    def judge(self, number: int) -> tuple[int, str, str]:
        """Read an input and return the outcome of it."""
        path, content = self.content(number)
        before = dict(self._seeds)[path]
        path.write_bytes(content)
        began, most = time.process_time(), _memory() + MAX_BYTES
        try:
            self._reader.read(self._folder)
            kind = text = "read"
        except Exception as error:
            kind, text = _kind(error), f"{type(error).__name__}: {error}"
        path.write_bytes(before)
        if time.process_time() - began > MAX_CPU_SECONDS:
            kind = "slow"
        if _memory() > most:
            kind = "memory"
        return number, kind, text[:400]


def _kind(error: Exception) -> str:
    """Kind of an error."""
    message = str(error)
    if not hasattr(error, "exit_code"):
        return f"undocumented: {type(error).__name__}"
    if "\n" in message or len(message) > MAX_MESSAGE:
        return "more than a line"
    return f"refused {type(error).__name__}"


def _memory() -> int:
    """Peak memory of this process in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def serve(jobs: list[Job]) -> None:
    """Read inputs in the child and write a line per outcome."""
    from .readers import READERS

    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[5])
    limit = pages * resource.getpagesize() + 3 * MAX_BYTES
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", "", DeprecationWarning, "(?!radejax)")
    for name, start, count in jobs:
        with tempfile.TemporaryDirectory() as folder:
            case = Case(name, READERS[name], pathlib.Path(folder))
            resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))
            for number in range(start, start + count):
                found = name, *case.judge(number)
                print(*found, sep="\x1f", end="\x1e", flush=True)
            resource.setrlimit(resource.RLIMIT_DATA, (resource.RLIM_INFINITY,) * 2)


def run(jobs: list[Job]) -> list[Outcome]:
    """Return the outcomes of inputs in order, up to a crash or hang of the child."""
    command = [sys.executable, "-X", "faulthandler", "-c"]
    command += [f"from tests.fuzz.engine import serve; serve({jobs!r})"]
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    env = {**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
    output, wrong = b"", ""
    with (
        tempfile.TemporaryFile() as stderr,
        subprocess.Popen(
            command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=stderr
        ) as child,
    ):
        assert child.stdout is not None
        while not wrong:
            if not select.select([child.stdout], [], [], MAX_SECONDS)[0]:
                child.kill()
                wrong = "hang"
            elif data := os.read(child.stdout.fileno(), 1 << 16):
                output += data
            else:
                wrong = f"crash: {child.wait()}"
        stderr.seek(0)
        text = stderr.read().decode(errors="replace")[-3000:]
    lines = output.decode(errors="replace").split("\x1e")[:-1]
    parts = [line.split("\x1f", 3) for line in lines]
    found = [(name, int(number), kind, text) for name, number, kind, text in parts]
    inputs = []
    for name, start, count in jobs:
        inputs += [(name, number) for number in range(start, start + count)]
    if len(found) < len(inputs):
        found.append((*inputs[len(found)], wrong, text))
    return found


def counts(jobs: list[Job]) -> dict[str, tuple[collections.Counter, list[Outcome]]]:
    """By reader, the number of outcomes of each kind, and the wrong outcomes."""
    outcomes = run(jobs)
    found = {}
    for name, _, _ in jobs:
        own = [outcome for outcome in outcomes if outcome[0] == name]
        wrong = [o for o in own if not o[2].startswith(("read", "refused"))]
        found[name] = collections.Counter(kind for _, _, kind, _ in own), wrong
    return found
