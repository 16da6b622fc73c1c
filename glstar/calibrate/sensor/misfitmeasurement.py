"""Measurement of effects that the sensor model lacks: in the profiles of stars, their brightness, sky and noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Index, robust_std
from glstar.calibrate.identify.platesolution import Matches
from glstar.calibrate.photo.detection import DetectedStars
from glstar.calibrate.photo.photograph import Photograph
from glstar.calibrate.photo.psf import fit_stars, profile, star_shapes
from glstar.calibrate.sensor.fit import BrightnessFit, MeasuredStars
from glstar.calibrate.sensor.misfit import WING_RADIUS_SIGMA, Measurement, Misfit, RadialProfile
from glstar.camera.sensor.sensor import PIXEL_VARIANCE_PX2, Sensor

# Wings are measured up to this radius, and the sky beneath them between the next two, in sigma as the pixels record it.
_OUTER_SIGMA = 8.0
_SKY_RING_SIGMA = (9.0, 12.0)
# Pixels this close to another star are excluded, sigma.
_NEIGHBOUR_SIGMA = 5.0
# The sky ring and the wings need this number of pixels each.
_MIN_RING_PIXELS = 40
# A star's weight grows with its signal-to-noise ratio up to this.
_WEIGHT_SNR = 60.0
# A typical shape needs this number of stars.
_MIN_PROFILE_STARS = 8
# Bootstrap samples: they determine a standard error to 5 %.
_RESAMPLED = 200
# Pixels above this fraction of the largest number may be saturated.
_USABLE_FRACTION = 0.98


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
    if len(wings) < _MIN_PROFILE_STARS:
        return None, None
    values, heavy = np.array(wings), np.array(weights)
    resampled = np.random.default_rng(0).integers(0, len(values), (_RESAMPLED, len(values)))
    spread = float(np.std([_weighted_median(values[sample], heavy[sample]) for sample in resampled]))
    stacked = RadialProfile((edges[1:] + edges[:-1]) / 2, np.nanmedian(np.array(profiles), axis=0))
    return Measurement(_weighted_median(values, heavy), spread), stacked


def _star_profile(
    above: Float, usable: NDArray[np.bool_], xy_px: Float, star: int, sigma_px: float, centre: Float
) -> tuple[Float, Float, Float] | None:
    """Return the radii (sigma) of the pixels of a star, their values above the sky ring, and a Gaussian's values."""
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
    if min(ring.sum(), wing.sum()) < _MIN_RING_PIXELS:
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
    if good.sum() < _MIN_PROFILE_STARS:
        return None, 0.0
    parts = np.column_stack([(xx - yy)[good], 2 * xy[good]]) / float(np.median(size[good]))
    resampled = np.random.default_rng(0).integers(0, len(parts), (_RESAMPLED, len(parts)))
    error = float(np.median(parts[resampled], axis=1).std(axis=0).max())
    e1, e2 = np.median(parts, axis=0)
    return Measurement(float(np.hypot(e1, e2)), error), float(np.arctan2(e2, e1) / 2 % np.pi)


# Noise is examined in patches of this side, px, in a square grid of this many per side.
_PATCH_PX = 192
_PATCHES = 4
# Pixels this many standard deviations off the sky belong to stars.
_STAR_SIGMA = 3.5
# A patch needs this number of starless pixels.
_MIN_PATCH_PIXELS = 2000
# The correlation at this lag, px, is due to residual structure of the background; it is subtracted.
_FAR_LAG_PX = 6


def measure_noise_structure(
    image: Photograph, detected: DetectedStars
) -> tuple[Measurement | None, Measurement | None]:
    """Return the correlation of neighbouring pixels and the spread on the 2 x 2 lattice: medians over patches."""
    height, width = image.pixels_dn.shape
    side = min(_PATCH_PX, height, width) // 2 * 2
    correlations, lattices = [], []
    # Patches of a small image coincide: each counts once.
    tops, lefts = (
        np.unique(np.linspace(0, free, _PATCHES).astype(int) // 2 * 2) for free in (height - side, width - side)
    )
    for top in tops:
        for left in lefts:
            part = slice(top, top + side), slice(left, left + side)
            above = image.pixels_dn[part] - detected.background.level_dn[part]
            noise_dn = float(np.median(detected.background.noise_dn[part]))
            near = detected.xy_px - (left, top)
            noise = _patch_noise(above, noise_dn, near, detected.psf_sigma_px)
            if noise is not None:
                correlations.append(noise[0])
                lattices.append(noise[1])
    if len(correlations) < _PATCHES:
        return None, None
    count = float(np.sqrt(len(correlations)))
    variances = np.array(lattices)
    middle = np.median(variances, axis=0)
    # The standard error of a median is 1.25 times that of the mean.
    error = 1.25 * float(variances.std(axis=0, ddof=1).max()) / count
    ratio = float(np.sqrt(middle.max() / middle.min()))
    return (
        Measurement(float(np.median(correlations)), 1.25 * float(np.std(correlations, ddof=1)) / count),
        Measurement(ratio - 1, ratio * error / float(middle.min() * np.sqrt(2))),
    )


def _patch_noise(above: Float, noise_dn: float, xy_px: Float, sigma_px: float) -> tuple[float, Float] | None:
    """Return the correlation of neighbours, and the noise variance of the lattice's four pixels over their mean."""
    starless = np.abs(above) < _STAR_SIGMA * max(noise_dn, 0.3)
    radius = 5 * sigma_px + 2
    for x, y in xy_px[((xy_px > -radius) & (xy_px < len(above) + radius)).all(axis=1)]:
        rows = slice(max(0, int(y - radius)), max(0, int(y + radius) + 1))
        columns = slice(max(0, int(x - radius)), max(0, int(x + radius) + 1))
        starless[rows, columns] = False
    if starless.sum() < _MIN_PATCH_PIXELS:
        return None
    residual = np.where(starless, above - above[starless].mean(), 0.0)
    variance = float((residual**2).sum() / starless.sum())
    phases = [(slice(row, None, 2), slice(column, None, 2)) for row in (0, 1) for column in (0, 1)]
    counts = np.array([starless[phase].sum() for phase in phases])
    lattice = np.array([(residual[phase] ** 2).sum() for phase in phases]) / np.maximum(counts, 1)
    # A constant sky has no noise to examine.
    if variance < 1e-3 or counts.min() < _MIN_PATCH_PIXELS // 8 or lattice.min() <= 0:
        return None

    def correlation(lag: int) -> float:
        total, pairs = 0.0, 0
        for one, other in (
            ((slice(lag, None), slice(None)), (slice(None, -lag), slice(None))),
            ((slice(None), slice(lag, None)), (slice(None), slice(None, -lag))),
        ):
            total += float((residual[one] * residual[other]).sum())
            pairs += int((starless[one] & starless[other]).sum())
        return total / max(pairs, 1) / variance

    return correlation(1) - correlation(_FAR_LAG_PX), np.asarray(lattice / lattice.mean())


@dataclass(frozen=True, slots=True)
class _Limits:
    """Limits on the stars used, and their required numbers."""

    # Shapes are measured on at most this many stars, the brightest, with at least this signal-to-noise ratio.
    most_shaped: int = 150
    shaped_snr: float = 20.0
    width_snr: float = 10.0
    # A star's weight grows with its signal-to-noise ratio up to this.
    weight_snr: float = 60.0
    # Number of stars needed for a typical shape, and for its change across the image.
    min_shaped: int = 8
    min_stars: int = 20
    # The corner is measured if a tenth of the stars lie beyond this fraction of its distance.
    corner_fraction: float = 0.6
    # Shapes are measured where sidereal trails are shorter than this, sigma: they add 1 % to the axis ratio.
    trail_sigma: float = 0.5
    # The background level is sampled on a square grid with this many points per side. Neighbouring points share tiles,
    # which increases the standard error of its gradient.
    level_grid: int = 16
    shared_tiles: float = 2.0
    # Rows and columns of the map of brightness residuals.
    map_shape: tuple[int, int] = (3, 4)


_LIMITS = _Limits()


def measure_misfit(
    image: Photograph,
    detected: DetectedStars,
    matches: Matches,
    sensor: Sensor,
    fit: BrightnessFit,
    stars: MeasuredStars,
) -> Misfit:
    """Measure how a photograph differs from its fitted sensor; `stars`: the matched stars, in the same order."""
    axis_px = _axis_px(matches)
    lone = ~stars.saturated & ~stars.blended
    signal = stars.peak_dn / stars.noise_dn
    growth, wider = _growth(image, stars, lone & (signal >= _LIMITS.width_snr), signal, axis_px)
    # One width was fitted to all stars, so the amplitude of a wider star underestimates its flux.
    fitted_px2, real_px2 = (
        sigma**2 + PIXEL_VARIANCE_PX2 for sigma in (sensor.psf_sigma_px, sensor.psf_sigma_px * wider)
    )
    ratio = np.maximum(stars.peak_dn, 1e-3) / fit.peak_dn(stars.vmag) * (fitted_px2 + real_px2) / (2 * fitted_px2)
    off_mag = -2.5 * np.log10(ratio)
    loss, mean_loss_mag = _corner_loss(image, stars, fit, off_mag, axis_px)
    gradient, towards_rad, rest_dn, rest_without_bowl_dn = _gradient(detected.background.level_dn)
    shaped = np.flatnonzero(lone & (signal >= _LIMITS.shaped_snr))
    shaped = shaped[np.argsort(-signal[shaped], kind="stable")][: _LIMITS.most_shaped]
    wings, stacked, ellipticity, long_axis_rad = None, None, None, 0.0
    if len(shaped) >= _LIMITS.min_shaped and stars.longest_trail_px < _LIMITS.trail_sigma * sensor.psf_sigma_px:
        wings, stacked = measure_wings(image, detected, matches.detection[shaped], sensor.psf_sigma_px, signal[shaped])
        if not detected.drawn_out_px:
            ellipticity, long_axis_rad = measure_ellipticity(image, detected, stars.xy_px[shaped], sensor.psf_sigma_px)
    correlation, lattice = measure_noise_structure(image, detected)
    return Misfit(
        wing_fraction=wings,
        stacked=stacked,
        corner_loss_mag=loss,
        mean_loss_mag=mean_loss_mag,
        brightness_map_mag=_brightness_map(image, stars.xy_px[fit.used], off_mag[fit.used]),
        gradient_dn=gradient,
        gradient_towards_rad=towards_rad,
        rest_dn=rest_dn,
        rest_without_bowl_dn=rest_without_bowl_dn,
        ellipticity=ellipticity,
        long_axis_rad=long_axis_rad,
        corner_growth=growth,
        neighbour_correlation=correlation,
        lattice_excess=lattice,
    )


def corner_distance(image: Photograph, matches: Matches, xy_px: Float) -> Float:
    """Return the distances (n,) of positions (n, 2) from the principal point, in distances of the farthest corner."""
    return np.asarray(np.linalg.norm(_offsets(xy_px, image.pixels_dn.shape, _axis_px(matches)), axis=1))


def _axis_px(matches: Matches) -> Float:
    """Return the pixel position of the optical axis on the image, mirrored if the image is."""
    camera = matches.solution.camera
    cx_px = camera.width_px - 1 - camera.cx_px if matches.solution.mirrored else camera.cx_px
    return np.array([cx_px, camera.cy_px])


def _offsets(xy_px: Float, shape: tuple[int, ...], axis_px: Float) -> Float:
    """Return offsets from the axis in units of the farthest corner's distance, (n, 2)."""
    corners = np.array([[x, y] for x in (0, shape[1] - 1) for y in (0, shape[0] - 1)])
    return np.asarray((xy_px - axis_px) / np.linalg.norm(corners - axis_px, axis=1).max())


def _covers_corner(offset: Float) -> bool:
    """Return whether there are enough stars, far enough from the axis, to measure the corner."""
    return (
        len(offset) >= _LIMITS.min_stars
        and float(np.quantile(np.linalg.norm(offset, axis=1), 0.9)) >= _LIMITS.corner_fraction
    )


def _fit_radial(offset: Float, values: Float, weights: Float) -> tuple[Float, Float]:
    """Return the robust fit of a + b x + c y + d r^2 and its covariance (Huber's weights; sandwich estimator)."""
    design = np.column_stack([np.ones(len(offset)), offset, (offset**2).sum(axis=1)])
    weights = weights / weights.mean()
    robust, p = weights, np.zeros(4)
    for _ in range(20):
        p = np.linalg.lstsq(design * np.sqrt(robust)[:, np.newaxis], values * np.sqrt(robust), rcond=None)[0]
        residual = np.abs(values - design @ p) * np.sqrt(weights)
        robust = weights * np.minimum(1.0, 1.5 * max(robust_std(residual), 1e-12) / np.maximum(residual, 1e-12))
    residual = values - design @ p
    inverse = np.linalg.pinv((design * robust[:, np.newaxis]).T @ design)
    meat = (design * ((robust * residual) ** 2)[:, np.newaxis]).T @ design
    return p, inverse @ meat @ inverse * len(values) / max(len(values) - 4, 1)


def _growth(
    image: Photograph, stars: MeasuredStars, good: NDArray[np.bool_], signal: Float, axis_px: Float
) -> tuple[Measurement | None, Float]:
    """Return the growth of sigma to the corner, and the expected width of each star over the typical one, (n,)."""
    offset = _offsets(stars.xy_px, image.pixels_dn.shape, axis_px)
    weights = np.minimum(signal[good], _LIMITS.weight_snr) ** 2
    if not _covers_corner(offset[good]):
        return None, np.ones(len(stars))
    p, covariance = _fit_radial(offset[good], stars.sigma_px[good], weights)
    if p[0] <= 0:
        return None, np.ones(len(stars))
    growth = Measurement(float(p[3] / p[0]), float(np.sqrt(covariance[3, 3]) / p[0]))
    if not growth.exceeds(0.0):
        return growth, np.ones(len(stars))
    r2 = (offset**2).sum(axis=1)
    width = 1 + growth.value * r2
    return growth, np.asarray(width / np.median(width[good]))


def _corner_loss(
    image: Photograph, stars: MeasuredStars, fit: BrightnessFit, off_mag: Float, axis_px: Float
) -> tuple[Measurement | None, float]:
    offset = _offsets(stars.xy_px[fit.used], image.pixels_dn.shape, axis_px)
    if not _covers_corner(offset):
        return None, 0.0
    p, covariance = _fit_radial(offset, off_mag[fit.used], np.ones(len(offset)))
    return Measurement(float(p[3]), float(np.sqrt(covariance[3, 3]))), float(p[3] * (offset**2).sum(axis=1).mean())


def _brightness_map(image: Photograph, xy_px: Float, off_mag: Float) -> Float:
    height, width = image.pixels_dn.shape
    cells = np.full(_LIMITS.map_shape, np.nan)
    rows = np.clip(xy_px[:, 1] / height * _LIMITS.map_shape[0], 0, _LIMITS.map_shape[0] - 1).astype(int)
    columns = np.clip(xy_px[:, 0] / width * _LIMITS.map_shape[1], 0, _LIMITS.map_shape[1] - 1).astype(int)
    for row, column in np.ndindex(_LIMITS.map_shape):
        inside = (rows == row) & (columns == column)
        if inside.any():
            cells[row, column] = np.median(off_mag[inside])
    return cells


def _gradient(level_dn: Float) -> tuple[Measurement, float, float, float]:
    """Return the change of the background across the image and the direction in which it brightens.

    Also its standard deviation without that plane, and without a centred paraboloid too.
    """
    height, width = level_dn.shape
    y, x = (np.rint(np.linspace(0, length - 1, _LIMITS.level_grid)).astype(int) for length in (height, width))
    xx, yy = (grid.ravel().astype(np.float64) for grid in np.meshgrid(x, y))
    size_px = np.array([width - 1.0, height - 1.0])
    offset = (np.column_stack([xx, yy]) - size_px / 2) / np.linalg.norm(size_px / 2)
    levels = level_dn[np.ix_(y, x)].ravel()
    p, covariance = _fit_radial(offset, levels, np.ones(len(levels)))
    # From one side of the image to the other.
    sides = 2 * size_px / np.linalg.norm(size_px)
    gradient_dn = float(np.abs(p[1:3] * sides).sum())
    error_dn = _LIMITS.shared_tiles * float(np.sqrt(np.diag(covariance)[1:3] @ sides**2))
    towards_rad = float(np.arctan2(p[2], p[1]) % (2 * np.pi))
    rest = levels - offset @ p[1:3]
    without_bowl = rest - p[3] * (offset**2).sum(axis=1)
    return (
        Measurement(gradient_dn, error_dn),
        towards_rad,
        robust_std(rest, float(np.median(rest))),
        robust_std(without_bowl, float(np.median(without_bowl))),
    )
