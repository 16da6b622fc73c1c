"""Detection of stars on an image: their positions, amplitudes and widths; level and noise of the sky background."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from glstar.arrays import Float, Index, Mask, robust_std
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import FittedStars, drawn_out_px, fit_stars

# Side of a background tile, px. Larger images have larger tiles with the same number of sampled pixels.
_TILE_PX = 64
_MOST_TILES = 32
_CLIP_SIGMA = 3.0
_CLIPS = 5
# Standard deviation of a Gaussian clipped at 3 sigma, over that of the whole Gaussian.
_CLIPPED_STD = float(np.sqrt(1 - 6 * np.exp(-4.5) / np.sqrt(2 * np.pi) / (ndtr(3) - ndtr(-3))))
# Rounding to whole DN adds this to the variance, DN^2.
_ROUNDING_DN2 = 1 / 12
# From this fraction of pixels at 0 on, the background is clipped and a truncated Gaussian is fitted.
_CLIPPED_FRACTION = 0.005
# A sky this far above 0, standard deviations of its noise, has no pixel at 0.
_CLIPPED_SIGMA = 4.0
# The fit divides the image into this many parts in x and in y, and uses each up to this quantile: brighter pixels
# are stars.
_PARTS = 4
_STARLESS_QUANTILE = 0.97
_MIN_PIXELS = 100
# A tile outside the image circle of a lens is darker than this part of the sky, and by this many standard deviations of
# its noise; the sky is the brightest fifth of the tiles.  Tiles are bright above this part; this fraction of their
# number may be neither, and this fraction of both must be inside and outside of a disc.
_BLACK = 0.1
_BLACK_SIGMA = 5.0
_BRIGHT = 0.33
_MOST_BETWEEN = 0.5
_LEAST_DISC = 0.93
_USUAL_QUANTILE = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The background at each pixel."""

    level_dn: Float  # (height, width) DN
    noise_dn: Float  # (height, width) standard deviation of the noise, DN
    # (height, width) whether a lens casts light there: outside its image circle an image is black; and whether that is
    # so in the surroundings, too.
    is_lit: Mask
    is_sky: Mask


@dataclass(frozen=True, slots=True)
class SkyLevel:
    """The background of a whole image, as in `glstar.camera.sensor.sensor.Sensor`."""

    mean_dn: float  # The Gaussian of eq. (40), before rounding and clipping at 0, DN
    std_dn: float
    # Standard deviation of the level over the image, DN: gradients and vignetting, which the sensor model lacks.
    unevenness_dn: float
    pixels: int  # Number of pixels that were measured
    clipped_fraction: float  # Fraction of them that are 0


def background_of(image_dn: Float) -> Background:
    """Return the level and the noise of the background at each pixel.

    The level is the clipped mean of tiles, median-filtered over neighbouring tiles and interpolated.
    """
    level, noise = tile_statistics(image_dn)
    is_lit = _lit_tiles(level, noise)
    is_sky = cv2.erode(is_lit.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    side, (height, width) = _tile_px(image_dn.shape), image_dn.shape
    lit, sky = (np.repeat(np.repeat(tiles, side, axis=0), side, axis=1)[:height, :width] for tiles in (is_lit, is_sky))
    return Background(_spread(level, image_dn.shape), np.maximum(_spread(noise, image_dn.shape), 0.05), lit, sky)


def _lit_tiles(level: Float, noise: Float) -> Mask:
    """Return which tiles a lens casts light on: all but those outside of an image circle.

    They are black beside a sky far above its noise, in all four corners, and around a disc that ends within few tiles:
    a sky is dark beside the Earth's limb on one side, and beside the glare of the Moon gradually.
    """
    usual = level >= np.quantile(level, _USUAL_QUANTILE)
    usual_dn, usual_noise_dn = float(np.median(level[usual])), float(np.median(noise[usual]))
    is_black = (level < _BLACK * usual_dn) & (usual_dn - level > _BLACK_SIGMA * usual_noise_dn)
    is_bright = level > _BRIGHT * usual_dn
    between = np.count_nonzero(~is_black & ~is_bright)
    if not is_black[[0, 0, -1, -1], [0, -1, 0, -1]].all() or between > _MOST_BETWEEN * np.count_nonzero(is_bright):
        return np.ones_like(is_black)
    row, column = np.mgrid[: level.shape[0], : level.shape[1]]
    from_middle = np.hypot(row - row[is_bright].mean(), column - column[is_bright].mean()).ravel()
    # The disc that has most bright tiles inside and black ones outside.
    order = np.argsort(from_middle, kind="stable")
    right = np.cumsum(is_bright.ravel()[order]) + is_black.sum() - np.cumsum(is_black.ravel()[order])
    is_disc = right.max() > _LEAST_DISC * (is_black.size - between)
    return np.asarray(~is_black) if is_disc else np.ones_like(is_black)


def tile_statistics(image: Float) -> tuple[Float, Float]:
    """Return the clipped mean and standard deviation of each tile of an image, (rows, columns)."""
    side = _tile_px(image.shape)
    rows, columns = (-(-length // side) for length in image.shape)
    padded = np.pad(image, ((0, rows * side - image.shape[0]), (0, columns * side - image.shape[1])), mode="reflect")
    stride = max(1, side // _TILE_PX)
    tiles = padded.reshape(rows, side, columns, side)[:, ::stride, :, ::stride]
    values = np.sort(np.swapaxes(tiles, 1, 2).reshape(rows, columns, -1).astype(np.float32), axis=-1)
    moments = np.array([_clipped_moments(tile) for tile in values.reshape(rows * columns, -1)])
    return moments[:, 0].reshape(rows, columns), moments[:, 1].reshape(rows, columns)


def _clipped_moments(ordered: NDArray[np.float32]) -> tuple[float, float]:
    """Return the clipped mean and standard deviation of sorted values."""
    low, middle, high = (_quantile(ordered, fraction) for fraction in (0.25, 0.5, 0.75))
    above = ordered.astype(np.float64) - middle
    # On sorted values a clip is a pair of indices and a difference of cumulative sums.
    sums, squares = np.zeros(len(above) + 1), np.zeros(len(above) + 1)
    np.cumsum(above, out=sums[1:])
    np.cumsum(above**2, out=squares[1:])
    mean, std = 0.0, max((high - low) / 1.349, 0.5)
    for _ in range(_CLIPS):
        first = above.searchsorted(mean - _CLIP_SIGMA * std, "left")
        last = above.searchsorted(mean + _CLIP_SIGMA * std, "right")
        count = max(int(last - first), 1)
        mean = float(sums[last] - sums[first]) / count
        variance = float(squares[last] - squares[first]) / count - mean**2
        std = max(float(np.sqrt(max(variance, 0.0))) / _CLIPPED_STD, 0.05)
    return middle + mean, float(std)


def _quantile(ordered: NDArray[np.float32], fraction: float) -> float:
    """Return a quantile of sorted values."""
    position = fraction * (len(ordered) - 1)
    below, above = float(ordered[int(position)]), float(ordered[int(np.ceil(position))])
    return below + (position % 1) * (above - below)


def sky_level(image_dn: Float, background: Background, starless: Mask) -> SkyLevel:
    """Return the mean and the standard deviation of the sky between the stars.

    `image_dn` (height, width); `starless` (height, width) bool: pixels without a star.  Teague & Chahl, eq. (40).
    Departs from section 2.5: the noise is measured about the local background, so that a gradient does not count as
    noise, and undetected stars are clipped.  If the background is clipped at 0 DN, a truncated Gaussian is fitted,
    because the simulator clips it again.
    """
    if starless.sum() < _MIN_PIXELS:
        starless = np.ones_like(starless)
    # A sky far above its noise is not clipped: what is black there is the rim of an image circle.
    noise_dn = float(np.median(background.noise_dn[background.is_sky]))
    may_be_clipped = background.level_dn < _CLIPPED_SIGMA * noise_dn
    clipped_fraction = float(((image_dn <= 0) & may_be_clipped)[starless].mean())
    lit_dn = background.level_dn[background.is_sky]
    unevenness = robust_std(lit_dn, float(np.median(lit_dn)))
    if clipped_fraction > _CLIPPED_FRACTION:
        mean, std = _clipped_gaussian(image_dn, starless)
        return SkyLevel(mean, std, unevenness, int(starless.sum()), clipped_fraction)

    above = (image_dn - background.level_dn)[starless]
    centre, std = 0.0, noise_dn
    for _ in range(_CLIPS):
        kept = above[np.abs(above - centre) <= _CLIP_SIGMA * std]
        centre, std = float(kept.mean()), float(kept.std()) / _CLIPPED_STD
    mean = float(background.level_dn[starless].mean()) + centre
    return SkyLevel(mean, float(np.sqrt(max(std**2 - _ROUNDING_DN2, 0.0))), unevenness, len(kept), clipped_fraction)


def _tile_px(shape: tuple[int, ...]) -> int:
    return min(max(_TILE_PX, -(-max(shape) // _MOST_TILES)), *shape)


def _spread(tiles: Float, shape: tuple[int, int]) -> Float:
    """Return values of tiles interpolated to each pixel, after a 3 x 3 median over tiles."""
    side = _tile_px(shape)
    filtered = cv2.medianBlur(tiles.astype(np.float32), 3) if min(tiles.shape) >= 3 else tiles.astype(np.float32)
    size = tiles.shape[1] * side, tiles.shape[0] * side
    return np.asarray(
        cv2.resize(filtered, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]], dtype=np.float64
    )


def _clipped_gaussian(image_dn: Float, starless: Mask) -> tuple[float, float]:
    """Return mean and standard deviation of a Gaussian background clipped at 0: medians over parts of the image."""
    tile_moments = []
    for rows in np.array_split(np.arange(image_dn.shape[0]), _PARTS):
        for columns in np.array_split(np.arange(image_dn.shape[1]), _PARTS):
            part = np.ix_(rows, columns)
            values = image_dn[part][starless[part]]
            if values.size >= _MIN_PIXELS:
                tile_moments.append(_fit_clipped_gaussian(np.rint(values).astype(np.intp)))
    mean, std = np.median(np.array(tile_moments), axis=0)
    return float(mean), float(std)


def _fit_clipped_gaussian(values: NDArray[np.intp]) -> tuple[float, float]:
    """Return the maximum-likelihood Gaussian of integers that are rounded, clipped at 0 and truncated at their top."""
    from scipy.optimize import minimize  # noqa: PLC0415 - takes 0.5 s to load, needed for dark backgrounds only

    top = max(int(np.quantile(values, _STARLESS_QUANTILE)), 1)
    counts = np.bincount(values[values <= top], minlength=top + 1)
    upper = np.arange(top + 1) + 0.5

    def negative_log_likelihood(p: Float) -> float:
        mean, std = p[0], np.exp(p[1])
        cumulative = ndtr((upper - mean) / std)
        fraction = np.diff(cumulative, prepend=0.0) / max(cumulative[-1], 1e-300)
        return -float(np.sum(counts * np.log(np.maximum(fraction, 1e-300))))

    start = np.array([float(np.mean(values[values <= top])), np.log(max(float(np.std(values[values <= top])), 0.5))])
    best = minimize(negative_log_likelihood, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6})
    return max(float(best.x[0]), 0.0), float(np.exp(best.x[1]))


@dataclass(frozen=True, slots=True)
class _Detection:
    """Thresholds of detection."""

    # Smallest signal-to-noise ratio of a peak in the smoothed image.
    peak_snr: float = 5.0
    most_stars: int = 1000
    # Parts along the longer side of an image with more peaks than that.
    parts: int = 16
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


_DETECTION = _Detection()


@dataclass(frozen=True, slots=True, eq=False)
class DetectedStars:
    """Detected stars, the brightest first."""

    xy_px: Float  # (n, 2) centres (x, y); pixel (0, 0) is the centre of the top-left pixel
    # (n,) amplitudes above the sky of Gaussians of width `psf_sigma_px`, DN; lower limits for saturated stars.
    peak_dn: Float
    sigma_px: Float  # (n,) the width of each star, fitted on its own, px
    noise_dn: Float  # (n,) noise of the sky around each star, DN
    saturated: Mask  # (n,) bool: whether a pixel of the star is saturated
    psf_sigma_px: float  # The median width, px; in place of eq. (39)
    background: Background
    sky: SkyLevel  # Of the starless pixels
    drawn_out_px: float  # Length of the stars' trails, px; 0 if the stars are round
    saturated_fraction: float  # Fraction of the image's pixels that are saturated
    hot_pixels: int  # Number of rejected peaks: too narrow for a star, too close to the edge, or not Gaussian
    at_the_edge: int
    shapeless: int

    def __len__(self) -> int:
        return len(self.peak_dn)

    def without(self, removed: NDArray[np.bool_]) -> "DetectedStars":
        """Return the detections without some of them; `removed` (n,) bool."""
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
    """Detect the stars of an image; there may be none.

    Detections are significant peaks of the image smoothed with its PSF.  The renderer's Gaussian
    (`glstar.calibrate.photo.psf`) is fitted to each, first with an individual width and then with the median width of
    all stars, which stabilises the amplitudes of faint stars.
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
    bright = np.flatnonzero(~saturated & ~hot & (fixed.peak_dn > _DETECTION.shape_snr * noise_dn))
    bright = bright[np.argsort(-fixed.peak_dn[bright])]
    # Fragments of a long trail are not stars, but their elongation measures its length.
    lengths_px = (
        drawn_out_px(above, usable, peaks[some], sigma_px) for some in (bright[np.isin(bright, good)], bright)
    )
    starless = _starless(pixels.shape, peaks, fixed.peak_dn, noise_dn, sigma_px) & background.is_sky
    return DetectedStars(
        xy_px=xy_px[order],
        peak_dn=peak_dn[order],
        sigma_px=free.unbiased_sigma_px[order],
        noise_dn=noise_dn[order],
        saturated=saturated[order],
        psf_sigma_px=sigma_px,
        background=background,
        sky=sky_level(pixels, background, starless & usable),
        # Branches, roofs and lamps are elongated too: the stars themselves decide where there are enough of them.
        drawn_out_px=next((length_px for length_px in lengths_px if length_px is not None), 0.0),
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
        sky=sky_level(pixels, background, background.is_sky),
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
    is_peak = (significance == highest) & (significance > _DETECTION.peak_snr)
    rows, columns = np.nonzero(is_peak & background.is_lit)  # elsewhere only hot pixels
    xy = np.column_stack([columns, rows]).astype(np.float64)
    xy = xy[np.argsort(-significance[rows, columns])]
    return _one_each(xy[_most_peaks(xy, max(significance.shape))], ~usable)


def _most_peaks(xy: Float, longer_side_px: int) -> Index:
    """Return which of many peaks are used, (k,), given the highest first: not all of them in leaves or in a town.

    The first half is the highest; the second half is the highest of all parts of the image, in turn.
    """
    if len(xy) <= _DETECTION.most_stars:
        return np.arange(len(xy))
    first = _DETECTION.most_stars // 2
    part = (xy * _DETECTION.parts / longer_side_px).astype(np.intp) @ [1, _DETECTION.parts + 1]
    by_part = np.argsort(part, kind="stable")
    _, start, count = np.unique(part[by_part], return_index=True, return_counts=True)
    rank = np.empty(len(xy), np.intp)
    rank[by_part] = np.arange(len(xy)) - np.repeat(start, count)
    rest = np.arange(first, len(xy))
    rest = rest[np.argsort(rank[rest], kind="stable")][: _DETECTION.most_stars - first]
    return np.sort(np.concatenate([np.arange(first), rest]))


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
