"""From a flight and an exposure to a scene."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import Flight
from glstar.flight.gimbal import NO_GIMBAL, Gimbal
from glstar.render.motion.pointing import CameraMotion, MotionSamples, Pointing
from glstar.render.motion.segmentation import ROLLING_POSITION_PX, TOLERANCES, segment_times
from glstar.render.motion.segmentfit import fitted_segments
from glstar.render.motion.trailmodels import (
    SAMPLE_SPACING_SIGMA,
    SUB_EXPOSURES_PER_SEGMENT,
    AnalyticSegments,
    SegmentLimit,
    SpriteCost,
    SubExposureRule,
    SubExposures,
    TrailModel,
)
from glstar.render.readout.stacking import StackedTrails, union
from glstar.render.scene.bodies import BodySources, body_field
from glstar.render.scene.culling import DrawList, StarCuller, TouchingStars
from glstar.render.scene.occlusion import CloudedSky
from glstar.render.scene.satellites import SatelliteMotion, passing_satellites
from glstar.render.scene.scene import Scene, StarListing
from glstar.render.scene.starcomponents import in_band
from glstar.sky.air.extinction import Extinction
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.solarsystem import observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.photometry import StarBrightness
from glstar.sky.place.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site

Float = NDArray[np.float64]

# A sample of the log within 20 microseconds of the start or the end of an exposure does not divide it: rounding of the
# exposure's time must not change the image.
_NODE_MARGIN_S: Final = 2e-5
# Path tolerance of truth, px.  The mean position over an exposure is exact to second order whatever the tolerance.
TRUTH_TOLERANCE_PX: Final = 0.01
# Motion that takes no more segments than this through every sample is not fitted: a steady turn of 200 deg/s takes 7 in
# 0.2 s.
_FEW_SEGMENTS: Final = SegmentLimit(12)


@dataclass(frozen=True, slots=True, eq=False)
class Simulator:
    """Composes the scenes of one flight; `of` computes its star field.

    With `dataclasses.replace` another camera, mount, sensor or air can be used with the same star field.

    Attributes
    ----------
    flight : Flight
    sky : Sky
    stars : StarField
        The apparent directions in the middle of the flight; computed once, uploaded once.
    camera : Camera
    mount : Mount
    sensor : Sensor
    pressure_hpa, temperature_c : float
        The air at the aircraft.
    sub_exposures_per_segment : float
        Cost of an analytic segment relative to a sub-exposure, for ``trail = "auto"``: see `drawcost`.
    bodies : bool
        Whether the Sun, the Moon and the planets are drawn.
    extinction : Extinction or None
        By the air above the aircraft; None for none.
    gimbal : Gimbal
        What carries the camera; `flight` has the attitude of its platform.
    moving : SatelliteMotion or None
        The motion of the camera against a satellite, if that is the only star.
    """

    flight: Flight
    sky: Sky
    stars: StarField
    camera: Camera
    mount: Mount
    sensor: Sensor
    pressure_hpa: float = STANDARD_PRESSURE_HPA
    temperature_c: float = STANDARD_TEMPERATURE_C
    sub_exposures_per_segment: float = SUB_EXPOSURES_PER_SEGMENT
    bodies: bool = False
    extinction: Extinction | None = None
    gimbal: Gimbal = NO_GIMBAL
    moving: SatelliteMotion | None = None

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
        *,
        bodies: bool = False,
        extinction: Extinction | None = None,
        gimbal: Gimbal = NO_GIMBAL,
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
            Magnitudes that were measured with the camera, which replace the catalogue's.
        bodies : bool
            Whether the Sun, the Moon and the planets are drawn.
        extinction : Extinction, optional
            By the air above the aircraft.
        gimbal : Gimbal
            What carries the camera.

        Returns
        -------
        Simulator

        Raises
        ------
        CalibrationError
            If the brightnesses belong to the stars of another catalogue.
        TelemetryError
            If the flight does not record its gimbal.
        """
        flight = gimbal.carried(flight)
        middle_s = (flight.attitude.first_s + flight.attitude.last_s) / 2
        stars = sky.star_field(middle_s)
        if star_brightness is not None:
            stars = star_brightness.applied(stars)
        return cls(
            *(flight, sky, stars, camera, mount, sensor, pressure_hpa, temperature_c),
            bodies=bodies,
            extinction=extinction,
            gimbal=gimbal,
        )

    def with_flight(self, flight: Flight) -> Self:
        """Return a simulator of the same flight extended with newer samples, which reuses the uploaded star field.

        Parameters
        ----------
        flight : Flight
            At most hours longer: star directions change by 0.03" per hour.

        Returns
        -------
        Simulator
        """
        return replace(self, flight=self.gimbal.carried(flight))

    @property
    def motion(self) -> CameraMotion:
        """The camera's orientation as a function of time."""
        return self.moving or CameraMotion(self.flight, self.sky, self.mount, self.pressure_hpa, self.temperature_c)

    def pointing(self, utc_s: Float) -> Pointing:
        """Return the camera's orientation at some times.

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
        """
        return self.motion.pointings(utc_s)[0]

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
            If the field of view of the camera's lens is too wide to be drawn.
        ConfigError
            If the sum of short exposures does not fit into 16 bits.

        Notes
        -----
        Teague & Chahl, section 2.6.  Departs from the paper's n = 200 dt: n = max(ceil(200 dt), ceil(longest trail
        / 1.5 sigma)), because at 60 deg/s a star moves by 20 px in 5 ms; the trail is measured at its fastest, so
        that no part of it shows a sampling ripple.  Analytic trails have no sub-exposures: see
        `glstar.render.motion.segmentation`.
        """
        self.camera.require_drawable()
        scene = self._stacked(exposure) if exposure.frames > 1 else self._single(exposure)
        if self.sky.satellites is None:
            return scene
        # Each with the motion of the camera against it, as the only star.
        alone = replace(self, sky=replace(self.sky, satellites=None), bodies=False)
        passing = passing_satellites(self.motion, self.camera, exposure)
        made = [replace(alone, stars=one.field(self.stars), moving=one).scene(exposure) for one in passing]
        return replace(scene, satellites=tuple(one for one in made if len(one.visible)))

    def _single(self, exposure: Exposure) -> Scene:
        """Return the scene of one exposure, without satellites."""
        path = _TruePath(self, exposure)
        trails = None if exposure.trail == "sprites" else self._segments(exposure, path)
        if trails is None:
            return self._from_sub_exposures(replace(exposure, trail="sprites"), path)
        return self._from_segments(replace(exposure, trail="analytic"), trails, path)

    def _stacked(self, exposure: Exposure) -> Scene:
        """Return the scene of a stacked image: that of each short exposure, and what truth lists of all together."""
        exposure.full_scale_dn(self.sensor.saturation_dn)  # raises if it does not fit
        shorts = tuple(map(self.scene, exposure.short_exposures()))
        shutter, (ends, *_) = self.motion.at(_shutter_s(exposure), np.unique(exposure.short_times_s()))
        # The light of one short exposure, at each of their ends: an upper bound of what a body leaves on any of them.
        bodies, _ = self._body_sources(exposure, shutter.site, ends, np.ones(len(ends) - 1), analytic=False)
        composed = self._composed(
            replace(exposure, trail=shorts[0].exposure.trail),
            shutter,
            union([short.draw_list for short in shorts]),
            StackedTrails([short.trails for short in shorts]),
            _TruePath(self, exposure.first),
            bodies,
        )
        listings = [short.listing for short in shorts if short.listing is not None]
        listing = StarListing(
            lambda: union([one.stars for one in listings]), lambda: StackedTrails([one.trails for one in listings])
        )
        return replace(composed, listing=listing, shorts=shorts)

    def _segments(self, exposure: Exposure, path: "_TruePath") -> AnalyticSegments | None:
        """Return an exposure's segments; None where sprites cost less."""
        sprite_cost = None if exposure.trail == "analytic" else self._sprite_cost(exposure)
        if exposure.path_tolerance_px == 0:
            return self.exact_segments(exposure, sprite_cost)
        fitted = path.few
        if fitted is None:
            fitted = path.fitted if path.is_drawn else self.fitted(exposure, exposure.path_tolerance_px)
        if fitted is None:
            return self.exact_segments(exposure, sprite_cost)
        # Stars that are not narrow are drawn in pieces where that costs less than segments: always less than sprites.
        if sprite_cost is None or not self.sensor.core.needs_erf or len(fitted) <= sprite_cost.in_segments(0.0):
            return fitted
        return fitted if len(fitted) <= sprite_cost.in_segments(fitted.longest_trail_px(self.camera)) else None

    def fitted(self, exposure: Exposure, tolerance_px: float) -> AnalyticSegments | None:
        """Return least-squares segments of an exposure: see `fitted_segments`."""
        return fitted_segments(
            self.motion,
            self._nodes_s(exposure),
            self.camera,
            self.sensor.core.effective_sigma_px,
            tolerance_px,
            psf_sigma_px=self.sensor.core.psf_sigma_px,
            position_px=_position_px(exposure),
            readout_s=exposure.readout_s,
        )

    def exact_segments(
        self, exposure: Exposure, sprite_cost: SpriteCost | SegmentLimit | None
    ) -> AnalyticSegments | None:
        """Return segments that pass through every sample of the log; None where sprites cost less."""
        times_s = segment_times(
            self.motion,
            self._nodes_s(exposure),
            self.camera,
            self.sensor.core.effective_sigma_px,
            sprite_cost=sprite_cost,
            position_px=_position_px(exposure),
        )
        if times_s is None:
            return None
        (pointing,) = self.motion.pointings(times_s)
        return AnalyticSegments(
            pointing,
            np.diff(times_s[::2]) / (times_s[-1] - times_s[0]),
            half_fraction=np.diff(times_s) / exposure.duration_s,
        )

    def _nodes_s(self, exposure: Exposure) -> Float:
        """Return the exposure's start and end and the samples of attitude between them, UTC seconds."""
        samples_s = self.flight.attitude.utc_s
        inside_s = [exposure.start_utc_s + _NODE_MARGIN_S, exposure.stop_utc_s - _NODE_MARGIN_S]
        first, last = np.searchsorted(samples_s, inside_s)
        return np.concatenate([[exposure.start_utc_s], samples_s[first:last], [exposure.stop_utc_s]])

    def _sub_exposure_rule(self, exposure: Exposure) -> SubExposureRule:
        return SubExposureRule(exposure.min_sub_exposures, SAMPLE_SPACING_SIGMA * self.sensor.core.psf_sigma_px)

    def _sprite_cost(self, exposure: Exposure) -> SpriteCost:
        return SpriteCost(self._sub_exposure_rule(exposure), self.sub_exposures_per_segment)

    def _from_sub_exposures(self, exposure: Exposure, path: "_TruePath") -> Scene:
        # At the rate of the attitude log at least, so that vibration faster than the sub-exposures is not missed.
        steps = max(exposure.min_sub_exposures, ceil(self.flight.attitude.rate_hz * exposure.span_s))
        ends_s = np.linspace(exposure.start_utc_s, exposure.stop_utc_s, steps + 1)
        shutter, (ends, *_) = self.motion.at(_shutter_s(exposure), ends_s)
        step_fraction = np.full(steps, exposure.span_s / exposure.duration_s / steps)
        touching = self._culler(self._stars_in_band, shutter.site).touching(ends, step_fraction, exposure.duration_s)
        bodies, body_step_px = self._body_sources(exposure, shutter.site, ends, step_fraction, analytic=False)
        n = self._sub_exposure_rule(exposure).count(steps * max(touching.longest_step_px, body_step_px))
        trails = SubExposures(self.pointing(exposure.sub_utc_s(n)))
        sky = CloudedSky.of(self.motion, self.camera, self.sensor, exposure)
        if sky is not None:
            part = np.full(n, 1 / n)
            draw_list, bodies = sky.dimmed(self._stars_in_band, touching.summed, part), sky.dimmed_bodies(bodies, part)
            return self._composed(exposure, shutter, draw_list, trails, path, bodies)
        return self._composed(exposure, shutter, touching.summed, trails, path, bodies)

    def _from_segments(self, exposure: Exposure, trails: AnalyticSegments, path: "_TruePath") -> Scene:
        shutter = path.shutter
        touching = path.touching if path.is_along(trails) else self.touching(exposure, trails, shutter.site)
        draw_list = touching.integrated(exposure.faintest_dn)
        step_fraction = trails.half_fractions(exposure.span_s / exposure.duration_s)
        bodies, _ = self._body_sources(exposure, shutter.site, trails.pointing, step_fraction, analytic=True)
        sky = CloudedSky.of(self.motion, self.camera, self.sensor, exposure)
        if sky is not None:
            trails, draw_list, bodies = sky.behind(trails, self._stars_in_band, draw_list, bodies)
        return self._composed(exposure, shutter, draw_list, trails, path, bodies)

    def touching(self, exposure: Exposure, trails: AnalyticSegments, site: Site) -> TouchingStars:
        """Return the stars that may touch the image of an exposure along some trails."""
        step_fraction = trails.half_fractions(exposure.span_s / exposure.duration_s)
        culler = self._culler(self._stars_in_band, site)
        return culler.touching(trails.pointing, step_fraction, exposure.duration_s)

    def _body_sources(
        self, exposure: Exposure, site: Site, pointing: Pointing, time_fraction: Float, *, analytic: bool
    ) -> tuple[BodySources | None, float]:
        """Return the bodies in the middle of an exposure, and their longest step as of `StarCuller.touching`."""
        if not self.bodies:
            return None, 0.0
        bodies = observed_bodies(self.sky, exposure.mid_utc_s, site)
        directions = np.array([body.direction_eq for body in bodies])
        radius_rad = np.array([body.angular_radius_rad for body in bodies])
        angle_rad = np.arccos(np.clip(pointing.boresight_eq @ directions.T, -1, 1))
        swing_rad = 0.0 if len(pointing) < 2 else float(_angles_rad(pointing.boresight_eq).max())
        margin_rad = self.camera.field_radius_rad + swing_rad + MAX_REFRACTION_RAD
        near = angle_rad.min(axis=0) < radius_rad + margin_rad
        sigma_rad = self.sensor.effective_sigma_px / max(self.camera.fx_px, self.camera.fy_px)
        field = in_band(body_field(bodies, self.stars, sigma_rad, near), self.sensor.colour)
        culler = self._culler(field, site)
        touching = culler.touching(pointing, time_fraction, exposure.duration_s)
        draw_list = touching.integrated(exposure.faintest_dn) if analytic else touching.summed
        return BodySources(bodies, field, draw_list), touching.longest_step_px

    def _q_aircraft_ned(self, utc_s: float) -> Float | None:
        """Return the attitude of the aircraft below a gimbal; None without one."""
        own = self.flight.own_attitude
        return None if own is None else own.at(utc_s)

    def _culler(self, stars: StarField, site: Site) -> StarCuller:
        zenith_mag = None if self.extinction is None else self.extinction.zenith_mag(site.height_m)
        return StarCuller(stars, self.camera, self.sensor, zenith_mag)

    @property
    def _stars_in_band(self) -> StarField:
        """The stars with their magnitudes in the band of the sensor; the same object for every scene."""
        return in_band(self.stars, self.sensor.colour)

    def _composed(
        self,
        exposure: Exposure,
        at_shutter: MotionSamples,
        draw_list: DrawList,
        trails: TrailModel,
        path: "_TruePath",
        bodies: BodySources | None,
    ) -> Scene:
        shutter, q_body_ned, site = at_shutter
        return Scene(
            stars=self._stars_in_band,
            draw_list=draw_list,
            trails=trails,
            camera=self.camera,
            sensor=self.sensor,
            exposure=exposure,
            site=site,
            C_camera_body=self.mount.C_camera_body,
            q_body_ned=q_body_ned[1],
            q_aircraft_ned=self._q_aircraft_ned(exposure.mid_utc_s),
            shutter=shutter,
            time_offset_s=self.flight.time_offset_s,
            bodies=bodies,
            extinction=self.extinction,
            listing=StarListing(lambda: path.touching.listed, lambda: path.with_ridges(bodies)),
            observing_sky=self.sky,
            motion=self.motion,
        )


class _TruePath:
    """The motion of the stars over an exposure and the stars that touch its image, however it is drawn."""

    def __init__(self, simulator: Simulator, exposure: Exposure) -> None:
        self._simulator = simulator
        self._exposure = exposure

    @cached_property
    def shutter(self) -> MotionSamples:
        """The camera as the shutter opens, in the middle of the exposure and as the shutter closes."""
        (shutter,) = self._simulator.motion.at(_shutter_s(self._exposure))
        return shutter

    @property
    def is_drawn(self) -> bool:
        """Whether trails are drawn along the fitted path, if there is one."""
        return self._exposure.path_tolerance_px == TRUTH_TOLERANCE_PX

    def is_along(self, trails: AnalyticSegments) -> bool:
        """Return whether trails that are drawn are those of truth."""
        if self._exposure.path_tolerance_px == 0:
            return False
        return trails is self.few or (self.is_drawn and trails is self.fitted)

    @cached_property
    def few(self) -> AnalyticSegments | None:
        """Segments through every sample of the log, if few suffice: a fit gains nothing then."""
        return self._simulator.exact_segments(self._exposure, _FEW_SEGMENTS)

    @cached_property
    def fitted(self) -> AnalyticSegments | None:
        """Least-squares segments, whose mean positions are those of the interpolated attitude."""
        return self._simulator.fitted(self._exposure, TRUTH_TOLERANCE_PX)

    @cached_property
    def trails(self) -> AnalyticSegments:
        """The few or the fitted segments, or segments through every sample of the log where a fit fails."""
        if self.few is not None:
            return self.few
        if self.fitted is not None:
            return self.fitted
        exact = self._simulator.exact_segments(self._exposure, None)
        assert exact is not None
        return exact

    def with_ridges(self, bodies: BodySources | None) -> AnalyticSegments:
        """Return the paths of truth, finely divided where a star or a body sets behind a horizon profile."""
        simulator, exposure = self._simulator, self._exposure
        sky = CloudedSky.of(simulator.motion, simulator.camera, simulator.sensor, exposure)
        return self.trails if sky is None else sky.divided_at_ridges(self.trails, self.touching, bodies)

    @cached_property
    def touching(self) -> TouchingStars:
        """The stars that may touch the image."""
        return self._simulator.touching(self._exposure, self.trails, self.shutter.site)


def _shutter_s(exposure: Exposure) -> Float:
    """Return when the shutter opens, the middle of the exposure, and when it closes, UTC seconds."""
    return np.array([exposure.start_utc_s, exposure.mid_utc_s, exposure.stop_utc_s])


def _angles_rad(directions: Float) -> Float:
    """Return the angles between consecutive unit vectors, (n - 1,) rad."""
    chord = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1.0)))


def _position_px(exposure: Exposure) -> float:
    """Return the largest distance between a star's position on a path and where it is drawn at the same time, px."""
    return ROLLING_POSITION_PX if exposure.readout_s else TOLERANCES.position_px
