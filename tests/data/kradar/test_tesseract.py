import io
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


@pytest.fixture
def tesseract():
    rng = np.random.default_rng(0)
    return (10 ** rng.uniform(2, 15, SHAPE)).astype(np.float32)


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


def test_integers_are_read(tmp_path):
    scipy.io.savemat(tmp_path / "t.mat", {"arrDREA": np.ones(SHAPE, np.uint8)})
    assert project_file(tmp_path / "t.mat").shape == (6, 5, 7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keep", [0, 3, 100, 150, 199, 250, -1])
def test_truncated_files_are_named(tmp_path, tesseract, kind, keep):
    path = tmp_path / "t.mat"
    write(path, tesseract, kind)
    path.write_bytes(path.read_bytes()[:keep])
    for read in (read_tesseract, project_file):
        with pytest.raises(
            DataError, match=r"t\.mat: (not a MATLAB|corrupted|trunc|no arrDREA)"
        ):
            read(path)


def read_or_damage(path, shape_drea=None):
    try:
        return read_tesseract(path, shape_drea=shape_drea)
    except DataError as error:
        assert path.name in str(error)  # noqa: PT017  names the file
        return None


@pytest.mark.parametrize("kind", ["plain", "compressed", "two variables"])
def test_a_flipped_bit_is_found_or_changes_no_number(tmp_path, tesseract, kind):
    path = tmp_path / "t.mat"
    write(path, tesseract, kind)
    content = path.read_bytes()
    # All bits of the tags and, where there is a checksum, a thousand of the numbers.
    end = content.find(tesseract.tobytes(order="F"))
    bits = list(range(8 * (end if end > 0 else 200)))
    if kind == "compressed":
        bits += (
            np.random.default_rng(1)
            .choice(np.arange(bits[-1] + 1, 8 * len(content)), 1000, replace=False)
            .tolist()
        )
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
    scipy.io.savemat(path, {"arrDREA": np.zeros((64, 64, 32, 32))}, do_compression=True)
    content = path.read_bytes()
    raw = bytearray(zlib.decompress(content[136:]))
    bomb = zlib.compress(bytes(raw) + bytes(1 << 26))
    path.write_bytes(content[:132] + struct.pack("<I", len(bomb)) + bomb)
    with pytest.raises(DataError, match="does not inflate to"):
        read_tesseract(path)
    with pytest.raises(DataError, match=r"expected \("):
        read_tesseract(path, shape_drea=SHAPE)


def test_v73_files_say_what_to_do(tmp_path):
    path = tmp_path / "t.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(384))
    with pytest.raises(DataError, match="not a MATLAB v5 file; save it in v7 or v6"):
        read_tesseract(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e4])
def test_impossible_power_is_damage(tmp_path, tesseract, value):
    path = tmp_path / "t.mat"
    tesseract[:, 2, :, 3] = value
    write(path, tesseract, "plain")
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(
            DataError,
            match="not linear power: some values are negative, infinite or NaN",
        ),
    ):
        project_file(path)


@pytest.mark.parametrize("layout", ["plain", "compressed"])
def test_values_that_are_no_power_are_named(tmp_path, tesseract, layout):
    path = tmp_path / "t.mat"
    write(path, 10 * np.log10(tesseract), layout)
    with pytest.raises(
        DataError, match=r"t\.mat: .* between 1 and 300, as in decibels"
    ):
        check_frame(path, GRID, deep=True)
    tesseract[..., tesseract.shape[3] // 3 :] = 0  # as in a file that is copied in part
    write(path, tesseract, layout)
    for read in (project_file, lambda path: read_polar(path, GRID)):
        with pytest.raises(
            DataError, match=r"80% of the beams have a power of exactly"
        ):
            read(path)


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


def test_wrong_content_is_named(tmp_path, tesseract):
    path = tmp_path / "t.mat"
    scipy.io.savemat(path, {"arrREA": np.ones((2, 2))})
    with pytest.raises(DataError, match=r"no arrDREA in it, only \['arrREA'\]"):
        read_tesseract(path)
    scipy.io.savemat(path, {"arrDREA": np.ones((2, 2))})
    with pytest.raises(DataError, match=r"shape \(2, 2\), expected four"):
        project_file(path)
    scipy.io.savemat(path, {"arrDREA": tesseract * 1j})
    with pytest.raises(DataError, match="flags 0x807, expected real"):
        read_tesseract(path)
    write(path, tesseract, "plain")
    other = RadarGrid.reduced(
        num_doppler=4, num_range=6, num_elevation=3, num_azimuth=6
    )
    for deep in (False, True):
        with pytest.raises(DataError, match=r"expected \(4, 6, 3, 6\)"):
            check_frame(path, other, deep=deep)
    for read in (read_tesseract, project_file):
        with pytest.raises(DataError, match=r"expected \(1, 2, 3, 4\)"):
            read(path, shape_drea=(1, 2, 3, 4))
        with pytest.raises(FileNotFoundError, match=r"none\.mat"):
            read(tmp_path / "none.mat")
        with pytest.raises(IsADirectoryError):
            read(tmp_path)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_released_projections(tmp_path, tesseract, dtype):
    path = tmp_path / "DERA_tesseract_00001.npy"
    wanted = project_tensor(tesseract).astype(dtype)
    np.save(path, wanted.transpose(2, 0, 1))
    found = read_projection_npy(path, projection_shape=(6, 5, 7))
    np.testing.assert_array_equal(found, wanted)
    assert found.dtype == dtype
    message = r"shape \(7, 6, 5\) of float\d\d, expected floats .* = \(8, 6, 5\), or \(6, 5, 8\)"
    with pytest.raises(DataError, match=message):
        read_projection_npy(path, projection_shape=(6, 5, 8))
    np.save(path, wanted)  # channels last
    found = read_projection_npy(path, projection_shape=(6, 5, 7))
    np.testing.assert_array_equal(found, wanted)
    check_frame(path, GRID)
    np.save(path, tesseract)
    for deep in (False, True):
        with pytest.raises(DataError, match="it seems to be a radar tensor"):
            check_frame(path, GRID, deep=deep)


def test_bad_released_projections(tmp_path):
    path = tmp_path / "p.npy"
    for value in (np.nan, -np.inf, 1e38):
        np.save(path, np.where(np.arange(210).reshape(7, 6, 5) == 9, value, 0.5))
        with pytest.raises(DataError, match="1 of 210 values are not finite or beyond"):
            read_projection_npy(path)
    np.save(path, np.where(np.arange(210).reshape(7, 6, 5) < 21, 0.0, 0.5))
    with pytest.raises(DataError, match="10% of the values are exactly 0"):
        read_projection_npy(path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"p\.npy"):
        read_projection_npy(path)
    np.save(path, np.ones((7, 6, 5), np.int32))
    with pytest.raises(DataError, match="expected floats"):
        read_projection_npy(path)
    np.save(path, np.ones((7, 6, 5)))
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(DataError, match=r"p\.npy: corrupted"):
        read_projection_npy(path)
    path.write_bytes(b"")
    with pytest.raises(DataError, match=r"p\.npy: corrupted"):
        read_projection_npy(path)
    np.save(path, np.array([{}], object))
    with pytest.raises(DataError, match=r"p\.npy: corrupted"):
        read_projection_npy(path)


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
