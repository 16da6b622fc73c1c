"""The background of the sky: one level in DN, one in electrons, or a measured map of its brightness over the image.

A map has gradients, vignetting and glow in place of one level.  The light of a sky whose brightness depends on
direction, and stray light of the lens, is computed at nodes over the image, and is linear between them.
"""

from collections.abc import Hashable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.sensor.pixelpattern import read_map, resampled
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.render.effects.effect import Control, Effect, EffectTexture, Key, Stage, Values, quads_of
from glstar.render.scene.clouds import cloud_sheet
from glstar.render.scene.scene import Scene

SKY_MAP_KEY = Key("sky_map", "", "the path of an image: PNG, TIFF, FITS or NPY")
SKY_BRIGHTNESS: Key = Key(
    "brightness", "flat", '"flat" or "natural"', Control("Sky brightness"), choices=("flat", "natural")
)
# Columns and rows for the smooth sky: at most 1.5 % off beyond 3 deg of the Moon.
SMOOTH_GRID = (97, 73)
# For edges of cloud and for flare: every second node is one of the smooth sky.
FINE_GRID = (193, 145)
# Pixels of a fragment of the develop pass, at most: develop.frag.
_SPAN_PX = 16.0


def relative_sky(file: str) -> NDArray[np.float32]:
    """Return the brightness of the sky over its mean, (rows, columns) float32, row 0 the top.

    `file`: a map of any size that covers the image.  Raises ConfigError if it cannot be read, is negative anywhere, or
    is 0 everywhere.
    """
    try:
        level = read_map(file).astype(np.float64)
    except ConfigError as error:
        raise ConfigError(f"cannot be used: {error}", key="sensor.sky_map") from error
    if level.min() < 0 or level.mean() <= 0:
        raise ConfigError(
            f"cannot be used: {file} holds numbers from {level.min():g} to {level.max():g}; a sky is 0 or brighter"
            " everywhere, and brighter than 0 somewhere",
            key="sensor.sky_map",
        )
    return np.asarray(level / level.mean(), dtype=np.float32)


def uniform_sky_dn(scene: Scene) -> float:
    """Return the mean signal of the sky of a scene in a pixel on the optical axis, in both noise models."""
    model = scene.sensor.electrons
    return scene.sensor.sky_mean_dn if model is None else model.dn_per_e * model.sky_e_per_s * scene.exposure.duration_s


def _map_texels(values: Values, scene: Scene) -> NDArray[np.float32]:
    # Resampled here: the filter of a GPU divides the distance between texels into 256 steps, which are visible.
    return quads_of(resampled(relative_sky(str(values["sky_map"])), scene.camera.width_px, scene.camera.height_px))


def _map_depends_on(values: Values, scene: Scene) -> Hashable:
    return values["sky_map"], scene.camera.width_px, scene.camera.height_px


def _map_truth(values: Values, _scene: Scene) -> Mapping[str, Any]:
    return {"sky_map": values["sky_map"]}


# In place of the uniform sky of both noise models.  It was measured behind the lens, so it has the lens's vignetting.
SKY_MAP = Effect(
    name="sky_map",
    section="sensor",
    keys=(SKY_MAP_KEY,),
    stage=Stage.SKY,
    uniforms=lambda _values, scene: {"sky_map_dn": uniform_sky_dn(scene)},
    textures=(EffectTexture("relative_sky", _map_texels, _map_depends_on),),
    truth=_map_truth,
    is_active=lambda values: bool(values["sky_map"]),
    glsl="""\
uniform sampler2D relative_sky;
uniform float sky_map_dn;

vec4 sky_map(vec4 signal_dn, uvec2 quad) {
    return signal_dn + sky_map_dn * texelFetch(relative_sky, ivec2(quad), 0);
}
""",
)


SKY_LEVEL = Effect(
    name="sky_level",
    section="sensor",
    keys=(
        Key(
            "sky_mean_dn",
            Sensor().sky_mean_dn,
            "a number of DN, 0 or more",
            Control("Sky", 0.0, 4096.0, "%.1f DN", logarithmic=True),
            minimum=0.0,
            scales=True,
        ),
    ),
    stage=Stage.SKY,
    noise_model="paper",
    reads=(SKY_MAP_KEY,),
    is_active=lambda values: not values["sky_map"],
    glsl="""\
// Mean of Teague & Chahl eq. (40), added once to the sum of all starlight.
uniform float sky_mean_dn;

vec4 sky_level(vec4 signal_dn, uvec2 quad) {
    return signal_dn + sky_mean_dn;
}
""",
)


# Its key, sensor.sky_e_per_s, may be left out of a config and has no default of its own: see SensorSection.
UNIFORM_SKY = Effect(
    name="uniform_sky",
    section="sensor",
    keys=(),
    stage=Stage.SKY_RADIANCE,
    noise_model="electrons",
    uniforms=lambda _values, scene: {"uniform_sky_dn": uniform_sky_dn(scene)},
    reads=(SKY_MAP_KEY,),
    is_active=lambda values: not values["sky_map"],
    glsl="""\
uniform float uniform_sky_dn;

vec4 uniform_sky(vec4 signal_dn, uvec2 quad) {
    return signal_dn + uniform_sky_dn;
}
""",
)


def has_natural_sky(sensor: Sensor) -> bool:
    """Return whether the brightness of a sensor's sky depends on direction."""
    return sensor.effects.get("sky.brightness", SKY_BRIGHTNESS.default) == "natural"


def lighting_of(scene: Scene) -> tuple[Hashable, ...]:
    """Return what the light of the sky and of the lens of a scene depends on, besides the keys of effects."""
    return (
        cloud_sheet(scene.sensor, scene.motion),
        scene.exposure.mid_utc_s,
        scene.site,
        scene.camera,
        scene.shutter.C_camera_eq.tobytes(),
        scene.extinction,
        scene.sine_horizon,
        scene.shutter.profile,
    )


def interpolates_by_quads(camera: Camera, grid: tuple[int, int]) -> bool:
    """Return whether nodes are closer to each other than the pixels of a fragment: each quad then reads its own."""
    return camera.width_px / (grid[0] - 1) < _SPAN_PX


@lru_cache(maxsize=8)
def node_positions(camera: Camera, grid: tuple[int, int]) -> Float:
    """Return the positions of columns and rows of nodes from edge to edge of the image, (rows, columns, 2) px."""
    columns, rows = grid
    x = np.linspace(-0.5, camera.width_px - 0.5, columns)
    y = np.linspace(-0.5, camera.height_px - 0.5, rows)
    return np.stack(np.meshgrid(x, y), axis=-1)


@lru_cache(maxsize=8)
def beyond_lens(camera: Camera) -> NDArray[np.bool_] | None:
    """Return at which pixels the lens shows nothing, (height, width): those that no direction reaches; None if none.

    A lens shows all within a limit, so that an image whose border it shows has no such pixel.
    """
    if camera.lens is None:
        return None
    columns, rows = np.arange(camera.width_px), np.arange(camera.height_px)
    lines = [(columns, rows[:1]), (columns, rows[-1:]), (columns[:1], rows), (columns[-1:], rows)]
    if not any(_is_unseen(camera, *line).any() for line in lines):
        return None
    return np.stack([_is_unseen(camera, columns, row) for row in rows])


def _is_unseen(camera: Camera, columns: NDArray[np.intp], rows: NDArray[np.intp] | np.intp) -> NDArray[np.bool_]:
    return np.isnan(camera.unit_vectors(np.stack(np.broadcast_arrays(columns, rows), axis=-1))[:, 0])


@lru_cache(maxsize=8)
def node_rays(camera: Camera, grid: tuple[int, int]) -> Float:
    """Return the directions of columns and rows of nodes, (rows, columns, 3) unit vectors in the camera frame.

    Nodes beyond the limit of a lens, where a pixel sees nothing, have directions along it.
    """
    positions = node_positions(camera, grid)
    rays = camera.unit_vectors(positions)
    beyond = np.isnan(rays[..., 0])
    if beyond.any():
        x, y = camera.normalized(positions[beyond]).T
        around_rad, limit_rad = np.arctan2(y, x), np.full_like(x, camera.limit_rad)
        across = np.sin(limit_rad) * [np.cos(around_rad), np.sin(around_rad)]
        rays[beyond] = np.column_stack([*across, np.cos(limit_rad)])
    return rays


def with_halfway_nodes(nodes: Float) -> Float:
    """Return values at nodes, (r, c), and their means halfway between them, (2 r - 1, 2 c - 1)."""
    for axis in (0, 1):
        nodes = np.moveaxis(nodes, axis, 0)
        finer = np.empty((2 * len(nodes) - 1, *nodes.shape[1:]))
        finer[::2], finer[1::2] = nodes, (nodes[1:] + nodes[:-1]) / 2
        nodes = np.moveaxis(finer, 0, axis)
    return nodes


def softened(nodes: Float) -> Float:
    """Return values at nodes, (r, c), blurred so that edges do not show the grid, (r, c).

    Each is the mean with its neighbours, weighted 1 : 2 : 1 along both axes; the sum stays except for the border.
    """
    for axis in (0, 1):
        nodes = np.moveaxis(nodes, axis, 0)
        wider = np.concatenate([nodes[:1], nodes, nodes[-1:]])
        nodes = np.moveaxis((wider[:-2] + 2 * nodes + wider[2:]) / 4, 0, axis)
    return nodes
