"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pathlib
from collections.abc import Iterator
from typing import IO, Any

from radejax.core.errors import DataError, DiskFullError


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[IO[bytes]]:
    """An open binary file that becomes `path` when the block ends without an error.

    Missing parent folders are made. After an error or a kill `path` is what it was;
    the error also removes the temporary file.

    Raises:
        DiskFullError: No space is left on the disk.
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if is_no_space(error):
            raise no_space_error(path) from error
        raise


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """As `atomic_write` for libraries that want a path: a temporary one to write to.

    Raises:
        DiskFullError: No space is left on the disk; what was written is removed.
    """
    path = pathlib.Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if is_no_space(error):
            raise no_space_error(path) from error
        raise


def is_no_space(error: BaseException) -> bool:
    """True if an error says that the disk is full or a quota is used up.

    Libraries in C++ keep the system's message but not its number.
    """
    numbers = (errno.ENOSPC, errno.EDQUOT)
    if isinstance(error, OSError) and error.errno in numbers:
        return True
    return any(os.strerror(number) in str(error) for number in numbers)


def no_space_error(path: str | os.PathLike) -> DiskFullError:
    """The one-line error for a full disk or an exhausted quota."""
    return DiskFullError(
        f"no space left on the disk of {pathlib.Path(path).parent}; nothing half-"
        "written was kept, run the same command again with space to continue"
    )


def write_text(path: str | os.PathLike, text: str) -> None:
    """Writes a text file atomically."""
    with atomic_write(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Writes plain values as JSON, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def read_json(path: str | os.PathLike) -> Any:
    """Reads a JSON file.

    Raises:
        FileNotFoundError: Names the file.
        DataError: The file is not valid JSON; names it and the place.
    """
    try:
        return json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path} is not valid JSON: {error}") from error
