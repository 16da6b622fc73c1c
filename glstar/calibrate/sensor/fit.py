"""From identified stars to the sensor: brightness, width and sky."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import ndtri

from glstar.arrays import Float, Index, Mask, robust_std
from glstar.calibrate.identify.platesolution import Matches, ReferenceStars, sidereal_trails
from glstar.calibrate.photo.detection import DetectedStars
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import dilution, fit_stars, profile
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import CalibrationError
from glstar.sky.photometry import brightness_ratio, magnitude_difference

Criterion = Literal["median", "paper"]

# Change of flux per magnitude, dex: eq. (36).
LIGHT_DEX_PER_MAG = -0.4
_STARS_NEEDED = 3
# Width and brightness are measured on stars above this signal-to-noise ratio.
_BRIGHT_ENOUGH = 10.0
# A star's weight in the width grows with its signal-to-noise ratio up to this.
_CLEAREST = 60.0
# Stars expected above this fraction of the sensor's range are left out: the brighter half would saturate.
_DIM_ENOUGH = 0.5
# The linearity is also measured on brighter stars, up to this fraction, if there are this many ...
_NEARLY_FULL = 0.9
_SLOPE_STARS = 15
# ... and a slope this near to -0.4, dex per magnitude, counts as linear.
_PROPORTIONAL = 0.02
# Sidereal trails are fitted if they are longer than this, sigma.
_TRAIL_SIGMA = 0.3
# Stars longer than their sidereal trails by more than this, sigma, show a moving camera.
_SHAKEN_SIGMA = 2.5
# Measured lengths of trails are right to this factor.
_LONGER = 1.35
# Bootstrap samples for the standard error of the typical width, which they determine to 5 %.
_RESAMPLED = 200
# A star is blended with another catalogue star within this distance, px plus a multiple of sigma, if the other is
# fainter by at most this, mag.
_BLENDED_PX = 2.0
_BLENDED_SIGMA = 4.0
_BLENDED_MAG = 3.5


@dataclass(frozen=True, slots=True, eq=False)
class BrightnessFit:
    """Brightness against magnitude."""

    criterion: Criterion  # {"median", "paper"}: the criterion of the reference brightness
    reference_vmag: float  # Magnitude and amplitude of the reference star, DN: B_r and m_r of eq. (37)
    reference_peak_dn: float
    used: Mask  # (n,) bool: the stars used in the fit
    scatter_mag: float  # Robust standard deviation of the used stars about the fit, magnitudes
    error_mag: float  # Standard error of the reference's brightness, magnitudes
    # Measured slope of log10 of the amplitude over magnitude (Theil and Sen); -0.4 for a linear sensor.
    slope_dex_per_mag: float
    slope_low_dex_per_mag: float  # Its 95 % confidence interval
    slope_high_dex_per_mag: float

    @property
    def linear(self) -> bool:
        """Whether the stars agree with a linear sensor."""
        within = self.slope_low_dex_per_mag <= LIGHT_DEX_PER_MAG <= self.slope_high_dex_per_mag
        return within or abs(self.slope_dex_per_mag - LIGHT_DEX_PER_MAG) < _PROPORTIONAL

    def peak_dn(self, vmag: Float) -> Float:
        """Return the amplitudes by eq. (37), (n,) float64, DN."""
        return np.asarray(self.reference_peak_dn * brightness_ratio(vmag - self.reference_vmag))


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStars:
    """Identified stars with their measurements, in the order of catalogue brightness."""

    catalogue: str  # The catalogue that numbers the stars
    star_id: NDArray[np.int32]  # (n,) int32
    name: tuple[str, ...]
    vmag: Float  # (n,)
    xy_px: Float  # (n, 2) detected positions
    residual_px: Float  # (n, 2) detected minus predicted positions
    peak_dn: Float  # (n,) amplitudes above the sky, for the sensor's width, DN
    sigma_px: Float  # (n,) the width of each star, px
    noise_dn: Float  # (n,)
    saturated: Mask  # (n,) bool: whether a pixel is saturated, and whether another catalogue star is too close
    blended: Mask
    psf_sigma_error_px: float  # Standard error of their typical width, px
    # (n, 2) sidereal motion of each star during the exposure, px; zeros if the camera tracked the sky or the motion is
    # too small to be detected.
    trail_px: Float

    @property
    def moved(self) -> bool:
        """Whether the stars have sidereal trails."""
        return bool(self.trail_px.any())

    @property
    def longest_trail_px(self) -> float:
        """The longest of their trails, px."""
        return float(np.linalg.norm(self.trail_px, axis=1).max(initial=0.0))

    def __len__(self) -> int:
        return len(self.vmag)


def fit_sensor(
    image: Photograph,
    detected: DetectedStars,
    reference: ReferenceStars,
    matches: Matches,
    *,
    exposure_s: float,
    criterion: Criterion = "median",
) -> tuple[Sensor, BrightnessFit, MeasuredStars]:
    """Return the sensor fitted to a photograph.

    `exposure_s`: exposure time, s; `criterion` {"median", "paper"}: the criterion of the reference brightness; see
    `fit_brightness`.  Raises CalibrationError if fewer than three stars are unsaturated and isolated, or if their
    trails are longer than sidereal motion explains.  Teague & Chahl, section 2.5, eqs (36)-(40).  If the image shows
    sidereal trails, because the camera did not track the sky, width and amplitude are corrected to stars at rest.
    """
    measured, sigma_px = _measure_stars(image, detected, reference, matches, exposure_s)
    sky = detected.sky
    range_dn = image.saturation_dn - sky.mean_dn
    fit = _fit_in_range(measured, criterion, sigma_px, sky.std_dn, range_dn, float(np.median(reference.stars.vmag)))
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


def _measure_stars(
    image: Photograph, detected: DetectedStars, reference: ReferenceStars, matches: Matches, exposure_s: float
) -> tuple[MeasuredStars, float]:
    """Return the matched stars with their amplitudes and widths, and their typical width, px."""
    k = matches.detection
    saturated, signal = detected.saturated[k], detected.signal_to_noise[k]
    blended = _blended(reference, matches, detected.psf_sigma_px)
    measurable = _measurable(matches, saturated, blended)
    wide = measurable & (signal >= _BRIGHT_ENOUGH)
    wide = wide if wide.sum() >= _STARS_NEEDED else measurable
    usable = image.pixels_dn < np.floor(0.98 * image.saturation_dn)
    above = image.pixels_dn - detected.background.level_dn
    trail_px = sidereal_trails(matches.solution, detected.xy_px, exposure_s)
    each_sigma_px, moved = _moving(above, usable, detected, k, wide, trail_px)
    if not moved:
        each_sigma_px, trail_px = detected.sigma_px[k], np.zeros_like(trail_px)
    weights = np.minimum(signal[wide], _CLEAREST) ** 2
    typical_px = _median(each_sigma_px[wide], weights)
    _refuse_shaken(detected, trail_px[k], typical_px)
    fits = fit_stars(
        above,
        usable,
        detected.xy_px,
        start_sigma_px=typical_px,
        sigma_px=typical_px,
        trail_px=trail_px if moved else None,
        only=k,
    )
    stars = reference.stars
    measured = MeasuredStars(
        catalogue=stars.catalogue,
        star_id=stars.star_id[matches.star],
        name=tuple(stars.name[s] for s in matches.star),
        vmag=stars.vmag[matches.star],
        xy_px=detected.xy_px[k],
        residual_px=matches.residual_px,
        peak_dn=np.where(saturated, detected.peak_dn[k], fits.unbiased_peak_dn),
        sigma_px=each_sigma_px,
        noise_dn=detected.noise_dn[k],
        saturated=saturated,
        blended=blended,
        psf_sigma_error_px=_median_error(each_sigma_px[wide], weights),
        trail_px=trail_px[k],
    )
    return measured, typical_px


def _measurable(matches: Matches, saturated: Mask, blended: Mask) -> Mask:
    """Return which matched stars are neither saturated nor blended; raise an error if they are too few."""
    measurable = ~saturated & ~blended
    if measurable.sum() < _STARS_NEEDED:
        raise CalibrationError(
            f"of {len(matches)} identified stars {int(saturated.sum())} are saturated and {int(measurable.sum())} can"
            f" be measured, but {_STARS_NEEDED} are needed; use a shorter exposure or a lower gain",
            stars_used=int(measurable.sum()),
            stars_needed=_STARS_NEEDED,
        )
    return measurable


def fit_brightness(
    vmag: Float, peak_dn: Float, used: Mask, *, criterion: Criterion = "median", sloping: Mask | None = None
) -> BrightnessFit:
    """Return the reference brightness of stars.

    `vmag`, `peak_dn` (n,): magnitudes, and amplitudes above the sky, DN; `used` (n,) bool: the stars to use: neither
    saturated nor below the noise; `criterion` {"median", "paper"}: ``"paper"``: eq. (38), the one star from which eq.
    (37) predicts the others best, by the sum of squares in DN.  ``"median"``: the median of the stars' brightness, each
    reduced to the reference's magnitude, in log space; `sloping` (n,) bool: stars for the slope of brightness over
    magnitude; by default the same.  Teague & Chahl, eqs (36)-(38).  Departs from eq. (38) by default, because the
    brightest stars dominate its sum.  With magnitudes wrong by 0.42 mag, as in the paper, and 40 stars, eq. (38) is
    0.11 mag too faint with a scatter of 0.17; the median is unbiased and scatters by 0.09.
    """
    m, peak = vmag[used], peak_dn[used]
    if criterion == "paper":
        # B'_i of every choice of a reference, one per row.
        computed = peak[:, np.newaxis] * brightness_ratio(m - m[:, np.newaxis])
        chosen = int(np.argmin(np.sqrt(((computed - peak) ** 2).sum(axis=1))))
        reference_vmag, reference_peak_dn = float(m[chosen]), float(peak[chosen])
    else:
        reference_vmag = round(float(np.median(m)), 2)
        reference_peak_dn = float(np.exp(np.median(np.log(peak / brightness_ratio(m - reference_vmag)))))
    off_mag = magnitude_difference(peak / (reference_peak_dn * brightness_ratio(m - reference_vmag)))
    scatter = robust_std(off_mag, float(np.median(off_mag)))
    if sloping is not None:
        m, peak = vmag[sloping], peak_dn[sloping]
    slope, low, high = _slope(m, np.log10(peak)) if np.ptp(m) > 0 else (np.nan, -np.inf, np.inf)
    return BrightnessFit(
        criterion=criterion,
        reference_vmag=reference_vmag,
        reference_peak_dn=reference_peak_dn,
        used=used,
        scatter_mag=scatter,
        # The median's standard error is pi / 2 times that of the mean, in variance.
        error_mag=scatter * float(np.sqrt(np.pi / 2 / used.sum())),
        slope_dex_per_mag=float(slope),
        slope_low_dex_per_mag=float(low),
        slope_high_dex_per_mag=float(high),
    )


def _slope(x: Float, y: Float) -> tuple[float, float, float]:
    """Return the median slope of all pairs of points (Theil and Sen) and its 95 % confidence interval.

    The interval is that of Kendall's tau with ties, as in SciPy's theilslopes.
    """
    one, other = np.triu_indices(len(x), 1)
    separation = x[other] - x[one]
    slopes = np.sort((y[other] - y[one])[separation != 0] / separation[separation != 0])

    def spread(n: NDArray[np.intp]) -> float:
        return float(np.sum(n * (n - 1.0) * (2 * n + 5)) / 18)

    ties = [np.unique(values, return_counts=True)[1] for values in (x, y)]
    sure = float(-ndtri(0.025)) * np.sqrt(max(spread(np.array([len(x)])) - sum(map(spread, ties)), 0.0))
    low = max(round((len(slopes) - sure) / 2) - 1, 0)
    high = min(round((len(slopes) + sure) / 2), len(slopes) - 1)
    return float(np.median(slopes)), float(slopes[low]), float(slopes[high])


def _median(values: Float, weights: Float) -> float:
    """Return the weighted median, interpolated between the two nearest values."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    return float(np.interp(weights.sum() / 2, below, values[order]))


def _median_error(values: Float, weights: Float) -> float:
    """Return the standard error of `_median`: its scatter over resampled stars (bootstrap)."""
    chosen = np.random.default_rng(0).integers(0, len(values), (_RESAMPLED, len(values)))
    return float(np.std([_median(values[k], weights[k]) for k in chosen]))


def _moving(
    above_dn: Float, usable: Mask, detected: DetectedStars, identified: Index, bright: Mask, trail_px: Float
) -> tuple[Float, bool]:
    """Return the widths of identified stars as trails of these lengths, and whether trails fit better than points.

    Both models are compared on the same pixels of the bright stars.
    """
    if np.linalg.norm(trail_px, axis=1).max(initial=0.0) < _TRAIL_SIGMA * detected.psf_sigma_px:
        return detected.sigma_px[identified], False
    start_px = detected.psf_sigma_px
    if detected.drawn_out_px:
        # The measured width still includes the trail.
        start_px = max(0.5, start_px - detected.drawn_out_px / 6)
    fits = [
        fit_stars(
            above_dn,
            usable,
            detected.xy_px,
            start_sigma_px=start_px,
            trail_px=trail,
            stamp_trail_px=trail_px,
            only=identified,
        )
        for trail in (trail_px, np.zeros_like(trail_px))
    ]
    moving, standing = (fit.misfit_dn[bright] for fit in fits)
    return fits[0].unbiased_sigma_px, bool(np.median(np.log(moving / standing)) < 0)


def _refuse_shaken(detected: DetectedStars, trail_px: Float, sigma_px: float) -> None:
    """Raise an error for trails longer than sidereal motion explains, because their width is more than the PSF's."""
    longest_px = float(np.median(np.linalg.norm(trail_px, axis=1)))
    if detected.drawn_out_px - _LONGER * longest_px > _SHAKEN_SIGMA * sigma_px:
        raise CalibrationError(
            f"the stars are trails of about {detected.drawn_out_px:.0f} px, and sidereal motion explains"
            f" {longest_px:.1f} px: the camera moved, or the given exposure is wrong; hold the camera still"
            " and expose for a shorter time",
        )


def _fit_in_range(
    measured: MeasuredStars,
    criterion: Criterion,
    sigma_px: float,
    noise_dn: float,
    range_dn: float,
    complete_vmag: float,
) -> BrightnessFit:
    """Fit the stars with catalogue magnitudes between the noise and saturation.

    A selection by measured brightness would favour faint stars that are measured too bright.  The slope over magnitude
    is measured on the brighter half of the catalogue: its faint end is biased towards stars brighter than their V.
    """
    lone = ~measured.saturated & ~measured.blended & (measured.peak_dn > 0)
    # Peak of a trail over that of the star at rest.
    fraction = dilution(measured.trail_px, sigma_px)
    # The pixel's area also averages over the peak of a sharp star.
    pixel_fraction = fraction * float(profile(0.0, sigma_px)) ** 2
    used = lone & (fraction * measured.peak_dn >= _BRIGHT_ENOUGH * noise_dn)
    if used.sum() < _STARS_NEEDED:
        used = lone
    fit = fit_brightness(measured.vmag, measured.peak_dn, used, criterion=criterion)
    for _ in range(3):
        expected_dn = fraction * fit.peak_dn(measured.vmag)
        full = expected_dn / fraction * pixel_fraction / range_dn
        clear = lone & (expected_dn >= _BRIGHT_ENOUGH * noise_dn)
        within, sloping = clear & (full <= _DIM_ENOUGH), clear & (full <= _NEARLY_FULL)
        if within.sum() < 2 * _STARS_NEEDED:
            break
        sloping &= measured.vmag <= complete_vmag
        fit = fit_brightness(
            measured.vmag,
            measured.peak_dn,
            within,
            criterion=criterion,
            sloping=sloping if sloping.sum() >= _SLOPE_STARS else None,
        )
    return fit


def _blended(reference: ReferenceStars, matches: Matches, sigma_px: float) -> Mask:
    """Return which matched stars have another catalogue star in their stamp."""
    near_px = _BLENDED_PX + _BLENDED_SIGMA * sigma_px
    vmag, star_at = reference.stars.vmag, {int(s): k for k, s in enumerate(matches.star)}
    blended = np.zeros(len(matches), dtype=np.bool_)
    for one, other in KDTree(matches.predicted_xy_px).query_pairs(near_px):
        a, b = int(matches.predicted[one]), int(matches.predicted[other])
        for star, neighbour in ((a, b), (b, a)):
            if star in star_at and vmag[neighbour] < vmag[star] + _BLENDED_MAG:
                blended[star_at[star]] = True
    return blended
