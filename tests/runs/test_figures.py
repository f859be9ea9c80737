"""Figures of a run: which frames in which order, and what a sample looks like."""

import pathlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from radejax.config import load_config
from radejax.data.kradar import KRadar
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs import figures
from radejax.runs.figures import draw_training_samples, frame_scene
from radejax.visualize.style import Scene

from .. import small_models as small


def test_samples_are_drawn_with_their_augmentation(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(
        figures, "draw_samples", lambda rows, grid: drawn.append((rows, grid))
    )
    config = small.shrink_run(load_config("quickstart_fusion:short")).replace(
        simulation={"train_sequences": 1, "test_sequences": 0},
        data={"roots": (str(tmp_path / "data"),), "mirror_probability": 1.0},
        train={"batch_size": 3},
    )
    config = config.replace(simulation={"frames_per_sequence": 3})
    draw_training_samples(config, count=2)
    ((rows, grid),) = drawn
    assert len(rows) == 2
    for frame, scene, target in rows:
        np.testing.assert_allclose(scene.power, frame.power[:, ::-1])
        np.testing.assert_array_equal(scene.image, frame.image[:, ::-1])
        mirrored = frame.ground_truth.box * [1, -1, 1, 1, 1, 1, -1]
        np.testing.assert_allclose(scene.ground_truth.box, mirrored, atol=1e-5)
        assert list(scene.ground_truth.cls) == list(frame.ground_truth.cls)
        bins = grid.nearest_bin(*mirrored[:, :2].T)
        np.testing.assert_array_equal(target[bins[:, 0], bins[:, 1]], 1.0)
        pixels = [
            s.camera.project_boxes(b)[0]
            for s, b in ((frame, frame.ground_truth.box), (scene, mirrored))
        ]
        ends = [np.sort(x[..., 0].reshape(len(mirrored), -1)) for x in pixels]
        width = scene.image.shape[1]
        np.testing.assert_allclose(ends[1], (width - ends[0])[:, ::-1], atol=1e-2)
    monkeypatch.undo()
    figure = figures.draw_samples(rows, grid)
    titles = [ax.get_title() for ax in figure.axes]
    assert titles[:2] == [rows[0][0].title, "input of the network"]
    assert len(titles) == 8
    (frame,) = KRadar([tmp_path / "data"])[:1]
    scene: Scene = frame_scene(
        frame, rows[0][0].projection, rows[0][0].grid, roi="wide"
    )
    assert scene.roi == (0.0, 72.0, -16.0, 16.0, -2.0, 7.6)


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
