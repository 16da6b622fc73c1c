"""Culling: selection of the stars that may touch an image during an exposure, with their truncation radii.

Bounds that are cheap for a million stars come first (a cone, the four sides of the image); the
positions of the remaining candidates are then computed at every time.
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import acos, asin, atan, cos, hypot, sin, sqrt
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.pointing import Pointing
from glstar.render.motion.starpaths import view_limit_rad, view_radius_rad
from glstar.sky.air.extinction import air_mass
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.catalogue.starfield import SkyCells, StarField
from glstar.sky.photometry import brightness_ratio

# Fraction of the flux of all stars that touch an image that may be left out: half of what is promised, because some
# of these stars are on the image only for a part of the exposure.
MAX_FRACTION_LEFT_OUT = 5e-4
# Cells of the sky save time from this number of stars, and for cones up to this radius, rad.
_MANY_STARS = 50_000
_NARROW_RAD = 0.5
# The four sides of the image are tested at every eighth time, where a bound suffices.
_SIDES_STRIDE = 8


@dataclass(frozen=True, slots=True, eq=False)
class DrawList:
    """The stars that may touch an image, with their truncation radii: the result of culling."""

    index: NDArray[np.int32]  # (k,) int32: indices into the `StarField`
    # (k,) distance from its centre up to which each star's point spread function is drawn, px.
    truncation_radius_px: Float
    # (k,) lower bound of the length of each star's trail at its slowest rate, px; 0 by default.
    min_trail_px: Float = field(default_factory=lambda: np.zeros(0))
    # (k,) or None: extinction of each star in the middle of the exposure, mag; None without extinction.
    extinction_mag: Float | None = None
    # (k, s) float32 or None: fraction of the light that arrives of each star in each of the s segments or
    # sub-exposures: behind cloud and ridges, and by scintillation; None without.
    passage: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if len(self.min_trail_px) != len(self.index):
            object.__setattr__(self, "min_trail_px", np.zeros(len(self.index)))

    @property
    def transmission(self) -> Float:
        """The fraction of each star's light that the air transmits, (k,)."""
        return np.ones(len(self)) if self.extinction_mag is None else brightness_ratio(self.extinction_mag)

    def observed_mag(self, stars: StarField) -> Float:
        """Return the magnitudes of the stars, of a field, in the camera's band below the air, (k,)."""
        above_air = stars.camera_mag[self.index]
        return above_air if self.extinction_mag is None else above_air + self.extinction_mag

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, stars: slice | NDArray[np.intp] | NDArray[np.bool_]) -> "DrawList":
        extinction_mag = None if self.extinction_mag is None else self.extinction_mag[stars]
        passage = None if self.passage is None else self.passage[stars]
        radius_px, trail_px = self.truncation_radius_px[stars], self.min_trail_px[stars]
        return DrawList(self.index[stars], radius_px, trail_px, extinction_mag, passage)

    def passage_of_groups(self, size: int) -> NDArray[np.float32]:
        """Return the mean passage of groups of neighbouring sub-exposures, (k, ceil(s / size)); (0, 0) without cloud.

        Each group has `size` sub-exposures; the last one may have fewer.
        """
        if self.passage is None:
            return np.zeros((0, 0), np.float32)
        firsts = np.arange(0, self.passage.shape[1], size)
        counts = np.minimum(size, self.passage.shape[1] - firsts)
        return np.asarray(np.add.reduceat(self.passage.astype(np.float64), firsts, axis=1) / counts, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class StarCuller:
    """Finds the stars of a field that touch the images of one camera."""

    stars: StarField
    camera: Camera
    sensor: Sensor
    zenith_extinction_mag: float | None = None  # Extinction per air mass, mag; None without extinction

    def touching(self, pointing: Pointing, time_fraction: Float, duration_s: float) -> "TouchingStars":
        """Return the stars that may touch an image.

        `pointing`: at n times from the start to the end of the exposure; of a horizon profile only the bound counts;
        `time_fraction` (n - 1,): fraction of the exposure between consecutive times.
        """
        # A star may be above a horizon profile between two times.
        pointing = replace(pointing, profile=None)
        step_rad = _largest_rotation_rad(pointing.C_camera_eq[:-1], pointing.C_camera_eq[1:])
        candidates = self._within_sides(pointing, step_rad, self._within_cone(pointing))
        observed_mag, extinction_mag = self.stars.camera_mag.take(candidates), None
        if self.zenith_extinction_mag is not None:
            directions = self.stars.direction_eq.take(candidates, axis=0)
            middle = len(pointing) // 2
            sine = pointing[middle : middle + 1].sine_apparent_altitude(directions)[0]
            extinction_mag = self.zenith_extinction_mag * air_mass(sine)
            observed_mag = observed_mag + extinction_mag
        peak_dn = self.sensor.peak_dn(observed_mag, duration_s)
        margin_px = self.sensor.truncation_radius_px(peak_dn) + 1
        touches, slowest_px, longest_step_px = self._steps(pointing, time_fraction, candidates, margin_px, step_rad)
        # The step at the image's farthest corner: pixel positions of a star that leaves the image within a step grow
        # without bound, and that step does not count.
        longest_step_px = min(longest_step_px, step_rad * self.camera.max_px_per_rad)
        index = candidates[touches].astype(np.int32)
        extinction_mag = None if extinction_mag is None else extinction_mag[touches]
        return TouchingStars(self, index, peak_dn[touches], slowest_px[touches], longest_step_px, extinction_mag)

    def _steps(
        self,
        pointing: Pointing,
        time_fraction: Float,
        candidates: NDArray[np.intp],
        margin_px: Float,
        step_rad: float,
    ) -> tuple[NDArray[np.bool_], Float, float]:
        """Return which candidates touch the image, the trail length at their slowest rate, px, and the longest step."""
        directions = self.stars.direction_eq.take(candidates, axis=0)  # five times as fast as an index
        diagonal_px = hypot(self.camera.width_px, self.camera.height_px)
        touches = np.zeros(len(candidates), dtype=np.bool_)
        slowest_px = np.full(len(candidates), np.inf)
        longest_step_px = 0.0
        first = 0
        for block in pointing.blocks(len(candidates), overlap=1):
            in_camera = _while_seen(block, directions)
            xy = self.camera.project(in_camera)
            step_px, down_px = (xy[1:, :, axis] - xy[:-1, :, axis] for axis in (0, 1))
            step_px *= step_px
            down_px *= down_px
            step_px += down_px
            np.sqrt(step_px, out=step_px)  # five times as fast as hypot
            trail_px = np.divide(step_px, time_fraction[first : first + len(step_px), np.newaxis], out=down_px)
            first += len(step_px)
            farthest_px = step_px.max(axis=0)
            if np.isnan(farthest_px).any():
                hidden = np.isnan(step_px)  # behind the camera or always below the horizon
                step_px[hidden], trail_px[hidden] = 0.0, np.inf
                farthest_px = step_px.max(axis=0)
            np.minimum(slowest_px, trail_px.min(axis=0), out=slowest_px)
            beyond_px = self.camera.distance_outside_px(xy)
            near = beyond_px < margin_px
            touches |= near.any(axis=0)
            # Between two times a star may graze the image: half a step is added to the margin.  Steps grow without
            # bound far off the axis, but none across the image is longer than its diagonal.
            reach_px = margin_px + np.minimum(farthest_px, diagonal_px) / 2
            far = np.flatnonzero(~touches & (np.fmin.reduce(beyond_px, axis=0) < reach_px))
            grazing_px = margin_px[far] + np.minimum(step_px.take(far, axis=1), diagonal_px) / 2
            beyond_px = beyond_px.take(far, axis=1)
            touches[far] = (np.fmin(beyond_px[:-1], beyond_px[1:]) < grazing_px).any(axis=0)
            step_px *= near[:-1] | near[1:]
            longest_step_px = max(longest_step_px, float(step_px.max(initial=0.0)))
            touches |= self._passes_limit(in_camera, xy, step_rad)
        slowest_px[np.isinf(slowest_px)] = 0.0  # visible at a single time
        return touches, slowest_px, longest_step_px

    def _passes_limit(self, in_camera: Float, xy: Float, step_rad: float) -> NDArray[np.bool_] | bool:
        """Return which stars may come into view between two times where the lens ends on the image, (k,): a bound."""
        camera = self.camera
        if camera.lens is None or camera.field_radius_rad < view_limit_rad(camera):
            return False
        cosine = in_camera[..., 2] / np.linalg.norm(in_camera, axis=-1)
        near = cosine > cos(min(view_limit_rad(camera) + step_rad, np.pi))
        return np.asarray((near & np.isnan(xy[..., 0])).any(axis=0))

    def _within_cone(self, pointing: Pointing) -> NDArray[np.intp]:
        """Return the stars in the cone that the field of view sweeps: a bound that is cheap for a million stars."""
        boresight = pointing.boresight_eq
        middle = boresight[len(boresight) // 2]
        swing_rad = acos(min(1.0, max(-1.0, (boresight @ middle).min())))
        radius_rad = view_radius_rad(self.camera, self._widest_px) + swing_rad + MAX_REFRACTION_RAD
        if radius_rad >= np.pi:
            return np.arange(len(self.stars))
        if len(self.stars) > _MANY_STARS and radius_rad < _NARROW_RAD:
            return _cells(self.stars).within(middle, radius_rad)
        return np.flatnonzero(self.stars.direction_eq @ middle > cos(radius_rad))

    def _within_sides(self, pointing: Pointing, step_rad: float, candidates: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those candidates that lie between the image's four sides at some time: a bound.

        `step_rad`: largest rotation of the camera between consecutive times.
        """
        if self.camera.lens is not None:  # its sides are not planes
            return candidates
        C = pointing.C_camera_eq
        nearest = np.arange(len(C)) // _SIDES_STRIDE * _SIDES_STRIDE
        widest_rad = atan(self._widest_px / min(self.camera.fx_px, self.camera.fy_px))
        slack_rad = _largest_rotation_rad(C, C[nearest]) + step_rad + widest_rad + MAX_REFRACTION_RAD
        if slack_rad >= np.pi / 2:
            return candidates
        outside = (_outward_normals(self.camera) @ C[::_SIDES_STRIDE]) @ self.stars.direction_eq.take(
            candidates, axis=0
        ).T
        near: NDArray[np.bool_] = (outside.max(axis=1) < sin(slack_rad)).any(axis=0)
        return candidates[near]

    @property
    def _widest_px(self) -> float:
        """A bound of the distance between a star just outside the image and its sprite's edge inside it, px."""
        return 8 * self.sensor.widest_sigma_px + 1


@dataclass(frozen=True, slots=True, eq=False)
class TouchingStars:
    """The stars that may touch an image."""

    culler: StarCuller
    index: NDArray[np.int32]  # (k,) int32: indices into the `StarField`
    peak_dn: Float  # (k,) amplitudes of their point spread functions if they did not move, DN
    slowest_px: Float  # (k,) lengths of their trails if they moved at their slowest rate all the time, px
    # The longest step of one of them between consecutive times, px.
    longest_step_px: float
    # (k,) or None: extinction of each star in the middle of the exposure, mag; None without extinction.
    extinction_mag: Float | None = None

    @property
    def listed(self) -> DrawList:
        """The stars that truth lists, each up to where it is below 0.02 DN if it did not move."""
        return self._drawn_up_to(self.culler.sensor.truncation_radius_px(self.peak_dn, renormalized=True))

    @property
    def summed(self) -> DrawList:
        """The stars for sub-exposures."""
        return self._drawn_up_to(self.culler.sensor.truncation_radius_px(self.peak_dn, self.slowest_px))

    def integrated(self, faintest_dn: float) -> DrawList:
        """Return the stars for analytic trails, whose flux outside the truncation radius is not lost.

        Trails that are fainter than `faintest_dn` everywhere are left out, the faintest first, up to
        `MAX_FRACTION_LEFT_OUT` of the flux.
        """
        sensor = self.culler.sensor
        radius_px = sensor.truncation_radius_px(self.peak_dn, self.slowest_px, renormalized=True)
        faint = np.flatnonzero(sensor.max_trail_peak_dn(self.peak_dn, self.slowest_px) < faintest_dn)
        draw_list = self._drawn_up_to(radius_px)
        if not faint.size:
            return draw_list
        faint = faint[np.argsort(self.peak_dn[faint], kind="stable")]
        left_out = np.cumsum(self.peak_dn[faint]) <= MAX_FRACTION_LEFT_OUT * self.peak_dn.sum()
        is_drawn = np.ones(len(self.index), dtype=np.bool_)
        is_drawn[faint[left_out]] = False
        return draw_list[is_drawn]

    def _drawn_up_to(self, radius_px: Float) -> DrawList:
        return DrawList(self.index, radius_px, self.slowest_px, self.extinction_mag)


# Sorting takes 0.3 s for two million stars, whose directions are those of hours.
_CELLS: WeakKeyDictionary[StarField, SkyCells] = WeakKeyDictionary()


def _cells(stars: StarField) -> SkyCells:
    """Return the stars of a field sorted into cells; the same object for the same field."""
    if stars not in _CELLS:
        _CELLS[stars] = SkyCells.of(stars.direction_eq)
    return _CELLS[stars]


# Every scene of a flight has the same camera.
@lru_cache(maxsize=64)
def _outward_normals(camera: Camera) -> Float:
    """Return the outward normals of the four planes through a pinhole and the image's sides, (4, 3) unit vectors."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = camera.unit_vectors([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
    outwards = np.cross(np.roll(corners, -1, axis=0), corners)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    outwards.flags.writeable = False
    return outwards


def _while_seen(pointing: Pointing, directions: Float) -> Float:
    """Return `Pointing.to_camera`, with the directions below the horizon of stars that rise or set.

    Between two times such a star may cross a corner of the image before it sets.
    """
    in_camera = pointing.to_camera(directions)
    if np.isnan(in_camera[[0, -1]]).any():
        below = np.isnan(in_camera[..., 2])
        crosses = np.flatnonzero(below.any(axis=0) & ~below.all(axis=0))
        in_camera[:, crosses] = pointing.to_camera(directions[crosses], below_horizon=True)
    return in_camera


def _largest_rotation_rad(C: Float, C_other: Float) -> float:
    """Return the largest angle between the attitudes of each pair, rad."""
    chord = C_other - C
    chord2 = np.einsum("nij,nij->n", chord, chord).max()  # squared Frobenius norm: 8 sin(angle / 2)^2
    return 2 * asin(min(1.0, sqrt(chord2 / 8)))
