"""Zip archives and NumPy's files, read no further than their own bytes reach.

What a file claims (sizes, shapes, methods) is compared with what it has before memory is
taken for it; whatever the standard readers raise on damage becomes a `DataError`.
"""

from __future__ import annotations

import ast
import contextlib
import io
import math
import operator
import os
import pathlib
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator

import numpy as np

from radejax.core.errors import DataError, one_line
from radejax.core.files import PathLike

DEFLATE_RATIO = 1032
"""Bytes that deflate makes of one byte at most."""

_LENGTHS = {(1, 0): struct.Struct("<H"), (2, 0): struct.Struct("<I")}
_MAX_HEADER = 10_000  # NumPy's own limit

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    tokenize.TokenError,
    OSError,
    EOFError,
    ValueError,  # UnicodeDecodeError, and NumPy's own
    SyntaxError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,  # of the parser of nested headers; sizes are compared before
    RecursionError,
    RuntimeError,  # encrypted; NotImplementedError: features of zip
)


@contextlib.contextmanager
def damage_named(where: PathLike, what: str) -> Iterator[None]:
    """Turns what readers raise on damaged files into a `DataError`.

    Args:
        where: File, or member of one.
        what: It should be, such as "a zip file".
    """
    try:
        yield
    except (DataError, FileNotFoundError, PermissionError):
        raise
    except _DAMAGE as error:
        raise DataError(
            f"{where}: damaged, not {what} ({type(error).__name__}: {one_line(error)})"
        ) from None


@contextlib.contextmanager
def open_zip(path: PathLike, what: str = "a zip file") -> Iterator[zipfile.ZipFile]:
    """A zip archive for reading; `DataError` that it is not `what`, where damaged."""
    with contextlib.ExitStack() as stack:
        with damage_named(path, what):
            archive = stack.enter_context(zipfile.ZipFile(path))
        yield archive


def read_member(archive: zipfile.ZipFile, name: str, *, max_bytes: int) -> bytes:
    """Content of a member of an archive.

    Args:
        archive: Open for reading.
        name: Of the member.
        max_bytes: What a member of this kind can have at most.

    Raises:
        DataError: It is damaged, larger, encrypted, or of another method than stored
            and deflated (whose decoders take memory without a bound).
    """
    where = f"{archive.filename}/{name}"
    with damage_named(where, "a readable member of a zip file"):
        info = archive.getinfo(name)
        if info.flag_bits & 1:
            raise DataError(f"{where}: is encrypted, expected a plain zip file")
        if info.compress_type not in _METHODS:
            raise DataError(
                f"{where}: compressed by method {info.compress_type}, expected stored "
                "(0) or deflated (8): zip it again"
            )
        possible = min(max_bytes, DEFLATE_RATIO * max(info.compress_size, 1))
        if info.file_size > possible:
            raise DataError(
                f"{where}: claims {info.file_size} bytes, expected at most {possible}"
            )
        with archive.open(info) as member:
            content = member.read(info.file_size + 1)
        if len(content) != info.file_size:
            raise DataError(
                f"{where}: damaged, {len(content)} bytes in place of {info.file_size}"
            )
        return content


def read_npy(path: PathLike) -> np.ndarray:
    """The array of a `.npy` file, without pickles.

    Raises:
        FileNotFoundError: There is no such file.
        DataError: It is damaged, or its size is not what its header claims.
    """
    with damage_named(path, "a NumPy array file"), open(path, "rb") as file:
        dtype, shape, is_fortran = _read_header(file, path)
        needed, left = dtype.itemsize * math.prod(shape), os.path.getsize(path)
        if left - file.tell() != needed:
            raise DataError(
                f"{path}: damaged, {left - file.tell()} bytes of numbers, shape "
                f"{shape} of {dtype} has {needed}"
            )
        numbers = np.fromfile(file, dtype, count=math.prod(shape))
        return numbers.reshape(shape, order="F" if is_fortran else "C")


def read_npz(path: PathLike) -> dict[str, np.ndarray]:
    """The arrays of a `.npz` file by name; errors as `read_npy`."""
    if not pathlib.Path(path).exists():
        raise FileNotFoundError(f"{path}: no such file")
    arrays = {}
    with open_zip(path, "a readable .npz file") as archive:
        limit = DEFLATE_RATIO * os.path.getsize(path)
        for name in archive.namelist():
            where = f"{path}/{name}"
            content = io.BytesIO(read_member(archive, name, max_bytes=limit))
            limit -= len(content.getvalue())  # members may not share their bytes
            with damage_named(where, "a NumPy array"):
                dtype, shape, is_fortran = _read_header(content, where)
                numbers = np.frombuffer(content.getbuffer()[content.tell() :], dtype)
                array = numbers.reshape(shape, order="F" if is_fortran else "C")
                arrays[name.removesuffix(".npy")] = array
    return arrays


def read_safetensors(path: PathLike) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file by name; errors as `read_npy`."""
    import safetensors.numpy  # by few of those who read archives

    with damage_named(path, "a safetensors file"):
        try:
            return safetensors.numpy.load_file(path)
        except safetensors.SafetensorError as error:
            raise ValueError(error) from None


def _read_header(
    file: io.BufferedIOBase, where: PathLike
) -> tuple[np.dtype, tuple[int, ...], bool]:
    """Type, shape and memory order; leaves the file at the first number."""
    version = np.lib.format.read_magic(file)
    if version not in _LENGTHS:
        raise DataError(f"{where}: NumPy's format {version}, expected 1.0 or 2.0")
    length = _LENGTHS[version]
    (size,) = length.unpack(file.read(length.size))
    if size > _MAX_HEADER:
        raise DataError(f"{where}: header of {size} bytes, at most {_MAX_HEADER}")
    # NumPy's own reader mends headers of Python 2 with a warning, which is no error.
    header = ast.literal_eval(file.read(size).decode("latin1").strip())
    if set(header) != {"descr", "fortran_order", "shape"}:
        raise DataError(f"{where}: damaged, header {one_line(str(header))}")
    dtype = np.lib.format.descr_to_dtype(header["descr"])
    is_fortran = bool(header["fortran_order"])
    shape = tuple(operator.index(size) for size in header["shape"])
    if dtype.hasobject or dtype.itemsize == 0 or min(shape, default=0) < 0:
        raise DataError(
            f"{where}: damaged, shape {shape} of {dtype}, expected an array of numbers "
            "or text"
        )
    return dtype, shape, is_fortran
