"""Stars on an image: where they are, how bright, how wide."""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.background import Background, SkyLevel, background_of, sky_level, tile_statistics
from glstar.calibrate.psf import FittedStars, fit_stars
from glstar.calibrate.shape import drawn_out_px
from glstar.calibrate.skyimage import SkyImage

__all__ = ["DetectedStars", "detect_stars"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A star stands this many standard deviations of the smoothed noise above the sky.
_SIGNIFICANT: Final = 5.0
_MOST_STARS: Final = 1000
# On so many of the brightest the width is tried first.
_FIRST_STARS: Final = 60
_FIRST_SIGMA_PX: Final = 1.3
# What is narrower than this, px, or than this share of the others, is a hot pixel; what is
# this many times wider, no star.
_HOT_PX: Final = 0.25
_HOT_SHARE: Final = 0.5
_TOO_WIDE: Final = 3.0
_CLEAR: Final = 10.0
# From so many times the noise up a star shows its shape.
_SHAPED: Final = 20.0
# Where a pixel holds this share of the largest number, it tells only that there was more.
_SATURATED_SHARE: Final = 0.98
# Where more than this share of an image does, it shows no night sky.
_BURNT_OUT: Final = 0.2
# A saturated patch is a star's if it is no longer than this, px and sigma, no longer than this multiple of its width,
# and fills this fraction of its bounding box.
_PATCH_PX: Final = 10.0
_PATCH_SIGMA: Final = 10.0
_PATCH_ASPECT: Final = 2.0
_PATCH_FILLED: Final = 0.5
# A fitted centre lies this near to the peak that it was started from, px and sigma.
_NEAR_PX: Final = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class DetectedStars:
    """What looks like a star on an image, the brightest first.

    Attributes
    ----------
    xy_px : (n, 2) float64
        Centres (x, y); pixel (0, 0) is the centre of the top-left pixel.
    peak_dn : (n,) float64
        Amplitudes above the sky, of Gaussians of the one width `psf_sigma_px`, DN; of saturated stars what the sensor
        can tell: at least this.
    sigma_px : (n,) float64
        The width of each by itself, px.
    noise_dn : (n,) float64
        Noise of the sky around, DN.
    saturated : (n,) bool
        Whether a pixel of it is at the sensor's limit.
    psf_sigma_px : float
        The median width, px; eq. (39) as it is meant.
    background : Background
    sky : SkyLevel
        Where no star is.
    drawn_out_px : float
        About how long the stars are drawn out, px; 0 where they are round.
    saturated_fraction : float
        The share of the image's pixels that are at the sensor's limit.
    hot_pixels, at_the_edge, shapeless : int
        How many peaks were refused: too narrow for a star, too near to the edge, or no Gaussian.
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

    @property
    def quality_note(self) -> str:
        """What there is to say of the image where stars are not recognised; nothing of dark ones with round stars."""
        if self.saturated_fraction > _BURNT_OUT:
            return (
                f" ({self.saturated_fraction:.0%} of the image is saturated: use a shorter exposure under a dark sky)"
            )
        if not self.drawn_out_px:
            return ""
        return (
            f" (the stars are drawn out by about {self.drawn_out_px:.0f} px: expose for a shorter time, or hold the"
            " camera still)"
        )

    @property
    def signal_to_noise(self) -> Float:
        """Amplitude over the sky's noise, (n,) float64."""
        return self.peak_dn / self.noise_dn


def detect_stars(image: SkyImage) -> DetectedStars:
    """Return the stars of an image.

    Parameters
    ----------
    image : SkyImage

    Returns
    -------
    DetectedStars
        Perhaps none.

    Notes
    -----
    Peaks of the image smoothed by its own point spread function, significant against the noise around them; each
    fitted with the renderer's Gaussian (`glstar.calibrate.psf`), first with a width of its own, then with the median
    width of all, which makes faint stars' amplitudes steady.
    """
    pixels = image.pixels_dn
    background = background_of(pixels)
    usable = pixels < _SATURATED_SHARE * image.saturation_dn
    saturated_fraction = float(1 - usable.mean())
    above = np.where(usable, pixels, float(image.saturation_dn)) - background.level_dn

    first = _peaks(above, background, usable, _FIRST_SIGMA_PX)[:_FIRST_STARS]
    sigma_px = _usual_sigma_px(fit_stars(above, usable, first, start_sigma_px=_FIRST_SIGMA_PX)) if len(first) else 1.0
    peaks = _peaks(above, background, usable, sigma_px)
    if not len(peaks):
        sky = sky_level(pixels, background, np.ones_like(usable))
        none = np.empty(0)
        return DetectedStars(
            none.reshape(0, 2),
            none,
            none,
            none,
            none.astype(np.bool_),
            sigma_px,
            background,
            sky,
            0.0,
            saturated_fraction,
            0,
            0,
            0,
        )

    alone = fit_stars(above, usable, peaks, start_sigma_px=sigma_px)
    saturated = _any_within(~usable, peaks, sigma_px)
    sigma_px = _usual_sigma_px(alone, ~saturated)
    alike = fit_stars(above, usable, peaks, start_sigma_px=sigma_px, sigma_px=sigma_px)
    noise_dn = _at(background.noise_dn, peaks)

    margin_px = 2 * sigma_px + 0.5
    limits = np.array([pixels.shape[1] - 1, pixels.shape[0] - 1]) - margin_px
    at_the_edge = ((alike.xy_px < margin_px) | (alike.xy_px > limits)).any(axis=1)
    # Of a faint star nobody can say how wide it is.
    clear = alike.peak_dn > _CLEAR * noise_dn
    hot = (alone.sigma_px < max(_HOT_PX, _HOT_SHARE * sigma_px)) & clear & ~saturated
    near = np.linalg.norm(alike.xy_px - peaks, axis=1) < np.where(saturated, 4 * sigma_px, 0) + sigma_px + _NEAR_PX
    shaped = alike.converged & near & (alike.peak_dn > 0) & ((alone.sigma_px < _TOO_WIDE * sigma_px) | saturated)
    # A star so bright that no fit finds it is where its saturated patch is.
    patch = saturated & ~shaped & _is_compact(~usable, peaks, sigma_px)
    xy_px = np.where(patch[:, np.newaxis], peaks, alike.xy_px)
    shaped |= patch
    good = np.flatnonzero(shaped & ~hot & ~at_the_edge)
    # A burnt-out star is as bright as it is large.
    peak_dn = np.where(saturated, image.saturation_dn - _at(background.level_dn, peaks), alike.peak_dn)
    burnt_px = cv2.boxFilter((~usable).astype(np.float32), -1, (31, 31), normalize=False)
    order = good[np.lexsort((-peak_dn[good], -np.where(saturated, _at(burnt_px, peaks), 0.0)[good]))]
    # Pieces of a long trail are no stars, and tell of it.
    shapes = np.flatnonzero(~saturated & ~hot & (alike.peak_dn > _SHAPED * noise_dn))
    shapes = shapes[np.argsort(-alike.peak_dn[shapes])]
    starless = _starless(pixels.shape, peaks, alike.peak_dn, noise_dn, sigma_px) & usable
    return DetectedStars(
        xy_px=xy_px[order],
        peak_dn=peak_dn[order],
        sigma_px=alone.unbiased_sigma_px[order],
        noise_dn=noise_dn[order],
        saturated=saturated[order],
        psf_sigma_px=sigma_px,
        background=background,
        sky=sky_level(pixels, background, starless),
        drawn_out_px=drawn_out_px(above, usable, peaks[shapes], sigma_px),
        saturated_fraction=saturated_fraction,
        hot_pixels=int((hot & ~at_the_edge).sum()),
        at_the_edge=int(at_the_edge.sum()),
        shapeless=int((~shaped & ~hot & ~at_the_edge).sum()),
    )


def _peaks(above: Float, background: Background, usable: Mask, sigma_px: float) -> Float:
    """Return where the smoothed image has significant peaks, (n, 2) x and y, px, the highest first."""
    smooth = cv2.GaussianBlur(above / background.noise_dn, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
    # The noise of neighbours may go together (JPEG, demosaicing): what is left after smoothing is measured.
    _, left = tile_statistics(smooth)
    significance = smooth / max(float(np.median(left)), 1e-6)
    reach = max(1, round(1.5 * sigma_px))
    highest = cv2.dilate(significance, np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8))
    rows, columns = np.nonzero((significance == highest) & (significance > _SIGNIFICANT))
    height = significance[rows, columns]
    order = np.argsort(-height)[:_MOST_STARS]
    xy = np.column_stack([columns, rows]).astype(np.float64)[order]
    return _one_each(xy, ~usable)


def _one_each(xy: Float, saturated: Mask) -> Float:
    """Return the peaks with one in the middle of each burnt-out patch instead of several on it."""
    count, labels, _, centres = cv2.connectedComponentsWithStats(saturated.astype(np.uint8), connectivity=8)
    if count == 1:
        return xy
    patch = _at(labels, xy)
    kept = xy.copy()
    _, first = np.unique(patch, return_index=True)
    burnt = first[patch[first] > 0]
    kept[burnt] = centres[patch[burnt]]
    keep = (patch == 0) | np.isin(np.arange(len(xy)), burnt)
    return np.asarray(kept[keep])


def _is_compact(saturated: Mask, xy: Float, sigma_px: float) -> Mask:
    """Return whether each place is on a saturated patch as round and small as a star's, (n,)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(saturated.astype(np.uint8), connectivity=8)
    _, _, width, height, area = stats[_at(labels, xy)].T
    longest, shortest = np.maximum(width, height), np.minimum(width, height)
    small = longest <= _PATCH_PX + _PATCH_SIGMA * sigma_px
    full = area >= _PATCH_FILLED * width * height
    return np.asarray((_at(labels, xy) > 0) & small & full & (longest <= _PATCH_ASPECT * shortest))


def _usual_sigma_px(fitted: FittedStars, counts: Mask | None = None) -> float:
    """Return the median width of fitted stars, hot pixels left out."""
    good = fitted.converged & (fitted.peak_dn > 0) & (fitted.sigma_px > _HOT_PX)
    if counts is not None and (good & counts).any():
        good &= counts
    # Faint stars tell little of their width.
    bright = good & (fitted.peak_dn >= np.quantile(fitted.peak_dn[good], 0.5)) if good.any() else good
    return float(np.median(fitted.sigma_px[bright])) if bright.any() else _FIRST_SIGMA_PX


def _any_within(mask: Mask, xy: Float, sigma_px: float) -> Mask:
    """Return whether the mask is set within a sigma or so of each place."""
    reach = int(np.ceil(1.5 * sigma_px)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(_at(cv2.dilate(mask.astype(np.uint8), disc), xy) > 0)


def _at(image: NDArray[Any], xy: Float) -> NDArray[Any]:
    columns, rows = np.rint(xy).astype(np.intp).T
    return np.asarray(image[rows.clip(0, image.shape[0] - 1), columns.clip(0, image.shape[1] - 1)])


def _starless(shape: tuple[int, ...], xy: Float, peak_dn: Float, noise_dn: Float, sigma_px: float) -> Mask:
    """Return the pixels on which no star leaves a tenth of the noise, and twice as far for wings."""
    covered = np.zeros(shape, dtype=np.uint8)
    contrast = np.maximum(10 * np.abs(peak_dn) / noise_dn, np.e)
    radius_px = 2 * np.hypot(sigma_px, 0.3) * np.sqrt(2 * np.log(contrast))
    for (x, y), radius in zip(xy, np.minimum(radius_px, 0.1 * max(shape)), strict=True):
        cv2.circle(covered, (round(x), round(y)), int(np.ceil(radius)), 1, thickness=-1)
    return np.asarray(covered == 0)
