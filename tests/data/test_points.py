"""CFAR points of maps with known results."""

import numpy as np
import pytest

from radejax.core.errors import DataError, UserError
from radejax.data.kradar import points as kradar_points
from radejax.data.kradar import reduced
from radejax.data.kradar.points import POINT_FIELDS, read_lidar, read_points
from radejax.data.kradar.reduced import reduce_tensor, strongest_points
from radejax.data.kradar.write import write_tesseract
from radejax.data.points import cfar_points, local_mean_db, percentile_points
from radejax.data.projection import project_tensor
from radejax.geometry.radar_grid import RadarGrid

from .. import small_models as small

GRID = RadarGrid.reduced(
    num_doppler=8, num_range=64, num_elevation=5, num_azimuth=56, max_range_m=75.6
)


def test_local_mean_by_hand():
    power = np.full((7, 7), 1.0)
    power[3, 3] = 1000.0  # in the guard: does not count
    power[1, 3] = 17.0  # one of 16 training cells: mean (15 + 17) / 16 = 2
    mean = local_mean_db(10 * np.log10(power), 1, 1)
    assert mean[3, 3] == pytest.approx(10 * np.log10(2.0))


def test_points_are_where_the_echoes_are():
    power = np.full(GRID.shape_drea, 1e9, np.float32)
    power[6, 30, 4, 40] = 1e13
    power[1, 50, 0, 10] = 1e12
    points = cfar_points(project_tensor(power), GRID)
    assert points.power_db == pytest.approx([130.0, 120.0], abs=1e-3)
    assert points.doppler_mps.tolist() == GRID.doppler_mps[[6, 1]].tolist()
    position = np.stack(points[:3], -1)
    np.testing.assert_allclose(np.linalg.norm(position, axis=1), GRID.range_m[[30, 50]])
    azimuth_rad = -np.arctan2(points.y_m, points.x_m)
    np.testing.assert_allclose(azimuth_rad, GRID.azimuth_rad[[40, 10]])
    elevation_rad = np.arcsin(points.z_m / GRID.range_m[[30, 50]])
    np.testing.assert_allclose(elevation_rad, GRID.elevation_rad[[4, 0]])
    constant = np.full(GRID.projection_shape, 0.5, np.float32)
    assert [column.shape for column in cfar_points(constant, GRID)] == [(0,)] * 8


@pytest.mark.parametrize("absent", ["elevation_rad", "doppler_mps"])
def test_what_is_not_measured_is_zero_or_nan(absent):
    axes = {"elevation_rad": np.array([0.1, 0.2]), absent: np.array([])}
    grid = small.uneven_grid(range_m=np.geomspace(2.0, 60.0, 40), **axes)
    power = np.full(grid.shape_drea, 1e9, np.float32)
    power[-1, 30, -1, 5] = 1e13
    projection = grid.measured_channels(project_tensor(power))
    points = cfar_points(projection, grid, guard_cells=1, training_cells=2)
    assert points.power_db == pytest.approx([130.0], abs=1e-3)
    if absent == "doppler_mps":
        assert points.z_m == pytest.approx(grid.range_m[30] * np.sin(0.2))
        assert np.isnan(points.doppler_mps).all()
    else:
        assert points.z_m.tolist() == [0.0]
        assert points.doppler_mps.tolist() == [grid.doppler_mps[-1]]
    ground = np.array([points.x_m[0], points.y_m[0]])
    ground *= grid.range_m[30] / np.linalg.norm(ground)
    np.testing.assert_allclose(ground, grid.bin_to_ego(30, 5))


def test_the_strongest_bins_are_chosen_by_the_rate():
    power = np.full(GRID.shape_drea, 1e9, np.float32)
    power[6, 30, 4, 40] = 1e13
    power[1, 50, 0, 10] = 1e12
    projection = project_tensor(power)
    points = percentile_points(projection, GRID, 1.5 / power[0, :, 0].size)
    assert points.range_bin.tolist() == [30, 50]
    for column, expected in zip(points, cfar_points(projection, GRID), strict=True):
        np.testing.assert_array_equal(column, expected)
    with pytest.raises(UserError, match=r"rate is 1\.0, expected"):
        percentile_points(projection, GRID, 1.0)
    for method in (cfar_points, percentile_points):
        with pytest.raises(UserError, match=r"shape of the projection is .8, 64, 5,"):
            method(power, GRID)


PCD = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z intensity t reflectivity ring ambient range
SIZE 4 4 4 4 4 2 1 2 4
TYPE F F F F U U U U U
COUNT 1 1 1 1 1 1 1 1 1
WIDTH 2
HEIGHT 2
VIEWPOINT 0 0 0 1 0 0 0
POINTS 4
DATA ascii
10.5 -2.25 0.125 7 0 1 2 3 10742
0 0 0 0 0 0 0 0 0
nan nan nan 0 0 0 0 0 0
3e1 4 -1.5 7 99 1 63 3 30302
"""


def test_lidar_points_are_read_without_rays_that_have_no_echo(tmp_path):
    path = tmp_path / "os2-64_00001.pcd"
    path.write_text(PCD)
    found = read_lidar(path)
    np.testing.assert_array_equal(found, [[10.5, -2.25, 0.125], [30.0, 4.0, -1.5]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DATA ascii", "DATA binary", "DATA binary, expected FIELDS x y z"),
        ("3e1 4 -1.5 7 99 1 63 3 30302\n", "", "3 points, the header says 4"),
        ("-1.5 7", "up 7", "corrupted, not an ASCII PCD file"),
        (PCD, "\xff\x00" * 50, "os2-64_00001.pcd"),
    ],
)
def test_other_lidar_files_are_named(tmp_path, old, new, message):
    path = tmp_path / "os2-64_00001.pcd"
    path.write_bytes(PCD.replace(old, new).encode("latin-1"))
    with pytest.raises(DataError, match=message):
        read_lidar(path)


# Points of radar files ----------------------------------------------------------------


def radar_file(folder, form, power):
    """Writes a frame of a radar tensor in one of the forms and returns its path."""
    if form == "tesseract":
        path = folder / "tesseract_00001.mat"
        write_tesseract(path, power)
        return path
    path, array = folder / f"{form}_00001.npy", reduce_tensor(power, GRID)
    if form == "rpc":
        array = strongest_points(array, GRID, 0.1)
    if form == "DERA_tesseract":
        array = project_tensor(power).transpose(2, 0, 1)
    np.save(path, array)
    return path


def noise_with_echo():
    rng = np.random.default_rng(0)
    power = (1e9 * rng.standard_exponential(GRID.shape_drea)).astype(np.float32)
    power[6, 30, 4, 40] = 1e13
    return power


@pytest.mark.parametrize("form", ["tesseract", "polar3d", "rpc"])
def test_the_strongest_cells_are_the_same_in_every_form(tmp_path, form):
    power = noise_with_echo()
    expected = strongest_points(reduce_tensor(power, GRID), GRID, 0.01)
    found = read_points(radar_file(tmp_path, form, power), GRID, rate=0.01)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("form", ["tesseract", "DERA_tesseract", "polar3d", "rpc"])
def test_cfar_finds_the_echo_in_every_form(tmp_path, form):
    path = radar_file(tmp_path, form, noise_with_echo())
    found = read_points(path, GRID, "cfar", threshold_db=25.0)
    (point,) = found
    np.testing.assert_array_equal(point[8:], [30, 40, 4])
    bins = tuple(np.array([[30], [40], [4]]))
    expected = reduced.points_of_bins(bins, *found[:, 3:5].T, GRID)
    np.testing.assert_allclose(found, expected)
    assert point[4] == pytest.approx(GRID.doppler_mps[6], abs=0.02)
    # The mean over 7 Doppler bins, of which one has the echo.
    divisor = 7 if form in ("polar3d", "rpc") else 1
    assert point[3] == pytest.approx(1 / divisor, rel=0.01)


@pytest.mark.parametrize("method", ["percentile", "cfar"])
@pytest.mark.parametrize("form", ["tesseract", "polar3d", "rpc"])
def test_z_is_that_of_an_axis_that_points_up_or_down(tmp_path, form, method):
    path = radar_file(tmp_path, form, noise_with_echo())
    options = {"rate": 5e-5, "threshold_db": 25.0}
    (up,) = read_points(path, GRID, method, is_axis_up=True, **options)
    (down,) = read_points(path, GRID, method, **options)
    # The echo is in the last elevation bin, at 18 degrees.
    z_m = GRID.range_m[30] * np.sin(np.deg2rad(18.0))
    np.testing.assert_allclose(up[[2, 7]], [z_m, np.deg2rad(18.0)])
    np.testing.assert_allclose(down[[2, 7]], -up[[2, 7]])
    others = [0, 1, 3, 4, 5, 6, 8, 9, 10]
    np.testing.assert_array_equal(up[others], down[others])
    # Both are read as points of the same bin.
    expected = reduced.project_reduced(down[None], GRID)
    np.testing.assert_array_equal(reduced.project_reduced(up[None], GRID), expected)


@pytest.mark.parametrize("count", [0, 3])
def test_points_are_written_in_three_formats(tmp_path, count):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, len(POINT_FIELDS)))
    for suffix in ("npy", "pcd", "bin"):
        kradar_points.write_points(tmp_path / f"points.{suffix}", points)
    np.testing.assert_array_equal(np.load(tmp_path / "points.npy"), points)
    stored = np.fromfile(tmp_path / "points.bin", "<f4").reshape(-1, 11)
    np.testing.assert_array_equal(stored, points.astype(np.float32))
    header, _, body = (tmp_path / "points.pcd").read_bytes().partition(b"DATA binary\n")
    lines = dict(line.split(" ", 1) for line in header.decode().splitlines())
    assert lines["FIELDS"].split() == list(POINT_FIELDS)
    for name, value in (("SIZE", "4"), ("TYPE", "F"), ("COUNT", "1")):
        assert lines[name].split() == [value] * 11
    sizes = [int(lines[name]) for name in ("WIDTH", "HEIGHT", "POINTS")]
    assert sizes == [count, 1, count]
    assert body == stored.tobytes()
