"""Which sequences and frames a data set has."""

import numpy as np
import pytest

from radejax.simulation.config import SimulationConfig, default_config
from radejax.simulation.scene_sources import ProceduralSource, make_source


@pytest.fixture
def source():
    values = default_config() | {"train_sequences": 2, "test_sequences": 1}
    return make_source(SimulationConfig.from_mapping(values))


def test_training_sequences_come_first(source):
    assert isinstance(source, ProceduralSource)
    assert source.numbers == [1, 2, 3]
    splits = [{spec.split for spec in source.frames(n)} for n in source.numbers]
    assert splits == [{"train"}, {"train"}, {"test"}]


def test_sensors_count_their_own_frames(source):
    first, second = source.frames(1)[:2]
    assert [b - a for a, b in zip(first.indices, second.indices, strict=True)] == [
        1
    ] * 5
    assert second.timestamp_s - first.timestamp_s == pytest.approx(0.1)
    assert first.name == f"{first.indices[0]:05d}_00001"
    offsets = {source.frames(n)[0].indices[0] for n in source.numbers}
    assert len(offsets) > 1


def test_vru_density_scale_are_added_to_training_scenes_alone():
    values = default_config() | {"train_sequences": 6, "test_sequences": 6}
    natural, added = (
        make_source(SimulationConfig.from_mapping(values | {"vru_density_scale": n}))
        for n in (1.0, 4.0)
    )

    def classes(source, numbers):
        return np.concatenate([source.make(n).tracks.cls for n in numbers])

    train, test = range(1, 7), range(7, 13)
    few, many = ((classes(source, train) >= 2).sum() for source in (natural, added))
    assert many > 2 * few
    np.testing.assert_array_equal(classes(natural, test), classes(added, test))
