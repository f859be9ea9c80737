"""Figures of a run: which frames, and in which order."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.runs import figures


def test_scenes_are_the_fullest_of_each_weather_in_the_order_of_tables() -> None:
    weathers = ["heavysnow", "fog", "normal", "hail", "fog"]
    sizes = [1, 1, 2, 3, 4]
    frames: Any = [
        SimpleNamespace(weather=weather, boxes=np.zeros((size, 7)))
        for weather, size in zip(weathers, sizes, strict=True)
    ]
    found = figures.fullest_of_weathers(frames)
    assert [*found.items()] == [
        ("normal", 2),
        ("fog", 4),
        ("heavysnow", 0),
        ("hail", 3),
    ]


def test_bins_out_of_view_and_frames_without_image_do_not_count() -> None:
    grid = RadarGrid.reduced(
        num_doppler=2, num_range=2, num_elevation=2, num_azimuth=2, max_range_m=20.0
    )
    first = np.array([[0.0, 0.2], [0.4, 0.0]])
    second = np.array([[0.0, 0.6], [0.0, 0.0]])
    nothing = np.zeros((2, 2))
    shares = [("fog", first), ("rain", second), ("fog", nothing), ("snow", nothing)]
    padded = [(name, np.pad(share, ((0, 0), (0, 3)))) for name, share in shares]
    assert figures.average_shares(padded, grid) == {
        "all": {"mean": pytest.approx(0.4), "frames": 2},
        "fog": {"mean": pytest.approx(0.3), "frames": 1},
        "rain": {"mean": pytest.approx(0.6), "frames": 1},
        "snow": {"mean": None, "frames": 0},
    }
