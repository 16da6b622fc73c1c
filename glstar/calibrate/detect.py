"""Detection of stars on an image, and measurement of their positions, amplitudes and widths."""

from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.background import Background, SkyLevel, background_of, sky_level, tile_statistics
from glstar.calibrate.photograph import Photograph
from glstar.calibrate.psf import FittedStars, fit_stars
from glstar.calibrate.shape import drawn_out_px

__all__ = ["DetectedStars", "detect_stars"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Detection:
    """Thresholds of detection."""

    # Smallest signal-to-noise ratio of a peak in the smoothed image.
    peak_snr: float = 5.0
    most_stars: int = 1000
    # The width of the PSF is first measured on this number of the brightest peaks, starting from this sigma, px.
    first_stars: int = 60
    first_sigma_px: float = 1.3
    # Narrower peaks than this, px, or than this fraction of the typical width, are hot pixels.
    hot_px: float = 0.25
    hot_fraction: float = 0.5
    # Peaks wider than this multiple of the typical width are not stars.
    too_wide: float = 3.0
    # Below this signal-to-noise ratio the width is too uncertain to reject a peak as a hot pixel, ...
    hot_snr: float = 10.0
    # ... and below this one it is too uncertain to measure an elongation.
    shape_snr: float = 20.0
    # Pixels above this fraction of the largest digital number count as saturated.
    saturated_level: float = 0.98
    # An image with a larger fraction of saturated pixels is reported.
    saturated_image: float = 0.2
    # A saturated patch is a star if its length is below this, px plus a multiple of sigma, and below this multiple of
    # its width, and if it fills this fraction of its bounding box.
    patch_px: float = 10.0
    patch_sigma: float = 10.0
    patch_aspect: float = 2.0
    patch_filled: float = 0.5
    # A fitted centre may lie this far from its peak, px, in addition to sigma.
    near_px: float = 1.5


_DETECTION: Final = _Detection()


@dataclass(frozen=True, slots=True, eq=False)
class DetectedStars:
    """Detected stars, the brightest first.

    Attributes
    ----------
    xy_px : (n, 2) float64
        Centres (x, y); pixel (0, 0) is the centre of the top-left pixel.
    peak_dn : (n,) float64
        Amplitudes above the sky of Gaussians of width `psf_sigma_px`, DN; lower limits for saturated stars.
    sigma_px : (n,) float64
        The width of each star, fitted on its own, px.
    noise_dn : (n,) float64
        Noise of the sky around each star, DN.
    saturated : (n,) bool
        Whether a pixel of the star is saturated.
    psf_sigma_px : float
        The median width, px; in place of eq. (39).
    background : Background
    sky : SkyLevel
        Of the starless pixels.
    drawn_out_px : float
        Length of the stars' trails, px; 0 if the stars are round.
    saturated_fraction : float
        Fraction of the image's pixels that are saturated.
    hot_pixels, at_the_edge, shapeless : int
        Number of rejected peaks: too narrow for a star, too close to the edge, or not Gaussian.
    """

    xy_px: Float
    peak_dn: Float
    sigma_px: Float
    noise_dn: Float
    saturated: Mask
    psf_sigma_px: float
    background: Background
    sky: SkyLevel
    drawn_out_px: float
    saturated_fraction: float
    hot_pixels: int
    at_the_edge: int
    shapeless: int

    def __len__(self) -> int:
        return len(self.peak_dn)

    def without(self, removed: NDArray[np.bool_]) -> "DetectedStars":
        """Return the detections without some of them.

        Parameters
        ----------
        removed : (n,) bool

        Returns
        -------
        DetectedStars
        """
        names = ("xy_px", "peak_dn", "sigma_px", "noise_dn", "saturated")
        return replace(self, **{name: getattr(self, name)[~removed] for name in names})

    @property
    def quality_note(self) -> str:
        """A remark on the image for error messages; empty for a dark image with round stars."""
        if self.saturated_fraction > _DETECTION.saturated_image:
            return (
                f" ({self.saturated_fraction:.0%} of the image is saturated: use a shorter exposure, under a dark sky)"
            )
        if not self.drawn_out_px:
            return ""
        return (
            f" (the stars are trails of about {self.drawn_out_px:.0f} px: use a shorter exposure, or hold the camera"
            " still)"
        )

    @property
    def signal_to_noise(self) -> Float:
        """Amplitudes over the noise of the sky, (n,) float64."""
        return self.peak_dn / self.noise_dn


def detect_stars(image: Photograph) -> DetectedStars:
    """Detect the stars of an image.

    Parameters
    ----------
    image : Photograph

    Returns
    -------
    DetectedStars
        Possibly empty.

    Notes
    -----
    Detections are significant peaks of the image smoothed with its PSF.  The renderer's Gaussian
    (`glstar.calibrate.psf`) is fitted to each, first with an individual width and then with the median width of all
    stars, which stabilises the amplitudes of faint stars.
    """
    pixels = image.pixels_dn
    background = background_of(pixels)
    usable = pixels < _DETECTION.saturated_level * image.saturation_dn
    above = np.where(usable, pixels, float(image.saturation_dn)) - background.level_dn

    first_px = _DETECTION.first_sigma_px
    first = _peaks(above, background, usable, first_px)[: _DETECTION.first_stars]
    sigma_px = _typical_sigma_px(fit_stars(above, usable, first, start_sigma_px=first_px)) if len(first) else 1.0
    peaks = _peaks(above, background, usable, sigma_px)
    if not len(peaks):
        return _no_stars(pixels, background, usable, sigma_px)
    saturated = _any_within(~usable, peaks, sigma_px)
    free = fit_stars(above, usable, peaks, start_sigma_px=sigma_px)
    sigma_px = _typical_sigma_px(free, ~saturated)
    fixed = fit_stars(above, usable, peaks, start_sigma_px=sigma_px, sigma_px=sigma_px)
    noise_dn = _at(background.noise_dn, peaks)
    xy_px, hot, at_the_edge, shaped = _classified(peaks, free, fixed, usable, saturated, noise_dn, sigma_px)

    good = np.flatnonzero(shaped & ~hot & ~at_the_edge)
    # The amplitude of a saturated star is a lower limit; saturated stars are sorted by the size of their patch.
    peak_dn = np.where(saturated, image.saturation_dn - _at(background.level_dn, peaks), fixed.peak_dn)
    patch_px2 = cv2.boxFilter((~usable).astype(np.float32), -1, (31, 31), normalize=False)
    order = good[np.lexsort((-peak_dn[good], -np.where(saturated, _at(patch_px2, peaks), 0.0)[good]))]
    # Fragments of a long trail are not stars, but their elongation measures its length.
    elongated = np.flatnonzero(~saturated & ~hot & (fixed.peak_dn > _DETECTION.shape_snr * noise_dn))
    elongated = elongated[np.argsort(-fixed.peak_dn[elongated])]
    starless = _starless(pixels.shape, peaks, fixed.peak_dn, noise_dn, sigma_px)
    return DetectedStars(
        xy_px=xy_px[order],
        peak_dn=peak_dn[order],
        sigma_px=free.unbiased_sigma_px[order],
        noise_dn=noise_dn[order],
        saturated=saturated[order],
        psf_sigma_px=sigma_px,
        background=background,
        sky=sky_level(pixels, background, starless & usable),
        drawn_out_px=drawn_out_px(above, usable, peaks[elongated], sigma_px),
        saturated_fraction=float(1 - usable.mean()),
        hot_pixels=int((hot & ~at_the_edge).sum()),
        at_the_edge=int(at_the_edge.sum()),
        shapeless=int((~shaped & ~hot & ~at_the_edge).sum()),
    )


def _no_stars(pixels: Float, background: Background, usable: Mask, sigma_px: float) -> DetectedStars:
    none = np.empty(0)
    return DetectedStars(
        xy_px=none.reshape(0, 2),
        peak_dn=none,
        sigma_px=none,
        noise_dn=none,
        saturated=none.astype(np.bool_),
        psf_sigma_px=sigma_px,
        background=background,
        sky=sky_level(pixels, background, np.ones_like(usable)),
        drawn_out_px=0.0,
        saturated_fraction=float(1 - usable.mean()),
        hot_pixels=0,
        at_the_edge=0,
        shapeless=0,
    )


def _classified(
    peaks: Float,
    free: FittedStars,
    fixed: FittedStars,
    usable: Mask,
    saturated: Mask,
    noise_dn: Float,
    sigma_px: float,
) -> tuple[Float, Mask, Mask, Mask]:
    """Return the positions of peaks, and which are hot pixels, at the edge, and shaped like a star.

    `free` was fitted with a width for each star, `fixed` with one width for all.
    """
    margin_px = 2 * sigma_px + 0.5
    limits = np.array([usable.shape[1] - 1, usable.shape[0] - 1]) - margin_px
    at_the_edge = np.any((fixed.xy_px < margin_px) | (fixed.xy_px > limits), axis=1)
    bright = fixed.peak_dn > _DETECTION.hot_snr * noise_dn
    hot = (free.sigma_px < max(_DETECTION.hot_px, _DETECTION.hot_fraction * sigma_px)) & bright & ~saturated
    allowed_px = np.where(saturated, 4 * sigma_px, 0) + sigma_px + _DETECTION.near_px
    near = np.linalg.norm(fixed.xy_px - peaks, axis=1) < allowed_px
    narrow = (free.sigma_px < _DETECTION.too_wide * sigma_px) | saturated
    shaped = fixed.converged & near & (fixed.peak_dn > 0) & narrow
    # The fit fails on very bright stars, so the position of their saturated patch is used.
    patch = saturated & ~shaped & _is_compact(~usable, peaks, sigma_px)
    xy_px = np.where(patch[:, np.newaxis], peaks, fixed.xy_px)
    shaped |= patch
    return xy_px, hot, at_the_edge, shaped


def _peaks(above: Float, background: Background, usable: Mask, sigma_px: float) -> Float:
    """Return the positions of significant peaks of the smoothed image, (n, 2) x and y, px, the highest first."""
    smooth = cv2.GaussianBlur(above / background.noise_dn, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
    # The noise of neighbours may be correlated (JPEG, demosaicing), so the noise is measured after smoothing.
    _, noise = tile_statistics(smooth)
    significance = smooth / max(float(np.median(noise)), 1e-6)
    radius = max(1, round(1.5 * sigma_px))
    highest = cv2.dilate(significance, np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8))
    rows, columns = np.nonzero((significance == highest) & (significance > _DETECTION.peak_snr))
    height = significance[rows, columns]
    order = np.argsort(-height)[: _DETECTION.most_stars]
    xy = np.column_stack([columns, rows]).astype(np.float64)[order]
    return _one_each(xy, ~usable)


def _one_each(xy: Float, saturated: Mask) -> Float:
    """Return the peaks, with one in the middle of each saturated patch instead of several on it."""
    count, labels, _, centres = cv2.connectedComponentsWithStats(saturated.astype(np.uint8), connectivity=8)
    if count == 1:
        return xy
    patch = _at(labels, xy)
    kept = xy.copy()
    _, first = np.unique(patch, return_index=True)
    on_patch = first[patch[first] > 0]
    kept[on_patch] = centres[patch[on_patch]]
    keep = (patch == 0) | np.isin(np.arange(len(xy)), on_patch)
    return np.asarray(kept[keep])


def _is_compact(saturated: Mask, xy: Float, sigma_px: float) -> Mask:
    """Return whether each position is on a saturated patch as round and small as a star, (n,)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(saturated.astype(np.uint8), connectivity=8)
    _, _, width, height, area = stats[_at(labels, xy)].T
    longest, shortest = np.maximum(width, height), np.minimum(width, height)
    small = longest <= _DETECTION.patch_px + _DETECTION.patch_sigma * sigma_px
    full = area >= _DETECTION.patch_filled * width * height
    return np.asarray((_at(labels, xy) > 0) & small & full & (longest <= _DETECTION.patch_aspect * shortest))


def _typical_sigma_px(fitted: FittedStars, counts: Mask | None = None) -> float:
    """Return the median width of the brighter half of fitted stars, without hot pixels."""
    good = fitted.converged & (fitted.peak_dn > 0) & (fitted.sigma_px > _DETECTION.hot_px)
    if counts is not None and (good & counts).any():
        good &= counts
    bright = good & (fitted.peak_dn >= np.quantile(fitted.peak_dn[good], 0.5)) if good.any() else good
    return float(np.median(fitted.sigma_px[bright])) if bright.any() else _DETECTION.first_sigma_px


def _any_within(mask: Mask, xy: Float, sigma_px: float) -> Mask:
    """Return whether the mask is set within 1.5 sigma of each position."""
    radius = int(np.ceil(1.5 * sigma_px)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(_at(cv2.dilate(mask.astype(np.uint8), disc), xy) > 0)


def _at(image: NDArray[Any], xy: Float) -> NDArray[Any]:
    columns, rows = np.rint(xy).astype(np.intp).T
    return np.asarray(image[rows.clip(0, image.shape[0] - 1), columns.clip(0, image.shape[1] - 1)])


def _starless(shape: tuple[int, ...], xy: Float, peak_dn: Float, noise_dn: Float, sigma_px: float) -> Mask:
    """Return the pixels far from stars: beyond twice the radius where a star falls below a tenth of the noise."""
    covered = np.zeros(shape, dtype=np.uint8)
    contrast = np.maximum(10 * np.abs(peak_dn) / noise_dn, np.e)
    radius_px = 2 * np.hypot(sigma_px, 0.3) * np.sqrt(2 * np.log(contrast))
    for (x, y), radius in zip(xy, np.minimum(radius_px, 0.1 * max(shape)), strict=True):
        cv2.circle(covered, (round(x), round(y)), int(np.ceil(radius)), 1, thickness=-1)
    return np.asarray(covered == 0)
