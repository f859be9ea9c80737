import sys

import numpy as np
import pytest
from PIL import Image

from radejax.core.errors import UserError
from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.visualize import recordings
from radejax.visualize.style import PREDICTION, Scene, new_figure


def color_figure(color):
    figure = new_figure(0.5, 0.4, dpi=100)
    figure.set_facecolor(color)
    return figure


def test_gif_has_every_frame_in_order(tmp_path):
    colors = ["white", PREDICTION.color, "black"]
    figures = map(color_figure, colors)
    path = recordings.animate(figures, tmp_path / "a.gif", frames_per_second=5)
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


def frame(index):
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
