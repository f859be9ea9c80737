"""Checks on the values a simulation depends on."""

import json

import pytest

from radejax.core.errors import UserError
from radejax.data.kradar.conditions import WEATHERS as KRADAR_WEATHERS
from radejax.simulation import config as simulation
from radejax.simulation.config import FULL_SIZE, SimulationOptions
from radejax.simulation.radar.propagation import WEATHERS
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.environments import ENVIRONMENTS

from .. import small_models as small

AXES = small.uneven_grid().to_dict()
SMALL = {"num_doppler": 8, "num_range": 32, "num_elevation": 5, "num_azimuth": 24}


def test_default_has_every_weather_in_training_and_several_held_out():
    config = SimulationOptions()
    train = [config.conditions(n)[2] for n in range(1, config.train_sequences + 1)]
    assert set(train) == set(WEATHERS) == set(KRADAR_WEATHERS)
    assert {environment for environment, *_ in simulation.CONDITIONS} == set(
        ENVIRONMENTS
    )
    last = config.train_sequences + config.test_sequences
    test = range(config.train_sequences + 1, last + 1)
    held_out = [config.conditions(n)[2] for n in test]
    assert len(set(held_out)) >= 4


@pytest.mark.parametrize(
    ("changes", "fingerprint"),
    [
        ({}, "b5e2efc2569e9d06"),
        ({"radar": {"preset": "ideal"}}, "5bda7fa95caa1d35"),
        (FULL_SIZE, "3b2237526e8635a0"),
        ({"grid": {**SMALL, "max_range_m": 118.0}}, "2ab946c2db82aee6"),
        ({"grid": SMALL}, "bc521cff617d1c30"),
    ],
)
def test_fingerprints_stay_the_same(changes, fingerprint):
    """Datasets that earlier versions have written are found again."""
    options = SimulationOptions(**changes)
    assert options.fingerprint() == fingerprint
    for text in (options.to_json(), options.model_dump_json()):
        again = SimulationOptions(**json.loads(text))
        assert again == options
        assert again.fingerprint() == fingerprint


def test_fingerprint_follows_every_change():
    options = SimulationOptions()
    changed = options.replace(grid={"num_range": 65})
    assert changed.fingerprint() != options.fingerprint()
    assert changed.make_grid().num_range == 65
    assert options.replace(seed=0).fingerprint() == options.fingerprint()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sead": 1}, "sead is not a field; did you mean config.simulation.seed"),
        ({"train_sequences": 2.5}, "train_sequences is 2.5, expected an integer"),
        ({"vru_density_scale": 3, "scenes": "a.zip"}, "is 3.0, expected 1 for scenes of"),
        ({"train_sequences": 0, "test_sequences": 0}, "expected a sequence"),
        ({"radar": {"power": 3}}, "simulation.radar.power is not a field"),
        ({"radar": {"noise_db": (1, 2, 3)}}, "noise_db is .*lowest and the highest"),
        ({"radar": "realistic"}, "radar is 'realistic', expected a dictionary"),
        ({"radar": {"preset": "perfect"}}, "expected 'ideal' or 'realistic'"),
        ({"radar_from_lidar_m": (0.0,)}, "radar_from_lidar_m.* is missing"),
        ({"grid": AXES | {"doppler_mps": (-1.0, 0.0, 3.0)}}, "expected uniform bins"),
        ({"grid": AXES | {"azimut_rad": (3.0,)}}, "not a field; did you mean .*azimuth_"),
    ],
)  # fmt: skip
def test_wrong_values(change, message):
    with pytest.raises(UserError, match=message):
        SimulationOptions(**change)


def test_every_field_of_the_radar_has_limits_that_its_default_keeps():
    options = SimulationOptions(radar=RadarParameters().to_dict())
    assert options.radar.make_parameters() == RadarParameters()


def test_a_sensor_is_changed_or_replaced():
    options = SimulationOptions()
    changed = options.replace(radar={"preset": "ideal"})
    assert changed.radar.make_parameters().azimuth_elements == 40.0
    full = changed.replace(**FULL_SIZE)
    assert full.radar == simulation.RadarOptions() != options.radar
    elements = full.radar.make_parameters().azimuth_elements
    assert elements == RadarParameters().azimuth_elements
