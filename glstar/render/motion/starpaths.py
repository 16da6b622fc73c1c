"""Paths of stars on the image over an exposure: sampled at discrete times, or conic segments."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import ceil, pi, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Mask
from glstar.camera.distortion import LENS_MODELS
from glstar.camera.model import Camera

# Pixel positions that are computed together: 32768 of them, 512 KiB, stay in the processor's cache.
_POSITIONS_PER_BLOCK = 1 << 15
# Times that are computed together for a sky of many stars, where a smaller block costs more than a cache miss.
_MIN_TIMES_PER_BLOCK = 8

# Gauss-Legendre quadrature with three nodes, on [0, 1]: exact up to the fifth power.
QUADRATURE_NODES = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
QUADRATURE_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18

# Samples of an analytic trail per exposure, whatever its length: truth counts them for its fractions.
_MIN_SAMPLES = 100


def times_per_block(star_count: int) -> int:
    """Return the number of times at which the positions of some stars are computed together."""
    return max(_MIN_TIMES_PER_BLOCK, _POSITIONS_PER_BLOCK // max(star_count, 1))


@dataclass(frozen=True, slots=True, eq=False)
class SampledPaths:
    """Paths of m stars over a part of an exposure, sampled at n times."""

    xy_px: Float  # (2, n, m) columns and rows, px; NaN behind the camera and below the horizon
    time_fraction: Float  # (n,) fraction of the exposure that each sample represents
    is_at_rest: bool = False  # Whether the stars do not move during a sample, as in sub-exposures

    @property
    def bounds_px(self) -> Float:
        """Minimum and maximum column and row of each path, (2, m, 2) px; NaN where any sample is NaN."""
        return _bounds(self.xy_px.min(axis=1), self.xy_px.max(axis=1))

    @property
    def weighted_sum_px(self) -> Float:
        """Sum of the samples weighted by their time fractions, (2, m) px; NaN where any sample is NaN."""
        return np.stack([self.time_fraction @ coordinate for coordinate in self.xy_px])

    def samples(self, stars: NDArray[np.intp]) -> Iterator[tuple[Float, Float]]:
        """Yield positions of the stars with some indices, (k,), a block of times at a time.

        Yields `xy_px` (n, k, 2): positions (x, y), px, NaN behind the camera and below the horizon; and
        `time_fraction` (n,): fraction of the exposure that each sample represents.
        """
        if stars.size:
            yield np.moveaxis(self.xy_px.take(stars, axis=2), 0, -1), self.time_fraction


@dataclass(frozen=True, eq=False)
class ConicPaths:
    """Paths of m stars over an exposure as analytic trails draw them: one conic per segment.

    In each of s segments the vector to a star is a quadratic function of time through its values at the segment's
    start, middle and end.  A pinhole projects it to a conic (a rational quadratic curve), a lens to another curve.
    """

    camera: Camera
    # (3, 2 s + 1, m) vectors in the camera frame at the start, the middle and the end of the first segment, which is
    # the start of the second, and so on; NaN below the horizon.
    nodes: Float
    weight: Float  # (s,) projective weight of both ends of each segment: see `end_weights`
    time_fraction: Float  # (s,) duration of each segment as a fraction of the exposure
    spacing_px: float  # Maximum distance between samples of a star on the image, px

    @cached_property
    def sample_counts(self) -> NDArray[np.intp]:
        """Number of equal parts of each segment, (s,); a path is sampled in the middle of each part."""
        chord_px = self.nodes_px[:, 2::2] - self.nodes_px[:, :-2:2]
        length_px = np.sqrt((chord_px * chord_px).sum(axis=0))  # five times as fast as hypot
        on_image = self.camera.contains(self.nodes_px[:, 1::2].transpose(1, 2, 0))
        longest_px = np.fmax.reduce(length_px, axis=1, where=on_image, initial=0.0)
        counts = np.maximum(np.ceil(longest_px / self.spacing_px), np.ceil(_MIN_SAMPLES * self.time_fraction))
        return np.asarray(counts, dtype=np.intp)

    def pieces(self) -> Iterator["ConicPaths"]:
        """Yield the paths of all stars over parts of the exposure: about 200 samples, or one segment with more.

        Most stars are inside or outside the image in each.
        """
        piece = np.cumsum(self.sample_counts) // (2 * _MIN_SAMPLES)
        if piece[-1] == 0:
            yield self
            return
        first = np.flatnonzero(np.diff(piece, prepend=-1))
        for start, stop in zip(first, [*first[1:], len(piece)], strict=True):
            nodes, segments = slice(2 * start, 2 * stop + 1), slice(start, stop)
            paths = replace(
                self,
                nodes=self.nodes[:, nodes],
                weight=self.weight[segments],
                time_fraction=self.time_fraction[segments],
            )
            # Cached properties of the whole are not computed again.
            vars(paths).update(nodes_px=self.nodes_px[:, nodes], sample_counts=self.sample_counts[segments])
            yield paths

    @property
    def bounds_px(self) -> Float:
        """`SampledPaths.bounds_px`, or slightly larger bounds."""
        low, high = self.segment_bounds_px
        return _bounds(low.min(axis=1), high.max(axis=1))

    @cached_property
    def segment_bounds_px(self) -> tuple[Float, Float]:
        """Minimum and maximum columns and rows of each segment, or slightly larger bounds, (2, s, m) px each.

        NaN where a position is NaN.
        """
        start, middle, end = self._weighted
        first_px, middle_px, last_px = self.nodes_px[:, :-2:2], self.nodes_px[:, 1::2], self.nodes_px[:, 2::2]
        low, high = np.minimum(first_px, last_px), np.maximum(first_px, last_px)
        if self.camera.lens is None:
            # A conic does not leave the triangle of its ends and the intersection of the tangents there.
            apex = _projected(self.camera, 2 * middle - (start + end) / 2)
            return np.minimum(low, apex, out=low), np.maximum(high, apex, out=high)
        # Of the ends, the quarters and the middle, and of how far a curve leaves them.
        early, late = self._quarters_px
        for at_px in (middle_px, early, late):
            np.minimum(low, at_px, out=low)
            np.maximum(high, at_px, out=high)
        bend_px = np.maximum(np.abs(first_px - 2 * early + middle_px), np.abs(middle_px - 2 * late + last_px))
        bend_px /= 4
        return low - bend_px, high + bend_px

    def weighted_sum_of(self, counted: Mask) -> Float:
        """Return the integral of position over some of the segments of each star, (s, m): (2, m) px."""
        return np.stack([self.time_fraction @ np.where(counted, axis, 0.0) for axis in self._ninetieths_px]) / 90

    def integral_between(self, begin: Float, end: Float, counted: Mask) -> tuple[Float, Float]:
        """Return the time, (m,), and the integral of position, (2, m) px, of each star between two times of its own.

        `begin`, `end` (m,): elapsed fractions of the exposure since the start of the first segment; `counted` (s, m):
        which segments of each star count.
        """
        since_start = np.zeros((3, len(self.time_fraction) + 1, len(begin)))
        shares = self.time_fraction[:, np.newaxis] * counted
        np.cumsum(shares, axis=0, out=since_start[0, 1:])
        np.cumsum(np.where(counted, self._ninetieths_px * (shares / 90), 0.0), axis=1, out=since_start[1:, 1:])
        ends = np.cumsum(self.time_fraction)
        times = np.concatenate([begin, end]).clip(0.0, ends[-1])
        segment = ends.searchsorted(times, "right").clip(max=len(ends) - 1)
        star = np.tile(np.arange(len(begin)), 2)
        before_end = times - ends[segment]
        in_segment = np.vstack(
            [self.time_fraction[segment] + before_end, self._since_start_of(segment, star, before_end)]
        )
        integral = since_start[:, segment, star] + np.where(counted[segment, star], in_segment, 0.0)
        time, *xy = integral[:, len(begin) :] - integral[:, : len(begin)]
        return time, np.stack(xy)

    def _since_start_of(self, segment: NDArray[np.intp], star: NDArray[np.intp], before_end: Float) -> Float:
        """Return integrals of the positions of stars since the start of a segment, all (n,): (2, n) px."""
        whole = self.time_fraction[segment]
        part = whole + before_end
        parameter = parameter_at(part / whole * QUADRATURE_NODES[:, np.newaxis], self.weight[segment])
        start, rate, bend = _quadratics(*(of[:, segment, star][:, np.newaxis] for of in self._weighted))
        xy_px = _projected(self.camera, start + parameter * (rate + parameter * bend))
        return np.asarray(part * np.einsum("n,xnp->xp", QUADRATURE_WEIGHTS, xy_px))

    @cached_property
    def _ninetieths_px(self) -> Float:
        """Mean positions during each segment, (2, s, m) px, times 90."""
        # Boole's rule: the paths are so smooth that it is exact to float64.
        early_px, late_px = self._quarters_px
        ninetieths = early_px + late_px
        ninetieths *= 32
        ninetieths += 12 * self.nodes_px[:, 1::2]
        at_ends = 7 * self.nodes_px[:, ::2]
        ninetieths += at_ends[:, :-1]
        ninetieths += at_ends[:, 1:]
        return ninetieths

    @cached_property
    def _quarters_px(self) -> tuple[Float, Float]:
        """Positions at a quarter and at three quarters of the time of each segment, (2, s, m) px each."""
        start, middle, end = self._weighted
        u = parameter_at(np.full(len(self.weight), 0.25), self.weight)[:, np.newaxis]
        between = 4 * u * (1 - u) * middle
        of_near, of_far = (1 - u) * (1 - 2 * u), u * (2 * u - 1)
        early, late = (of_near * near + of_far * far for near, far in ((start, end), (end, start)))
        early += between
        late += between
        return _projected(self.camera, early), _projected(self.camera, late)

    def positions(self, segment: NDArray[np.intp], elapsed: Float) -> Float:
        """Return the positions of all stars at some times.

        `segment` (n,) intp contains each time; `elapsed` (n,): fraction of the segment that has elapsed, 0 to 1.
        Returns (n, m, 2) positions (x, y), px; NaN behind the camera and below the horizon.
        """
        parameter = parameter_at(elapsed, self.weight[segment])
        return self.camera.project(_quadratic(self._quadratics(), segment, parameter).transpose(1, 2, 0))

    def samples(self, stars: NDArray[np.intp]) -> Iterator[tuple[Float, Float]]:
        """Yield the positions of some of the stars, as `SampledPaths.samples` does."""
        if not stars.size:
            return
        quadratics, times = self._quadratics(stars), self._times()
        parameter, block_size = self._parameters(times), times_per_block(len(stars))
        for start in range(0, len(times.segment), block_size):
            block = slice(start, start + block_size)
            vectors = _quadratic(quadratics, times.segment[block], parameter[block])
            yield self.camera.project(vectors.transpose(1, 2, 0)), times.time_fraction[block]

    def _times(self, finer: int = 1, least: int = 1) -> "_SampleTimes":
        """Return the times of all samples, `finer` times as many as `sample_counts` says, and some of each segment."""
        counts = np.maximum(finer * self.sample_counts, least)
        segment = np.repeat(np.arange(len(counts)), counts)
        first = np.repeat(np.cumsum(counts) - counts, counts)
        elapsed = (np.arange(len(segment)) - first + 0.5) / counts[segment]
        return _SampleTimes(counts, segment, elapsed, self.time_fraction[segment] / counts[segment])

    def _parameters(self, times: "_SampleTimes") -> Float:
        return parameter_at(times.elapsed, self.weight[times.segment])

    def segment_samples(
        self, segment: NDArray[np.intp], star: NDArray[np.intp], finer: int, least: int
    ) -> Iterator["SegmentSamples"]:
        """Yield the samples of some segments of some stars, (p,) both, some of them at a time: see `_times`."""
        if not len(segment):
            return
        times = self._times(finer, least)
        u, begins = self._parameters(times), np.cumsum(times.time_fraction) - times.time_fraction
        basis = (1 - u) * (1 - 2 * u), 4 * u * (1 - u), u * (2 * u - 1)
        nodes = [of.reshape(3, -1) for of in self._weighted]
        ends = np.cumsum(times.counts)
        block = max(1, _POSITIONS_PER_BLOCK // (int(times.counts.max()) + 2))
        for start in range(0, len(segment), block):
            of_segment, of_star = segment[start : start + block], star[start : start + block]
            # And one on either side, which belongs to another segment, for the distance between samples.
            many = times.counts[of_segment] + 2
            last = np.cumsum(many) - 1
            first = last - many + 1
            sample = np.arange(last[-1] + 1) + np.repeat(ends[of_segment] - many + 1 - first, many)
            own = np.ones(len(sample), dtype=np.bool_)
            own[first] = own[last] = False
            np.clip(sample, 0, ends[-1] - 1, out=sample)
            beside = np.concatenate([first, last])
            at_beside = times.segment[sample[beside]] * self.nodes.shape[2] + np.tile(of_star, 2)
            at = of_segment * self.nodes.shape[2] + of_star
            vectors = np.zeros((3, len(sample)))
            for of, weight in zip(nodes, basis, strict=True):
                values = np.repeat(of.take(at, axis=1), many, axis=1)
                values[:, beside] = of.take(at_beside, axis=1)
                values *= weight.take(sample)
                vectors += values
            yield SegmentSamples(
                self.camera.project(vectors.T),
                sample,
                np.flatnonzero(own),
                np.repeat(of_star, many - 2),
                begins.take(sample[own]),
                times.time_fraction.take(sample[own]),
            )

    def _weighted_nodes(self, nodes: Float) -> tuple[Float, Float, Float]:
        """Return the start, the middle and the end of each segment, the ends multiplied by their weights."""
        weight = self.weight[:, np.newaxis]
        return nodes[:, :-2:2] * weight, nodes[:, 1::2], nodes[:, 2::2] * weight

    @cached_property
    def _weighted(self) -> tuple[Float, Float, Float]:
        return self._weighted_nodes(self.nodes)

    def _quadratics(self, stars: NDArray[np.intp] | None = None) -> tuple[Float, Float, Float]:
        """Return coefficients of 1, u and u^2 of the vectors to some stars, u that of `parameter_at`."""
        if stars is None:
            return _quadratics(*self._weighted)
        return _quadratics(*self._weighted_nodes(self.nodes.take(stars, axis=2)))

    @cached_property
    def nodes_px(self) -> Float:
        """Columns and rows of all nodes, (2, 2 s + 1, m) px."""
        return _projected(self.camera, self.nodes)


class _SampleTimes(NamedTuple):
    """When paths are sampled: in the middle of equal parts of each of s segments."""

    counts: NDArray[np.intp]  # (s,) parts of each segment
    segment: NDArray[np.intp]  # (n,) the segment of each part
    elapsed: Float  # (n,) fraction of the segment that has elapsed
    time_fraction: Float  # (n,) duration of each part as a fraction of the exposure


class SegmentSamples(NamedTuple):
    """Samples of segments of paths, one after the other, each segment between two samples of its neighbours."""

    xy_px: Float  # (k, 2) positions (x, y), px; NaN behind the camera and below the horizon
    number: NDArray[np.intp]  # (k,) number of each sample on its path; that of a neighbour that there is not is its own
    own: NDArray[np.intp]  # (q,) indices of those that are not of neighbours
    star: NDArray[np.intp]  # (q,) index of the star of each of these
    begins: Float  # (q,) when the time that it represents begins, fractions of the exposure since the first segment
    time_fraction: Float  # (q,) fraction of the exposure that it represents

    def own_values(self, values: Float) -> tuple[Float, Float]:
        """Return the values, (k,), of own samples, and by how much they change from one to the next."""
        before, after = self.own - 1, self.own + 1
        step = values[after] - values[before]
        step /= np.maximum(self.number[after] - self.number[before], 1)
        return values[self.own], step


def end_weights(starts: Float, ends: Float) -> Float:
    """Return the projective weights of the ends of rotations relative to their middles, (n,).

    `starts`, `ends` (n, 3, 3): rotation matrices into the camera frame at the start and the end of each rotation.

    The quadratic through the weighted ends and the middle follows the rotation exactly on a pinhole's image: a vector
    that rotates by an angle is a + b cos + c sin of that angle.  Multiplied by 1 + t^2, t the tangent of half the
    angle, it is a quadratic function of t, and t is nearly proportional to time.  A pinhole is insensitive to the
    factor, which is 1 / cos^2(rotation / 4) at the ends if the angle is measured from the middle.
    """
    chord = ends - starts
    sine2 = np.einsum("nij,nij->n", chord, chord) / 8  # of half the rotation
    return np.asarray(2 / (1 + np.sqrt(np.maximum(1 - sine2, 0.0))))


def parameter_at(elapsed: Float, weight: Float) -> Float:
    """Return the parameters of the quadratics through weighted ends at elapsed fractions of rotations, all (n,).

    A parameter is (1 + tan(x A) / tan(A)) / 2, 0 to 1, with x = 2 elapsed - 1 and A the angle whose squared tangent is
    weight - 1 (`end_weights`).  The angle of a uniform rotation is proportional to time, and the quadratic's parameter
    to the tangent of half the angle.  If time took the parameter's place, a path of 16 degrees would be up to 0.09 px
    off at f = 968 px.
    """
    tangent = np.sqrt(np.maximum(weight - 1, 1e-12))
    return np.asarray(0.5 + 0.5 * np.tan((2 * elapsed - 1) * np.arctan(tangent)) / tangent)


def end_rates_px(camera: Camera, start: Float, middle: Float, end: Float) -> Float:
    """Return how fast the quadratics through weighted vectors begin and end on the image, (2, ..., 2) px per parameter.

    `start`, `middle`, `end` (..., 3): vectors in the camera frame, the ends multiplied by their weights.
    """
    rates = np.stack([4 * middle - 3 * start - end, start - 4 * middle + 3 * end])
    return camera.project_with_rates(np.stack([start, end]), rates)[1]


def _quadratics(start: Float, middle: Float, end: Float) -> tuple[Float, Float, Float]:
    """Return coefficients of 1, u and u^2 of quadratics through values at u = 0, 1/2 and 1."""
    return start, 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)


def _quadratic(coefficients: tuple[Float, Float, Float], segment: NDArray[np.intp], parameter: Float) -> Float:
    """Evaluate quadratics, (3, n, m), with coefficients (3, s, m) each, at parameters in segments, both (n,)."""
    u = parameter[:, np.newaxis]
    used = segment[:1] if segment[0] == segment[-1] else segment
    start, rate, curvature = (coefficient.take(used, axis=1) for coefficient in coefficients)
    vectors = u * curvature
    vectors += rate
    vectors *= u
    vectors += start
    return vectors


def _projected(camera: Camera, vectors: Float) -> Float:
    """Return columns and rows, (2, n, m) px, of vectors in the camera frame, (3, n, m)."""
    return camera.project(vectors.transpose(1, 2, 0)).transpose(2, 0, 1)


def _bounds(low: Float, high: Float) -> Float:
    return np.moveaxis(np.stack([low, high]), 1, -1)


# Every exposure of a flight has the same camera.
@lru_cache(maxsize=64)
def probe_rays(camera: Camera) -> NDArray[np.float64]:
    """Return the directions of the probes in the camera frame, (3, k) unit vectors: 9, behind a lens 25 or less.

    Behind a lens that ends on the image, probes near its limit are left out: there a path comes to rest.
    """
    places = np.linspace(-0.5, 0.5, 3 if camera.lens is None else 5)
    columns, rows = (edge * places + (edge - 1) / 2 for edge in (camera.width_px, camera.height_px))
    rays = camera.unit_vectors([(x, y) for y in rows for x in columns]).T
    within_rad = np.pi if camera.lens is None else _PROBED * view_limit_rad(camera)
    rays = rays[:, np.isfinite(rays).all(axis=0) & (np.arccos(np.clip(rays[2], -1, 1)) < within_rad)]
    rays.flags.writeable = False
    return rays


# Part of the largest angle from the axis within which probes are.
_PROBED = 0.97
# Directions that a lens without a limit maps are drawn up to these angles: tangents and the antipode have no position.
_LARGEST_RAD = {True: radians(89.5), False: radians(176.0)}
# And up to where their distance from the axis is this many times that of the farthest corner.
_FARTHEST = 4.0


@lru_cache(maxsize=64)
def view_limit_rad(camera: Camera) -> float:
    """Return the angle from the axis up to which stars are drawn, rad: that of the lens, or far outside the image.

    There a trail begins and ends as at the horizon.
    """
    lens = camera.lens
    if lens is None:
        return pi / 2
    first_step = LENS_MODELS[lens.model].radius
    limit_rad = min(camera.limit_rad, _LARGEST_RAD[first_step is None])
    if first_step is None:
        return limit_rad
    corners = camera.normalized([(x, y) for x in (-0.5, camera.width_px) for y in (-0.5, camera.height_px)])
    angle_rad = np.linspace(0.0, limit_rad, 2000)[1:-1]
    with np.errstate(all="ignore"):  # beyond a pole
        far = ~(np.abs(first_step(lens.coefficients, angle_rad)[0]) < _FARTHEST * np.hypot(*corners.T).max())
    return float(angle_rad[far.argmax()]) if far.any() else limit_rad


def view_radius_rad(camera: Camera, margin_px: float) -> float:
    """Return the largest angle from the optical axis of a position up to a margin beside the image, or more, rad."""
    if camera.lens is None:
        return camera.field_radius_rad + float(np.arctan(margin_px / min(camera.fx_px, camera.fy_px)))
    return _lens_view_radius_rad(camera, 8 * ceil(margin_px / 8))


@lru_cache(maxsize=64)
def _lens_view_radius_rad(camera: Camera, margin_px: int) -> float:
    """Return `view_radius_rad` behind a lens."""
    wider = replace(
        camera,
        width_px=camera.width_px + 2 * margin_px,
        height_px=camera.height_px + 2 * margin_px,
        cx_px=camera.cx_px + margin_px,
        cy_px=camera.cy_px + margin_px,
    )
    return wider.field_radius_rad
