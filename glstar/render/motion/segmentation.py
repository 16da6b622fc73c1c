"""Division of an exposure into the segments of analytic trails, and the error bound that decides it.

Within a segment the vector to a star is taken as a quadratic function of time through its values at the start, the
middle and the end.  A pinhole projects it to a conic, which also represents a steady rotation (`starpaths`); a lens to
another curve, of which positions at these times and the rates at both ends are drawn.
`trail.frag` integrates the flux along such a path in closed form.  Segments are as long as the error bound allows,
whatever the motion: one may do for a steady rotation by several degrees, while one period of a vibration takes several.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion.pointing import CameraMotion, Pointing
from glstar.render.motion.starpaths import end_rates_px, end_weights, probe_rays
from glstar.rotation import turn_from_matrix
from glstar.sky.air.refraction import refraction_displacement

# Start and end times of segments, (segments,) each, UTC seconds since 1970.
Segments = tuple[Float, Float]


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest acceptable errors of an analytic trail."""

    position_px: float = 0.02  # Distance between a star's true and drawn positions at the same time, px
    trail_fraction: float = 4e-3  # Error of the flux in any pixel, as a fraction of the trail's own flux there
    peak_fraction: float = 5e-4  # The same, as a fraction of the peak of the star if it did not move


@dataclass(frozen=True, slots=True)
class ShapeLimits:
    """Range of segments that the shaders can draw: `star_path.frag` is compiled with these numbers."""

    short_sigma: float = 2.0  # A path shorter than this many sigma is drawn as two Gaussians
    # Largest relative variation of flux per length between a segment's middle and its ends.
    max_flux_variation: float = 0.9
    max_end_flux: float = 3.0  # Largest flux per length at the ends of a segment, relative to uniform motion


@dataclass(frozen=True, slots=True)
class Refinement:
    """How segments are evaluated and divided."""

    # Minimum number of intervals at whose ends a segment is evaluated; there are at least two per sample of the log.
    min_samples: int = 8
    shortest_s: float = 2e-5  # Segments shorter than this are accepted, s
    # Change of the turn rate at a sample of the log, relative to the largest rate, above which it is discontinuous.
    rate_change: float = 1e-3
    # Maximum number of parts that a segment is divided into at once: extrapolation of the error is less certain the
    # more there are.
    max_parts: int = 24
    unknown_parts: int = 4  # Number of parts where the error is unknown
    # Whether a number of segments suffices is tested with this fraction of it.
    trial_fraction: float = 0.7


TOLERANCES = Tolerances()
# `Tolerances.position_px` under a rolling shutter, where rows cut trails anywhere: a trail that ends 0.005 px too early
# or too late is 0.2 % of its peak off at sigma 1 px.
ROLLING_POSITION_PX = 0.005
SHAPE_LIMITS = ShapeLimits()
# Variance of two Gaussians due to an even change of the motion, in squares of `ahead` of two_gaussians.glsl: VARIANCE
# RATE_CHANGE^2 there.
_CHANGE_VARIANCE = 0.0187834 * 2.3282816**2
REFINEMENT = Refinement()
# Fraction of a segment in which a change leaves no light.
_SHORTEST = 1e-5


def segment_times(
    motion: CameraMotion,
    nodes_s: Float,
    camera: Camera,
    sigma_px: float,
    *,
    most: int | None = None,
    position_px: float = TOLERANCES.position_px,
) -> Float | None:
    """Return the ends and the middles of the segments of an exposure, (2 m + 1,) UTC seconds since 1970.

    The times are the start, the middle and the end of the first segment, which is the start of the second, and so on;
    None if the motion is so rough that it takes more segments than `most`.

    - `nodes_s` (n,): start and end of the exposure, and between them the samples of the log, where the turn rate may
      change discontinuously.  A segment is divided at a rate discontinuity, or evenly if it contains none.
    - `camera`: errors are evaluated at nine points of its field: corners, middles of the sides and centre; behind a
      lens at 25.
    - `sigma_px`: standard deviation of a star as the pixels record it, px.
    - `position_px`: largest distance between a star's true and drawn positions at the same time, px.
    """
    evaluator = _SegmentEvaluator(motion, nodes_s, camera, sigma_px, position_px)
    segments = nodes_s[:1], nodes_s[-1:]
    if most is None:
        evaluated = evaluator.evaluate(segments)
    else:
        # Both are evaluated in one request: see `_SegmentEvaluator.evaluate`.
        parts = _trial_parts(nodes_s, most)
        evaluated = evaluator.evaluate(parts, segments)
        if _takes_more(evaluator, parts, next(evaluated), most):
            return None
    excess = next(evaluated)
    starts = np.sort(np.concatenate([begins for begins, _ in evaluator.refined(segments, excess)]))
    times = np.empty(2 * len(starts) + 1)
    times[:-1:2] = starts
    times[-1] = nodes_s[-1]
    times[1::2] = (times[:-1:2] + times[2::2]) / 2
    return times


def _trial_parts(nodes_s: Float, most: int) -> Segments:
    """Return equal parts of an exposure, somewhat fewer than a number of segments.

    If several of them have to be divided, it takes more segments.
    """
    marks_s = np.linspace(nodes_s[0], nodes_s[-1], max(1, int(REFINEMENT.trial_fraction * most)) + 1)
    return marks_s[:-1], marks_s[1:]


def _takes_more(evaluator: "_SegmentEvaluator", parts: Segments, excess: Float, most: int) -> bool:
    """Return whether an exposure, of which `parts` have been evaluated, takes more segments than a number."""
    accepted = 0
    for begins, remaining in evaluator.refined(parts, excess):
        accepted += len(begins)
        if remaining and accepted + remaining > most:
            return True
    return False


class _SegmentEvaluator:
    """Evaluates the error of segments of one exposure and divides them; parameters as for `segment_times`."""

    def __init__(
        self, motion: CameraMotion, nodes_s: Float, camera: Camera, sigma_px: float, position_px: float
    ) -> None:
        self._motion = motion
        self._nodes_s = nodes_s
        self._camera = camera
        self._sigma_px = sigma_px
        self._position_px = position_px
        self._at_nodes: Pointing | None = None

    def evaluate(self, *several: Segments) -> Iterator[Float]:
        """Yield for each set of segments the error of each divided by the tolerance; NaN if unknown."""
        elapsed = [self._elapsed(begins, ends) for begins, ends in several]
        times_s = [_times_s(*of_segments, at) for of_segments, at in zip(several, elapsed, strict=True)]
        # The nodes are requested with the first samples, because a request costs more than its times.
        if self._at_nodes is None:
            self._at_nodes, *pointings = self._motion.pointings(self._nodes_s, *times_s)
        else:
            pointings = self._motion.pointings(*times_s)
        for (begins, ends), at, pointing in zip(several, elapsed, pointings, strict=True):
            xy, rates_px = _probe_paths(pointing, len(begins), self._camera)
            length_s = ends - begins
            fraction = length_s / (self._nodes_s[-1] - self._nodes_s[0])
            excess = segment_excess(xy, rates_px, fraction, self._sigma_px, self._position_px, at)
            excess[length_s < REFINEMENT.shortest_s] = 0.0
            yield excess

    def _elapsed(self, begins: Float, ends: Float) -> Float:
        """Return the elapsed fractions of segments at which they are evaluated, (times, segments).

        The fractions are even, but for the second and the last but one: the first and the last node, if it is nearer to
        an end.
        """
        first, last = self._nodes_s.searchsorted(begins, "right"), self._nodes_s.searchsorted(ends) - 1
        samples, within = REFINEMENT.min_samples, int((last - first).max()) + 2
        while samples < 2 * within:
            samples *= 2
        even, length_s = _even_fractions(samples + 1), ends - begins
        step = np.full(len(begins), even[1])
        after_begin = np.minimum((self._nodes_s[first] - begins) / length_s, step)
        before_end = np.minimum((ends - self._nodes_s[last]) / length_s, step)
        inner = np.tile(even[1:-1, np.newaxis], len(begins))
        return np.vstack([np.zeros_like(step), after_begin, inner, 1 - before_end, np.ones_like(step)])

    def refined(self, segments: Segments, excess: Float) -> Iterator[tuple[Float, int]]:
        """Yield, division by division, the starts of acceptable segments and how many parts of others remain."""
        begins, ends = segments
        while not (acceptable := excess <= 1.0).all():
            accepted = begins[acceptable]
            begins, ends = self._divided(begins[~acceptable], ends[~acceptable], excess[~acceptable])
            yield accepted, len(begins)
            excess = next(self.evaluate((begins, ends)))
        yield begins, 0

    def _divided(self, begins: Float, ends: Float, excess: Float) -> Segments:
        """Return the parts of segments: divided at the rate discontinuity nearest to the middle, or evenly."""
        breaks_s, middles = self._rate_discontinuities_s, (begins + ends) / 2
        after = np.minimum(np.maximum(breaks_s.searchsorted(middles), 1), len(breaks_s) - 1)
        before_s, after_s = breaks_s[after - 1], breaks_s[after]
        # Of two at the same distance the earlier, whatever the rounding of the exposure's time.
        nearest = np.where(middles - before_s < after_s - middles + REFINEMENT.shortest_s, before_s, after_s)
        has_break = (nearest > begins) & (nearest < ends)
        if has_break.all():
            return np.concatenate([begins, nearest]), np.concatenate([nearest, ends])
        starts, stops = _even_parts(begins[~has_break], ends[~has_break], excess[~has_break])
        begins, ends, nearest = begins[has_break], ends[has_break], nearest[has_break]
        return np.concatenate([begins, nearest, starts]), np.concatenate([nearest, ends, stops])

    @cached_property
    def _rate_discontinuities_s(self) -> Float:
        """The nodes at which the turn rate changes discontinuously, and the exposure's start and end."""
        assert self._at_nodes is not None
        C = self._at_nodes.C_camera_eq
        rotations = C[1:] @ np.swapaxes(C[:-1], 1, 2)
        rate = turn_from_matrix(rotations) / np.diff(self._nodes_s)[:, np.newaxis]
        change = np.linalg.norm(np.diff(rate, axis=0), axis=1)
        discontinuous = change > REFINEMENT.rate_change * np.linalg.norm(rate, axis=1).max()
        return np.asarray(self._nodes_s[np.concatenate([[True], discontinuous, [True]])])


def _times_s(begins: Float, ends: Float, elapsed: Float) -> Float:
    """Return the times of elapsed fractions, (times, segments), one segment after the other."""
    times_s = begins + (ends - begins) * elapsed
    times_s[-1] = ends
    return times_s.T.ravel()


def _even_parts(begins: Float, ends: Float, excess: Float) -> Segments:
    """Return the equal parts of segments, each divided into as many as its error requires."""
    # The error is proportional to the third power of a segment's length.
    needed = np.where(np.isfinite(excess), np.cbrt(excess), REFINEMENT.unknown_parts)
    counts = np.ceil(needed).clip(2, REFINEMENT.max_parts).astype(np.intp)
    segment = np.repeat(np.arange(len(counts)), counts)
    part = np.arange(len(segment)) - (np.cumsum(counts) - counts)[segment]
    step_s = ((ends - begins) / counts)[segment]
    starts = begins[segment] + part * step_s
    stops = begins[segment] + (part + 1) * step_s
    return starts, np.where(part == counts[segment] - 1, ends[segment], stops)


def _probe_paths(pointing: Pointing, segments: int, camera: Camera) -> tuple[Float, Float]:
    """Return the paths of probes, stars all over the field in the middle of each segment.

    Positions, (times, segments, probes, 2) px, and the rates at which segments start and end, (2, segments, probes, 2):
    see `end_rates_px`.
    """
    C = pointing.C_camera_eq.reshape(segments, -1, 3, 3)
    times = C.shape[1]
    directions = np.swapaxes(C[:, times // 2], 1, 2) @ probe_rays(camera)
    zenith_eq = pointing.zenith_eq.reshape(segments, -1, 3)
    velocity_eq = pointing.velocity_eq.reshape(segments, -1, 3)
    refraction = refraction_displacement(zenith_eq @ directions, pointing.refraction_scale)
    observed = directions[:, np.newaxis] + velocity_eq[..., np.newaxis]
    observed += refraction[:, :, np.newaxis] * zenith_eq[..., np.newaxis]
    in_camera = (C @ observed).transpose(1, 0, 3, 2)
    weight = end_weights(C[:, 0], C[:, -1])[:, np.newaxis, np.newaxis]
    ends = in_camera[0] * weight, in_camera[times // 2], in_camera[-1] * weight
    return camera.project(in_camera), end_rates_px(camera, *ends)


def segment_excess(
    xy: Float, rates_px: Float, time_fraction: Float, sigma_px: float, position_px: float, elapsed: Float | None = None
) -> Float:
    """Return the error of segments divided by the tolerance, (segments,), of what `_probe_paths` returns.

    `elapsed` are the fractions of the segments at these times, as `_SegmentEvaluator` takes them; even ones if None.
    NaN or infinite if a probe leaves the hemisphere in front of the camera, or if its path cannot be drawn at all.
    """
    off = xy - xy[0]
    off_x, off_y = off[..., 0], off[..., 1]
    chord_x, chord_y = off_x[-1], off_y[-1]
    length = np.hypot(chord_x, chord_y)
    safe_length = np.where(length > 0, length, 1.0)
    along_x, along_y = np.where(length > 0, chord_x, 1.0) / safe_length, chord_y / safe_length
    s = off_x * along_x + off_y * along_y
    p = off_y * along_x - off_x * along_y
    short = length < SHAPE_LIMITS.short_sigma * sigma_px
    off_px, error = np.zeros(short.shape), np.zeros(short.shape)
    # Most exposures need only one of the two.
    if np.count_nonzero(short) < short.size:
        t = _even_fractions(len(s))[:, np.newaxis] if elapsed is None else elapsed
        rate_x, rate_y = rates_px[..., 0], rates_px[..., 1]
        rates = np.stack([rate_x * along_x + rate_y * along_y, rate_y * along_x - rate_x * along_y])
        off_px, error = _curved_path_error(s, p, t[..., np.newaxis], rates, length, sigma_px)
    if np.count_nonzero(short):
        if elapsed is not None:
            s, p = (np.concatenate([of[:1], of[2:-2], of[-1:]]) for of in (s, p))
        off_px, error = (
            np.where(short, 0.0, off_px),
            np.where(short, _two_gaussians_error(s, p, length, sigma_px), error),
        )

    level = 2.5 * sigma_px / np.maximum(length, 1e-9)
    level = np.minimum(1.0, time_fraction[:, np.newaxis] * np.minimum(4.0, level))
    per_error = np.maximum(1 / TOLERANCES.trail_fraction, level * (1 / TOLERANCES.peak_fraction))
    excess = np.maximum(off_px * (1 / position_px), error * per_error)
    return np.asarray(excess.max(axis=-1))


def _two_gaussians_error(s: Float, p: Float, length: Float, sigma_px: float) -> Float:
    """Return the flux error of a path drawn as two Gaussians, (segments, probes): from differences of moments.

    `s`, `p` (times, segments, probes): positions along the chord and perpendicular to it at even times, px; `length`
    (segments, probes): length of the chord, px.
    """
    half = len(s) // 2
    ahead, aside = s[half] - length / 2, p[half]
    off_s, off_p = s - (length / 2 + 2 * ahead / 3), p - 2 * aside / 3
    off_s2, off_p2 = off_s * off_s, off_p * off_p
    powers = np.stack([off_s, off_p, off_s2, off_p2, off_s * off_p]).reshape(5, len(s), -1)
    mean_s, mean_p, var_s, var_p, covariance = (_simpson_weights(len(s)) @ powers).reshape(5, *length.shape)
    # The covariance of both Gaussians: of a motion with an even change it would be 4 / 45 (two_gaussians.glsl).
    var_s_error = np.abs(var_s - (length * length / 12 + _CHANGE_VARIANCE * ahead * ahead))
    var_p_error = np.abs(var_p - _CHANGE_VARIANCE * aside * aside)
    covariance_error = np.abs(covariance - _CHANGE_VARIANCE * ahead * aside)
    second_order = (var_s_error + var_p_error + covariance_error) / (2 * sigma_px**2)
    extent2 = (off_s2 + off_p2).max(axis=0) / sigma_px**2
    return np.asarray(0.61 / sigma_px * np.hypot(mean_s, mean_p) + second_order + 4e-4 * extent2 * extent2 * extent2)


def _curved_path_error(
    s: Float, p: Float, t: Float, rates: Float, length: Float, sigma_px: float
) -> tuple[Float, Float]:
    """Return the largest position error, px, and the flux error of a curved path, (segments, probes) both.

    The curve and its flux per length are those of `curved_path` in `star_path.frag`; positions of the same time are
    compared.  Parameters as for `_two_gaussians_error`, but `t`, the elapsed fractions, (times, segments or 1, 1), and
    `rates` (2, 2, segments, probes): of s and p, at the start and the end, px.
    """
    half = len(s) // 2
    safe_length = np.maximum(length, 1e-9)
    x, offset = s / safe_length, p[half] / safe_length
    (rate_start, rate_end), (across_start, across_end) = rates / safe_length
    slowest = 1 / SHAPE_LIMITS.max_end_flux
    is_drawn = np.minimum(rate_start, rate_end) > slowest
    rate_start, rate_end = np.maximum(rate_start, slowest), np.maximum(rate_end, slowest)
    flux_slope = 4 * x[half] - 2
    flux_curvature = 0.75 * (1 / rate_start + 1 / rate_end) - 1.5
    asymmetry = -(across_start / rate_start + across_end / rate_end) / 2
    curvature = offset / np.maximum(x[half] * (1 - x[half]), 0.05) - asymmetry * (2 * x[half] - 1)
    is_drawn &= np.abs(flux_slope) + np.abs(flux_curvature) < SHAPE_LIMITS.max_flux_variation

    m = 2 * x - 1
    to_ends = x * (1 - x)
    drawn_time = x - to_ends * (flux_slope + flux_curvature * m * (2 / 3))
    flux = 1 + flux_slope * m + flux_curvature * (2 / 3 - 4 * to_ends)
    late = drawn_time - t
    off_along = length * late / np.maximum(flux, 0.1)
    off_across = p - length * to_ends * (curvature + asymmetry * m)
    off_px = np.sqrt((off_along * off_along + off_across * off_across).max(axis=0))
    # A displacement along the path changes the flux only where it varies, and no more than one across the path.
    uneven = (np.abs(np.diff(late, axis=0)) / np.maximum(np.diff(t, axis=0), _SHORTEST)).max(axis=0)
    along = np.minimum(uneven, np.abs(off_along).max(axis=0) * (0.7 / sigma_px))
    # trail.frag neglects a tenth to a quarter of the square of the slope between the path's ends and its chord.
    error = along + np.abs(off_across).max(axis=0) * (0.7 / sigma_px) + 0.3 * curvature * curvature
    return off_px, np.where(is_drawn, error, np.inf)


@lru_cache(maxsize=16)
def _even_fractions(count: int) -> Float:
    """Return evenly spaced elapsed fractions of a segment from 0 to 1, (count,)."""
    fractions = np.arange(count) / (count - 1)
    fractions.flags.writeable = False
    return fractions


@lru_cache(maxsize=16)
def _simpson_weights(count: int) -> Float:
    """Return the weights of Simpson's rule for the mean of evenly spaced samples, an odd number of them."""
    weights = np.where(np.arange(count) % 2, 4.0, 2.0) / (3 * (count - 1))
    weights[[0, -1]] /= 2
    weights.flags.writeable = False
    return weights
