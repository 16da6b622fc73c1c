"""From a flight and an exposure to a scene."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import acos, asin, atan, ceil, cos, hypot, sin, sqrt
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor import FAINTEST_DN, Sensor
from glstar.flight import Flight
from glstar.render.scene import Pointing, Scene
from glstar.render.segmentation import segment_times
from glstar.rotation import matrix_from_quaternion, turn_from_matrix
from glstar.sky.horizon import MAX_REFRACTION_RAD, diurnal_aberration_rad
from glstar.sky.observed import Sky
from glstar.sky.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site
from glstar.sky.starbrightness import StarBrightness
from glstar.sky.starfield import StarField

__all__ = ["Simulator"]

Float = NDArray[np.float64]

# Two sub-exposures this many sigma apart leave beads of 0.03 % on a trail; at 2 sigma 1.4 %, at 3 sigma 22 %.
_BEADLESS_SIGMA: Final = 1.5

# So near to the end of an exposure a sample of the log is at its end, s.
_AT_THE_END_S: Final = 2e-5
# What is left at the least of a small way up or down where air lifts what is low more.
_LEAST_LIFTED: Final = 0.7
# Of so many moments one is looked at where a bound is enough.
_LOOKS_APART: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Simulator:
    """Composes scenes of one flight; `of` finds its stars.

    With `dataclasses.replace` another camera, mount, sensor or air takes over the stars that were found.

    Attributes
    ----------
    flight : Flight
    sky : Sky
    stars : StarField
        The apparent directions of the flight's middle; found once, uploaded once.
    camera : Camera
    mount : Mount
    sensor : Sensor
    pressure_hpa, temperature_c : float
        The air at the aircraft.
    """

    flight: Flight
    sky: Sky
    stars: StarField
    camera: Camera
    mount: Mount
    sensor: Sensor
    pressure_hpa: float = STANDARD_PRESSURE_HPA
    temperature_c: float = STANDARD_TEMPERATURE_C

    @classmethod
    def of(
        cls,
        flight: Flight,
        sky: Sky,
        camera: Camera,
        mount: Mount,
        sensor: Sensor,
        pressure_hpa: float = STANDARD_PRESSURE_HPA,
        temperature_c: float = STANDARD_TEMPERATURE_C,
        star_brightness: StarBrightness | None = None,
    ) -> Self:
        """Return the simulator of a flight under a sky.

        Parameters
        ----------
        flight : Flight
        sky : Sky
        camera : Camera
        mount : Mount
        sensor : Sensor
        pressure_hpa, temperature_c : float
            The air at the aircraft.
        star_brightness : StarBrightness, optional
            What the camera sees of each star, where that was measured.

        Returns
        -------
        Simulator

        Raises
        ------
        CalibrationError
            If the brightnesses are those of another catalogue's stars.
        """
        middle_s = (flight.attitude.first_s + flight.attitude.last_s) / 2
        stars = sky.star_field(middle_s)
        if star_brightness is not None:
            stars = replace(stars, measured_mag=star_brightness.magnitudes(stars.catalogue, stars.star_id, stars.vmag))
        return cls(flight, sky, stars, camera, mount, sensor, pressure_hpa, temperature_c)

    def following(self, flight: Flight) -> Self:
        """Return a simulator of the same flight as far as it is known by now: what was uploaded of its stars serves on.

        Parameters
        ----------
        flight : Flight
            Hours later at the most: star directions age by 0.03" in one.

        Returns
        -------
        Simulator
        """
        return replace(self, flight=flight)

    def scene(self, exposure: Exposure) -> Scene:
        """Return the scene of one exposure.

        Parameters
        ----------
        exposure : Exposure
            It must lie inside the flight.

        Returns
        -------
        Scene

        Raises
        ------
        TrackRangeError
            If the exposure begins before the flight's first attitude or ends after its last.
        RenderError
            If the camera's lens sees too wide a field to be drawn.

        Notes
        -----
        Teague & Chahl, section 2.6.  Departs from the paper's n = 200 dt: n = max(ceil(200 dt), ceil(longest trail
        / 1.5 sigma)), for at 60 deg/s stars are 20 px apart after 5 ms; the trail is measured at its fastest, so
        that no part of it is beaded.  Swept trails depart from it altogether: `glstar.render.segmentation`.
        """
        self.camera.check_field()
        moments_s = None if exposure.trail == "sprites" else self._segment_times(exposure)
        if moments_s is None:
            return self._in_sprites(replace(exposure, trail="sprites"))
        return self._swept(replace(exposure, trail="analytic"), moments_s)

    def _segment_times(self, exposure: Exposure) -> Float | None:
        """Return the ends and the middles of an exposure's segments, UTC seconds; None where sprites cost less."""
        return segment_times(
            self.pointings,
            self._knots_s(exposure),
            self.camera,
            self.sensor.drawn_sigma_px,
            sub_exposures=None if exposure.trail == "analytic" else partial(self._sub_exposures, exposure),
        )

    def _knots_s(self, exposure: Exposure) -> Float:
        """Return the exposure's ends and the samples of attitude between them, UTC seconds."""
        samples_s = self.flight.attitude.utc_s
        # A sample at the very end cuts nothing: a microsecond more or less must not draw another picture.
        opens_s, closes_s = exposure.start_utc_s + _AT_THE_END_S, exposure.stop_utc_s - _AT_THE_END_S
        first, last = np.searchsorted(samples_s, [opens_s, closes_s])
        return np.concatenate([[exposure.start_utc_s], samples_s[first:last], [exposure.stop_utc_s]])

    def _sub_exposures(self, exposure: Exposure, trail_px: float) -> int:
        """Return into how many an exposure is cut so that a trail of this length has no beads."""
        return max(exposure.min_sub_exposures, ceil(trail_px / (_BEADLESS_SIGMA * self.sensor.psf_sigma_px)))

    def _in_sprites(self, exposure: Exposure) -> Scene:
        # As often as the log tells of attitude, or vibration faster than the sub-exposures would not be seen.
        steps = max(exposure.min_sub_exposures, ceil(self.flight.attitude.rate_hz * exposure.duration_s))
        ends_s = np.linspace(exposure.start_utc_s, exposure.stop_utc_s, steps + 1)
        shutter, (ends, *_) = self._at(_shutter_s(exposure), ends_s)
        visible, reach_px, longest_px = self._touching(ends, exposure, np.full(steps, 1 / steps))
        n = self._sub_exposures(exposure, steps * longest_px)
        return self._composed(exposure, shutter, visible, reach_px, pointing=self.pointing(exposure.sub_utc_s(n)))

    def _swept(self, exposure: Exposure, moments_s: Float) -> Scene:
        shutter, (pointing, *_) = self._at(_shutter_s(exposure), moments_s)
        visible, reach_px, _ = self._touching(pointing, exposure, np.diff(moments_s) / exposure.duration_s)
        segment_share = np.diff(moments_s[::2]) / (moments_s[-1] - moments_s[0])
        return self._composed(exposure, shutter, visible, reach_px, pointing=pointing, segment_share=segment_share)

    def _composed(
        self,
        exposure: Exposure,
        at_shutter: tuple[Pointing, Float, Site],
        visible: NDArray[np.int32],
        reach_px: Float,
        **ways: Any,
    ) -> Scene:
        shutter, q_body_ned, site = at_shutter
        return Scene(
            stars=self.stars,
            visible=visible,
            reach_px=reach_px,
            camera=self.camera,
            sensor=self.sensor,
            exposure=exposure,
            site=site,
            C_camera_body=self.mount.C_camera_body,
            q_body_ned=q_body_ned[1],
            shutter=shutter,
            time_offset_s=self.flight.time_offset_s,
            **ways,
        )

    def pointing(self, utc_s: Float) -> Pointing:
        """Return where the camera looks at each of some moments.

        Parameters
        ----------
        utc_s : (n,) float64
            UTC seconds since 1970, within minutes of each other.

        Returns
        -------
        Pointing

        Raises
        ------
        TrackRangeError
            If a time lies outside the flight.

        Notes
        -----
        Teague & Chahl, eqs (22), (30)-(32), composed in float64.
        """
        return self.pointings(utc_s)[0]

    def pointings(self, *utc_s: Float) -> list[Pointing]:
        """Return `pointing` of several sets of moments; together they take little longer than one.

        Parameters
        ----------
        *utc_s : (n,) float64
            UTC seconds since 1970, all within minutes of each other.

        Returns
        -------
        list of Pointing

        Raises
        ------
        TrackRangeError
            If a time lies outside the flight.
        """
        return [pointing for pointing, _, _ in self._at(*utc_s)]

    def _at(self, *utc_s: Float) -> list[tuple[Pointing, Float, Site]]:
        """Return of each of `pointings` that, the attitudes then, (n, 4), and the place at the middle moment."""
        all_s = np.concatenate(utc_s)
        latitude_rad, longitude_rad, height_m = self.flight.position.coordinates(all_s)
        C_ned_eq = self.sky.C_ned_eq(all_s, latitude_rad, longitude_rad)
        q_body_ned = self.flight.attitude.at(all_s)
        C_camera_eq = self.mount.C_camera_body @ matrix_from_quaternion(q_body_ned) @ C_ned_eq
        found = []
        first = 0
        for moments_s in utc_s:
            these, middle = slice(first, first + len(moments_s)), first + len(moments_s) // 2
            latitude, longitude, height = (float(of[middle]) for of in (latitude_rad, longitude_rad, height_m))
            site = Site(latitude, longitude, height, self.pressure_hpa, self.temperature_c)
            pointing = Pointing(
                C_camera_eq=C_camera_eq[these],
                zenith_eq=-C_ned_eq[these, 2],
                velocity_eq=diurnal_aberration_rad(latitude, height) * C_ned_eq[these, 1],
                refraction_scale=self.sky.refraction_scale(site),
            )
            found.append((pointing, q_body_ned[these], site))
            first = these.stop
        return found

    def _touching(self, ends: Pointing, exposure: Exposure, share: Float) -> tuple[NDArray[np.int32], Float, float]:
        """Return which stars touch the image, how far each is drawn, and the longest way of one between two moments.

        `share` says how much of the exposure passes between one moment and the next.
        """
        step_rad = _largest_turn_rad(ends.C_camera_eq[:-1], ends.C_camera_eq[1:])
        candidates = self._within_cone(ends)
        swept = exposure.trail == "analytic"
        if swept:
            candidates = self._bright_enough(candidates, exposure, self._slowest_px(ends, share))
        candidates = self._within_sides(ends, step_rad, candidates)
        directions = self.stars.direction_eq.take(candidates, axis=0)  # in a fifth of an index's time
        peak_dn = self.sensor.peak_dn(self.stars.camera_mag.take(candidates), exposure.duration_s)
        # A lens that stretches the image stretches sprites with it.
        stretch, pinhole = self.camera.stretch, self.camera.pinhole
        margin_px = stretch * (self.sensor.reach_px(peak_dn) + 1)
        diagonal_px = hypot(self.camera.width_px, self.camera.height_px)
        # That at the image's farthest corner: a star that leaves the image in a step goes on to where pixels grow
        # without bound, and that way does not count.
        bound_px = step_rad * self.camera.most_px_per_rad
        touches = np.zeros(len(candidates), dtype=np.bool_)
        slowest_px = np.full(len(candidates), np.inf)
        longest_px = 0.0
        passed = 0
        for moments in ends.blocks(len(candidates), overlap=1):
            in_camera = moments.to_camera(directions)
            xy = self.camera.project(in_camera)
            # Light is summed as a pinhole has it, and a trail must not be beaded there.
            straight = xy if self.camera.lens is None else pinhole.project(in_camera)
            along = straight[1:] - straight[:-1]
            along_x, along_y = along[..., 0], along[..., 1]
            step_px = np.sqrt(along_x * along_x + along_y * along_y)  # in a fifth of hypot's time
            whole_px = step_px / share[passed : passed + len(step_px), np.newaxis]
            passed += len(step_px)
            unseen = np.isnan(step_px)  # behind the camera or under the horizon: no way
            if unseen.any():
                step_px[unseen], whole_px[unseen] = 0.0, np.inf
            slowest_px = np.minimum(slowest_px, whole_px.min(axis=0))
            beyond_px = self.camera.beyond_px(xy)
            near = beyond_px < margin_px
            longest_px = max(longest_px, float(np.where(near[:-1] | near[1:], step_px, 0.0).max(initial=0.0)))
            touches |= near.any(axis=0)
            # Between two moments a star may graze the image: half a step more on every side.  Far off the axis steps
            # grow without bound, and none across the image is longer than its diagonal.
            far = np.flatnonzero(~touches)
            grazing_px = margin_px[far] + np.minimum(stretch * step_px.take(far, axis=1), diagonal_px) / 2
            beyond_px = beyond_px.take(far, axis=1)
            touches[far] = (np.fmin(beyond_px[:-1], beyond_px[1:]) < grazing_px).any(axis=0)
        slowest_px[np.isinf(slowest_px)] = 0.0  # seen at one moment alone
        if swept:
            touches &= self.sensor.trail_peak_dn(peak_dn, slowest_px) >= FAINTEST_DN
        reach_px = stretch * self.sensor.reach_px(peak_dn[touches], slowest_px[touches], given_back=swept)
        return candidates[touches].astype(np.int32), reach_px, min(longest_px, bound_px)

    def _slowest_px(self, ends: Pointing, share: Float) -> float:
        """Return a bound: how long at the least the way of a star is which goes on as between any two moments, px."""
        C = ends.C_camera_eq
        turn = turn_from_matrix(C[1:] @ np.swapaxes(C[:-1], 1, 2))
        turn_rad = np.linalg.norm(turn, axis=1)
        # The nearer to the axis of the turn, the slower; and the image may be all around it.
        off_axis_rad = np.arctan2(np.hypot(turn[:, 0], turn[:, 1]), np.abs(turn[:, 2]))
        off_axis_rad -= self.camera.reach_rad + self._widest_sprite_rad() + turn_rad.max() + MAX_REFRACTION_RAD
        # A pinhole shows no angle smaller than on its axis.
        px_per_rad = min(self.camera.fx_px, self.camera.fy_px) - abs(self.camera.skew_px)
        step_px = 2 * np.sin(turn_rad / 2) * np.sin(off_axis_rad.clip(min=0.0)) * max(px_per_rad, 0.0)
        return _LEAST_LIFTED * float((step_px / share).min())

    def _bright_enough(self, stars: NDArray[np.intp], exposure: Exposure, slowest_px: float) -> NDArray[np.intp]:
        """Return those of some stars that are bright enough to be drawn if their trails are at least so long."""
        peak_dn = self.sensor.peak_dn(self.stars.camera_mag.take(stars), exposure.duration_s)
        return stars[self.sensor.trail_peak_dn(peak_dn, slowest_px) >= FAINTEST_DN]

    def _within_cone(self, ends: Pointing) -> NDArray[np.intp]:
        """Return the stars that the camera's cone sweeps over: a bound, cheap for a million stars."""
        boresight = ends.boresight_eq
        middle = boresight[len(boresight) // 2]
        swing_rad = acos(min(1.0, max(-1.0, (boresight @ middle).min())))
        radius_rad = self.camera.reach_rad + swing_rad + self._widest_sprite_rad() + MAX_REFRACTION_RAD
        if radius_rad >= np.pi:
            return np.arange(len(self.stars))
        return np.flatnonzero(self.stars.direction_eq @ middle > cos(radius_rad))

    def _within_sides(self, ends: Pointing, step_rad: float, candidates: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those of some stars that the image's four sides sweep over: a bound too, looked at now and then.

        `step_rad` says how far the camera turns from one moment to the next at the most.
        """
        if self.camera.lens is not None:  # its sides are no planes
            return candidates
        C = ends.C_camera_eq
        nearest = np.arange(len(C)) // _LOOKS_APART * _LOOKS_APART
        slack_rad = _largest_turn_rad(C, C[nearest]) + step_rad + self._widest_sprite_rad() + MAX_REFRACTION_RAD
        if slack_rad >= np.pi / 2:
            return candidates
        outside = (_outwards(self.camera) @ C[::_LOOKS_APART]) @ self.stars.direction_eq.take(candidates, axis=0).T
        near: NDArray[np.bool_] = (outside.max(axis=1) < sin(slack_rad)).any(axis=0)
        return candidates[near]

    def _widest_sprite_rad(self) -> float:
        """Return a bound on the angle between a star just outside the image and its sprite's edge inside it."""
        widest_px = 8 * self.sensor.drawn_sigma_px + 1
        return atan(widest_px / min(self.camera.fx_px, self.camera.fy_px))


def _shutter_s(exposure: Exposure) -> Float:
    """Return when the shutter opens, the middle, and when it closes, UTC seconds."""
    return np.array([exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])


# Each scene of a flight asks for the same camera's.
@lru_cache(maxsize=64)
def _outwards(camera: Camera) -> Float:
    """Return the normals of the four planes through a pinhole and the image's sides, (4, 3) unit vectors."""
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = camera.unproject([(-0.5, -0.5), (right, -0.5), (right, bottom), (-0.5, bottom)])
    outwards = np.cross(np.roll(corners, -1, axis=0), corners)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    outwards.flags.writeable = False
    return outwards


def _largest_turn_rad(C: Float, C_other: Float) -> float:
    """Return the largest angle between two attitudes of each pair, rad."""
    chord = C_other - C
    chord2 = np.einsum("nij,nij->n", chord, chord).max()  # Frobenius: 8 sin(angle / 2)^2
    return 2 * asin(min(1.0, sqrt(chord2 / 8)))
