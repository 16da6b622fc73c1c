"""Wings and ellipticity of the stars of a photograph."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.misfit import WING_RADIUS_SIGMA, Measurement, RadialProfile
from glstar.calibrate.photograph import Photograph
from glstar.calibrate.psf import fit_stars, profile
from glstar.calibrate.shape import star_shapes
from glstar.camera.sensor import PIXEL_VARIANCE_PX2

__all__ = ["measure_ellipticity", "measure_wings"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# Wings are measured up to this radius, and the sky beneath them between the next two, in sigma as the pixels record it.
_OUTER_SIGMA: Final = 8.0
_SKY_RING_SIGMA: Final = (9.0, 12.0)
# Pixels this close to another star are excluded, sigma.
_NEIGHBOUR_SIGMA: Final = 5.0
# The sky ring and the wings need this number of pixels each.
_MIN_PIXELS: Final = 40
# A star's weight grows with its signal-to-noise ratio up to this.
_WEIGHT_SNR: Final = 60.0
# A typical shape needs this number of stars.
_MIN_STARS: Final = 8
# Bootstrap samples: they determine a standard error to 5 %.
_RESAMPLED: Final = 200
# Pixels above this fraction of the largest number may be saturated.
_USABLE_FRACTION: Final = 0.98


def measure_wings(
    image: Photograph, detected: DetectedStars, chosen: Index, sigma_px: float, signal: Float
) -> tuple[Measurement | None, RadialProfile | None]:
    """Return the excess flux in the wings over the flux of the Gaussian, and the mean profile."""
    above = image.pixels_dn - detected.background.level_dn
    usable = image.pixels_dn < _USABLE_FRACTION * image.saturation_dn
    fits = fit_stars(above, usable, detected.xy_px, start_sigma_px=sigma_px, only=chosen)
    edges = np.linspace(0, _OUTER_SIGMA, 17)
    wings, weights, profiles = [], [], []
    for k, star in enumerate(chosen):
        measured = _star_profile(above, usable, detected.xy_px, int(star), float(fits.sigma_px[k]), fits.xy_px[k])
        if measured is None or not fits.converged[k]:
            continue
        radius, light, gaussian = measured
        peak = float(fits.peak_dn[k])
        outside = (radius >= WING_RADIUS_SIGMA) & (radius < _OUTER_SIGMA)
        sigma2 = float(fits.sigma_px[k]) ** 2
        # The mean of the usable pixels replaces pixels hidden by neighbours.
        area = np.pi * (_OUTER_SIGMA**2 - WING_RADIUS_SIGMA**2) * (sigma2 + PIXEL_VARIANCE_PX2)
        wings.append(area * float(np.mean(light[outside] - peak * gaussian[outside])) / (2 * np.pi * sigma2 * peak))
        weights.append(min(signal[k], _WEIGHT_SNR) ** 2)
        count = np.histogram(radius, edges)[0]
        recorded_peak = peak * sigma2 / (sigma2 + PIXEL_VARIANCE_PX2)
        total = np.histogram(radius, edges, weights=light / recorded_peak)[0]
        profiles.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    if len(wings) < _MIN_STARS:
        return None, None
    values, heavy = np.array(wings), np.array(weights)
    resampled = np.random.default_rng(0).integers(0, len(values), (_RESAMPLED, len(values)))
    spread = float(np.std([_weighted_median(values[some], heavy[some]) for some in resampled]))
    stacked = RadialProfile((edges[1:] + edges[:-1]) / 2, np.nanmedian(np.array(profiles), axis=0))
    return Measurement(_weighted_median(values, heavy), spread), stacked


def _star_profile(
    above: Float, usable: NDArray[np.bool_], xy_px: Float, star: int, sigma_px: float, centre: Float
) -> tuple[Float, Float, Float] | None:
    """Return the radii (sigma) of the pixels of a star, their values above the sky ring, and those of a Gaussian."""
    recorded_px = float(np.sqrt(sigma_px**2 + PIXEL_VARIANCE_PX2))
    half = int(np.ceil(_SKY_RING_SIGMA[1] * recorded_px)) + 1
    column, row = (round(float(value)) for value in centre)
    if min(column, row) < half or column + half >= above.shape[1] or row + half >= above.shape[0]:
        return None
    x, y = np.arange(column - half, column + half + 1), np.arange(row - half, row + half + 1)
    part = np.ix_(y, x)
    radius = np.hypot(x - centre[0], (y - centre[1])[:, np.newaxis]) / recorded_px
    good = usable[part].copy()
    others = np.delete(xy_px, star, axis=0)
    for near in others[(np.abs(others - centre) < half + _NEIGHBOUR_SIGMA * recorded_px).all(axis=1)]:
        good &= np.hypot(x - near[0], (y - near[1])[:, np.newaxis]) > _NEIGHBOUR_SIGMA * recorded_px
    ring = good & (radius >= _SKY_RING_SIGMA[0]) & (radius < _SKY_RING_SIGMA[1])
    wing = good & (radius >= WING_RADIUS_SIGMA) & (radius < _OUTER_SIGMA)
    if min(ring.sum(), wing.sum()) < _MIN_PIXELS:
        return None
    gaussian = np.outer(profile(y - centre[1], sigma_px), profile(x - centre[0], sigma_px))
    inside = good & (radius < _OUTER_SIGMA)
    return radius[inside], above[part][inside] - float(np.mean(above[part][ring])), gaussian[inside]


def _weighted_median(values: Float, weights: Float) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - weights[order] / 2
    return float(np.interp(weights.sum() / 2, below, values[order]))


def measure_ellipticity(
    image: Photograph, detected: DetectedStars, xy_px: Float, sigma_px: float
) -> tuple[Measurement | None, float]:
    """Return the ellipticity of the mean star without the pixel's own width, and the direction of its long axis."""
    above = image.pixels_dn - detected.background.level_dn
    usable = image.pixels_dn < _USABLE_FRACTION * image.saturation_dn
    xx, yy, xy = star_shapes(above, usable, xy_px, sigma_px)
    size = xx + yy - 2 * PIXEL_VARIANCE_PX2
    good = size > 0.1 * sigma_px**2
    if good.sum() < _MIN_STARS:
        return None, 0.0
    parts = np.column_stack([(xx - yy)[good], 2 * xy[good]]) / float(np.median(size[good]))
    resampled = np.random.default_rng(0).integers(0, len(parts), (_RESAMPLED, len(parts)))
    error = float(np.median(parts[resampled], axis=1).std(axis=0).max())
    e1, e2 = np.median(parts, axis=0)
    return Measurement(float(np.hypot(e1, e2)), error), float(np.arctan2(e2, e1) / 2 % np.pi)
