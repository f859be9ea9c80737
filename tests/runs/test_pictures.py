"""Pictures of a run: which frames, and in which order."""

import pathlib
from types import SimpleNamespace

import numpy as np
import pytest

from radejax.runs import pictures


def test_scenes_are_the_fullest_of_each_weather_in_the_order_of_tables(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weathers = ["heavysnow", "fog", "normal", "hail", "fog"]
    sizes = [1, 1, 2, 3, 4]
    frames = [
        SimpleNamespace(weather=weather, boxes=np.zeros((size, 7)))
        for weather, size in zip(weathers, sizes, strict=True)
    ]
    drawn = []
    monkeypatch.setattr(pictures, "record_positions", lambda *_: range(5))
    monkeypatch.setattr(pictures.FrameDrawer, "_scene", lambda _, index: index)
    monkeypatch.setattr(pictures, "draw_scenes", drawn.extend)
    monkeypatch.setattr(pictures.bev, "save_figure", lambda *_: None)
    drawer = pictures.FrameDrawer([], frames, {}, roi=(), score_threshold=0.3)
    drawer.draw_scenes(pathlib.Path("scenes.png"))
    assert drawn == [2, 4, 0, 3]
