"""Stars behind the horizon: when they rise and set during an exposure, and its ridges.

The horizon moves by 7e-5 rad/s, and float32 directions are good to 6e-8 rad: a crossing that a shader computed would be
up to a millisecond off, in which a star moves by 5 px at 300 deg/s.  Therefore all of it is computed in float64.
"""

from dataclasses import dataclass, replace
from math import ceil, inf

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.render.motion.pointing import CameraMotion, Pointing
from glstar.render.motion.starpaths import view_limit_rad
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.transmission import Sources
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.observed.stars import SIDEREAL_RAD_PER_S

# Between the times at which the height of stars above the horizon is computed, they move by this at most, px.
_RIDGE_STEP_PX = 0.1
# These times at least and at most.
_FEWEST_RIDGE_TIMES, _MOST_RIDGE_TIMES = 5, 513
# Segments in which a star sets or rises are divided into parts in which stars move by this at most, px.
_RIDGE_PART_PX = 0.05
# Parts of such a segment at least and at most: a star that hardly moves may set too.
_FEWEST_PARTS_AT_RIDGE, _MOST_PARTS_AT_RIDGE = 16, 512


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """A horizon profile behind which stars set and rise during one exposure: an `Attenuator`."""

    motion: CameraMotion  # With the profile in its sky
    exposure: Exposure
    px_per_rad: float  # Scale of the image
    max_change: float = inf  # Segments are divided where a star sets, whatever the change

    @property
    def min_times(self) -> int:
        """Number of times between which stars move little above the ridge."""
        return int(np.clip(ceil(self._set_px / _RIDGE_STEP_PX) + 1, _FEWEST_RIDGE_TIMES, _MOST_RIDGE_TIMES))

    @property
    def _set_px(self) -> float:
        """By how much stars move with respect to the ground during the exposure, px."""
        return SIDEREAL_RAD_PER_S * (self.exposure.stop_utc_s - self.exposure.start_utc_s) * self.px_per_rad

    def fraction(self, sources: Sources, times: int) -> Float:
        """Return which part of the half intervals before and after each time stars are up, (times, m).

        Their height above the horizon changes linearly in each, so the integral over the exposure is exact.
        """
        (pointing,) = self.motion.pointings(np.linspace(self.exposure.start_utc_s, self.exposure.stop_utc_s, times))
        height = pointing.clearance(sources.direction_eq)
        middle = (height[1:] + height[:-1]) / 2
        before, after = _part_above(middle, height[1:]), _part_above(height[:-1], middle)
        inside = (before[:-1] + after[1:]) / 2
        return np.concatenate([after[:1], inside, before[-1:]])

    def parts(self, fraction: Float, time_fraction: Float) -> NDArray[np.intp]:
        """Return into how many equal parts segments are divided, so that trails end at the ridge, (s,).

        `fraction`: that of `fraction`; `time_fraction` (s,): durations of the segments; they add up to 1.  Returns 1
        where no star sets or rises.
        """
        parts = np.ceil(self._set_px * time_fraction / _RIDGE_PART_PX).clip(
            _FEWEST_PARTS_AT_RIDGE, _MOST_PARTS_AT_RIDGE
        )
        changes = (np.diff(fraction, axis=0) != 0).any(axis=1)
        before = np.concatenate([[0], np.cumsum(changes)])
        ends = np.concatenate([[0.0], np.cumsum(time_fraction)]) / time_fraction.sum() * len(changes)
        # Of all intervals that a segment touches.
        first, last = np.floor(ends[:-1] + 1e-9).astype(np.intp), np.ceil(ends[1:] - 1e-9).astype(np.intp)
        return np.where(before[last] > before[first], parts, 1).astype(np.intp)

    def divided(self, trails: AnalyticSegments, sources: Sources) -> AnalyticSegments:
        """Return trails of shorter segments where a source sets or rises."""
        if not len(sources.direction_eq):
            return trails
        return divided(trails, self.parts(self.fraction(sources, self.min_times), trails.time_fraction))


def _part_above(first: Float, last: Float) -> Float:
    """Return the part in which a quantity is positive that changes linearly from one value to another."""
    low, high = np.minimum(first, last), np.maximum(first, last)
    span = high - low
    part = (high.clip(min=0.0) - low.clip(min=0.0)) / np.where(span > 0, span, 1.0)
    return np.where(span > 0, part, np.where(low >= 0, 1.0, 0.0))


def divided(trails: AnalyticSegments, parts: NDArray[np.intp]) -> AnalyticSegments:
    """Return trails along the same conics, whose segments are divided into numbers of equal parts, (s,)."""
    if parts.max() == 1:
        return trails
    pointing = trails.pointing
    segment = np.repeat(np.arange(len(parts)), 2 * parts)
    first = np.repeat(np.cumsum(2 * parts) - 2 * parts, 2 * parts)
    elapsed = (np.arange(len(segment)) - first) / (2 * parts[segment])
    u, weight = elapsed[:, np.newaxis, np.newaxis], trails.end_weight[segment][:, np.newaxis, np.newaxis]
    C = pointing.C_camera_eq
    start, middle, end = C[2 * segment] * weight, C[2 * segment + 1], C[2 * segment + 2] * weight
    between = start + u * (4 * middle - 3 * start - end + u * 2 * (start - 2 * middle + end))
    between /= np.linalg.norm(between, axis=2, keepdims=True).mean(axis=1, keepdims=True)
    zenith, velocity = (_between(v, segment, elapsed) for v in (pointing.zenith_eq, pointing.velocity_eq))
    unit_zenith = zenith / np.linalg.norm(zenith, axis=1, keepdims=True)
    pole = pointing.pole_eq
    fine = replace(
        pointing,
        C_camera_eq=np.concatenate([between, C[-1:]]),
        zenith_eq=np.concatenate([unit_zenith, pointing.zenith_eq[-1:]]),
        velocity_eq=np.concatenate([velocity, pointing.velocity_eq[-1:]]),
        pole_eq=None if pole is None else np.concatenate([_between(pole, segment, elapsed), pole[-1:]]),
    )
    return AnalyticSegments(fine, np.repeat(trails.time_fraction / parts, parts))


def _between(vectors: Float, segment: NDArray[np.intp], elapsed: Float) -> Float:
    """Return vectors between those at the ends of segments."""
    part = elapsed[:, np.newaxis]
    return np.asarray((1 - part) * vectors[2 * segment] + part * vectors[2 * segment + 2])


# A fraction of the exposure, beyond its end by more than any rounding.
NEVER = 2.0

# How far the zenith may move between the times of the segments, relative to its largest distance from the first.
_ZENITH_MARGIN = 2.0
# Change of a height, a sine, by rounding.
_ROUNDING = 1e-9


def rise_and_set(trails: AnalyticSegments, direction_eq: NDArray[np.float64], camera: Camera) -> Float:
    """Return when stars rise above the apparent horizon and set, or come into the view of a lens and leave it.

    `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox.  Returns (m, 2) elapsed
    fractions of the exposure: a star is up from the first to the second; if the second is earlier, until the second and
    again from the first.  0 of a star that is up at the start, `NEVER` of a star that does not rise or does not set.
    Within a segment the sine of an altitude is the quadratic through its values at the start, the middle and the end.
    """
    pointing = trails.pointing
    moved = np.linalg.norm(pointing.zenith_eq - pointing.zenith_eq[0], axis=1).max()
    height = pointing[:1].heights(direction_eq)[0]
    is_up, may_cross = height >= 0, np.abs(height) <= _ZENITH_MARGIN * moved + _ROUNDING
    if camera.lens is not None:
        limit_rad, boresight = view_limit_rad(camera), pointing.boresight_eq
        swing_rad = np.arccos(np.clip((boresight @ boresight[0]).min(), -1, 1)) + MAX_REFRACTION_RAD
        angle_rad = np.arccos(np.clip(direction_eq @ boresight[0], -1, 1))
        is_up &= angle_rad < limit_rad
        may_cross |= np.abs(angle_rad - limit_rad) <= swing_rad
    times, near = _without_crossing(is_up), np.flatnonzero(may_cross)
    if near.size:
        heights = pointing.heights(direction_eq[near])
        if camera.lens is not None:
            heights = np.minimum(heights, _above_limit(pointing, direction_eq[near], camera))
        times[near] = _crossings(heights, trails.time_fraction)
    return times


def _above_limit(pointing: Pointing, direction_eq: Float, camera: Camera) -> Float:
    """Return how far within the view of a lens stars are, as differences of cosines, (n, m)."""
    in_camera = pointing.to_camera(direction_eq, below_horizon=True)
    cosine = in_camera[..., 2] / np.linalg.norm(in_camera, axis=-1)
    return np.asarray(cosine - np.cos(view_limit_rad(camera)))


def _without_crossing(is_up: NDArray[np.bool_]) -> Float:
    """Return `rise_and_set` of stars that are up, or not, throughout."""
    return np.column_stack([np.where(is_up, 0.0, NEVER), np.full(len(is_up), NEVER)])


def _crossings(heights: Float, time_fraction: Float) -> Float:
    """Return `rise_and_set` of a few stars: from their heights at all times, (n, m)."""
    is_up = heights >= 0
    changes = is_up[1:] != is_up[:-1]
    stars = np.arange(heights.shape[1])
    times = _without_crossing(is_up[0])
    # A star crosses the horizon at most twice a day; the third crossing of a longer exposure is ignored.
    for _ in range(2):
        half = np.argmax(changes, axis=0)
        crosses = np.flatnonzero(changes[half, stars])
        time = _time_of_crossing(heights, time_fraction, half)
        times[crosses, is_up[half, stars].astype(np.intp)[crosses]] = time[crosses]
        changes[half, stars] = False
    return times


def _time_of_crossing(heights: Float, time_fraction: Float, half: NDArray[np.intp]) -> Float:
    """Return when the quadratic through the heights of each star is 0 in one half of a segment, as a fraction."""
    stars, segment = np.arange(heights.shape[1]), half // 2
    start, middle, end = (heights[2 * segment + k, stars] for k in range(3))
    before, after = heights[half, stars], heights[half + 1, stars]
    # Before + (slope + bend v) v, v the elapsed fraction of the half; signs such that it decreases through 0.
    sign = np.where(before >= 0, 1.0, -1.0)
    bend = sign * (start - 2 * middle + end) / 2
    slope = sign * (after - before) - bend
    root = np.sqrt(np.maximum(slope * slope - 4 * bend * sign * before, 0.0)) - slope
    elapsed = np.where(root > 0, 2 * sign * before / np.where(root > 0, root, 1.0), 0.0).clip(0.0, 1.0)
    begins = np.cumsum(time_fraction) - time_fraction
    return np.asarray(begins[segment] + (half % 2 + elapsed) / 2 * time_fraction[segment])
