"""A tiny detector on a tiny sensor, its data and its compiled steps, shared by tests."""

import dataclasses
import pathlib
from typing import Any

import grain
import jax
import numpy as np
import pytest

from radejax import models
from radejax.config import Config
from radejax.core import devices
from radejax.core.structures import Batch
from radejax.geometry.radar_grid import RadarGrid
from radejax.runs.experiment import TrainingData, fit

from ..small_models import drawn, radar_config, small_grid

NUM_FRAMES = 16


@dataclasses.dataclass(frozen=True)
class Tiny:
    """What a training needs."""

    config: Config
    model: Any
    variables: Any
    grid: RadarGrid
    map_grid: RadarGrid
    frames: Batch

    def loader(self, batch_size: int = 4, seed: int = 0) -> Any:
        """Endless, shuffled, checkpointable."""
        dataset = grain.MapDataset.range(NUM_FRAMES).seed(seed).shuffle()
        dataset = dataset.repeat(None).batch(batch_size)
        dataset = dataset.map(lambda i: jax.tree.map(lambda x: x[i], self.frames))
        return iter(dataset.to_iter_dataset(grain.ReadOptions(num_threads=0)))

    def fit(
        self,
        workdir: pathlib.Path,
        batches: Any = None,
        *,
        steps_per_epoch: int = NUM_FRAMES // 4,
        info: Any = None,
        num_devices: int = 1,
        **changes: Any,
    ) -> Any:
        """Result of `experiment.fit` on the tiny data, on one device by default."""
        data = TrainingData(
            batches=self.loader() if batches is None else batches,
            steps_per_epoch=steps_per_epoch,
            grid=self.map_grid,
            info=info or {},
            keys=[f"1/{i:05d}" for i in range(NUM_FRAMES)],
        )
        given = {"config": self.config, "model": self.model, "workdir": workdir}
        given |= {"weights": self.variables, **changes}
        return fit(data=data, mesh=devices.make_mesh(num_devices), **given)


@pytest.fixture(scope="session")
def tiny():
    """One bright bin an object, so that a few steps learn something."""
    grid = small_grid()
    config = radar_config().replace(
        # Attention is irrelevant for the loop, and takes longer to compile.
        model={"cbam": "off", "heatmap_prior": 0.1},
        loss={"heatmap_sigma_bins": 1.0},
        train={
            "batch_size": 4,
            "num_epochs": 2,
            "learning_rate": 3e-3,
            "log_every_steps": 1,
            "checkpoint_every_steps": 3,
            "max_skipped_steps": 2,
        },
    )
    model = models.build(config.model)
    variables = drawn(model, np.zeros((1, *grid.projection_shape)))
    return Tiny(
        config=config,
        model=model,
        variables=jax.tree_util.tree_map_with_path(_without_biases, variables),
        grid=grid,
        map_grid=models.map_grid(grid, model, "true"),
        frames=make_frames(grid, seed=0),
    )


def _without_biases(path: tuple, x: np.ndarray) -> np.ndarray:
    """As a training begins: all zero but the heatmap's, a confidence of 0.1."""
    name = "/".join(key.key for key in path)
    if name.endswith("heatmap/out/bias"):
        return np.full_like(x, np.log(0.1 / 0.9))
    return np.zeros_like(x) if name.endswith("bias") else x


def make_frames(grid: RadarGrid, seed: int) -> Batch:
    """Two sedans a frame that each light up their own bin."""
    rng = np.random.default_rng(seed)
    n = NUM_FRAMES
    cells = np.stack([rng.integers(4, 14, (n, 2)), rng.integers(2, 12, (n, 2))], -1)
    places = cells + rng.uniform(-0.3, 0.3, cells.shape)
    xy = grid.bin_to_ego(*np.moveaxis(places, -1, 0))
    projection = 0.05 * rng.random((n, *grid.projection_shape))
    for frame in range(n):
        projection[frame, cells[frame, :, 0], cells[frame, :, 1]] += 0.6
    boxes = np.zeros((n, 3, 8), np.float32)
    boxes[:, :2, :2] = xy
    boxes[:, :2, 3:] = (4.4, 1.9, 1.6, 0.0, 1.0)
    return Batch(
        projection=projection.astype(np.float16),
        boxes=boxes,
        classes=np.zeros((n, 3), np.int32),
        is_valid=np.tile([True, True, False], (n, 1)),
        frame=np.arange(n, dtype=np.int32),
    )


@pytest.fixture
def workdir(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    return folder
