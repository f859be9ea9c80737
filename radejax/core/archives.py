"""Readers of NumPy, zip and safetensors files that report corruption as a `DataError`."""

from __future__ import annotations

import contextlib
import errno
import zipfile
from collections.abc import Iterator

import numpy as np

from radejax.core.errors import DataError, one_line
from radejax.core.files import PathLike, as_path

_POINTER = b"version https://git-lfs"


@contextlib.contextmanager
def wrap_read_errors(where: PathLike, what: str) -> Iterator[None]:
    """Turns the errors of readers on corrupted files into a `DataError`.

    Args:
        where: Name of the file, or of a member of an archive, for the message.
        what: Description of the expected file, such as "a zip file".
    """
    try:
        yield
    except (DataError, FileNotFoundError):
        raise
    except Exception as error:  # on corrupted files, readers raise errors of any type
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            # An error of the file system, such as a missing permission. Only `open` names
            # the file.
            error.filename = error.filename or str(where)
            raise
        raise DataError(
            f"{where}: corrupted, not {what} ({type(error).__name__}: {one_line(error)})"
        ) from None


def read_member(archive: zipfile.ZipFile, name: str, *, max_bytes: int) -> bytes:
    """Reads a member of an archive and verifies its checksum.

    Args:
        archive: Archive that is open for reading.
        name: Name of the member.
        max_bytes: Largest valid size of the member.

    Raises:
        DataError: The member is corrupted, encrypted or larger.
    """
    where = f"{archive.filename}/{name}"
    with wrap_read_errors(where, "a readable member of a zip file"):
        info = archive.getinfo(name)
        if info.file_size > max_bytes:
            raise DataError(
                f"{where}: {info.file_size} bytes, expected at most {max_bytes}"
            )
        return archive.read(info)


def read_npy(path: PathLike, *, mapped: bool = False) -> np.ndarray:
    """Reads the array of a `.npy` file, which must not contain pickled objects.

    If `mapped`, only header and size of the file are read, and the array is a memory map.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted, or its size differs from that in its header.
    """
    with wrap_read_errors(path, "a NumPy array file"):
        array = np.load(as_path(path), mmap_mode="r", allow_pickle=False)
        size = as_path(path).stat().st_size
        expected = array.offset + array.nbytes
        if size != expected:
            raise DataError(f"{path}: corrupted, {size} bytes, expected {expected}")
        return array if mapped else np.array(array)


def read_npz(path: PathLike) -> dict[str, np.ndarray]:
    """Reads the arrays of a `.npz` file by name.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted.
    """
    with (
        wrap_read_errors(path, "a NumPy archive"),
        open(as_path(path), "rb") as file,  # NumPy would leave it open if reading fails
        np.load(file, allow_pickle=False) as arrays,
    ):
        return dict(arrays)


def check_not_pointer(path: PathLike) -> None:
    """Raises a `DataError` if a file is a pointer of Git LFS in place of the content."""
    with open(as_path(path), "rb") as file:
        if file.read(len(_POINTER)) == _POINTER:
            raise DataError(
                f"{path}: a pointer of Git LFS, not the file itself: run `git lfs pull` in "
                "its folder, or download the file"
            )


def read_safetensors(path: PathLike) -> dict[str, np.ndarray]:
    """Reads the arrays of a safetensors file by name.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted.
    """
    import safetensors.numpy  # only few users of this module need it

    check_not_pointer(path)
    with wrap_read_errors(path, "a safetensors file"):
        return safetensors.numpy.load_file(as_path(path))
