"""The sensor: from magnitudes to digital numbers, in the paper's model or in electrons, and its limiting magnitude."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from math import erfc, exp, hypot, isfinite, log10, nan, pi, sqrt
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.camera.sensor import pointspread
from glstar.camera.sensor.colourband import ColourBand
from glstar.camera.sensor.pointspread import PointSpread, PsfComponent
from glstar.errors import ConfigError
from glstar.sky.photometry import brightness_ratio

# Temperature at which data sheets give the dark current, degrees Celsius.
DARK_REFERENCE_C = 25.0

_POSITIVE = ("vmag_0_e_per_s", "gain_dn_per_e", "analogue_gain", "full_well_e", "dark_doubling_c")
_NOT_NEGATIVE = (
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
    f/1.2 lens.  Raises ConfigError if a value is not valid; `key` names it.  Janesick, Photon Transfer (2007),
    chapter 5; EMVA Standard 1288, release 4.0, linear model, eqs (3) to (12).
    """

    vmag_0_e_per_s: float = 90_000.0  # Photo-electrons per second of a star of magnitude 0 on the optical axis, e/s
    sky_e_per_s: float = 0.0  # Photo-electrons per second and pixel of a uniform sky on the optical axis, e/s
    gain_dn_per_e: float = 0.47  # Conversion factor at an analogue gain of 1, DN/e
    analogue_gain: float = 1.0  # Amplification before the converter, a factor
    full_well_e: float = 8200.0  # Most electrons of a pixel, e
    black_level_dn: float = 256.0  # Digital number without light, DN
    read_noise_before_gain_e: float = 1.5  # Read noise that arises before the amplifier, e rms
    read_noise_after_gain_e: float = 2.8  # Read noise that arises behind the amplifier, e rms at an analogue gain of 1
    dark_current_e_per_s: float = 0.2  # Dark current at 25 degrees Celsius, e/s per pixel
    dark_doubling_c: float = 7.0  # Rise of temperature that doubles the dark current, degrees Celsius
    temperature_c: float = 25.0  # Temperature of the sensor, degrees Celsius

    def __post_init__(self) -> None:
        _require_positive(self, _POSITIVE)
        _require_not_negative(self, _NOT_NEGATIVE, "a number, 0 or more")
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

    def sky_and_dark_e(self, duration_s: float) -> float:
        """Return the mean number of electrons of sky and dark current, as of a pixel without a full well, e."""
        return (self.sky_e_per_s + self.dark_e_per_s) * duration_s

    def background_e(self, duration_s: float) -> float:
        """Return the mean number of electrons of a pixel without a star, on the optical axis, e.

        It is that of sky and dark current, cut at the full well.
        """
        return self.cut_at_full_well(self.sky_and_dark_e(duration_s))[0]

    def background_variance_e2(self, duration_s: float) -> float:
        """Return the variance of such a pixel: shot noise, cut at the full well, and read noise, e^2."""
        _, shot_e2 = self.cut_at_full_well(self.sky_and_dark_e(duration_s))
        return shot_e2 + self.read_noise_e**2

    def cut_at_full_well(self, mean_e: float) -> tuple[float, float]:
        """Return mean, e, and variance, e^2, of counts of some mean that are cut at the full well.

        The counts are normal with the variance of Poisson's law.  The variance falls to 0 where the mean passes the
        full well, which is how EMVA 1288 finds the saturation point.
        """
        sigma = sqrt(max(mean_e, 0.0))
        if mean_e + _NEVER_REACHED_SIGMA * sigma <= self.full_well_e:
            return mean_e, mean_e
        room = (self.full_well_e - mean_e) / sigma
        above, density = erfc(room / sqrt(2)) / 2, exp(-0.5 * room * room) / sqrt(2 * pi)
        cut = density - room * above  # the mean of what is cut off, in sigma, and its mean square
        cut_squared = (1 + room * room) * above - room * density
        return mean_e - sigma * cut, max(mean_e * (1 + room * room - cut_squared - (room + cut) ** 2), 0.0)

    def variance_e2(self, mean_e: ArrayLike) -> Float:
        """Return the variance of pixels with some mean numbers of electrons: shot noise and read noise, (...) e^2.

        The 1/12 DN^2 of rounding is not in it.  EMVA 1288, eq. (9): the variance of a Poisson count is its mean.
        """
        return np.asarray(mean_e, dtype=np.float64) + self.read_noise_e**2

    def pixel_electrons(self, pixel_dn: float) -> tuple[float, float]:
        """Return the electrons of a pixel above the black level, and their signal-to-noise ratio.

        Noise can make the electrons negative; the ratio, over shot noise and read noise, is then 0.
        """
        electrons = (pixel_dn - self.black_level_dn) / self.dn_per_e
        counted = max(electrons, 0.0)
        variance_e2 = float(self.variance_e2(counted))
        return electrons, counted / variance_e2**0.5 if variance_e2 > 0 else 0.0

    def signal_to_noise(self, flux_e: ArrayLike, area_px2: ArrayLike, duration_s: float) -> Float:
        """Return the signal-to-noise ratio of stars, (...), measured with the weights of their own profile.

        `flux_e` (...) are the electrons of each star on all its pixels together, and `area_px2` (...) its
        noise-equivalent area: 1 over the sum of its squared profile, 4 pi sigma^2 at rest.  Saturation and the rounding
        to DN are not in it.  Merline & Howell 1995, Exp. Astron. 6, 163, eq. (1), with the noise-equivalent area of
        King 1983 for the number of pixels.
        """
        flux = np.asarray(flux_e, dtype=np.float64)
        background_e2 = self.background_variance_e2(duration_s)
        noise_e2 = flux + np.asarray(area_px2) * background_e2
        return np.asarray(flux / np.sqrt(np.maximum(noise_e2, np.finfo(np.float64).tiny)))

    def with_scale(self, scale: float) -> Self:
        """Return the model with digital numbers `scale` times as large, for another bit depth."""
        return replace(self, gain_dn_per_e=self.gain_dn_per_e * scale, black_level_dn=self.black_level_dn * scale)

    def leaves_same_signal(self, other: "ElectronModel") -> bool:
        """Return whether stars leave the same noiseless signal on another sensor."""
        return (self.vmag_0_e_per_s, self.dn_per_e) == (other.vmag_0_e_per_s, other.dn_per_e)


def _require_positive(owner: object, keys: Iterable[str]) -> None:
    for key in keys:
        value = getattr(owner, key)
        if not (isfinite(value) and value > 0):
            raise ConfigError(f"must be a positive number, not {value}", key=f"sensor.{key}")


def _require_not_negative(owner: object, keys: Iterable[str], allowed: str) -> None:
    for key in keys:
        value = getattr(owner, key)
        if not (isfinite(value) and value >= 0):
            raise ConfigError(f"must be {allowed}, not {value}", key=f"sensor.{key}")


# Shot noise never reaches this number of standard deviations.
_NEVER_REACHED_SIGMA = 9.0
# A pixel at the full well reads less than this number of standard deviations of the read noise below it.
_FULL_READ_SIGMA = 5.0

PixelModel = Literal["integrated", "sampled"]
EffectValue = float | int | bool | str
NoiseModel = Literal["paper", "electrons"]

# Radius of the largest sprite of wings and halos, px: all drivers draw points of 255 px.
_LARGEST_PX = 110.0
# `Sensor.widest_sigma_px` times this contains every star, offsets included.
_WIDEST_IN_SIGMA = 8.0
# Variance of a square pixel of side 1, px^2: a pixel integrates over its area.
PIXEL_VARIANCE_PX2 = 1 / 12
# From this sigma, a Gaussian widened by the pixel's variance replaces the integral over it: at most 0.09 % of the
# flux is in another pixel (0.45 % at 0.7 px, 0.12 % at 1 px).
MIN_WIDENED_SIGMA_PX = 1.1
# Below it, three Gaussians along each side of a pixel have its moments up to the sixth order: their places, their
# weights, and the variance that each adds to that of the point spread function (pixel_kernel.glsl).
PIXEL_PLACES_PX = (-0.3458319986644865, 0.0, 0.3458319986644865)
PIXEL_WEIGHTS = (0.31890297, 0.36219406, 0.31890297)
PIXEL_PART_VARIANCE_PX2 = 0.00705189


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
        _require_positive(self, ("reference_peak_dn", "reference_exposure_s", "psf_sigma_px"))
        _require_not_negative(self, ("sky_mean_dn", "sky_std_dn"), "a number of DN, 0 or more")
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
        narrow = min(
            self.point_spread.components(self.psf_sigma_px, scale=scale), key=lambda component: component.sigma_px
        )
        return self if self.point_spread.is_gaussian else self.of_component(narrow)

    @property
    def widest_sigma_px(self) -> float:
        """Largest `effective_sigma_px` of the Gaussians of a star anywhere on the image, with their offsets, px."""
        if self.point_spread.is_gaussian:
            return self.effective_sigma_px
        return max(
            hypot(*component.offset_px) / _WIDEST_IN_SIGMA + self.of_component(component).effective_sigma_px
            for component in self._widest_components
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
            effects={key: value for key, value in self.effects.items() if key not in pointspread.PSF_KEYS},
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
        """Ratio of the amplitudes of a star in the image and of the point spread function; the flux is the same."""
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

    @property
    def full_dn(self) -> int:
        """The digital number from which a pixel counts as saturated, DN.

        The lower one of the limits of the converter and of the full well, less five times the read noise.
        """
        if self.electrons is None:
            return self.saturation_dn
        model = self.electrons
        least_e = max(model.full_well_e - _FULL_READ_SIGMA * model.read_noise_e, 0.5 * model.full_well_e)
        return min(self.saturation_dn, int(model.black_level_dn + model.dn_per_e * least_e))

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
        return float(model.dn_per_e * np.sqrt(model.background_variance_e2(duration_s)))

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
        return pointspread.gaussian_radius_px(self.effective_sigma_px, peak_dn, reduction, renormalized=renormalized)

    def _widest_truncation_px(self, peak_dn: ArrayLike, min_trail_px: ArrayLike, *, renormalized: bool) -> Float:
        """Return the largest of the truncation radii of the Gaussians of stars anywhere on the image, px."""
        peak = np.asarray(peak_dn, dtype=np.float64)
        largest = np.zeros(())
        for component in self._widest_components:
            gaussian = self.of_component(component)
            of_peak = gaussian.reference_peak_dn / self.reference_peak_dn
            radius_px = gaussian.component_radius_px(of_peak * peak, min_trail_px, renormalized=renormalized)
            largest = np.maximum(largest, hypot(*component.offset_px) + radius_px)
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
        radius_px = pointspread.gaussian_radius_px(
            sigma_px, peak_dn, reduction, renormalized=renormalized, faintest_dn=pointspread.FAINTEST_COMPONENT_DN
        )
        return np.minimum(radius_px, max(_LARGEST_PX, pointspread.PLAIN.min_sigma * sigma_px))

    def leaves_same_signal(self, other: "Sensor", light_keys: Collection[str] | None = None) -> bool:
        """Return whether stars leave the same noiseless signal on another sensor.

        Parameters
        ----------
        other : Sensor
            Its sky, noise, bit depth and effects may differ.
        light_keys : collection of str, optional
            Dotted keys of the effects that change the signal of stars: see `glstar.render.effects.light_keys`.
            Default: all.

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
        keys = self.effects.keys() | other.effects.keys() if light_keys is None else light_keys
        return equalised == other and all(self.effects.get(key) == other.effects.get(key) for key in keys)

    def with_bit_depth(self, bit_depth: int, scaled_keys: Collection[str]) -> Self:
        """Return the sensor with another bit depth; all brightnesses keep their fraction of full scale.

        Parameters
        ----------
        bit_depth : int
            Bits, 1 to 16.
        scaled_keys : collection of str
            Dotted keys of the effects whose values are in DN: see `glstar.render.effects.scaled_keys`.

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
                key: value * scale if key in scaled_keys and not isinstance(value, str) else value
                for key, value in self.effects.items()
            },
        )


def _trail_sigma_px(sensor: Sensor) -> float:
    """Mean width of a star's Gaussians, weighted with their amplitudes: it decides the peak of a trail."""
    psf = sensor.point_spread
    if psf.is_gaussian:
        return sensor.effective_sigma_px
    gaussians = [sensor.of_component(component) for component in psf.circular(sensor.psf_sigma_px)]
    peaks = np.array([gaussian.reference_peak_dn for gaussian in gaussians])
    widths_px = np.array([gaussian.effective_sigma_px for gaussian in gaussians])
    longest = psf.scale_range[1] / np.sqrt(1 - psf.psf_ellipticity)
    return float(longest * peaks @ widths_px / peaks.sum())


def _have_same_gain(one: ElectronModel | None, other: ElectronModel | None) -> bool:
    """Return whether a star leaves the same signal with two electron models, or with none."""
    return one is other if one is None or other is None else one.leaves_same_signal(other)


# Signal-to-noise ratio at which a star is taken as detected.
LIMITING_SNR = 5.0
# Variance of rounding to whole numbers, DN^2.
_QUANTISATION_VARIANCE_DN2 = 1 / 12


def noise_equivalent_area_px2(sensor: Sensor) -> float:
    """Return the noise-equivalent area of a star that does not move, on the optical axis, px^2.

    It is 1 over the integral of the squared profile: 4 pi sigma^2 for a Gaussian.  King 1983, PASP 95, 163.  Two
    Gaussians of the variances s and t at the distance d overlap by exp(-d^2 / 2 (s + t)) / 2 pi (s + t).
    """
    parts = [
        (component.flux_fraction, sensor.of_component(component).effective_sigma_px ** 2, component.offset_px)
        for component in sensor.point_spread.components(sensor.psf_sigma_px)
    ]
    squared = 0.0
    for fraction, variance_px2, (x_px, y_px) in parts:
        for other_fraction, other_px2, (other_x_px, other_y_px) in parts:
            both_px2 = variance_px2 + other_px2
            separation_px2 = (x_px - other_x_px) ** 2 + (y_px - other_y_px) ** 2
            squared += fraction * other_fraction * exp(-separation_px2 / (2 * both_px2)) / (2 * pi * both_px2)
    return 1 / squared


def limiting_mag(sensor: Sensor, duration_s: float, area_px2: float, *, sky_dn: float = 0.0, frames: int = 1) -> float:
    """Return the magnitude of a star that a matched filter finds with a signal-to-noise ratio of 5.

    It is in the camera's band, as it reaches the lens, on the optical axis; NaN if the background saturates.  Valid for
    both noise models; row noise, fixed patterns, a colour mosaic and processing in the camera are not in it.

    `duration_s` is the exposure time, of each short exposure of a stack; `area_px2` the noise-equivalent area of the
    star or of its trail.  `sky_dn` is the signal per pixel of a sky that the sensor's own background does not have,
    with shot noise in electrons.  `frames` is the number of short exposures in the image, whose ratio is sqrt(frames)
    times the ratio of one.

    Merline & Howell 1995, Exp. Astron. 6, 163, eq. (1), solved for the flux F: F^2 = SNR^2 (K F + A v), with K DN per
    electron (0 in the paper's noise model), the noise-equivalent area A, and the variance v of a pixel without a star.
    """
    model = sensor.electrons
    dn_per_e = 0.0 if model is None else model.dn_per_e
    is_full = model is not None and model.sky_and_dark_e(duration_s) + sky_dn / dn_per_e >= model.full_well_e
    if is_full or sensor.background_mean_dn(duration_s) + sky_dn >= sensor.saturation_dn:
        return nan
    variance_dn2 = sensor.background_std_dn(duration_s) ** 2 + dn_per_e * sky_dn + _QUANTISATION_VARIANCE_DN2
    squared_snr = LIMITING_SNR**2 / frames
    shot_dn = squared_snr * dn_per_e
    flux_dn = (shot_dn + sqrt(shot_dn**2 + 4 * squared_snr * area_px2 * variance_dn2)) / 2
    return -2.5 * log10(flux_dn / float(sensor.flux_of_magnitude_dn(0.0, duration_s)))
