"""The sky behind the stars: its level and its noise, here and there and as a whole."""

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

# The sky is taken to be even over this, px; no more than so many pixels of a tile are looked at.
_TILE_PX: Final = 64
_MOST_TILES: Final = 32
_CLIP_SIGMA: Final = 3.0
_CLIPS: Final = 5
# What clipping a Gaussian at 3 sigma leaves of its standard deviation.
_CLIPPED_STD: Final = float(np.sqrt(1 - 6 * np.exp(-4.5) / np.sqrt(2 * np.pi) / (ndtr(3) - ndtr(-3))))
# Rounding to whole DN adds this to the variance, DN^2.
_ROUNDING_DN2: Final = 1 / 12
# From this share of the sky's pixels at 0 on, the noise is clipped and must be fitted as such.
_CLIPPED_SHARE: Final = 0.005
# Such a sky is fitted in so many parts each way, and in each up to this quantile, above which stars are.
_PARTS: Final = 4
_STARLESS_QUANTILE: Final = 0.97
_LEAST_PIXELS: Final = 100


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """The sky under every pixel.

    Attributes
    ----------
    level_dn : (height, width) float64
        DN.
    noise_dn : (height, width) float64
        Standard deviation of its noise, DN.
    """

    level_dn: Float
    noise_dn: Float


@dataclass(frozen=True, slots=True)
class SkyLevel:
    """The sky of a whole image, as `glstar.camera.sensor.Sensor` means it.

    Attributes
    ----------
    mean_dn, std_dn : float
        The Gaussian of eq. (40), before it is rounded and clipped at 0, DN.
    unevenness_dn : float
        How much the level differs from place to place, standard deviation, DN: gradients and vignetting, which the
        sensor's one number does not tell.
    pixels : int
        How many pixels it was measured on.
    clipped_share : float
        The share of them that is 0.
    """

    mean_dn: float
    std_dn: float
    unevenness_dn: float
    pixels: int
    clipped_share: float


def background_of(image_dn: Float) -> Background:
    """Return the sky's level and noise at every pixel, blind to stars.

    Parameters
    ----------
    image_dn : (height, width) float64

    Returns
    -------
    Background
        Clipped means of tiles, a median over neighbours, and smooth in between.
    """
    level, noise = tile_statistics(image_dn)
    return Background(_spread(level, image_dn.shape), np.maximum(_spread(noise, image_dn.shape), 0.05))


def tile_statistics(image: Float) -> tuple[Float, Float]:
    """Return the mean and the standard deviation of each tile of an image, stars clipped away.

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
    """Return the mean and the standard deviation of values in order, those far off clipped away."""
    low, middle, high = (_quantile(ordered, share) for share in (0.25, 0.5, 0.75))
    above = ordered.astype(np.float64) - middle
    # In order, a clip is a pair of places and a difference of sums.
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


def _quantile(ordered: NDArray[np.float32], share: float) -> float:
    """Return a quantile of values that are in order."""
    place = share * (len(ordered) - 1)
    below, above = float(ordered[int(place)]), float(ordered[int(np.ceil(place))])
    return below + (place % 1) * (above - below)


def sky_level(image_dn: Float, background: Background, starless: Mask) -> SkyLevel:
    """Return the mean and the standard deviation of the sky where there are no stars.

    Parameters
    ----------
    image_dn : (height, width) float64
    background : Background
    starless : (height, width) bool
        Where no star was found.

    Returns
    -------
    SkyLevel

    Notes
    -----
    Teague & Chahl, eq. (40).  Departs from section 2.5: the noise is that of pixels about the sky around them, so that
    a gradient is not taken for noise; stars too faint to be found are clipped; and where 0 cuts the noise off, the
    Gaussian that was cut is fitted, for the simulator will cut it again.
    """
    if starless.sum() < _LEAST_PIXELS:
        starless = np.ones_like(starless)
    clipped_share = float((image_dn[starless] <= 0).mean())
    unevenness = robust_std(background.level_dn, float(np.median(background.level_dn)))
    if clipped_share > _CLIPPED_SHARE:
        mean, std = _cut_gaussian(image_dn, starless)
        return SkyLevel(mean, std, unevenness, int(starless.sum()), clipped_share)

    above = (image_dn - background.level_dn)[starless]
    std = float(np.median(background.noise_dn))
    centre = 0.0
    for _ in range(_CLIPS):
        kept = above[np.abs(above - centre) <= _CLIP_SIGMA * std]
        centre, std = float(kept.mean()), float(kept.std()) / _CLIPPED_STD
    mean = float(background.level_dn[starless].mean()) + centre
    return SkyLevel(mean, float(np.sqrt(max(std**2 - _ROUNDING_DN2, 0.0))), unevenness, len(kept), clipped_share)


def _tile_px(shape: tuple[int, ...]) -> int:
    return min(max(_TILE_PX, -(-max(shape) // _MOST_TILES)), *shape)


def _spread(tiles: Float, shape: tuple[int, int]) -> Float:
    """Return what tiles say, at every pixel, after a median over each tile and its neighbours."""
    side = _tile_px(shape)
    calm = cv2.medianBlur(tiles.astype(np.float32), 3) if min(tiles.shape) >= 3 else tiles.astype(np.float32)
    size = tiles.shape[1] * side, tiles.shape[0] * side
    return np.asarray(cv2.resize(calm, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]], dtype=np.float64)


def _cut_gaussian(image_dn: Float, starless: Mask) -> tuple[float, float]:
    """Return the mean and standard deviation of a Gaussian sky that 0 cuts off: the medians over parts of the image."""
    found = []
    for rows in np.array_split(np.arange(image_dn.shape[0]), _PARTS):
        for columns in np.array_split(np.arange(image_dn.shape[1]), _PARTS):
            part = np.ix_(rows, columns)
            values = image_dn[part][starless[part]]
            if values.size >= _LEAST_PIXELS:
                found.append(_fit_cut_gaussian(np.rint(values).astype(np.intp)))
    mean, std = np.median(np.array(found), axis=0)
    return float(mean), float(std)


def _fit_cut_gaussian(values: NDArray[np.intp]) -> tuple[float, float]:
    """Return the Gaussian most likely to give these whole numbers once rounded, cut off at 0 and at their top."""
    from scipy.optimize import minimize  # noqa: PLC0415 - half a second to load, for dark skies only

    top = max(int(np.quantile(values, _STARLESS_QUANTILE)), 1)
    counts = np.bincount(values[values <= top], minlength=top + 1)
    upper = np.arange(top + 1) + 0.5

    def unlikelihood(p: Float) -> float:
        mean, std = p[0], np.exp(p[1])
        reached = ndtr((upper - mean) / std)
        share = np.diff(reached, prepend=0.0) / max(reached[-1], 1e-300)
        return -float(np.sum(counts * np.log(np.maximum(share, 1e-300))))

    start = np.array([float(np.mean(values[values <= top])), np.log(max(float(np.std(values[values <= top])), 0.5))])
    best = minimize(unlikelihood, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6})
    return max(float(best.x[0]), 0.0), float(np.exp(best.x[1]))
