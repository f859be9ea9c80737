"""Attenuation and backscatter of weather against hand-worked numbers."""

import numpy as np
import pytest

from radejax.data.kradar.sequences import WEATHERS as KRADAR_WEATHERS
from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import weather
from radejax.simulation.radar.tensor import RadarParameters

GRID = RadarGrid.kradar()
PARAMETERS = RadarParameters()


def test_knows_kradars_seven():
    assert set(weather.WEATHERS) == set(KRADAR_WEATHERS)


def test_attenuation_by_hand():
    # Rain: 6 dB/km there and back over 100 m is 1.2 dB, and 2 dB on the radome.
    factor = weather.attenuation("rain", np.array([100.0]))
    assert 10 * np.log10(factor[0]) == pytest.approx(-3.2)
    assert weather.attenuation("normal", np.array([100.0]))[0] == 1.0


def test_clear_air_is_the_receiver_noise():
    noise = weather.noise_profile("normal", GRID, PARAMETERS, np.zeros(2))
    floor_db = 10 * np.log10(noise[20:])
    np.testing.assert_allclose(floor_db, PARAMETERS.noise_db, atol=0.01)


def test_backscatter_falls_with_the_square_of_range():
    # 20 dB per decade, and the extra way of 54 m at 6 dB/km there and back.
    noise = weather.noise_profile("rain", GRID, PARAMETERS, np.zeros(2))
    clutter = (noise - 10 ** (PARAMETERS.noise_db / 10)).sum(1, dtype=np.float64)
    near, far = 13, 130
    drop = 10 * np.log10(clutter[near] / clutter[far])
    way = GRID.range_m[far] - GRID.range_m[near]
    assert drop == pytest.approx(20.0 + 2 * 6.0 * way / 1000.0, abs=0.1)


@pytest.mark.parametrize("speed", [0.0, 1.0, 10.0])
def test_backscatter_centers_on_minus_the_ego_speed(speed):
    noise = weather.noise_profile("rain", GRID, PARAMETERS, np.array([speed, 0.0]))
    step = GRID.doppler_mps[1] - GRID.doppler_mps[0]
    expected = (-speed - GRID.doppler_mps[0]) % (64 * step) / step
    peak = noise[20].argmax()
    assert abs((peak - expected + 32) % 64 - 32) <= 0.5


def test_order_of_weathers():
    def clutter(name):
        return weather.noise_profile(name, GRID, PARAMETERS, np.zeros(2))[10].sum()

    assert clutter("rain") > clutter("heavysnow") > clutter("lightsnow")
    assert clutter("lightsnow") > clutter("fog") > clutter("normal") * 0.999


def test_rain_is_ten_millimetres_an_hour():
    # ITU-R P.838-3 at 77 GHz, horizontal: k = 1.132, alpha = 0.7177; and 24 dBZ in
    # Rayleigh's law, pi^5 |K|^2 Z / lambda^4 with |K|^2 = 0.7.
    law = weather.WEATHERS["rain"]
    assert law.attenuation_db_per_km == pytest.approx(1.132 * 10**0.7177, abs=0.2)
    reflectivity = np.pi**5 * 0.7 * 10**2.4 * 1e-18 / PARAMETERS.wavelength_m**4
    assert law.backscatter_db == pytest.approx(10 * np.log10(reflectivity), abs=0.5)
