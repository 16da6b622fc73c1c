"""Extinction: how much light the air above an aircraft absorbs and scatters, by altitude and height.

The models are of the V band.  Green 1992 (International Comet Quarterly 14, 55) after Hayes & Latham 1975 has three
parts: scattering by the air (Rayleigh), by aerosol, and absorption by ozone above all aircraft.
"""

from dataclasses import dataclass
from math import exp
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Extinction", "air_mass"]

Float = NDArray[np.float64]

# Height in which the pressure falls to 1/e, m, and the pressure at sea level, hPa: Green 1992.
_PRESSURE_SCALE_M: Final = 7996.0
_SEA_LEVEL_HPA: Final = 1013.25


@dataclass(frozen=True, slots=True)
class Extinction:
    """Extinction by the air above an observer.

    Attributes
    ----------
    rayleigh_mag : float
        Of the air at sea level, per air mass, mag: 0.1451 at 510 nm, the eye's night vision, by Green; 0.105
        at 550 nm.
    aerosol_mag : float
        Of the aerosol at sea level, per air mass, mag: 0.05 in very clear air, 0.120 usual, 0.3 in haze.
    aerosol_scale_m : float
        Height in which the aerosol falls to 1/e, m.
    ozone_mag : float
        Of the ozone, per air mass, mag.
    pressure_hpa : float or None
        Pressure at the observer, which the air's part is proportional to; None for that of the standard atmosphere at
        the observer's height.
    """

    rayleigh_mag: float = 0.1451
    aerosol_mag: float = 0.120
    aerosol_scale_m: float = 1500.0
    ozone_mag: float = 0.016
    pressure_hpa: float | None = None

    def rayleigh_at_mag(self, height_m: float) -> float:
        """Return the part of the air per air mass at a height, mag.

        Parameters
        ----------
        height_m : float
            Height above sea level, m.

        Returns
        -------
        float
        """
        if self.pressure_hpa is not None:
            return self.rayleigh_mag * self.pressure_hpa / _SEA_LEVEL_HPA
        return self.rayleigh_mag * exp(-height_m / _PRESSURE_SCALE_M)

    def aerosol_at_mag(self, height_m: float) -> float:
        """Return the part of the aerosol per air mass at a height, mag.

        Parameters
        ----------
        height_m : float
            Height above sea level, m.

        Returns
        -------
        float
        """
        return self.aerosol_mag * exp(-height_m / self.aerosol_scale_m)

    def zenith_mag(self, height_m: float) -> float:
        """Return the extinction per air mass, which is that of the zenith, mag.

        Parameters
        ----------
        height_m : float
            Height above sea level, m.

        Returns
        -------
        float

        Notes
        -----
        Green 1992, eqs (2) to (4).
        """
        return self.rayleigh_at_mag(height_m) + self.aerosol_at_mag(height_m) + self.ozone_mag


def air_mass(sine_apparent_altitude: ArrayLike) -> Float:
    """Return the air mass: the air along a line of sight over that towards the zenith.

    Parameters
    ----------
    sine_apparent_altitude : (...) array_like
        Sine of the altitude with refraction.  Below the horizontal, the horizontal's air mass (40) is returned.

    Returns
    -------
    (...) float64

    Notes
    -----
    Rozenberg 1966, as in Green 1992: X = 1 / (s + 0.025 exp(-11 s)).
    """
    s = np.maximum(np.asarray(sine_apparent_altitude, dtype=np.float64), 0.0)
    return np.asarray(1 / (s + 0.025 * np.exp(-11 * s)))
