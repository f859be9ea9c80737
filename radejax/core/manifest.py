"""What the files of an output folder were made from, and whether all of them are there.

A job that writes one file per frame describes itself in its folder:

manifest.json          what the folder contains, the options and the names of all files that
                       the finished job has
manifest.<id>.jsonl    one line per written file: its name, and name, size and modification
                       time of each file that it was made from

Every call of a job appends to a file of its own, so that several processes and hosts can
work in one folder. A line that a killed process left incomplete is ignored.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import IO

import radejax
from radejax.core import files
from radejax.core.errors import DataError
from radejax.core.files import JsonObject, PathLike

FILE = "manifest.json"

State = list[list[str | int]]
"""Name, size and modification time in nanoseconds of every file."""


def state_of(paths: Iterable[PathLike | None]) -> State:
    """Returns the state of the given files; those that are missing or None are left out."""
    found = State()
    for path in paths:
        with contextlib.suppress(FileNotFoundError):
            if path is not None:
                stat = files.as_path(path).stat()
                found.append([os.path.basename(path), stat.st_size, stat.st_mtime_ns])
    return found


@dataclasses.dataclass(frozen=True)
class Manifest:
    """The description of an output folder.

    Attributes:
        folder: The folder.
        options: What the files depend on besides their sources, as JSON values.
        names: Names of all files of the finished job, relative to the folder; empty if the
            folder grows with the dataset.
        sources: State of the sources of every written file, by its name.
    """

    folder: pathlib.Path
    options: JsonObject
    names: tuple[str, ...]
    sources: Mapping[str, State]

    @classmethod
    def open(cls, folder: PathLike) -> Manifest | None:
        """Reads the description of a folder; None if there is none.

        Raises:
            DataError: The description is corrupted.
        """
        folder = files.as_path(folder)
        if not (folder / FILE).is_file():
            return None
        content = files.read_object(folder / FILE, "options", "names")
        sources = {}
        for path in sorted(folder.glob("manifest.*.jsonl")):
            for line in files.read_text(path).splitlines():
                with contextlib.suppress(ValueError):  # the process was killed
                    name, state = json.loads(line)
                    sources[name] = state
        return cls(folder, content["options"], tuple(content["names"]), sources)

    @classmethod
    def claim(
        cls,
        folder: PathLike,
        what: str,
        options: JsonObject,
        names: Sequence[str] = (),
    ) -> Manifest:
        """Describes a new folder, or opens that of an earlier call of the same job.

        Args:
            folder: Folder of the job, created if missing.
            what: Content of the folder, such as "boxes", for the error message.
            options: See `Manifest`.
            names: See `Manifest`.

        Raises:
            UserError: The folder belongs to another job; the message names the options that
                differ.
            DataError: The description is corrupted.
        """
        folder = files.as_path(folder)
        wanted = {
            "what": what,
            "radejax": radejax.__version__,
            "options": options,
            "names": list(names),
        }
        ignore = ("radejax",)
        files.claim(folder / FILE, wanted, f"other {what}", ignore=ignore)
        found = cls.open(folder)
        assert found is not None
        return found

    @contextlib.contextmanager
    def log(self) -> Iterator[Callable[[str, State], None]]:
        """Yields a function `add(name, sources)` to call for every file that is written."""
        path = self.folder / f"manifest.{uuid.uuid4().hex[:12]}.jsonl"
        with contextlib.ExitStack() as stack:
            file: IO[str] | None = None

            def add(name: str, sources: State) -> None:
                nonlocal file
                if file is None:
                    file = stack.enter_context(open(path, "w"))
                file.write(json.dumps([name, sources]) + "\n")
                file.flush()

            yield add

    def is_done(self, name: str) -> bool:
        """Returns whether a file was written and is there."""
        return name in self.sources and (self.folder / name).is_file()

    def check_whole(self, pattern: str, fix: str) -> None:
        """Checks that exactly the files of the finished job are there.

        Args:
            pattern: Pattern of the names of the job's files, such as "*.json".
            fix: Advice at the end of the error message.

        Raises:
            DataError: Files are missing, as the job was interrupted or the folder was
                copied in part, or there are files that are not of this job.
        """
        total = len(self.names)
        missing = [name for name in self.names if not (self.folder / name).is_file()]
        there = {str(p.relative_to(self.folder)) for p in self.folder.glob(pattern)}
        problems = {
            f"an interrupted job, which did not write {{}} of {total} files": [
                name for name in missing if name not in self.sources
            ],
            f"a partial copy, without {{}} of {total} files": [
                name for name in missing if name in self.sources
            ],
            "{} files that are not of the job that wrote the others": sorted(
                there - {*self.names, FILE}
            ),
        }
        for problem, names in problems.items():
            if names:
                found = problem.format(len(names))
                place = files.relative(self.folder)
                raise DataError(f"{place} holds {found}, such as {names[0]}; {fix}")
