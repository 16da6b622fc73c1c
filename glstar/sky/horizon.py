"""Horizontal coordinates: hour angles, azimuth and altitude, refraction.

Tables and labels use the angles of eqs (22)-(29).  The renderer does the same calculation with vectors, by `C_ned_eq`
and `refraction_displacement`, without asin and tan.
"""

from math import acos, cos, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.sky.site import STANDARD_PRESSURE_HPA

__all__ = [
    "C_ned_eq",
    "azimuth_altitude_rad",
    "bennett_refraction_rad",
    "dip_rad",
    "diurnal_aberration_rad",
    "hour_angle_rad",
    "ned_direction",
    "ned_to_azimuth_altitude_rad",
    "refraction_displacement",
    "refraction_rad",
    "refraction_scale",
    "true_altitude_rad",
]

Float = NDArray[np.float64]

# Eq. (25) is a fit for higher altitudes, rad: below, it decreases again, and it is singular at -5.11 deg.
LOWEST_ALTITUDE_RAD: Final = np.deg2rad(-1.0)
# Margin of a cone in unrefracted directions, rad: refraction is at most 0.7 deg, and aberration 0.01 deg.
MAX_REFRACTION_RAD: Final = np.deg2rad(1.0)

# Meeus's constant, ', which makes the refraction at the zenith zero; eq. (25) gives -0.116" there.
_ZENITH_ARCMIN = 0.0019279

_ARCMIN_RAD = np.pi / 10800
_EARTH_ROTATION_RAD_PER_S = 7.292115e-5
_WGS84_A_M = 6378137.0
_WGS84_F = 1 / 298.257223563
_LIGHT_M_PER_S = 299792458.0
_EARTH_RADIUS_M = 6371000.0
# Curvature of a nearly horizontal ray over that of the Earth.
_RAY_CURVATURE = 1 / 7


def hour_angle_rad(local_sidereal_time_rad: ArrayLike, ra_rad: ArrayLike) -> Float:
    """Return the hour angle, -pi to pi.

    Parameters
    ----------
    local_sidereal_time_rad : (...) array_like
        Local apparent sidereal time, rad.
    ra_rad : (...) array_like
        Apparent right ascension, rad.

    Returns
    -------
    (...) float64
        rad, positive west of the meridian.

    Notes
    -----
    Teague & Chahl, eq. (22).
    """
    angle = np.asarray(local_sidereal_time_rad, dtype=np.float64) - np.asarray(ra_rad, dtype=np.float64)
    return (angle + np.pi) % (2 * np.pi) - np.pi


def azimuth_altitude_rad(hour_angle_rad: ArrayLike, dec_rad: ArrayLike, latitude_rad: float) -> tuple[Float, Float]:
    """Return azimuth and altitude, without refraction.

    Parameters
    ----------
    hour_angle_rad, dec_rad : (...) array_like
        Hour angle and apparent declination, rad.
    latitude_rad : float
        Geodetic latitude, rad.

    Returns
    -------
    azimuth_rad, altitude_rad : (...) float64
        Azimuth from north through east, 0 to 2 pi.

    Notes
    -----
    Teague & Chahl, eqs (23), (24); Meeus, eqs (13.5), (13.6).  Departs from eq. (24), printed with five arguments:
    azimuth = atan2(sin w, cos w sin phi - tan dec cos phi) + pi, both arguments multiplied by cos dec so that the
    azimuth of the celestial pole is defined.  Departs from eq. (23), whose asin loses digits near the zenith.
    """
    w, dec = np.asarray(hour_angle_rad, dtype=np.float64), np.asarray(dec_rad, dtype=np.float64)
    north = np.sin(dec) * cos(latitude_rad) - np.cos(dec) * np.cos(w) * sin(latitude_rad)
    east = -np.cos(dec) * np.sin(w)
    up = np.sin(dec) * sin(latitude_rad) + np.cos(dec) * np.cos(w) * cos(latitude_rad)
    return np.arctan2(east, north) % (2 * np.pi), np.arctan2(up, np.hypot(north, east))


def ned_direction(azimuth_rad: ArrayLike, altitude_rad: ArrayLike) -> Float:
    """Return the unit vector north, east, down.

    Parameters
    ----------
    azimuth_rad, altitude_rad : (...) array_like
        rad.

    Returns
    -------
    (..., 3) float64

    Notes
    -----
    Teague & Chahl, eq. (29).
    """
    azimuth, altitude = np.broadcast_arrays(
        np.asarray(azimuth_rad, dtype=np.float64), np.asarray(altitude_rad, dtype=np.float64)
    )
    return np.stack(
        [np.cos(azimuth) * np.cos(altitude), np.sin(azimuth) * np.cos(altitude), -np.sin(altitude)], axis=-1
    )


def ned_to_azimuth_altitude_rad(direction_ned: ArrayLike) -> tuple[Float, Float]:
    """Return the azimuth and altitude of a vector: the inverse of eq. (29).

    Parameters
    ----------
    direction_ned : (..., 3) array_like
        Vectors north, east, down, of any length.

    Returns
    -------
    azimuth_rad, altitude_rad : (...) float64
        Azimuth from north through east, 0 to 2 pi.
    """
    north, east, down = np.moveaxis(np.asarray(direction_ned, dtype=np.float64), -1, 0)
    return np.arctan2(east, north) % (2 * np.pi), np.arctan2(-down, np.hypot(north, east))


def C_ned_eq(latitude_rad: ArrayLike, local_sidereal_time_rad: ArrayLike) -> Float:
    """Return the matrix from the true equator and equinox of date to north, east, down.

    Parameters
    ----------
    latitude_rad, local_sidereal_time_rad : (...) array_like
        Geodetic latitude and local apparent sidereal time, rad.

    Returns
    -------
    (..., 3, 3) float64

    Notes
    -----
    Teague & Chahl, eqs (22)-(24) and (29) in one matrix.
    """
    latitude, sidereal = np.asarray(latitude_rad, dtype=np.float64), np.asarray(local_sidereal_time_rad, np.float64)
    sin_lat, cos_lat, sin_lst, cos_lst = np.sin(latitude), np.cos(latitude), np.sin(sidereal), np.cos(sidereal)
    C = np.empty((*np.broadcast_shapes(latitude.shape, sidereal.shape), 3, 3))
    north, east, down = C[..., 0, :], C[..., 1, :], C[..., 2, :]
    north[..., 0], north[..., 1], north[..., 2] = -sin_lat * cos_lst, -sin_lat * sin_lst, cos_lat
    east[..., 0], east[..., 1], east[..., 2] = -sin_lst, cos_lst, 0.0
    down[..., 0], down[..., 1], down[..., 2] = -(cos_lat * cos_lst), -(cos_lat * sin_lst), -sin_lat
    return C


def diurnal_aberration_rad(latitude_rad: float, height_m: float = 0.0) -> float:
    """Return the observer's eastward speed in units of the speed of light; diurnal aberration adds it to unit vectors.

    Parameters
    ----------
    latitude_rad : float
        Geodetic latitude, rad.
    height_m : float
        Height above the WGS84 ellipsoid, m.

    Returns
    -------
    float
        rad; 0.32" at the equator.

    Notes
    -----
    Not in the paper.  It is half of the difference between the paper's corrected formulae and ERFA.
    """
    flattened = 1 - _WGS84_F * (2 - _WGS84_F) * sin(latitude_rad) ** 2
    from_axis_m = (_WGS84_A_M / sqrt(flattened) + height_m) * cos(latitude_rad)
    return _EARTH_ROTATION_RAD_PER_S * from_axis_m / _LIGHT_M_PER_S


def dip_rad(height_m: float) -> float:
    """Return how far the sea's horizon is below the horizontal, with refraction.

    Parameters
    ----------
    height_m : float
        Height above the sea, m; the dip is 0 below it.

    Returns
    -------
    float
        rad; 1.63 deg at 3 km.

    Notes
    -----
    acos(R / (R + h)), times sqrt(1 - 1/7): a ray near the ground is curved by a seventh of the Earth's curvature.
    """
    return acos(_EARTH_RADIUS_M / (_EARTH_RADIUS_M + max(height_m, 0.0))) * sqrt(1 - _RAY_CURVATURE)


def refraction_scale(pressure_hpa: float, temperature_c: float) -> float:
    """Return the refraction of air divided by that of standard air.

    Parameters
    ----------
    pressure_hpa : float
        Pressure at the observer, hPa.
    temperature_c : float
        Temperature at the observer, degrees Celsius.

    Returns
    -------
    float
        1 at 1010 hPa and 10 degrees.

    Notes
    -----
    Teague & Chahl, eq. (28).
    """
    return pressure_hpa / STANDARD_PRESSURE_HPA * 283 / (273 + temperature_c)


def refraction_rad(altitude_rad: ArrayLike, scale: float = 1.0) -> Float:
    """Return the refraction of a true altitude: the apparent altitude minus the true altitude.

    Parameters
    ----------
    altitude_rad : (...) array_like
        True altitude, rad.  Below -1 deg, the refraction of -1 deg is returned.
    scale : float
        The result of `refraction_scale` for the air.

    Returns
    -------
    (...) float64
        rad.

    Notes
    -----
    Teague & Chahl, eq. (25); Meeus, eq. (16.4).  Departs from eq. (25): 0.0019279' are added, which makes the
    refraction at the zenith zero; and the formula is used down to -1 deg only, because it is singular at -5.11 deg and
    would raise stars from below the horizon.
    """
    altitude_deg = np.rad2deg(np.maximum(np.asarray(altitude_rad, dtype=np.float64), LOWEST_ALTITUDE_RAD))
    arcmin = 1.02 / np.tan(np.deg2rad(altitude_deg + 10.3 / (altitude_deg + 5.11))) + _ZENITH_ARCMIN
    return scale * arcmin * _ARCMIN_RAD


def bennett_refraction_rad(apparent_altitude_rad: ArrayLike, scale: float = 1.0) -> Float:
    """Return Bennett's refraction of an apparent altitude, for correcting observations.

    Parameters
    ----------
    apparent_altitude_rad : (...) array_like
        Apparent altitude, rad; at least 0.
    scale : float
        The result of `refraction_scale` for the air.

    Returns
    -------
    (...) float64
        rad.

    Notes
    -----
    Teague & Chahl, eq. (27).  It inverts eq. (25) as printed within 3.7", and `refraction_rad` within 3.8";
    `true_altitude_rad` is the exact inverse.
    """
    altitude_deg = np.rad2deg(np.asarray(apparent_altitude_rad, dtype=np.float64))
    return scale * _ARCMIN_RAD / np.tan(np.deg2rad(altitude_deg + 7.31 / (altitude_deg + 4.4)))


def true_altitude_rad(apparent_altitude_rad: ArrayLike, scale: float = 1.0) -> Float:
    """Return the true altitude of an apparent altitude: the exact inverse of `refraction_rad`.

    Parameters
    ----------
    apparent_altitude_rad : (...) array_like
        Apparent altitude, rad.
    scale : float
        The result of `refraction_scale` for the air.

    Returns
    -------
    (...) float64
        rad.

    Notes
    -----
    Teague & Chahl, eq. (26) solved for its altitude.
    """
    apparent = np.asarray(apparent_altitude_rad, dtype=np.float64)
    true = apparent
    # Fixed-point iteration: each step reduces the error by a factor below 0.4, even in the densest air at the horizon.
    for _ in range(40):
        true = apparent - refraction_rad(true, scale)
    return true


def refraction_displacement(sine_altitude: ArrayLike, scale: float = 1.0) -> Float:
    """Return the multiple of the zenith vector that refraction adds to the unit vector of a star.

    A rotation of a unit vector u towards the zenith by the refraction R gives the direction of u + q zenith, with
    q = sin R / cos(h + R).

    Parameters
    ----------
    sine_altitude : (...) array_like
        Sine of the true altitude: u . zenith.  Below sin(-1 deg), the value at sin(-1 deg) is returned.
    scale : float
        The result of `refraction_scale` for the air; 0 for no refraction.

    Returns
    -------
    (...) float64
        q, dimensionless.

    Notes
    -----
    A rational fit to Teague & Chahl, eqs (25), (26), to 0.002" down to -1 deg; `star.vert` has the same.
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
