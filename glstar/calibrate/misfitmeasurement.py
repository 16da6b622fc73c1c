"""Measurement of the effects in a photograph that the sensor model lacks."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.detect import DetectedStars
from glstar.calibrate.matches import Matches
from glstar.calibrate.misfit import Measurement, Misfit
from glstar.calibrate.noisestructure import measure_noise_structure
from glstar.calibrate.photograph import Photograph
from glstar.calibrate.sensorfit import BrightnessFit, MeasuredStars
from glstar.calibrate.starprofiles import measure_ellipticity, measure_wings
from glstar.camera.sensor import PIXEL_VARIANCE_PX2, Sensor
from glstar.statistics import robust_std

__all__ = ["corner_distance", "measure_misfit"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]


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


_LIMITS: Final = _Limits()


def measure_misfit(
    image: Photograph,
    detected: DetectedStars,
    matches: Matches,
    sensor: Sensor,
    fit: BrightnessFit,
    stars: MeasuredStars,
) -> Misfit:
    """Measure how a photograph differs from its fitted sensor.

    Parameters
    ----------
    image : Photograph
    detected : DetectedStars
    matches : Matches
    sensor : Sensor
    fit : BrightnessFit
    stars : MeasuredStars
        The matched stars, in the same order.

    Returns
    -------
    Misfit
    """
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
    """Return the distances of pixel positions from the principal point over that of the farthest corner.

    Parameters
    ----------
    image : Photograph
    matches : Matches
    xy_px : (n, 2) float64

    Returns
    -------
    (n,) float64
    """
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
        left = np.abs(values - design @ p) * np.sqrt(weights)
        robust = weights * np.minimum(1.0, 1.5 * max(robust_std(left), 1e-12) / np.maximum(left, 1e-12))
    left = values - design @ p
    inverse = np.linalg.pinv((design * robust[:, np.newaxis]).T @ design)
    meat = (design * ((robust * left) ** 2)[:, np.newaxis]).T @ design
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
