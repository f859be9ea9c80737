import io

import h5py
import numpy as np
import pytest
import scipy.io

from radejax.core.errors import DataError
from radejax.data.kradar.write import write_tesseract
from radejax.data.projection import project
from radejax.data.tesseract import (
    _read_slabs,
    check_tesseract,
    project_file,
    read_projection_npy,
    read_tesseract,
)

SHAPE = (4, 6, 3, 5)


@pytest.fixture
def tesseract():
    rng = np.random.default_rng(0)
    return (10 ** rng.uniform(2, 15, SHAPE)).astype(np.float32)


def write(path, tesseract, kind):
    if kind == "v7.3":
        with h5py.File(path, "w", userblock_size=512) as file:
            file["arrDREA"] = tesseract.T
        with open(path, "r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    elif kind == "two variables":
        scipy.io.savemat(path, {"other": np.ones(3), "arrDREA": tesseract})
    else:
        write_tesseract(path, tesseract, compress=kind == "compressed")


KINDS = ["plain", "compressed", "v7.3", "two variables"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_kind_of_file(tmp_path, tesseract, kind, dtype):
    path = tmp_path / "t.mat"
    write(path, tesseract.astype(dtype), kind)
    found = read_tesseract(path, shape_drea=SHAPE)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, tesseract)
    timings = {"reading": 0.0}
    projection = project_file(path, shape_drea=SHAPE, timings=timings)
    np.testing.assert_array_equal(projection, project(tesseract.astype(dtype)))
    assert timings["reading"] > 0
    check_tesseract(path, shape_drea=SHAPE)
    check_tesseract(path, shape_drea=SHAPE, deep=True)


def test_integers_are_read_by_scipy(tmp_path, tesseract):
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
            DataError, match=r"t\.mat: (the file is empty|damaged|trunc|no arrDREA)"
        ):
            read(path)


def test_flipped_bytes_are_found_where_files_have_checksums(tmp_path, tesseract):
    path = tmp_path / "t.mat"
    write(path, tesseract, "compressed")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"t\.mat: damaged"):
        project_file(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e4])
def test_impossible_power_is_damage(tmp_path, tesseract, value):
    path = tmp_path / "t.mat"
    tesseract[:, 2, :, 3] = value
    write(path, tesseract, "plain")
    with (
        np.errstate(invalid="ignore"),
        pytest.raises(DataError, match="negative or non-finite power"),
    ):
        project_file(path)


def test_wrong_content_is_named(tmp_path, tesseract):
    path = tmp_path / "t.mat"
    scipy.io.savemat(path, {"arrREA": np.ones((2, 2))})
    with pytest.raises(DataError, match=r"no arrDREA in it, only \['arrREA'\]"):
        read_tesseract(path)
    scipy.io.savemat(path, {"arrDREA": np.ones((2, 2))})
    with pytest.raises(DataError, match=r"shape \(2, 2\) of float64, expected real"):
        project_file(path)
    scipy.io.savemat(path, {"arrDREA": tesseract * 1j})
    with pytest.raises(DataError, match="of complex64, expected real"):
        read_tesseract(path)
    write(path, tesseract, "plain")
    for read in (read_tesseract, project_file, check_tesseract):
        with pytest.raises(DataError, match=r"grid demands \(1, 2, 3, 4\)"):
            read(path, shape_drea=(1, 2, 3, 4))
        with pytest.raises(FileNotFoundError, match=r"none\.mat: no such tesseract"):
            read(tmp_path / "none.mat")
        with pytest.raises(DataError, match="is a folder"):
            read(tmp_path)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_released_projections(tmp_path, tesseract, dtype):
    path = tmp_path / "DERA_tesseract_00001.npy"
    wanted = project(tesseract, dtype=dtype)
    np.save(path, wanted.transpose(2, 0, 1))
    found = read_projection_npy(path, projection_shape=(6, 5, 7))
    np.testing.assert_array_equal(found, wanted)
    assert found.dtype == dtype
    with pytest.raises(
        DataError, match=r"shape \(7, 6, 5\), the .* demands \(8, 6, 5\)"
    ):
        read_projection_npy(path, projection_shape=(6, 5, 8))


def test_bad_released_projections(tmp_path):
    path = tmp_path / "p.npy"
    with pytest.raises(FileNotFoundError, match="no such projection"):
        read_projection_npy(path)
    np.save(path, np.ones((7, 6, 5), np.int32))
    with pytest.raises(DataError, match="expected floats"):
        read_projection_npy(path)
    np.save(path, np.ones((7, 6, 5)))
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(DataError, match=r"p\.npy: damaged"):
        read_projection_npy(path)
    path.write_bytes(b"")
    with pytest.raises(DataError, match=r"p\.npy: damaged"):
        read_projection_npy(path)
    np.save(path, np.array([{}], object))
    with pytest.raises(DataError, match=r"p\.npy: damaged"):
        read_projection_npy(path)


class Dribble(io.BytesIO):
    """A file that returns a few bytes at a time, as network file systems may."""

    def readinto(self, buffer):
        return super().readinto(memoryview(buffer)[:7])


def test_slabs_of_a_file_that_returns_parts(tesseract):
    content = np.asfortranarray(tesseract).tobytes(order="F")
    slab = np.empty(SHAPE[2::-1], np.float32)
    slabs = _read_slabs(Dribble(content), slab, SHAPE[3], {"reading": 0.0})
    found = np.stack([column.copy() for column in slabs])  # [A, E, R, D]
    np.testing.assert_array_equal(found.T, tesseract)
    short = _read_slabs(Dribble(content[:-3]), slab, SHAPE[3], {"reading": 0.0})
    with pytest.raises(EOFError, match="the file ends in column 4 of 5"):
        list(short)
