"""The road as a mirror: the bounce that makes far targets fade and flash (two-ray).

Between radar and target there is a second way over the road, longer by a few
wavelengths. There and back, the two ways combine to four; near grazing incidence an even
road reflects almost everything, so they add up to 12 dB more or nearly cancel.

The bounced way is given the direction of the direct one: 1.5 m of mirrored height are
one beam of elevation at 10 m and less beyond. Hills, kerbs and vehicles in between do not
disturb it.

References:
    Fresnel's equations; loss of coherence by roughness: Ament, "Toward a theory of
    reflection by a rough surface", Proc. IRE 1953. Asphalt: Locatelli, Alvarez-Perez and
    Yarovoy, "Multipath model improvement for automotive radar application", EuCAP 2024.
    Snow: Lammers and Hayes, "Multipath propagation over snow at millimeter wavelengths",
    RADC 1980 (coherent at grazing angles under 2 degrees, nulls of 20 dB and deeper).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Inexact


@dataclasses.dataclass(frozen=True)
class Surface:
    """What covers the road.

    Attributes:
        permittivity: Relative, complex.
        roughness_m: Standard deviation of height.
    """

    permittivity: complex
    roughness_m: float


_DRY = Surface(3.2 - 0.1j, 0.0008)
_WET = Surface(7.6 - 12.6j, 0.0004)
_SNOW = Surface(1.6 - 0.01j, 0.004)

SURFACES = {
    "normal": _DRY,
    "overcast": _DRY,
    "fog": _DRY,
    "rain": _WET,
    "sleet": _WET,
    "lightsnow": _SNOW,
    "heavysnow": _SNOW,
}
"""Surface per weather. Our choice: values of the usual order, a film of water that fills
the asphalt's pores in rain and sleet, loose snow."""


def reflection(
    sine: float | Float[np.ndarray, "*targets"],
    surface: Surface,
    wavelength_m: float,
    *,
    vertical: bool = False,
) -> Inexact[Any, "*targets"]:
    """Complex reflection coefficient of the mean field.

    Args:
        sine: Sine of the grazing angle.
        surface: What reflects.
        wavelength_m: Wavelength.
        vertical: Polarisation; the coefficient is -1 at grazing incidence for both.
    """
    sine = np.asarray(sine, float)
    root = np.sqrt(surface.permittivity - (1.0 - sine**2))
    first = surface.permittivity * sine if vertical else sine
    fresnel = (first - root) / (first + root)
    rough = 2.0 * np.pi * surface.roughness_m * sine / wavelength_m
    return fresnel * np.exp(-2.0 * rough**2)


def bounce(
    position_m: Float[np.ndarray, "S 3"],
    ground_m: float,
    surface: Surface,
    wavelength_m: float,
) -> Complex[np.ndarray, " S"]:
    """Factor on the amplitude of targets over a flat road, two-way.

    `(1 + rho exp(i 2 pi d / wavelength))^2`: direct and bounced on the way there times
    the same on the way back; d is how much longer the bounced way is.

    Args:
        position_m: In the radar's frame.
        ground_m: Height of the road in that frame (negative). Targets lower than it
            count as lying on it.
        surface: What covers the road.
        wavelength_m: Wavelength.
    """
    flat = np.hypot(position_m[:, 0], position_m[:, 1])
    radar_height = -ground_m
    height = np.maximum(position_m[:, 2] - ground_m, 0.0)
    direct = np.hypot(flat, height - radar_height)
    bounced = np.maximum(np.hypot(flat, height + radar_height), 1e-6)
    rho = reflection((height + radar_height) / bounced, surface, wavelength_m)
    turn = 2.0 * np.pi * (bounced - direct) / wavelength_m
    return np.square(1.0 + rho * np.exp(1j * turn))
