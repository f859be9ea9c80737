"""Frames of K-Radar's reduced releases: K-Radar's numbers, loops as a reference, bad input."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from radejax.core.errors import DataError
from radejax.data.kradar import reduced
from radejax.data.kradar.reduced import (
    EMPTY_LEVEL,
    is_reduced,
    project_reduced,
    reduce_tensor,
    strongest_points,
)
from radejax.data.kradar.tesseract import check_frame, read_frame
from radejax.data.projection import project_tensor
from radejax.geometry.radar_grid import RadarGrid

KRADAR = RadarGrid.kradar()
GRID = RadarGrid.reduced(num_doppler=8, num_range=20, num_elevation=5, num_azimuth=7)


def make_tensor(seed=0, grid=GRID):
    rng = np.random.default_rng(seed)
    return (1e9 * rng.standard_exponential(grid.shape_drea)).astype(np.float32)


def level_of(power):
    """The documented formula for a released power."""
    return (10 * np.log10(1e13 * power + 1e-10) + 1.2) / 184.3


def project_by_loops(power, doppler, grid, is_cell):
    """Projection of the cells of a mask."""
    num_doppler = grid.num_doppler
    level = level_of(power)
    projection = np.empty(grid.projection_shape)
    for r in range(grid.num_range):
        for a in range(grid.num_azimuth):
            empty = min(EMPTY_LEVEL, level[is_cell].min())
            if is_cell.all():
                empty = level[r, a].min()
            projection[r, a] = empty
            for e in range(grid.num_elevation):
                if is_cell[r, a, e]:
                    distance = np.abs(grid.doppler_mps - doppler[r, a, e])
                    d = int(distance.argmin())
                    old = projection[r, a, d]
                    projection[r, a, d] = max(old, level[r, a, e])
                    projection[r, a, num_doppler + e] = level[r, a, e]
    return projection


# K-Radar's numbers --------------------------------------------------------------------


@pytest.mark.parametrize("order", ["C", "F"])
def test_power_and_doppler_are_those_of_kradar(golden, order):
    stored = np.load(golden / "reduced_releases.npz")
    sizes = {"num_range": 20, "num_elevation": 2, "num_azimuth": 2}
    grid = RadarGrid.reduced(num_doppler=64, **sizes)
    grid = dataclasses.replace(grid, doppler_mps=KRADAR.doppler_mps)
    found = reduce_tensor(np.asarray(stored["tesseract"], order=order), grid)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found[0], stored["polar"][0], rtol=1e-12)
    np.testing.assert_allclose(found[1], stored["polar"][1], rtol=1e-10, atol=1e-12)


def test_points_are_at_the_bins_of_kradar(golden):
    stored = np.load(golden / "reduced_releases.npz")
    points = stored["points"]
    bins = reduced._bins_of_points(stored["points5"], KRADAR, "")
    np.testing.assert_array_equal(bins, points[:, 8:].T)
    columns = reduced._points_at(bins, KRADAR)
    np.testing.assert_allclose(columns, points[:, [0, 1, 2, 5, 6, 7]].T, atol=1e-12)
    level = project_reduced(points, KRADAR)[bins[0], bins[1], 64 + bins[2]]
    np.testing.assert_allclose(level, level_of(points[:, 3]), atol=1e-6)


# Numbers worked out by hand -----------------------------------------------------------


def test_an_echo_in_one_doppler_bin():
    tensor = np.full(GRID.shape_drea, 7e5, np.float32)
    tensor[0] = 1e15  # K-Radar leaves out the first Doppler bin
    tensor[6, 3, 2, 4] = 7e12
    polar = reduce_tensor(tensor, GRID)
    mean = (7e12 + 6 * 7e5) / 7
    assert polar[0, 3, 4, 2] == pytest.approx(mean / 1e13, rel=1e-6)
    assert polar[1, 3, 4, 2] == pytest.approx(GRID.doppler_mps[6], abs=1e-4)
    assert polar[1, 0, 0, 0] == pytest.approx(GRID.doppler_mps[1:].mean(), abs=1e-6)
    projection, full = project_reduced(polar, GRID), project_tensor(tensor[1:])
    strong = projection[3, 4]
    # An echo in one of seven bins is 10 log10(7) dB lower than its maximum.
    loss = 10 * np.log10(7) / 184.3
    assert strong[8 + 2] == pytest.approx(full[3, 4, 7 + 2] - loss, abs=1e-5)
    assert strong[6] == strong[8 + 2]
    assert strong[4] == pytest.approx(level_of(7e5 / 1e13), abs=1e-6)
    assert strong[[0, 1, 2, 3, 5, 7]] == pytest.approx(level_of(7e5 / 1e13), abs=1e-6)


def test_cells_without_power_have_no_doppler():
    tensor = make_tensor()
    tensor[:, 4, 1, 2] = 0.0
    polar = reduce_tensor(tensor, GRID)
    assert np.isnan(polar[1, 4, 2, 1])
    projection = project_reduced(polar, GRID)
    assert np.isfinite(projection).all()
    assert projection[4, 2, 8 + 1] == pytest.approx(level_of(0.0), abs=1e-6)


# An independent reference, and laws ----------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_projection_agrees_with_loops(dtype):
    power, doppler = polar = reduce_tensor(make_tensor(), GRID)
    everything = np.ones(power.shape, bool)
    expected = project_by_loops(power, doppler, GRID, everything)
    found = project_reduced(polar.astype(dtype), GRID)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert found.dtype == np.float32


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 10**6), st.floats(0.01, 0.99))
def test_points_agree_with_loops_in_both_layouts(seed, rate):
    power, doppler = polar = reduce_tensor(make_tensor(seed), GRID)
    points = strongest_points(polar, GRID, rate)
    assert abs(len(points) - rate * power.size) <= 1
    if len(points) == 0:
        return
    is_point = np.zeros(power.shape, bool)
    is_point[tuple(points[:, 8:].T.astype(int))] = True
    assert power[is_point].min() > power[~is_point].max()
    expected = project_by_loops(power, doppler, GRID, is_point)
    np.testing.assert_allclose(project_reduced(points, GRID), expected, atol=1e-6)
    older = points[:, :5]
    is_ahead = older[:, :3].any(axis=1)
    assert is_ahead.all() == (points[:, 8] > 0).all()
    if is_ahead.any():
        expected = project_reduced(points[is_ahead], GRID)
        np.testing.assert_array_equal(project_reduced(older, GRID), expected)


def test_noise_lies_below_its_maximum_by_the_documented_shift():
    grid = dataclasses.replace(GRID, doppler_mps=KRADAR.doppler_mps)
    tensor = make_tensor(grid=grid)
    mean = project_reduced(reduce_tensor(tensor, grid), grid)[..., 64:].mean()
    of_maxima = project_tensor(tensor)[..., 64:].mean()
    assert of_maxima - mean == pytest.approx(0.037, abs=0.002)


def test_arrays_are_recognized_by_shape():
    polar = reduce_tensor(make_tensor(), GRID)
    assert is_reduced(polar, GRID)
    assert is_reduced(strongest_points(polar, GRID, 0.1), GRID)
    assert not is_reduced(make_tensor(), GRID)
    assert not is_reduced(project_tensor(make_tensor()), GRID)
    assert not is_reduced(np.stack([project_tensor(make_tensor())] * 2), GRID)


# Bad input ----------------------------------------------------------------------------


def _polar():
    return reduce_tensor(make_tensor(), GRID)


def _points(columns=11):
    return strongest_points(_polar(), GRID, 0.1)[:, :columns]


def _with(array, index, value):
    array[index] = value
    return array


_SCALE = "expected linear power (not decibels) divided by 1e+13"
BAD = {
    "elevation before azimuth": (
        lambda: _polar().swapaxes(2, 3),
        "shape (2, 20, 5, 7) of float64, expected float64 or float32 [power and Doppler, "
        "range, azimuth, elevation] = (2, 20, 7, 5), or points [N, 11] or [N, 5]",
    ),
    "no points": (lambda: _points()[:0], "shape (0, 11)"),
    "raw power": (lambda: _polar() * [[[[1e13]]], [[[1]]]], _SCALE),
    "zeros": (lambda: _with(_polar(), np.s_[0, :5], 0), "25% of them 0"),
    "NaN": (lambda: _with(_polar(), np.s_[0, 3, 2, 1], np.nan), "powers from nan"),
    "bin of NaN": (lambda: _with(_points(), np.s_[3, 9], np.nan), "point 3 has"),
    "position outside": (lambda: _points(5) * [3, 3, 3, 1, 1], "which is not a point"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_frames_are_one_clear_line(name, tmp_path):
    make, message = BAD[name]
    path = tmp_path / "polar3d_00001.npy"
    np.save(path, make())
    with pytest.raises(DataError) as error:
        read_frame(path, GRID)
    assert str(error.value).startswith(f"{path}: ")
    assert message in str(error.value)


def test_the_head_shows_shape_and_type(tmp_path):
    path = tmp_path / "rpc_00001.npy"
    np.save(path, _points())
    check_frame(path, GRID)
    np.save(path, _points(4))
    with pytest.raises(DataError, match="Cartesian"):
        check_frame(path, GRID)
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(DataError, match="corrupted"):
        check_frame(path, GRID)
