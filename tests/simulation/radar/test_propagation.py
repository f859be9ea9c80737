"""Attenuation and backscatter of weather against hand-worked numbers."""

from __future__ import annotations

import numpy as np
import pytest

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import propagation
from radejax.simulation.radar.tensor import RadarParameters

GRID = RadarGrid.kradar()
PARAMETERS = RadarParameters()


def test_attenuation_by_hand():
    # Rain: 6 dB/km there and back over 100 m is 1.2 dB, and 2 dB on the radome.
    factor = propagation.attenuation("rain", np.array([100.0]))
    assert 10 * np.log10(factor[0]) == pytest.approx(-3.2)
    assert propagation.attenuation("normal", np.array([100.0]))[0] == 1.0


def test_clear_air_is_the_receiver_noise():
    noise = propagation.noise_profile("normal", GRID, PARAMETERS, np.zeros(2))
    floor_db = 10 * np.log10(noise[20:])
    np.testing.assert_allclose(floor_db, PARAMETERS.noise_db, atol=0.01)


def test_backscatter_falls_with_the_square_of_range():
    # 20 dB per decade, and the extra way of 54 m at 6 dB/km there and back.
    noise = propagation.noise_profile("rain", GRID, PARAMETERS, np.zeros(2))
    clutter = (noise - 10 ** (PARAMETERS.noise_db / 10)).sum(1, dtype=np.float64)
    near, far = 13, 130
    drop = 10 * np.log10(clutter[near] / clutter[far])
    way = GRID.range_m[far] - GRID.range_m[near]
    assert drop == pytest.approx(20.0 + 2 * 6.0 * way / 1000.0, abs=0.1)


@pytest.mark.parametrize("speed", [0.0, 1.0, 10.0])
def test_backscatter_centers_on_minus_the_ego_speed(speed):
    noise = propagation.noise_profile("rain", GRID, PARAMETERS, np.array([speed, 0.0]))
    step = GRID.doppler_mps[1] - GRID.doppler_mps[0]
    expected = (-speed - GRID.doppler_mps[0]) % (64 * step) / step
    peak = noise[20].argmax()
    assert abs((peak - expected + 32) % 64 - 32) <= 0.5


def test_rain_is_ten_millimeters_an_hour():
    # ITU-R P.838-3 at 77 GHz, horizontal: k = 1.132, alpha = 0.7177; and 24 dBZ in
    # Rayleigh's law, pi^5 |K|^2 Z / lambda^4 with |K|^2 = 0.7.
    law = propagation.WEATHERS["rain"]
    assert law.attenuation_db_per_km == pytest.approx(1.132 * 10**0.7177, abs=0.2)
    reflectivity = np.pi**5 * 0.7 * 10**2.4 * 1e-18 / PARAMETERS.wavelength_m**4
    assert law.backscatter_db == pytest.approx(10 * np.log10(reflectivity), abs=0.5)


WAVELENGTH = 0.0039
METAL = propagation.Surface(-1e12j, 0.0)
EVEN = propagation.Surface(4.0, 0.0)


def _reflection(sine, surface):
    return propagation.reflection(np.array([sine]), surface, WAVELENGTH)[0]


class TestReflection:
    def test_minus_one_at_grazing_incidence(self):
        assert _reflection(1e-9, EVEN) == pytest.approx(-1.0, abs=1e-6)

    def test_roughness_by_hand(self):
        # Height deviation of lambda / (4 pi) at a sine of 1: exp(-1/2).
        rough = propagation.Surface(4.0, WAVELENGTH / (4.0 * np.pi))
        ratio = _reflection(1.0, rough) / _reflection(1.0, EVEN)
        assert ratio == pytest.approx(np.exp(-0.5))
        # (1 - n) / (1 + n) with refractive index 2.
        assert _reflection(1.0, EVEN) == pytest.approx(-1 / 3)


class TestBounce:
    def test_peaks_and_nulls_where_the_ways_differ_by_half_wavelengths(self):
        # Both heights h, ground distance D: the bounced way is sqrt(D^2 + 4 h^2).
        height, wanted = 0.9, np.array([20.0, 20.5])  # wavelengths of difference
        longer = wanted * WAVELENGTH
        distance = (4 * height**2 - longer**2) / (2 * longer)
        at = np.stack([distance, 0 * distance, 0 * distance], 1)
        power = np.abs(propagation.bounce(at, -height, METAL, WAVELENGTH)) ** 2
        # The metal turns the phase: whole wavelengths cancel, halves add to 16.
        np.testing.assert_allclose(power, [0.0, 16.0], atol=1e-3)

    def test_nothing_comes_back_from_an_even_metal_floor_itself(self):
        at = np.array([[20.0, 5.0, -0.9], [20.0, 5.0, -1.3]])
        found = propagation.bounce(at, -0.9, METAL, WAVELENGTH)
        np.testing.assert_allclose(found, 0.0, atol=1e-6)

    def test_equals_the_sum_of_four_ways(self):
        at = np.array([[13.0, -4.0, 0.4]])
        radar, image = np.zeros(3), np.array([0.0, 0.0, -1.8])
        target = at[0]
        direct, bounced = (np.linalg.norm(target - p) for p in (radar, image))
        sine = (target[2] + 1.8) / bounced
        rho = _reflection(sine, EVEN)
        ways = [
            np.prod([1.0 if leg == direct else rho for leg in (there, back)])
            * np.exp(2j * np.pi * (there + back - 2 * direct) / WAVELENGTH)
            for there in (direct, bounced)
            for back in (direct, bounced)
        ]
        found = propagation.bounce(at, -0.9, EVEN, WAVELENGTH)
        np.testing.assert_allclose(found, [np.sum(ways)], rtol=1e-9)
