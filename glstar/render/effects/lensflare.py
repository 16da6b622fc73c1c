"""Flare of the Sun, the Moon, bright planets and a lamp: light scattered in the lens, its ghosts, and a streak."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.vignetting import px2_per_sr
from glstar.render.effects import sky as skylight
from glstar.render.effects.cloud import transmission_towards
from glstar.render.effects.effect import Control, Effect, EffectTexture, Key, Stage, Values
from glstar.render.scene.clouds import horizontal_axes
from glstar.render.scene.scene import Scene
from glstar.sky.photometry import brightness_ratio

_SOURCES = ("Sun", "Moon", "Venus", "Jupiter")
# A lamp of this magnitude is none.
_NO_LAMP_MAG = 30.0
# Sources whose whole light is less than this per pixel of the image are left out, DN.
_FAINTEST_DN = 1e-3
# Ghosts of a source that is farther from the middle than this, in half diagonals of the image, do not reach the sensor.
_GHOST_REACH = 1.5
# Width of the soft edge of a ghost, over its radius.
_GHOST_EDGE = 0.15
# Half width at half maximum of a streak across its direction and along it, over the height of the image.
_STREAK_ACROSS = 0.012
_STREAK_ALONG = 0.15
# Farther across than this, in standard deviations, it has less than 1e-14 of its light.
_STREAK_REACH = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """A source of flare."""

    direction: Float  # (3,) unit vector, camera frame
    flux_dn: float


def _is_active(values: Values) -> bool:
    return any(float(values[key]) > 0 for key in ("scatter", "ghost_fraction", "streak_fraction"))


def flare_dn(scene: Scene, xy_px: Float) -> Float:
    """Return the flare at pixels, (..., 2), in the middle of the exposure, (...) DN a pixel above the sky."""
    if not _is_active(FLARE.values(scene.sensor)):
        return np.zeros(xy_px.shape[:-1])
    return _flare_dn(scene, xy_px, scene.camera.unit_vectors(xy_px))


def _flare_dn(scene: Scene, xy_px: Float, rays: Float) -> Float:
    """Return the flare at pixels and their directions, (...) DN."""
    values = FLARE.values(scene.sensor)
    camera = scene.camera
    flare = np.zeros(xy_px.shape[:-1])
    pixel_sr = _projected_solid_angles_sr(camera, rays)
    for source in _sources(values, scene):
        cosine = float(source.direction[2])
        if cosine <= np.cos(np.deg2rad(float(values["hood_deg"]))) or cosine <= 0:
            continue
        # The aperture is seen obliquely.
        entering_dn = source.flux_dn * cosine
        if entering_dn < _FAINTEST_DN * camera.width_px * camera.height_px:
            continue
        scattered = _scattered(values, np.nan_to_num(rays @ source.direction))
        flare += entering_dn * float(values["scatter"]) * scattered * pixel_sr
        flare += entering_dn * _ghosts(values, camera, source.direction, xy_px)
        flare += entering_dn * _streak(values, camera, source.direction, xy_px)
    return flare


def _projected_solid_angles_sr(camera: Camera, rays: Float) -> Float:
    """Return the solid angles of pixels in some directions, (...), times the cosines of these."""
    if camera.lens is None:
        return np.asarray(rays[..., 2] ** 4 / (camera.fx_px * camera.fy_px))
    return np.asarray(np.nan_to_num(np.maximum(rays[..., 2], 0.0) / np.maximum(px2_per_sr(camera, rays), 1.0)))


def _sources(values: Values, scene: Scene) -> list[_Source]:
    """Return the bodies above the horizon, and the lamp."""
    sources: list[_Source] = []
    mag_0_dn = float(scene.sensor.flux_of_magnitude_dn(0.0, scene.exposure.duration_s))
    bodies = scene.observed_bodies(_SOURCES)
    directions_eq = np.array([body.direction_eq for body in bodies]).reshape(-1, 3)
    in_camera = scene.shutter[1:2].to_camera(directions_eq)[0]
    passed = transmission_towards(scene, directions_eq)
    for k, body in enumerate(bodies):
        if np.isnan(in_camera[k]).any():
            continue
        extinction = scene.extinction_mag(np.sin(body.apparent_altitude_rad))
        mag = body.vmag + (0.0 if extinction is None else float(extinction))
        flux_dn = mag_0_dn * float(brightness_ratio(mag)) * float(passed[k])
        sources.append(_Source(in_camera[k] / np.linalg.norm(in_camera[k]), flux_dn))
    lamp_mag = float(values["lamp_mag"])
    if lamp_mag < _NO_LAMP_MAG:
        azimuth, altitude = (np.deg2rad(float(values[f"lamp_{name}_deg"])) for name in ("azimuth", "altitude"))
        zenith = scene.shutter.zenith_eq[1]
        east, north = horizontal_axes(zenith)
        level = np.sin(azimuth) * east + np.cos(azimuth) * north
        direction = scene.shutter.C_camera_eq[1] @ (np.cos(altitude) * level + np.sin(altitude) * zenith)
        sources.append(_Source(direction, mag_0_dn * float(brightness_ratio(lamp_mag))))
    return sources


def _scattered(values: Values, cosine: Float) -> Float:
    """Return the scattered light per projected solid angle, 1 over the hemisphere: Harvey and Shack, slope -2."""
    shoulder = np.sin(np.deg2rad(float(values["scatter_deg"])))
    sine2 = np.where(cosine > 0, 1 - cosine * cosine, 1.0)
    return np.asarray(1 / (np.pi * shoulder**2 * np.log1p(shoulder**-2) * (1 + sine2 / shoulder**2)))


def _source_px(camera: Camera, direction: Float) -> Float:
    """Return where a source is on the plane of the image, px; NaN beyond the limit of the lens."""
    return np.asarray(camera.project(direction[np.newaxis])[0])


def _ghosts(values: Values, camera: Camera, direction: Float, xy_px: Float) -> Float:
    """Return the light of the ghosts of a source, per pixel: soft discs on the line through source and axis."""
    fraction = float(values["ghost_fraction"])
    axis_px = np.array([camera.cx_px, camera.cy_px])
    offset_px = _source_px(camera, direction) - axis_px
    light = np.zeros(xy_px.shape[:-1])
    half_diagonal_px = np.hypot(camera.width_px, camera.height_px) / 2
    if fraction == 0 or not np.linalg.norm(offset_px) < _GHOST_REACH * half_diagonal_px:
        return light
    chance = np.random.default_rng(int(values["ghost_seed"]))
    for _ in range(int(values["ghosts"])):
        place, size = chance.uniform(-1.2, 0.8), chance.uniform(0.3, 1.0)
        radius_px = size * float(values["ghost_size"]) * camera.height_px / 2
        x, y = axis_px + place * offset_px
        square = (xy_px[..., 0] - x) ** 2 + (xy_px[..., 1] - y) ** 2
        near = square < ((1 + _GHOST_EDGE / 2) * radius_px) ** 2
        distance = np.sqrt(square[near]) / radius_px
        # A disc whose edge is a straight line has the flux pi r^2 (1 + edge^2 / 12).
        disc = np.clip((1 - distance) / _GHOST_EDGE + 0.5, 0.0, 1.0)
        light[near] += fraction * disc / (np.pi * radius_px**2 * (1 + _GHOST_EDGE**2 / 12))
    return light


def _streak(values: Values, camera: Camera, direction: Float, xy_px: Float) -> Float:
    """Return the light of the streak through a source, per pixel: Lorentzian along it, Gaussian across."""
    fraction = float(values["streak_fraction"])
    angle = np.deg2rad(float(values["streak_deg"]))
    if fraction == 0:
        return np.zeros(xy_px.shape[:-1])
    x_px, y_px = _source_px(camera, direction)
    x, y = xy_px[..., 0] - x_px, xy_px[..., 1] - y_px
    sigma_px = _STREAK_ACROSS * camera.height_px / np.sqrt(2 * np.log(2))
    across = (y * np.cos(angle) - x * np.sin(angle)) / sigma_px
    near = np.abs(across) < _STREAK_REACH
    along = (x[near] * np.cos(angle) + y[near] * np.sin(angle)) / (_STREAK_ALONG * camera.height_px)
    lorentzian = 1 / (np.pi * _STREAK_ALONG * camera.height_px * (1 + along * along))
    light = np.zeros(across.shape)
    light[near] = fraction * lorentzian * np.exp(-0.5 * across[near] ** 2) / (np.sqrt(2 * np.pi) * sigma_px)
    return light


def flare_at_nodes(scene: Scene, *, step: int = 1) -> Float:
    """Return the flare at every `step`-th node of `FINE_GRID`, (rows, columns) DN a pixel above the sky.

    It is the flare in the middle of the exposure.
    """
    positions_px = skylight.node_positions(scene.camera, skylight.FINE_GRID)
    rays = skylight.node_rays(scene.camera, skylight.FINE_GRID)
    return _flare_dn(scene, positions_px[::step, ::step], rays[::step, ::step])


def has_flare(scene: Scene) -> bool:
    """Return whether the lens of a scene flares."""
    return _is_active(FLARE.values(scene.sensor))


def _texels(_values: Values, scene: Scene) -> NDArray[np.float32]:
    flare = flare_at_nodes(scene)
    # Four components: software OpenGL is slow with one that is not its own.
    return np.stack([flare, *([np.zeros_like(flare)] * 3)], axis=-1).astype(np.float32)


def _depends_on(values: Values, scene: Scene) -> Hashable:
    return (
        *values.items(),
        *skylight.lighting_of(scene),
        float(scene.sensor.flux_of_magnitude_dn(0.0, scene.exposure.duration_s)),
    )


def _options(_values: Values, scene: Scene) -> Mapping[str, int]:
    return {
        "FLARE_WITH_SKY": int(skylight.has_natural_sky(scene.sensor)),
        "FLARE_BY_QUADS": int(skylight.interpolates_by_quads(scene.camera, skylight.FINE_GRID)),
    }


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    flare = flare_at_nodes(scene, step=4)
    return {"flare_mean_dn": round(float(flare.mean()), 6), "flare_max_dn": round(float(flare.max()), 6)}


FLARE = Effect(
    name="flare",
    section="flare",
    keys=(
        Key(
            "scatter",
            0.0,
            "a fraction of the light from 0 to 0.5; 0 is none",
            Control("Scattered light", 0.0, 0.05, "%.4f"),
            minimum=0.0,
            maximum=0.5,
        ),
        Key("scatter_deg", 0.5, "an angle from 0.01 to 45 deg", minimum=0.01, maximum=45.0),
        Key("hood_deg", 90.0, "an angle from 1 to 90 deg", minimum=1.0, maximum=90.0),
        Key(
            "ghost_fraction",
            0.0,
            "a fraction of the light from 0 to 0.1; 0 is none",
            Control("Ghosts", 0.0, 0.002, "%.5f"),
            minimum=0.0,
            maximum=0.1,
        ),
        Key("ghosts", 4, "a whole number from 1 to 20", minimum=1, maximum=20),
        Key("ghost_size", 0.15, "a part of the image's height from 0.01 to 2", minimum=0.01, maximum=2.0),
        Key("ghost_seed", 0, "a whole number, 0 or more", minimum=0),
        Key(
            "streak_fraction",
            0.0,
            "a fraction of the light from 0 to 0.1; 0 is none",
            Control("Streak", 0.0, 0.005, "%.5f"),
            minimum=0.0,
            maximum=0.1,
        ),
        Key("streak_deg", 0.0, "an angle in degrees"),
        Key("lamp_mag", _NO_LAMP_MAG, "a magnitude from -30 to 30; 30 is no lamp", minimum=-30.0, maximum=30.0),
        Key("lamp_azimuth_deg", 0.0, "an azimuth in degrees"),
        Key("lamp_altitude_deg", 0.0, "an altitude from -90 to 90 deg", minimum=-90.0, maximum=90.0),
    ),
    stage=Stage.SKY,
    uniforms=lambda _values, _scene: {},
    textures=(EffectTexture("flare_signal", _texels, _depends_on),),
    truth=_truth,
    is_active=_is_active,
    options=_options,
    glsl="""\
#if FLARE_WITH_SKY && SKY_SPAN_PX
// Of the texture of the natural sky, which is read for the sky.
vec4 flare(vec4 signal_dn, uvec2 quad) {
    return signal_dn + in_span(quad, sky_span(quad).zw);
}
#elif FLARE_WITH_SKY
vec4 flare(vec4 signal_dn, uvec2 quad) {
    return signal_dn + between_nodes(quad, bool(SKY_BY_QUADS), sky_at(quad, false).a, sky_at(quad, true).a);
}
#else
// Flare, DN a pixel, at nodes from edge to edge of the image.
uniform sampler2D flare_signal;

float flare_at(uvec2 quad, bool last) {
    return textureLod(flare_signal, node_of(textureSize(flare_signal, 0), quad, bool(FLARE_BY_QUADS), last), 0.0).r;
}

vec4 flare(vec4 signal_dn, uvec2 quad) {
    return signal_dn + between_nodes(quad, bool(FLARE_BY_QUADS), flare_at(quad, false), flare_at(quad, true));
}
#endif
""",
)
