"""The sky of a photograph: its brightness over the image, its noise against that brightness, and the gamma it shows."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import ndtr

from glstar.arrays import Float, Mask
from glstar.calibrate.photo.detection import DetectedStars
from glstar.calibrate.photo.photograph import Photograph

# Radius that a star hides, px plus sigma, and its growth with each factor of e in brightness over the noise, sigma.
_STAR_PX = 3.0
_STAR_SIGMA = 2.5
_STAR_GROWTH_SIGMA = 0.8
# Side of a texel of the map, px, of images up to this width; larger images have as many texels.
_TEXEL_PX = 16
_MOST_TEXELS = 128
# Pixels this far off their surroundings, standard deviations, are no sky: faint stars and hot pixels.
_CLIP_SIGMA = 3.5
_CLIPS = 4
# Standard deviation of a Gaussian clipped at 3.5 sigma, over that of the whole Gaussian.
_CLIPPED_STD = float(np.sqrt(1 - 7 * np.exp(-6.125) / np.sqrt(2 * np.pi) / (ndtr(3.5) - ndtr(-3.5))))
_ROUNDING_DN2 = 1 / 12
# The noise is measured at this number of levels, on blocks of this side, px.
_LEVELS = 12
_BLOCK_PX = 32
_LEAST_BLOCKS = 24
_LEAST_BLOCK_FRACTION = 0.3
# From this number of standard deviations on, noise that grows with the level counts as shot noise.
_SIGNIFICANT = 4.0
# From this fraction of pixels at 0 DN on, the levels are those of a Gaussian cut off at 0.
_CLIPPED_FRACTION = 0.002


@dataclass(frozen=True, slots=True, eq=False)
class SkyMap:
    """The level of the sky over an image."""

    texels_dn: Float  # (rows, columns) level on a grid that covers the image, black level included, DN
    level_dn: Float  # (height, width) the same at each pixel, as the renderer interpolates it
    residual_dn: Float  # (height, width) the image minus that
    is_sky: Mask  # (height, width) bool: pixels without stars
    error_dn: float  # Standard error of a texel, DN


@dataclass(frozen=True, slots=True, eq=False)
class NoiseAgainstLevel:
    """Variance of the pixels of a sky against its level: photon transfer inside one image."""

    level_dn: Float  # (n,) medians of blocks, by level; DN and DN^2, without the rounding
    variance_dn2: Float
    variance_error_dn2: Float  # (n,) standard errors
    dn_per_e: float  # Slope of the fitted line and its standard error, DN/e
    dn_per_e_error: float
    at_zero_dn2: float  # The line at 0 DN

    @property
    def is_shot_noise(self) -> bool:
        """Whether the noise grows with the level, beyond doubt."""
        return self.dn_per_e > _SIGNIFICANT * self.dn_per_e_error

    def variance_at_dn2(self, level_dn: Float) -> Float:
        """Return the fitted variance at levels, DN^2."""
        return np.asarray(np.maximum(self.at_zero_dn2 + self.dn_per_e * level_dn, 1e-3))


def starless_pixels(image: Photograph, detected: DetectedStars, more_px: Float) -> Mask:
    """Return the pixels of the sky away from all stars.

    `more_px` (n, 2): positions of other stars, such as those of the catalogue, px.  Returns (height, width) bool.
    """
    hidden = np.zeros(image.pixels_dn.shape, np.uint8)
    sigma_px = max(detected.psf_sigma_px, 0.7)
    brightness = np.log(np.maximum(detected.signal_to_noise, 1.0))
    radii = _STAR_PX + sigma_px * (_STAR_SIGMA + _STAR_GROWTH_SIGMA * brightness)
    radii = np.where(detected.saturated, 1.6 * radii, radii)
    all_px = np.concatenate([detected.xy_px, more_px])
    all_radii = np.concatenate([radii, np.full(len(more_px), _STAR_PX + _STAR_SIGMA * sigma_px)])
    for (x, y), radius in zip(np.rint(all_px).astype(int).tolist(), all_radii.tolist(), strict=True):
        cv2.circle(hidden, (x, y), round(radius), 1, -1)
    is_dark = (hidden == 0) & (image.pixels_dn < 0.98 * image.saturation_dn)
    return np.asarray(is_dark & detected.background.is_sky)


def measure_sky(image: Photograph, detected: DetectedStars, more_px: Float) -> SkyMap:
    """Return the level of the sky over an image.

    `more_px` (n, 2): positions of undetected stars, px.  A mean of the starless pixels around each texel, weighted
    with a Gaussian of half a texel, clipped at 3.5 standard deviations.  Where the sky is cut off at 0 DN, the level is
    the mean of the Gaussian before the cut.
    """
    pixels = image.pixels_dn
    is_sky = starless_pixels(image, detected, more_px)
    side = max(_TEXEL_PX, -(-max(pixels.shape) // _MOST_TEXELS))
    level, noise = detected.background.level_dn, detected.background.noise_dn
    for _ in range(_CLIPS):
        good = is_sky & (np.abs(pixels - level) < _CLIP_SIGMA * np.maximum(noise, 0.7))
        texels, error = _smoothed(np.where(good, pixels, 0.0), good, side, detected.background.level_dn)
        level = _at_pixels(texels, pixels.shape)
    if (pixels[is_sky] <= 0).mean() > _CLIPPED_FRACTION:
        variance, _ = _smoothed(np.where(good, (pixels - level) ** 2, 0.0), good, side, noise**2)
        texels = before_clipping(texels, np.sqrt(np.maximum(variance, 1e-2)))[0]
        level = _at_pixels(texels, pixels.shape)
    return SkyMap(texels, level, pixels - level, is_sky, float(error * np.median(noise)))


def _smoothed(values: Float, good: Mask, side: int, elsewhere: Float) -> tuple[Float, float]:
    """Return weighted means of the good pixels around each texel, and their standard error for a noise of 1."""
    sigma = side / 2
    # The surroundings count a little: they fill the places that stars hide.
    weight = good.astype(np.float64) + 1e-3
    total = cv2.GaussianBlur(values + 1e-3 * elsewhere, (0, 0), sigma)
    mean = total / cv2.GaussianBlur(weight, (0, 0), sigma)
    size = -(-values.shape[1] // side), -(-values.shape[0] // side)
    texels = cv2.resize(mean, size, interpolation=cv2.INTER_AREA)
    return np.asarray(texels, dtype=np.float64), 1 / (2 * np.sqrt(np.pi) * np.hypot(sigma, side / 3.5))


def _at_pixels(texels: Float, shape: tuple[int, int]) -> Float:
    return np.asarray(cv2.resize(texels, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float64)


def before_clipping(cut_mean: Float, cut_std: Float) -> tuple[Float, Float]:
    """Return mean and standard deviation of Gaussians whose values below 0 became 0.

    `cut_mean`, `cut_std` (...): mean and standard deviation afterwards, DN.  Returns `mean, std` (...): DN; the mean is
    at least -2 standard deviations.
    """
    z = np.linspace(-2.0, 6.0, 801)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    mean = z * ndtr(z) + density
    std = np.sqrt((z**2 + 1) * ndtr(z) + z * density - mean**2)
    at = np.interp(cut_mean / np.maximum(cut_std, 1e-6), mean / std, z)
    true_std = cut_std / np.interp(at, z, std)
    return np.where(at < z[-1], at * true_std, cut_mean), true_std


def measure_noise(sky: SkyMap) -> NoiseAgainstLevel | None:
    """Return the noise of the sky against its level; None if there is too little sky.

    EMVA 1288, eq. (9): the variance grows by the gain K for each DN.  A line is fitted to the variances of blocks of
    pixels, clipped at 3.5 standard deviations, with weights from their scatter.
    """
    height, width = (length // _BLOCK_PX * _BLOCK_PX for length in sky.level_dn.shape)
    blocks = [
        np.swapaxes(
            array[:height, :width].reshape(height // _BLOCK_PX, _BLOCK_PX, width // _BLOCK_PX, _BLOCK_PX), 1, 2
        ).reshape(-1, _BLOCK_PX**2)
        for array in (sky.level_dn, sky.residual_dn, sky.is_sky)
    ]
    enough = blocks[2].mean(axis=1) > _LEAST_BLOCK_FRACTION
    if enough.sum() < _LEAST_BLOCKS:
        return None
    level, residual, is_sky = (block[enough] for block in blocks)
    levels = np.array([one[good].mean() for one, good in zip(level, is_sky, strict=True)])
    variance = _clipped_variance(residual, is_sky)
    at_zero = is_sky & (level + residual <= 0)
    cut = at_zero.sum(axis=1) > _CLIPPED_FRACTION * is_sky.sum(axis=1)
    if cut.any():
        means = np.array([(one + more)[good].mean() for one, more, good in zip(level, residual, is_sky, strict=True)])
        whole = before_clipping(means, np.sqrt(variance + _ROUNDING_DN2))
        levels = np.where(cut, whole[0], levels)
        variance = np.where(cut, np.maximum(whole[1] ** 2 - _ROUNDING_DN2, 1e-3), variance)
    order = np.array_split(np.argsort(levels), min(_LEVELS, len(levels) // 8))
    x = np.array([np.mean(levels[k]) for k in order])
    y = np.array([np.median(variance[k]) for k in order])
    error = np.array([1.25 * np.std(variance[k]) / np.sqrt(len(k)) for k in order])
    error = np.maximum(error, y * np.sqrt(2 / (_BLOCK_PX**2 * np.array([len(k) for k in order]))))
    design = np.column_stack([np.ones_like(x), x]) / error[:, np.newaxis]
    inverse = np.linalg.pinv(design.T @ design)
    p = inverse @ (design.T @ (y / error))
    excess = float(np.sum((y / error - design @ p) ** 2)) / max(len(x) - 2, 1)
    return NoiseAgainstLevel(x, y, error, float(p[1]), float(np.sqrt(inverse[1, 1] * max(excess, 1.0))), float(p[0]))


def _clipped_variance(residual: Float, is_sky: Mask) -> Float:
    """Return the variance of each block's sky without outliers and without rounding."""
    good, std = is_sky.copy(), np.full(len(residual), np.inf)
    mean = np.zeros(len(residual))
    for _ in range(_CLIPS + 1):
        good = is_sky & (np.abs(residual - mean[:, np.newaxis]) < _CLIP_SIGMA * std[:, np.newaxis])
        count = np.maximum(good.sum(axis=1), 2)
        mean = np.where(good, residual, 0.0).sum(axis=1) / count
        square = np.where(good, (residual - mean[:, np.newaxis]) ** 2, 0.0).sum(axis=1) / (count - 1)
        std = np.maximum(np.sqrt(square) / _CLIPPED_STD, 0.3)
    return np.asarray(np.maximum(square / _CLIPPED_STD**2 - _ROUNDING_DN2, 1e-3))


# Gammas that are tried: from much darker to much brighter than a screen's 2.2, in steps of 0.5 %.
_GAMMAS = np.exp(np.arange(np.log(0.25), np.log(4.0), 0.005))
# Levels whose variance is smaller than this are not used, DN^2: the rounding to whole numbers is not noise.
_LEAST_VARIANCE_DN2 = 1.0
_LEAST_LEVELS_OF_GAMMA = 5
# The variance of a level is right to this fraction: the sky is not quite smooth inside a block.
_LEVEL_VARIANCE_ERROR = 0.05


class GammaFit(NamedTuple):
    """The gamma of a tone curve by the noise of an image."""

    value: float  # The one nearest to 1 that the noise allows, within one standard error; 1 if it allows a linear image
    low: float  # The range that it allows, within two standard errors
    high: float


def fit_gamma(image: Photograph, detected: DetectedStars) -> GammaFit:
    """Return the gamma of a photograph's tone curve, by the noise of its sky; `image`: as recorded."""
    noise = measure_noise(measure_sky(image, detected, np.zeros((0, 2))))
    return _ANY_GAMMA if noise is None else gamma_of_noise(noise, image.saturation_dn)


def gamma_of_noise(noise: NoiseAgainstLevel, white_dn: float) -> GammaFit:
    """Return the gamma with which the variance of the light grows linearly with the light.

    `noise`: as recorded; `white_dn`: the largest digital number.  Photon transfer, EMVA 1288 eq. (9), in the light x =
    (DN / white)^g: the variance of DN times (dx / dDN)^2 is a line with an intercept, the read noise, and a slope, the
    gain, that are not negative.  Read noise and gamma bend the line alike: that with the least gamma is taken.
    """
    used = (noise.variance_dn2 > _LEAST_VARIANCE_DN2) & (noise.level_dn > 0)
    if used.sum() < _LEAST_LEVELS_OF_GAMMA:
        return _ANY_GAMMA
    level, variance = noise.level_dn[used] / white_dn, noise.variance_dn2[used]
    error = np.hypot(noise.variance_error_dn2[used] / variance, _LEVEL_VARIANCE_ERROR)
    chi2 = np.array(
        [_misfit_of_gamma(level**g, variance * (g * level ** (g - 1)) ** 2, error) for g in _GAMMAS.tolist()]
    )
    unit = max(1.0, float(chi2.min()) / int(used.sum() - 3))
    near, allowed = (_GAMMAS[chi2 <= chi2.min() + count * unit] for count in (1, 4))
    low, high = float(allowed.min()), float(allowed.max())
    value = 1.0 if low <= 1 <= high else float(near[np.abs(np.log(near)).argmin()])
    return GammaFit(value, low, high)


_ANY_GAMMA = GammaFit(1.0, float(_GAMMAS[0]), float(_GAMMAS[-1]))


def _misfit_of_gamma(light: Float, variance: Float, relative_error: Float) -> float:
    """Return the sum of squares of variances off a line whose intercept and slope are not negative."""
    design = np.column_stack([np.ones_like(light), light]) / (relative_error * variance)[:, np.newaxis]
    ones = 1 / relative_error
    trials = []
    for columns in ([0, 1], [0], [1]):
        solution = np.linalg.lstsq(design[:, columns], ones, rcond=None)[0]
        if (solution >= 0).all():
            trials.append(float(np.sum((ones - design[:, columns] @ solution) ** 2)))
    return min(trials)
