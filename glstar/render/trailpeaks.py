"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.render.clouds import CloudPassage
from glstar.render.scene import Scene
from glstar.render.stacking import StackedTrails
from glstar.render.trailmodels import AnalyticSegments, TrailModel

__all__ = ["TrailPeaks", "trail_peaks"]

Float = NDArray[np.float64]

# Parts of an exposure at whose ends a path is evaluated, at least.
_MIN_PARTS: Final = 16
# Parts that are shorter than this, sigma, are wide Gaussians instead of lines: the difference is below 1e-4.
_SHORT_SIGMA: Final = 0.5
# Lines whose ends are farther than their length and this, sigma, add less than 1e-5.
_FAR_SIGMA: Final = 5.0
# Closer to the end of a trail than this, sigma, light from beyond is missing.
_REACH_SIGMA: Final = 2.0


@dataclass(frozen=True, slots=True)
class TrailPeaks:
    """Expected brightness of m stars.

    Attributes
    ----------
    peak_fraction_per_px2 : (m,) float64
        Signal at the brightest point of a trail on the image, over the flux of the star.
    area_px2 : (m,) float64
        Noise-equivalent area of the trail: the squared flux over the integral of the squared signal.  That of a part of
        the trail is the same part of it.
    """

    peak_fraction_per_px2: Float
    area_px2: Float


def trail_peaks(scene: Scene, direction_eq: Float, passage: CloudPassage | None = None) -> TrailPeaks:
    """Return the expected brightness of trails along the true paths of stars.

    Parameters
    ----------
    scene : Scene
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    passage : CloudPassage, optional
        What cloud transmits of the stars: the peak is that of the dimmed trail, over the flux above the cloud.

    Returns
    -------
    TrailPeaks

    Notes
    -----
    The point is where the star is slowest while it is on the image; the light of the whole path arrives there, because
    a vibrating star passes it several times.  The path is a chain of lines, whose light is a Gaussian across and a
    difference of error functions along.  A star at rest has the area 4 pi sigma^2, and a long trail of length L the
    area 2 sqrt(pi) sigma L: flux over peak times 2 and times sqrt(2); between them the factor is interpolated.
    """
    sigma_px = scene.sensor.core.effective_sigma_px
    chains = list(_chains(scene, direction_eq))
    points, order = zip(*(_brightest(scene, *chain) for chain in chains), strict=True)
    point = points[0] if len(chains) == 1 else _least(np.stack(points), np.stack(order))
    xy_px, weight = _joined(chains)
    step = np.diff(xy_px, axis=0)
    length_px = np.hypot(step[..., 0], step[..., 1])
    hidden = ~np.isfinite(length_px)
    weights = np.where(hidden, 0.0, weight[:, np.newaxis])
    mean = np.ones(1)
    if passage is not None:
        ends = np.cumsum(weight)
        weights, mean = weights * passage.at((ends - weight / 2) / ends[-1]), passage.mean
    peak = _signal_at(point, np.nan_to_num(xy_px), length_px, weights, sigma_px)
    dimmed = peak / np.maximum(mean, 1e-30)
    concentration = np.minimum(2 * np.pi * sigma_px**2 * dimmed, 1.0)
    factor = np.sqrt(2) + (2 - np.sqrt(2)) * concentration
    return TrailPeaks(peak, factor / np.maximum(dimmed, 1e-30))


def _chains(scene: Scene, direction_eq: Float) -> Iterator[tuple[Float, Float]]:
    """Yield `_chain` of each short exposure of a stacked image, or of the exposure."""
    trails = scene.trails if scene.listing is None else scene.listing.trails
    shorts = trails.shorts if isinstance(trails, StackedTrails) else (trails,)
    for short in shorts:
        xy_px, weight = _chain(scene, short, direction_eq)
        yield xy_px, weight / len(shorts)


def _joined(chains: list[tuple[Float, Float]]) -> tuple[Float, Float]:
    """Return several chains as one, with lines of no light between them."""
    if len(chains) == 1:
        return chains[0]
    weights = [np.concatenate([weight, [0.0]]) for _, weight in chains]
    return np.concatenate([xy_px for xy_px, _ in chains]), np.concatenate(weights)[:-1]


def _least(points: Float, order: Float) -> Float:
    """Return the point with the smallest order of each star, (m, 2), of (k, m, 2) with orders (k, m)."""
    return np.asarray(points[order.argmin(axis=0), np.arange(points.shape[1])])


def _chain(scene: Scene, trails: TrailModel, direction_eq: Float) -> tuple[Float, Float]:
    """Return positions along paths, (n, m, 2) px, and the fractions of the exposure between them, (n - 1,)."""
    if isinstance(trails, AnalyticSegments) and 2 * len(trails) >= _MIN_PARTS:
        weight = np.repeat(trails.time_fraction / 2, 2)
        return scene.camera.project(trails.pointing.to_camera(direction_eq)), weight
    if isinstance(trails, AnalyticSegments):
        parts = 2 * -(-_MIN_PARTS // (2 * len(trails)))
        weight = np.repeat(trails.time_fraction / parts, parts)
        times = np.concatenate([[0.0], np.cumsum(weight)])
        return trails.positions(scene.camera, direction_eq, np.minimum(times, 1.0)), weight
    xy_px = scene.camera.project(trails.pointing.to_camera(direction_eq))
    xy_px = np.concatenate([xy_px, xy_px[-1:]])
    return xy_px, np.full(len(xy_px) - 1, 1 / (len(xy_px) - 1))


def _brightest(scene: Scene, xy_px: Float, weight: Float) -> tuple[Float, Float]:
    """Return where each star is slowest on the image, or its nearest point to the image, (m, 2) px; and how slow."""
    step = np.diff(xy_px, axis=0)
    length_px = np.hypot(step[..., 0], step[..., 1])
    middle = (xy_px[1:] + xy_px[:-1]) / 2
    speed = length_px / weight[:, np.newaxis]
    # On the image the slowest part that has light from both sides, and off it the nearest.
    length_px = np.nan_to_num(length_px)
    from_start_px = np.cumsum(length_px, axis=0) - length_px / 2
    to_end_px = np.minimum(from_start_px, length_px.sum(axis=0) - from_start_px)
    reaches_px = np.minimum(_REACH_SIGMA * scene.sensor.core.effective_sigma_px, to_end_px.max(axis=0))
    speed *= np.where(to_end_px < reaches_px, 1e6, 1.0)
    outside_px = np.nan_to_num(np.maximum(scene.camera.distance_outside_px(middle), 0.0), nan=np.inf)
    order = np.where(outside_px > 0, 1e12 + outside_px, np.nan_to_num(speed, nan=np.inf))
    brightest = np.nan_to_num(_least(middle, order))
    size_px = np.array([scene.camera.width_px, scene.camera.height_px])
    return np.asarray(brightest.clip(-0.5, size_px - 0.5)), order.min(axis=0)


def _signal_at(point: Float, xy_px: Float, length_px: Float, weight: Float, sigma_px: float) -> Float:
    """Return the signal of chains of lines at one point each, (m,), over the flux of the star, 1/px^2."""
    off_x, off_y = (point[:, axis] - xy_px[:-1, :, axis] for axis in (0, 1))
    length = np.maximum(np.nan_to_num(length_px), 1e-9)
    # Most lines are too far to matter.
    reach = length + _FAR_SIGMA * sigma_px
    line, star = np.nonzero(off_x * off_x + off_y * off_y < reach * reach)
    length = length[line, star]
    along = (xy_px[line + 1, star] - xy_px[line, star]) / length[:, np.newaxis]
    off = np.stack([off_x[line, star], off_y[line, star]], axis=1) / sigma_px
    length = length / sigma_px
    s = (off * along).sum(axis=-1)
    p2 = np.maximum((off * off).sum(axis=-1) - s * s, 0.0)
    variance = 1 + length * length / 12
    wide = np.exp(-0.5 * (s - length / 2) ** 2 / variance) / np.sqrt(2 * np.pi * variance)
    density = np.where(length < _SHORT_SIGMA, wide, (_normal_cumulative(s) - _normal_cumulative(s - length)) / length)
    across = np.exp(-0.5 * p2) / np.sqrt(2 * np.pi)
    signal = np.bincount(star, weight[line, star] * across * density, minlength=len(point))
    return np.asarray(signal / sigma_px**2)


def _normal_cumulative(z: Float) -> Float:
    """Return the cumulative distribution of the unit Gaussian to 1e-7: Abramowitz & Stegun 26.2.17."""
    t = 1 / (1 + 0.2316419 * np.abs(z))
    polynomial = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * polynomial
    return np.asarray(np.where(z < 0, tail, 1 - tail))
