"""Batches without a dataset on disk depend on seed and step only and equal written frames."""

import jax
import numpy as np
import pytest
from online_batches import OnlineBatches

from radejax.simulation.config import SimulationOptions

GRID = {"num_doppler": 8, "num_range": 32, "num_elevation": 5, "num_azimuth": 24}
SIZES = {"train_sequences": 3, "frames_per_sequence": 4, "image_width": 0}


def batches(start_step=0):
    options = SimulationOptions(grid=GRID, **SIZES)
    sizes = {"batch_size": 3, "max_objects": 20}
    return OnlineBatches(options, seed=4, start_step=start_step, **sizes)


@pytest.fixture(scope="module")
def source():
    return batches()


def test_iterating_and_resuming_give_the_same_batches(source):
    loader = source.loader()
    first = next(loader)
    position = loader.get_state()
    expected = next(loader)
    assert np.abs(first.projection - expected.projection).max() > 0.01
    for found in (source.batch(1), next(batches(start_step=1))):
        jax.tree.map(np.testing.assert_array_equal, found, expected)
    other = batches().loader()
    other.set_state(position)
    jax.tree.map(np.testing.assert_array_equal, next(other), expected)
