"""From a flight and an exposure to a scene: sub-exposures or segments, bodies, satellites and stacked exposures."""

from dataclasses import dataclass, replace
from math import ceil
from typing import Self

import numpy as np

from glstar.arrays import Float
from glstar.camera.exposure import Exposure, Trail
from glstar.camera.model import Camera, Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import Flight
from glstar.flight.gimbal import NO_GIMBAL, Gimbal
from glstar.render.motion import trailmodels
from glstar.render.motion.pointing import CameraMotion, MotionSamples, Pointing
from glstar.render.motion.trailmodels import SubExposureRule, SubExposures, TrailModel
from glstar.render.readout.stacking import StackedListing, StackedTrails, union
from glstar.render.scene.attenuation import Attenuation
from glstar.render.scene.bodies import BodySources, body_field, star_sigma_rad
from glstar.render.scene.culling import DrawList
from glstar.render.scene.exposuremotion import ExposureListing, ExposureMotion
from glstar.render.scene.satellites import SatelliteMotion, Sunlight, passing_satellites
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import in_band
from glstar.sky.air.extinction import Extinction
from glstar.sky.air.refraction import MAX_REFRACTION_RAD
from glstar.sky.catalogue.starfield import StarField
from glstar.sky.observed.solarsystem import observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.photometry import StarBrightness
from glstar.sky.place.site import STANDARD_PRESSURE_HPA, STANDARD_TEMPERATURE_C, Site


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
    bodies : bool
        Whether the Sun, the Moon and the planets are drawn.
    earthshine : bool
        Whether the light of the Earth on the Moon is drawn too.
    extinction : Extinction or None
        Extinction by the air above the aircraft; None without extinction.
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
    bodies: bool = False
    earthshine: bool = False
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
        earthshine: bool = False,
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
        earthshine : bool
            Whether the light of the Earth on the Moon is drawn too.
        extinction : Extinction, optional
            Extinction by the air above the aircraft.
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
            flight=flight,
            sky=sky,
            stars=stars,
            camera=camera,
            mount=mount,
            sensor=sensor,
            pressure_hpa=pressure_hpa,
            temperature_c=temperature_c,
            bodies=bodies,
            earthshine=earthshine,
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
        ConfigError
            If the sum of short exposures does not fit into 16 bits.

        Notes
        -----
        Teague & Chahl, section 2.6.  Departs from the paper's n = 200 dt: n = max(ceil(200 dt), ceil(longest trail /
        1.5 sigma)), because at 60 deg/s a star moves by 20 px in 5 ms.  The trail is measured at its fastest, so that
        no part of it shows a sampling ripple.  Analytic trails have no sub-exposures: see
        `glstar.render.motion.segmentation`.
        """
        scene = self._stacked(exposure) if exposure.frames > 1 else self._single(exposure)
        if self.sky.satellites is None:
            return scene
        # Each with the motion of the camera against it, as the only star.
        alone = replace(self, sky=replace(self.sky, satellites=None), bodies=False)
        scenes = [
            replace(alone, stars=motion.field(self.stars), moving=motion).scene(exposure)
            for motion in passing_satellites(self.motion, self.camera, exposure)
        ]
        return replace(scene, satellites=tuple(satellite for satellite in scenes if len(satellite.visible)))

    def _single(self, exposure: Exposure) -> Scene:
        """Return the scene of one exposure, without satellites."""
        path = self._exposure_motion(exposure)
        return self._from_sub_exposures(path) if exposure.trail == "sprites" else self._from_segments(path)

    def _exposure_motion(self, exposure: Exposure) -> ExposureMotion:
        motion = self.motion
        sunlight = None if self.moving is None else Sunlight(self.moving, exposure)
        return ExposureMotion(
            motion,
            exposure,
            camera=self.camera,
            sensor=self.sensor,
            stars=in_band(self.stars, self.sensor.colour),
            extinction=self.extinction,
            attenuation=Attenuation.of(motion, self.camera, self.sensor, exposure, sunlight),
        )

    def _stacked(self, exposure: Exposure) -> Scene:
        """Return the scene of a stacked image: that of each short exposure, and what truth lists of all together."""
        exposure.full_scale_dn(self.sensor.saturation_dn)  # raises if it does not fit
        path, shorts = self._exposure_motion(exposure), tuple(map(self.scene, exposure.short_exposures()))
        shutter, (ends, *_) = self.motion.at(path.shutter_s, np.unique(exposure.short_times_s()))
        # The light of one short exposure, at each of their ends: an upper bound of what a body leaves on any of them.
        bodies, _ = self._body_sources(path, shutter.site, ends, np.ones(len(ends) - 1), analytic=False)
        scene = self._composed(
            path,
            shorts[0].exposure.trail,
            shutter,
            union([short.draw_list for short in shorts]),
            StackedTrails([short.trails for short in shorts]),
            bodies,
        )
        listings = [short.listing for short in shorts if short.listing is not None]
        return replace(scene, listing=StackedListing(listings), shorts=shorts)

    def _sub_exposure_rule(self, exposure: Exposure) -> SubExposureRule:
        spacing_px = trailmodels.SAMPLE_SPACING_SIGMA * self.sensor.core.psf_sigma_px
        return SubExposureRule(exposure.min_sub_exposures, spacing_px)

    def _from_sub_exposures(self, path: ExposureMotion) -> Scene:
        exposure = path.exposure
        # At the rate of the attitude log at least, so that vibration faster than the sub-exposures is not missed.
        steps = max(exposure.min_sub_exposures, ceil(self.flight.attitude.rate_hz * exposure.span_s))
        ends_s = np.linspace(exposure.start_utc_s, exposure.stop_utc_s, steps + 1)
        shutter, (ends, *_) = self.motion.at(path.shutter_s, ends_s)
        step_fraction = np.full(steps, exposure.span_s / exposure.duration_s / steps)
        touching = path.culler(path.stars, shutter.site).touching(ends, step_fraction, exposure.duration_s)
        bodies, body_step_px = self._body_sources(path, shutter.site, ends, step_fraction, analytic=False)
        count = self._sub_exposure_rule(exposure).count(steps * max(touching.longest_step_px, body_step_px))
        part = np.full(count, 1 / count)
        return self._composed(
            path,
            "sprites",
            shutter,
            path.attenuation.dimmed(path.stars, touching.summed, part),
            SubExposures(self.pointing(exposure.sub_utc_s(count))),
            path.attenuation.dimmed_bodies(bodies, part),
        )

    def _from_segments(self, path: ExposureMotion) -> Scene:
        segments = path.drawn_segments
        draw_list = path.touching_along(segments).integrated(path.exposure.faintest_dn)
        step_fraction = path.half_fractions(segments)
        bodies, _ = self._body_sources(path, path.shutter.site, segments.pointing, step_fraction, analytic=True)
        segments, draw_list, bodies = path.attenuation.behind(segments, path.stars, draw_list, bodies)
        return self._composed(path, "analytic", path.shutter, draw_list, segments, bodies)

    def _body_sources(
        self, path: ExposureMotion, site: Site, pointing: Pointing, time_fraction: Float, *, analytic: bool
    ) -> tuple[BodySources | None, float]:
        """Return the bodies in the middle of an exposure, and their longest step as of `StarCuller.touching`."""
        if not self.bodies:
            return None, 0.0
        exposure = path.exposure
        bodies = observed_bodies(self.sky, exposure.mid_utc_s, site)
        if not self.earthshine:
            bodies = tuple(replace(body, earthshine_vmag=None) for body in bodies)
        directions = np.array([body.direction_eq for body in bodies])
        radius_rad = np.array([body.angular_radius_rad for body in bodies])
        angle_rad = np.arccos(np.clip(pointing.boresight_eq @ directions.T, -1, 1))
        swing_rad = 0.0 if len(pointing) < 2 else float(_angles_rad(pointing.boresight_eq).max())
        margin_rad = self.camera.field_radius_rad + swing_rad + MAX_REFRACTION_RAD
        near = angle_rad.min(axis=0) < radius_rad + margin_rad
        sigma_rad = star_sigma_rad(self.camera, self.sensor.effective_sigma_px, angle_rad)
        field = in_band(body_field(bodies, self.stars, sigma_rad, near), self.sensor.colour)
        touching = path.culler(field, site).touching(pointing, time_fraction, exposure.duration_s)
        draw_list = touching.integrated(exposure.faintest_dn) if analytic else touching.summed
        return BodySources(bodies, field, draw_list), touching.longest_step_px

    def _composed(
        self,
        path: ExposureMotion,
        trail: Trail,
        at_shutter: MotionSamples,
        draw_list: DrawList,
        trails: TrailModel,
        bodies: BodySources | None,
    ) -> Scene:
        shutter, q_body_ned, site = at_shutter
        own_attitude = self.flight.own_attitude
        return Scene(
            stars=path.stars,
            draw_list=draw_list,
            trails=trails,
            camera=self.camera,
            sensor=self.sensor,
            exposure=replace(path.exposure, trail=trail),
            site=site,
            C_camera_body=self.mount.C_camera_body,
            q_body_ned=q_body_ned[1],
            q_aircraft_ned=None if own_attitude is None else own_attitude.at(path.exposure.mid_utc_s),
            shutter=shutter,
            time_offset_s=self.flight.time_offset_s,
            bodies=bodies,
            extinction=self.extinction,
            listing=ExposureListing(path, bodies),
            observing_sky=self.sky,
            motion=path.motion,
            attenuation=path.attenuation,
        )


def _angles_rad(directions: Float) -> Float:
    """Return the angles between consecutive unit vectors, (n - 1,) rad."""
    chord = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    return np.asarray(2 * np.arcsin(np.minimum(chord / 2, 1.0)))
