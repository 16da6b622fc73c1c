"""Least-squares segments of analytic trails: fewer than pass through every sample of a rough attitude log.

Within a segment the vector to a star is a quadratic function of time, as in `segmentation`, and consecutive segments
share their ends.  Here the orientations at the starts, middles and ends are fitted to the interpolated attitude by
least squares, so that no star anywhere on the image is farther than a tolerance from its true position at any time.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion.pointing import CameraMotion, Pointing
from glstar.render.motion.segmentation import TOLERANCES, segment_excess
from glstar.render.motion.starpaths import end_rates_px, end_weights, probe_rays
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.rotation import matrix_from_quaternion, quaternion_from_turn, turn_from_matrix
from glstar.sky.air.refraction import refraction_displacement

# Weight of no correction relative to the mean weight of the samples: segments shorter than three samples leave some
# corrections undetermined.
STIFFNESS = 1e-7


def node_corrections(basis: Float, segment: NDArray[np.intp], turn: Float, weight: Float, count: int) -> Float:
    """Return the corrections of nodes, (count, 3) rotation vectors, rad, that minimise weighted squared residuals.

    The nodes are the start, the middle and the end of the first segment, which is the start of the second, and so on.

    - `basis` (n, 3): weight of the start, the middle and the end of its segment in each sample.
    - `segment` (n,) intp: the segment that contains each sample, increasing; each has at least one.
    - `turn` (n, 3): rotation vectors that the corrections shall add up to, rad.
    - `weight` (n,): weights of the samples.

    A sample depends on the three nodes of its segment.  The middle one has no other samples, and is eliminated first;
    the equations of the ends have three diagonals.  Solving takes a time proportional to the number of nodes, on
    one thread: NumPy's dense solver would keep all threads of OpenBLAS busy, and round differently with another number
    of them.  SciPy's banded solver would take a worker longer to load than ten images to draw.
    """
    weighted = basis * weight[:, np.newaxis]
    first, second = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)]).T
    products = weighted[:, first] * basis[:, second]
    right = (weighted[:, :, np.newaxis] * turn[:, np.newaxis]).reshape(-1, 9)
    columns = np.concatenate([products, right], axis=1)
    sums = np.add.reduceat(columns, segment.searchsorted(np.arange(count // 2)))
    stiffness = STIFFNESS * sums[:, :3].sum() / count
    middle, to_start, to_end = sums[:, 1:2] + stiffness, sums[:, 3:4], sums[:, 4:5]
    of_start, of_middle, of_end = (sums[:, at : at + 3] for at in (6, 9, 12))
    # The diagonal and the right sides of the ends of the segments, and what is beside the diagonal.
    ends = np.zeros((count // 2 + 1, 4))
    ends[:-1] += np.hstack([sums[:, :1] - to_start * to_start / middle, of_start - to_start / middle * of_middle])
    ends[1:] += np.hstack([sums[:, 2:3] - to_end * to_end / middle, of_end - to_end / middle * of_middle])
    ends[:, 0] += stiffness
    beside = sums[:, 5:] - to_start * to_end / middle
    corrections = np.empty((count, 3))
    corrections[::2] = _tridiagonal_solution(ends[:, 0].tolist(), beside[:, 0].tolist(), ends[:, 1:].T.tolist()).T
    of_ends = to_start * corrections[:-2:2] + to_end * corrections[2::2]
    corrections[1::2] = (of_middle - of_ends) / middle
    return corrections


def _tridiagonal_solution(diagonal: list[float], beside: list[float], right: list[list[float]]) -> Float:
    """Return the solutions, (k, n), of symmetric positive definite equations with k right sides of n numbers.

    `beside` has the n - 1 elements below the diagonal.  By elimination (Thomas), in Python: LAPACK would be no faster.
    """
    factors = []
    for row, element in enumerate(beside):
        factors.append(element / diagonal[row])
        diagonal[row + 1] -= factors[-1] * element
    solutions = []
    for values in right:
        for row, factor in enumerate(factors):
            values[row + 1] -= factor * values[row]
        solution = [values[-1] / diagonal[-1]]
        for row in range(len(factors) - 1, -1, -1):
            solution.append(values[row] / diagonal[row] - factors[row] * solution[-1])
        solutions.append(solution[::-1])
    return np.array(solutions)


Integer = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class FitLimits:
    """How segments are searched and fitted."""

    # Minimum number of intervals of an exposure at whose ends the attitude is sampled; there are at least two per
    # interval of the log, because a spline bends between its nodes.
    min_samples: int = 32
    min_parts: int = 4  # Minimum number of intervals between samples in a segment
    # Maximum number of parts between two samples of the log at which all segments are sampled alike; more are added
    # only in the segments that need them.
    max_even_parts: int = 8
    # Stars with a narrower point spread function have a proportionally smaller tolerance, px: a displacement by 0.01 px
    # changes a pixel by 0.5 % of the peak at 1.2 px, and a path may be somewhat farther off between the times of
    # comparison.
    sigma_px: float = 1.37
    block: int = 256  # Intervals of the log that are searched together: this bounds memory
    # Fraction of the tolerance that one segment may use in the search; the rest is for the shared ends: with 0.8 the
    # fewest segments of a 200 Hz log are left after those above the tolerance are divided.
    search_fraction: float = 0.8
    rounds: int = 12  # Maximum number of times that segments above the tolerance are divided
    max_parts: int = 24  # Maximum number of parts that a segment is divided into at once
    shortest_s: float = 2e-5  # Shorter segments are not tried, s
    # Segments with fewer samples may be farther from the true path between them, as a spline oscillates.
    few_samples: int = 8
    between_few: float = 1.4  # Factor of the deviation of these segments


LIMITS = FitLimits()
# Times that differ by less than this are the same, s: UTC seconds have a resolution of 2.4e-7 s.
_SAME_S = 1e-6
# Lengths of segments that the search tries, in intervals of the log: in steps of about a quarter.
_LENGTHS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 19, 24, 30, 38, 48, 60, 76, 96, 120, 152, 192, 240)


def fitted_segments(
    motion: CameraMotion,
    nodes_s: Float,
    camera: Camera,
    sigma_px: float,
    tolerance_px: float,
    *,
    psf_sigma_px: float,
    position_px: float = TOLERANCES.position_px,
    readout_s: float = 0.0,
) -> AnalyticSegments | None:
    """Return segments of an exposure that follow the attitude within a tolerance; None if that takes too short ones.

    The fit minimises the integral of the squared rotation between the true orientation and the fitted one.  Therefore
    the mean of that rotation over the exposure is zero, and the mean position of a star on the image is exact to second
    order.

    - `nodes_s` (n,): the exposure's start and end, and the samples of the log between them, UTC seconds since 1970.
    - `camera`: errors are evaluated at the probes of its field (`starpaths.probe_rays`).
    - `sigma_px`, `psf_sigma_px`: standard deviation of a star as the pixels record it, and without the pixel, px.
    - `tolerance_px`: largest distance between a star's true and fitted positions at the same time, px; positive.
    - `position_px`: largest distance between its fitted position and where the shaders draw it, px.
    - `readout_s`: while rows open and while they close, trails end; there stars are at most `position_px` from their
      true positions, too.
    """
    at_ends = max(1.0, tolerance_px / position_px) if readout_s else 1.0
    # Narrower stars show smaller displacements.
    tolerance_px *= min(1.0, psf_sigma_px / LIMITS.sigma_px)
    # An even number, so that the middle of each interval is a sample.
    parts = 2 * ceil(LIMITS.min_samples / (2 * (len(nodes_s) - 1)))
    samples = SampledMotion.of(motion, nodes_s, parts)
    knots_s = samples.search(camera, tolerance_px, samples.strictness(readout_s, at_ends))
    for _ in range(LIMITS.rounds):
        samples = samples.resolving(motion, knots_s)
        fit = SegmentFit.of(motion, samples, knots_s)
        strictness = samples.strictness(readout_s, at_ends)
        deviation, drawing = fit.excess(camera, sigma_px, tolerance_px, position_px, strictness)
        if ((deviation <= 1.0) & (drawing <= 1.0)).all():
            return AnalyticSegments(fit.nodes, fit.time_fraction)
        knots_s = _divided(knots_s, nodes_s, deviation, drawing)
        if np.diff(knots_s).min() < LIMITS.shortest_s:
            return None
    return None


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """The true orientation at the samples of the log and evenly between them."""

    nodes_s: Float  # (k,) the exposure's start and end, and the samples of the log between them, UTC seconds since 1970
    parts: int  # Number of equal parts between two nodes
    times_s: Float  # (n,) times of all samples
    pointing: Pointing  # The orientation at these times
    bends: bool  # Whether the rate varies between two nodes, as along a spline

    @classmethod
    def of(cls, motion: CameraMotion, nodes_s: Float, parts: int) -> Self:
        """Return samples at `parts` times from each node to the next, and at the last node."""
        within = nodes_s[:-1, np.newaxis] + np.diff(nodes_s)[:, np.newaxis] * (np.arange(parts) / parts)
        times_s = np.append(within.ravel(), nodes_s[-1])
        bends = motion.flight.attitude.interpolation != "slerp"
        (pointing,) = motion.pointings(times_s)
        return cls(nodes_s, parts, times_s, pointing, bends)

    def resolving(self, motion: CameraMotion, knots_s: Float) -> Self:
        """Return samples that divide each segment into at least eight parts, or two where the log's rate is constant.

        A quadratic passes through three samples, whatever is between them.
        """
        # A constant rate between two samples of the log is a quadratic of its own.
        needed = LIMITS.min_parts if self.bends else 2
        fewest = int(self._counts(knots_s).min())
        if fewest >= (LIMITS.few_samples if self.bends else needed):
            return self
        parts = min(self.parts * -(-needed // max(fewest, 1)), max(self.parts, LIMITS.max_even_parts))
        even = self if parts == self.parts else self.of(motion, self.nodes_s, parts)
        return even.resolved_around(motion, knots_s)

    def _counts(self, knots_s: Float) -> Integer:
        """Return the number of samples of each segment, without its end."""
        return np.diff(self.times_s.searchsorted(knots_s - _SAME_S))

    def resolved_around(self, motion: CameraMotion, knots_s: Float) -> Self:
        """Return the samples and others in segments with few: one may need a hundred times as many as the others."""
        coarse = np.flatnonzero(self._counts(knots_s) < LIMITS.few_samples)
        if not coarse.size:
            return self
        length_s = knots_s[coarse + 1] - knots_s[coarse]
        fractions = np.arange(LIMITS.few_samples) / LIMITS.few_samples
        even_s = (knots_s[coarse, np.newaxis] + length_s[:, np.newaxis] * fractions).ravel()
        after = self.times_s.searchsorted(even_s).clip(1, len(self.times_s) - 1)
        distance_s = np.minimum(np.abs(self.times_s[after] - even_s), np.abs(self.times_s[after - 1] - even_s))
        return self._with(motion, even_s[distance_s > _SAME_S])

    def _with(self, motion: CameraMotion, added_s: Float) -> Self:
        """Return the samples and others at further times."""
        (added,) = motion.pointings(added_s)
        times_s = np.concatenate([self.times_s, added_s])
        order = np.argsort(times_s, kind="stable")
        own = self.pointing
        pointing = replace(
            own,
            C_camera_eq=np.concatenate([own.C_camera_eq, added.C_camera_eq])[order],
            zenith_eq=np.concatenate([own.zenith_eq, added.zenith_eq])[order],
            velocity_eq=np.concatenate([own.velocity_eq, added.velocity_eq])[order],
        )
        return replace(self, times_s=times_s[order], pointing=pointing)

    def strictness(self, readout_s: float, at_ends: float) -> Float:
        """Return the factor of distances at each sample, (n,): `at_ends` while rows open and close, and 1 between."""
        from_end_s = np.minimum(self.times_s - self.times_s[0], self.times_s[-1] - self.times_s)
        return np.where(from_end_s <= readout_s, at_ends, 1.0)

    def search(self, camera: Camera, tolerance_px: float, strictness: Float) -> Float:
        """Return nodes at which segments begin and end, UTC seconds, from the start to the end of the exposure.

        Each segment is as long as a quadratic function follows the rotation within the tolerance.  This treats rotation
        vectors as additive: `SegmentFit.excess` decides.
        """
        turns_px = _turns_px(self.pointing, camera)
        last = len(self.nodes_s) - 1
        knots = [0]
        for first in range(0, last, LIMITS.block):
            end = min(first + LIMITS.block, last)
            samples = slice(first * self.parts, end * self.parts + 1)
            limit_px = LIMITS.search_fraction * tolerance_px / strictness[samples]
            longest = self._longest(self.times_s[samples], turns_px[samples], limit_px)
            while knots[-1] < end:
                knots.append(min(end, knots[-1] + int(longest[knots[-1] - first])))
        return self.nodes_s[knots]

    def _longest(self, times_s: Float, turns_px: Float, limit_px: Float) -> Integer:
        """Return the most intervals of a segment from each node of a block, given the limit at each sample, (n,)."""
        last = (len(times_s) - 1) // self.parts
        t = times_s - times_s[0]
        longest = np.ones(last + 1, dtype=np.intp)
        axes_px = np.ascontiguousarray(turns_px.T)
        if _follow(t[:, np.newaxis], axes_px[:, :, np.newaxis], limit_px[:, np.newaxis])[0]:
            longest[0] = last
            return longest
        for length in _LENGTHS:
            if length >= last:
                break
            starts = np.arange(0, len(t) - length * self.parts, self.parts)
            window = starts + np.arange(length * self.parts + 1)[:, np.newaxis]
            follows = _follow(t.take(window), axes_px.take(window, axis=1), limit_px.take(window))
            if not follows.any():
                break
            longest[: len(follows)][follows] = length
        return longest


def _turns_px(pointing: Pointing, camera: Camera) -> Float:
    """Return the rotation since the start as the sum of its steps, (n, 3) px at the farthest corner of the image."""
    C = pointing.C_camera_eq
    turns = np.zeros((len(C), 3))
    np.cumsum(turn_from_matrix(C[1:] @ np.swapaxes(C[:-1], 1, 2)), axis=0, out=turns[1:])
    around_axis = np.hypot(camera.width_px, camera.height_px) / 2
    turns *= np.array([camera.max_px_per_rad, camera.max_px_per_rad, around_axis])
    return turns


def _follow(t: Float, values: Float, limit: Float) -> NDArray[np.bool_]:
    """Return whether quadratics fitted to values, (3, n, k), at times t, (n, k), are near all of them, (k,)."""
    # Orthogonal polynomials on the times of each of the k windows.
    count = len(t)
    linear = t - t.sum(axis=0) / count
    square = linear * linear
    variance = square.sum(axis=0)
    quadratic = square - (square * linear).sum(axis=0) / variance * linear
    quadratic -= quadratic.sum(axis=0) / count
    power = (quadratic * quadratic).sum(axis=0)
    residual = values - values.sum(axis=1, keepdims=True) / count
    for basis, norm in ((linear, variance), (quadratic, np.maximum(power, 1e-30 * variance))):
        coefficient = (residual * basis).sum(axis=1) / norm
        residual -= coefficient[:, np.newaxis] * basis
    residual *= residual
    return np.asarray((residual.sum(axis=0) <= limit * limit).all(axis=0))


def _divided(knots_s: Float, nodes_s: Float, deviation: Float, drawing: Float) -> Float:
    """Return knots that divide the segments with an error above 1: what `SegmentFit.excess` returns.

    A path that deviates is divided at samples of the log, where its rate may change; one that cannot be drawn, evenly.
    """
    added = []
    for begin, end, *errors in zip(knots_s[:-1], knots_s[1:], deviation, drawing, strict=True):
        error = max(errors) if np.isfinite(errors).all() else np.nan
        if error <= 1.0:
            continue
        # The error is proportional to the third power of a segment's length.
        parts = int(np.clip(np.ceil(np.cbrt(error)), 2, LIMITS.max_parts)) if np.isfinite(error) else 4
        even_s = begin + (end - begin) * np.arange(1, parts) / parts
        inside_s = nodes_s[nodes_s.searchsorted(begin, "right") : nodes_s.searchsorted(end, "left")]
        if errors[0] > 1.0 and not errors[1] > errors[0] and inside_s.size >= parts - 1:
            even_s = np.unique(inside_s[np.abs(inside_s[:, np.newaxis] - even_s).argmin(axis=0)])
        added.append(even_s)
    return np.sort(np.concatenate([knots_s, *added]))


@dataclass(frozen=True, eq=False)
class SegmentFit:
    """Segments fitted to sampled orientations."""

    sampled: Pointing  # The true orientation at n times
    # The fitted orientation at the start, the middle and the end of the first segment, which is the start of the
    # second, and so on: 2 m + 1 times.
    nodes: Pointing
    time_fraction: Float  # (m,) duration of each segment as a fraction of the exposure
    segment: Integer  # (n,) intp: the segment that contains each sample
    # (n, 3) weight of the segment's start, middle and end in the vector at each sample, before normalization.
    basis: Float
    bends: bool  # Whether the rate varies between two samples of the log

    @classmethod
    def of(cls, motion: CameraMotion, samples: SampledMotion, knots_s: Float) -> Self:
        """Return the least-squares segments between knots, (m + 1,) UTC seconds since 1970, from n samples."""
        times_s, sampled = samples.times_s, samples.pointing
        node_times_s = np.empty(2 * len(knots_s) - 1)
        node_times_s[::2] = knots_s
        node_times_s[1::2] = (knots_s[1:] + knots_s[:-1]) / 2
        (nodes,) = motion.pointings(node_times_s)
        C = nodes.C_camera_eq
        weight = end_weights(C[:-2:2], C[2::2])
        segment = (knots_s.searchsorted(times_s, "right") - 1).clip(0, len(knots_s) - 2)
        u = (times_s - knots_s[segment]) / np.diff(knots_s)[segment]
        at_ends = weight[segment]
        basis = np.stack([at_ends * (1 - u) * (1 - 2 * u), 4 * u * (1 - u), at_ends * u * (2 * u - 1)], axis=1)
        normalized = basis / basis.sum(axis=1, keepdims=True)
        index = 2 * segment[:, np.newaxis] + np.arange(3)
        drawn = np.einsum("nk,nkij->nij", normalized, C[index])
        turn = _small_turn(sampled.C_camera_eq @ np.swapaxes(drawn, 1, 2))
        correction = node_corrections(normalized, segment, turn, np.gradient(times_s), len(C))
        fitted = matrix_from_quaternion(quaternion_from_turn(correction)) @ C
        corrected = replace(nodes, C_camera_eq=fitted)
        return cls(sampled, corrected, np.diff(knots_s) / (knots_s[-1] - knots_s[0]), segment, basis, samples.bends)

    @cached_property
    def _weight(self) -> Float:
        C = self.nodes.C_camera_eq
        return end_weights(C[:-2:2], C[2::2])[:, np.newaxis, np.newaxis]

    def excess(
        self, camera: Camera, sigma_px: float, tolerance_px: float, position_px: float, strictness: Float
    ) -> tuple[Float, Float]:
        """Return the errors of each segment divided by the tolerated error, (m,) each; NaN if unknown.

        `sigma_px`: standard deviation of a star as the pixels record it, px; `tolerance_px`: largest distance from the
        true position at the same time, px; `position_px`: largest distance between fitted and drawn positions at the
        same time, px; `strictness` (n,): factor of the distance at each sample.  Returns `deviation` (m,): the distance
        over the tolerance; `drawing` (m,): the error with which the shaders draw the fitted path, as `segment_excess`
        bounds it.
        """
        # Stars all over the field in the middle of each segment.
        directions = np.swapaxes(self.nodes.C_camera_eq[1::2], 1, 2) @ probe_rays(camera)
        start, middle, end = (_observed(self.nodes[k : 2 * len(directions) + k - 1 : 2], directions) for k in range(3))
        project = camera.project
        vectors = np.einsum("nk,knij->nij", self.basis, np.stack([of[self.segment] for of in (start, middle, end)]))
        true = _observed(self.sampled, directions[self.segment])
        off = project(np.swapaxes(vectors, 1, 2)) - project(np.swapaxes(true, 1, 2))
        distance_px = np.sqrt((off * off).sum(axis=-1).max(axis=1)) * strictness
        first = self.segment.searchsorted(np.arange(len(directions)))
        deviation_px = np.maximum.reduceat(distance_px, first)
        # A quadratic passes close to few samples, whatever is between them.
        if self.bends:
            deviation_px[np.diff(first, append=len(distance_px)) < LIMITS.few_samples] *= LIMITS.between_few
        ends = start * self._weight, middle, end * self._weight
        rates_px = end_rates_px(camera, *(np.swapaxes(of, 1, 2) for of in ends))
        drawn = segment_excess(project(_sampled_path(*ends)), rates_px, self.time_fraction, sigma_px, position_px)
        return deviation_px / tolerance_px, drawn


def _sampled_path(start: Float, middle: Float, end: Float) -> Float:
    """Return vectors along quadratic segments, (9, m, probes, 3)."""
    u = (np.arange(9) / 8)[:, np.newaxis, np.newaxis, np.newaxis]
    vectors = (1 - u) * (1 - 2 * u) * start + 4 * u * (1 - u) * middle + u * (2 * u - 1) * end
    return np.swapaxes(vectors, 2, 3)


def _observed(pointing: Pointing, directions: Float) -> Float:
    """Return observed vectors in the camera frame, (n, 3, probes), of other directions (n, 3, probes) at each time."""
    zenith = pointing.zenith_eq[:, :, np.newaxis]
    sine_altitude = (zenith * directions).sum(axis=1, keepdims=True)
    refraction = refraction_displacement(sine_altitude, pointing.refraction_scale)
    return pointing.C_camera_eq @ (directions + pointing.velocity_eq[:, :, np.newaxis] + refraction * zenith)


def _small_turn(C: Float) -> Float:
    """Return the rotation vectors, (n, 3) rad, of nearly unit matrices with any scale."""
    turn: Float = (C - np.swapaxes(C, 1, 2))[:, [1, 2, 0], [2, 0, 1]]
    turn *= (1.5 / np.trace(C, axis1=1, axis2=2))[:, np.newaxis]
    return turn
