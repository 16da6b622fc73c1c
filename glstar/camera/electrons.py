"""The electron model of a sensor: photo-electrons, dark current, full well, noise, gain and black level."""

from dataclasses import dataclass, fields, replace
from math import hypot, isfinite
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.errors import ConfigError

__all__ = ["DARK_REFERENCE_C", "ElectronModel"]

Float = NDArray[np.float64]

# Temperature at which data sheets give the dark current, degrees Celsius.
DARK_REFERENCE_C: Final = 25.0

_POSITIVE: Final = ("vmag_0_e_per_s", "gain_dn_per_e", "analogue_gain", "full_well_e", "dark_doubling_c")
_NOT_NEGATIVE: Final = (
    "sky_e_per_s",
    "black_level_dn",
    "read_noise_before_gain_e",
    "read_noise_after_gain_e",
    "dark_current_e_per_s",
)


@dataclass(frozen=True, slots=True)
class ElectronModel:
    """How light becomes digital numbers in a sensor that counts electrons.

    The defaults are those of the preset ``generic``: a 12-bit sensor of the class of the Sony IMX477 behind a 6 mm
    f/1.2 lens.

    Attributes
    ----------
    vmag_0_e_per_s : float
        Photo-electrons per second of a star of magnitude 0 on the optical axis, e/s.
    sky_e_per_s : float
        Photo-electrons per second and pixel of a uniform sky on the optical axis, e/s.
    gain_dn_per_e : float
        Conversion factor at an analogue gain of 1, DN/e.
    analogue_gain : float
        Amplification before the converter, a factor.
    full_well_e : float
        Most electrons of a pixel, e.
    black_level_dn : float
        Digital number without light, DN.
    read_noise_before_gain_e : float
        Read noise that arises before the amplifier, e rms.
    read_noise_after_gain_e : float
        Read noise that arises behind the amplifier, e rms at an analogue gain of 1.
    dark_current_e_per_s : float
        Dark current at 25 degrees Celsius, e/s per pixel.
    dark_doubling_c : float
        Rise of temperature that doubles the dark current, degrees Celsius.
    temperature_c : float
        Temperature of the sensor, degrees Celsius.

    Raises
    ------
    ConfigError
        If a value is not valid; `key` names it.

    Notes
    -----
    Janesick, Photon Transfer (2007), chapter 5; EMVA Standard 1288, release 4.0, linear model, eqs (3) to (12).
    """

    vmag_0_e_per_s: float = 90_000.0
    sky_e_per_s: float = 0.0
    gain_dn_per_e: float = 0.47
    analogue_gain: float = 1.0
    full_well_e: float = 8200.0
    black_level_dn: float = 256.0
    read_noise_before_gain_e: float = 1.5
    read_noise_after_gain_e: float = 2.8
    dark_current_e_per_s: float = 0.2
    dark_doubling_c: float = 7.0
    temperature_c: float = 25.0

    def __post_init__(self) -> None:
        for key in _POSITIVE:
            value = getattr(self, key)
            if not (isfinite(value) and value > 0):
                raise ConfigError(f"must be a positive number, not {value}", key=f"sensor.{key}")
        for key in _NOT_NEGATIVE:
            value = getattr(self, key)
            if not (isfinite(value) and value >= 0):
                raise ConfigError(f"must be a number, 0 or more, not {value}", key=f"sensor.{key}")
        if not isfinite(self.temperature_c):
            raise ConfigError(f"must be a temperature, not {self.temperature_c}", key="sensor.temperature_c")

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of ``[sensor]`` that belong to this model, by name, ready for JSON and TOML."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def dn_per_e(self) -> float:
        """Digital numbers per electron, with the analogue gain: the K of EMVA 1288."""
        return self.gain_dn_per_e * self.analogue_gain

    @property
    def read_noise_e(self) -> float:
        """Read noise, e rms: of the parts before and behind the amplifier."""
        return hypot(self.read_noise_before_gain_e, self.read_noise_after_gain_e / self.analogue_gain)

    @property
    def dark_e_per_s(self) -> float:
        """Dark current at the sensor's temperature, e/s per pixel."""
        doublings = (self.temperature_c - DARK_REFERENCE_C) / self.dark_doubling_c
        return float(self.dark_current_e_per_s * 2.0**doublings)

    def background_e(self, duration_s: float) -> float:
        """Return the mean number of electrons of a pixel without a star, on the optical axis.

        Parameters
        ----------
        duration_s : float
            Exposure time, s.

        Returns
        -------
        float
            Of sky and dark current, at most the full well, e.
        """
        return min((self.sky_e_per_s + self.dark_e_per_s) * duration_s, self.full_well_e)

    def variance_e2(self, mean_e: ArrayLike) -> Float:
        """Return the variance of pixels: shot noise and read noise, e^2.

        Parameters
        ----------
        mean_e : (...) array_like
            Mean numbers of electrons, e.

        Returns
        -------
        (...) float64
            Without the 1/12 DN^2 of rounding.

        Notes
        -----
        EMVA 1288, eq. (9): the variance of a Poisson count is its mean.
        """
        return np.asarray(mean_e, dtype=np.float64) + self.read_noise_e**2

    def pixel_electrons(self, pixel_dn: float) -> tuple[float, float]:
        """Return the electrons of a pixel and their signal-to-noise ratio, from its digital number.

        Parameters
        ----------
        pixel_dn : float
            Digital number, DN.

        Returns
        -------
        electrons : float
            Above the black level, e; negative by noise.
        signal_to_noise : float
            Over shot noise and read noise; 0 for negative ones.
        """
        electrons = (pixel_dn - self.black_level_dn) / self.dn_per_e
        counted = max(electrons, 0.0)
        variance_e2 = float(self.variance_e2(counted))
        return electrons, counted / variance_e2**0.5 if variance_e2 > 0 else 0.0

    def signal_to_noise(self, flux_e: ArrayLike, area_px2: ArrayLike, duration_s: float) -> Float:
        """Return the signal-to-noise ratio of stars, measured with the weights of their own profile.

        Parameters
        ----------
        flux_e : (...) array_like
            Electrons of each star on all its pixels together, e.
        area_px2 : (...) array_like
            Noise-equivalent area of each: 1 over the sum of its squared profile, px^2; 4 pi sigma^2 at rest.
        duration_s : float
            Exposure time, s.

        Returns
        -------
        (...) float64

        Notes
        -----
        Merline & Howell 1995, Exp. Astron. 6, 163, eq. (1), with the noise-equivalent area of King 1983 for the number
        of pixels.  Saturation and the rounding to DN are not in it.
        """
        flux = np.asarray(flux_e, dtype=np.float64)
        background_e2 = self.variance_e2(self.background_e(duration_s))
        noise_e2 = flux + np.asarray(area_px2) * background_e2
        return np.asarray(flux / np.sqrt(np.maximum(noise_e2, np.finfo(np.float64).tiny)))

    def with_scale(self, scale: float) -> Self:
        """Return the model with digital numbers `scale` times as large, for another bit depth.

        Parameters
        ----------
        scale : float

        Returns
        -------
        ElectronModel
        """
        return replace(self, gain_dn_per_e=self.gain_dn_per_e * scale, black_level_dn=self.black_level_dn * scale)

    def leaves_same_signal(self, other: "ElectronModel") -> bool:
        """Return whether stars leave the same noiseless signal on another sensor.

        Parameters
        ----------
        other : ElectronModel

        Returns
        -------
        bool
        """
        return (self.vmag_0_e_per_s, self.dn_per_e) == (other.vmag_0_e_per_s, other.dn_per_e)
