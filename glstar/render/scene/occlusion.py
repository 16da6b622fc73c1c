"""Stars and bodies behind cloud and ridges: what arrives of each segment or sub-exposure of their trails.

Stars that set and rise behind a horizon profile during an exposure.

When stars rise and set during an exposure, in float64.

The horizon moves by 7e-5 rad/s, and float32 directions are good to 6e-8 rad: a crossing that a shader computed would be
up to a millisecond off, in which a star moves by 5 px at 300 deg/s.
"""

from dataclasses import dataclass, replace
from math import ceil
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import CameraMotion, Pointing
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.bodies import BodySources
from glstar.render.scene.clouds import CloudPassage, cloud_passage, cloud_sheet
from glstar.render.scene.culling import DrawList, TouchingStars
from glstar.render.scene.satellites import SatelliteMotion
from glstar.render.scene.scene import Scene
from glstar.sky.air.clouds import CloudSheet
from glstar.sky.air.extinction import Scintillation
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.stars import SIDEREAL_RAD_PER_S
from glstar.sky.photometry import brightness_ratio

Float = NDArray[np.float64]

# Between the times at which the height of stars above the horizon is computed, they move by this at most, px.
_RIDGE_STEP_PX: Final = 0.1
# These times at least and at most.
_FEWEST_RIDGE_TIMES, _MOST_RIDGE_TIMES = 5, 513
# Segments in which a star sets or rises are divided into parts in which stars move by this at most, px.
_RIDGE_PART_PX: Final = 0.05
# Parts of such a segment at least and at most: a star that hardly moves may set too.
_FEWEST_PARTS_AT_RIDGE, _MOST_PARTS_AT_RIDGE = 16, 512


def _set_px(exposure: Exposure, px_per_rad: float) -> float:
    """Return by how much stars move with respect to the ground during an exposure, px."""
    return SIDEREAL_RAD_PER_S * (exposure.stop_utc_s - exposure.start_utc_s) * px_per_rad


def ridge_times(exposure: Exposure, px_per_rad: float) -> int:
    """Return at how many times the height of stars above a horizon profile has to be computed.

    `px_per_rad`: scale of the image.
    """
    return int(
        np.clip(ceil(_set_px(exposure, px_per_rad) / _RIDGE_STEP_PX) + 1, _FEWEST_RIDGE_TIMES, _MOST_RIDGE_TIMES)
    )


def ridge_passage(motion: CameraMotion, exposure: Exposure, direction_eq: Float, times: int) -> CloudPassage:
    """Return the part of the time in which stars are above a horizon profile.

    `motion`: of the flight, with a profile in its sky; `exposure`: a single one; `direction_eq` (m, 3): geocentric
    apparent unit vectors, true equator and equinox; `times`: number of equidistant times, n.  Returns: at each time the
    part of the half intervals before and after it in which a star is up, if its height above the horizon changes
    linearly in each; so the integral over the exposure is exact.
    """
    (pointing,) = motion.pointings(np.linspace(exposure.start_utc_s, exposure.stop_utc_s, times))
    height = pointing.clearance(direction_eq)
    middle = (height[1:] + height[:-1]) / 2
    before, after = _part_above(middle, height[1:]), _part_above(height[:-1], middle)
    inside = (before[:-1] + after[1:]) / 2
    return CloudPassage(np.concatenate([after[:1], inside, before[-1:]]))


def _part_above(first: Float, last: Float) -> Float:
    """Return the part in which a quantity is positive that changes linearly from one value to another."""
    low, high = np.minimum(first, last), np.maximum(first, last)
    span = high - low
    part = (high.clip(min=0.0) - low.clip(min=0.0)) / np.where(span > 0, span, 1.0)
    return np.where(span > 0, part, np.where(low >= 0, 1.0, 0.0))


def ridge_parts(passage: CloudPassage, exposure: Exposure, time_fraction: Float, px_per_rad: float) -> NDArray[np.intp]:
    """Return into how many equal parts segments are divided, so that trails end at the ridge.

    `passage`: of `ridge_passage`; `time_fraction` (s,): durations of the segments; they add up to 1; `px_per_rad`:
    scale of the image.  Returns (s,) intp: 1 where no star sets or rises.
    """
    parts = np.ceil(_set_px(exposure, px_per_rad) * time_fraction / _RIDGE_PART_PX).clip(
        _FEWEST_PARTS_AT_RIDGE, _MOST_PARTS_AT_RIDGE
    )
    changes = (np.diff(passage.transmission, axis=0) != 0).any(axis=1)
    before = np.concatenate([[0], np.cumsum(changes)])
    ends = np.concatenate([[0.0], np.cumsum(time_fraction)]) / time_fraction.sum() * len(changes)
    # Of all intervals that a segment touches.
    first, last = np.floor(ends[:-1] + 1e-9).astype(np.intp), np.ceil(ends[1:] - 1e-9).astype(np.intp)
    return np.where(before[last] > before[first], parts, 1).astype(np.intp)


def divided(trails: AnalyticSegments, parts: NDArray[np.intp]) -> AnalyticSegments:
    """Return trails along the same conics, each segment divided into some equal parts.

    `parts` (s,) intp: of each segment.
    """
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


# Segments are divided until no star's transmission changes by more than this within one, of the largest that it has; of
# stars fainter than this fraction of the brightest light that arrives, of 1.
_LARGEST_CHANGE: Final = 0.04
_FAINT: Final = 0.05
# Light below this fraction does not count, such as that of a satellite in the shadow of the Earth.
_DARK: Final = 1e-3
# The same of a satellite's light.
_LARGEST_CHANGE_OF_LIGHT: Final = 0.01
# Parts of a segment at most.
_MOST_PARTS_BEHIND_CLOUD: Final = 32
# Scintillation is computed whenever a star has moved by this, px, but not more often than this, s: half the time in
# which it is correlated; and this often at most, and at least, or else once for the exposure.
_SCINTILLATION_STEP_PX: Final = 2.0
_SCINTILLATION_STEP_S: Final = 0.002
_MOST_SCINTILLATION_STEPS, _LEAST_SCINTILLATION_STEPS = 512, 16
# Times of an exposure between which the rotation of the camera is measured for that.
_TURN_TIMES: Final = 17


@dataclass(frozen=True, slots=True, eq=False)
class CloudedSky:
    """What a sheet of cloud, a horizon profile and scintillation leave of the stars during one exposure."""

    sheet: CloudSheet | None
    motion: CameraMotion  # With the profile in its sky
    exposure: Exposure
    camera: Camera
    scintillation: Scintillation | None  # Of stars; bodies are too large for it

    @classmethod
    def of(cls, motion: CameraMotion, camera: Camera, sensor: Sensor, exposure: Exposure) -> Self | None:
        """Return the sky over a camera; None without cloud, horizon profile and scintillation."""
        sheet, scintillation = cloud_sheet(sensor, motion), _scintillation(sensor)
        varies = isinstance(motion, SatelliteMotion)
        if sheet is None and motion.sky.profile is None and scintillation is None and not varies:
            return None
        return cls(sheet, motion, exposure, camera, scintillation)

    @property
    def _px_per_rad(self) -> float:
        return max(self.camera.fx_px, self.camera.fy_px)

    def _passages(
        self, stars: StarField, index: NDArray[np.int32], bodies: BodySources | None
    ) -> tuple[CloudPassage | None, CloudPassage | None]:
        """Return what cloud and scintillation leave of stars and then of bodies, and what the profile leaves."""
        direction_eq = _directions(stars, index, bodies)
        has_profile, fluctuation_times = self.motion.sky.profile is not None, self._fluctuation_times
        times = max(ridge_times(self.exposure, self._px_per_rad) if has_profile else 2, fluctuation_times)
        if isinstance(self.motion, SatelliteMotion):
            times = max(times, self.motion.light_times(self.exposure))
        cloud = ridge = None
        if self.sheet is not None:
            cloud = cloud_passage(self.sheet, self.motion, self.exposure, direction_eq, times)
            times = len(cloud.transmission)
        if isinstance(self.motion, SatelliteMotion):
            cloud = _product(self.motion.light(self.exposure, times), cloud)
        if self.scintillation is not None:
            factors = np.ones((times, len(direction_eq)))
            factors[:, : len(index)] = self._factors(stars, index, times)
            cloud = _product(cloud, CloudPassage(factors))
        if has_profile:
            ridge = ridge_passage(self.motion, self.exposure, direction_eq, times)
        return cloud, ridge

    @property
    def _fluctuation_times(self) -> int:
        """Number of times at which scintillation is computed; 2 where trails are too short to vary."""
        if self.scintillation is None:
            return 2
        times_s = np.linspace(self.exposure.start_utc_s, self.exposure.stop_utc_s, _TURN_TIMES)
        (pointing,) = self.motion.pointings(times_s)
        turned_rad = pointing.rotation_rad.sum()
        span_s = self.exposure.stop_utc_s - self.exposure.start_utc_s
        steps = ceil(
            min(
                turned_rad * self._px_per_rad / _SCINTILLATION_STEP_PX,
                span_s / _SCINTILLATION_STEP_S,
                _MOST_SCINTILLATION_STEPS,
            )
        )
        return steps + 1 if steps >= _LEAST_SCINTILLATION_STEPS else 2

    def _factors(self, stars: StarField, index: NDArray[np.int32], times: int) -> Float:
        """Return the relative brightness of some stars by scintillation, (times, m)."""
        assert self.scintillation is not None
        (samples,) = self.motion.at(np.array([self.exposure.mid_utc_s]))
        sine = samples.pointing.sine_apparent_altitude(stars.direction_eq[index])[0]
        rms = self.scintillation.rms(sine, samples.site.height_m)
        start_s, span_s = self.exposure.start_utc_s, self.exposure.stop_utc_s - self.exposure.start_utc_s
        if self._fluctuation_times == 2:
            mean = self.scintillation.mean_factors(rms, stars.star_id[index], start_s, span_s)
            return np.broadcast_to(mean, (times, len(index)))
        return self.scintillation.factors(rms, stars.star_id[index], start_s, span_s, times)

    def mean_factors(self, stars: StarField, index: NDArray[np.int32]) -> Float | None:
        """Return the mean relative brightness of some stars by scintillation, (m,); None without."""
        if self.scintillation is None:
            return None
        times = 2
        if self.sheet is not None or self.motion.sky.profile is not None or self._fluctuation_times > 2:
            passages = [one for one in self._passages(stars, index, None) if one is not None]
            times = len(passages[0].transmission)
        return CloudPassage(self._factors(stars, index, times)).mean

    def divided_at_ridges(
        self, trails: AnalyticSegments, touching: TouchingStars, bodies: BodySources | None
    ) -> AnalyticSegments:
        """Return trails of shorter segments where a star or a body sets or rises behind the horizon profile.

        `touching`: the stars that may touch the image.
        """
        directions = _directions(touching.culler.stars, touching.index, bodies)
        if self.motion.sky.profile is None or not len(directions):
            return trails
        ridge = ridge_passage(self.motion, self.exposure, directions, ridge_times(self.exposure, self._px_per_rad))
        return divided(trails, ridge_parts(ridge, self.exposure, trails.time_fraction, self._px_per_rad))

    def dimmed(self, stars: StarField, draw_list: DrawList, time_fraction: Float) -> DrawList:
        """Return a draw list with its passage.

        `time_fraction` (s,): durations of the segments or sub-exposures; they add up to 1.
        """
        if not len(draw_list):
            return draw_list
        return _with_passage(draw_list, _product(*self._passages(stars, draw_list.index, None)), time_fraction)

    def dimmed_bodies(self, bodies: BodySources | None, time_fraction: Float) -> BodySources | None:
        """Return bodies whose draw list has its passage."""
        if bodies is None:
            return None
        without = replace(self, scintillation=None)
        if self.sheet is None and self.motion.sky.profile is None:
            return bodies
        return replace(bodies, draw_list=without.dimmed(bodies.stars, bodies.draw_list, time_fraction))

    def behind(
        self, trails: AnalyticSegments, stars: StarField, draw_list: DrawList, bodies: BodySources | None
    ) -> tuple[AnalyticSegments, DrawList, BodySources | None]:
        """Return analytic trails, the stars and the bodies with their passage.

        Returns `trails`: of shorter segments, where the transmission changes much within one.
        """
        directions = _directions(stars, draw_list.index, bodies)
        if not len(directions):
            return trails, draw_list, bodies
        cloud, ridge = self._passages(stars, draw_list.index, bodies)
        parts = np.ones(len(trails), dtype=np.intp)
        if cloud is not None:
            magnitudes = [draw_list.observed_mag(stars)]
            magnitudes += [] if bodies is None else [bodies.draw_list.observed_mag(bodies.stars)]
            parts = self._cloud_parts(cloud, trails.time_fraction, brightness_ratio(np.concatenate(magnitudes)))
        if ridge is not None:
            parts = np.maximum(parts, ridge_parts(ridge, self.exposure, trails.time_fraction, self._px_per_rad))
        trails, passage = divided(trails, parts), _product(cloud, ridge)
        first, last = (CloudPassage(part) for part in np.split(passage.transmission, [len(draw_list)], axis=1))
        if len(draw_list):
            draw_list = _with_passage(draw_list, first, trails.time_fraction)
        if bodies is not None and len(bodies.draw_list):
            bodies = replace(bodies, draw_list=_with_passage(bodies.draw_list, last, trails.time_fraction))
        return trails, draw_list, bodies

    def _cloud_parts(self, cloud: CloudPassage, time_fraction: Float, brightness: Float) -> NDArray[np.intp]:
        """Return into how many parts each segment is divided, so that what arrives changes little within each, (s,)."""
        largest = cloud.transmission.max(axis=0)
        faintest = _FAINT * (brightness * largest).max()
        of_star = np.maximum(largest, faintest / brightness).clip(_DARK, 1.0)
        changes = (np.abs(np.diff(cloud.transmission, axis=0)) / of_star).max(axis=1)
        along = np.concatenate([[0.0], np.cumsum(changes)])
        ends = np.concatenate([[0.0], np.cumsum(time_fraction)])
        in_segment = np.diff(np.interp(ends / ends[-1], np.linspace(0, 1, len(along)), along))
        limit = _LARGEST_CHANGE_OF_LIGHT if isinstance(self.motion, SatelliteMotion) else _LARGEST_CHANGE
        return np.asarray(np.ceil(in_segment / limit).clip(1, _MOST_PARTS_BEHIND_CLOUD), dtype=np.intp)


def _scintillation(sensor: Sensor) -> Scintillation | None:
    """Return the scintillation of the keys of ``[sky]``."""
    rms = float(sensor.effects.get("sky.scintillation", 0.0))
    return Scintillation(rms, int(sensor.effects.get("sky.scintillation_seed", 0))) if rms else None


def _directions(stars: StarField, index: NDArray[np.int32], bodies: BodySources | None) -> Float:
    """Return the directions of some stars and of the sources of bodies, (m, 3)."""
    directions = stars.direction_eq[index]
    if bodies is None:
        return directions
    return np.concatenate([directions, bodies.stars.direction_eq[bodies.draw_list.index]])


def _product(cloud: CloudPassage | None, ridge: CloudPassage | None) -> CloudPassage:
    """Return what arrives of stars behind cloud and a horizon profile, one of which may be missing."""
    if cloud is None or ridge is None:
        whole = cloud or ridge
        assert whole is not None
        return whole
    return CloudPassage(cloud.transmission * ridge.transmission)


def _with_passage(draw_list: DrawList, passage: CloudPassage, time_fraction: Float) -> DrawList:
    return replace(draw_list, passage=np.ascontiguousarray(passage.means(time_fraction).T, dtype=np.float32))


def scene_passage(scene: Scene, direction_eq: Float) -> CloudPassage | None:
    """Return what arrives of stars over the exposure of a scene: behind cloud, and of a satellite's changing light.

    `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox.  Returns: as `scene_cloud`.
    """
    sheet = cloud_sheet(scene.sensor, scene.motion)
    if not isinstance(scene.motion, SatelliteMotion):
        return scene_cloud(scene, direction_eq)
    times = scene.motion.light_times(scene.exposure)
    cloud = None if sheet is None else cloud_passage(sheet, scene.motion, scene.exposure, direction_eq, times)
    light = scene.motion.light(scene.exposure, times if cloud is None else len(cloud.transmission))
    return _product(light, cloud)


def scene_cloud(scene: Scene, direction_eq: Float) -> CloudPassage | None:
    """Return what cloud transmits of stars over the exposure of a scene.

    `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox.  Returns: of a stacked image,
    from the start of the first short exposure to the end of the last; None without cloud.
    """
    sheet = cloud_sheet(scene.sensor, scene.motion)
    if sheet is None or scene.motion is None:
        return None
    return cloud_passage(sheet, scene.motion, scene.exposure, direction_eq)


def scene_scintillation(scene: Scene, index: NDArray[np.int32]) -> dict[str, Float]:
    """Return the column of scintillation in the truth of stars.

    `index` (m,) int32: into the stars of the scene.  Returns ``scintillation``, (m,): the mean relative brightness over
    the exposure, of a stacked image over the short ones; empty without scintillation.
    """
    means = []
    for one in scene.shorts or (scene,):
        sky = None if one.motion is None else CloudedSky.of(one.motion, one.camera, one.sensor, one.exposure)
        mean = None if sky is None else sky.mean_factors(one.stars, index)
        if mean is not None:
            means.append(mean)
    return {"scintillation": np.mean(means, axis=0)} if means else {}


# A fraction of the exposure, beyond its end by more than any rounding.
NEVER: Final = 2.0

# How far the zenith may move between the times of the segments, relative to its largest distance from the first.
_ZENITH_MARGIN: Final = 2.0
# Change of a height, a sine, by rounding.
_ROUNDING: Final = 1e-9


def rise_and_set(trails: AnalyticSegments, direction_eq: NDArray[np.float64]) -> Float:
    """Return when stars rise above the apparent horizon and set.

    `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox.  Returns (m, 2) elapsed
    fractions of the exposure: a star is up from the first to the second; if the second is earlier, until the second and
    again from the first. 0 of a star that is up at the start, `NEVER` of a star that does not rise or does not set.
    Within a segment the sine of an altitude is the quadratic through its values at the start, the middle and the end.
    """
    pointing = trails.pointing
    moved = np.linalg.norm(pointing.zenith_eq - pointing.zenith_eq[0], axis=1).max()
    height = pointing[:1].heights(direction_eq)[0]
    times = _without_crossing(height >= 0)
    near = np.flatnonzero(np.abs(height) <= _ZENITH_MARGIN * moved + _ROUNDING)
    if near.size:
        times[near] = _crossings(pointing, trails.time_fraction, direction_eq[near])
    return times


def _without_crossing(is_up: NDArray[np.bool_]) -> Float:
    """Return `rise_and_set` of stars that are up, or not, throughout."""
    return np.column_stack([np.where(is_up, 0.0, NEVER), np.full(len(is_up), NEVER)])


def _crossings(pointing: Pointing, time_fraction: Float, direction_eq: Float) -> Float:
    """Return `rise_and_set` of a few stars: from their heights at all times."""
    heights = pointing.heights(direction_eq)
    is_up = heights >= 0
    changes = is_up[1:] != is_up[:-1]
    stars = np.arange(len(direction_eq))
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
