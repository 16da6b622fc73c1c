"""Brightness of the sky by direction, in V, and the names of day, twilight and night by the altitude of the Sun.

Airglow and starlight, moonlight, twilight and the glow of a town are in flux per square arcsecond relative to a star of
magnitude 0: 10^(-0.4 mag/arcsec2).  Light from beyond the air, zodiacal and of stars that are not drawn, is in S10
units: stars of V 10 per square degree.  ``assets/galaxy.npz`` holds the light of stars from V 6.5 to 10, and of fainter
ones; `tests/scripts/make_galaxy.py` wrote it and says how.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import inf, radians

import erfa
import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.sky.air.extinction import Extinction
from glstar.sky.photometry import brightness_ratio
from glstar.system.resources import asset

# V of a dark sky at the zenith, mag/arcsec2, which Patat's twilight ends in.
_DARK_MAG = 21.6
# Sun's zenith distance, deg, at which Patat's fit begins, and that at which it reaches the dark sky.
_PATAT_FIRST_DEG = 95.0
_PATAT_LAST_DEG = 105.85
# Brightness by day: the fit is continued as a line to the Sun at the horizon, and stays there.
_DAY_ZENITH_DEG = 90.0
# Below the horizon the Moon's light fades like twilight, by this much per degree: an assumption.
_MOON_BELOW_MAG_PER_DEG = 1.3
# The Moon is not closer than its radius, deg.
_CLOSEST_MOON_DEG = 0.25
# The least extinction with which the twilight's gradient is computed, mag: Schaefer's formula diverges without air.
_LEAST_TWILIGHT_MAG = 0.2
# The sky towards the Sun below the horizon, deg: closest angle.
_CLOSEST_SUN_DEG = 5.0
# A town's glow at the horizon below its dome is this many times that at the zenith, with this power of the altitude.
_TOWN_RISE = 8.0
_TOWN_POWER = 3.0

# V of one S10 unit, mag/arcsec2: 10 + 2.5 log10(3600^2).
S10_MAG_ARCSEC2 = 27.7815
# What a dark sky far from ecliptic and Galaxy has of each: Benn & Ellison 1998 (New Astronomy Reviews 42, 503).
ZODIACAL_IN_DARK_SKY_S10 = 60.0
STARLIGHT_IN_DARK_SKY_S10 = 15.0
# Extinction of extended light over that of a star: what is scattered out of one line of sight enters another.  Leinert
# et al. 1998, section 5.
_DIFFUSE = 0.75

# Zodiacal light at 500 nm, S10, by ecliptic latitude and by the difference of longitude to the Sun: Leinert et al. 1998
# (A&AS 127, 1), table 16, after Levasseur-Regourd & Dumont 1980.  At the poles 60.
_LATITUDE_DEG = (0, 5, 10, 15, 20, 25, 30, 45, 60, 75, 90)
_TABLE = {
    15: (9000, 5300, 2690, 1450, 870, 590, 410, 196, 114, 78, 60),
    20: (5000, 3500, 1880, 1100, 710, 495, 355, 185, 110, 77, 60),
    25: (3000, 2210, 1350, 860, 585, 425, 320, 174, 106, 76, 60),
    30: (1940, 1460, 955, 660, 480, 365, 285, 162, 102, 74, 60),
    35: (1290, 990, 710, 530, 400, 310, 250, 151, 98, 73, 60),
    40: (925, 735, 545, 415, 325, 264, 220, 140, 94, 72, 60),
    45: (710, 570, 435, 345, 278, 228, 195, 130, 91, 70, 60),
    60: (395, 345, 275, 228, 190, 163, 143, 105, 81, 67, 60),
    75: (264, 248, 210, 177, 153, 134, 118, 91, 73, 64, 60),
    90: (202, 196, 176, 151, 130, 115, 103, 81, 67, 62, 60),
    105: (166, 164, 154, 133, 117, 104, 93, 75, 64, 60, 60),
    120: (147, 145, 138, 120, 108, 98, 88, 70, 60, 58, 60),
    135: (140, 139, 130, 115, 105, 95, 86, 70, 60, 57, 60),
    150: (140, 139, 129, 116, 107, 99, 91, 75, 62, 56, 60),
    165: (153, 150, 140, 129, 118, 110, 102, 81, 64, 56, 60),
    180: (180, 166, 152, 139, 127, 116, 105, 82, 65, 56, 60),
}
# Steps of the map's logarithms to base 10, and between its nodes, deg.
_PER_DEX = 80
_STEP_DEG = 2.5
# The magnitudes between which the first map adds up the stars.
_LISTED_MAG = (6.5, 10.0)

# Names of the light, brightest first, and the altitudes of the Sun's centre, rad, above which each begins: by day with
# the Sun's radius and the refraction at the horizon.
LIGHT_LEVELS = (
    ("day", radians(-0.833)),
    ("civil twilight", radians(-6.0)),
    ("nautical twilight", radians(-12.0)),
    ("astronomical twilight", radians(-18.0)),
    ("night", -inf),
)


@dataclass(frozen=True, slots=True)
class SkyLights:
    """Which lights the sky has."""

    zenith_mag_arcsec2: float = _DARK_MAG  # V of the dark sky at the zenith: airglow, zodiacal light and starlight
    moonlight: bool = True
    twilight: bool = True
    town_mag_arcsec2: float = 30.0  # V of the glow of towns at the zenith; 30 is none
    town_azimuth_rad: float | None = None  # azimuth of the town; None for towns all around
    ground_fraction: float = 0.1  # brightness of the ground over the mean of the sky at the horizon


@dataclass(frozen=True, slots=True)
class SkyState:
    """What lights the sky of a scene."""

    extinction: Extinction
    height_m: float  # height of the observer
    sun_altitude_rad: float  # apparent altitude of the Sun
    moon_altitude_rad: float  # apparent altitude of the Moon
    moon_phase_angle_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class SkyView:
    """Directions in the sky."""

    sine_altitude: Float  # (...) sine of the apparent altitude; below the horizontal the sky is that of the horizontal
    azimuth_rad: Float  # (...)
    moon_separation_rad: Float  # (...) angles to the Moon
    sun_separation_rad: Float  # (...) angles to the Sun


def sky_radiance(view: SkyView, lights: SkyLights, state: SkyState) -> Float:
    """Return the brightness of the sky in some directions, (...) flux per square arcsecond over that of magnitude 0."""
    sine = np.maximum(view.sine_altitude, 0.0)
    zenith_mag = state.extinction.zenith_mag(state.height_m)
    mass = _scattering_mass(sine)
    radiance = brightness_ratio(lights.zenith_mag_arcsec2) * _dark_gradient(mass, zenith_mag)
    if lights.moonlight:
        radiance = radiance + _moonlight(view, sine, state)
    if lights.twilight:
        radiance = radiance + _twilight(view, sine, state)
    if lights.town_mag_arcsec2 < 30:
        radiance = radiance + brightness_ratio(lights.town_mag_arcsec2) * _town_gradient(view, sine, lights, state)
    return np.asarray(radiance)


def nanolamberts_to_mag(brightness_nl: ArrayLike) -> Float:
    """Return V, (...) mag/arcsec2, of brightnesses in nanolamberts.

    Garstang 1989, as in Krisciunas & Schaefer 1991, eq. (1): B = 34.08 exp(20.7233 - 0.92104 V).
    """
    return np.asarray((20.7233 - np.log(np.asarray(brightness_nl, dtype=np.float64) / 34.08)) / 0.92104)


def moonlight_nl(
    separation_rad: ArrayLike,
    moon_mass: ArrayLike,
    sky_mass: ArrayLike,
    phase_angle_rad: float,
    zenith_mag: float,
    *,
    rayleigh: float = 1.0,
    aerosol: float = 1.0,
) -> Float:
    """Return the brightness of the sky lit by the Moon, (...) nanolamberts.

    `separation_rad` (...): angles to the Moon; `moon_mass`, `sky_mass` (...): air masses (1 - 0.96 sin^2 z)^-0.5 of the
    Moon and of the sky; `phase_angle_rad`: phase angle of the Moon; `zenith_mag`: extinction per air mass; `rayleigh`,
    `aerosol`: scattering by the air and by aerosol over that at sea level, each relative to the whole extinction.

    Krisciunas & Schaefer 1991 (PASP 103, 1033), eqs (3), (15), (20), (21).  Departs from eq. (21), which jumps by 14 %
    at 10 deg: nearer than this the larger of the two laws of aerosol is used, which cross at 8.4 deg.
    """
    degrees = np.maximum(np.rad2deg(np.asarray(separation_rad, dtype=np.float64)), _CLOSEST_MOON_DEG)
    phase_deg = abs(np.rad2deg(phase_angle_rad))
    illuminance = 10 ** (-0.4 * (3.84 + 0.026 * phase_deg + 4e-9 * phase_deg**4))
    by_air = 10**5.36 * (1.06 + np.cos(np.deg2rad(degrees)) ** 2)
    by_aerosol = np.maximum(10 ** (6.15 - degrees / 40), np.where(degrees < 10, 6.2e7 / degrees**2, 0.0))
    moon_mag, sky_mag = (zenith_mag * np.asarray(mass, dtype=np.float64) for mass in (moon_mass, sky_mass))
    scattered = brightness_ratio(moon_mag) * (1 - brightness_ratio(sky_mag))
    return np.asarray((rayleigh * by_air + aerosol * by_aerosol) * illuminance * scattered)


def twilight_mag(sun_altitude_rad: float) -> float:
    """Return V of the sky at the zenith in twilight, mag/arcsec2, with the dark sky in it.

    `sun_altitude_rad`: altitude of the Sun without refraction.  Patat, Ugolnikov & Postylyakov 2006 (A&A 455, 385): a
    fit to zenith distances from 95 to 105 deg.  Before 95 deg it is continued as a line to the Sun at the horizon, and
    by day as a constant: a sky in which no star is seen.
    """
    zenith_distance = 90 - float(np.rad2deg(sun_altitude_rad))
    since = max(zenith_distance, _DAY_ZENITH_DEG) - _PATAT_FIRST_DEG
    if since < 0:
        return 11.84 + 1.518 * since
    if zenith_distance > _PATAT_LAST_DEG:
        return _DARK_MAG
    return 11.84 + 1.518 * since - 0.057 * since**2


def _scattering_mass(sine_altitude: Float) -> Float:
    """Return the air mass for light that is scattered or emitted in the air: Krisciunas & Schaefer, eq. (3)."""
    return np.asarray(1 / np.sqrt(1 - 0.96 * (1 - sine_altitude**2)))


def _dark_gradient(mass: Float, zenith_mag: float) -> Float:
    """Return the brightness of a dark sky relative to the zenith: Benn & Ellison 1998."""
    return (0.4 + 0.6 * mass) * brightness_ratio(zenith_mag * (mass - 1))


def _moonlight(view: SkyView, sine: Float, state: SkyState) -> Float:
    air, height_m = state.extinction, state.height_m
    zenith_mag, at_sea_mag = air.zenith_mag(height_m), air.zenith_mag(0.0)
    if zenith_mag == 0:
        return np.zeros_like(sine)
    scattering = []
    for part_mag in (air.rayleigh_at_mag, air.aerosol_at_mag):
        at_sea = part_mag(0.0) / at_sea_mag
        scattering.append(part_mag(height_m) / zenith_mag / at_sea if at_sea > 0 else 0.0)
    light_nl = moonlight_nl(
        view.moon_separation_rad,
        _scattering_mass(np.maximum(np.sin(state.moon_altitude_rad), 0.0)),
        _scattering_mass(sine),
        state.moon_phase_angle_rad,
        zenith_mag,
        rayleigh=scattering[0],
        aerosol=scattering[1],
    )
    below_deg = max(-float(np.rad2deg(state.moon_altitude_rad)), 0.0)
    faded = brightness_ratio(_MOON_BELOW_MAG_PER_DEG * below_deg)
    # Where there is no light at all, its magnitude is infinite.
    return np.asarray(faded * brightness_ratio(nanolamberts_to_mag(np.maximum(light_nl, 1e-9))))


def _twilight(view: SkyView, sine: Float, state: SkyState) -> Float:
    """Return the twilight: Patat's at the zenith, with the gradient of Schaefer 1993 (Vistas in Astronomy 36, 311)."""
    sun_zenith_deg = 90 - float(np.rad2deg(state.sun_altitude_rad))
    at_zenith = float(brightness_ratio(twilight_mag(state.sun_altitude_rad)) - brightness_ratio(_DARK_MAG))
    if at_zenith <= 0:
        return np.zeros_like(sine)
    zenith_mag, at_sea_mag = (state.extinction.zenith_mag(height_m) for height_m in (state.height_m, 0.0))
    gradient_mag = max(zenith_mag, _LEAST_TWILIGHT_MAG)
    zenith_deg = np.rad2deg(np.arccos(np.minimum(sine, 1.0)))
    towards_sun = sun_zenith_deg / np.maximum(np.rad2deg(view.sun_separation_rad), _CLOSEST_SUN_DEG)
    depth = _scattered_fraction(_scattering_mass(sine), zenith_mag) / _scattered_fraction(1.0, at_sea_mag)
    return np.asarray(at_zenith * towards_sun * depth * brightness_ratio(-zenith_deg / (360 * gradient_mag)))


def _town_gradient(view: SkyView, sine: Float, lights: SkyLights, state: SkyState) -> Float:
    """Return a town's glow over that at the zenith at sea level."""
    if lights.town_azimuth_rad is None:
        towards = np.full_like(sine, 0.5)
    else:
        towards = ((1 + np.cos(view.azimuth_rad - lights.town_azimuth_rad)) / 2) ** 2
    scattered = _scattered_fraction(1.0, state.extinction.zenith_mag(state.height_m))
    at_sea = _scattered_fraction(1.0, state.extinction.zenith_mag(0.0))
    return np.asarray((1 + _TOWN_RISE * towards * (1 - sine) ** _TOWN_POWER) * scattered / at_sea)


def _scattered_fraction(mass: Float | float, zenith_mag: float) -> Float:
    """Return the fraction of light that the air scatters along some air mass; above 0."""
    return np.asarray(np.maximum(1 - brightness_ratio(zenith_mag * mass), 1e-9))


def zodiacal_s10(longitude_from_sun_rad: ArrayLike, latitude_rad: ArrayLike) -> Float:
    """Return the zodiacal light, (...) S10 units, by ecliptic longitude from the Sun and ecliptic latitude, (...).

    Within 15 deg of longitude from the Sun, the light at 15 deg is returned.
    """
    longitude_rad = np.asarray(longitude_from_sun_rad, dtype=np.float64)
    from_sun_deg = np.abs((np.rad2deg(longitude_rad) + 180) % 360 - 180)
    longitudes = np.array(list(_TABLE), dtype=np.float64)
    logarithms = np.log(np.array(list(_TABLE.values()), dtype=np.float64))
    row, down = _between(longitudes, np.maximum(from_sun_deg, longitudes[0]))
    column, across = _between(np.array(_LATITUDE_DEG, dtype=np.float64), np.abs(np.rad2deg(latitude_rad)))
    return np.asarray(np.exp(_bilinear(logarithms, row, down, column, across)))


def galaxy_s10(longitude_rad: ArrayLike, latitude_rad: ArrayLike, drawn_mag: float = 6.5) -> Float:
    """Return the light of the stars that are too faint to be drawn, (...) S10 units.

    `longitude_rad`, `latitude_rad` (...): galactic coordinates; `drawn_mag`: the faintest V that is drawn.  Stars from
    V 6.5 to 10 give about the same light per magnitude, so a limit in this range divides it in proportion.
    """
    brightest, faintest = _LISTED_MAG
    fraction = float(np.clip((faintest - drawn_mag) / (faintest - brightest), 0.0, 1.0))
    listed, faint = _maps()
    column = np.rad2deg(np.asarray(longitude_rad, dtype=np.float64)) % 360 / _STEP_DEG
    row = (np.rad2deg(np.asarray(latitude_rad, dtype=np.float64)) + 90) / _STEP_DEG
    first_row = np.clip(row.astype(np.intp), 0, len(faint) - 2)
    first_column = np.clip(column.astype(np.intp), 0, faint.shape[1] - 2)
    at = (first_row, row - first_row, first_column, column - first_column)
    return _bilinear(faint, *at) + fraction * _bilinear(listed, *at)


def diffuse_transmission(zenith_mag: float, air_mass: ArrayLike) -> Float:
    """Return the fraction of extended light from beyond the air that arrives, (...), along air masses, (...).

    `zenith_mag`: extinction of a star per air mass.
    """
    return brightness_ratio(_DIFFUSE * zenith_mag * np.asarray(air_mass, dtype=np.float64))


def beyond_the_air_s10(
    direction_icrs: Float, sun_icrs: Float, *, zodiacal: bool, galaxy: bool, drawn_mag: float
) -> Float:
    """Return the light from beyond the atmosphere in some directions, (...) S10 units.

    `direction_icrs` (..., 3), `sun_icrs` (3,): unit vectors; `zodiacal`, `galaxy`: which lights; `drawn_mag`: the
    faintest V that is drawn.
    """
    light = np.zeros(direction_icrs.shape[:-1])
    if zodiacal:
        ecliptic = erfa.ecm06(2451545.0, 0.0)
        longitude, latitude = erfa.c2s(direction_icrs @ ecliptic.T)
        sun_longitude, _ = erfa.c2s(sun_icrs @ ecliptic.T)
        light = light + zodiacal_s10(longitude - sun_longitude, latitude)
    if galaxy:
        longitude, latitude = erfa.icrs2g(*erfa.c2s(direction_icrs))
        light = light + galaxy_s10(longitude, latitude, drawn_mag)
    return np.asarray(light)


@lru_cache(maxsize=1)
def _maps() -> tuple[Float, Float]:
    """Return the light of stars from V 6.5 to 10, and of fainter ones; the first column is repeated at the end."""
    with np.load(asset("galaxy.npz")) as stored:
        maps = [10 ** (stored[name].astype(np.float64) / _PER_DEX) for name in ("listed", "faint")]
    listed, faint = (np.concatenate([values, values[:, :1]], axis=1) for values in maps)
    return listed, faint


def _between(nodes: Float, values: Float) -> tuple[NDArray[np.intp], Float]:
    """Return the node below each value, and the fraction of the distance to the next."""
    first = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    return first, np.asarray((values - nodes[first]) / (nodes[first + 1] - nodes[first]))


def _bilinear(table: Float, row: NDArray[np.intp], down: Float, column: NDArray[np.intp], across: Float) -> Float:
    upper = table[row, column] * (1 - across) + table[row, column + 1] * across
    lower = table[row + 1, column] * (1 - across) + table[row + 1, column + 1] * across
    return np.asarray(upper * (1 - down) + lower * down)


def light_name(sun_altitude_rad: float) -> str:
    """Return ``"day"``, ``"night"`` or the name of the twilight, by the altitude of the Sun's centre, unrefracted."""
    return next(name for name, least_rad in LIGHT_LEVELS if sun_altitude_rad > least_rad)
