"""Point spread functions as sums of Gaussians, so that trails keep their closed form, and where they are truncated."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import cos, degrees, log, pi, radians, sin, sqrt
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import ConfigError
from glstar.sky.photometry import USUAL_BV, VALID_BV

Profile = Literal["gaussian", "moffat"]

# Full width at half maximum of a Gaussian of sigma 1.
_FWHM_PER_SIGMA = 2 * sqrt(2 * log(2))
# Nodes of the mixture of a Moffat profile: exponent beta, number, step and largest value of ln(alpha^2 / 2 sigma^2).
# Chosen by a search for the smallest error of encircled energy and profile: 0.44 % of both at beta 2, 0.33 % at 2.5,
# 0.17 % at 3, 0.1 % at 3.5 and less above.
_FIVE_NODES = ((2.0, 1.25, 1.0), (2.5, 1.0, 1.4))
_FOUR_NODES = (
    (2.5, 1.15, 1.2),
    (3.0, 1.0, 1.5),
    (3.5, 0.9, 1.7),
    (4.0, 0.8, 1.8),
    (5.0, 0.7, 2.0),
    (6.0, 0.65, 2.2),
    (8.0, 0.55, 2.5),
    (12.0, 0.45, 2.9),
    (20.0, 0.35, 3.3),
)
# Radii at which the mixture is fitted, in units of alpha.
_FIT_RADII = np.concatenate([np.linspace(0, 3, 60), np.geomspace(3.1, 80, 80)])
# Weight of the condition that the fluxes of the mixture add up to 1.
_UNIT_FLUX_WEIGHT = 1e3
# Sigmas of the halo's Gaussians differ by this factor: their sum falls as 1 / r^2 within 4 %.
_HALO_RATIO = 2.0
# Gaussians along the major axis of an elliptical star (Gauss-Hermite nodes) for axis ratios down to these.
_HERMITE_NODES = ((0.9, 3), (0.8, 5), (0.7, 7), (0.6, 9))
# Stars are not narrower than this fraction of the width on the axis.
_NARROWEST = 0.2


@dataclass(frozen=True, slots=True)
class PsfComponent:
    """One circular Gaussian of a point spread function."""

    flux_fraction: float  # Its part of the star's flux
    sigma_px: float  # Standard deviation, px
    offset_px: tuple[float, float] = (0.0, 0.0)  # Its centre minus the star's (x, y), px


@dataclass(frozen=True, slots=True)
class PointSpread:
    """Shape of a star beyond the Gaussian core: profile, wings, halo, ellipticity, and how its width varies.

    Raises ConfigError if a value is not valid; `key` names it.  Moffat 1969, *A&A* 3, 455.
    """

    # {"gaussian", "moffat"}: the core's profile; its full width at half maximum is that of a Gaussian of
    # ``psf_sigma_px``.
    psf: Profile = "gaussian"
    psf_beta: float = 3.0  # Exponent of the Moffat profile, 2 to 20: the smaller, the wider its wings
    psf_wing_fraction: float = 0.0  # Fraction of the flux in the wings, a second Gaussian
    psf_wing_sigma_px: float = 4.0  # Standard deviation of the wings, px
    psf_halo_fraction: float = 0.0  # Fraction of the flux in a halo whose surface brightness falls as 1 / r^2
    psf_halo_radius_px: float = 20.0  # Where the halo ends, px: the standard deviation of its widest Gaussian
    # Increase of the core's width from the centre of the image to a corner, as a fraction; it is proportional to the
    # square of the distance from the principal point.
    psf_growth: float = 0.0
    # 1 minus the ratio of the axes of an elliptical core, 0 to 0.4; the area stays the same.
    psf_ellipticity: float = 0.0
    psf_angle_rad: float = 0.0  # Direction of the major axis, from the image's x axis towards its y axis, rad
    # Increase of the core's width from the principal point to half the diagonal in one direction, as a fraction, and
    # decrease in the opposite direction: a sensor that is tilted against the focal surface.
    psf_tilt: float = 0.0
    # Direction in which stars are wider, from the image's x axis towards its y axis, rad.
    psf_tilt_angle_rad: float = 0.0
    # Increase of the core's width per magnitude of B - V above 0.65, as a fraction: colours have different foci.
    psf_colour_growth: float = 0.0

    def __post_init__(self) -> None:
        if self.psf not in get_args(Profile):
            raise ConfigError(f"must be 'gaussian' or 'moffat', not {self.psf!r}", key="sensor.psf")
        limits = {
            "psf_beta": (2.0, 20.0),
            "psf_wing_fraction": (0.0, 0.9),
            "psf_wing_sigma_px": (0.1, 40.0),
            "psf_halo_fraction": (0.0, 0.5),
            "psf_halo_radius_px": (1.0, 40.0),
            "psf_growth": (0.0, 4.0),
            "psf_ellipticity": (0.0, 0.4),
            "psf_angle_rad": (-2 * pi, 2 * pi),
            "psf_tilt": (0.0, 0.9),
            "psf_tilt_angle_rad": (-2 * pi, 2 * pi),
            "psf_colour_growth": (-0.5, 0.5),
        }
        for key, (low, high) in limits.items():
            if not low <= getattr(self, key) <= high:
                raise ConfigError(
                    f"must lie between {low:g} and {high:g}, not {getattr(self, key)}", key=f"sensor.{key}"
                )

    @classmethod
    def of(cls, effects: Mapping[str, object]) -> "PointSpread":
        """Return the point spread function of a sensor's keys, given `Sensor.effects`; others have their defaults."""
        return _of_values(tuple(map(effects.get, PSF_KEYS)))

    @classmethod
    def of_keys(cls, keys: Mapping[str, object]) -> "PointSpread":
        """Return the point spread function of some keys of ``[sensor]``, given without the section."""
        return _of_values(tuple(map(keys.get, _KEYS.values())))

    @property
    def is_gaussian(self) -> bool:
        """Whether all stars are the same circular Gaussian."""
        return (
            self.psf == "gaussian"
            and not self.psf_wing_fraction
            and not self.psf_halo_fraction
            and not self.psf_ellipticity
            and not self.varies
        )

    @property
    def varies(self) -> bool:
        """Whether the width of the core depends on a star's position or colour."""
        return bool(self.psf_growth or self.psf_tilt or self.psf_colour_growth)

    def circular(self, sigma_px: float) -> tuple[PsfComponent, ...]:
        """Return the Gaussians of a circular star on the optical axis, whose flux fractions add up to 1.

        `sigma_px` is ``psf_sigma_px``: of the core, or of the Gaussian of equal width at half maximum.
        """
        core, outer = _circular(self, sigma_px)
        return core + outer

    def components(self, sigma_px: float, *, scale: float = 1.0) -> tuple[PsfComponent, ...]:
        """Return the Gaussians of a star at whose position `scale_at` is `scale`.

        Wings and halo stay as they are; an elliptical Gaussian is a row of circular ones along its major axis
        (Gauss-Hermite quadrature).
        """
        ratio = 1 - self.psf_ellipticity
        nodes, weights = _hermite(ratio)
        along = cos(self.psf_angle_rad), sin(self.psf_angle_rad)
        row = []
        core, outer = _circular(self, sigma_px)
        for gaussian in core:
            width_px = scale * gaussian.sigma_px
            step_px = width_px * sqrt(1 / ratio - ratio)
            for node, weight in zip(nodes, weights, strict=True):
                offset_px = (node * step_px * along[0], node * step_px * along[1])
                row.append(PsfComponent(gaussian.flux_fraction * weight, width_px * sqrt(ratio), offset_px))
        return (*row, *outer)

    def flux_per_peak_px2(self, sigma_px: float) -> float:
        """Return the flux of a star on the axis over the amplitude of its point spread function, px^2."""
        if self.is_gaussian:
            return 2 * np.pi * sigma_px**2
        return float(1 / sum(one.flux_fraction / (2 * np.pi * one.sigma_px**2) for one in self.circular(sigma_px)))

    def scale_at(self, offset: ArrayLike, bv: ArrayLike = USUAL_BV) -> Float:
        """Return the widths of the core over ``psf_sigma_px``, (...): 1 on the axis for a star of B - V 0.65.

        `offset` (..., 2) is the position (x, y) minus the principal point, over half the diagonal of the image; `bv`
        (...) is used from -0.3 to 1.7.
        """
        x, y = np.moveaxis(np.asarray(offset, dtype=np.float64), -1, 0)
        towards = x * cos(self.psf_tilt_angle_rad) + y * sin(self.psf_tilt_angle_rad)
        redder = np.clip(np.asarray(bv, dtype=np.float64), *VALID_BV) - USUAL_BV
        scale = 1 + self.psf_growth * (x * x + y * y) + self.psf_tilt * towards + self.psf_colour_growth * redder
        return np.asarray(np.maximum(scale, _NARROWEST))

    @property
    def scale_range(self) -> tuple[float, float]:
        """Bounds of `scale_at` on the image."""
        of_colour = [self.psf_colour_growth * (bv - USUAL_BV) for bv in VALID_BV]
        return (
            max(1 - self.psf_tilt + min(of_colour), _NARROWEST),
            1 + self.psf_growth + self.psf_tilt + max(of_colour),
        )

    def widest(self, sigma_px: float) -> tuple[str, float, float]:
        """Return the key of ``[sensor]`` that makes stars widest, its value, and the width of that Gaussian, px."""
        core, _ = _circular(self, sigma_px)
        core_px = self.scale_range[1] * max(one.sigma_px for one in core)
        widths = [("psf_sigma_px", sigma_px, core_px)]
        if self.psf_wing_fraction:
            widths.append(("psf_wing_sigma_px", self.psf_wing_sigma_px, self.psf_wing_sigma_px))
        if self.psf_halo_fraction:
            widths.append(("psf_halo_radius_px", self.psf_halo_radius_px, self.psf_halo_radius_px))
        return max(widths, key=lambda one: one[2])

    @property
    def keys(self) -> dict[str, float | str]:
        """The keys of ``[sensor]`` that differ from a plain Gaussian."""
        changed = {name: value for name in _KEYS if (value := getattr(self, name)) != getattr(_GAUSSIAN, name)}
        return {_KEYS[name]: degrees(value) if name in _ANGLES else value for name, value in changed.items()}


_GAUSSIAN = PointSpread()
# The keys of ``[sensor]`` by attribute; angles are in degrees there.
_ANGLES = {"psf_angle_rad": "psf_angle_deg", "psf_tilt_angle_rad": "psf_tilt_angle_deg"}
_KEYS = {name: _ANGLES.get(name, name) for name in PointSpread.__slots__}
# The same as `Sensor.effects` has them.
PSF_KEYS = tuple(f"sensor.{key}" for key in _KEYS.values())


@lru_cache(maxsize=64)
def _of_values(values: tuple[Any, ...]) -> PointSpread:
    keys: dict[str, Any] = {name: value for name, value in zip(_KEYS, values, strict=True) if value is not None}
    keys |= {name: radians(keys[name]) for name in _ANGLES if name in keys}
    return PointSpread(**keys)


@lru_cache(maxsize=64)
def _circular(psf: PointSpread, sigma_px: float) -> tuple[tuple[PsfComponent, ...], tuple[PsfComponent, ...]]:
    """Return the Gaussians of the core, and of wings and halo."""
    core: tuple[tuple[float, float], ...] = ((1.0, sigma_px),)
    if psf.psf == "moffat":
        alpha_px = _FWHM_PER_SIGMA * sigma_px / (2 * sqrt(2 ** (1 / psf.psf_beta) - 1))
        core = tuple((flux, alpha_px * sigma) for flux, sigma in moffat_mixture(psf.psf_beta))
    in_core = 1 - psf.psf_wing_fraction - psf.psf_halo_fraction
    if in_core <= 0:
        raise ConfigError(
            f"leaves {in_core:g} of the flux to the core, with psf_wing_fraction {psf.psf_wing_fraction:g}; their sum"
            " must be below 1",
            key="sensor.psf_halo_fraction",
        )
    outer = []
    if psf.psf_wing_fraction:
        outer.append(PsfComponent(psf.psf_wing_fraction, psf.psf_wing_sigma_px))
    if psf.psf_halo_fraction:
        count = 1 + max(0, int(log(psf.psf_halo_radius_px / (2 * sigma_px)) / log(_HALO_RATIO)))
        outer += [
            PsfComponent(psf.psf_halo_fraction / count, psf.psf_halo_radius_px / _HALO_RATIO**k) for k in range(count)
        ]
    return tuple(PsfComponent(in_core * flux, sigma) for flux, sigma in core), tuple(outer)


@lru_cache(maxsize=64)
def _hermite(ratio: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return nodes and weights that replace a normal distribution along the major axis; one node for a circle."""
    if ratio == 1:
        return (0.0,), (1.0,)
    count = next(count for smallest, count in _HERMITE_NODES if ratio >= smallest - 1e-12)
    nodes, weights = np.polynomial.hermite_e.hermegauss(count)
    return tuple(nodes.tolist()), tuple((weights / weights.sum()).tolist())


@lru_cache(maxsize=64)
def moffat_mixture(beta: float) -> tuple[tuple[float, float], ...]:
    """Return the Gaussians that approximate a Moffat profile (1 + r^2 / alpha^2)^-beta of alpha 1, for beta 2 to 20.

    Each is a flux fraction and a standard deviation, in units of alpha.  A Moffat profile is exactly a mixture of
    Gaussians whose 1 / (2 sigma^2) has a gamma distribution of shape beta - 1.  Here a few sigmas at equal ratios have
    the fluxes that fit encircled energy and profile best, by least squares.
    """
    nodes, count = (_FIVE_NODES, 5) if beta < _FOUR_NODES[0][0] else (_FOUR_NODES, 4)
    betas, steps, largest = np.transpose(nodes)
    rate = np.exp(np.interp(beta, betas, largest) - np.interp(beta, betas, steps) * np.arange(count))
    outside = np.exp(-np.outer(_FIT_RADII**2, rate))
    squared = 1 + _FIT_RADII**2
    design = np.vstack([1 - outside, outside * rate / (beta - 1), np.full((1, count), _UNIT_FLUX_WEIGHT)])
    profile = np.concatenate([1 - squared ** (1 - beta), squared**-beta, [_UNIT_FLUX_WEIGHT]])
    flux, *_ = np.linalg.lstsq(design, profile, rcond=None)
    flux /= flux.sum()
    return tuple(zip(flux.tolist(), np.sqrt(0.5 / rate).tolist(), strict=True))


# The point spread function of a star is truncated where its signal over the whole exposure falls below this, DN.
TRUNCATION_DN = 0.02
# A Gaussian of several is drawn where it is at least this, DN: a tenth of what is cut off a single Gaussian.
FAINTEST_COMPONENT_DN = 0.1 * TRUNCATION_DN


@dataclass(frozen=True, slots=True)
class Truncation:
    """Limits of the radius at which a star's point spread function is truncated, besides `TRUNCATION_DN`."""

    peak_fraction: float  # The signal at the radius, over the peak, is at most this
    min_sigma: float  # Smallest radius, sigma
    min_px: float = 0.0  # Smallest radius, px


# Flux outside the radius is lost: 1e-3 of it at 3.5 sigma.
PLAIN = Truncation(peak_fraction=1e-4, min_sigma=3.5)
# Flux outside the radius is added to the rest.  Below 1.2 px, the sum over the pixels of a narrow trail would depend on
# its position between pixel centres.
RENORMALIZED = Truncation(peak_fraction=1e-3, min_sigma=1.5, min_px=1.2)


def gaussian_radius_px(
    sigma_px: float, peak_dn: ArrayLike, reduction: Float, *, renormalized: bool, faintest_dn: float = 0.0
) -> Float:
    """Return the radius at which Gaussians are truncated, (...) px.

    `peak_dn` (...) are the amplitudes of stars that do not move, DN, and `reduction` (...) the factor by which motion
    reduces them.  `renormalized` adds the flux outside the radius to the rest.  Signals below `faintest_dn` do not
    matter, however faint the star is.
    """
    limits = RENORMALIZED if renormalized else PLAIN
    peak = np.asarray(peak_dn, dtype=np.float64)
    max_contrast = 1 / limits.peak_fraction
    of_peak = np.minimum(max_contrast, peak / faintest_dn) if faintest_dn else max_contrast
    contrast = np.maximum(peak / TRUNCATION_DN, of_peak) / reduction
    radius_sigma = np.sqrt(2 * np.log(np.maximum(contrast, 1.0)))
    return np.asarray(np.maximum(sigma_px * radius_sigma, max(limits.min_sigma * sigma_px, limits.min_px)))
