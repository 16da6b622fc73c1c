"""Effects in a photograph that the sensor model lacks: PSF wings, vignetting, a sky gradient, correlated noise."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.calibrate.notes import Note, NoteKind
from glstar.calibrate.photo.detection import SkyLevel
from glstar.camera.sensor.sensor import Sensor


@dataclass(frozen=True, slots=True)
class _Relevance:
    """Effects are reported if they exceed these limits."""

    # In standard errors.
    significance: float = 4.0
    # Flux beyond the Gaussian's, over the Gaussian's.
    wing_fraction: float = 0.03
    # Flux lost in the corner.
    vignetting_fraction: float = 0.10
    # Long over short axis of the stars, and relative change of the PSF's width to the corner.
    axis_ratio: float = 1.08
    growth_fraction: float = 0.08
    # A sky gradient matters beyond both: DN across the image, and multiples of the sky noise.
    gradient_dn: float = 5.0
    gradient_noise: float = 0.5
    # Correlation of the noise of neighbouring pixels; faint undetected stars cause a few hundredths.
    correlation: float = 0.15
    # Ratio of the noise's standard deviations between the pixels of the 2 x 2 lattice.
    lattice_ratio: float = 1.10


_RELEVANCE = _Relevance()
_LEAST_LOSS_MAG = -2.5 * float(np.log10(1 - _RELEVANCE.vignetting_fraction))
# Wings begin at this radius, in sigma as the pixels record it; and the flux of a Gaussian beyond it, over its flux.
WING_RADIUS_SIGMA = 3.0
_GAUSSIAN_WING = float(np.exp(-(WING_RADIUS_SIGMA**2) / 2))


@dataclass(frozen=True, slots=True)
class Measurement:
    """A measured number."""

    value: float  # In the same unit
    standard_error: float

    def exceeds(self, limit: float) -> bool:
        """Return whether it differs from 0 significantly, and by more than a limit in the same unit."""
        return abs(self.value) > max(_RELEVANCE.significance * self.standard_error, limit)


@dataclass(frozen=True, slots=True, eq=False)
class RadialProfile:
    """The median profile of the bright stars, each divided by its amplitude."""

    radius_sigma: Float  # (k,) distance from the centre over the standard deviation that the pixels record
    brightness: Float  # (k,) over the amplitude that the pixels record: 1 at the centre of a Gaussian star


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """Differences of a photograph from the sensor model; None if there are too few stars or pixels."""

    # Flux between 3 and 8 sigma beyond that of the fitted Gaussian, over the flux of the Gaussian.
    wing_fraction: Measurement | None
    stacked: RadialProfile | None
    corner_loss_mag: Measurement | None  # Loss of stars in the farthest corner against the axis, magnitudes
    mean_loss_mag: float  # The same for the mean of the stars in the brightness fit
    # (3, 4) median brightness residual in parts of the image, positive for faint stars; NaN where no star is.
    brightness_map_mag: Float
    gradient_dn: Measurement  # Change of the background from one side or corner of the image to the other, DN
    gradient_towards_rad: float  # Direction in which the sky brightens, rad from the right, clockwise
    # Standard deviation of the background without that gradient, and without a centred paraboloid too, DN.
    rest_dn: float
    rest_without_bowl_dn: float
    ellipticity: Measurement | None  # (a^2 - b^2) / (a^2 + b^2) of the axes a, b of the mean star
    long_axis_rad: float  # Direction of its long axis, rad from the horizontal, clockwise, 0 to pi
    corner_growth: Measurement | None  # Relative growth of the PSF's width from the axis to the farthest corner
    neighbour_correlation: Measurement | None  # Correlation of the noise of neighbouring pixels
    # Largest over smallest standard deviation of the noise on the 2 x 2 lattice, minus 1.
    lattice_excess: Measurement | None

    @property
    def axis_ratio(self) -> float:
        """Long axis over short axis of the mean star; NaN where it is unknown."""
        if self.ellipticity is None:
            return float("nan")
        e = min(self.ellipticity.value, 0.99)
        return float(np.sqrt((1 + e) / (1 - e)))

    def has_gradient(self, noise_dn: float) -> bool:
        """Return whether the sky has a relevant gradient, given its noise (DN)."""
        return self.gradient_dn.exceeds(max(_RELEVANCE.gradient_dn, _RELEVANCE.gradient_noise * noise_dn))

    @property
    def has_vignetting(self) -> bool:
        """Whether stars lose flux towards the corners, significantly and by a relevant amount."""
        loss = self.corner_loss_mag
        return loss is not None and loss.value > 0 and loss.exceeds(_LEAST_LOSS_MAG)

    def unexplained_unevenness(self, sky: SkyLevel) -> tuple[float, str]:
        """Return the unevenness of the sky beyond effects with notes of their own, rms DN, and a label."""
        if self.has_vignetting:
            return self.rest_without_bowl_dn, "besides a gradient and the vignetting"
        if self.has_gradient(sky.std_dn):
            return self.rest_dn, "besides its gradient"
        return sky.unevenness_dn, "over the image"

    def notes(self, sensor: Sensor, *, linear: bool = True) -> tuple[Note, ...]:
        """Return notes for the user, one for each significant and relevant effect.

        `linear`: whether pixel values are proportional to the light; otherwise the response distorts the profiles of
        stars, and neither wings nor a change of width are reported.
        """
        texts = {
            NoteKind.WINGS: self._wings() if linear else "",
            NoteKind.CORNER_WIDTH: self._growth() if linear else "",
            NoteKind.VIGNETTING: self._vignetting(),
            NoteKind.BRIGHT_CORNERS: self._bright_corners(),
            NoteKind.GRADIENT: self._gradient(sensor),
            NoteKind.ELLIPSE: self._ellipse(),
            NoteKind.PROCESSING: self._processing(),
        }
        return tuple(Note(kind, text) for kind, text in texts.items() if text)

    def _wings(self) -> str:
        if (
            self.wing_fraction is None
            or self.wing_fraction.value < 0
            or not self.wing_fraction.exceeds(_RELEVANCE.wing_fraction)
        ):
            return ""
        extra = self.wing_fraction.value
        lost = 100 * extra / (1 + extra)
        beyond = lost + 100 * _GAUSSIAN_WING / (1 + extra)
        return (
            f"the stars have wings: {beyond:.0f} % of their flux lies beyond 3 sigma, where a Gaussian has"
            f" {100 * _GAUSSIAN_WING:.1f} %: sigma is too wide for their cores, and simulated stars lack"
            f" {lost:.0f} % of the flux ({2.5 * np.log10(1 + extra):.2f} mag); focus, and keep the lens clear of dew"
            " and haze"
        )

    def _vignetting(self) -> str:
        loss = self.corner_loss_mag
        if loss is None or not self.has_vignetting:
            return ""
        corner = 100 * (1 - 10 ** (-0.4 * loss.value))
        return (
            f"the corners are {corner:.0f} % darker than the centre ({loss.value:.2f} ± {loss.standard_error:.2f} mag:"
            f" vignetting): the reference peak is {self.mean_loss_mag:.2f} mag too faint for the centre, and too bright"
            " for the corners; stop the lens down, or divide the image by a flat field"
        )

    def _bright_corners(self) -> str:
        loss = self.corner_loss_mag
        if loss is None or self.has_vignetting or not loss.exceeds(_LEAST_LOSS_MAG):
            return ""
        return (
            f"stars in the corner are {-loss.value:.2f} ± {loss.standard_error:.2f} mag brighter than on the axis:"
            f" the reference peak is {abs(self.mean_loss_mag):.2f} mag too bright for the centre; look for haze in"
            " the middle of the image, or a correction of vignetting that is too strong"
        )

    def _gradient(self, sensor: Sensor) -> str:
        if not self.has_gradient(sensor.sky_std_dn):
            return ""
        return (
            f"the sky has a gradient: it brightens by {self.gradient_dn.value:.0f} DN across the image, towards the"
            f" {_direction(self.gradient_towards_rad)}, with a noise of {sensor.sky_std_dn:.1f} DN; the model has"
            f" one level, {sensor.sky_mean_dn:.0f} DN; take images away from the Moon, twilight and lights"
        )

    def _ellipse(self) -> str:
        if self.ellipticity is None or not self.ellipticity.exceeds(0.0) or self.axis_ratio < _RELEVANCE.axis_ratio:
            return ""
        return (
            f"the stars are elliptical: {self.axis_ratio:.2f} times as long as wide,"
            f" {np.rad2deg(self.long_axis_rad):.0f} deg"
            " clockwise from the horizontal: sigma is the mean of the two axes, and simulated stars are round; hold the"
            " camera still, focus, and check the lens for astigmatism"
        )

    def _growth(self) -> str:
        growth = self.corner_growth
        if growth is None or not growth.exceeds(_RELEVANCE.growth_fraction):
            return ""
        kind = "wider" if growth.value > 0 else "narrower"
        return (
            f"the stars in the corner are {100 * abs(growth.value):.0f} ± {100 * growth.standard_error:.0f} % {kind}"
            " than on the axis: sigma is that of the typical star, and all simulated stars have it; focus"
            " between centre and corner, or stop the lens down"
        )

    def _processing(self) -> str:
        correlation, lattice = self.neighbour_correlation, self.lattice_excess
        correlated = correlation is not None and correlation.exceeds(_RELEVANCE.correlation)
        interpolated = lattice is not None and lattice.exceeds(_RELEVANCE.lattice_ratio - 1)
        if not (correlated or interpolated):
            return ""
        effects, causes = [], "demosaicing, noise reduction, scaling or JPEG"
        if correlated and correlation is not None:
            effects.append(f"the noise of neighbouring pixels is correlated ({correlation.value:.2f}; 0 in raw images)")
        if interpolated and lattice is not None:
            causes = "demosaicing: colours interpolated between pixels"
            effects.append(f"the noise differs by {100 * lattice.value:.0f} % between the pixels of a 2 x 2 lattice")
        return (
            f"{', and '.join(effects)}, as after processing ({causes}): simulated noise is independent from pixel to"
            " pixel, the measured noise is not that of the raw sensor, and sigma includes the smoothing; take raw"
            " images of one colour"
        )

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON-serialisable values; None where unknown."""

        def number(estimate: Measurement | None) -> dict[str, float] | None:
            if estimate is None:
                return None
            return {"value": estimate.value, "standard_error": estimate.standard_error}

        has_shape = self.ellipticity is not None
        return {
            "wing_fraction_beyond_gaussian": number(self.wing_fraction),
            "corner_loss_mag": number(self.corner_loss_mag),
            "brightness_residual_map_mag": [
                [None if np.isnan(off) else float(off) for off in row] for row in self.brightness_map_mag
            ],
            "sky_gradient_dn": number(self.gradient_dn),
            "sky_brightens_towards_deg": float(np.rad2deg(self.gradient_towards_rad)),
            "sky_unevenness_without_gradient_dn": self.rest_dn,
            "sky_unevenness_without_gradient_and_bowl_dn": self.rest_without_bowl_dn,
            "psf_ellipticity": number(self.ellipticity),
            "psf_axis_ratio": self.axis_ratio if has_shape else None,
            "psf_long_axis_deg": float(np.rad2deg(self.long_axis_rad)) if has_shape else None,
            "corner_sigma_growth": number(self.corner_growth),
            "noise_neighbour_correlation": number(self.neighbour_correlation),
            "noise_lattice_excess": number(self.lattice_excess),
        }


def _direction(clockwise_rad: float) -> str:
    names = ("right", "lower right", "bottom", "lower left", "left", "upper left", "top", "upper right")
    return names[round(clockwise_rad / (np.pi / 4)) % 8]
