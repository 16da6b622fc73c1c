"""The sensor: from magnitudes to digital numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from math import hypot, isfinite
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.colourband import ColourBand
from glstar.camera.electrons import ElectronModel
from glstar.camera.pointspread import PointSpread, PsfComponent
from glstar.camera.truncation import FAINTEST_COMPONENT_DN, PLAIN, gaussian_radius_px
from glstar.errors import ConfigError
from glstar.sky.magnitudes import brightness_ratio

__all__ = [
    "MIN_WIDENED_SIGMA_PX",
    "PAPER_KEYS",
    "PIXEL_VARIANCE_PX2",
    "EffectValue",
    "NoiseModel",
    "Sensor",
]

Float = NDArray[np.float64]
PixelModel = Literal["integrated", "sampled"]
EffectValue = float | int | bool | str
NoiseModel = Literal["paper", "electrons"]

# Beginnings of the effects' keys that change the noiseless signal of stars; all others act on it later.
_KEYS_OF_LIGHT = ("sensor.psf", "sensor.band", "sensor.mosaic", "cloud.")

# Radius of the largest sprite of wings and halos, px: all drivers draw points of 255 px.
_LARGEST_PX = 110.0
# `Sensor.widest_sigma_px` times this contains every star, offsets included.
_WIDEST_IN_SIGMA = 8.0
# Variance of a square pixel of side 1, px^2: a pixel integrates over its area.
PIXEL_VARIANCE_PX2 = 1 / 12
# From this sigma, a Gaussian widened by the pixel's variance replaces the integral over it: at most 0.09 % of the
# flux is in another pixel (0.45 % at 0.7 px, 0.12 % at 1 px).
MIN_WIDENED_SIGMA_PX = 1.1


# Keys of ``[sensor]`` of the paper's noise model only.
PAPER_KEYS = ("reference_vmag", "reference_peak_dn", "reference_exposure_s", "sky_mean_dn", "sky_std_dn")


@dataclass(frozen=True, slots=True)
class Sensor:
    """Brightness, point spread function and background of a camera, as a calibration measures them.

    Attributes
    ----------
    reference_vmag : float
        Magnitude of the reference star.
    reference_peak_dn : float
        Amplitude of its point spread function above the sky if it does not move, DN.
    reference_exposure_s : float
        Exposure time that gives this amplitude, s.
    psf_sigma_px : float
        Standard deviation of the Gaussian point spread function, px.
    sky_mean_dn, sky_std_dn : float
        Mean and standard deviation of the background, DN.
    bit_depth : int
        Bits of the analogue-digital converter, 1 to 16; the sensor saturates at 2**bit_depth - 1 DN.
    pixel : {"integrated", "sampled"}
        Whether a pixel integrates over its area, as in real sensors, or samples the value at its centre, as in the
        paper.
    electrons : ElectronModel or None
        How light becomes digital numbers, with ``noise = "electrons"``: it replaces the reference star, the sky and the
        noise above.  None for the paper's noise model.
    effects : mapping of str to float, int, bool or str
        Values of the effects' keys that have no field here, by dotted key such as ``"vignetting.strength"``.  Keys that
        are missing have their defaults; see `glstar.render.effects`.

    Raises
    ------
    ConfigError
        If a value is not valid; `key` names it.

    Notes
    -----
    Teague & Chahl, section 2.5, eqs (36), (37), (40).  Departs from section 2.5: brightness is the amplitude above
    the sky, so that the mean of the sky is added once, with the noise, to the sum of all starlight.
    """

    reference_vmag: float = 3.0
    reference_peak_dn: float = 150.0
    reference_exposure_s: float = 0.5
    psf_sigma_px: float = 1.2
    sky_mean_dn: float = 16.0
    sky_std_dn: float = 3.0
    bit_depth: int = 8
    pixel: PixelModel = "integrated"
    electrons: ElectronModel | None = None
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
        self.point_spread.circular(self.psf_sigma_px)
        ColourBand.of(self.effects)
        if self.electrons is not None and self.electrons.black_level_dn >= self.saturation_dn:
            raise ConfigError(
                f"must be below the saturation of {self.bit_depth} bits, {self.saturation_dn} DN, not"
                f" {self.electrons.black_level_dn:g}",
                key="sensor.black_level_dn",
            )

    @property
    def noise(self) -> NoiseModel:
        """The noise model: ``"paper"`` or ``"electrons"``."""
        return "paper" if self.electrons is None else "electrons"

    @property
    def keys(self) -> dict[str, Any]:
        """The keys of ``[sensor]`` of its noise model, ready for JSON and TOML; with ``effects`` if it holds any."""
        names = [field.name for field in fields(self) if field.name not in {"effects", "electrons"}]
        keys = {name: getattr(self, name) for name in names if self.electrons is None or name not in PAPER_KEYS}
        if self.electrons is not None:
            keys = {"noise": self.noise, **keys, **self.electrons.keys}
        return keys | ({"effects": dict(self.effects)} if self.effects else {})

    @property
    def saturation_dn(self) -> int:
        """The largest value that a pixel can hold, DN."""
        return int(2**self.bit_depth - 1)

    @property
    def point_spread(self) -> PointSpread:
        """The shape of its stars: profile, wings, halo, ellipticity, and how their width varies."""
        return PointSpread.of(self.effects)

    @property
    def colour(self) -> ColourBand:
        """Its response to the colours of stars, and its mosaic."""
        return ColourBand.of(self.effects)

    @property
    def core(self) -> Self:
        """The sensor with the narrowest Gaussian of its point spread function, which limits the spacing of samples."""
        scale, _ = self.point_spread.scale_range
        narrow = min(self.point_spread.components(self.psf_sigma_px, scale=scale), key=lambda one: one.sigma_px)
        return self if self.point_spread.is_gaussian else self.of_component(narrow)

    @property
    def widest_sigma_px(self) -> float:
        """Largest `effective_sigma_px` of the Gaussians of a star anywhere on the image, with their offsets, px."""
        if self.point_spread.is_gaussian:
            return self.effective_sigma_px
        return max(
            hypot(*one.offset_px) / _WIDEST_IN_SIGMA + self.of_component(one).effective_sigma_px
            for one in self._widest_components
        )

    @property
    def _widest_components(self) -> tuple[PsfComponent, ...]:
        return self.point_spread.components(self.psf_sigma_px, scale=self.point_spread.scale_range[1])

    def of_component(self, component: PsfComponent) -> Self:
        """Return the sensor on which stars have the flux and the width of one Gaussian of theirs.

        Parameters
        ----------
        component : PsfComponent
            Of `point_spread`.

        Returns
        -------
        Sensor
            With a plain Gaussian.
        """
        peak_ratio = component.flux_fraction * self._flux_per_peak / (2 * np.pi * component.sigma_px**2)
        electrons = self.electrons
        if electrons is not None:
            flux_e_per_s = component.flux_fraction * electrons.vmag_0_e_per_s
            electrons = replace(electrons, vmag_0_e_per_s=flux_e_per_s)
        return replace(
            self,
            electrons=electrons,
            psf_sigma_px=component.sigma_px,
            reference_peak_dn=self.reference_peak_dn * float(peak_ratio),
            effects={key: value for key, value in self.effects.items() if not key.startswith("sensor.psf")},
        )

    @property
    def needs_erf(self) -> bool:
        """Whether the integral over a pixel needs erf; from sigma 1.1 px, a widened Gaussian approximates it."""
        return self.pixel == "integrated" and self.psf_sigma_px < MIN_WIDENED_SIGMA_PX

    @property
    def effective_sigma_px(self) -> float:
        """Standard deviation of a star in the image, px: of the point spread function and the pixel."""
        extra_px2 = PIXEL_VARIANCE_PX2 if self.pixel == "integrated" else 0.0
        return float(np.sqrt(self.psf_sigma_px**2 + extra_px2))

    @property
    def effective_peak(self) -> float:
        """Amplitude of a star in the image over that of the point spread function; the flux is the same."""
        return (self.psf_sigma_px / self.effective_sigma_px) ** 2

    def peak_dn(self, vmag: ArrayLike, duration_s: float) -> Float:
        """Return the amplitude of the point spread function of stars that do not move, DN.

        Parameters
        ----------
        vmag : (...) array_like
            Magnitudes.
        duration_s : float
            Exposure time, s; the amplitude is proportional to it.

        Returns
        -------
        (...) float64
            DN, above the sky.

        Notes
        -----
        Teague & Chahl, eq. (37).  Departs from eq. (37): this is the amplitude of the fitted Gaussian, not the value
        of the brightest pixel, which is 2 to 15 % lower, depending on the position of the star within the pixel.
        In electrons the flux is given instead, and the amplitude follows from it.
        """
        if self.electrons is not None:
            flux_e = self.electrons.vmag_0_e_per_s * duration_s * brightness_ratio(np.asarray(vmag, dtype=np.float64))
            return np.asarray(self.electrons.dn_per_e * flux_e / self._flux_per_peak)
        exposure_ratio = duration_s / self.reference_exposure_s
        magnitude_difference = np.asarray(vmag, dtype=np.float64) - self.reference_vmag
        return self.reference_peak_dn * exposure_ratio * brightness_ratio(magnitude_difference)

    def flux_dn(self, peak_dn: ArrayLike) -> Float:
        """Return the flux of stars, the sum over their pixels: 2 pi sigma^2 times the amplitude, DN.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes as `peak_dn` gives them, DN.

        Returns
        -------
        (...) float64
        """
        return self._flux_per_peak * np.asarray(peak_dn, dtype=np.float64)

    @property
    def _flux_per_peak(self) -> float:
        """Flux of a star over the amplitude of its point spread function, px^2."""
        return self.point_spread.flux_per_peak_px2(self.psf_sigma_px)

    def background_mean_dn(self, duration_s: float) -> float:
        """Return the mean of pixels without a star, on the optical axis, DN.

        Parameters
        ----------
        duration_s : float
            Exposure time, s.

        Returns
        -------
        float
            With the black level, if the sensor has one.
        """
        model = self.electrons
        if model is None:
            return self.sky_mean_dn
        return model.black_level_dn + model.dn_per_e * model.background_e(duration_s)

    def background_std_dn(self, duration_s: float) -> float:
        """Return the standard deviation of pixels without a star, on the optical axis, DN.

        Parameters
        ----------
        duration_s : float
            Exposure time, s.

        Returns
        -------
        float
        """
        model = self.electrons
        if model is None:
            return self.sky_std_dn
        return float(model.dn_per_e * np.sqrt(model.variance_e2(model.background_e(duration_s))))

    def flux_of_magnitude_dn(self, vmag: ArrayLike, duration_s: float) -> Float:
        """Return the signal that a source of some magnitude leaves on all its pixels together, DN.

        Valid for every noise model of the sensor, for points and, with magnitudes per pixel, for surfaces.

        Parameters
        ----------
        vmag : (...) array_like
            Magnitudes in the camera's band, as they reach the lens.
        duration_s : float
            Exposure time, s; the flux is proportional to it.

        Returns
        -------
        (...) float64
            DN above the background, before saturation.  The lens transmits this on its axis.
        """
        return self.flux_dn(self.peak_dn(vmag, duration_s))

    def max_trail_peak_dn(self, peak_dn: ArrayLike, min_trail_px: ArrayLike) -> Float:
        """Return an upper bound of the largest signal in the trails of stars, DN.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes as returned by `peak_dn`, DN.
        min_trail_px : (...) array_like
            Lower bound of the trail length at the slowest rate during the exposure, px.

        Returns
        -------
        (...) float64
            DN, above the sky.
        """
        return np.asarray(np.asarray(peak_dn, dtype=np.float64) / self._peak_reduction(min_trail_px))

    def _peak_reduction(self, min_trail_px: ArrayLike) -> Float:
        """Return a lower bound of the factor by which motion reduces the peak of a star."""
        trail_px = np.asarray(min_trail_px, dtype=np.float64)
        return np.asarray(np.maximum(1.0, trail_px / (_trail_sigma_px(self) * np.sqrt(2 * np.pi))))

    def truncation_radius_px(
        self, peak_dn: ArrayLike, min_trail_px: ArrayLike = 0.0, *, renormalized: bool = False
    ) -> Float:
        """Return the radius at which the point spread functions of stars are truncated, along x and along y, px.

        Parameters
        ----------
        peak_dn : (...) array_like
            Amplitudes as returned by `peak_dn`, DN.
        min_trail_px : (...) array_like
            Lower bound of the trail length at the slowest rate during the exposure, px.  A moving star is fainter at
            the edge of its point spread function.
        renormalized : bool
            Whether the flux outside the radius is added to the rest, as it is for analytic trails, so that none is
            lost.

        Returns
        -------
        (...) float64
            Where the signal over the whole exposure falls below 0.02 DN and 1e-4 of `peak_dn`, but at least 3.5 sigma,
            outside which is 1e-3 of the flux.  Renormalized: below 0.02 DN and 1e-3 of `peak_dn`, but at least
            1.5 sigma and 1.2 px.

        Notes
        -----
        Departs from eq. (42), whose kernel of 6 sigma^2 px cuts a visible square out of the wings of a bright star and
        loses half a percent of the flux of a faint one.
        """
        if not self.point_spread.is_gaussian:
            return self._widest_truncation_px(peak_dn, min_trail_px, renormalized=renormalized)
        reduction = self._peak_reduction(min_trail_px)
        return gaussian_radius_px(self.effective_sigma_px, peak_dn, reduction, renormalized=renormalized)

    def _widest_truncation_px(self, peak_dn: ArrayLike, min_trail_px: ArrayLike, *, renormalized: bool) -> Float:
        """Return the largest of the truncation radii of the Gaussians of stars anywhere on the image, px."""
        peak, largest = np.asarray(peak_dn, dtype=np.float64), np.zeros(())
        for one in self._widest_components:
            gaussian = self.of_component(one)
            of_peak = gaussian.reference_peak_dn / self.reference_peak_dn
            radius_px = gaussian.component_radius_px(of_peak * peak, min_trail_px, renormalized=renormalized)
            largest = np.maximum(largest, hypot(*one.offset_px) + radius_px)
        return largest

    def component_radius_px(self, peak_dn: ArrayLike, min_trail_px: ArrayLike, *, renormalized: bool) -> Float:
        """Return `truncation_radius_px` of one Gaussian of several, limited to what drivers draw as one sprite, px.

        Parameters
        ----------
        peak_dn, min_trail_px, renormalized
            As for `truncation_radius_px`.

        Returns
        -------
        (...) float64
            At most 110 px, or 3.5 sigma if that is more.  Of the wings of a faint star nothing below
            `FAINTEST_COMPONENT_DN` is drawn.
        """
        sigma_px, reduction = self.effective_sigma_px, self._peak_reduction(min_trail_px)
        radius_px = gaussian_radius_px(
            sigma_px, peak_dn, reduction, renormalized=renormalized, faintest_dn=FAINTEST_COMPONENT_DN
        )
        return np.minimum(radius_px, max(_LARGEST_PX, PLAIN.min_sigma * sigma_px))

    def leaves_same_signal(self, other: "Sensor") -> bool:
        """Return whether stars leave the same noiseless signal on another sensor.

        Parameters
        ----------
        other : Sensor
            Its sky, noise, bit depth and effects may differ.

        Returns
        -------
        bool
        """
        if not _have_same_gain(self.electrons, other.electrons):
            return False
        equalised = replace(
            self,
            electrons=other.electrons,
            sky_mean_dn=other.sky_mean_dn,
            sky_std_dn=other.sky_std_dn,
            bit_depth=other.bit_depth,
            effects=other.effects,
        )
        return equalised == other and _of_light(self.effects) == _of_light(other.effects)

    def with_bit_depth(self, bit_depth: int) -> Self:
        """Return the sensor with another bit depth; all brightnesses keep their fraction of full scale.

        Parameters
        ----------
        bit_depth : int
            Bits, 1 to 16.

        Returns
        -------
        Sensor
        """
        scale = (2**bit_depth - 1) / self.saturation_dn
        return replace(
            self,
            reference_peak_dn=self.reference_peak_dn * scale,
            sky_mean_dn=self.sky_mean_dn * scale,
            sky_std_dn=self.sky_std_dn * scale,
            bit_depth=bit_depth,
            electrons=None if self.electrons is None else self.electrons.with_scale(scale),
            effects={
                key: value * scale if key.endswith("_dn") and isinstance(value, float) else value
                for key, value in self.effects.items()
            },
        )


def _trail_sigma_px(sensor: Sensor) -> float:
    """Mean width of a star's Gaussians, weighted with their amplitudes: it decides the peak of a trail."""
    psf = sensor.point_spread
    if psf.is_gaussian:
        return sensor.effective_sigma_px
    sensors = [sensor.of_component(one) for one in psf.circular(sensor.psf_sigma_px)]
    peaks = np.array([one.reference_peak_dn for one in sensors])
    widths_px = np.array([one.effective_sigma_px for one in sensors])
    longest = psf.scale_range[1] / np.sqrt(1 - psf.psf_ellipticity)
    return float(longest * peaks @ widths_px / peaks.sum())


def _of_light(effects: Mapping[str, EffectValue]) -> dict[str, EffectValue]:
    return {key: value for key, value in effects.items() if key.startswith(_KEYS_OF_LIGHT)}


def _have_same_gain(one: ElectronModel | None, other: ElectronModel | None) -> bool:
    """Return whether a star leaves the same signal with two electron models, or with none."""
    return one is other if one is None or other is None else one.leaves_same_signal(other)
