"""The sensor: how starlight becomes digital numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from math import isfinite
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.errors import ConfigError
from glstar.sky.magnitudes import brightness_ratio

__all__ = ["FAINTEST_DN", "PIXEL_VARIANCE_PX2", "WIDENED_FROM_SIGMA_PX", "EffectValue", "Sensor"]

Float = NDArray[np.float64]
PixelModel = Literal["integrated", "sampled"]
EffectValue = float | int | bool | str

# A star is drawn to where its light over the whole exposure falls under this, DN ...
FAINTEST_DN = 0.02
# ... and under this share of its peak, but never nearer than so many sigma; farther where what is cut off is lost than
# where it is given back to the rest.
_FAINTEST_SHARE, _LEAST_REACH_SIGMA = 1e-4, 3.5
_FAINTEST_SHARE_GIVEN_BACK, _LEAST_REACH_SIGMA_GIVEN_BACK = 1e-3, 1.5
# Nearer, how much is left of a narrow one would hang on where between two pixels its trail runs.
_LEAST_REACH_PX_GIVEN_BACK = 1.2
# A pixel integrates over its area: the variance of a square one pixel wide, px^2.
PIXEL_VARIANCE_PX2 = 1 / 12
# From this sigma up a widened Gaussian stands for the integral over the pixel, to 0.5 % of the light and better.
WIDENED_FROM_SIGMA_PX = 0.7


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
    effects : mapping of str to float, int, bool or str
        Values of the effects' keys that have no field here, by dotted key such as ``"vignetting.strength"``.  Keys that
        are missing have their defaults; see `glstar.render.effects`.

    Raises
    ------
    ConfigError
        If a number cannot be meant; `key` names it.

    Notes
    -----
    Teague & Chahl, section 2.5, eqs (36), (37), (40).  Departs from section 2.5: brightness is the amplitude above
    the sky, so that the sky's mean is added once, with the noise, to the sum of all light.
    """

    reference_vmag: float = 3.0
    reference_peak_dn: float = 150.0
    reference_exposure_s: float = 0.5
    psf_sigma_px: float = 1.2
    sky_mean_dn: float = 16.0
    sky_std_dn: float = 3.0
    bit_depth: int = 8
    pixel: PixelModel = "integrated"
    effects: Mapping[str, EffectValue] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if self.bit_depth not in range(1, 17):
            raise ConfigError(f"must lie between 1 and 16, not {self.bit_depth}", key="sensor.bit_depth")
        if self.pixel not in get_args(PixelModel):
            raise ConfigError(f"must be 'integrated' or 'sampled', not {self.pixel!r}", key="sensor.pixel")
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

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of ``[sensor]`` by name, ready for JSON and TOML; with ``effects`` only if it holds any."""
        names = [field.name for field in fields(self) if field.name != "effects"]
        return {name: getattr(self, name) for name in names} | ({"effects": dict(self.effects)} if self.effects else {})

    @property
    def saturation_dn(self) -> int:
        """The largest value that a pixel can hold, DN."""
        return int(2**self.bit_depth - 1)

    @property
    def needs_erf(self) -> bool:
        """Whether the integral over a pixel takes erf; from sigma 0.7 px up a widened Gaussian stands for it."""
        return self.pixel == "integrated" and self.psf_sigma_px < WIDENED_FROM_SIGMA_PX

    @property
    def drawn_sigma_px(self) -> float:
        """Standard deviation of a star as the pixels record it, px."""
        extra_px2 = PIXEL_VARIANCE_PX2 if self.pixel == "integrated" else 0.0
        return float(np.sqrt(self.psf_sigma_px**2 + extra_px2))

    @property
    def drawn_peak(self) -> float:
        """Amplitude of a star as the pixels record it, over that of the point spread function: the light stays."""
        return (self.psf_sigma_px / self.drawn_sigma_px) ** 2

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

    def trail_peak_dn(self, peak_dn: ArrayLike, slowest_trail_px: ArrayLike) -> Float:
        """Return a bound on the brightest light of a star's trail, DN.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes as `peak_dn` gives them, DN.
        slowest_trail_px : (...) array_like
            See `reach_px`.

        Returns
        -------
        (...) float64
            DN, above the sky.
        """
        spread_over = np.asarray(slowest_trail_px, dtype=np.float64) / (self.drawn_sigma_px * np.sqrt(2 * np.pi))
        return np.asarray(np.asarray(peak_dn, dtype=np.float64) / np.maximum(1.0, spread_over))

    def reach_px(self, peak_dn: ArrayLike, slowest_trail_px: ArrayLike = 0.0, *, given_back: bool = False) -> Float:
        """Return how far from its centre a star is drawn, along x and along y, px.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes as `peak_dn` gives them: of the star standing still for the whole exposure, DN.
        slowest_trail_px : (...) array_like
            The trail that it would leave at the slowest rate it has during the exposure, px: a moving star spreads
            its light, and what is left at the sprite's edge is fainter.
        given_back : bool
            Whether what is cut off is given back to what is left, as it is for swept trails: no light is lost then.

        Returns
        -------
        (...) float64
            To where its light over the whole exposure falls under 0.02 DN and under 1e-4 of `peak_dn`, and 3.5 sigma
            at the least, outside which lies 1e-3 of the light.  Where that is given back, under 0.02 DN and 1e-3 of
            `peak_dn`, and 1.5 sigma and 1.2 px at the least.

        Notes
        -----
        Departs from eq. (42), whose kernel of 6 sigma^2 px cuts a visible square out of a bright star's skirt and
        loses half a percent of a faint one's light.
        """
        sigma_px = self.drawn_sigma_px
        trail_px = np.asarray(slowest_trail_px, dtype=np.float64)
        spread_over = np.maximum(1.0, trail_px / (sigma_px * np.sqrt(2 * np.pi)))
        share, least_px = _FAINTEST_SHARE, _LEAST_REACH_SIGMA * sigma_px
        if given_back:
            share = _FAINTEST_SHARE_GIVEN_BACK
            least_px = max(_LEAST_REACH_SIGMA_GIVEN_BACK * sigma_px, _LEAST_REACH_PX_GIVEN_BACK)
        contrast = np.maximum(np.asarray(peak_dn, dtype=np.float64) / FAINTEST_DN, 1 / share) / spread_over
        reach_sigma = np.sqrt(2 * np.log(np.maximum(contrast, 1.0)))
        return np.asarray(np.maximum(sigma_px * reach_sigma, least_px))

    def same_light(self, other: "Sensor") -> bool:
        """Say whether stars leave the same light on another sensor; sky, noise and converter may differ.

        Parameters
        ----------
        other : Sensor

        Returns
        -------
        bool
        """
        alike = replace(
            self,
            sky_mean_dn=other.sky_mean_dn,
            sky_std_dn=other.sky_std_dn,
            bit_depth=other.bit_depth,
            effects=other.effects,
        )
        return alike == other

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
            effects={
                key: value * finer if key.endswith("_dn") and isinstance(value, float) else value
                for key, value in self.effects.items()
            },
        )
