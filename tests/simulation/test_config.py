"""Checks on the values a simulation depends on."""

import dataclasses
import json

import ml_collections
import pytest

from radejax.core.errors import UserError
from radejax.simulation.config import (
    CONDITIONS,
    SimulationConfig,
    default_config,
)
from radejax.simulation.radar.propagation import WEATHERS
from radejax.simulation.radar.tensor import RadarParameters
from radejax.simulation.world.environments import ENVIRONMENTS

from .. import small_models as small


def test_default_has_every_weather_in_training_and_several_held_out():
    config = SimulationConfig.from_mapping(default_config())
    train = [config.conditions(n)[2] for n in range(1, config.train_sequences + 1)]
    assert set(train) == set(WEATHERS)
    last = config.train_sequences + config.test_sequences
    held_out = [
        config.conditions(n)[2] for n in range(config.train_sequences + 1, last + 1)
    ]
    assert len(set(held_out)) >= 4


def test_conditions_are_kradars():
    for environment, time, weather in CONDITIONS:
        assert environment in ENVIRONMENTS
        assert weather in WEATHERS
        assert time in ("day", "night")
    assert {c[0] for c in CONDITIONS} == set(ENVIRONMENTS)


def test_config_dict_and_mapping_give_the_same_fingerprint():
    plain = default_config()
    as_config_dict = ml_collections.ConfigDict(default_config())
    a = SimulationConfig.from_mapping(plain)
    b = SimulationConfig.from_mapping(as_config_dict)
    assert a.fingerprint() == b.fingerprint()
    again = SimulationConfig.from_mapping(json.loads(a.to_json()))
    assert again.fingerprint() == a.fingerprint()


def test_fingerprint_follows_every_change():
    base = SimulationConfig.from_mapping(default_config()).fingerprint()
    changed = default_config()
    changed["grid"]["num_range"] = 65
    assert SimulationConfig.from_mapping(changed).fingerprint() != base


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sead": 1}, "field is 'sead', expected seed, scenes"),
        ({"frames_per_sequence": 0}, "frames_per_sequence is 0, expected an integer"),
        ({"seed": "one"}, "seed is 'one', expected an integer of at least 0"),
        ({"train_sequences": 2.5}, "train_sequences is 2.5, expected an integer"),
        ({"vru_density_scale": 9.0}, "is 9.0, expected .* at most 5"),
        (
            {"vru_density_scale": 3, "scenes": "labels.zip"},
            "is 3, expected 1 for scenes of real labels",
        ),
        ({"train_sequences": 0, "test_sequences": 0}, "expected a sequence"),
        ({"output": "video"}, "'video', expected one of 'tesseract', 'projection'"),
        ({"camera_mode": "x"}, "is 'x', expected one of 'scene', 'oracle'"),
        ({"grid": "velodyne"}, "expected 'kradar' or"),
        ({"grid": {"num_range": 3}}, "simulation.grid"),
        ({"radar": {"power": 3}}, "simulation.radar: .*power"),
        (
            {"radar": {"azimuth_elements": -3}},
            "simulation.radar.azimuth_elements is -3, expected a number",
        ),
        ({"radar": {"gain_db": float("nan")}}, "radar.gain_db is nan"),
        ({"radar": {"noise_db": "loud"}}, "radar.noise_db is 'loud'"),
        ({"radar": {"noise_db": (3.0, 1.0)}}, "noise_db is .*the lower number first"),
        ({"radar": {"noise_db": (1, 2, 3)}}, "noise_db is .*lowest and the highest"),
        ({"radar": {"leakage": (0.1, 9.0)}}, "leakage is 9.0, expected a number"),
        ({"radar": "realistic"}, "radar is 'realistic', expected a preset and fields"),
        ({"radar": {"preset": "perfect"}}, "expected one of ideal, realistic"),
        (
            {"radar": {"max_scatterers_per_row": 9.5}},
            "is 9.5, expected an integer of at least 1 and at most 4096",
        ),
        ({"label_distance_m": 0}, "label_distance_m is 0, expected a number above 0"),
        ({"label_distance_m": float("nan")}, "label_distance_m is nan"),
        ({"radar_from_lidar_m": (0.0,)}, "three numbers"),
        ({"sequences": (5,)}, "selects sequences of real labels"),
    ],
)
def test_wrong_values(change, message):
    with pytest.raises(UserError, match=message):
        SimulationConfig.from_mapping(default_config() | change)


def test_every_field_of_the_radar_has_limits_that_its_default_keeps():
    parameters = dataclasses.asdict(RadarParameters())
    config = SimulationConfig.from_mapping(default_config() | {"radar": parameters})
    assert config.make_parameters() == RadarParameters()


def test_kradar_grid():
    config = SimulationConfig.from_mapping(default_config() | {"grid": "kradar"})
    assert config.make_grid().shape_drea == (64, 256, 37, 107)


def test_a_grid_may_be_given_by_its_axes() -> None:
    grid = small.uneven_grid()
    config = default_config() | {"grid": grid.to_dict()}
    as_config_dict = ml_collections.ConfigDict(config)
    found = SimulationConfig.from_mapping(as_config_dict)
    assert found.make_grid() == grid
    again = SimulationConfig.from_mapping(json.loads(found.to_json()))
    assert again.make_grid() == grid


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"doppler_mps": (-1.0, 0.0, 3.0)}, "doppler_mps is .* expected uniform bins"),
        ({"range_m": (3.0, 1.0)}, "grid: range_m must be increasing"),
        ({"azimut_rad": (3.0, 1.0)}, "grid: .*unexpected .*'azimut_rad'"),
    ],
)
def test_wrong_axes_are_named(change: dict[str, object], message: str) -> None:
    axes = small.uneven_grid().to_dict() | change
    with pytest.raises(UserError, match=message):
        SimulationConfig.from_mapping(default_config() | {"grid": axes})
