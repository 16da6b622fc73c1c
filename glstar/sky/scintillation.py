"""Scintillation: the brightness of stars seen through turbulent air by a small lens, as a log-normal process."""

from dataclasses import dataclass
from math import exp, expm1, tanh
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.sky.extinction import air_mass

__all__ = ["SMALL_LENS_RMS", "Scintillation"]

Float = NDArray[np.float64]

# Relative standard deviation at the zenith at sea level through lenses below 5 cm, at once: Dravins and others 1997,
# PASP 109, 173.
SMALL_LENS_RMS: Final = 0.38
# Of the air mass, for such lenses; 1.5 to 1.75 is for large telescopes (the same).
_AIR_MASS_POWER: Final = 0.92
# Height in which it falls to 1/e, m: Young 1967.
_SCALE_HEIGHT_M: Final = 8000.0
# Time in which the brightness is correlated, s: half a second averages 0.38 to 0.048, as measured.
_CORRELATION_S: Final = 0.004
# Multipliers of the hash splitmix64.
_GOLDEN, _MIX_1, _MIX_2 = (np.uint64(number) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


@dataclass(frozen=True, slots=True)
class Scintillation:
    """Scintillation over a site.

    Attributes
    ----------
    zenith_rms : float
        Relative standard deviation of the brightness of a star at the zenith at sea level, at once.
    seed : int
        Another number, other variations.
    """

    zenith_rms: float
    seed: int = 0

    def rms(self, sine_apparent_altitude: ArrayLike, height_m: float) -> Float:
        """Return the relative standard deviation of the brightness of stars at once.

        Parameters
        ----------
        sine_apparent_altitude : (...) array_like
            Sines of altitudes with refraction.
        height_m : float
            Of the observer.

        Returns
        -------
        (...) float64
        """
        at_zenith = self.zenith_rms * exp(-max(height_m, 0.0) / _SCALE_HEIGHT_M)
        return np.asarray(at_zenith * air_mass(sine_apparent_altitude) ** _AIR_MASS_POWER)

    def mean_factors(self, rms: Float, star_id: NDArray[np.int32], utc_s: float, duration_s: float) -> Float:
        """Return the mean relative brightness of stars over an exposure.

        Parameters
        ----------
        rms : (m,) float64
            Of each star, see `rms`.
        star_id : (m,) int
        utc_s : float
            Start of the exposure.
        duration_s : float

        Returns
        -------
        (m,) float64
            Log-normal, with the mean 1.
        """
        steps = duration_s / _CORRELATION_S
        # The variance of the mean of a process with exponential correlation.
        part = 2 * (steps + expm1(-steps)) / (steps * steps)
        return np.asarray(_log_normal(rms * part**0.5, self._normal(star_id, utc_s, 1))[0])

    def factors(self, rms: Float, star_id: NDArray[np.int32], utc_s: float, duration_s: float, times: int) -> Float:
        """Return the relative brightness of stars at some times of an exposure.

        Parameters
        ----------
        rms, star_id, utc_s, duration_s
            As for `mean_factors`.
        times : int
            Number of equidistant times from the start to the end, n.

        Returns
        -------
        (n, m) float64
            A process with exponential correlation.  For longer steps than that it is averaged, so that the mean
            over the exposure has the right variance.
        """
        steps = duration_s / (times - 1) / _CORRELATION_S
        kept = exp(-steps)
        normal = self._normal(star_id, utc_s, times)
        for k in range(1, times):
            normal[k] = kept * normal[k - 1] + (1 - kept * kept) ** 0.5 * normal[k]
        return _log_normal(rms * (2 / steps * tanh(steps / 2)) ** 0.5, normal)

    def _normal(self, star_id: NDArray[np.int32], utc_s: float, times: int) -> Float:
        """Return numbers of a unit normal distribution, (times, m), which depend on star, exposure and seed only."""
        frame = np.uint64(round(utc_s * 1e6) & (2**64 - 1))
        of_seed = _hashed(np.array([self.seed], np.uint64) + _hashed(np.array([frame])))
        of_star = _hashed(np.asarray(star_id, np.int64).astype(np.uint64) ^ of_seed)
        k = np.arange(2 * times, dtype=np.uint64)[:, np.newaxis]
        uniform = (_hashed(of_star + k * _GOLDEN) >> np.uint64(11)).astype(np.float64) * 2.0**-53
        radius = np.sqrt(-2 * np.log(1 - uniform[:times]))
        return np.asarray(radius * np.cos(2 * np.pi * uniform[times:]))


def _log_normal(rms: Float, normal: Float) -> Float:
    """Return log-normal numbers of mean 1 and some standard deviations, given unit normal ones."""
    variance = np.log1p(rms * rms)
    return np.asarray(np.exp(np.sqrt(variance) * normal - variance / 2))


def _hashed(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the hash splitmix64 of numbers, modulo 2**64."""
    z = numbers + _GOLDEN
    z = (z ^ (z >> np.uint64(30))) * _MIX_1
    z = (z ^ (z >> np.uint64(27))) * _MIX_2
    return np.asarray(z ^ (z >> np.uint64(31)))
