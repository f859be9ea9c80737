"""Propagation at 77 GHz: effects of weather and two-ray reflection at the road.

Rain is modeled at a rate of about 10 mm/h. Its backscatter corresponds to a reflectivity
of 24 dBZ, which large drops do not exceed at this wavelength. The values of snow, fog and
radome losses are our choice. Their order is known: fog has hardly any effect, dry snow
attenuates less than rain and melting snow more. The actual values vary.

Between radar and target there is a second path, reflected by the road and longer by a few
wavelengths. The two paths on the way there and the two on the way back give four
combinations. Near grazing incidence an even road reflects almost completely, so the
combinations add up to 12 dB more power or nearly cancel. The model gives the reflected path
the direction of the direct path, because 1.5 m of mirrored height correspond to one
elevation beam at 10 m and to less than one beyond. Hills, kerbs and vehicles in between are
neglected.

References:
    Attenuation by rain: ITU-R P.838-3, 5.9 dB/km at 10 mm/h and 11.4 dB/km at 25 mm/h
    (77 GHz, horizontal polarization).
    Attenuation and backscatter of rain in automotive radar: Zang et al., "The impact of
    adverse weather conditions on autonomous vehicles", IEEE Vehicular Technology Magazine
    2019.
    Melting snow attenuates more than rain with the same amount of water: Jain and Watson,
    "Attenuation in melting snow on microwave- and millimeter-wave terrestrial radio links",
    Electronics Letters 1985.
    Reflection: Fresnel's equations; loss of coherence by roughness: Ament, "Toward a
    theory of reflection by a rough surface", Proc. IRE 1953. Asphalt: Locatelli,
    Alvarez-Perez and Yarovoy, "Multipath model improvement for automotive radar
    application", EuCAP 2024. Snow: Lammers and Hayes, "Multipath propagation over snow at
    millimeter wavelengths", RADC 1980 (coherent at grazing angles under 2 degrees, nulls
    of 20 dB and deeper).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Inexact

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar import sensor
from radejax.simulation.radar.tensor import RadarParameters

Cells = Float[np.ndarray, "*cells"]
Points = Float[np.ndarray, "S 3"]


class Surface(NamedTuple):
    """Surface of the road.

    Attributes:
        permittivity: Complex relative permittivity.
        roughness_m: Standard deviation of the height.
    """

    permittivity: complex
    roughness_m: float


_DRY = Surface(3.2 - 0.1j, 0.0008)
_WET = Surface(7.6 - 12.6j, 0.0004)
_SNOW = Surface(1.6 - 0.01j, 0.004)


class Weather(NamedTuple):
    """Effects of one kind of weather on the received signal.

    Attributes:
        attenuation_db_per_km: One-way attenuation in the air.
        radome_db: Two-way loss by water or snow on the sensor.
        backscatter_db: Cross-section of the falling particles in dB of m2 per m3.
        spread_mps: Standard deviation of the particles' radial velocities.
        surface: Surface of the road. Its values are our choice, of the usual order: dry
            asphalt, a film of water that fills the asphalt's pores in rain and sleet, or
            loose snow.
    """

    attenuation_db_per_km: float
    radome_db: float
    backscatter_db: float
    spread_mps: float
    surface: Surface


WEATHERS = {
    "normal": Weather(0.0, 0.0, -90.0, 1.0, _DRY),
    "overcast": Weather(0.0, 0.0, -90.0, 1.0, _DRY),
    "fog": Weather(0.5, 0.5, -65.0, 0.5, _DRY),
    "rain": Weather(6.0, 2.0, -36.0, 1.0, _WET),
    "sleet": Weather(8.0, 3.0, -37.0, 0.8, _WET),
    "lightsnow": Weather(1.0, 1.0, -50.0, 0.6, _SNOW),
    "heavysnow": Weather(4.0, 3.0, -43.0, 0.8, _SNOW),
}
"""K-Radar's seven weathers."""


def attenuation(weather: str, distance_m: Cells) -> Cells:
    """Computes the factor on the received power by two-way attenuation and radome loss."""
    law = WEATHERS[weather]
    loss_db = 2.0 * law.attenuation_db_per_km * distance_m / 1000.0 + law.radome_db
    factor: Cells = 10.0 ** (-loss_db / 10.0)
    return factor


def noise_profile(
    weather: str,
    grid: RadarGrid,
    parameters: RadarParameters,
    ego_velocity_mps: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "R D"]:
    """Computes the mean power of noise, ground clutter and backscatter by range and Doppler.

    The echoes of many drops, or of many stones and leaves, in one cell add up to a complex
    Gaussian, so they are modeled as noise and not as scatterers. At range R, the cell of a
    beam of solid angle W has a volume of R^2 W dR, so the power of drops falls with R^-2.
    Drops have no mean velocity over ground. Their range rate is minus the ego speed plus a
    spread, on a Doppler axis that wraps around. The ground fills R dR of a beam's width.
    Its range rates are those of points at rest in all azimuth bins.

    Returns:
        float32 linear power.
    """
    law = WEATHERS[weather]
    width = parameters.scan_beamwidth_rad or 2.4 / parameters.azimuth_elements
    beam = width * (2.4 / parameters.elevation_elements)
    distance = np.maximum(grid.range_m, 1.0)
    volume = distance**2 * beam * grid.range_widths_m
    area = distance * width * grid.range_widths_m
    level_db = parameters.gain_db + parameters.receiver_db
    high_pass = sensor.high_pass(distance, parameters.high_pass_m)
    way = attenuation(weather, distance) * high_pass
    of_drops = 10.0 ** ((level_db + law.backscatter_db) / 10.0)
    rain = of_drops * (volume / distance**4 * way)
    of_stones = 10.0 ** (level_db / 10.0) * parameters.ground_clutter
    ground = of_stones * (area / distance**4 * way)
    speed = ego_velocity_mps[:1]
    of_rain = _doppler_share(-speed, law.spread_mps, grid)
    of_ground = _doppler_share(-speed * np.cos(grid.azimuth_rad), None, grid)
    noise = sensor.receiver_noise(grid, parameters)
    noise += rain[:, None] * of_rain
    noise += ground[:, None] * of_ground
    return noise.astype(np.float32)


def _doppler_share(
    mean_mps: Float[np.ndarray, " K"], spread_mps: float | None, grid: RadarGrid
) -> Float[np.ndarray, " D"]:
    """Returns the fraction of power in each Doppler bin.

    Args:
        mean_mps: Range rates.
        spread_mps: Standard deviation around each of them, or None for half a bin.
        grid: Sensor axes, whose Doppler axis wraps around.
    """
    if grid.num_doppler < 2:
        return np.ones(1)
    step = grid.doppler_mps[1] - grid.doppler_mps[0]
    period = step * grid.num_doppler
    folds = np.arange(-6, 7) * period
    offset = grid.doppler_mps - mean_mps[:, None]  # [K, D]
    offset = np.mod(offset + period / 2, period) - period / 2
    spread = (offset[..., None] + folds) / (spread_mps or step / 2.0)
    density = np.exp(-0.5 * spread**2).sum(-1)
    share: Float[np.ndarray, " D"] = (density / density.sum(-1, keepdims=True)).mean(0)
    return share


def reflection(
    sine: Float[np.ndarray, "*targets"], surface: Surface, wavelength_m: float
) -> Inexact[np.ndarray, "*targets"]:
    """Computes the complex reflection coefficient of the coherent field.

    The polarization is horizontal.

    Args:
        sine: Sine of the grazing angle.
        surface: Reflecting surface.
        wavelength_m: Wavelength.
    """
    root = np.sqrt(surface.permittivity - (1.0 - sine**2))
    rough = 2.0 * np.pi * surface.roughness_m * sine / wavelength_m
    coherent: Inexact[np.ndarray, "*targets"] = (
        (sine - root) / (sine + root) * np.exp(-2.0 * rough**2)
    )
    return coherent


def bounce(
    position_m: Points, ground_m: float, surface: Surface, wavelength_m: float
) -> Complex[np.ndarray, " S"]:
    """Computes the two-way factor on the amplitude of targets above a flat road.

    The factor is `(1 + rho exp(i 2 pi d / wavelength))^2`, where rho is the reflection
    coefficient and d the difference in length between the reflected and the direct path.
    The square accounts for the way there and the way back.

    Args:
        position_m: Positions of the targets in the radar frame.
        ground_m: Height of the road in the radar frame (negative). Targets below the road
            are treated as lying on it.
        surface: Surface of the road.
        wavelength_m: Wavelength.
    """
    flat = np.hypot(position_m[:, 0], position_m[:, 1])
    radar_height = -ground_m
    height = np.maximum(position_m[:, 2] - ground_m, 0.0)
    direct = np.hypot(flat, height - radar_height)
    bounced = np.maximum(np.hypot(flat, height + radar_height), 1e-6)
    rho = reflection((height + radar_height) / bounced, surface, wavelength_m)
    turn = 2.0 * np.pi * (bounced - direct) / wavelength_m
    factor: Complex[np.ndarray, " S"] = np.square(1.0 + rho * np.exp(1j * turn))
    return factor
