"""Apparent magnitudes of the Sun, the Moon and the planets.

The planets follow Mallama & Hilton 2018 (Astronomy and Computing 25, 10), without the rotation of Mars (0.06 mag).
"""

from math import asin, degrees, exp, log10, sin, sqrt
from typing import Final

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from glstar.sky.apparent import direction

__all__ = ["moon_vmag", "planet_vmag", "sun_vmag"]

Float = NDArray[np.float64]

# V of the Sun at 1 au.
_SUN_VMAG: Final = -26.75
# V of the full Moon at its mean distance and 1 au from the Sun, and that distance, km: Allen's law.
_FULL_MOON_VMAG: Final = -12.73
_MEAN_MOON_KM: Final = 384400.0

# Coefficients of powers of the phase angle in degrees, with the constant first.
_MERCURY: Final = (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)
_VENUS: Final = (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)
_VENUS_CRESCENT: Final = (236.05828, -2.81914, 8.39034e-3)  # above 163.7 deg
_MARS: Final = (-1.601, 2.267e-2, -1.302e-4)
_MARS_GIBBOUS: Final = (-0.367, -0.02573, 3.445e-4)  # above 50 deg, not seen from the Earth
_JUPITER: Final = (-9.395, -3.7e-4, 6.16e-4)

# North poles of rotation, J2000, deg: the IAU's working group on cartographic coordinates.
_SATURN_POLE: Final = direction(np.deg2rad(40.589), np.deg2rad(83.537))
_URANUS_POLE: Final = direction(np.deg2rad(257.311), np.deg2rad(-15.175))


def sun_vmag(distance_au: float) -> float:
    """Return the V magnitude of the Sun.

    Parameters
    ----------
    distance_au : float
        Distance from the observer, au.

    Returns
    -------
    float
    """
    return _SUN_VMAG + 5 * log10(distance_au)


def moon_vmag(phase_angle_rad: float, distance_km: float, sun_distance_au: float) -> float:
    """Return the V magnitude of the Moon.

    Parameters
    ----------
    phase_angle_rad : float
        Angle between Sun and observer at the Moon, rad.
    distance_km : float
        Distance from the observer, km.
    sun_distance_au : float
        Distance of the Moon from the Sun, au.

    Returns
    -------
    float

    Notes
    -----
    Allen, Astrophysical Quantities: V = -12.73 + 0.026 a + 4e-9 a^4 with the phase angle a in degrees; valid up to
    about 150 deg, and too faint near new Moon.
    """
    angle_deg = degrees(phase_angle_rad)
    at_mean_distance = _FULL_MOON_VMAG + 0.026 * angle_deg + 4e-9 * angle_deg**4
    return at_mean_distance + 5 * log10(distance_km / _MEAN_MOON_KM * sun_distance_au)


def planet_vmag(name: str, from_sun_au: Float, from_observer_au: Float, phase_angle_rad: float, year: float) -> float:
    """Return the V magnitude of a planet.

    Parameters
    ----------
    name : str
        A key of `glstar.sky.ephemeris.PLANETS`.
    from_sun_au, from_observer_au : (3,) float64
        The planet's position from the Sun and from the observer, ICRS axes, au.
    phase_angle_rad : float
        Angle between Sun and observer at the planet, rad.
    year : float
        Julian year, for Neptune, which brightened from 1980 to 2000.

    Returns
    -------
    float

    Notes
    -----
    Mallama & Hilton 2018, eqs (2) to (17): V(1, 0) and the phase law, plus 5 log10(r d).
    """
    a = degrees(phase_angle_rad)
    r, d = float(np.linalg.norm(from_sun_au)), float(np.linalg.norm(from_observer_au))
    match name:
        case "Mercury":
            at_1_au = _series(_MERCURY, a)
        case "Venus":
            at_1_au = _series(_VENUS if a < 163.7 else _VENUS_CRESCENT, a)
        case "Mars":
            at_1_au = _series(_MARS if a <= 50 else _MARS_GIBBOUS, a)
        case "Jupiter":
            at_1_au = _series(_JUPITER, a)
        case "Saturn":
            tilt = _ring_tilt_rad(from_sun_au / r, from_observer_au / d)
            at_1_au = -8.914 - 1.825 * sin(tilt) + 0.026 * a - 0.378 * sin(tilt) * exp(-2.25 * a)
        case "Uranus":
            latitudes_deg = [degrees(_latitude_rad(_URANUS_POLE, v)) for v in (from_sun_au / r, from_observer_au / d)]
            at_1_au = -7.110 - 0.00084 * (abs(latitudes_deg[0]) + abs(latitudes_deg[1])) / 2
            at_1_au += _series((0.0, 6.587e-3, 1.045e-4), a) if a > 3.1 else 0.0
        case "Neptune":
            at_1_au = min(max(-6.89 - 0.0054 * (year - 1980), -7.00), -6.89)
            at_1_au += _series((0.0, 7.944e-3, 9.617e-5), a) if a > 1.9 and year >= 2000 else 0.0
        case _:
            raise ValueError(f"no magnitude of {name}")
    return at_1_au + 5 * log10(r * d)


def _series(coefficients: tuple[float, ...], phase_angle_deg: float) -> float:
    return float(polyval(phase_angle_deg, coefficients))


def _ring_tilt_rad(from_sun: Float, from_observer: Float) -> float:
    """Return the geometric mean of the latitudes of Sun and observer on Saturn; 0 on opposite sides of the rings."""
    product = _latitude_rad(_SATURN_POLE, from_sun) * _latitude_rad(_SATURN_POLE, from_observer)
    return sqrt(product) if product > 0 else 0.0


def _latitude_rad(pole: Float, towards_planet: Float) -> float:
    """Return the planetocentric latitude of somebody who sees the planet in a direction."""
    return asin(max(-1.0, min(1.0, -float(pole @ towards_planet))))
