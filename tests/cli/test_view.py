from types import SimpleNamespace

import numpy as np

from radejax.cli.view import track_ids, viewer_scenes
from radejax.data.kradar import KRadar
from radejax.data.kradar.labels import Label
from radejax.simulation.dataset import default_config, simulate_dataset


def label(x: float, track_id: int) -> Label:
    return Label("Sedan", (x, 1.0, 0.0, 4.0, 2.0, 1.5, 0.0), "R", track_id)


def test_track_ids_belong_to_the_boxes_that_are_left():
    offset = (-2.54, 0.3, 0.0)
    labels = (label(10.0, 5), label(20.0, 6), label(30.0, -1))
    kept = np.array([labels[2].box, labels[0].box])
    kept[:, :3] += offset
    frame = SimpleNamespace(
        sequence=3, labels=labels, boxes=kept, radar_from_lidar_m=offset
    )
    assert track_ids(frame) == [None, (3, 5)]
    frame.boxes = np.zeros((0, 7))
    assert track_ids(frame) == []


def test_frames_with_projections_alone_are_shown(tmp_path):
    config = default_config() | {"output": "projection", "frames_per_sequence": 1}
    config.update(train_sequences=1, test_sequences=0)
    root = simulate_dataset(config, tmp_path / "data", progress=False)
    frames = KRadar([root], version="v2.1", visibility=None)
    (shown,) = viewer_scenes(frames, frames.grid)
    stored = np.load(frames[0].projection_path)
    np.testing.assert_allclose(shown.projection, np.moveaxis(stored, 0, -1))
