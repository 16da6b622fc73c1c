"""From identified stars to the sensor: brightness, width and sky."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import theilslopes

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.identify import Heavens, Matches
from glstar.calibrate.image import SkyImage
from glstar.calibrate.psf import fit_stars
from glstar.errors import CalibrationError
from glstar.photometry import brightness_ratio, magnitude_difference
from glstar.sensor import Sensor

__all__ = ["LIGHT_DEX_PER_MAG", "BrightnessFit", "Criterion", "MeasuredStars", "fit_brightness", "fit_sensor"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]
Criterion = Literal["median", "paper"]

# By how much light falls a magnitude, decades: eq. (36).
LIGHT_DEX_PER_MAG: Final = -0.4
_STARS_NEEDED: Final = 3
# Stars tell of width and brightness from this many times the noise up.
_BRIGHT_ENOUGH: Final = 10.0
# Stars that should reach this share of the sensor's range are left out: the brighter half of them would burn out.
_DIM_ENOUGH: Final = 0.5
# Another star of the catalogue so near, px and sigma, and no fainter than this by magnitudes, spoils a measurement.
_BLENDED_PX: Final = 2.0
_BLENDED_SIGMA: Final = 4.0
_BLENDED_MAG: Final = 3.5


@dataclass(frozen=True, slots=True, eq=False)
class BrightnessFit:
    """How brightness goes with magnitude.

    Attributes
    ----------
    criterion : {"median", "paper"}
        How the reference was found.
    reference_vmag, reference_peak_dn : float
        Magnitude and amplitude of the reference star, DN: B_r and m_r of eq. (37).
    used : (n,) bool
        Which stars it rests on.
    scatter_mag : float
        Robust standard deviation of the used stars about the fit, magnitudes.
    error_mag : float
        Standard error of the reference's brightness, magnitudes.
    slope_dex_per_mag : float
        How log10 of the amplitude really goes with magnitude (Theil and Sen); -0.4 for a sensor that answers to light
        in proportion.
    slope_low_dex_per_mag, slope_high_dex_per_mag : float
        Between these it lies in 95 of 100 cases.
    """

    criterion: Criterion
    reference_vmag: float
    reference_peak_dn: float
    used: Mask
    scatter_mag: float
    error_mag: float
    slope_dex_per_mag: float
    slope_low_dex_per_mag: float
    slope_high_dex_per_mag: float

    @property
    def linear(self) -> bool:
        """Whether the stars agree with a sensor that answers to light in proportion."""
        return self.slope_low_dex_per_mag <= LIGHT_DEX_PER_MAG <= self.slope_high_dex_per_mag

    def peak_dn(self, vmag: Float) -> Float:
        """Return what eq. (37) gives, (n,) float64, DN."""
        return np.asarray(self.reference_peak_dn * brightness_ratio(vmag - self.reference_vmag))


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStars:
    """Identified stars with what was measured of them, the brightest of the catalogue first.

    Attributes
    ----------
    hr : (n,) int32
    name : tuple of str
    vmag : (n,) float64
    xy_px : (n, 2) float64
        Where they were found.
    residual_px : (n, 2) float64
        Found minus predicted.
    peak_dn : (n,) float64
        Amplitudes above the sky, for the sensor's one width, DN.
    sigma_px : (n,) float64
        The width of each, px.
    noise_dn : (n,) float64
    saturated, blended : (n,) bool
        Whether a pixel is at the sensor's limit; whether another star of the catalogue is too near.
    """

    hr: NDArray[np.int32]
    name: tuple[str, ...]
    vmag: Float
    xy_px: Float
    residual_px: Float
    peak_dn: Float
    sigma_px: Float
    noise_dn: Float
    saturated: Mask
    blended: Mask

    def __len__(self) -> int:
        return len(self.vmag)


def fit_sensor(
    image: SkyImage,
    detected: DetectedStars,
    heavens: Heavens,
    matches: Matches,
    *,
    exposure_s: float,
    criterion: Criterion = "median",
) -> tuple[Sensor, BrightnessFit, MeasuredStars]:
    """Return the sensor that a photograph shows.

    Parameters
    ----------
    image : SkyImage
    detected : DetectedStars
    heavens : Heavens
    matches : Matches
    exposure_s : float
        How long the shutter was open, s.
    criterion : {"median", "paper"}
        How the reference brightness is found; see `fit_brightness`.

    Returns
    -------
    Sensor
    BrightnessFit
    MeasuredStars

    Raises
    ------
    CalibrationError
        If fewer than three stars are unsaturated and alone.

    Notes
    -----
    Teague & Chahl, section 2.5, eqs (36)-(40).
    """
    stars, k = heavens.stars, matches.detection
    saturated, signal = detected.saturated[k], detected.signal_to_noise[k]
    blended = _blended(heavens, matches, detected.psf_sigma_px)
    lone = ~saturated & ~blended
    if lone.sum() < _STARS_NEEDED:
        raise CalibrationError(
            f"of {len(matches)} identified stars {int(saturated.sum())} are burnt out and {int(lone.sum())} can be"
            f" measured, where {_STARS_NEEDED} are needed; expose for a shorter time, or with less gain",
            stars_used=int(lone.sum()),
            stars_needed=_STARS_NEEDED,
        )
    wide = lone & (signal >= _BRIGHT_ENOUGH)
    sigma_px = float(np.median(detected.sigma_px[k[wide if wide.sum() >= _STARS_NEEDED else lone]]))
    usable = image.pixels_dn < np.floor(0.98 * image.saturation_dn)
    above = image.pixels_dn - detected.background.level_dn
    again = fit_stars(above, usable, detected.xy_px, start_sigma_px=sigma_px, sigma_px=sigma_px)
    measured = MeasuredStars(
        hr=stars.hr[matches.star],
        name=tuple(stars.name[s] for s in matches.star),
        vmag=stars.vmag[matches.star],
        xy_px=detected.xy_px[k],
        residual_px=matches.residual_px,
        peak_dn=np.where(saturated, detected.peak_dn[k], again.peak_dn[k]),
        sigma_px=detected.sigma_px[k],
        noise_dn=detected.noise_dn[k],
        saturated=saturated,
        blended=blended,
    )
    sky = detected.sky
    fit = _fit_in_range(measured, criterion, sky.std_dn, image.saturation_dn - sky.mean_dn)
    sensor = Sensor(
        reference_vmag=fit.reference_vmag,
        reference_peak_dn=fit.reference_peak_dn,
        reference_exposure_s=exposure_s,
        psf_sigma_px=sigma_px,
        sky_mean_dn=sky.mean_dn,
        sky_std_dn=sky.std_dn,
        bit_depth=image.bit_depth,
    )
    return sensor, fit, measured


def fit_brightness(vmag: Float, peak_dn: Float, used: Mask, *, criterion: Criterion = "median") -> BrightnessFit:
    """Return the reference brightness of stars.

    Parameters
    ----------
    vmag, peak_dn : (n,) float64
        Magnitudes, and amplitudes above the sky, DN.
    used : (n,) bool
        Which stars count: neither saturated nor lost in the noise.
    criterion : {"median", "paper"}
        ``"paper"``: eq. (38), the one star from which eq. (37) predicts the others best, by the sum of squares in DN.
        ``"median"``: the median of the stars' brightness, each reduced to the reference's magnitude, in log space.

    Returns
    -------
    BrightnessFit

    Notes
    -----
    Teague & Chahl, eqs (36)-(38).  Departs from eq. (38) by default: with magnitudes wrong by 0.42 mag, as in the
    paper, and 40 stars, eq. (38) is 0.11 mag too faint with a scatter of 0.17, because the brightest stars decide
    alone; the median is unbiased and scatters by 0.09.
    """
    m, peak = vmag[used], peak_dn[used]
    if criterion == "paper":
        # B'_i of every choice of a reference, one a row.
        computed = peak[:, np.newaxis] * brightness_ratio(m - m[:, np.newaxis])
        chosen = int(np.argmin(np.sqrt(((computed - peak) ** 2).sum(axis=1))))
        reference_vmag, reference_peak_dn = float(m[chosen]), float(peak[chosen])
    else:
        reference_vmag = round(float(np.median(m)), 2)
        reference_peak_dn = float(np.exp(np.median(np.log(peak / brightness_ratio(m - reference_vmag)))))
    off_mag = magnitude_difference(peak / (reference_peak_dn * brightness_ratio(m - reference_vmag)))
    scatter = 1.4826 * float(np.median(np.abs(off_mag - np.median(off_mag))))
    slope, _, low, high = theilslopes(np.log10(peak), m) if np.ptp(m) > 0 else (np.nan, 0.0, -np.inf, np.inf)
    return BrightnessFit(
        criterion,
        reference_vmag,
        reference_peak_dn,
        used,
        scatter,
        # The median's standard error is pi / 2 times that of the mean, in variance.
        scatter * float(np.sqrt(np.pi / 2 / len(m))),
        float(slope),
        float(low),
        float(high),
    )


def _fit_in_range(measured: MeasuredStars, criterion: Criterion, noise_dn: float, room_dn: float) -> BrightnessFit:
    """Fit the stars whose catalogue magnitude puts them between the noise and the limit.

    Chosen by what was measured, only those faint stars would count that look brighter than they are.
    """
    lone = ~measured.saturated & ~measured.blended & (measured.peak_dn > 0)
    used = lone & (measured.peak_dn >= _BRIGHT_ENOUGH * noise_dn)
    if used.sum() < _STARS_NEEDED:
        used = lone
    fit = fit_brightness(measured.vmag, measured.peak_dn, used, criterion=criterion)
    for _ in range(3):
        expected_dn = fit.peak_dn(measured.vmag)
        within = lone & (expected_dn >= _BRIGHT_ENOUGH * noise_dn) & (expected_dn <= _DIM_ENOUGH * room_dn)
        if within.sum() < 2 * _STARS_NEEDED:
            break
        fit = fit_brightness(measured.vmag, measured.peak_dn, within, criterion=criterion)
    return fit


def _blended(heavens: Heavens, matches: Matches, sigma_px: float) -> Mask:
    """Return which matched stars have another one of the catalogue in their stamp."""
    near_px = _BLENDED_PX + _BLENDED_SIGMA * sigma_px
    vmag, star_at = heavens.stars.vmag, {int(s): k for k, s in enumerate(matches.star)}
    blended = np.zeros(len(matches), dtype=np.bool_)
    for one, other in KDTree(matches.predicted_xy_px).query_pairs(near_px):
        a, b = int(matches.predicted[one]), int(matches.predicted[other])
        for star, neighbour in ((a, b), (b, a)):
            if star in star_at and vmag[neighbour] < vmag[star] + _BLENDED_MAG:
                blended[star_at[star]] = True
    return blended
