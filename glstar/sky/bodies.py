"""The Sun, the Moon and the planets as an observer on the Earth, or above it, sees them.

Places include light time, the observer's place on the WGS84 ellipsoid (57' of parallax for the Moon), the deflection of
light by the Sun, and annual aberration.  `Sky` has the frames: the same that the stars are drawn in.
"""

from dataclasses import dataclass
from math import asin, atan2, cos, pi
from types import MappingProxyType
from typing import Final

import erfa
import numpy as np
from numpy.typing import NDArray

from glstar.sky.apparent import ASTROMETRY, right_ascension_declination
from glstar.sky.bodymagnitudes import moon_vmag, planet_vmag, sun_vmag
from glstar.sky.catalogue import StarCatalogue
from glstar.sky.ephemeris import (
    AU_KM,
    LIGHT_KM_PER_DAY,
    PLANETS,
    EarthState,
    earth_state,
    moon_km,
    planet_km,
)
from glstar.sky.geodesy import geocentric_m
from glstar.sky.horizon import C_ned_eq, diurnal_aberration_rad, ned_to_azimuth_altitude_rad, refraction_rad
from glstar.sky.observed import Sky
from glstar.sky.site import Site
from glstar.sky.timescale import JulianDate, centuries_since_j2000, tt_julian_date

__all__ = ["BODIES", "Body", "moon_over", "observed_bodies"]

Float = NDArray[np.float64]

# All bodies in their order in tables and truth.
BODIES: Final = ("Sun", "Moon", *PLANETS)

# Equatorial radii, km: IAU 2015 resolution B3 for the Sun, the IAU's working group on cartographic coordinates (2009).
_RADIUS_KM: Final = MappingProxyType(
    {
        "Sun": 695700.0,
        "Moon": 1737.4,
        "Mercury": 2439.7,
        "Venus": 6051.8,
        "Mars": 3396.19,
        "Jupiter": 71492.0,
        "Saturn": 60268.0,
        "Uranus": 25559.0,
        "Neptune": 24764.0,
    }
)
# Light from Neptune is 4 h old; its place then is known to a millimetre after three iterations.
_LIGHT_TIME_ITERATIONS: Final = 3
# Closest angle to the Sun for which light is deflected, as in ERFA's manual: 1e-6 rad^2 / 2.
_DEFLECTION_LIMIT: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One body at one time, from one site.

    Attributes
    ----------
    name : str
        As in `BODIES`.
    direction_eq : (3,) float64
        Topocentric apparent unit vector without diurnal aberration, true equator and equinox of date: the same as
        the directions of a `StarField`, with parallax.
    sun_direction_eq : (3,) float64
        Unit vector from the body to the Sun in the same frame; zero for the Sun.
    azimuth_rad, altitude_rad, apparent_altitude_rad : float
        As in `ObservedPlaces`, rad.
    distance_km : float
        From the observer, km.
    angular_radius_rad : float
        rad; the equator's.
    phase_angle_rad : float
        Angle between the Sun and the observer at the body, rad; 0 for the Sun.
    bright_limb_rad : float or None
        Position angle of the middle of the bright limb, from celestial north through east, rad; None for the Sun.
    vmag : float
        V magnitude above the air.
    """

    name: str
    direction_eq: Float
    sun_direction_eq: Float
    azimuth_rad: float
    altitude_rad: float
    apparent_altitude_rad: float
    distance_km: float
    angular_radius_rad: float
    phase_angle_rad: float
    bright_limb_rad: float | None
    vmag: float

    @property
    def illuminated_fraction(self) -> float:
        """The lit fraction of the disc, 0 to 1."""
        return (1 + cos(self.phase_angle_rad)) / 2

    @property
    def ra_dec_rad(self) -> tuple[float, float]:
        """Topocentric apparent right ascension and declination of date, rad."""
        ra_rad, dec_rad = right_ascension_declination(self.direction_eq)
        return float(ra_rad), float(dec_rad)


def observed_bodies(sky: Sky, utc_s: float, site: Site, names: tuple[str, ...] = BODIES) -> tuple[Body, ...]:
    """Return the Sun, the Moon and the planets as seen from a site.

    Parameters
    ----------
    sky : Sky
        Its frames, its Earth orientation and its refraction; not its stars.
    utc_s : float
        UTC seconds since 1970.
    site : Site
    names : tuple of str
        Those to compute, of `BODIES`.

    Returns
    -------
    tuple of Body
        In the order of `names`, whether above the horizon or below.

    Notes
    -----
    Explanatory Supplement to the Astronomical Almanac, 3rd edition, chapter 7: light time, deflection, aberration.
    """
    observer = _Observer(sky, utc_s, site)
    return tuple(observer.body(name) for name in names)


def moon_over(utc_s: float, site: Site) -> Body:
    """Return the Moon as seen from a site, for messages about the light of a night.

    Parameters
    ----------
    utc_s : float
        UTC seconds since 1970.
    site : Site

    Returns
    -------
    Body
    """
    frames = Sky(StarCatalogue.open("bsc5").by_id([]), ASTROMETRY["erfa"], None)
    return observed_bodies(frames, utc_s, site, ("Moon",))[0]


class _Observer:
    """An observer at a time, with the matrices that all bodies share."""

    def __init__(self, sky: Sky, utc_s: float, site: Site) -> None:
        self._tt = tt_julian_date(utc_s)
        self._earth = earth_state(self._tt)
        self._year = 2000 + 100 * centuries_since_j2000(self._tt)
        self._C_eq_icrs = sky.astrometry.C_eq_icrs(utc_s)
        self._C_ned_eq = sky.C_ned_eq([utc_s], site.latitude_rad, site.longitude_rad)[0]
        self._towards_east = np.array([0.0, diurnal_aberration_rad(site.latitude_rad, site.height_m), 0.0])
        self._refraction_scale = sky.refraction_scale(site)
        geocentric_km = geocentric_m(site.latitude_rad, site.longitude_rad, site.height_m) / 1000
        in_ned = C_ned_eq(site.latitude_rad, site.longitude_rad) @ geocentric_km
        self._position_km = self._earth.barycentric_km + self._C_eq_icrs.T @ (self._C_ned_eq.T @ in_ned)

        from_sun_km = self._earth.sun_km - self._position_km
        self._sun_apparent = self._apparent("Sun", from_sun_km, from_sun_km)

    def body(self, name: str) -> Body:
        barycentric_km, sun_km = self._as_seen(name)
        from_observer_km = barycentric_km - self._position_km
        from_sun_km = barycentric_km - sun_km
        distance_km = float(np.linalg.norm(from_observer_km))
        direction_eq = self._C_eq_icrs @ self._apparent(name, from_observer_km, from_sun_km)
        azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(self._C_ned_eq @ direction_eq + self._towards_east)
        if name == "Sun":
            phase_rad, bright_limb_rad, to_sun = 0.0, None, np.zeros(3)
        else:
            # The Sun as seen from here and now, because aberration displaces both: the angle is that of the almanac.
            bright_limb_rad = _position_angle_rad(direction_eq, self._C_eq_icrs @ self._sun_apparent)
            to_sun = self._C_eq_icrs @ (-from_sun_km / np.linalg.norm(from_sun_km))
            phase_rad = float(erfa.sepp(from_sun_km, from_observer_km))
        return Body(
            name=name,
            direction_eq=direction_eq,
            sun_direction_eq=to_sun,
            azimuth_rad=float(azimuth_rad),
            altitude_rad=float(altitude_rad),
            apparent_altitude_rad=float(altitude_rad + refraction_rad(altitude_rad, self._refraction_scale)),
            distance_km=distance_km,
            angular_radius_rad=asin(_RADIUS_KM[name] / distance_km),
            phase_angle_rad=phase_rad,
            bright_limb_rad=bright_limb_rad,
            vmag=self._vmag(name, from_sun_km / AU_KM, from_observer_km / AU_KM, phase_rad),
        )

    def _as_seen(self, name: str) -> tuple[Float, Float]:
        """Return where a body was, and where the Sun was, when the light left that arrives now: (3,) km."""
        then, earth = self._tt, self._earth
        position_km = _barycentric_km(name, then, earth)
        for _ in range(_LIGHT_TIME_ITERATIONS - 1):
            days = float(np.linalg.norm(position_km - self._position_km)) / LIGHT_KM_PER_DAY
            then = self._tt[0], self._tt[1] - days
            earth = earth_state(then)
            position_km = _barycentric_km(name, then, earth)
        return position_km, earth.sun_km

    def _apparent(self, name: str, from_observer_km: Float, from_sun_km: Float) -> Float:
        """Return the unit vector of a body after deflection and annual aberration, ICRS axes."""
        observed = from_observer_km / np.linalg.norm(from_observer_km)
        sun_to_observer_au = (self._position_km - self._earth.sun_km) / AU_KM
        sun_distance_au = float(np.linalg.norm(sun_to_observer_au))
        if name not in ("Sun", "Moon"):
            observed = erfa.ld(
                1.0,
                observed,
                from_sun_km / np.linalg.norm(from_sun_km),
                sun_to_observer_au / sun_distance_au,
                sun_distance_au,
                _DEFLECTION_LIMIT,
            )
        velocity = self._earth.velocity_km_per_day / LIGHT_KM_PER_DAY
        aberrated = erfa.ab(observed, velocity, sun_distance_au, np.sqrt(1 - velocity @ velocity))
        return np.asarray(aberrated, dtype=np.float64)

    def _vmag(self, name: str, from_sun_au: Float, from_observer_au: Float, phase_rad: float) -> float:
        distance_au = float(np.linalg.norm(from_observer_au))
        if name == "Sun":
            return sun_vmag(distance_au)
        if name == "Moon":
            return moon_vmag(phase_rad, distance_au * AU_KM, float(np.linalg.norm(from_sun_au)))
        return planet_vmag(name, from_sun_au, from_observer_au, phase_rad, self._year)


def _barycentric_km(name: str, tt: JulianDate, earth: EarthState) -> Float:
    if name == "Sun":
        return earth.sun_km
    if name == "Moon":
        return earth.barycentric_km + moon_km(tt)
    return earth.sun_km + planet_km(name, tt)


def _position_angle_rad(direction_eq: Float, towards_eq: Float) -> float:
    """Return the position angle at a direction of the projection of a vector, north through east, 0 to 2 pi."""
    x, y, z = direction_eq
    east = np.array([-y, x, 0.0])
    north = np.array([-z * x, -z * y, x * x + y * y])
    return atan2(float(towards_eq @ east), float(towards_eq @ north)) % (2 * pi)
