"""Files that are either whole or not there, and folders that belong to one job."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import logging
import os
import pathlib
import shutil
import socket
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import IO, Any

from radejax.core import schema
from radejax.core.errors import DataError, DiskFullError, UserError

PathLike = str | os.PathLike[str]

_log = logging.getLogger(__name__)

_LONGEST_INT = 30  # digits; 64 bits have 20
_LONG = 80  # characters of a value that a message shows

# Whole files -------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """A temporary path to write to, which becomes `path` at the end of the block.

    Missing parent folders are made. After an error or a kill `path` is what it was;
    the error also removes the temporary file. Permissions are those of a new file in that
    folder, also where a library writes for the owner alone.

    Raises:
        DiskFullError: No space is left on the disk.
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(path)
    try:
        with disk_full(path):
            temporary.touch()
            mode = stat.S_IMODE(temporary.stat().st_mode)
            yield temporary
            with open(temporary, "rb+") as file:
                if stat.S_IMODE(os.fstat(file.fileno()).st_mode) != mode:
                    os.fchmod(file.fileno(), mode)
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def swapped_in(folder: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """A temporary folder beside, of which all moves into `folder` at the end of the block.

    What has the same name there is replaced, folders whole; the rest stays. After an error
    `folder` is what it was; after a kill too, unless it came between two of these moves.

    Raises:
        DiskFullError: No space is left on the disk.
    """
    folder = pathlib.Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(folder)
    _remove_stale(folder.parent.glob(_stale_pattern(folder.name)))
    try:
        with disk_full(folder):
            temporary.mkdir()
            yield temporary
            folder.mkdir(exist_ok=True)
            for path in sorted(temporary.iterdir()):
                if (folder / path.name).is_dir():
                    (folder / path.name).rename(temporary / f".old {path.name}")
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """As `atomic_path`: an open binary file that becomes `path`."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        yield file


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes a text file atomically."""
    with atomic_write(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Writes plain values as JSON, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def read_text(path: str | os.PathLike[str]) -> str:
    """Reads a text file, without a byte order mark.

    Raises:
        FileNotFoundError: Names the file.
        DataError: It is a folder, or not UTF-8; names the line.
    """
    try:
        content = pathlib.Path(path).read_bytes()
    except (IsADirectoryError, NotADirectoryError):
        raise DataError(f"{path}: is no file, expected a text file") from None
    return decoded(content, str(path))


def decoded(content: bytes, where: str) -> str:
    """Bytes of a text file as text, without a byte order mark.

    Raises:
        DataError: They are not UTF-8; names `where` and the line.
    """
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise DataError(
            f"{where}:{line}: byte {content[error.start]:#04x} is not UTF-8 text"
        ) from None


def read_json(path: str | os.PathLike[str], hint: Any = Any, *, mend: str = "") -> Any:
    """Reads a JSON file.

    Args:
        path: The file.
        hint: What it must hold, see `schema.check`.
        mend: What to do where it does not.

    Raises:
        FileNotFoundError: Names the file.
        DataError: The file is not valid JSON, or holds something else; names it and the
            place.
    """
    try:
        return parse_json(read_text(path), hint, str(path))
    except DataError as error:
        raise DataError(f"{error}{'; ' * bool(mend)}{mend}") from None


def parse_json(text: str, hint: Any, where: str) -> Any:
    """As `read_json`, of a text; `where` names it in errors."""
    try:
        value = json.loads(text, parse_int=_parse_int)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where} is not valid JSON: {error}") from None
    return schema.check(value, hint, where)


def _parse_int(digits: str) -> int:
    """An integer as JSON has it; Python's own take quadratic time for long ones."""
    if len(digits) > _LONGEST_INT:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def temporary_path(path: pathlib.Path) -> pathlib.Path:
    """Where this process writes what is to become `path`, for `remove_stale` to know."""
    return path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.tmp")


def remove_stale(folder: pathlib.Path, name: str = "*") -> None:
    """Removes temporary files that killed processes of this machine left.

    Args:
        folder: Looked at with all folders in it.
        name: Of the files that they were to become; may have wildcards.
    """
    _remove_stale(folder.rglob(_stale_pattern(name)))


def _stale_pattern(name: str) -> str:
    return f".{name}.{socket.gethostname()}.*.tmp"


def _remove_stale(paths: Iterable[pathlib.Path]) -> None:
    for path in list(paths):
        process = path.name.split(".")[-2]
        if process.isdecimal() and not is_running(int(process)):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


def is_running(process: int) -> bool:
    """True if a process of this machine, by its number, could still be writing."""
    try:
        os.kill(process, 0)
        status = pathlib.Path(f"/proc/{process}/stat").read_text()
    except ProcessLookupError:
        return False
    except OSError:  # not ours, or no /proc here
        return True
    # In containers nobody may collect the dead: "pid (name) Z ..." is one of them.
    return status.rpartition(")")[2].split()[0] != "Z"


# Full disks --------------------------------------------------------------------------


@contextlib.contextmanager
def disk_full(
    path: str | os.PathLike[str], message: str | None = None
) -> Iterator[None]:
    """Turns errors on a full disk into one line; a `with` block or a decorator.

    Args:
        path: Of the file that is written in the block.
        message: In place of that the file was not kept.

    Raises:
        DiskFullError: No space is left, or a quota is used up.
    """
    try:
        yield
    except Exception as error:
        if not is_no_space(error):
            raise
        raise DiskFullError(
            message
            or f"no space left on the disk of {pathlib.Path(path).parent}; nothing half-"
            "written was kept, run the same command again with space to continue"
        ) from error


def is_no_space(error: BaseException) -> bool:
    """True if an error says that the disk is full or a quota is used up.

    Libraries in C++ keep the system's message but not its number.
    """
    numbers = (errno.ENOSPC, errno.EDQUOT)
    if isinstance(error, OSError) and error.errno in numbers:
        return True
    return any(os.strerror(number) in str(error) for number in numbers)


# Whose folder it is ------------------------------------------------------------------


def claim(
    path: str | os.PathLike[str],
    wanted: Mapping[str, Any],
    what: str,
    *,
    mend: str = "choose another folder, or delete that one",
    name: str = "",
    ignore: Collection[str] = (),
    renewed: Callable[[Any], Any] = lambda found: found,
) -> None:
    """Makes a folder the place of one job, or checks that it is this job's already.

    Args:
        path: JSON file in the folder, which says what the job is; written with its
            folder if there is none.
        wanted: What it must say, values that JSON has.
        what: Is in the folder where it says something else: "another projection".
        mend: What to do then.
        name: Of the whole, before the fields' names in the message.
        ignore: Fields that may differ.
        renewed: Brings what an earlier version wrote to the present form.

    Raises:
        UserError: The folder is another job's; names the fields that differ. Or it is
            a file.
        DataError: The JSON file is damaged.
    """
    path = pathlib.Path(path)
    if path.parent.is_file():
        raise UserError(f"{path.parent} is a file, expected a folder")
    try:
        found = renewed(read_json(path, dict[str, Any]))
    except FileNotFoundError:
        write_json(path, wanted)
        return
    require_same(
        {field: value for field, value in found.items() if field not in ignore},
        {field: value for field, value in wanted.items() if field not in ignore},
        f"{relative(path.parent)} holds {what}",
        mend=mend,
        name=name,
    )


def require_same(
    found: Mapping[str, Any],
    wanted: Mapping[str, Any],
    what: str,
    *,
    mend: str,
    name: str = "",
) -> None:
    """`UserError` "what: field is ... there and ... here; mend" where two differ."""
    if lines := differences(found, json.loads(json.dumps(wanted)), name):
        raise UserError(f"{what}: {'; '.join(lines)}; {mend}")


def differences(found: Any, wanted: Any, name: str = "config") -> list[str]:
    """What differs between two trees of values, as read from JSON: a line each."""
    if found == wanted:
        return []
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        return [
            line
            for key in sorted(set(found) | set(wanted))
            for line in differences(
                found.get(key), wanted.get(key), f"{name}.{key}".removeprefix(".")
            )
        ]
    if max(len(repr(found)), len(repr(wanted))) > _LONG:
        return [f"{name} differs"]
    return [f"{name} is {found!r} there and {wanted!r} here"]


@contextlib.contextmanager
def lock(path: str | os.PathLike[str], message: str | None = None) -> Iterator[None]:
    """Keeps other processes out of a block while one is in it.

    The system releases the lock however the process ends.

    Args:
        path: File that is locked; made with its folder if missing, and left there.
        message: Of the error; without one the process waits until it is let in.

    Raises:
        UserError: Another process holds it.
    """
    path = pathlib.Path(path)
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
    """A path as messages name it: from the current folder where it is below that."""
    here = pathlib.Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)
