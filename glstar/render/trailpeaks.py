"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import sqrt
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.limitingmagnitude import noise_equivalent_area_px2
from glstar.camera.sensor import Sensor
from glstar.render.clouds import CloudPassage
from glstar.render.gaussianscenes import psf_scale
from glstar.render.rowtimes import RecordedTimes
from glstar.render.scene import Scene
from glstar.render.stacking import StackedTrails
from glstar.render.trailmodels import AnalyticSegments, TrailModel

__all__ = ["TrailPeaks", "trail_peaks"]

Float = NDArray[np.float64]
_Stars = slice | NDArray[np.intp]

# Parts of an exposure at whose ends a path is evaluated, at least.
_MIN_PARTS: Final = 16
# Parts that are shorter than this, sigma, are wide Gaussians instead of lines: the difference is below 1e-4.
_SHORT_SIGMA: Final = 0.5
# Lines whose ends are farther than their length and this, sigma, add less than 1e-5.
_FAR_SIGMA: Final = 5.0
# Closer to the end of a trail than this, sigma, light from beyond is missing; that of wings counts too.
_REACH_SIGMA: Final = 2.0
_REACH_OF_WINGS_SIGMA: Final = 4.0


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


def trail_peaks(
    scene: Scene,
    direction_eq: Float,
    passage: CloudPassage | None = None,
    nodes_px: Float | None = None,
    recorded: RecordedTimes | None = None,
) -> TrailPeaks:
    """Return the expected brightness of trails along the true paths of stars.

    Parameters
    ----------
    scene : Scene
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.
    passage : CloudPassage, optional
        What cloud transmits of the stars: the peak is that of the dimmed trail, over the flux above the cloud.
    nodes_px : (2, n, m) float64, optional
        Their `ConicPaths.nodes_px`, if these are known.
    recorded : RecordedTimes, optional
        When a rolling shutter records them: fractions are of the flux that it records.

    Returns
    -------
    TrailPeaks

    Notes
    -----
    The point is where the star is slowest, relative to what cloud transmits, while it is on the image; the light of the
    whole path arrives there, because a vibrating star passes it several times.  The path is a chain of lines, whose
    light is a Gaussian across and a difference of error functions along, for each Gaussian of a star's profile.  A
    Gaussian at rest has the area 4 pi sigma^2, and a long trail of length L the area 2 sqrt(pi) sigma L: flux over peak
    times 2 and times sqrt(2); other profiles have other factors.  Between them the factor is interpolated.
    """
    chains = list(_chains(scene, direction_eq, nodes_px, recorded))
    transmissions = _transmissions(chains, passage)
    found = (_brightest(scene, chain, transmission) for chain, transmission in zip(chains, transmissions, strict=True))
    points, order = zip(*found, strict=True)
    point = points[0] if len(chains) == 1 else _least(np.stack(points), np.stack(order))
    peak, mean = np.zeros(len(point)), np.ones(1) if passage is None else passage.mean
    scales = psf_scale(scene, direction_eq)
    profiles = list(_profiles(scene.sensor, scales))
    for chain, transmission in zip(chains, transmissions, strict=True):
        for stars, gaussians in profiles:
            of_stars, passing = chain[stars], None if transmission is None else transmission[:, stars]
            for fraction, sigma_px, offset_px in gaussians:
                peak[stars] += fraction * of_stars.signal_at(point[stars] - offset_px, sigma_px, passing)
    dimmed = peak / np.maximum(mean, 1e-30)
    return TrailPeaks(peak, _area_factor(scene.sensor, scales, dimmed) / np.maximum(dimmed, 1e-30))


def _profiles(sensor: Sensor, scales: Float) -> Iterator[tuple[_Stars, list[tuple[float, float, Float]]]]:
    """Yield the stars with each profile, and its Gaussians: fraction of the flux, sigma in px, offset (x, y) in px."""
    if sensor.point_spread.is_gaussian:
        yield slice(None), [(1.0, sensor.effective_sigma_px, np.zeros(2))]
        return
    for scale in np.unique(scales).tolist():
        yield (
            np.flatnonzero(scales == scale),
            [
                (one.flux_fraction, sensor.of_component(one).effective_sigma_px, np.array(one.offset_px))
                for one in sensor.point_spread.components(sensor.psf_sigma_px, scale=scale)
            ],
        )


def _area_factor(sensor: Sensor, scales: Float, peak: Float) -> Float:
    """Return the noise-equivalent areas of trails times their peaks, of a flux of 1."""
    at_rest, along_line, rest_px2 = 2.0, sqrt(2.0), 2 * np.pi * sensor.effective_sigma_px**2
    if not sensor.point_spread.is_gaussian:
        parts = [
            (one.flux_fraction, sensor.of_component(one).effective_sigma_px ** 2)
            for one in sensor.point_spread.circular(sensor.psf_sigma_px)
        ]
        rest_px2 = 1 / sum(fraction / (2 * np.pi * variance) for fraction, variance in parts)
        at_rest = noise_equivalent_area_px2(sensor) / rest_px2
        pairs = [(f * g, s + t) for f, s in parts for g, t in parts]
        across = sum(fraction / sqrt(2 * np.pi * variance) for fraction, variance in parts)
        along_line = across / sum(fraction / sqrt(2 * np.pi * variance) for fraction, variance in pairs)
    concentration = np.minimum(rest_px2 * peak * scales**2, 1.0)
    return np.asarray(along_line + (at_rest - along_line) * concentration)


def _chains(
    scene: Scene, direction_eq: Float, nodes_px: Float | None, recorded: RecordedTimes | None
) -> Iterator["_Chain"]:
    """Yield the chain of each short exposure of a stacked image, or of the exposure, while its rows are open."""
    trails = scene.trails if scene.listing is None else scene.listing.trails
    if not isinstance(trails, StackedTrails):
        xy_px, duration = _chain(scene, trails, direction_eq, nodes_px)
        yield _Chain.of(*_while_open(xy_px, duration, recorded, scene.exposure.span_s))
        return
    rows = [None] * len(trails.shorts) if recorded is None else recorded.shorts
    span_s = scene.exposure.first.span_s
    for short, times in zip(trails.shorts, rows, strict=True):
        xy_px, duration = _chain(scene, short, direction_eq, None)
        yield _Chain.of(*_while_open(xy_px, duration / len(trails.shorts), times, span_s))


def _while_open(
    xy_px: Float, duration: Float, times: RecordedTimes | None, span_s: float
) -> tuple[Float, Float, Float | None]:
    """Return the arguments of `_Chain.of`: of a rolling shutter, the path between each star's opening and closing.

    What is before and after is left as lines of no length and no light.
    """
    if times is None:
        return xy_px, duration, None
    share = duration.sum()
    ends_s = (span_s / share) * np.concatenate([[0.0], np.cumsum(duration)])[:, np.newaxis]
    first_px, last_px = (times.positions[k].T[:, np.newaxis] for k in (0, 2))
    xy_px = np.where(ends_s < times.opens_s, first_px, np.where(ends_s > times.closes_s, last_px, xy_px))
    open_s = np.diff(ends_s.clip(times.opens_s, times.closes_s), axis=0)
    return xy_px, duration, share * open_s / np.maximum(times.closes_s - times.opens_s, 1e-12)


def _transmissions(chains: list["_Chain"], passage: CloudPassage | None) -> list[Float | None]:
    """Return what cloud transmits of the stars during each line of each chain, (n, m); None for all."""
    if passage is None:
        return [None] * len(chains)
    durations = np.concatenate([chain.duration for chain in chains])
    ends = np.cumsum(durations)
    middles = (ends - durations / 2) / ends[-1]
    counts = np.cumsum([len(chain.duration) for chain in chains])[:-1]
    return [passage.at(times) for times in np.split(middles, counts)]


def _least(points: Float, order: Float) -> Float:
    """Return the point with the smallest order of each star, (m, 2), of (k, m, 2) with orders (k, m)."""
    return np.asarray(points[order.argmin(axis=0), np.arange(points.shape[1])])


def _chain(scene: Scene, trails: TrailModel, direction_eq: Float, nodes_px: Float | None) -> tuple[Float, Float]:
    """Return positions along paths, (2, n, m) px, and the fractions of the exposure between them, (n - 1,)."""
    if isinstance(trails, AnalyticSegments) and 2 * len(trails) >= _MIN_PARTS:
        if nodes_px is None:
            nodes_px = np.moveaxis(scene.camera.project(trails.pointing.to_camera(direction_eq)), -1, 0)
        return nodes_px, np.repeat(trails.time_fraction / 2, 2)
    if isinstance(trails, AnalyticSegments):
        parts = 2 * -(-_MIN_PARTS // (2 * len(trails)))
        weight = np.repeat(trails.time_fraction / parts, parts)
        times = np.concatenate([[0.0], np.cumsum(weight)])
        xy_px = trails.positions(scene.camera, direction_eq, np.minimum(times, 1.0))
        return np.moveaxis(xy_px, -1, 0), weight
    xy_px = np.moveaxis(scene.camera.project(trails.pointing.to_camera(direction_eq)), -1, 0)
    xy_px = np.concatenate([xy_px, xy_px[:, -1:]], axis=1)
    return xy_px, np.full(xy_px.shape[1] - 1, 1 / (xy_px.shape[1] - 1))


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """Paths of m stars as chains of n lines.

    Attributes
    ----------
    xy_px : (2, n + 1, m) float64
        Positions at the ends of the lines, px; 0 where a star is not visible.
    step_px : (2, n, m) float64
        From one to the next, px.
    length_px : (n, m) float64
        Lengths of the lines, px.
    duration : (n,) float64
        The fraction of the exposure of each line.
    hidden : (n, m) bool or None
        Which lines have an end that is not visible; None if all are visible.
    recorded : (n, m) float64 or None
        Under a rolling shutter, the fraction of each star's own exposure of each line; None for `duration`.
    """

    xy_px: Float
    step_px: Float
    length_px: Float
    duration: Float
    hidden: NDArray[np.bool_] | None
    recorded: Float | None

    @classmethod
    def of(cls, xy_px: Float, duration: Float, recorded: Float | None) -> Self:
        """Return the chain through positions, (2, n + 1, m) px; NaN where a star is not visible."""
        step_px = xy_px[:, 1:] - xy_px[:, :-1]
        length_px = np.sqrt(step_px[0] * step_px[0] + step_px[1] * step_px[1])  # five times as fast as hypot
        if np.isfinite(length_px.sum()):
            return cls(xy_px, step_px, length_px, duration, None, recorded)
        hidden = ~np.isfinite(length_px)
        step_px[:, hidden] = 0.0
        length_px[hidden] = 0.0
        return cls(np.nan_to_num(xy_px), step_px, length_px, duration, hidden, recorded)

    def __getitem__(self, stars: _Stars) -> Self:
        """Return the chain of some stars."""
        hidden = None if self.hidden is None else self.hidden[:, stars]
        recorded = None if self.recorded is None else self.recorded[:, stars]
        parts = self.xy_px[..., stars], self.step_px[..., stars], self.length_px[:, stars], self.duration
        return type(self)(*parts, hidden, recorded)

    def signal_at(self, point: Float, sigma_px: float, transmission: Float | None) -> Float:
        """Return the signal at one point per star, (m,), over the flux of the star, 1/px^2.

        `transmission`, (n, m), is that of each line; None for 1.
        """
        off_px = [point[:, axis] - self.xy_px[axis, :-1] for axis in (0, 1)]
        # Most lines are too far to matter.
        reach = self.length_px + _FAR_SIGMA * sigma_px
        is_near = off_px[0] * off_px[0] + off_px[1] * off_px[1] < reach * reach
        if self.hidden is not None:
            is_near &= ~self.hidden
        near = np.flatnonzero(is_near)
        line, star = np.divmod(near, len(point))
        length_px = np.maximum(self.length_px.ravel().take(near), 1e-9)
        along_x, along_y = (step.ravel().take(near) / length_px for step in self.step_px)
        off_x, off_y = (off.ravel().take(near) / sigma_px for off in off_px)
        length = length_px / sigma_px
        s = off_x * along_x + off_y * along_y
        p2 = np.maximum(off_x * off_x + off_y * off_y - s * s, 0.0)
        weight = self.duration.take(line) if self.recorded is None else self.recorded.ravel().take(near)
        signal = weight * _density(s, length) * np.exp(-0.5 * p2)
        if transmission is not None:
            signal *= transmission.ravel().take(near)
        summed = np.bincount(star, signal, minlength=len(point))
        return np.asarray(summed / (np.sqrt(2 * np.pi) * sigma_px**2))


def _brightest(scene: Scene, chain: _Chain, transmission: Float | None) -> tuple[Float, Float]:
    """Return where each star leaves most light on the image, or its nearest point to it, (m, 2) px; and an order."""
    length_px = chain.length_px
    if chain.recorded is None:
        order = length_px / chain.duration[:, np.newaxis]
    else:
        order = np.where(chain.recorded > 0, length_px / np.maximum(chain.recorded, 1e-12), np.inf)
    if transmission is not None:
        order /= np.maximum(transmission, 1e-9)
    # On the image the slowest part that has light from both sides, and off it the nearest.
    from_start_px = np.cumsum(length_px, axis=0)
    total_px = from_start_px[-1].copy()
    from_start_px -= length_px / 2
    to_end_px = np.minimum(from_start_px, total_px - from_start_px)
    reaches_px = np.minimum(_reach_px(scene.sensor), to_end_px.max(axis=0))
    order *= np.where(to_end_px < reaches_px, 1e6, 1.0)
    middle = chain.xy_px[:, 1:] + chain.xy_px[:, :-1]
    middle /= 2
    outside_px = scene.camera.distance_outside_px(middle.transpose(1, 2, 0))
    is_outside = outside_px > 0
    if is_outside.any():
        order = np.where(is_outside, 1e12 + outside_px, order)
    if chain.hidden is not None:
        order[chain.hidden] = np.inf
    slowest = order.argmin(axis=0)
    stars = np.arange(len(slowest))
    brightest = middle[:, slowest, stars].T
    size_px = np.array([scene.camera.width_px, scene.camera.height_px])
    return np.asarray(brightest.clip(-0.5, size_px - 0.5)), order[slowest, stars]


def _reach_px(sensor: Sensor) -> float:
    psf, sigma_px = sensor.point_spread, sensor.effective_sigma_px
    return _REACH_SIGMA * sigma_px if psf.is_gaussian else _REACH_OF_WINGS_SIGMA * sigma_px * (1 + psf.psf_growth)


def _density(s: Float, length: Float) -> Float:
    """Return the light per sigma of lines at a distance s from their starts along them; lengths in sigma."""
    density = np.empty_like(s)
    is_short = length < _SHORT_SIGMA
    short, long = np.flatnonzero(is_short), np.flatnonzero(~is_short)
    size = length.take(short)
    variance = 1 + size * size / 12
    off = s.take(short) - size / 2
    density[short] = np.exp(-0.5 * off * off / variance) / np.sqrt(2 * np.pi * variance)
    size, at = length.take(long), s.take(long)
    density[long] = (_normal_cumulative(at) - _normal_cumulative(at - size)) / size
    return density


def _normal_cumulative(z: Float) -> Float:
    """Return the cumulative distribution of the unit Gaussian to 1e-7: Abramowitz & Stegun 26.2.17."""
    t = 1 / (1 + 0.2316419 * np.abs(z))
    polynomial = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * polynomial
    return np.asarray(np.where(z < 0, tail, 1 - tail))
