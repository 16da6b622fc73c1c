"""Positions of the Sun, the Moon and the planets: ERFA's series, with corrections that bring them to DE421.

ERFA's series of the planets (`plan94`) are up to 90" from the Jet Propulsion Laboratory's ephemeris DE421, and its Moon
(`moon98`) up to 13".  ``assets/ephemeris.npz`` holds the differences from 1990 to 2050 as Chebyshev series of whole
numbers; `tests/scripts/make_ephemeris.py` wrote it.  Outside these years, the series are used without corrections.
"""

from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import erfa
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray

from glstar.errors import CatalogueError
from glstar.sky.timescale import JulianDate
from glstar.system.resources import asset

__all__ = ["AU_KM", "LIGHT_KM_PER_DAY", "PLANETS", "EarthState", "earth_state", "is_corrected", "moon_km", "planet_km"]

Float = NDArray[np.float64]

# The astronomical unit, IAU 2012 resolution B2.
AU_KM: Final = 149597870.7
# The speed of light, 299792.458 km/s.
LIGHT_KM_PER_DAY: Final = 299792.458 * 86400

# The planets, with their numbers in ERFA's `plan94`.
PLANETS: Final = MappingProxyType(
    {"Mercury": 1, "Venus": 2, "Mars": 4, "Jupiter": 5, "Saturn": 6, "Uranus": 7, "Neptune": 8}
)

_FILE: Final = "ephemeris.npz"


@dataclass(frozen=True, slots=True, eq=False)
class EarthState:
    """Position and velocity of the Earth's centre; ICRS axes.

    Attributes
    ----------
    heliocentric_km, barycentric_km : (3,) float64
        From the Sun's centre, and from the barycentre of the solar system, km.
    velocity_km_per_day : (3,) float64
        Relative to the barycentre, km per day.
    """

    heliocentric_km: Float
    barycentric_km: Float
    velocity_km_per_day: Float

    @property
    def sun_km(self) -> Float:
        """The Sun's centre from the barycentre, (3,) km."""
        return self.barycentric_km - self.heliocentric_km


def earth_state(tt: JulianDate) -> EarthState:
    """Return the Earth's position and velocity, by ERFA's `epv00`: within 10 km (0.014") of DE421.

    Parameters
    ----------
    tt : (float, float)
        Terrestrial Time, a two-part Julian date.

    Returns
    -------
    EarthState
    """
    # The status only says that it is a little worse before 1900 and after 2100.
    heliocentric, barycentric, _ = erfa.ufunc.epv00(*tt)
    return EarthState(
        np.asarray(heliocentric["p"], dtype=np.float64) * AU_KM,
        np.asarray(barycentric["p"], dtype=np.float64) * AU_KM,
        np.asarray(barycentric["v"], dtype=np.float64) * AU_KM,
    )


def planet_km(name: str, tt: JulianDate) -> Float:
    """Return the heliocentric position of a planet, ICRS axes.

    Parameters
    ----------
    name : str
        A key of `PLANETS`.
    tt : (float, float)
        Terrestrial Time, a two-part Julian date.

    Returns
    -------
    (3,) float64
        km.  Of Jupiter and Saturn it is the barycentre of the planet and its moons: at most 0.1" beside the planet.
    """
    position_velocity, _ = erfa.ufunc.plan94(*tt, PLANETS[name])  # the status: as of `earth_state`
    series = np.asarray(position_velocity["p"], dtype=np.float64) * AU_KM
    return series + _corrections()[name.lower()].at(tt)


def moon_km(tt: JulianDate) -> Float:
    """Return the geocentric position of the Moon, ICRS axes.

    Parameters
    ----------
    tt : (float, float)
        Terrestrial Time, a two-part Julian date.

    Returns
    -------
    (3,) float64
        km; within 0.6" of DE421 from 1990 to 2050, and 14" in other years.
    """
    series = np.asarray(erfa.moon98(*tt)["p"], dtype=np.float64) * AU_KM
    return series + _corrections()["moon"].at(tt)


def is_corrected(tt: JulianDate) -> bool:
    """Return whether a time lies within the years of the corrections, 1990 to 2050.

    Parameters
    ----------
    tt : (float, float)
        Terrestrial Time, a two-part Julian date.

    Returns
    -------
    bool
    """
    return all(correction.covers(tt) for correction in _corrections().values())


@dataclass(frozen=True, slots=True, eq=False)
class _Correction:
    """A vector as consecutive Chebyshev series of whole numbers.

    Attributes
    ----------
    first_jd : float
        Start of the first series, Julian date.
    piece_days : float
        Length of a series, days.
    step_km : float
        Unit of the coefficients, km.
    coefficients : (pieces, 3, degree + 1) int8 or int16
    """

    first_jd: float
    piece_days: float
    step_km: float
    coefficients: NDArray[np.int8] | NDArray[np.int16]

    def covers(self, tt: JulianDate) -> bool:
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
