"""NumPy, zip and safetensors files, whose corruption is one error that names the file."""

from __future__ import annotations

import contextlib
import errno
import os
import zipfile
from collections.abc import Iterator

import numpy as np

from radejax.core.errors import DataError, one_line
from radejax.core.files import PathLike


@contextlib.contextmanager
def wrap_read_errors(where: PathLike, what: str) -> Iterator[None]:
    """Turns what readers raise on corrupted files into a `DataError`.

    Args:
        where: File, or member of one.
        what: What it should be, such as "a zip file".
    """
    try:
        yield
    except (DataError, FileNotFoundError):
        raise
    except Exception as error:  # readers raise whatever a corrupted byte leads to
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise  # of the file system: no such file, no permission, a failing disk
        raise DataError(
            f"{where}: corrupted, not {what} ({type(error).__name__}: {one_line(error)})"
        ) from None


def read_member(archive: zipfile.ZipFile, name: str, *, max_bytes: int) -> bytes:
    """Content of a member of an archive; its checksum is verified.

    Args:
        archive: Open for reading.
        name: Name of the member.
        max_bytes: What a member of this kind can have at most.

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


def read_npy(path: PathLike) -> np.ndarray:
    """The array of a `.npy` file, without pickles.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: The file is corrupted, or its size is not what its header says.
    """
    with wrap_read_errors(path, "a NumPy array file"):
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        size, expected = os.path.getsize(path), array.offset + array.nbytes
        if size != expected:
            raise DataError(f"{path}: corrupted, {size} bytes, expected {expected}")
        return np.array(array)


def read_npz(path: PathLike) -> dict[str, np.ndarray]:
    """The arrays of a `.npz` file by name; errors as `read_npy`."""
    with (
        wrap_read_errors(path, "a NumPy archive"),
        open(path, "rb") as file,  # NumPy leaves a file open that it fails to read
        np.load(file, allow_pickle=False) as arrays,
    ):
        return dict(arrays)


def read_safetensors(path: PathLike) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file by name; errors as `read_npy`."""
    import safetensors.numpy  # few of the callers of this module need it

    with wrap_read_errors(path, "a safetensors file"):
        return safetensors.numpy.load_file(path)
