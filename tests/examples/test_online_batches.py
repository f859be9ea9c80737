"""Batches without a dataset on disk depend on seed and step only and equal written frames."""

import jax
import numpy as np
import pytest
from online_batches import OnlineBatches

from radejax.simulation.config import SimulationOptions
from radejax.simulation.simulator import SequenceSimulator

GRID = {"num_doppler": 8, "num_range": 32, "num_elevation": 5, "num_azimuth": 24}
OPTIONS = SimulationOptions(
    train_sequences=3, frames_per_sequence=4, image_width=0, grid=GRID
)


def batches(**kwargs):
    return OnlineBatches(
        OPTIONS, **{"batch_size": 3, "max_objects": 20, "seed": 4} | kwargs
    )


@pytest.fixture(scope="module")
def source():
    return batches()


def test_shapes_and_content(source):
    batch = next(source)
    assert batch.projection.shape == (3, 32, 24, 13)
    assert batch.boxes.shape == (3, 20, 8)
    assert bool(batch.is_valid.any(1).all())
    valid = np.asarray(batch.is_valid)
    boxes = np.asarray(batch.boxes)[valid]
    assert source.grid.in_field_of_view(boxes[:, 0], boxes[:, 1]).all()
    np.testing.assert_allclose(np.hypot(boxes[:, 6], boxes[:, 7]), 1.0, atol=1e-6)
    # LiDAR height: the ground lies 1.6 m below.
    np.testing.assert_allclose(boxes[:, 2] - boxes[:, 5] / 2, -1.6, atol=1e-5)
    assert 0.4 < float(batch.projection.min()) < float(batch.projection.max()) < 1.0


def test_iterating_resuming_and_asking_give_the_same_batch(source):
    fresh = batches()
    sequence = [next(fresh) for _ in range(3)]
    assert fresh.step == 3
    resumed = next(batches(start_step=2))
    asked = source.batch(2)
    for other in (resumed, asked):
        jax.tree.map(np.testing.assert_array_equal, sequence[2], other)
    assert np.abs(sequence[1].projection - sequence[2].projection).max() > 0.01


def test_frame_differs_from_the_simulator_by_noise_only(source):
    batch = source.batch(5)
    index = int(batch.frame[0])
    number, spec = source._specs[index]
    simulator = SequenceSimulator(source._source.make(number), source._options)
    expected = simulator.run(
        simulator.radar_input(simulator.sequence.frame(spec.scene_idx))
    )
    # The leak in the first and last range bins is noise.
    found, expected = np.asarray(batch.projection[0])[5:-3], expected[5:-3]
    bright = expected > 0.75
    assert bright.any()
    np.testing.assert_allclose(found[bright], expected[bright], atol=0.02)


def test_too_many_objects_are_counted():
    source = batches(max_objects=1)
    batch = source.batch(0)
    assert batch.boxes.shape == (3, 1, 8)
    assert source.num_cut > 0


def test_a_loader_continues_at_its_position(source):
    loader = source.loader()
    next(loader)
    position = loader.get_state()
    expected = next(loader)
    jax.tree.map(np.testing.assert_array_equal, source.batch(1), expected)
    other = batches().loader()
    other.set_state(position)
    jax.tree.map(np.testing.assert_array_equal, next(other), expected)
    names = source.frame_names
    assert len(names) == 12
    assert names[int(expected.frame[0])].split("/")[0] in ("1", "2", "3")
