import builtins

import numpy as np
import pytest

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import viewer
from radejax.visualize.style import Scene

GRID = RadarGrid.reduced(num_doppler=4, num_range=16, num_elevation=3, num_azimuth=9)
BOX = [20.0, 3.0, 0.0, 4.0, 2.0, 1.5, 0.4]


def frame(index: int) -> Scene:
    projection = np.full(GRID.projection_shape, 0.2, np.float32)
    projection[5, 3, 0] = projection[5, 3, GRID.num_doppler + 2] = 0.6
    return Scene(
        projection,
        GRID,
        ground_truth=Boxes.one_frame([BOX[0] + index, *BOX[1:]], ["Sedan"]),
        predictions=Boxes.one_frame(BOX, ["Sedan"], [0.5]),
        time_s=1.6e9 + 0.1 * index,
        title=f"frame {index}",
    )


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


def test_opening_needs_the_program(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match=r"radejax\[viewer\]"):
        viewer.open_viewer(tmp_path / "a.rrd")


def test_recording_needs_its_suffix(tmp_path):
    with pytest.raises(UserError, match=r"\.rrd"):
        viewer.write_recording([frame(0)], tmp_path / "a.mp4")


def test_recording_is_whole(tmp_path):
    pytest.importorskip("rerun")
    path = tmp_path / "a.rrd"
    viewer.write_recording((frame(i) for i in range(3)), path)
    assert path.read_bytes()[:3] == b"RRF"
    with pytest.raises(UserError, match="no frames"):
        viewer.write_recording([], tmp_path / "b.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]
