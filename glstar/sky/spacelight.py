"""Light from beyond the atmosphere that is no drawn star: zodiacal light, and the faint stars of the Galaxy.

``assets/galaxy.npz`` holds the light of stars from V 6.5 to 10, and of fainter ones;
`tests/scripts/make_galaxy.py` wrote it and says how.  Both lights are those above the air, in S10 units: stars of V
10 per square degree.
"""

from functools import lru_cache
from typing import Final

import erfa
import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.sky.magnitudes import brightness_ratio
from glstar.system.resources import asset

__all__ = [
    "S10_MAG_ARCSEC2",
    "STARLIGHT_IN_DARK_SKY_S10",
    "ZODIACAL_IN_DARK_SKY_S10",
    "beyond_the_air_s10",
    "diffuse_transmission",
    "galaxy_s10",
    "zodiacal_s10",
]

Float = NDArray[np.float64]

# V of one S10 unit, mag/arcsec2: 10 + 2.5 log10(3600^2).
S10_MAG_ARCSEC2: Final = 27.7815
# What a dark sky far from ecliptic and Galaxy has of each: Benn & Ellison 1998 (New Astronomy Reviews 42, 503).
ZODIACAL_IN_DARK_SKY_S10: Final = 60.0
STARLIGHT_IN_DARK_SKY_S10: Final = 15.0
# Extinction of extended light over that of a star: what is scattered out of one line of sight enters another.  Leinert
# et al. 1998, section 5.
_DIFFUSE: Final = 0.75

# Zodiacal light at 500 nm, S10, by ecliptic latitude and by the difference of longitude to the Sun: Leinert et al. 1998
# (A&AS 127, 1), table 16, after Levasseur-Regourd & Dumont 1980.  At the poles 60.
_LATITUDE_DEG: Final = (0, 5, 10, 15, 20, 25, 30, 45, 60, 75, 90)
_TABLE: Final = {
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
_PER_DEX: Final = 80
_STEP_DEG: Final = 2.5
# The magnitudes between which the first map adds up the stars.
_LISTED_MAG: Final = (6.5, 10.0)


def zodiacal_s10(longitude_from_sun_rad: ArrayLike, latitude_rad: ArrayLike) -> Float:
    """Return the zodiacal light in some directions.

    Parameters
    ----------
    longitude_from_sun_rad, latitude_rad : (...) array_like
        Ecliptic longitude from the Sun, and ecliptic latitude, rad.

    Returns
    -------
    (...) float64
        S10 units; closer than 15 deg of longitude to the Sun that of 15 deg.
    """
    longitude_rad = np.asarray(longitude_from_sun_rad, dtype=np.float64)
    from_sun_deg = np.abs((np.rad2deg(longitude_rad) + 180) % 360 - 180)
    longitudes = np.array(list(_TABLE), dtype=np.float64)
    logarithms = np.log(np.array(list(_TABLE.values()), dtype=np.float64))
    row, down = _between(longitudes, np.maximum(from_sun_deg, longitudes[0]))
    column, across = _between(np.array(_LATITUDE_DEG, dtype=np.float64), np.abs(np.rad2deg(latitude_rad)))
    return np.asarray(np.exp(_bilinear(logarithms, row, down, column, across)))


def galaxy_s10(longitude_rad: ArrayLike, latitude_rad: ArrayLike, drawn_mag: float = 6.5) -> Float:
    """Return the light of the stars that are too faint to be drawn.

    Parameters
    ----------
    longitude_rad, latitude_rad : (...) array_like
        Galactic coordinates, rad.
    drawn_mag : float
        The faintest V that is drawn.

    Returns
    -------
    (...) float64
        S10 units.

    Notes
    -----
    Stars from V 6.5 to 10 give about the same light per magnitude, so that a limit between takes its share of it.
    """
    brightest, faintest = _LISTED_MAG
    share = float(np.clip((faintest - drawn_mag) / (faintest - brightest), 0.0, 1.0))
    # Columns once around, and the first again.
    listed, faint = _maps()
    column = np.rad2deg(np.asarray(longitude_rad, dtype=np.float64)) % 360 / _STEP_DEG
    row = (np.rad2deg(np.asarray(latitude_rad, dtype=np.float64)) + 90) / _STEP_DEG
    first_row = np.clip(row.astype(np.intp), 0, len(faint) - 2)
    first_column = np.clip(column.astype(np.intp), 0, faint.shape[1] - 2)
    at = (first_row, row - first_row, first_column, column - first_column)
    return _bilinear(faint, *at) + share * _bilinear(listed, *at)


def diffuse_transmission(zenith_mag: float, air_mass: ArrayLike) -> Float:
    """Return the fraction of extended light from beyond the air that arrives.

    Parameters
    ----------
    zenith_mag : float
        Extinction of a star per air mass, mag.
    air_mass : (...) array_like

    Returns
    -------
    (...) float64
    """
    return brightness_ratio(_DIFFUSE * zenith_mag * np.asarray(air_mass, dtype=np.float64))


def beyond_the_air_s10(
    direction_icrs: Float, sun_icrs: Float, *, zodiacal: bool, galaxy: bool, drawn_mag: float
) -> Float:
    """Return the light from beyond the atmosphere in some directions.

    Parameters
    ----------
    direction_icrs : (..., 3) float64
        Unit vectors.
    sun_icrs : (3,) float64
    zodiacal, galaxy : bool
        Which lights.
    drawn_mag : float
        The faintest V that is drawn.

    Returns
    -------
    (...) float64
        S10 units.
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
    with np.load(asset("galaxy.npz")) as stored:
        made = [10 ** (stored[name].astype(np.float64) / _PER_DEX) for name in ("listed", "faint")]
    listed, faint = (np.concatenate([values, values[:, :1]], axis=1) for values in made)
    return listed, faint


def _between(nodes: Float, values: Float) -> tuple[NDArray[np.intp], Float]:
    """Return the node below each value, and the fraction of the distance to the next."""
    first = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    return first, np.asarray((values - nodes[first]) / (nodes[first + 1] - nodes[first]))


def _bilinear(table: Float, row: NDArray[np.intp], down: Float, column: NDArray[np.intp], across: Float) -> Float:
    upper = table[row, column] * (1 - across) + table[row, column + 1] * across
    lower = table[row + 1, column] * (1 - across) + table[row + 1, column + 1] * across
    return np.asarray(upper * (1 - down) + lower * down)
