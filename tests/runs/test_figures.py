"""Figures of a run: which frames, and in which order."""

import json
import pathlib
from types import SimpleNamespace

import numpy as np
import pytest

from radejax.core.structures import Boxes
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs import figures


def test_scenes_are_the_fullest_of_each_weather_in_the_order_of_tables(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weathers = ["heavysnow", "fog", "normal", "hail", "fog"]
    sizes = [1, 1, 2, 3, 4]
    frames = [
        SimpleNamespace(key="1/1", weather=weather, boxes=np.zeros((size, 7)))
        for weather, size in zip(weathers, sizes, strict=True)
    ]
    drawn = []
    monkeypatch.setattr(figures.FrameDrawer, "_scene", lambda _, index, title: index)
    monkeypatch.setattr(figures, "draw_scenes", drawn.extend)
    monkeypatch.setattr(figures, "save_figure", lambda *_: None)
    drawer = figures.FrameDrawer(
        [], frames, Boxes.one_frame([], [], []), roi=(), score_threshold=0.3
    )
    drawer.draw_scenes(pathlib.Path("scenes.png"))
    assert drawn == [2, 4, 0, 3]


def test_bins_out_of_view_and_frames_without_image_do_not_count(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = RadarGrid.reduced(
        num_doppler=2, num_range=2, num_elevation=2, num_azimuth=2, max_range_m=20.0
    )
    first = np.array([[0.0, 0.2], [0.4, 0.0]])
    second = np.array([[0.0, 0.6], [0.0, 0.0]])
    nothing = np.zeros((2, 2))
    shares = [("fog", first), ("rain", second), ("fog", nothing), ("snow", nothing)]
    maps, counts = figures.average_by_group(shares)
    assert list(maps) == ["all", "fog", "rain", "snow"]
    assert counts == {"all": 2, "fog": 1, "rain": 1, "snow": 0}
    np.testing.assert_allclose(maps["all"], [[0.0, 0.4], [0.4, 0.0]])
    np.testing.assert_allclose(maps["fog"], first)
    padded = [
        (SimpleNamespace(weather=weather), np.pad(share, ((0, 0), (0, 3))))
        for weather, share in shares
    ]
    monkeypatch.setattr(figures, "frame_shares", lambda *_: padded)
    data = SimpleNamespace(records=SimpleNamespace(grid=grid))
    path = tmp_path / "camera_share.json"
    figures.write_camera_share(path, None, {}, data, [])
    summary = json.loads(path.read_text())
    assert summary["all"] == {"mean": pytest.approx(0.4), "frames": 2}
    assert summary["fog"] == {"mean": pytest.approx(0.3), "frames": 1}
    assert summary["snow"] == {"mean": None, "frames": 0}
