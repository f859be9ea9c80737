"""The road as a mirror against Fresnel, optics of two ways, and its far limit."""

import numpy as np
import pytest

from radejax.simulation.radar import two_ray
from radejax.simulation.radar.weather import WEATHERS

WAVELENGTH = 0.0039
METAL = two_ray.Surface(-1e12j, 0.0)
EVEN = two_ray.Surface(4.0, 0.0)


def test_every_weather_has_a_surface():
    assert set(two_ray.SURFACES) == set(WEATHERS)


class TestReflection:
    def test_straight_down_by_hand(self):
        # (1 - n) / (1 + n) with refractive index 2: -1/3, +1/3 for the other sign rule.
        assert two_ray.reflection(1.0, EVEN, WAVELENGTH) == pytest.approx(-1 / 3)
        vertical = two_ray.reflection(1.0, EVEN, WAVELENGTH, vertical=True)
        assert vertical == pytest.approx(1 / 3)

    def test_minus_one_at_grazing_incidence(self):
        for vertical in (False, True):
            found = two_ray.reflection(1e-9, EVEN, WAVELENGTH, vertical=vertical)
            assert found == pytest.approx(-1.0, abs=1e-6)

    def test_brewsters_angle(self):
        # No vertical reflection where the tangent of the angle of incidence is n = 2.
        sine = np.cos(np.arctan(2.0))
        found = two_ray.reflection(sine, EVEN, WAVELENGTH, vertical=True)
        assert abs(found) < 1e-12

    def test_roughness_by_hand(self):
        # Height deviation of lambda / (4 pi) at a sine of 1: exp(-1/2).
        rough = two_ray.Surface(4.0, WAVELENGTH / (4.0 * np.pi))
        ratio = two_ray.reflection(1.0, rough, WAVELENGTH) / two_ray.reflection(
            1.0, EVEN, WAVELENGTH
        )
        assert ratio == pytest.approx(np.exp(-0.5))

    def test_wet_roads_mirror_more_than_dry_ones_and_snow_least(self):
        rain, dry, snow = (
            abs(two_ray.reflection(0.1, two_ray.SURFACES[w], WAVELENGTH))
            for w in ("rain", "normal", "heavysnow")
        )
        assert rain > dry > snow


class TestBounce:
    def test_peaks_and_nulls_where_the_ways_differ_by_half_wavelengths(self):
        # Both heights h, ground distance D: the bounced way is sqrt(D^2 + 4 h^2).
        height, wanted = 0.9, np.array([20.0, 20.5])  # wavelengths of difference
        longer = wanted * WAVELENGTH
        distance = (4 * height**2 - longer**2) / (2 * longer)
        at = np.stack([distance, 0 * distance, 0 * distance], 1)
        power = np.abs(two_ray.bounce(at, -height, METAL, WAVELENGTH)) ** 2
        # The metal turns the phase: whole wavelengths cancel, halves add to 16.
        np.testing.assert_allclose(power, [0.0, 16.0], atol=1e-3)

    def test_far_away_power_falls_with_the_eighth_power(self):
        # Targets below the first lobe: F ~ 4 pi h1 h2 / (lambda R), R^-4 of its own.
        at = np.array([[2000.0, 0, -0.7], [4000.0, 0, -0.7]])
        power = np.abs(two_ray.bounce(at, -0.9, METAL, WAVELENGTH)) ** 2
        drop = 10 * np.log10(power[0] / power[1])
        assert drop == pytest.approx(12.04, abs=0.5)

    def test_nothing_comes_back_from_an_even_metal_floor_itself(self):
        at = np.array([[20.0, 5.0, -0.9], [20.0, 5.0, -1.3]])
        np.testing.assert_allclose(
            two_ray.bounce(at, -0.9, METAL, WAVELENGTH), 0.0, atol=1e-6
        )

    def test_without_reflection_nothing_changes(self):
        air = two_ray.Surface(1.0, 0.0)
        at = np.array([[20.0, 5.0, 0.3]])
        np.testing.assert_allclose(two_ray.bounce(at, -0.9, air, WAVELENGTH), 1.0)

    def test_equals_the_sum_of_four_ways(self):
        at = np.array([[13.0, -4.0, 0.4]])
        radar, image = np.zeros(3), np.array([0.0, 0.0, -1.8])
        target = at[0]
        direct, bounced = (np.linalg.norm(target - p) for p in (radar, image))
        sine = (target[2] + 1.8) / bounced
        rho = two_ray.reflection(sine, EVEN, WAVELENGTH)
        ways = [
            np.prod([1.0 if leg == direct else rho for leg in (there, back)])
            * np.exp(2j * np.pi * (there + back - 2 * direct) / WAVELENGTH)
            for there in (direct, bounced)
            for back in (direct, bounced)
        ]
        found = two_ray.bounce(at, -0.9, EVEN, WAVELENGTH)
        np.testing.assert_allclose(found, [np.sum(ways)], rtol=1e-9)
