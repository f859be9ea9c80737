import builtins
import dataclasses

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import viewer
from radejax.visualize.canvas import Scene

GRID = RadarGrid.reduced(num_doppler=4, num_range=16, num_elevation=3, num_azimuth=9)
BOX = [20.0, 3.0, 0.0, 4.0, 2.0, 1.5, 0.4]


def frame(index: int) -> Scene:
    projection = np.full(GRID.projection_shape, 0.2, np.float32)
    projection[5, 3, 0] = projection[5, 3, GRID.num_doppler + 2] = 0.6
    return Scene(
        projection,
        GRID,
        ground_truth=([[BOX[0] + index, *BOX[1:]]], ["Sedan"]),
        predictions=([BOX], [0.5], [0]),
        track_ids=[7],
        time_s=1.6e9 + 0.1 * index,
        title=f"frame {index}",
    )


def test_strongest_echo_is_where_the_tensor_has_it():
    points, strength = viewer.echo_points(frame(0).projection, GRID, 1)
    range_m = 5 * 118.0 / 15
    azimuth, elevation = np.deg2rad([-53 + 3 * 106 / 8, 18.0])
    expected = [
        range_m * np.cos(elevation) * np.cos(azimuth),
        -range_m * np.cos(elevation) * np.sin(azimuth),
        range_m * np.sin(elevation),
    ]
    np.testing.assert_allclose(points, [expected], rtol=1e-6)
    np.testing.assert_allclose(strength, 0.4, rtol=1e-6)
    # Left of boresight and above; below with the axis the other way round.
    assert points[0, 1] > 0
    down, _ = viewer.echo_points(frame(0).projection, GRID, 1, elevation_sign=-1)
    np.testing.assert_allclose(down[:, 2], -points[:, 2])


def test_more_points_than_bins_are_all_bins():
    points, _ = viewer.echo_points(frame(0).projection, GRID, 10_000)
    assert points.shape == (16 * 9, 3)
    with pytest.raises(UserError, match="elevation_sign"):
        viewer.echo_points(frame(0).projection, GRID, elevation_sign=0)


def test_mesh_covers_the_ground_between_bin_centers():
    vertices, triangles = viewer.ground_mesh(GRID)
    assert triangles.shape == (2 * 15 * 8, 3)
    a, b, c = (vertices[triangles[:, i], :2] for i in range(3))
    u, v = b - a, c - a
    areas = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    # Polygonal fan: half r^2 sin(step) in each of the eight sectors.
    step = np.deg2rad(106 / 8)
    np.testing.assert_allclose(areas.sum(), 8 * 0.5 * 118.0**2 * np.sin(step))


def test_yaw_quaternions():
    quaternions = viewer.yaw_quaternions(np.array([0.0, np.pi / 2]))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternions, [[0, 0, 0, 1], [0, 0, half, half]])


def test_without_rerun_the_extra_is_named(tmp_path, monkeypatch):
    original = builtins.__import__

    def without_rerun(name, *args, **kwargs):
        if name.split(".")[0] == "rerun":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_rerun)
    with pytest.raises(UserError, match=r"radejax\[viewer\]"):
        viewer.write_recording([frame(0)], tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())


def test_opening_needs_recording_and_program(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"a\.rrd"):
        viewer.open_viewer(tmp_path / "a.rrd")
    (tmp_path / "a.rrd").touch()
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match=r"radejax\[viewer\]"):
        viewer.open_viewer(tmp_path / "a.rrd")


def test_recording_needs_its_suffix(tmp_path):
    with pytest.raises(UserError, match=r"\.rrd"):
        viewer.write_recording([frame(0)], tmp_path / "a.mp4")


def test_trails_follow_tracks_and_end_with_them():
    class Stream:
        strips = None

        def log(self, path, entity):
            assert path == "world/tracks"
            self.strips = entity

    rr = pytest.importorskip("rerun")
    del rr
    stream, trails = Stream(), {}
    for i in range(4):
        viewer._log_trails(stream, frame(i), trails, 3)
    (trail,) = trails.values()
    np.testing.assert_allclose(np.array(trail)[:, 0], [21.0, 22.0, 23.0])
    gone = dataclasses.replace(frame(4), track_ids=[None])
    viewer._log_trails(stream, gone, trails, 3)
    assert not trails


def test_recording_is_whole(tmp_path):
    pytest.importorskip("rerun")
    path = viewer.write_recording((frame(i) for i in range(3)), tmp_path / "a.rrd")
    assert path.read_bytes()[:3] == b"RRF"
    with pytest.raises(UserError, match="no frames"):
        viewer.write_recording([], tmp_path / "b.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]
