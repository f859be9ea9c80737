"""What the files of an output folder were made from, and whether all of them are there.

A job that writes one file per frame describes itself in its folder:

manifest.json          what the folder contains, the options and the names of all files that
                       the finished job has
manifest.<id>.jsonl    one line per written file: the time, its name (of records, the key
                       of the frame), and name, size and modification time of each file
                       that it was made from, or null if it could not be made

Every process appends to a file of its own, so that several processes and hosts can work in
one folder. A line that a killed process left incomplete is ignored.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import logging
import operator
import os
import pathlib
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence

from radejax.core import files
from radejax.core.archives import wrap_read_errors
from radejax.core.errors import DataError, UserError
from radejax.core.files import JsonObject, PathLike
from radejax.core.version import __version__

_log = logging.getLogger(__name__)

FILE = "manifest.json"

_PROCESS = uuid.uuid4().hex[:12]

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


def add(folder: pathlib.Path, name: str, sources: State | None) -> None:
    """Logs a file of a folder, and the state of its sources; None if it cannot be made."""
    path = folder / f"manifest.{_PROCESS}{os.getpid()}.jsonl"
    with files.disk_full(path), open(path, "a") as file:
        file.write(json.dumps([time.time_ns(), name, sources]) + "\n")


def read_sources(folder: pathlib.Path) -> dict[str, State | None]:
    """Returns the state of the sources of every logged file, by its name."""
    lines = []
    for path in folder.glob("manifest.*.jsonl"):
        for line in files.read_text(path).splitlines():
            with contextlib.suppress(ValueError):  # the process was killed
                time_ns, name, state = json.loads(line)
                lines.append((time_ns, name, state))
    lines.sort(key=operator.itemgetter(0))
    return {name: state for _, name, state in lines}


def checksums(folder: pathlib.Path, *names: str) -> dict[str, str]:
    """Returns the sha256 of those files of a folder that are there, by their names."""
    there = [name for name in names if (folder / name).is_file()]
    return {x: hashlib.sha256((folder / x).read_bytes()).hexdigest() for x in there}


def read_checked(path: pathlib.Path, *keys: str) -> JsonObject:
    """Reads a JSON object, and checks the files whose checksums are its field "sha256".

    Files that are missing, and objects without this field, are not checked.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file does not contain an object with the given keys. Or another file
            of the folder is not the one that was written with it.
    """
    content = files.read_object(path, *keys)
    with wrap_read_errors(path, "a description with checksums of files"):
        stored = dict(content.get("sha256", {}))
    for name, sha256 in checksums(path.parent, *stored).items():
        if sha256 != stored[name]:
            raise DataError(
                f"{files.relative(path.with_name(name))} is corrupted or of another folder: its "
                f"sha256 differs from the one in {path.name}; copy the whole folder, or write "
                "it again"
            )
    return content


def warn_of_changes(
    folder: pathlib.Path, sources: Mapping[str, PathLike | None]
) -> list[str]:
    """Returns the files that were made from something else, and logs their number.

    Args:
        folder: Folder of the files.
        sources: The file from which each file would be made now, by name. Files whose
            source is missing now, or was not logged, count as unchanged.
    """
    known = read_sources(folder)
    states = {name: state_of([path]) for name, path in sources.items() if name in known}
    changed = [name for name, now in states.items() if now and now != known[name]]
    if changed:
        text = (
            "%s: %d of %d files were made from other files than there are now (name, size or "
            "time differ), such as %s: delete these, or the folder, and make them again"
        )
        place = files.relative(folder)
        _log.warning(text, place, len(changed), len(sources), ", ".join(changed[:5]))
    return changed


@dataclasses.dataclass(frozen=True)
class Manifest:
    """The description of an output folder.

    Attributes:
        folder: The folder.
        options: What the files depend on besides their sources, as JSON values.
        names: Names of all files of the finished job, relative to the folder; empty if the
            folder grows with the dataset.
    """

    folder: pathlib.Path
    options: JsonObject
    names: tuple[str, ...]

    @functools.cached_property
    def sources(self) -> Mapping[str, State | None]:
        """State of the sources of every file, by its name; None if it cannot be made."""
        return read_sources(self.folder)

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
        return cls(folder, content["options"], tuple(content["names"]))

    @classmethod
    def claim(
        cls,
        folder: PathLike,
        what: str,
        options: JsonObject,
        names: Sequence[str] = (),
        patterns: Sequence[str] = (),
        option: str = "",
    ) -> Manifest:
        """Describes a new folder, or opens that of an earlier call of the same job.

        With patterns, a folder in which nothing was written yet may get other options.

        Args:
            folder: Folder of the job, created if missing.
            what: Content of the folder, such as "boxes", for the error message.
            options: See `Manifest`.
            names: See `Manifest`.
            patterns: Patterns of the names of the job's files, such as "*.npy".
            option: Options of commands that choose the folder, such as " (--out)".

        Raises:
            UserError: The folder belongs to another job; the message names the options that
                differ. Or it has files of the patterns and no description.
            DataError: The description is corrupted.
        """
        folder = files.as_path(folder)
        wanted = {
            "what": what,
            "radejax": __version__,
            "options": options,
            "names": list(names),
        }
        fix = f"choose another folder{option}, or delete that one"
        path = folder / FILE
        there = files.read_object(path) if path.exists() else None
        written = files.find_files(folder, *patterns) if folder.is_dir() else []
        if written and there is None:
            raise UserError(
                f"{files.relative(written[0])} is there, but no {FILE} that describes how "
                f"it was made: {fix}"
            )
        if there and not written and there.get("what") == what and patterns:
            files.write_json(path, wanted)
        files.claim(path, wanted, f"other {what}", fix=fix, ignore=["radejax"])
        return cls(folder, options, tuple(names))

    def is_done(self, name: str, sources: State) -> bool:
        """Returns whether a file was made from the given sources and is there."""
        return self.sources.get(name) == sources and (self.folder / name).is_file()

    def check_whole(self, pattern: str, fix: str) -> set[str]:
        """Checks that exactly the files of the finished job are there.

        Args:
            pattern: Pattern of the names of the job's files, such as "*.json".
            fix: Advice at the end of the error message.

        Returns:
            The names of the files that could not be made. They may be missing.

        Raises:
            DataError: Files are missing, as the job was interrupted or the folder was
                copied in part, or there are files that are not of this job.
        """
        total = len(self.names)
        failed = {name for name in self.names if self.sources.get(name, ()) is None}
        made = [name for name in self.names if name not in failed]
        missing = [name for name in made if not (self.folder / name).is_file()]
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
        return failed
