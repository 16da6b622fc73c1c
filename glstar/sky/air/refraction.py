"""Refraction of true and apparent altitudes, and of unit vectors without trigonometric functions."""

from math import sin

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.sky.place.site import STANDARD_PRESSURE_HPA

# Eq. (25) is a fit for higher altitudes, rad: below, it decreases again, and it is singular at -5.11 deg.
LOWEST_ALTITUDE_RAD = np.deg2rad(-1.0)
# Margin of a cone in unrefracted directions, rad: refraction is at most 0.7 deg, and aberration 0.01 deg.
MAX_REFRACTION_RAD = np.deg2rad(1.0)

# Meeus's constant, ', which makes the refraction at the zenith zero; eq. (25) gives -0.116" there.
_ZENITH_ARCMIN = 0.0019279

_ARCMIN_RAD = np.pi / 10800


def refraction_scale(pressure_hpa: float, temperature_c: float) -> float:
    """Return the ratio of the refractions of air at the observer and of standard air, 1010 hPa and 10 deg C.

    Teague & Chahl, eq. (28).
    """
    return pressure_hpa / STANDARD_PRESSURE_HPA * 283 / (273 + temperature_c)


def refraction_rad(altitude_rad: ArrayLike, scale: float = 1.0) -> Float:
    """Return the refraction of a true altitude: the apparent altitude minus the true altitude.

    `altitude_rad` (...): below -1 deg, the refraction of -1 deg is returned; `scale`: see `refraction_scale`.

    Teague & Chahl, eq. (25); Meeus, eq. (16.4).  Departs from eq. (25): 0.0019279' are added, which makes the
    refraction at the zenith zero; and the formula is used down to -1 deg only, because it is singular at -5.11 deg and
    would raise stars from below the horizon.
    """
    altitude_deg = np.rad2deg(np.maximum(np.asarray(altitude_rad, dtype=np.float64), LOWEST_ALTITUDE_RAD))
    arcmin = 1.02 / np.tan(np.deg2rad(altitude_deg + 10.3 / (altitude_deg + 5.11))) + _ZENITH_ARCMIN
    return scale * arcmin * _ARCMIN_RAD


def bennett_refraction_rad(apparent_altitude_rad: ArrayLike, scale: float = 1.0) -> Float:
    """Return Bennett's refraction of an apparent altitude, for correcting observations.

    `apparent_altitude_rad` (...): at least 0; `scale`: see `refraction_scale`.  Teague & Chahl, eq. (27).  It inverts
    eq. (25) as printed within 3.7", and `refraction_rad` within 3.8"; `true_altitude_rad` is the exact inverse.
    """
    altitude_deg = np.rad2deg(np.asarray(apparent_altitude_rad, dtype=np.float64))
    return scale * _ARCMIN_RAD / np.tan(np.deg2rad(altitude_deg + 7.31 / (altitude_deg + 4.4)))


def true_altitude_rad(apparent_altitude_rad: ArrayLike, scale: float = 1.0) -> Float:
    """Return true altitudes of apparent altitudes, (...): the exact inverse of `refraction_rad`.

    `scale`: see `refraction_scale`.  Teague & Chahl, eq. (26) solved for its altitude.
    """
    apparent = np.asarray(apparent_altitude_rad, dtype=np.float64)
    true = apparent
    # Fixed-point iteration: each step reduces the error by a factor below 0.4, even in the densest air at the horizon.
    for _ in range(40):
        true = apparent - refraction_rad(true, scale)
    return true


def refraction_displacement(sine_altitude: ArrayLike, scale: float = 1.0) -> Float:
    """Return the multiple of the zenith vector that refraction adds to the unit vector of a star, (...).

    `sine_altitude` (...): sine of the true altitude, u . zenith; below -1 deg, the value at -1 deg is returned;
    `scale`: see `refraction_scale`; 0 for no refraction.

    A rotation of a unit vector u towards the zenith by the refraction R gives the direction of u + q zenith, with q =
    sin R / cos(h + R).  A rational fit of q to Teague & Chahl, eqs (25), (26), to 0.002" down to -1 deg, also in
    `star.vert`.
    """
    s = np.maximum(np.asarray(sine_altitude, dtype=np.float64), sin(LOWEST_ALTITUDE_RAD))
    # Horner's rule in place: 8.431267579e-3 + s (9.001200823e-2 - 5.085505610e-2 s), and so on.
    above = _horner(s, -5.085505610e-2, 9.001200823e-2, 8.431267579e-3)
    above /= _horner(s, -171.7474067, 303.4601537, 27.89442102, 1.0)
    above *= scale
    return above


def _horner(s: Float, *coefficients: float) -> Float:
    """Return the value of a polynomial; coefficients from the highest power down."""
    first, second, *others = coefficients
    value = s * first
    value += second
    for coefficient in others:
        value *= s
        value += coefficient
    return value
