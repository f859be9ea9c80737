"""Atomic writing and reading of files, and locks and descriptions of job folders."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import fnmatch
import functools
import json
import logging
import os
import pathlib
import re
import shutil
import socket
import uuid
from collections.abc import Collection, Iterator, Mapping
from typing import IO, Any

from radejax.core.errors import DataError, DiskFullError, UserError

PathLike = str | os.PathLike[str]
JsonObject = dict[str, Any]
"""A JSON object whose fields a reader checks one by one, or the values of one to write."""

_log = logging.getLogger(__name__)

_MAX_VALUE_CHARS = 80
_SHORT_WRITE = re.compile(r"\d+ requested and \d+ written")  # of numpy.ndarray.tofile


# Writing -----------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_path(path: PathLike) -> Iterator[pathlib.Path]:
    """Yields a temporary path to write to, which becomes `path` at the end of the block.

    Missing parent folders are created. If an error occurs or the process is killed, `path`
    remains unchanged.

    Raises:
        DiskFullError: No space is left on the disk.
    """
    path = as_path(path)
    temporary = temporary_path(path)
    try:
        with disk_full(path):
            yield temporary
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def atomic_write(path: PathLike) -> Iterator[IO[bytes]]:
    """Yields a binary file open for writing, which becomes `path` like in `atomic_path`."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        yield file


@contextlib.contextmanager
def swapped_in(folder: PathLike, *stale: str) -> Iterator[pathlib.Path]:
    """Yields a temporary folder whose content moves into `folder` after the block.

    Entries of the same name are replaced, and others stay, except those that match the
    patterns `stale`: what an earlier block wrote, and this one perhaps not. If the block
    raises an error, `folder` remains unchanged.

    Raises:
        DiskFullError: No space is left on the disk.
    """
    folder = as_path(folder)
    is_new = not folder.exists()
    # In the folder, as its parent may be read-only or on another disk.
    temporary = temporary_path(folder / "new")
    remove_stale(folder, ".new.")
    try:
        with disk_full(folder):
            temporary.mkdir()
            yield temporary
            new = sorted(temporary.iterdir())
            old = {folder / path.name for path in new if (folder / path.name).is_dir()}
            for path in old.union(*map(folder.glob, stale)):
                path.rename(temporary / f".old {path.name}")
            for path in new:
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        if is_new and not any(folder.iterdir()):
            folder.rmdir()


def write_text(path: PathLike, text: str) -> None:
    """Writes a text file atomically."""
    with atomic_write(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: PathLike, value: object) -> None:
    """Writes plain values as JSON, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def temporary_path(path: pathlib.Path) -> pathlib.Path:
    """Returns a path next to another one, whose missing parent folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Containers may have equal host names and process ids.
    unique = uuid.uuid4().hex[:8]
    return path.with_name(f".{path.name}.{_machine()}.{unique}.{os.getpid()}.tmp")


@functools.cache
def _machine() -> str:
    """Returns the host name, and on Linux the number of the container's processes."""
    try:
        return f"{socket.gethostname()}.{os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return socket.gethostname()


def remove_stale(folder: pathlib.Path, prefix: str = "**/.") -> None:
    """Removes temporary files that killed processes on this machine left in a folder."""
    for path in list(folder.glob(f"{prefix}*.{_machine()}.*.tmp")):
        process = path.name.split(".")[-2]
        if process.isdecimal() and not _is_running(int(process)):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except OSError as error:
        return error.errno == errno.EPERM  # the process belongs to another user
    return True


@contextlib.contextmanager
def disk_full(path: PathLike) -> Iterator[None]:
    """Turns errors caused by a full disk into a `DiskFullError` with a one-line message.

    It can be used in a `with` statement or as a decorator.

    Args:
        path: File that is written in the block.

    Raises:
        DiskFullError: No space is left on the disk, or a quota is exhausted.
    """
    try:
        yield
    except Exception as error:
        if not is_no_space(error):
            raise
        raise DiskFullError(
            f"no space left on the disk of {pathlib.Path(path).parent}; nothing half-"
            "written was kept, run the same command again with space to continue"
        ) from error


def is_no_space(error: BaseException) -> bool:
    """Returns whether an error reports a full disk or an exhausted quota.

    C++ libraries pass on the system's error message but not its error number, so the
    message is searched as well. NumPy passes on neither.
    """
    numbers = (errno.ENOSPC, errno.EDQUOT)
    if isinstance(error, OSError) and error.errno in numbers:
        return True
    if isinstance(error, OSError) and _SHORT_WRITE.fullmatch(str(error)):
        return True
    return any(os.strerror(number) in str(error) for number in numbers)


# Reading -----------------------------------------------------------------------------


def as_path(path: PathLike) -> pathlib.Path:
    """Converts a path of a user, with `~` for the home folder, to a `Path`.

    Raises:
        UserError: The path begins with `~`, and there is no such home folder.
    """
    try:
        return pathlib.Path(path).expanduser()
    except RuntimeError:
        raise UserError(f"{path}: there is no home folder to replace ~") from None


def find_files(folder: PathLike, *patterns: str) -> list[pathlib.Path]:
    """Finds files in a folder and all its subfolders, also through symbolic links.

    A folder to which several links lead is visited once, so that links may form a loop.

    Args:
        folder: Folder to search.
        *patterns: Patterns of the file names, such as "*.npy".

    Returns:
        Sorted paths below `folder`.

    Raises:
        OSError: A folder cannot be read.
    """

    def stop(error: OSError) -> None:
        raise error

    found = list[pathlib.Path]()
    visited = set[str]()
    for parent, folders, names in os.walk(folder, onerror=stop, followlinks=True):
        real = os.path.realpath(parent)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders.sort()
        for pattern in patterns:
            matching = fnmatch.filter(names, pattern)
            found += [pathlib.Path(parent, name) for name in matching]
    return sorted(found)


def read_text(path: PathLike) -> str:
    """Reads a UTF-8 text file, without a byte order mark.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The path is a folder, or the file is not valid UTF-8. In the latter case
            the message contains the line number.
    """
    try:
        content = as_path(path).read_bytes()
    except (IsADirectoryError, NotADirectoryError):
        raise DataError(f"{path}: expected a text file") from None
    return decoded(content, str(path))


def decoded(content: bytes, where: str) -> str:
    """Decodes the UTF-8 content of a file.

    Args:
        content: Bytes of the file; a byte order mark is removed.
        where: Name of the file in the error message.

    Raises:
        DataError: The content is not valid UTF-8; the message contains the line number.
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise DataError(
            f"{where}:{line}: byte {content[error.start]:#04x} is not UTF-8 text"
        ) from None


def read_json(path: PathLike) -> Any:
    """Reads a JSON file.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is not valid UTF-8 or not valid JSON.
    """
    text = read_text(path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON: {error}") from None


def read_object(path: PathLike, *keys: str) -> JsonObject:
    """Reads a JSON file that contains an object with the given keys.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is not valid JSON, or does not contain such an object.
    """
    value = read_json(path)
    if not isinstance(value, dict) or not set(keys) <= set(value):
        raise DataError(f"{path}: expected a JSON object {' '.join(keys)}".rstrip())
    return value


# Folders of one job ------------------------------------------------------------------


def claim(
    path: PathLike,
    wanted: Mapping[str, object],
    what: str,
    *,
    fix: str = "choose another folder, or delete that one",
    name: str = "",
    ignore: Collection[str] = (),
) -> None:
    """Writes the description of a job into its folder, or compares it with the existing one.

    Args:
        path: JSON file in the folder. If it does not exist, it is written and missing
            folders are created.
        wanted: Description of the job as plain values.
        what: Content of a folder that belongs to another job, for the error message, such
            as "another simulation".
        fix: Advice at the end of the error message.
        name: Prefix of the field names in the error message.
        ignore: Fields that may differ, such as "train.num_epochs".

    Raises:
        UserError: The folder belongs to another job; the message names the fields that
            differ.
        DataError: The JSON file is corrupted.
    """
    path = as_path(path)
    try:
        found = read_object(path)
    except FileNotFoundError:
        write_json(path, wanted)
        return
    ignored = [f"{name}.{field}".removeprefix(".") for field in ignore]
    if lines := differences(found, json.loads(json.dumps(wanted)), name, ignored):
        place = relative(path.parent)
        raise UserError(f"{place} holds {what}: {'; '.join(lines)}; {fix}")


def differences(
    found: object, wanted: object, name: str = "config", ignore: Collection[str] = ()
) -> list[str]:
    """Returns one line per difference between two trees of values read from JSON.

    Args:
        found: The values that are there.
        wanted: The values that are expected.
        name: Name of the trees, the prefix of the field names.
        ignore: Full names of fields that may differ.
    """
    if found == wanted or name in ignore:
        return []
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        lines = []
        for key in sorted(set(found) | set(wanted)):
            field = f"{name}.{key}".removeprefix(".")
            lines += differences(found.get(key), wanted.get(key), field, ignore)
        return lines
    if max(len(repr(found)), len(repr(wanted))) > _MAX_VALUE_CHARS:
        return [f"{name} differs"]
    return [f"{name} is {found!r} there and {wanted!r} here"]


@contextlib.contextmanager
def lock(path: PathLike, message: str | None = None) -> Iterator[None]:
    """Holds an exclusive lock on a file while a block runs.

    The operating system releases the lock when the process ends, even if it is killed. If
    the file system does not support locks, a warning is logged and the block runs without
    one.

    Args:
        path: File to lock. It and its folder are created if missing, and are not removed.
        message: Error message if another process holds the lock; if None, the process
            waits for the lock instead.

    Raises:
        UserError: Another process holds the lock, and `message` is given.
    """
    path = as_path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if message else 0))
        except BlockingIOError:
            raise UserError(message) from None
        except OSError as error:
            _log.warning("no locks on the disk of %s (%s)", path.parent, error.strerror)
        yield


def relative(path: pathlib.Path) -> str:
    """Returns a path relative to the current folder if it is below it, else unchanged."""
    here = pathlib.Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)
