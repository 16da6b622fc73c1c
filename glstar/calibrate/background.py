"""Level and noise of the sky background, at each pixel and over the whole image."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from glstar.statistics import robust_std

__all__ = ["Background", "SkyLevel", "background_of", "sky_level", "tile_statistics"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Side of a background tile, px. Larger images have larger tiles with the same number of sampled pixels.
_TILE_PX: Final = 64
_MOST_TILES: Final = 32
_CLIP_SIGMA: Final = 3.0
_CLIPS: Final = 5
# Standard deviation of a Gaussian clipped at 3 sigma, over that of the whole Gaussian.
_CLIPPED_STD: Final = float(np.sqrt(1 - 6 * np.exp(-4.5) / np.sqrt(2 * np.pi) / (ndtr(3) - ndtr(-3))))
# Rounding to whole DN adds this to the variance, DN^2.
_ROUNDING_DN2: Final = 1 / 12
# From this fraction of pixels at 0 on, the background is clipped and a truncated Gaussian is fitted.
_CLIPPED_FRACTION: Final = 0.005
# The fit divides the image into this many parts in x and in y, and uses each up to this quantile: brighter pixels
# are stars.
_PARTS: Final = 4
_STARLESS_QUANTILE: Final = 0.97
_MIN_PIXELS: Final = 100


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The background at each pixel.

    Attributes
    ----------
    level_dn : (height, width) float64
        DN.
    noise_dn : (height, width) float64
        Standard deviation of the noise, DN.
    """

    level_dn: Float
    noise_dn: Float


@dataclass(frozen=True, slots=True)
class SkyLevel:
    """The background of a whole image, as in `glstar.camera.sensor.Sensor`.

    Attributes
    ----------
    mean_dn, std_dn : float
        The Gaussian of eq. (40), before rounding and clipping at 0, DN.
    unevenness_dn : float
        Standard deviation of the level over the image, DN: gradients and vignetting, which the sensor model lacks.
    pixels : int
        Number of pixels that were measured.
    clipped_fraction : float
        Fraction of them that are 0.
    """

    mean_dn: float
    std_dn: float
    unevenness_dn: float
    pixels: int
    clipped_fraction: float


def background_of(image_dn: Float) -> Background:
    """Return the level and the noise of the background at each pixel.

    Parameters
    ----------
    image_dn : (height, width) float64

    Returns
    -------
    Background
        Clipped means of tiles, median-filtered over neighbouring tiles and interpolated.
    """
    level, noise = tile_statistics(image_dn)
    return Background(_spread(level, image_dn.shape), np.maximum(_spread(noise, image_dn.shape), 0.05))


def tile_statistics(image: Float) -> tuple[Float, Float]:
    """Return the clipped mean and standard deviation of each tile of an image.

    Parameters
    ----------
    image : (height, width) float64

    Returns
    -------
    mean, std : (rows, columns) float64
    """
    side = _tile_px(image.shape)
    rows, columns = (-(-length // side) for length in image.shape)
    padded = np.pad(image, ((0, rows * side - image.shape[0]), (0, columns * side - image.shape[1])), mode="reflect")
    stride = max(1, side // _TILE_PX)
    tiles = padded.reshape(rows, side, columns, side)[:, ::stride, :, ::stride]
    values = np.sort(np.swapaxes(tiles, 1, 2).reshape(rows, columns, -1).astype(np.float32), axis=-1)
    found = np.array([_clipped(tile) for tile in values.reshape(rows * columns, -1)])
    return found[:, 0].reshape(rows, columns), found[:, 1].reshape(rows, columns)


def _clipped(ordered: NDArray[np.float32]) -> tuple[float, float]:
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

    Parameters
    ----------
    image_dn : (height, width) float64
    background : Background
    starless : (height, width) bool
        Pixels without a star.

    Returns
    -------
    SkyLevel

    Notes
    -----
    Teague & Chahl, eq. (40).  Departs from section 2.5: the noise is measured about the local background,
    so that a gradient does not count as noise; undetected stars are clipped; and if the background is clipped at
    0 DN, a truncated Gaussian is fitted, because the simulator clips it again.
    """
    if starless.sum() < _MIN_PIXELS:
        starless = np.ones_like(starless)
    clipped_fraction = float((image_dn[starless] <= 0).mean())
    unevenness = robust_std(background.level_dn, float(np.median(background.level_dn)))
    if clipped_fraction > _CLIPPED_FRACTION:
        mean, std = _clipped_gaussian(image_dn, starless)
        return SkyLevel(mean, std, unevenness, int(starless.sum()), clipped_fraction)

    above = (image_dn - background.level_dn)[starless]
    std = float(np.median(background.noise_dn))
    centre = 0.0
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
    found = []
    for rows in np.array_split(np.arange(image_dn.shape[0]), _PARTS):
        for columns in np.array_split(np.arange(image_dn.shape[1]), _PARTS):
            part = np.ix_(rows, columns)
            values = image_dn[part][starless[part]]
            if values.size >= _MIN_PIXELS:
                found.append(_fit_clipped_gaussian(np.rint(values).astype(np.intp)))
    mean, std = np.median(np.array(found), axis=0)
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
