"""What weather does to a 77 GHz radar: attenuation, a wet radome, backscatter.

Rain is that of about 10 mm/h. Its backscatter is that of a reflectivity of 24 dBZ, which
large drops do not exceed at this wavelength. Snow, fog and the losses on the radome are
our choice: the order is known (fog next to nothing, dry snow less than rain, melting snow
more), the values depend on the day.

References:
    Rain on the way: ITU-R P.838-3, 5.9 dB/km at 10 mm/h and 11.4 at 25 mm/h (77 GHz,
    horizontal polarisation).
    Both effects of rain on automotive radar: Zang et al., "The impact of adverse weather
    conditions on autonomous vehicles", IEEE Vehicular Technology Magazine 2019.
    Melting snow attenuates more than rain of its water: Jain and Watson, "Attenuation in
    melting snow on microwave- and millimetre-wave terrestrial radio links", Electronics
    Letters 1985.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from radejax.geometry.radar_grid import RadarGrid
from radejax.simulation.radar.tensor import RadarParameters


@dataclasses.dataclass(frozen=True)
class Weather:
    """How one kind of weather changes what the radar receives.

    Attributes:
        attenuation_db_per_km: Loss on the way, one way.
        radome_db: Loss by water or snow on the sensor, there and back.
        backscatter_db: Cross-section of the falling particles in dB of m2 per m3.
        spread_mps: Standard deviation of the particles' radial velocities.
    """

    attenuation_db_per_km: float
    radome_db: float
    backscatter_db: float
    spread_mps: float


WEATHERS = {
    "normal": Weather(0.0, 0.0, -90.0, 1.0),
    "overcast": Weather(0.0, 0.0, -90.0, 1.0),
    "fog": Weather(0.5, 0.5, -65.0, 0.5),
    "rain": Weather(6.0, 2.0, -36.0, 1.0),
    "sleet": Weather(8.0, 3.0, -37.0, 0.8),
    "lightsnow": Weather(1.0, 1.0, -50.0, 0.6),
    "heavysnow": Weather(4.0, 3.0, -43.0, 0.8),
}
"""K-Radar's seven weathers."""


def attenuation(
    weather: str, distance_m: Float[np.ndarray, "*cells"]
) -> Float[np.ndarray, "*cells"]:
    """Factor on received power at distances: the way there and back, and the radome."""
    law = WEATHERS[weather]
    loss_db = 2.0 * law.attenuation_db_per_km * distance_m / 1000.0 + law.radome_db
    return 10.0 ** (-loss_db / 10.0)


def noise_profile(
    weather: str,
    grid: RadarGrid,
    parameters: RadarParameters,
    ego_velocity_mps: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "R D"]:
    """Mean noise power of range and Doppler cells: receiver plus backscatter.

    Many drops in one cell add up to a complex Gaussian, like noise, so they need no
    scatterers. The cell of beam solid angle W at range R holds R^2 W dR cubic metres,
    so its power falls with R^-2. Drops stand still in the air: their range rate is
    minus the ego speed, plus a spread, on an axis that wraps around.

    Returns:
        float32 linear power.
    """
    law = WEATHERS[weather]
    beam = (2.4 / parameters.azimuth_elements) * (2.4 / parameters.elevation_elements)
    distance = np.maximum(grid.range_m, 1.0)
    volume = distance**2 * beam * grid.range_step_m
    clutter = 10.0 ** ((parameters.gain_db + law.backscatter_db) / 10.0) * (
        volume / distance**4 * attenuation(weather, distance)
    )
    step = grid.doppler_mps[1] - grid.doppler_mps[0]
    period = step * grid.num_doppler
    offset = grid.doppler_mps + ego_velocity_mps[0]
    folds = np.arange(-6, 7) * period
    offset = np.mod(offset + period / 2, period) - period / 2
    density = np.exp(-0.5 * ((offset[:, None] + folds) / law.spread_mps) ** 2).sum(1)
    share = density / density.sum()
    noise = 10.0 ** (parameters.noise_db / 10.0)
    return (noise + clutter[:, None] * share[None]).astype(np.float32)
