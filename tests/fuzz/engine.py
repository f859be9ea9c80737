"""Readers under fire: a child reads damaged inputs, its parent counts what becomes of them.

One child serves many inputs. It dies or hangs alone: its parent notes on which input, and
starts another one. Inputs are numbered, and the same in every process: number n of a
reader is made of `Random(f"{reader}/{n}")`.
"""

import collections
import contextlib
import os
import pathlib
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, Pipe

from .mutate import mutate

ROOT = pathlib.Path(__file__).resolve().parents[2]
CORPUS = pathlib.Path(__file__).with_name("corpus")
"""Inputs that once broke a reader, `<reader>/<file>...`: read as they are, then damaged."""

MAX_SECONDS = 120.0  # of the wall, for machines with much to do; then it is killed
MAX_CPU_SECONDS = 3.0
MAX_BYTES = 384 << 20  # beyond what the child had: the largest inputs have 4 MiB
MAX_MESSAGE = 2500  # characters of the one line

Outcome = tuple[int, str, str]
"""Number of the input; "read", "refused CLASS", or what is wrong; and the message."""

_WRONG_PATH = (
    FileNotFoundError,
    NotADirectoryError,
    IsADirectoryError,
    PermissionError,
)


class Reader:
    """One reader of the package and a valid folder of what it reads.

    Args:
        make: Writes the folder.
        read: Reads it; what it raises is judged.
        files: Patterns of the files that are damaged, one at a time.
        writes: Whether it also writes: the folder is then made anew for every input.
        count: Inputs in the test suite; by default what text readers get.
    """

    def __init__(
        self,
        make: Callable[[pathlib.Path], object],
        read: Callable[[pathlib.Path], object],
        *files: str,
        count: int = 500,
        writes: bool = False,
    ) -> None:
        self.make, self.read, self.files, self.count = make, read, files, count
        self.writes = writes


class Case:
    """A reader with its folder, in the child."""

    def __init__(self, name: str, reader: Reader, folder: pathlib.Path) -> None:
        self._name, self._reader, self._folder = name, reader, folder
        folder.mkdir()
        reader.make(folder)
        self._whole = folder.with_name(f"{folder.name}.whole")
        shutil.copytree(folder, self._whole)
        reader.read(folder)  # and what it does once, it does here
        paths = [p for f in reader.files for p in folder.glob(f) if p.is_file()]
        self._seeds = [(path, path.read_bytes()) for path in sorted(set(paths))]
        assert self._seeds, f"{name}: nothing to damage"
        known = sorted((CORPUS / name).glob("*")) if (CORPUS / name).is_dir() else []
        # By the file's ending where there are several: manifest.json.3 is manifest.json.
        self._known = [(self._target(path.name), path.read_bytes()) for path in known]

    def _target(self, name: str) -> pathlib.Path:
        stem = re.sub(r"\.\d+$", "", name)
        return next((p for p, _ in self._seeds if p.name == stem), self._seeds[0][0])

    def content(self, number: int) -> tuple[pathlib.Path, bytes]:
        """File and content of an input: first the known ones as they are."""
        if number < len(self._known):
            return self._known[number]
        rng = random.Random(f"{self._name}/{number}")
        path, content = rng.choice([*self._seeds * 9, *self._known])
        return path, mutate(rng, content, path.name)

    def judge(self, number: int) -> Outcome:
        """Reads an input and says what came of it."""
        path, content = self.content(number)
        before = dict(self._seeds)[path]
        path.write_bytes(content)
        began = time.process_time()
        try:
            self._reader.read(self._folder)
            kind = text = "read"
        except Exception as error:
            kind, text = _kind(error), f"{type(error).__name__}: {error}"
        finally:
            path.write_bytes(before)
            if self._reader.writes:
                shutil.rmtree(self._folder)
                shutil.copytree(self._whole, self._folder)
        if (seconds := time.process_time() - began) > MAX_CPU_SECONDS:
            kind = f"slow: {seconds:.1f} s"
        return number, kind, text[:400]


def _kind(error: Exception) -> str:
    """What an error is, to a user."""
    name, message = type(error).__name__, str(error)
    is_ours = isinstance(error, ValueError) and hasattr(error, "exit_code")
    if not is_ours and not isinstance(error, _WRONG_PATH):
        return f"escape: {name}"
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) and "parser" not in str(cause):
            return "memory"
        cause = cause.__cause__ or cause.__context__
    if is_ours and ("\n" in message or len(message) > MAX_MESSAGE):
        return "unclear: more than a line"
    return f"refused {name}"


def _memory() -> int:
    """Most bytes that this process ever had."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def serve(fd: int, folder: str) -> None:
    """The child: reads what it is told to, until nobody listens any more."""
    from .readers import READERS

    connection = Connection(fd)
    with contextlib.suppress(EOFError):
        cases: dict[str, Case] = {}
        while True:
            name, start, count = connection.recv()
            if name not in cases:
                place = pathlib.Path(folder) / str(len(cases))
                cases[name] = Case(name, READERS[name], place)
            _limit_memory()
            warnings.simplefilter("error")  # a warning is more than one line
            others = "(?!radejax)"  # what they give up concerns no user
            warnings.filterwarnings("ignore", "", DeprecationWarning, others)
            most = _memory() + MAX_BYTES
            for number in range(start, start + count):
                outcome = cases[name].judge(number)
                if _memory() > most:
                    outcome = number, "memory", outcome[2]
                connection.send(outcome)


def _fast_folder() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def _limit_memory() -> None:
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[5])
    limit = pages * resource.getpagesize() + 2 * MAX_BYTES
    resource.setrlimit(resource.RLIMIT_DATA, (limit, resource.RLIM_INFINITY))


class Child:
    """The child's handle in its parent, to be used in a `with` block."""

    def __init__(self) -> None:
        self._process: subprocess.Popen | None = None

    def run(self, reader: str, start: int, count: int) -> Iterator[Outcome]:
        """What becomes of `count` inputs of a reader, in order."""
        number, end = start, start + count
        while number < end:
            if self._process is None:
                self._start()
            self._connection.send((reader, number, end - number))
            first = number
            while number < end:
                # The first answer waits for what is made once.
                if not self._connection.poll(MAX_SECONDS + 120 * (number == first)):
                    yield number, "hang", f"no answer in {MAX_SECONDS} s"
                    number = self._restart(number)
                    break
                try:
                    outcome = self._connection.recv()
                except (EOFError, ConnectionResetError):
                    yield number, f"crash: {self._process.wait()}", self._last_words()
                    number = self._restart(number)
                    break
                yield outcome
                number += 1
                if outcome[1] == "memory":
                    self._restart(number)
                    break

    def counts(
        self, reader: str, start: int, count: int
    ) -> tuple[collections.Counter, list]:
        """How often each kind of outcome came, and the outcomes that are wrong."""
        outcomes = list(self.run(reader, start, count))
        wrong = [o for o in outcomes if not o[1].startswith(("read", "refused"))]
        return collections.Counter(kind for _, kind, _ in outcomes), wrong

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  closed with the child
        fd = theirs.fileno()
        self._folder = tempfile.TemporaryDirectory(dir=_fast_folder())
        code = "from tests.fuzz.engine import serve; "
        code += f"serve({fd}, {self._folder.name!r})"
        paths = (str(ROOT), os.environ.get("PYTHONPATH", ""))
        environ = os.environ | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "JAX_PLATFORMS": "cpu",
            "JAX_ENABLE_COMPILATION_CACHE": "0",
        }
        self._process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", "-c", code],
            pass_fds=[fd],
            env=environ,
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=self._stderr,
            stderr=self._stderr,
        )
        theirs.close()

    def _last_words(self) -> str:
        self._stderr.seek(0)
        return self._stderr.read().decode(errors="replace")[-3000:]

    def _restart(self, number: int) -> int:
        """The next input's number; the child has been ended."""
        self.close()
        return number + 1

    def close(self) -> None:
        """Ends the child."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._connection.close()
            self._stderr.close()
            self._folder.cleanup()
            self._process = None

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def keep(name: str, reader: Reader, number: int) -> pathlib.Path:
    """Puts an input into the corpus."""
    with tempfile.TemporaryDirectory() as folder:
        path, content = Case(name, reader, pathlib.Path(folder) / "0").content(number)
    target = CORPUS / name / f"{path.name}.{number}"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(content)
    return target
