"""Culling: selection of the stars that may touch an image during an exposure, with their truncation radii.

Bounds that are cheap for a million stars come first (a cone, a bound on the flux, the four sides of the image); the
positions of the remaining candidates are then computed at every time.
"""

from dataclasses import dataclass, field
from functools import lru_cache
from math import acos, asin, atan, cos, hypot, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor import TRUNCATION_DN, Sensor
from glstar.render.pointing import Pointing
from glstar.rotation import turn_from_matrix
from glstar.sky.extinction import air_mass
from glstar.sky.horizon import MAX_REFRACTION_RAD
from glstar.sky.magnitudes import brightness_ratio
from glstar.sky.starfield import StarField

__all__ = ["DrawList", "StarCuller"]

Float = NDArray[np.float64]

# Refraction compresses the sky near the horizon: a small vertical displacement keeps at least this fraction.
_MIN_REFRACTED_FRACTION: Final = 0.7
# The four sides of the image are tested at every eighth time, where a bound suffices.
_SIDES_STRIDE: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class DrawList:
    """The stars that may touch an image, with their truncation radii: the result of culling.

    Attributes
    ----------
    index : (k,) int32
        Indices into the `StarField`.
    truncation_radius_px : (k,) float64
        Distance from its centre up to which each star's point spread function is drawn, px.
    min_trail_px : (k,) float64
        Lower bound of the length of each star's trail at its slowest rate, px; 0 by default.
    extinction_mag : (k,) float64 or None
        What the air takes from each star in the middle of the exposure, mag; None without extinction.
    """

    index: NDArray[np.int32]
    truncation_radius_px: Float
    min_trail_px: Float = field(default_factory=lambda: np.zeros(0))
    extinction_mag: Float | None = None

    def __post_init__(self) -> None:
        if len(self.min_trail_px) != len(self.index):
            object.__setattr__(self, "min_trail_px", np.zeros(len(self.index)))

    @property
    def transmission(self) -> Float:
        """The fraction of each star's light that the air transmits, (k,)."""
        return np.ones(len(self)) if self.extinction_mag is None else brightness_ratio(self.extinction_mag)

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, stars: slice | NDArray[np.intp] | NDArray[np.bool_]) -> "DrawList":
        extinction_mag = None if self.extinction_mag is None else self.extinction_mag[stars]
        return DrawList(self.index[stars], self.truncation_radius_px[stars], self.min_trail_px[stars], extinction_mag)


@dataclass(frozen=True, slots=True, eq=False)
class StarCuller:
    """Finds the stars of a field that touch the images of one camera.

    Attributes
    ----------
    stars : StarField
    camera : Camera
    sensor : Sensor
    zenith_extinction_mag : float or None
        Extinction per air mass, mag; None without extinction.
    """

    stars: StarField
    camera: Camera
    sensor: Sensor
    zenith_extinction_mag: float | None = None

    def draw_list(
        self, pointing: Pointing, time_fraction: Float, duration_s: float, *, analytic: bool
    ) -> tuple[DrawList, float]:
        """Return the stars that may touch an image, and the longest step of one of them between consecutive times.

        Parameters
        ----------
        pointing : Pointing
            At n times from the start to the end of the exposure.
        time_fraction : (n - 1,) float64
            Fraction of the exposure between consecutive times.
        duration_s : float
            Length of the exposure, s.
        analytic : bool
            Whether trails are drawn analytically.  Then the flux outside the truncation radius is not lost, so that
            the radius is smaller, and trails below 0.02 DN everywhere are left out.

        Returns
        -------
        draw_list : DrawList
        longest_step_px : float
            In the undistorted image plane, px.
        """
        step_rad = _largest_rotation_rad(pointing.C_camera_eq[:-1], pointing.C_camera_eq[1:])
        candidates = self._within_cone(pointing)
        if analytic:
            min_trail_px = self._min_trail_px(pointing, time_fraction)
            candidates = self._bright_enough(candidates, duration_s, min_trail_px)
        candidates = self._within_sides(pointing, step_rad, candidates)
        observed_mag, extinction_mag = self.stars.camera_mag.take(candidates), None
        if self.zenith_extinction_mag is not None:
            directions = self.stars.direction_eq.take(candidates, axis=0)
            middle = len(pointing) // 2
            sine = pointing[middle : middle + 1].sine_apparent_altitude(directions)[0]
            extinction_mag = self.zenith_extinction_mag * air_mass(sine)
            observed_mag = observed_mag + extinction_mag
        peak_dn = self.sensor.peak_dn(observed_mag, duration_s)
        # Sprites grow with the local magnification of the lens.
        margin_px = self.camera.max_magnification * (self.sensor.truncation_radius_px(peak_dn) + 1)
        touches, slowest_px, longest_step_px = self._steps(pointing, time_fraction, candidates, margin_px)
        if analytic:
            touches &= self.sensor.max_trail_peak_dn(peak_dn, slowest_px) >= TRUNCATION_DN
        radius_px = self.sensor.truncation_radius_px(peak_dn[touches], slowest_px[touches], renormalized=analytic)
        radius_px = self.camera.max_magnification * radius_px
        extinction_mag = None if extinction_mag is None else extinction_mag[touches]
        draw_list = DrawList(candidates[touches].astype(np.int32), radius_px, slowest_px[touches], extinction_mag)
        # The step at the image's farthest corner: pixel positions of a star that leaves the image within a step grow
        # without bound, and that step does not count.
        return draw_list, min(longest_step_px, step_rad * self.camera.max_px_per_rad)

    def _steps(
        self, pointing: Pointing, time_fraction: Float, candidates: NDArray[np.intp], margin_px: Float
    ) -> tuple[NDArray[np.bool_], Float, float]:
        """Return which candidates touch the image, the trail length at their slowest rate, px, and the longest step."""
        directions = self.stars.direction_eq.take(candidates, axis=0)  # five times as fast as an index
        stretch, pinhole = self.camera.max_magnification, self.camera.pinhole
        diagonal_px = hypot(self.camera.width_px, self.camera.height_px)
        touches = np.zeros(len(candidates), dtype=np.bool_)
        slowest_px = np.full(len(candidates), np.inf)
        longest_step_px = 0.0
        first = 0
        for block in pointing.blocks(len(candidates), overlap=1):
            in_camera = block.to_camera(directions)
            xy = self.camera.project(in_camera)
            # Trails are drawn in the undistorted image plane, where their sampling ripple has to be small.
            undistorted = xy if self.camera.lens is None else pinhole.project(in_camera)
            step = undistorted[1:] - undistorted[:-1]
            step_x, step_y = step[..., 0], step[..., 1]
            step_px = np.sqrt(step_x * step_x + step_y * step_y)  # five times as fast as hypot
            trail_px = step_px / time_fraction[first : first + len(step_px), np.newaxis]
            first += len(step_px)
            hidden = np.isnan(step_px)  # behind the camera or below the horizon
            if hidden.any():
                step_px[hidden], trail_px[hidden] = 0.0, np.inf
            slowest_px = np.minimum(slowest_px, trail_px.min(axis=0))
            beyond_px = self.camera.distance_outside_px(xy)
            near = beyond_px < margin_px
            near_step_px = np.where(near[:-1] | near[1:], step_px, 0.0)
            longest_step_px = max(longest_step_px, float(near_step_px.max(initial=0.0)))
            touches |= near.any(axis=0)
            # Between two times a star may graze the image: half a step is added to the margin.  Steps grow without
            # bound far off the axis, but none across the image is longer than its diagonal.
            far = np.flatnonzero(~touches)
            grazing_px = margin_px[far] + np.minimum(stretch * step_px.take(far, axis=1), diagonal_px) / 2
            beyond_px = beyond_px.take(far, axis=1)
            touches[far] = (np.fmin(beyond_px[:-1], beyond_px[1:]) < grazing_px).any(axis=0)
        slowest_px[np.isinf(slowest_px)] = 0.0  # visible at a single time
        return touches, slowest_px, longest_step_px

    def _min_trail_px(self, pointing: Pointing, time_fraction: Float) -> float:
        """Return a lower bound of the length of any star's trail if it moved at its slowest rate throughout, px."""
        C = pointing.C_camera_eq
        rotation = turn_from_matrix(C[1:] @ np.swapaxes(C[:-1], 1, 2))
        rotation_rad = np.linalg.norm(rotation, axis=1)
        # The smaller the angle to the rotation axis, the slower; and the image extends in all directions.
        off_axis_rad = np.arctan2(np.hypot(rotation[:, 0], rotation[:, 1]), np.abs(rotation[:, 2]))
        off_axis_rad -= (
            self.camera.field_radius_rad + self._widest_sprite_rad() + rotation_rad.max() + MAX_REFRACTION_RAD
        )
        # A pinhole magnifies least on its axis.
        px_per_rad = min(self.camera.fx_px, self.camera.fy_px) - abs(self.camera.skew_px)
        step_px = 2 * np.sin(rotation_rad / 2) * np.sin(off_axis_rad.clip(min=0.0)) * max(px_per_rad, 0.0)
        return _MIN_REFRACTED_FRACTION * float((step_px / time_fraction).min())

    def _bright_enough(self, stars: NDArray[np.intp], duration_s: float, min_trail_px: float) -> NDArray[np.intp]:
        """Return those stars whose trails reach the faintest flux that is drawn, given a bound of their lengths."""
        peak_dn = self.sensor.peak_dn(self.stars.camera_mag.take(stars), duration_s)
        return stars[self.sensor.max_trail_peak_dn(peak_dn, min_trail_px) >= TRUNCATION_DN]

    def _within_cone(self, pointing: Pointing) -> NDArray[np.intp]:
        """Return the stars in the cone that the field of view sweeps: a bound that is cheap for a million stars."""
        boresight = pointing.boresight_eq
        middle = boresight[len(boresight) // 2]
        swing_rad = acos(min(1.0, max(-1.0, (boresight @ middle).min())))
        radius_rad = self.camera.field_radius_rad + swing_rad + self._widest_sprite_rad() + MAX_REFRACTION_RAD
        if radius_rad >= np.pi:
            return np.arange(len(self.stars))
        return np.flatnonzero(self.stars.direction_eq @ middle > cos(radius_rad))

    def _within_sides(self, pointing: Pointing, step_rad: float, candidates: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those candidates that lie between the image's four sides at some time: a bound.

        `step_rad` is the largest rotation of the camera between consecutive times.
        """
        if self.camera.lens is not None:  # its sides are not planes
            return candidates
        C = pointing.C_camera_eq
        nearest = np.arange(len(C)) // _SIDES_STRIDE * _SIDES_STRIDE
        slack_rad = _largest_rotation_rad(C, C[nearest]) + step_rad + self._widest_sprite_rad() + MAX_REFRACTION_RAD
        if slack_rad >= np.pi / 2:
            return candidates
        outside = (_outward_normals(self.camera) @ C[::_SIDES_STRIDE]) @ self.stars.direction_eq.take(
            candidates, axis=0
        ).T
        near: NDArray[np.bool_] = (outside.max(axis=1) < sin(slack_rad)).any(axis=0)
        return candidates[near]

    def _widest_sprite_rad(self) -> float:
        """Return a bound of the angle between a star just outside the image and its sprite's edge inside it."""
        widest_px = 8 * self.sensor.widest_sigma_px + 1
        return atan(widest_px / min(self.camera.fx_px, self.camera.fy_px))


# Every scene of a flight has the same camera.
@lru_cache(maxsize=64)
def _outward_normals(camera: Camera) -> Float:
    """Return the outward normals of the four planes through a pinhole and the image's sides, (4, 3) unit vectors."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = camera.unproject([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
    outwards = np.cross(np.roll(corners, -1, axis=0), corners)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    outwards.flags.writeable = False
    return outwards


def _largest_rotation_rad(C: Float, C_other: Float) -> float:
    """Return the largest angle between the attitudes of each pair, rad."""
    chord = C_other - C
    chord2 = np.einsum("nij,nij->n", chord, chord).max()  # squared Frobenius norm: 8 sin(angle / 2)^2
    return 2 * asin(min(1.0, sqrt(chord2 / 8)))
