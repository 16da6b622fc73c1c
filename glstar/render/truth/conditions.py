"""What a scene's exposure is taken under: Sun, Moon, the ground, and the limiting magnitude."""

from dataclasses import dataclass
from functools import lru_cache
from math import asin, degrees, isfinite, log10, nan, pi, radians

import numpy as np

from glstar.arrays import Float
from glstar.camera.model import Mount
from glstar.camera.mounts import mount_label
from glstar.camera.sensor.sensor import limiting_mag, noise_equivalent_area_px2
from glstar.errors import RenderError
from glstar.render.effects.cloud import axis_transmission, frame_transmission, sky_fraction
from glstar.render.effects.naturalsky import natural_sky_dn
from glstar.render.readout.rows import recorded_times
from glstar.render.scene.clouds import cloud_sheet
from glstar.render.scene.scene import Scene
from glstar.render.truth.peaks import trail_peaks
from glstar.sky.air.refraction import refraction_rad
from glstar.sky.air.skybrightness import light_name
from glstar.sky.observed.solarsystem import Body, observed_bodies
from glstar.sky.observed.stars import Sky
from glstar.sky.place.site import Site

# The Sun and the Moon are computed for the middle of every interval of this length, s: the Moon moves by 15" in half
# of it, and its parallax changes by 8".
_INTERVAL_S = 60.0
# Step of latitude and longitude for which they are computed, deg: half a step changes the Moon's parallax by 3".
_STEP_DEG = 0.1


@dataclass(frozen=True, slots=True)
class ViewingConditions:
    """Where the Sun and the Moon are in the middle of an exposure, and where the camera points."""

    sun_altitude_rad: float  # Without refraction, rad
    moon_altitude_rad: float  # With refraction, rad
    moon_illuminated_fraction: float  # 0 to 1
    moon_separation_rad: float  # From the optical axis, rad
    axis_altitude_rad: float  # Of the optical axis above the horizon, with its dip if it has one, rad
    sees_only_ground: bool  # Whether the complete image is below the horizon
    mount: Mount  # Of the camera, named in the warning

    @property
    def light(self) -> str:
        """``"day"``, ``"night"``, or which twilight."""
        return light_name(self.sun_altitude_rad)

    @property
    def sun_and_moon(self) -> str:
        """The Sun and the Moon in one line; of a Moon below the horizon the altitude only."""
        moon = f"Sun {degrees(self.sun_altitude_rad):.0f} deg, Moon {degrees(self.moon_altitude_rad):.0f} deg"
        if self.moon_altitude_rad < 0:
            return moon
        separation_deg = degrees(self.moon_separation_rad)
        return f"{moon}, {self.moon_illuminated_fraction:.0%} lit, {separation_deg:.0f} deg from the axis"

    @property
    def warning(self) -> str:
        """Why a real camera would see few stars or none, a line for each reason; empty at night."""
        lines = []
        if self.light == "day":
            lines.append(f"day: the Sun is {_up(self.sun_altitude_rad)}")
        elif self.light == "civil twilight":
            lines.append(f"bright twilight: the Sun is {_up(self.sun_altitude_rad)}")
        return "\n".join([*lines, *filter(None, [self.ground_warning])])

    @property
    def ground_warning(self) -> str:
        """That the camera points at the ground; empty if it points at the sky."""
        if self.sees_only_ground:
            return f"the camera sees only the ground ({mount_label(self.mount)}): [mount] says how it is mounted"
        if self.axis_altitude_rad < 0:
            below_deg = -degrees(self.axis_altitude_rad)
            return f"the camera points at the ground, {below_deg:.0f} deg below the horizon ({mount_label(self.mount)})"
        return ""


def _up(altitude_rad: float) -> str:
    altitude_deg = degrees(altitude_rad)
    return f"{altitude_deg:.0f} deg up" if altitude_deg >= 0 else f"{-altitude_deg:.1f} deg below the horizon"


def viewing_conditions(scene: Scene) -> ViewingConditions:
    """Return the Sun, the Moon and the direction of the camera in the middle of an exposure.

    Altitudes and angles are within 0.02 deg, because Sun and Moon are computed once a minute.  Raises RenderError if
    the scene is not one of a simulator, which knows its sky.
    """
    if scene.observing_sky is None:
        raise RenderError("the Sun and the Moon need a scene of a simulator, which knows where they are")
    interval = int(scene.exposure.mid_utc_s // _INTERVAL_S)
    places = (round(degrees(rad) / _STEP_DEG) for rad in (scene.site.latitude_rad, scene.site.longitude_rad))
    sun, moon = _sun_and_moon(scene.observing_sky, interval, *places)
    zenith, axis = scene.shutter.zenith_eq[1], scene.shutter.boresight_eq[1]
    sun_rad, moon_rad = (_elevation_rad(body.direction_eq, zenith) for body in (sun, moon))
    sine = float(axis @ zenith)
    axis_rad = _elevation_rad(axis, zenith) - asin(sine - float(scene.above_horizon(axis)))
    return ViewingConditions(
        sun_altitude_rad=sun_rad,
        moon_altitude_rad=moon_rad + float(refraction_rad(moon_rad, scene.shutter.refraction_scale)),
        moon_illuminated_fraction=moon.illuminated_fraction,
        moon_separation_rad=pi / 2 - _elevation_rad(moon.direction_eq, axis),
        axis_altitude_rad=axis_rad,
        sees_only_ground=_sees_only_ground(scene, axis_rad),
        mount=Mount.from_matrix(scene.C_camera_body),
    )


def _sees_only_ground(scene: Scene, axis_rad: float) -> bool:
    """Return whether no part of the image is above the horizon; the optical axis is by `axis_rad`."""
    if scene.shutter.profile is None:
        return axis_rad < -scene.camera.field_radius_rad
    return sky_fraction(scene) == 0


@lru_cache(maxsize=4)
def _sun_and_moon(sky: Sky, interval: int, latitude: int, longitude: int) -> tuple[Body, Body]:
    """Return the Sun and the Moon in the middle of an interval, from near a site."""
    site = Site(radians(latitude * _STEP_DEG), radians(longitude * _STEP_DEG), 0.0)
    sun, moon = observed_bodies(sky, (interval + 0.5) * _INTERVAL_S, site, ("Sun", "Moon"))
    return sun, moon


def _elevation_rad(direction: Float, zenith: Float) -> float:
    return asin(float(np.clip(direction @ zenith, -1.0, 1.0)))


@dataclass(frozen=True, slots=True)
class LimitingMagnitude:
    """Magnitudes of stars on the optical axis that are measured with a signal-to-noise ratio of 5."""

    at_rest_mag: float  # Of a star that does not move on the image; NaN if there is none
    trail_mag: float  # Of a star with the trail of this exposure; NaN if there is none
    cloud_transmission: float | None = None  # The mean over the sky of the image; None without cloud, and without sky

    @property
    def text(self) -> str:
        """All in one line."""
        if not isfinite(self.at_rest_mag):
            return "no star: the sky saturates"
        trail = f", {self.trail_mag:.1f} as a trail" if isfinite(self.trail_mag) else ""
        passed = self.cloud_transmission
        cloud = "" if passed is None else f", cloud transmits {100 * passed:.0f} % on average"
        return f"limit V {self.at_rest_mag:.1f} at rest{trail}{cloud}"


def conditions_report(scene: Scene) -> str:
    """Return the light, Sun, Moon, limiting magnitude and cloud of an exposure in one line, with the warnings.

    Raises RenderError if the scene is not one of a simulator, which knows its sky.
    """
    conditions = viewing_conditions(scene)
    parts = [f"{conditions.light}: {conditions.sun_and_moon}", limiting_magnitude(scene).text]
    return "; ".join([*parts, *(line for line in conditions.warning.splitlines() if not line.startswith("day"))])


def limiting_magnitude(scene: Scene) -> LimitingMagnitude:
    """Return the limiting magnitude above the air, with the sky, extinction, cloud and trail of the optical axis."""
    zenith, axis = scene.shutter.zenith_eq[1], scene.shutter.boresight_eq[1]
    sine = float(axis @ zenith)
    is_ground = bool(scene.above_horizon(axis) < 0)
    extinction = None if is_ground else scene.extinction_mag(sine)
    extinction_mag = 0.0 if extinction is None else float(extinction)
    sky_dn = natural_sky_dn(scene)
    sensor, duration_s, frames = scene.sensor, scene.exposure.duration_s, scene.exposure.frames
    rest_px2 = noise_equivalent_area_px2(sensor)
    at_rest_mag = limiting_mag(sensor, duration_s, rest_px2, sky_dn=sky_dn, frames=frames)
    trail_px2 = nan if is_ground else _trail_area_px2(scene, axis)
    trail_mag = nan
    if isfinite(trail_px2):
        trail_mag = limiting_mag(sensor, duration_s, trail_px2, sky_dn=sky_dn, frames=frames)
    cloud = 1.0 if is_ground else axis_transmission(scene)
    lost_mag = extinction_mag - 2.5 * log10(max(cloud, 1e-30))
    has_cloud = cloud_sheet(sensor, scene.motion) is not None
    mean = frame_transmission(scene) if has_cloud else None
    return LimitingMagnitude(at_rest_mag - lost_mag, trail_mag - lost_mag, mean)


def _trail_area_px2(scene: Scene, direction_eq: Float) -> float:
    """Return the noise-equivalent area of the trail of a star."""
    recorded = recorded_times(scene, direction_eq[np.newaxis]) if scene.exposure.readout_s else None
    return float(trail_peaks(scene, direction_eq[np.newaxis], recorded=recorded).area_px2[0])
