"""The Sun, the Moon and the planets as an observer on the Earth, or above it, sees them.

Places include light time, the observer's position on the WGS84 ellipsoid (57' of parallax for the Moon), the deflection
of light by the Sun, and annual aberration, in the frames of `Sky`.  ERFA's series of the planets (`plan94`) are up to
90" from the Jet Propulsion Laboratory's ephemeris DE421, and its Moon (`moon98`) up to 13"; ``assets/ephemeris.npz``
holds the differences from 1990 to 2050 as Chebyshev series (`tests/scripts/make_ephemeris.py` wrote it).  Magnitudes of
planets follow Mallama & Hilton 2018 (Astronomy and Computing 25, 10), without the rotation of Mars (0.06 mag).
"""

from dataclasses import dataclass, field
from functools import lru_cache
from math import asin, atan2, cos, degrees, exp, log10, pi, sin, sqrt
from types import MappingProxyType

import erfa
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import CatalogueError
from glstar.sky.air.refraction import refraction_rad
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from glstar.sky.place.apparent import ASTROMETRY, direction, right_ascension_declination
from glstar.sky.place.horizon import C_ned_eq, ned_to_azimuth_altitude_rad, with_diurnal_aberration
from glstar.sky.place.site import Site, geocentric_m
from glstar.sky.place.timescale import JulianDate, centuries_since_j2000, tt_julian_date
from glstar.system.resources import asset

# V of the Sun at 1 au.
_SUN_VMAG = -26.75
# V of the full Moon at its mean distance and 1 au from the Sun, and that distance, km: Allen's law.
_FULL_MOON_VMAG = -12.73
_MEAN_MOON_KM = 384400.0

# Coefficients of powers of the phase angle in degrees, with the constant first.
_MERCURY = (-0.613, 6.3280e-2, -1.6336e-3, 3.3644e-5, -3.4265e-7, 1.6893e-9, -3.0334e-12)
_VENUS = (-4.384, -1.044e-3, 3.687e-4, -2.814e-6, 8.938e-9)
_VENUS_CRESCENT = (236.05828, -2.81914, 8.39034e-3)  # above 163.7 deg
_EARTH = (-3.99, -1.060e-3, 2.054e-4)
_MARS = (-1.601, 2.267e-2, -1.302e-4)
_JUPITER = (-9.395, -3.7e-4, 6.16e-4)

# North poles of rotation, J2000, deg: the IAU's working group on cartographic coordinates.
_SATURN_POLE = direction(np.deg2rad(40.589), np.deg2rad(83.537))
_URANUS_POLE = direction(np.deg2rad(257.311), np.deg2rad(-15.175))

# The astronomical unit, IAU 2012 resolution B2.
AU_KM = 149597870.7
# The speed of light, 299792.458 km/s.
LIGHT_KM_PER_DAY = 299792.458 * 86400

# The planets, with their numbers in ERFA's `plan94`.
PLANETS = MappingProxyType({"Mercury": 1, "Venus": 2, "Mars": 4, "Jupiter": 5, "Saturn": 6, "Uranus": 7, "Neptune": 8})

_FILE = "ephemeris.npz"

# All bodies in their order in tables and truth.
BODIES = ("Sun", "Moon", *PLANETS)

# Equatorial radii, km: IAU 2015 resolution B3 for the Sun, the IAU's working group on cartographic coordinates (2009).
_RADIUS_KM = MappingProxyType(
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
_LIGHT_TIME_ITERATIONS = 3
# Closest angle to the Sun for which light is deflected, as in ERFA's manual: 1e-6 rad^2 / 2.
_DEFLECTION_LIMIT = 1e-6


def sun_vmag(distance_au: float) -> float:
    """Return the V magnitude of the Sun at a distance from the observer."""
    return _SUN_VMAG + 5 * log10(distance_au)


def moon_vmag(phase_angle_rad: float, distance_km: float, sun_distance_au: float) -> float:
    """Return the V magnitude of the Moon.

    `phase_angle_rad`: angle between Sun and observer at the Moon; `distance_km`: from the observer; `sun_distance_au`:
    from the Sun.  Allen, Astrophysical Quantities: V = -12.73 + 0.026 a + 4e-9 a^4 with the phase angle a in degrees;
    valid up to about 150 deg, and too faint near new Moon.
    """
    angle_deg = degrees(phase_angle_rad)
    at_mean_distance = _FULL_MOON_VMAG + 0.026 * angle_deg + 4e-9 * angle_deg**4
    return at_mean_distance + 5 * log10(distance_km / _MEAN_MOON_KM * sun_distance_au)


def earthshine_vmag(earth_phase_rad: float, moon_km: float, sun_distance_au: float, distance_km: float) -> float:
    """Return the V magnitude of the Moon's disc as the Earth alone lights it.

    `earth_phase_rad`: angle between Sun and Moon at the Earth; `moon_km`: from the Earth's centre to the Moon;
    `sun_distance_au`: from the Earth to the Sun; `distance_km`: from the observer to the Moon.  The Moon reflects the
    Earth's light as it does the Sun's when full, because it comes from the observer's side; V of the Earth at the Moon
    by Mallama & Hilton 2018.  The observer's parallax, up to 1 deg of phase, and weather on the Earth (0.1 mag) are not
    in it.
    """
    earth = _series(_EARTH, degrees(earth_phase_rad)) + 5 * log10(moon_km / AU_KM * sun_distance_au)
    return moon_vmag(0.0, distance_km, 1.0) + earth - _SUN_VMAG


def planet_vmag(name: str, from_sun_au: Float, from_observer_au: Float, phase_angle_rad: float, year: float) -> float:
    """Return the V magnitude of a planet.

    `name`: a key of `PLANETS`; `from_sun_au`, `from_observer_au` (3,): the planet's position from the Sun and from the
    observer, ICRS axes; `phase_angle_rad`: angle between Sun and observer at the planet; `year`: Julian year, for
    Neptune, which brightened from 1980 to 2000.  Mallama & Hilton 2018, eqs (2) to (17): V(1, 0) and the phase law,
    plus 5 log10(r d).
    """
    a = degrees(phase_angle_rad)
    r, d = float(np.linalg.norm(from_sun_au)), float(np.linalg.norm(from_observer_au))
    match name:
        case "Mercury":
            at_1_au = _series(_MERCURY, a)
        case "Venus":
            at_1_au = _series(_VENUS if a < 163.7 else _VENUS_CRESCENT, a)
        case "Mars":
            at_1_au = _series(_MARS, a)  # up to 50 deg: from the Earth it is at most 47 deg
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
    """Return the planetocentric latitude of an observer who sees the planet in a direction."""
    return asin(max(-1.0, min(1.0, -float(pole @ towards_planet))))


@dataclass(frozen=True, slots=True, eq=False)
class EarthState:
    """Position and velocity of the Earth's centre; ICRS axes."""

    heliocentric_km: Float  # (3,) position from the Sun's centre
    barycentric_km: Float  # (3,) position from the barycentre of the solar system
    velocity_km_per_day: Float  # (3,) velocity relative to the barycentre

    @property
    def sun_km(self) -> Float:
        """The Sun's centre from the barycentre, (3,) km."""
        return self.barycentric_km - self.heliocentric_km


def earth_state(tt: JulianDate) -> EarthState:
    """Return the Earth's position and velocity, by ERFA's `epv00`: within 10 km (0.014") of DE421."""
    # The status only reports a slightly larger error before 1900 and after 2100.
    heliocentric, barycentric, _ = erfa.ufunc.epv00(*tt)
    return EarthState(
        np.asarray(heliocentric["p"], dtype=np.float64) * AU_KM,
        np.asarray(barycentric["p"], dtype=np.float64) * AU_KM,
        np.asarray(barycentric["v"], dtype=np.float64) * AU_KM,
    )


def planet_km(name: str, tt: JulianDate) -> Float:
    """Return the heliocentric position of a planet of `PLANETS`, (3,) km, ICRS axes.

    For Jupiter and Saturn, this is the barycentre of the planet and its moons: at most 0.1" from the planet.
    """
    position_velocity, _ = erfa.ufunc.plan94(*tt, PLANETS[name])  # the status is as for `earth_state`
    series = np.asarray(position_velocity["p"], dtype=np.float64) * AU_KM
    return series + _corrections()[name.lower()].at(tt)


def moon_km(tt: JulianDate) -> Float:
    """Return the geocentric position of the Moon, (3,) km, ICRS axes: 0.6" from DE421 in 1990 to 2050, else 14"."""
    series = np.asarray(erfa.moon98(*tt)["p"], dtype=np.float64) * AU_KM
    return series + _corrections()["moon"].at(tt)


def is_corrected(tt: JulianDate) -> bool:
    """Return whether a time lies within the years of the corrections, 1990 to 2050."""
    return all(correction.covers(tt) for correction in _corrections().values())


@dataclass(frozen=True, slots=True, eq=False)
class _Correction:
    """A vector as consecutive Chebyshev series of whole numbers."""

    first_jd: float  # start of the first series, Julian date
    piece_days: float  # length of a series
    step_km: float  # unit of the coefficients
    coefficients: NDArray[np.int8] | NDArray[np.int16]  # (pieces, 3, degree + 1)

    def covers(self, tt: JulianDate) -> bool:
        """Return whether there is a series for a time."""
        return 0 <= self._piece(tt) < len(self.coefficients)

    def at(self, tt: JulianDate) -> Float:
        """Return the vector at a time, (3,) km; zero where there is no series."""
        if not self.covers(tt):
            return np.zeros(3)
        piece = self._piece(tt)
        elapsed = int(piece)
        polynomials = chebvander(2 * (piece - elapsed) - 1, self.coefficients.shape[2] - 1)
        steps: Float = self.coefficients[elapsed].astype(np.float64) @ np.asarray(polynomials, np.float64).ravel()
        return self.step_km * steps

    def _piece(self, tt: JulianDate) -> float:
        return ((tt[0] - self.first_jd) + tt[1]) / self.piece_days


@lru_cache(maxsize=1)
def _corrections() -> dict[str, _Correction]:
    path = asset(_FILE)
    try:
        with np.load(path, allow_pickle=False) as stored:
            first_jd = float(stored["first_jd"])
            corrections = {}
            for name in ("moon", *(planet.lower() for planet in PLANETS)):
                piece_days, step_km = (float(number) for number in stored[f"{name}_scale"])
                corrections[name] = _Correction(first_jd, piece_days, step_km, stored[name])
            return corrections
    except OSError as error:
        raise CatalogueError(path, f"cannot be read ({error.strerror}); install glstar again") from error
    except (ValueError, KeyError, TypeError) as error:
        raise CatalogueError(path, "is damaged; install glstar again") from error


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One body at one time, from one site."""

    name: str  # one of `BODIES`
    # (3,) topocentric apparent unit vector without diurnal aberration, true equator and equinox of date: the same as
    # the directions of a `StarField`, with parallax.
    direction_eq: Float
    sun_direction_eq: Float  # (3,) unit vector from the body to the Sun in the same frame; zero for the Sun
    azimuth_rad: float  # from north through east
    altitude_rad: float  # without refraction
    apparent_altitude_rad: float  # with refraction
    distance_km: float  # from the observer
    angular_radius_rad: float  # of the equator
    phase_angle_rad: float  # angle between the Sun and the observer at the body; 0 for the Sun
    # Position angle of the middle of the bright limb, from celestial north through east, rad; None for the Sun.
    bright_limb_rad: float | None
    vmag: float  # V magnitude above the air, without earthshine
    # (3,) diurnal aberration, true equator and equinox: it adds to `direction_eq`
    diurnal_aberration_eq: Float = field(default_factory=lambda: np.zeros(3))
    earthshine_vmag: float | None = None  # V magnitude of the Moon as the Earth lights it; None for others

    @property
    def illuminated_fraction(self) -> float:
        """The lit fraction of the disc, 0 to 1."""
        return (1 + cos(self.phase_angle_rad)) / 2

    @property
    def light_vmag(self) -> float:
        """V magnitude of all its light, with earthshine."""
        if self.earthshine_vmag is None:
            return self.vmag
        return -2.5 * log10(10 ** (-0.4 * self.vmag) + 10 ** (-0.4 * self.earthshine_vmag))

    @property
    def ra_dec_rad(self) -> tuple[float, float]:
        """Topocentric apparent right ascension and declination of date, with diurnal aberration, rad."""
        ra_rad, dec_rad = right_ascension_declination(self.direction_eq + self.diurnal_aberration_eq)
        return float(ra_rad), float(dec_rad)


def observed_bodies(sky: Sky, utc_s: float, site: Site, names: tuple[str, ...] = BODIES) -> tuple[Body, ...]:
    """Return the Sun, the Moon and the planets as seen from a site, in the order of `names`, also below the horizon.

    `sky`: its frames, Earth orientation and refraction are used, not its stars; `names`: bodies of `BODIES`.
    Explanatory Supplement to the Astronomical Almanac, 3rd edition, chapter 7: light time, deflection, aberration.
    """
    observer = _Observer(sky, utc_s, site)
    return tuple(observer.body(name) for name in names)


def moon_over(utc_s: float, site: Site) -> Body:
    """Return the Moon as seen from a site, for messages about the light of a night."""
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
        self._site = site
        self._refraction_scale = sky.refraction_scale(site)
        geocentric_km = geocentric_m(site.latitude_rad, site.longitude_rad, site.height_m) / 1000
        in_ned = C_ned_eq(site.latitude_rad, site.longitude_rad) @ geocentric_km
        self._position_km = self._earth.barycentric_km + self._C_eq_icrs.T @ (self._C_ned_eq.T @ in_ned)

        from_sun_km = self._earth.sun_km - self._position_km
        self._sun_apparent = self._apparent("Sun", from_sun_km, from_sun_km)

    def body(self, name: str) -> Body:
        """Return one body."""
        barycentric_km, sun_km = self._as_seen(name)
        from_observer_km = barycentric_km - self._position_km
        from_sun_km = barycentric_km - sun_km
        distance_km = float(np.linalg.norm(from_observer_km))
        direction_eq = self._C_eq_icrs @ self._apparent(name, from_observer_km, from_sun_km)
        in_ned = self._C_ned_eq @ direction_eq
        seen_ned = with_diurnal_aberration(in_ned, self._site.latitude_rad, self._site.height_m)
        azimuth_rad, altitude_rad = ned_to_azimuth_altitude_rad(seen_ned)
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
            diurnal_aberration_eq=self._C_ned_eq.T @ (seen_ned - in_ned),
            earthshine_vmag=self._earthshine_vmag(barycentric_km, distance_km) if name == "Moon" else None,
        )

    def _earthshine_vmag(self, moon_barycentric_km: Float, distance_km: float) -> float:
        from_earth_km = moon_barycentric_km - self._earth.barycentric_km
        to_sun_km = -self._earth.heliocentric_km
        return earthshine_vmag(
            float(erfa.sepp(to_sun_km, from_earth_km)),
            float(np.linalg.norm(from_earth_km)),
            float(np.linalg.norm(to_sun_km)) / AU_KM,
            distance_km,
        )

    def _as_seen(self, name: str) -> tuple[Float, Float]:
        """Return barycentric positions, (3,) km, of a body and of the Sun when the light left that arrives now."""
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
