"""Extinction: how much light the air above an aircraft absorbs and scatters, by altitude and height.

Green 1992 (International Comet Quarterly 14, 55) after Hayes & Latham 1975 adds scattering by the air (Rayleigh),
scattering by aerosol, and absorption by ozone above all aircraft, at 510 nm, which the eye sees best at night.  Each
part has its own law of wavelength.

`Scintillation` is the brightness of stars seen through turbulent air by a small lens, as a log-normal process.
"""

from dataclasses import dataclass, replace
from math import exp, expm1, tanh

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float

# Height in which the pressure falls to 1/e, m, and the pressure at sea level, hPa: Green 1992.
_PRESSURE_SCALE_M = 7996.0
_SEA_LEVEL_HPA = 1013.25

# Wavelength of Green's parts, nm.
EYE_NM = 510.0
# Power of the aerosol's extinction over the wavelength: Hayes & Latham 1975.
_AEROSOL_POWER = -1.3
# Absorption of ozone's Chappuis band by wavelength, 1e-21 cm^2 at 243 K: Serdyuchenko et al. 2014 (Atmospheric
# Measurement Techniques 7, 625), rounded to 5 %, which is 0.002 mag.
_OZONE_NM = (420.0, 440.0, 460.0, 480.0, 500.0, 510.0, 525.0, 550.0, 575.0, 600.0, 625.0, 650.0, 700.0)
_OZONE = (0.03, 0.13, 0.36, 0.72, 1.24, 1.60, 2.20, 3.40, 4.75, 5.12, 4.05, 2.60, 0.95)

# Relative standard deviation of the instantaneous brightness at the zenith at sea level through lenses below 5 cm:
# Dravins and others 1997, PASP 109, 173.
SMALL_LENS_RMS = 0.38
# Power of the air mass for such lenses; 1.5 to 1.75 for large telescopes (the same).
_AIR_MASS_POWER = 0.92
# Height in which scintillation falls to 1/e, m: Young 1967.
_SCALE_HEIGHT_M = 8000.0
# Time in which the brightness is correlated, s: half a second averages 0.38 to 0.048, as measured.
_CORRELATION_S = 0.004
# Multipliers of the hash splitmix64.
_GOLDEN, _MIX_1, _MIX_2 = (np.uint64(number) for number in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


@dataclass(frozen=True, slots=True)
class Extinction:
    """Extinction by the air above an observer."""

    # Extinction of the air at sea level per air mass: 0.1451 at 510 nm, the eye's night vision, by Green; 0.105 at 550.
    rayleigh_mag: float = 0.1451
    aerosol_mag: float = 0.120  # extinction of aerosol at sea level per air mass: 0.05 very clear, 0.12 usual, 0.3 haze
    aerosol_scale_m: float = 1500.0  # height in which the aerosol falls to 1/e
    ozone_mag: float = 0.016  # extinction of ozone per air mass
    # Pressure at the observer, to which the air's part is proportional; None: the standard atmosphere at their height.
    pressure_hpa: float | None = None
    wavelength_nm: float = EYE_NM  # wavelength of the three parts
    by_channel: bool = False  # whether the channels of a mosaic have the extinction of their own wavelengths

    def at_wavelength(self, wavelength_nm: float) -> "Extinction":
        """Return the extinction at another wavelength, 420 to 700 nm.

        Scattering by the air: Bodhaine et al. 1999 (Journal of Atmospheric and Oceanic Technology 16, 1854), eq. (30).
        Aerosol: wavelength^-1.3.  Ozone: Serdyuchenko et al. 2014.
        """
        new, old = wavelength_nm, self.wavelength_nm
        ozone = np.interp([new, old], _OZONE_NM, _OZONE)
        return replace(
            self,
            rayleigh_mag=self.rayleigh_mag * _rayleigh_optical_depth(new) / _rayleigh_optical_depth(old),
            aerosol_mag=self.aerosol_mag * (new / old) ** _AEROSOL_POWER,
            ozone_mag=self.ozone_mag * float(ozone[0] / ozone[1]),
            wavelength_nm=new,
        )

    def rayleigh_at_mag(self, height_m: float) -> float:
        """Return the extinction of the air per air mass, mag, at a height above sea level."""
        if self.pressure_hpa is not None:
            return self.rayleigh_mag * self.pressure_hpa / _SEA_LEVEL_HPA
        return self.rayleigh_mag * exp(-height_m / _PRESSURE_SCALE_M)

    def aerosol_at_mag(self, height_m: float) -> float:
        """Return the extinction of the aerosol per air mass, mag, at a height above sea level."""
        return self.aerosol_mag * exp(-height_m / self.aerosol_scale_m)

    def zenith_mag(self, height_m: float) -> float:
        """Return the extinction at the zenith, mag, at a height above sea level: Green 1992, eqs (2) to (4)."""
        return self.rayleigh_at_mag(height_m) + self.aerosol_at_mag(height_m) + self.ozone_mag


def _rayleigh_optical_depth(wavelength_nm: float) -> float:
    """Return the optical depth of the air above the sea, up to a factor: Bodhaine et al. 1999, eq. (30)."""
    squared = (wavelength_nm / 1000) ** 2
    numerator = 1.0455996 - 341.29061 / squared - 0.90230850 * squared
    return numerator / (1 + 0.0027059889 / squared - 85.968563 * squared)


def air_mass(sine_apparent_altitude: ArrayLike) -> Float:
    """Return air masses, (...): the air along lines of sight over that towards the zenith.

    `sine_apparent_altitude` (...): sines of altitudes with refraction; below the horizontal, its air mass (40) is
    returned.  Rozenberg 1966, as in Green 1992: X = 1 / (s + 0.025 exp(-11 s)).
    """
    s = np.maximum(np.asarray(sine_apparent_altitude, dtype=np.float64), 0.0)
    return np.asarray(1 / (s + 0.025 * np.exp(-11 * s)))


@dataclass(frozen=True, slots=True)
class Scintillation:
    """Scintillation over a site."""

    zenith_rms: float  # relative standard deviation of the instantaneous brightness at the zenith at sea level
    seed: int = 0

    def rms(self, sine_apparent_altitude: ArrayLike, height_m: float) -> Float:
        """Return the relative standard deviations, (...), of the instantaneous brightness of stars.

        `sine_apparent_altitude` (...): sines of altitudes with refraction; `height_m`: height of the observer.
        """
        at_zenith = self.zenith_rms * exp(-max(height_m, 0.0) / _SCALE_HEIGHT_M)
        return np.asarray(at_zenith * air_mass(sine_apparent_altitude) ** _AIR_MASS_POWER)

    def mean_factors(self, rms: Float, star_id: NDArray[np.int32], utc_s: float, duration_s: float) -> Float:
        """Return the mean relative brightness of stars over an exposure, (m,), log-normal with the mean 1.

        `rms` (m,): see `rms`; `star_id` (m,): the stars' numbers; `utc_s`: start of the exposure.
        """
        steps = duration_s / _CORRELATION_S
        # The variance of the mean of a process with exponential correlation.
        fraction = 2 * (steps + expm1(-steps)) / (steps * steps)
        return np.asarray(_log_normal(rms * fraction**0.5, self._normal(star_id, utc_s, 1))[0])

    def factors(self, rms: Float, star_id: NDArray[np.int32], utc_s: float, duration_s: float, times: int) -> Float:
        """Return the relative brightness of stars at equidistant times from start to end of an exposure, (times, m).

        `rms`, `star_id`, `utc_s`, `duration_s`: as for `mean_factors`.  A process with exponential correlation,
        averaged over a step between two times, so that the mean over the exposure has the right variance.
        """
        steps = duration_s / (times - 1) / _CORRELATION_S
        correlation = exp(-steps)
        normal = self._normal(star_id, utc_s, times)
        for k in range(1, times):
            normal[k] = correlation * normal[k - 1] + (1 - correlation * correlation) ** 0.5 * normal[k]
        return _log_normal(rms * (2 / steps * tanh(steps / 2)) ** 0.5, normal)

    def _normal(self, star_id: NDArray[np.int32], utc_s: float, times: int) -> Float:
        """Return numbers of a unit normal distribution, (times, m), which depend on star, exposure and seed only."""
        frame = np.uint64(round(utc_s * 1e6) & (2**64 - 1))
        of_seed = _hashed(np.array([self.seed], np.uint64) + _hashed(np.array([frame])))
        of_star = _hashed(np.asarray(star_id, np.int64).astype(np.uint64) ^ of_seed)
        count = np.arange(2 * times, dtype=np.uint64)[:, np.newaxis]
        uniform = (_hashed(of_star + count * _GOLDEN) >> np.uint64(11)).astype(np.float64) * 2.0**-53
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
