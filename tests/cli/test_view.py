import numpy as np

from radejax.cli.view import viewer_scenes
from radejax.data.kradar import KRadar
from radejax.simulation.dataset import default_config, simulate_dataset


def test_frames_with_projections_alone_are_shown(tmp_path):
    config = default_config() | {"output": "projection", "frames_per_sequence": 1}
    config.update(train_sequences=1, test_sequences=0)
    root = simulate_dataset(config, tmp_path / "data", progress=False)
    frames = KRadar([root], version="v2.1", visibility=None)
    (shown,) = viewer_scenes(frames, frames.grid)
    stored = np.load(frames[0].projection_path)
    np.testing.assert_allclose(shown.projection, np.moveaxis(stored, 0, -1))
