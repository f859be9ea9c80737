"""The CFAR detector on maps with known results."""

import cfar
import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import tensor
from radejax.simulation.radar.tensor import RadarParameters

GRID = RadarGrid.reduced(
    num_doppler=8, num_range=64, num_elevation=5, num_azimuth=56, max_range_m=75.6
)
PARAMETERS = RadarParameters(azimuth_elements=40.0, elevation_elements=12.0)
SETTINGS = cfar.CfarSettings()


def projection_of(*targets):
    """Projection of point targets (range, azimuth, dBsm) in noise."""
    range_m, azimuth, rcs_db = np.array(targets, float).reshape(-1, 3).T
    power_db = PARAMETERS.gain_db + rcs_db - 40.0 * np.log10(range_m)
    amplitude = 10.0 ** (power_db / 20.0)
    zero = np.zeros_like(range_m)
    scatterers = tensor.Scatterers(
        *(v.astype(np.float32) for v in (range_m, azimuth, zero, zero)),
        np.stack([amplitude, zero], 1).astype(np.float32),
    )
    noise = np.full((64, 8), 10 ** (PARAMETERS.noise_db / 10), np.float32)
    return np.asarray(
        tensor.simulate(
            scatterers, noise, tensor.frame_key(3), grid=GRID, parameters=PARAMETERS
        )
    )


def test_finds_cars_where_they_are():
    projection = projection_of((20.0, -0.2, 8.0), (40.0, 0.3, 8.0))
    found = cfar.detect(projection, GRID, PARAMETERS)
    cars = found["box"][found["cls"] == "Sedan"]
    for distance, azimuth in ((20.0, -0.2), (40.0, 0.3)):
        near_side = np.array([distance * np.cos(azimuth), -distance * np.sin(azimuth)])
        rear = cars[:, :2] - cars[:, 3:4] / 2 * (1.0, 0.0)
        assert np.hypot(*(rear - near_side).T).min() < 1.2


@pytest.mark.parametrize(
    ("rcs_db", "cls"),
    [
        (18.0, "Bus or Truck"),
        (4.0, "Sedan"),
        (-5.3, "Motorcycle"),
        (-12.0, "Pedestrian"),
    ],
)
def test_cross_section_chooses_the_class(rcs_db, cls):
    limits = (9.0, -5.0, -7.0, -9.0, -16.0)
    names = ("Bus or Truck", "Sedan", "Motorcycle", "Bicycle", "Pedestrian")
    settings = cfar.CfarSettings(rcs_steps=tuple(zip(names, limits, strict=True)))
    projection = projection_of((15.6, 0.0, rcs_db))
    found = cfar.detect(projection, GRID, PARAMETERS, settings)
    assert found["cls"][0] == cls
