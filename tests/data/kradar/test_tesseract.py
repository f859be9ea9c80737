import functools
import io
import random
import re
import struct
import zlib

import numpy as np
import pytest
import scipy.io

from radejax.core.errors import DataError
from radejax.data.kradar.tesseract import (
    Layout,
    _read_columns,
    check_frame,
    project_file,
    read_polar,
    read_projection_npy,
    read_tesseract,
)
from radejax.data.kradar.write import write_tesseract
from radejax.data.projection import project_tensor
from radejax.geometry.radar_grid import RadarGrid

SHAPE = (4, 6, 3, 5)
GRID = RadarGrid.reduced(num_doppler=4, num_range=6, num_elevation=3, num_azimuth=5)


TESSERACT = (10 ** np.random.default_rng(0).uniform(2, 15, SHAPE)).astype(np.float32)


@pytest.fixture
def tesseract():
    return TESSERACT.copy()


def write(path, tesseract, kind):
    if kind == "two variables":
        scipy.io.savemat(path, {"other": np.ones(3), "arrDREA": tesseract})
    else:
        write_tesseract(path, tesseract, compress=kind == "compressed")


KINDS = ["plain", "compressed", "two variables"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_kind_of_file(tmp_path, tesseract, kind, dtype):
    path = tmp_path / "t.mat"
    write(path, tesseract.astype(dtype), kind)
    found = read_tesseract(path, shape_drea=SHAPE)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, tesseract)
    projection = project_file(path, shape_drea=SHAPE)
    np.testing.assert_array_equal(projection, project_tensor(tesseract.astype(dtype)))
    check_frame(path, GRID)
    check_frame(path, GRID, deep=True)


def read_or_damage(path, shape_drea=None):
    try:
        return read_tesseract(path, shape_drea=shape_drea)
    except DataError as error:
        assert path.name in str(error)  # noqa: PT017  names the file
        return None


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_is_found_or_changes_no_number(tmp_path, tesseract, kind):
    path = tmp_path / "t.mat"
    write(path, tesseract, kind)
    content = path.read_bytes()
    # All bits of the tags and, where there is a checksum, a thousand of the numbers.
    end = content.find(tesseract.tobytes(order="F"))
    bits = list(range(8 * (end if end > 0 else 200)))
    if kind == "compressed":
        bits += random.Random(1).sample(range(bits[-1] + 1, 8 * len(content)), 1000)
    num_found = 0
    for bit in bits:
        with open(path, "r+b") as file:
            file.seek(bit // 8)
            file.write(bytes([content[bit // 8] ^ 1 << bit % 8]))
        found = read_or_damage(path)
        with open(path, "r+b") as file:
            file.seek(bit // 8)
            file.write(content[bit // 8 : bit // 8 + 1])
        num_found += found is None
        if found is not None:
            np.testing.assert_array_equal(found, tesseract, err_msg=f"bit {bit}")
    # The text of 124 bytes, flags without meaning and names of others may change.
    assert num_found > len(bits) - 8 * (124 + 8 + 64)


def test_small_integers_of_floats_are_read(tmp_path):
    """MATLAB saves floats that are whole numbers as integers."""
    path = tmp_path / "t.mat"
    whole = np.arange(360, dtype=np.uint16).reshape(SHAPE)
    scipy.io.savemat(path, {"arrDREA": whole})
    content = bytearray(path.read_bytes())
    content[144] = 7  # the class says single, the numbers are uint16
    path.write_bytes(content)
    np.testing.assert_array_equal(read_tesseract(path), whole)
    np.testing.assert_array_equal(scipy.io.loadmat(path)["arrDREA"], whole)
    np.testing.assert_array_equal(project_file(path), project_tensor(whole))


def test_no_more_is_inflated_than_is_claimed(tmp_path):
    path = tmp_path / "t.mat"
    scipy.io.savemat(path, {"arrDREA": np.zeros((64, 64, 8, 8))}, do_compression=True)
    content = path.read_bytes()
    raw = bytearray(zlib.decompress(content[136:]))
    bomb = zlib.compress(bytes(raw) + bytes(1 << 24), 1)
    path.write_bytes(content[:132] + struct.pack("<I", len(bomb)) + bomb)
    with pytest.raises(DataError, match="does not inflate to"):
        read_tesseract(path)
    with pytest.raises(DataError, match=r"expected \("):
        read_tesseract(path, shape_drea=SHAPE)


def test_a_shape_of_unsigned_integers(tmp_path, tesseract):
    path = tmp_path / "t.mat"
    write(path, tesseract, "plain")
    content = path.read_bytes()
    tag, shape = struct.pack("<I", 16), struct.pack("<4i", *tesseract.shape)
    assert content.count(struct.pack("<I", 5) + tag + shape) == 1
    unsigned = struct.pack("<I", 6) + tag + shape
    path.write_bytes(content.replace(struct.pack("<I", 5) + tag + shape, unsigned))
    np.testing.assert_array_equal(scipy.io.loadmat(path)["arrDREA"], tesseract)
    np.testing.assert_array_equal(read_tesseract(path), tesseract)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_released_projections(tmp_path, tesseract, dtype):
    path = tmp_path / "DERA_tesseract_00001.npy"
    wanted = project_tensor(tesseract).astype(dtype)
    np.save(path, wanted.transpose(2, 0, 1))
    found = read_projection_npy(path, (6, 5, 7))
    np.testing.assert_array_equal(found, wanted)
    assert found.dtype == dtype
    np.save(path, wanted)  # channels last
    found = read_projection_npy(path, (6, 5, 7))
    np.testing.assert_array_equal(found, wanted)
    check_frame(path, GRID)


def with_values(rows, value):
    """The tensor with another value in some rows of its first axis."""
    array = TESSERACT.copy()
    array[rows] = value
    return array


PROJECTION = np.full((7, 6, 5), 0.5)
NO_POWER = "not linear power: some values are negative, infinite or NaN"
WRONG = {
    "other name": ({"arrREA": np.ones((2, 2))}, r"no arrDREA in it, only \['arrREA'\]"),
    "two axes": ({"arrDREA": np.ones((2, 2))}, r"shape \(2, 2\), expected \(4, 6, 3, 5"),
    "one azimuth less": (TESSERACT[..., :4], r"expected \(4, 6, 3, 5\)"),
    "NaN": (with_values(np.s_[:, 2, :, 3], np.nan), NO_POWER),
    "decibels": (10 * np.log10(TESSERACT), "between 1 and 300, as in decibels"),
    "copied in part": (with_values(np.s_[..., 1:], 0), "more than 5% of the beams have a power of"),
    "tensor.npy": (TESSERACT, "it seems to be a radar tensor"),
    "NaN.npy": (np.where(np.arange(7)[:, None, None] < 1, np.nan, PROJECTION), "30 of 210"),
    "zeros.npy": (np.where(np.arange(210).reshape(7, 6, 5) < 21, 0.0, 0.5), "10% of the"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_named(tmp_path, name):
    content, message = WRONG[name]
    path = tmp_path / (name if name.endswith(".npy") else "t.mat")
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        scipy.io.savemat(path, content)
    elif path.suffix == ".npy":
        np.save(path, content)
    else:
        write_tesseract(path, content)
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(DataError, match=rf"{re.escape(path.name)}.*{message}"),
    ):
        check_frame(path, GRID, deep=True)
    if name in ("one azimuth less", "shape.npy", "tensor.npy"):  # the header shows it
        with pytest.raises(DataError, match=message):
            check_frame(path, GRID)
    if name == "copied in part":
        with pytest.raises(DataError, match=message):
            read_polar(path, GRID)


@pytest.mark.parametrize(
    "read",
    [
        read_tesseract,
        project_file,
        functools.partial(read_projection_npy, projection_shape=(6, 5, 7)),
    ],
)
def test_missing_files_keep_their_error(tmp_path, read):
    with pytest.raises(FileNotFoundError, match=r"none\.mat"):
        read(tmp_path / "none.mat")
    with pytest.raises(IsADirectoryError):
        read(tmp_path)


class Dribble(io.BytesIO):
    """A file that returns a few bytes at a time, as network file systems may."""

    def readinto(self, buffer):
        return super().readinto(memoryview(buffer)[:7])


@pytest.mark.wrong_types
def test_columns_of_a_file_that_returns_parts(tesseract):
    content = np.asfortranarray(tesseract).tobytes(order="F")
    layout = Layout(tesseract.dtype, SHAPE, 0, None, len(content))
    columns = _read_columns(Dribble(content), layout)
    found = np.stack([column.copy() for column in columns])  # [A, E, R, D]
    np.testing.assert_array_equal(found.T, tesseract)
    with pytest.raises(EOFError, match="the file ends in column 4"):
        list(_read_columns(Dribble(content[:-3]), layout))
