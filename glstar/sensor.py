"""The sensor: how starlight becomes digital numbers."""

from dataclasses import dataclass, replace
from math import isfinite
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.errors import ConfigError
from glstar.photometry import brightness_ratio

__all__ = ["FAINTEST_DN", "FAINTEST_SHARE", "Sensor"]

Float = NDArray[np.float64]

# A sprite ends where the star's light over the whole exposure falls under this, DN ...
FAINTEST_DN = 0.02
# ... or under this share of its peak, whichever is fainter: 4.3 sigma, outside which lie 4e-5 of the light.
FAINTEST_SHARE = 1e-4
# A pixel integrates over its area: the variance of a square one pixel wide, px^2.
_PIXEL_VARIANCE_PX2 = 1 / 12
# From this sigma up a widened Gaussian stands for the integral over the pixel, to 0.5 % of the light and better.
_WIDENED_FROM_SIGMA_PX = 0.7


@dataclass(frozen=True, slots=True)
class Sensor:
    """What a calibration knows of lens and sensor together.

    Attributes
    ----------
    reference_vmag : float
        Magnitude of the reference star.
    reference_peak_dn : float
        The amplitude of its point spread function (sky removed) when it stands still, DN.
    reference_exposure_s : float
        The exposure in which it reaches that, s.
    psf_sigma_px : float
        Standard deviation of the Gaussian point spread function, px.
    sky_mean_dn, sky_std_dn : float
        Mean and standard deviation of the background, DN.
    bit_depth : int
        Bits of the analogue-digital converter, 1 to 16; the sensor saturates at 2**bit_depth - 1.
    pixel : {"integrated", "sampled"}
        Whether a pixel gathers light over its area, as real ones do, or takes the value at its centre, as the
        paper does.

    Raises
    ------
    ConfigError
        If a number cannot be meant; `key` names it.

    Notes
    -----
    Teague & Chahl, section 2.5, eqs (36), (37), (40).
    """

    reference_vmag: float = 3.0
    reference_peak_dn: float = 150.0
    reference_exposure_s: float = 0.5
    psf_sigma_px: float = 1.2
    sky_mean_dn: float = 16.0
    sky_std_dn: float = 3.0
    bit_depth: int = 8
    pixel: Literal["integrated", "sampled"] = "integrated"

    def __post_init__(self) -> None:
        for key in ("reference_peak_dn", "reference_exposure_s", "psf_sigma_px"):
            value = getattr(self, key)
            if not (isfinite(value) and value > 0):
                raise ConfigError(f"must be a positive number, not {value}", key=f"sensor.{key}")
        for key in ("sky_mean_dn", "sky_std_dn"):
            value = getattr(self, key)
            if not (isfinite(value) and value >= 0):
                raise ConfigError(f"must be a number of DN, 0 or more, not {value}", key=f"sensor.{key}")
        if not isfinite(self.reference_vmag):
            raise ConfigError(f"must be a magnitude, not {self.reference_vmag}", key="sensor.reference_vmag")
        if not 1 <= self.bit_depth <= 16:
            raise ConfigError(f"must lie between 1 and 16, not {self.bit_depth}", key="sensor.bit_depth")

    @property
    def saturation_dn(self) -> int:
        """The largest value that a pixel can hold, DN."""
        return int(2**self.bit_depth - 1)

    @property
    def needs_erf(self) -> bool:
        """Whether the integral over a pixel takes erf; from sigma 0.7 px up a widened Gaussian stands for it."""
        return self.pixel == "integrated" and self.psf_sigma_px < _WIDENED_FROM_SIGMA_PX

    @property
    def drawn_sigma_px(self) -> float:
        """Standard deviation of a star as the pixels record it, px."""
        extra_px2 = _PIXEL_VARIANCE_PX2 if self.pixel == "integrated" else 0.0
        return float(np.sqrt(self.psf_sigma_px**2 + extra_px2))

    def peak_dn(self, vmag: ArrayLike, duration_s: float) -> Float:
        """Return the amplitude of a star's point spread function when it stands still, DN.

        Parameters
        ----------
        vmag : (...) array_like
            Magnitudes.
        duration_s : float
            Exposure, s; the light grows with it.

        Returns
        -------
        (...) float64
            DN, above the sky.

        Notes
        -----
        Teague & Chahl, eq. (37).  Departs from eq. (37): the amplitude of the fitted Gaussian, not the brightest
        pixel, which lies 2 to 15 % lower depending on where in the pixel the star falls.
        """
        share = duration_s / self.reference_exposure_s
        fainter = np.asarray(vmag, dtype=np.float64) - self.reference_vmag
        return self.reference_peak_dn * share * brightness_ratio(fainter)

    def flux_dn(self, peak_dn: ArrayLike) -> Float:
        """Return all the light of a star, summed over its pixels: 2 pi sigma^2 times its amplitude, DN.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes as `peak_dn` gives them, DN.

        Returns
        -------
        (...) float64
        """
        return 2 * np.pi * self.psf_sigma_px**2 * np.asarray(peak_dn, dtype=np.float64)

    def reach_px(self, peak_dn: ArrayLike) -> Float:
        """Return how far from its centre a star is drawn, along x and along y, px.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes over the whole exposure, DN.

        Returns
        -------
        (...) float64
            To where its light falls under 0.02 DN and under 1e-4 of its peak.

        Notes
        -----
        Departs from eq. (42), whose kernel of 6 sigma^2 px cuts a visible square out of a bright star's skirt and
        loses half a percent of a faint one's light.
        """
        contrast = np.maximum(np.asarray(peak_dn, dtype=np.float64) / FAINTEST_DN, 1 / FAINTEST_SHARE)
        return np.asarray(self.drawn_sigma_px * np.sqrt(2 * np.log(contrast)))

    def with_bit_depth(self, bit_depth: int) -> Self:
        """Return the same sensor behind a converter of another depth: full scale stays full scale.

        Parameters
        ----------
        bit_depth : int
            Bits, 1 to 16.

        Returns
        -------
        Sensor
        """
        finer = (2**bit_depth - 1) / self.saturation_dn
        return replace(
            self,
            reference_peak_dn=self.reference_peak_dn * finer,
            sky_mean_dn=self.sky_mean_dn * finer,
            sky_std_dn=self.sky_std_dn * finer,
            bit_depth=bit_depth,
        )
