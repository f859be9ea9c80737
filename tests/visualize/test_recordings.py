import sys

import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import recordings
from radejax.visualize.style import PREDICTION, Scene, new_figure


def color_figure(color: str):
    figure = new_figure(0.5, 0.4, dpi=100)
    figure.set_facecolor(color)
    return figure


def test_gif_has_every_frame_in_order(tmp_path):
    colors = ["white", PREDICTION.color, "black"]
    path = recordings.animate(
        (color_figure(c) for c in colors), tmp_path / "a.gif", frames_per_second=5
    )
    with Image.open(path) as gif:
        assert gif.n_frames == 3
        assert gif.info["duration"] == 200
        assert gif.info["loop"] == 0
        assert gif.size == (50, 40)
        seen = []
        for i in range(3):
            gif.seek(i)
            seen.append(gif.convert("RGB").getpixel((25, 20)))
    assert seen == [(255, 255, 255), (255, 127, 110), (0, 0, 0)]
    assert [p.name for p in tmp_path.iterdir()] == ["a.gif"]


def test_gif_keeps_the_colors_of_thin_lines(tmp_path):
    colors = np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)
    colors[20, 10:14] = 255, 127, 110
    figure = color_figure("white")
    figure.figimage(colors)
    path = recordings.animate([figure], tmp_path / "a.gif")
    with Image.open(path) as gif:
        shown = np.asarray(gif.convert("RGB"))
    assert (shown == (255, 127, 110)).all(-1).sum() >= 4


@pytest.mark.parametrize(
    ("frames", "name", "message"),
    [([], "a.gif", "no frames"), (["white"], "a.mp4", r"as \.gif")],
)
def test_wrong_use_is_named(tmp_path, frames, name, message):
    with pytest.raises(UserError, match=message):
        recordings.animate(map(color_figure, frames), tmp_path / name)
    assert not list(tmp_path.iterdir())


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
    vertices, triangles = recordings.ground_mesh(GRID)
    assert triangles.shape == (2 * 15 * 8, 3)
    a, b, c = (vertices[triangles[:, i], :2] for i in range(3))
    u, v = b - a, c - a
    areas = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    # Polygonal fan: half r^2 sin(step) in each of the eight sectors.
    step = np.deg2rad(106 / 8)
    np.testing.assert_allclose(areas.sum(), 8 * 0.5 * 118.0**2 * np.sin(step))


def test_yaw_quaternions():
    quaternions = recordings.yaw_quaternions(np.array([0.0, np.pi / 2]))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternions, [[0, 0, 0, 1], [0, 0, half, half]])


def test_without_rerun_or_the_suffix_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    for name, message in (("a.rrd", r"radejax\[viewer\]"), ("a.mp4", r"\.rrd")):
        with pytest.raises(UserError, match=message):
            recordings.write_recording([frame(0)], tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_recording_is_whole(tmp_path):
    pytest.importorskip("rerun")
    path = tmp_path / "a.rrd"
    recordings.write_recording((frame(i) for i in range(3)), path)
    assert path.read_bytes()[:3] == b"RRF"
    with pytest.raises(UserError, match="no frames"):
        recordings.write_recording([], tmp_path / "b.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["a.rrd"]
