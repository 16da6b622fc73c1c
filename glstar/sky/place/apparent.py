"""Apparent places: from the catalogue's J2000 to the true equator and equinox of date.

`PaperAstrometry` has the formulae of the paper with their errors corrected (azimuth and altitude within 0.23" of ERFA
from 2000 to 2035, right ascension and declination within 0.40"); `ErfaAstrometry` calls ERFA (within 0.05").  Both
rotate unit vectors, because the paper's first-order formulae in right ascension and declination fail near the celestial
poles (0.4" at 89.5 deg, 55" at 89.95 deg).  Only proper motion is added in right
ascension and declination, as in the paper: its error is at most 0.12" in 35 years.

Apparent places are geocentric.  `glstar.sky.place.horizon` has the effects of the rotation of the Earth at a site.
"""

from abc import ABC, abstractmethod
from typing import Literal, NamedTuple

import erfa
import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.rotation import about_x, about_y, about_z
from glstar.sky.place.timescale import centuries_since_j2000, mean_sidereal_time_rad, tt_julian_date, ut1_julian_date

ARCSEC_RAD = np.pi / 648000

# The constant of aberration, rad.
_KAPPA_RAD = 20.49552 * ARCSEC_RAD


class _MeanPlaces(NamedTuple):
    """Mean places of n stars, J2000; arrays that broadcast to (n,)."""

    ra_rad: Float
    dec_rad: Float
    pm_ra_cosdec_rad_per_yr: Float
    pm_dec_rad_per_yr: Float
    parallax_rad: Float
    radial_velocity_m_per_s: Float


class Astrometry(ABC):
    """Computes apparent places from the mean places of a catalogue."""

    def apparent_directions(
        self,
        ra_rad: ArrayLike,
        dec_rad: ArrayLike,
        pm_ra_cosdec_rad_per_yr: ArrayLike,
        pm_dec_rad_per_yr: ArrayLike,
        utc_s: float,
        *,
        parallax_rad: ArrayLike = 0.0,
        radial_velocity_m_per_s: ArrayLike = 0.0,
    ) -> Float:
        """Return geocentric apparent directions, (n, 3) unit vectors, true equator and equinox of date.

        `ra_rad`, `dec_rad` (n,): right ascension and declination, J2000; `pm_ra_cosdec_rad_per_yr`,
        `pm_dec_rad_per_yr` (n,): proper motions per Julian year, in right ascension with the factor cos(dec), as in
        catalogues; `utc_s`: UTC seconds since 1970; `parallax_rad` (n,): parallaxes, not negative;
        `radial_velocity_m_per_s` (n,): radial velocities, positive away from the Sun.
        """
        numbers = (ra_rad, dec_rad, pm_ra_cosdec_rad_per_yr, pm_dec_rad_per_yr, parallax_rad, radial_velocity_m_per_s)
        return self._apparent(_MeanPlaces(*(np.asarray(number, dtype=np.float64) for number in numbers)), utc_s)

    @abstractmethod
    def _apparent(self, stars: _MeanPlaces, utc_s: float) -> Float:
        """Return geocentric apparent directions; see `apparent_directions`."""

    @abstractmethod
    def C_eq_icrs(self, utc_s: float) -> Float:
        """Return the matrix from ICRS to the true equator and equinox of date, (3, 3); `utc_s`: UTC s since 1970."""

    @abstractmethod
    def sidereal_time_rad(self, utc_s: float, dut1_s: float) -> float:
        """Return the apparent sidereal time at Greenwich, 0 to 2 pi rad.

        `utc_s`: UTC seconds since 1970; `dut1_s`: UT1 - UTC, s.
        """


class PaperAstrometry(Astrometry):
    """The formulae of Teague & Chahl, sections 2.1 and 2.2, with their errors corrected."""

    def _apparent(self, stars: _MeanPlaces, utc_s: float) -> Float:
        """Return apparent directions: proper motion, precession, aberration and nutation of vectors, in this order.

        Teague & Chahl, eqs (1)-(19).  As in the paper, there is no parallax (up to 0.77").
        """
        t = centuries_since_j2000(tt_julian_date(utc_s))
        mean_j2000 = direction(*proper_motion(*stars[:4], 100 * t))
        mean_of_date = mean_j2000 @ precession_matrix(t).T
        aberrated = mean_of_date + aberration_velocity(t)
        return _unit(aberrated @ _nutation_matrix(t).T)

    def C_eq_icrs(self, utc_s: float) -> Float:
        """Return nutation times precession, without the frame bias between J2000 and ICRS (0.02")."""
        t = centuries_since_j2000(tt_julian_date(utc_s))
        return _nutation_matrix(t) @ precession_matrix(t)

    def sidereal_time_rad(self, utc_s: float, dut1_s: float) -> float:
        """Return the mean sidereal time plus the equation of the equinoxes; see `mean_sidereal_time_rad`."""
        t = centuries_since_j2000(tt_julian_date(utc_s))
        in_longitude, in_obliquity = nutation_rad(t)
        true_obliquity = mean_obliquity_rad(t) + in_obliquity
        mean = mean_sidereal_time_rad(ut1_julian_date(utc_s, dut1_s))
        return float((mean + in_longitude * np.cos(true_obliquity)) % (2 * np.pi))


class ErfaAstrometry(Astrometry):
    """ERFA's apparent places: IAU 2006/2000A precession and nutation, light deflection, parallax, radial velocity."""

    def _apparent(self, stars: _MeanPlaces, utc_s: float) -> Float:
        """Return apparent directions by ERFA's `apci13`, which depends on the date only, and `atciq` for each star.

        The single call `atci13` would repeat the first step for each star, which is 350 times slower.
        """
        astrom, equation_of_origins = erfa.apci13(*tt_julian_date(utc_s))
        ra_cirs, dec_apparent = erfa.atciq(
            stars.ra_rad,
            stars.dec_rad,
            stars.pm_ra_cosdec_rad_per_yr / np.cos(stars.dec_rad),
            stars.pm_dec_rad_per_yr,
            stars.parallax_rad / ARCSEC_RAD,
            stars.radial_velocity_m_per_s / 1000,
            astrom,
        )
        return direction(ra_cirs - equation_of_origins, dec_apparent)

    def C_eq_icrs(self, utc_s: float) -> Float:
        """Return ERFA's bias-precession-nutation matrix, IAU 2006/2000A."""
        return np.asarray(erfa.pnm06a(*tt_julian_date(utc_s)), dtype=np.float64)

    def sidereal_time_rad(self, utc_s: float, dut1_s: float) -> float:
        """Return ERFA's Greenwich apparent sidereal time, IAU 2006/2000A."""
        return float(erfa.gst06a(*ut1_julian_date(utc_s, dut1_s), *tt_julian_date(utc_s)))


ASTROMETRY: dict[Literal["paper", "erfa"], Astrometry] = {"paper": PaperAstrometry(), "erfa": ErfaAstrometry()}


def direction(ra_rad: ArrayLike, dec_rad: ArrayLike) -> Float:
    """Return the unit vectors, (..., 3), of right ascensions and declinations, or of any longitudes and latitudes."""
    ra, dec = np.broadcast_arrays(np.asarray(ra_rad, dtype=np.float64), np.asarray(dec_rad, dtype=np.float64))
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def sun_direction(utc_s: float) -> Float:
    """Return the direction of the Sun, accurate to 1', to distinguish night from day.

    `utc_s`: UTC seconds since 1970.  Returns a geocentric unit vector, (3,), true equator and equinox of date: the
    negative of ERFA's heliocentric position of the Earth (`epv00`), without aberration (20").
    """
    tt = tt_julian_date(utc_s)
    heliocentric, _ = erfa.epv00(*tt)
    return _unit(np.asarray(erfa.pnm06a(*tt)) @ -np.asarray(heliocentric["p"], dtype=np.float64))


def right_ascension_declination(direction_eq: ArrayLike) -> tuple[Float, Float]:
    """Return the right ascensions, 0 to 2 pi, and declinations of vectors of any length, (..., 3), rad."""
    x, y, z = np.moveaxis(np.asarray(direction_eq, dtype=np.float64), -1, 0)
    return np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))


def proper_motion(
    ra_rad: ArrayLike,
    dec_rad: ArrayLike,
    pm_ra_cosdec_rad_per_yr: ArrayLike,
    pm_dec_rad_per_yr: ArrayLike,
    years: float,
) -> tuple[Float, Float]:
    """Return mean places of J2000 after a number of years of proper motion.

    `ra_rad`, `dec_rad` (n,): right ascension and declination at J2000; `pm_ra_cosdec_rad_per_yr`, `pm_dec_rad_per_yr`
    (n,): proper motions; `years`: Julian years since J2000.  Returns right ascensions and declinations, (n,) rad.

    Teague & Chahl, eq. (1).  Departs from eq. (1): the proper motion in right ascension of the catalogue includes
    cos(dec) and must be divided by it; otherwise the error for alpha Centauri is 47" in 2025.
    """
    ra, dec = np.asarray(ra_rad, dtype=np.float64), np.asarray(dec_rad, dtype=np.float64)
    pm_ra = np.asarray(pm_ra_cosdec_rad_per_yr, dtype=np.float64)
    pm_dec = np.asarray(pm_dec_rad_per_yr, dtype=np.float64)
    return ra + pm_ra * years / np.cos(dec), dec + pm_dec * years


def precession_matrix(t: float) -> Float:
    """Return the matrix from the mean equator of J2000 to the mean equator of date, (3, 3).

    `t`: Julian centuries of TT since J2000.  Teague & Chahl, eqs (2), (3) = R3(-z) R2(gamma) R3(-zeta); Meeus, eqs
    (21.3), (21.4).  Departs from eq. (3): vectors are rotated, without the tan and asin of the paper.
    """
    zeta = (2306.2181 + (0.30188 + 0.017998 * t) * t) * t * ARCSEC_RAD
    z = (2306.2181 + (1.09468 + 0.018203 * t) * t) * t * ARCSEC_RAD
    gamma = (2004.3109 - (0.42665 + 0.041833 * t) * t) * t * ARCSEC_RAD
    return about_z(-z) @ about_y(gamma) @ about_z(-zeta)


def mean_obliquity_rad(t: float) -> float:
    """Return the mean obliquity of the ecliptic, rad, by eq. (8); `t`: Julian centuries of TT since J2000."""
    return float(np.deg2rad(23.439291 - (13.004166e-3 + (0.1639e-6 - 0.50361e-6 * t) * t) * t))


def nutation_rad(t: float) -> tuple[float, float]:
    """Return the nutation in longitude and in obliquity, rad; `t`: Julian centuries of TT since J2000.

    Teague & Chahl, eqs (4)-(7); Meeus, chapter 22.  Departs from eq. (4): the Sun's term is -1.32" sin 2L; the paper
    prints a plus, which is wrong by 2.6".
    """
    node = np.deg2rad(125.04452 - 1934.136261 * t)
    sun = np.deg2rad(280.4665 + 36000.7698 * t)
    moon = np.deg2rad(218.3165 + 481267.8813 * t)
    in_longitude = -17.20 * np.sin(node) - 1.32 * np.sin(2 * sun) - 0.23 * np.sin(2 * moon) + 0.21 * np.sin(2 * node)
    in_obliquity = 9.20 * np.cos(node) + 0.57 * np.cos(2 * sun) + 0.10 * np.cos(2 * moon) - 0.09 * np.cos(2 * node)
    return float(in_longitude * ARCSEC_RAD), float(in_obliquity * ARCSEC_RAD)


def _nutation_matrix(t: float) -> Float:
    """Return the matrix from the mean to the true equator and equinox of date.

    Departs from eqs (10), (11), which are of first order and contain tan(dec): they are wrong by 55" at 89.95 deg.
    """
    mean_obliquity = mean_obliquity_rad(t)
    in_longitude, in_obliquity = nutation_rad(t)
    return about_x(-(mean_obliquity + in_obliquity)) @ about_z(-in_longitude) @ about_x(mean_obliquity)


def aberration_velocity(t: float) -> Float:
    """Return the Earth's velocity in units of the speed of light; annual aberration adds it to each unit vector.

    `t`: Julian centuries of TT since J2000.  Returns a vector, (3,), mean equator and equinox of date.

    Teague & Chahl, eqs (12)-(19), are its components along right ascension and declination.  Departs from eqs (12),
    (13): the vector is added without a division by cos(dec), and kappa is 20.49552", not 20.29552".  Departs from
    eq. (15): the constant term of the longitude of perihelion is 102.93735 deg.
    """
    obliquity = mean_obliquity_rad(t)
    mean_longitude = 280.46646 + (36000.76983 + 0.3032e-3 * t) * t
    anomaly = np.deg2rad(357.52911 + (35999.05029 - 0.1537e-3 * t) * t)
    centre = (
        (1914.602 - (4.817 + 0.014 * t) * t) * np.sin(anomaly)
        + (19.993 - 0.101 * t) * np.sin(2 * anomaly)
        + 0.289 * np.sin(3 * anomaly)
    ) * 1e-3
    sun = np.deg2rad(mean_longitude + centre)
    perihelion = np.deg2rad(102.93735 + (1.71946 + 0.46e-3 * t) * t)
    eccentricity = 16.708634e-3 - (42.037e-6 + 0.1267e-6 * t) * t
    along_x = np.sin(sun) - eccentricity * np.sin(perihelion)
    along_y = -(np.cos(sun) - eccentricity * np.cos(perihelion))
    return _KAPPA_RAD * np.array([along_x, along_y * np.cos(obliquity), along_y * np.sin(obliquity)])


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))
