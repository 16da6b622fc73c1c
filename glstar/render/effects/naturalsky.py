"""Brightness of the sky by direction, and the ground below the horizon."""

from collections.abc import Hashable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import erfa
import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.errors import RenderError
from glstar.render.effects import sky as skylight
from glstar.render.effects.cloud import crossing_at, is_below_cloud
from glstar.render.effects.effect import Control, Effect, EffectTexture, Key, Stage, Values
from glstar.render.effects.lensflare import FLARE, flare_at_nodes, has_flare
from glstar.render.scene.clouds import cloud_sheet
from glstar.render.scene.scene import Scene
from glstar.sky.air import skybrightness
from glstar.sky.air.clouds import CloudLights, cloud_from_above, cloud_from_below
from glstar.sky.air.extinction import Extinction, air_mass
from glstar.sky.observed.solarsystem import Body
from glstar.sky.photometry import brightness_ratio, magnitude_difference

# Distance of nodes with a horizon profile at most, px: sky and ground are linear along 8 or 16 pixels of a row.
_RIDGE_PX = 12
# Weights of the start, the middle and the end of the exposure: Simpson's rule.
_TIME_WEIGHTS = (1 / 6, 4 / 6, 1 / 6)
# Below this rotation of the camera during the exposure, rad, the middle represents it.
_STILL_RAD = np.deg2rad(0.5)
# Number of azimuths in the mean brightness of the ground.
_AZIMUTHS = 24
# Town glow of no town.
NO_TOWN_MAG = 30.0
_ARCSEC2_PER_SR = (648000 / np.pi) ** 2
_DEFAULT = skybrightness.SkyLights()
# The airglow is at least this fraction of the dark sky at the zenith.
_LEAST_AIRGLOW = 0.3
# Magnitudes down to which the catalogues have all stars.
_COMPLETE_MAG = {"bsc5": 6.5, "hipparcos": 7.5, "gaia": 10.0, "tycho2": 11.0}


def _lights(values: Values) -> skybrightness.SkyLights:
    return skybrightness.SkyLights(
        zenith_mag_arcsec2=float(values["zenith_mag_arcsec2"]),
        moonlight=bool(values["moonlight"]),
        twilight=bool(values["twilight"]),
        town_mag_arcsec2=float(values["town_mag_arcsec2"]),
        town_azimuth_rad=float(np.deg2rad(town)) if (town := float(values["town_azimuth_deg"])) >= 0 else None,
        ground_fraction=float(values["ground_fraction"]),
    )


def sky_radiance_at(values: Values, scene: Scene, time: int, direction_eq: Float) -> Float:
    """Return the brightness of the sky without the ground, (...) flux per arcsec^2 over that of magnitude 0.

    `values` are the effect's keys, and `time` is 0, 1 or 2 for the start, the middle or the end of the exposure.
    `direction_eq` (..., 3) are apparent unit vectors, true equator and equinox, with refraction.
    """
    zenith = scene.shutter.zenith_eq[time]
    sun, moon = _sun_and_moon(scene)
    sine = direction_eq @ zenith
    # North is the pole's direction without its vertical part.
    north = np.array([0.0, 0.0, 1.0]) - zenith[2] * zenith
    east = np.cross(north, zenith)
    view = skybrightness.SkyView(
        sine_altitude=sine,
        azimuth_rad=np.arctan2(direction_eq @ east, direction_eq @ north),
        moon_separation_rad=erfa.sepp(direction_eq, moon.direction_eq),
        sun_separation_rad=erfa.sepp(direction_eq, sun.direction_eq),
    )
    lights = _lights(values)
    state = _state(scene)
    if not values["zodiacal_light"] and not values["galaxy"]:
        return skybrightness.sky_radiance(view, lights, state)
    zenith_mag = state.extinction.zenith_mag(state.height_m)
    beyond = skybrightness.beyond_the_air_s10(
        direction_eq @ scene.stars.C_eq_icrs,
        sun.direction_eq @ scene.stars.C_eq_icrs,
        zodiacal=bool(values["zodiacal_light"]),
        galaxy=bool(values["galaxy"]),
        drawn_mag=_drawn_mag(scene),
    )
    arriving = (
        beyond
        * skybrightness.diffuse_transmission(zenith_mag, air_mass(sine))
        * brightness_ratio(skybrightness.S10_MAG_ARCSEC2)
    )
    return skybrightness.sky_radiance(view, _without_space(values, lights, zenith_mag), state) + arriving


def _without_space(values: Values, lights: skybrightness.SkyLights, zenith_mag: float) -> skybrightness.SkyLights:
    """Return the lights with the dark sky less its usual zodiacal light and starlight, which are drawn by direction."""
    usual_s10 = skybrightness.ZODIACAL_IN_DARK_SKY_S10 if values["zodiacal_light"] else 0.0
    usual_s10 += skybrightness.STARLIGHT_IN_DARK_SKY_S10 if values["galaxy"] else 0.0
    usual = usual_s10 * float(
        skybrightness.diffuse_transmission(zenith_mag, 1.0) * brightness_ratio(skybrightness.S10_MAG_ARCSEC2)
    )
    whole = float(brightness_ratio(lights.zenith_mag_arcsec2))
    return replace(lights, zenith_mag_arcsec2=float(magnitude_difference(max(whole - usual, _LEAST_AIRGLOW * whole))))


def _drawn_mag(scene: Scene) -> float:
    """Return the magnitude down to which the scene has all stars."""
    faintest = float(scene.stars.vmag.max(initial=-np.inf))
    return min(faintest, _COMPLETE_MAG.get(scene.stars.catalogue, np.inf))


def _state(scene: Scene) -> skybrightness.SkyState:
    sun, moon = _sun_and_moon(scene)
    return skybrightness.SkyState(
        extinction=scene.extinction or Extinction(),
        height_m=scene.site.height_m,
        sun_altitude_rad=sun.altitude_rad,
        moon_altitude_rad=moon.apparent_altitude_rad,
        moon_phase_angle_rad=moon.phase_angle_rad,
    )


def _sun_and_moon(scene: Scene) -> tuple[Body, Body]:
    if scene.observing_sky is None:
        raise RenderError("the brightness of the sky needs a scene of a simulator, which knows where the Sun is")
    sun, moon = scene.observed_bodies(("Sun", "Moon"))
    return sun, moon


# Nodes beyond the limit of a lens have the solid angle at this part of the limit: nearer to it, it may be infinite.
_NEAR_LIMIT = 0.99


@lru_cache(maxsize=8)
def _solid_angle_arcsec2(camera: Camera, grid: tuple[int, int]) -> Float:
    """Return the solid angles of pixels at the texture's nodes, (rows, columns).

    Nodes where the lens shows nothing have about the solid angle of the nearest nodes: pixels between both are linear.
    """
    centres = skylight.node_positions(camera, grid)
    solid_angle = _solid_angle_at(camera, centres)
    unseen = np.isnan(solid_angle)
    if unseen.any():
        across = skylight.node_rays(camera, grid)[unseen][:, :2]
        across *= np.sin(_NEAR_LIMIT * camera.limit_rad) / np.linalg.norm(across, axis=1, keepdims=True)
        ahead = np.full(len(across), np.cos(_NEAR_LIMIT * camera.limit_rad))
        solid_angle[unseen] = _solid_angle_at(camera, camera.project(np.column_stack([across, ahead])))
    return np.nan_to_num(solid_angle) * _ARCSEC2_PER_SR


def _solid_angle_at(camera: Camera, centres_px: Float) -> Float:
    """Return the solid angles of pixels, (...) sr; NaN where the lens shows nothing within half a pixel."""

    def unit(offset_px: tuple[float, float]) -> Float:
        return camera.unit_vectors(centres_px + np.array(offset_px))

    along_x = unit((0.5, 0.0)) - unit((-0.5, 0.0))
    along_y = unit((0.0, 0.5)) - unit((0.0, -0.5))
    return np.asarray(np.linalg.norm(np.cross(along_x, along_y), axis=-1))


def _grid(scene: Scene) -> tuple[int, int]:
    """Return the columns and rows of the texture."""
    is_fine = has_flare(scene) or cloud_sheet(scene.sensor, scene.motion) is not None
    return skylight.FINE_GRID if is_fine else skylight.SMOOTH_GRID


def _texels(values: Values, scene: Scene) -> NDArray[np.float32]:
    """Return sky and ground, DN a pixel, the sine of the altitude above the horizon, and flare, (rows, columns, 4)."""
    grid = _grid(scene)
    rays = skylight.node_rays(scene.camera, grid)
    boresight = scene.shutter.boresight_eq
    still = boresight[0] @ boresight[2] > np.cos(_STILL_RAD)
    times = {1: 1.0} if still else dict(enumerate(_TIME_WEIGHTS))
    radiance = np.zeros(rays.shape[:2])
    ground = np.zeros(rays.shape[:2])
    for time, weight in times.items():
        direction = rays @ scene.shutter.C_camera_eq[time]
        sky, below = _sky_and_ground(values, scene, time, direction)
        radiance += weight * sky
        ground += weight * below
    if cloud_sheet(scene.sensor, scene.motion) is not None:
        radiance, ground = skylight.softened(radiance), skylight.softened(ground)
    flare = flare_at_nodes(scene) if has_flare(scene) else np.zeros_like(radiance)
    while scene.shutter.profile is not None and scene.camera.width_px > _RIDGE_PX * (grid[0] - 1):
        radiance, ground, flare = (skylight.with_halfway_nodes(nodes) for nodes in (radiance, ground, flare))
        grid = 2 * grid[0] - 1, 2 * grid[1] - 1
    sine = scene.above_horizon(skylight.node_rays(scene.camera, grid) @ scene.shutter.C_camera_eq[1])
    dn_of_mag_0 = float(scene.sensor.flux_of_magnitude_dn(0.0, scene.exposure.duration_s))
    per_pixel = dn_of_mag_0 * _solid_angle_arcsec2(scene.camera, grid)
    return np.stack([per_pixel * radiance, per_pixel * ground, sine, flare], axis=-1).astype(np.float32)


def _row_texels(values: Values, scene: Scene) -> NDArray[np.float32]:
    """Return sky and flare at the first columns of spans of pixels and of the next spans, DN, (rows, spans, 4)."""
    texels = _texels(values, scene)
    span_px = _span_px(scene)
    width_px = scene.camera.width_px
    first_px = np.arange(0.0, width_px, span_px)
    last_px = np.minimum(first_px + span_px, width_px - 0.5)
    ends = []
    for component in (0, 3):
        first, last = (_at_columns(texels[..., component], ends_px, width_px) for ends_px in (first_px, last_px))
        ends += [first, first + (last - first) * (span_px / (last_px - first_px))]
    return np.stack(ends, axis=-1).astype(np.float32)


def _at_columns(nodes: NDArray[np.float32], columns_px: Float, width_px: int) -> NDArray[np.float32]:
    """Return values at some columns of pixels, linear between columns of nodes, (rows, columns)."""
    at = (columns_px + 0.5) / width_px * (nodes.shape[1] - 1)
    left = np.minimum(at.astype(np.intp), nodes.shape[1] - 2)
    right_part = (at - left).astype(np.float32)
    return np.asarray((1 - right_part) * nodes[:, left] + right_part * nodes[:, left + 1])


def _sky_and_ground(values: Values, scene: Scene, time: int, direction_eq: Float) -> tuple[Float, Float]:
    """Return the brightness of sky and ground in some directions, with cloud in front of them."""
    ground = _ground_radiance(values, scene, time)
    crossing = crossing_at(scene, time, direction_eq)
    # The sky itself is smooth: every second node suffices.
    is_fine = direction_eq.shape[:2] == skylight.FINE_GRID[::-1]
    coarse = direction_eq[::2, ::2] if is_fine else direction_eq
    if crossing is None:
        sky = sky_radiance_at(values, scene, time, coarse)
        return skylight.with_halfway_nodes(sky) if is_fine else sky, np.full(direction_eq.shape[:-1], ground)
    without_towns = {**values, "town_mag_arcsec2": NO_TOWN_MAG}
    sky = sky_radiance_at(without_towns, scene, time, coarse)
    has_towns = float(values["town_mag_arcsec2"]) < NO_TOWN_MAG
    town = sky_radiance_at(values, scene, time, coarse) - sky if has_towns else np.zeros_like(sky)
    if is_fine:
        sky, town = skylight.with_halfway_nodes(sky), skylight.with_halfway_nodes(town)
    lights = _cloud_lights(without_towns, scene, time)
    if not is_below_cloud(scene):
        return sky + town, cloud_from_above(crossing, ground, lights)
    _, moon = _sun_and_moon(scene)
    clouded = cloud_from_below(crossing, direction_eq @ moon.direction_eq, sky, town, lights)
    # The ground is lit by what the cloud leaves.
    return clouded, np.full(direction_eq.shape[:-1], ground)


def _cloud_lights(values: Values, scene: Scene, time: int) -> CloudLights:
    """Return what lights the cloud: the Moon, if it is to light the air, and the mean sky at 30 deg."""
    _, moon = _sun_and_moon(scene)
    sine_moon = float(np.sin(moon.apparent_altitude_rad))
    extinction = scene.extinction or Extinction()
    mag = moon.vmag + extinction.zenith_mag(scene.site.height_m) * float(air_mass(sine_moon))
    mean_sky = float(sky_radiance_at(values, scene, time, _ring(scene.shutter.zenith_eq[time], 0.5)).mean())
    return CloudLights(10 ** (-0.4 * mag) if values["moonlight"] else 0.0, sine_moon, mean_sky)


def _ground_radiance(values: Values, scene: Scene, time: int) -> float:
    zenith = scene.shutter.zenith_eq[time]
    horizon = _ring(zenith, 0.0)
    return float(values["ground_fraction"]) * float(sky_radiance_at(values, scene, time, horizon).mean())


def _ring(zenith: Float, sine: float) -> Float:
    """Return directions all around at an altitude."""
    level = np.cross(zenith, [0.0, 0.0, 1.0] if abs(zenith[2]) < 0.9 else [1.0, 0.0, 0.0])
    level /= np.linalg.norm(level)
    angle = 2 * np.pi * np.arange(_AZIMUTHS)[:, np.newaxis] / _AZIMUTHS
    horizon = np.cos(angle) * level + np.sin(angle) * np.cross(zenith, level)
    return np.asarray(horizon if sine == 0 else np.sqrt(1 - sine * sine) * horizon + sine * zenith)


def _radiance_on_axis(values: Values, scene: Scene) -> float:
    """Return the brightness of the sky, or of the ground, on the optical axis in the middle of the exposure."""
    boresight = scene.shutter.boresight_eq[1]
    sky, ground = _sky_and_ground(values, scene, 1, boresight[np.newaxis])
    return float((ground if scene.above_horizon(boresight) < 0 else sky)[0])


def natural_sky_dn(scene: Scene) -> float:
    """Return the signal of the natural sky in a pixel on the optical axis, in the middle of the exposure, DN.

    It is 0 without ``[sky] brightness = "natural"``.
    """
    if not skylight.has_natural_sky(scene.sensor):
        return 0.0
    values = NATURAL_SKY.values(scene.sensor)
    solid_angle_arcsec2 = _ARCSEC2_PER_SR / (scene.camera.fx_px * scene.camera.fy_px)
    mag_0_dn = float(scene.sensor.flux_of_magnitude_dn(0.0, scene.exposure.duration_s))
    return mag_0_dn * solid_angle_arcsec2 * _radiance_on_axis(values, scene)


def _depends_on(values: Values, scene: Scene) -> Hashable:
    return (
        *values.items(),
        *skylight.lighting_of(scene),
        scene.exposure.duration_s,
        _drawn_mag(scene) if values["galaxy"] else None,
        float(scene.sensor.flux_of_magnitude_dn(0.0, 1.0)),
        tuple(FLARE.values(scene.sensor).items()),
    )


def _options(_values: Values, scene: Scene) -> Mapping[str, int]:
    by_quads = _grid(scene) == skylight.FINE_GRID and skylight.interpolates_by_quads(scene.camera, skylight.FINE_GRID)
    return {"SKY_BY_QUADS": int(by_quads), "SKY_SPAN_PX": _span_px(scene)}


def _span_px(scene: Scene) -> int:
    """Return the width of the spans of pixels between two values of the texture of rows, or 0 with ground in view."""
    if _grid(scene) != skylight.FINE_GRID or scene.shutter.profile is not None:
        return 0
    lowest = (
        skylight.node_rays(scene.camera, skylight.FINE_GRID)
        @ (scene.shutter.C_camera_eq[1] @ scene.shutter.zenith_eq[1])
    ).min()
    if lowest <= scene.sine_horizon:
        return 0
    return (
        4
        if skylight.interpolates_by_quads(scene.camera, skylight.FINE_GRID)
        else 16
        if scene.sensor.bit_depth <= 8
        else 8
    )


def _truth(values: Values, scene: Scene) -> Mapping[str, Any]:
    boresight = scene.shutter.boresight_eq[1]
    sun, moon = _sun_and_moon(scene)
    return {
        "sky_mag_arcsec2": round(float(-2.5 * np.log10(_radiance_on_axis(values, scene))), 4),
        "sun_altitude_deg": round(float(np.rad2deg(sun.altitude_rad)), 4),
        "moon_altitude_deg": round(float(np.rad2deg(moon.apparent_altitude_rad)), 4),
        "moon_separation_deg": round(float(np.rad2deg(erfa.sepp(boresight, moon.direction_eq))), 4),
        "moon_illuminated_fraction": round(moon.illuminated_fraction, 4),
    }


NATURAL_SKY = Effect(
    name="natural_sky",
    section="sky",
    keys=(
        skylight.SKY_BRIGHTNESS,
        Key(
            "zenith_mag_arcsec2",
            _DEFAULT.zenith_mag_arcsec2,
            "a magnitude per square arcsecond from 0 to 30",
            Control("Dark sky", 16.0, 23.0, "V %.2f"),
            minimum=0.0,
            maximum=30.0,
        ),
        Key("moonlight", True, "true or false", Control("Moonlight")),
        Key("twilight", True, "true or false", Control("Twilight")),
        Key("zodiacal_light", False, "true or false", Control("Zodiacal light")),
        Key("galaxy", False, "true or false", Control("Galaxy")),
        Key(
            "town_mag_arcsec2",
            _DEFAULT.town_mag_arcsec2,
            "a magnitude per square arcsecond from 0 to 30; 30 is no town",
            Control("Town glow", 16.0, 30.0, "V %.2f"),
            minimum=0.0,
            maximum=30.0,
        ),
        Key("town_azimuth_deg", -1.0, "an azimuth in degrees up to 360; negative for towns all around", maximum=360.0),
        Key(
            "ground_fraction",
            _DEFAULT.ground_fraction,
            "a number, 0 or more: the ground's brightness over that of the sky at the horizon",
            minimum=0.0,
        ),
    ),
    stage=Stage.SKY_RADIANCE,
    textures=(
        EffectTexture("sky_signal", _texels, _depends_on),
        EffectTexture("sky_of_spans", _row_texels, _depends_on),
    ),
    truth=_truth,
    is_active=lambda values: values["brightness"] == "natural",
    options=_options,
    glsl="""\
#if SKY_SPAN_PX
// Sky and flare, DN a pixel, at the first column of a span of pixels and at that of the next one: one fetch.
uniform sampler2D sky_of_spans;

float span_of(uvec2 quad) {
    if (float(SKY_SPAN_PX) < SPAN_PX)
        return float(quad.x / uint(SKY_SPAN_PX / 4));
    return floor(floor(fragment.x) * (SPAN_PX / float(SKY_SPAN_PX)));
}

vec4 sky_span(uvec2 quad) {
    vec2 size = vec2(textureSize(sky_of_spans, 0));
    float row = (floor(fragment.y) + 0.5) / image_px.y * (size.y - 1.0);
    return textureLod(sky_of_spans, (vec2(span_of(quad), row) + 0.5) / size, 0.0);
}

vec4 in_span(uvec2 quad, vec2 ends_dn) {
    return mix(ends_dn.xxxx, ends_dn.yyyy, columns_px(quad) / float(SKY_SPAN_PX) - span_of(quad));
}

vec4 natural_sky(vec4 signal_dn, uvec2 quad) {
    return signal_dn + in_span(quad, sky_span(quad).xy);
}
#else
// Sky and ground, DN a pixel, the sine of the altitude above the horizon, and flare, DN a pixel.
uniform sampler2D sky_signal;

vec4 sky_at(uvec2 quad, bool last) {
    return textureLod(sky_signal, node_of(textureSize(sky_signal, 0), quad, bool(SKY_BY_QUADS), last), 0.0);
}

vec4 natural_sky(vec4 signal_dn, uvec2 quad) {
    vec4 first = sky_at(quad, false), last = sky_at(quad, true);
    vec4 sky = between_nodes(quad, bool(SKY_BY_QUADS), first.x, last.x);
    vec4 ground = between_nodes(quad, bool(SKY_BY_QUADS), first.y, last.y);
    vec4 above = between_nodes(quad, bool(SKY_BY_QUADS), first.z, last.z);
    return signal_dn + mix(ground, sky, step(0.0, above));
}
#endif
""",
)
