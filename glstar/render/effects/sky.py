"""The background level of the sky.

The uniform sky of the electron model.

A measured map of the sky's brightness over the image: gradients, vignetting and glow in place of one level.
"""

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.camera.sensor.pixelpattern import read_map, resampled
from glstar.camera.sensor.sensor import Sensor
from glstar.errors import ConfigError
from glstar.render.effects.effect import Control, Effect, EffectTexture, Key, Stage, UniformValue, Values, quads_of
from glstar.render.scene.scene import Scene

SKY_MAP_KEY = Key("sky_map", default="", allowed="the path of an image: PNG, TIFF, FITS or NPY")


def relative_sky(file: str) -> NDArray[np.float32]:
    """Return the brightness of the sky over its mean.

    `file`: a map of any size that covers the image.  Returns (rows, columns) float32: of mean 1; row 0 is the top.
    Raises ConfigError if it cannot be read, or is not brighter than 0 on the mean.
    """
    try:
        level = read_map(file).astype(np.float64)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be used: {file}: {error}", key="sensor.sky_map") from error
    if level.min() < 0 or level.mean() <= 0:
        raise ConfigError(
            f"cannot be used: {file} holds numbers from {level.min():g} to {level.max():g}; a sky is 0 or brighter"
            " everywhere, and brighter than 0 somewhere",
            key="sensor.sky_map",
        )
    return np.asarray(level / level.mean(), dtype=np.float32)


def _mean_of_map(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    sensor = scene.sensor
    if sensor.electrons is None:
        return {"sky_map_dn": sensor.sky_mean_dn}
    return {"sky_map_dn": sensor.electrons.dn_per_e * sensor.electrons.sky_e_per_s * scene.exposure.duration_s}


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
    uniforms=_mean_of_map,
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
            default=Sensor().sky_mean_dn,
            allowed="a number of DN, 0 or more",
            minimum=0.0,
            control=Control("Sky", 0.0, 4096.0, "%.1f DN", logarithmic=True),
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


def _uniform_sky_level(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"uniform_sky_dn": model.dn_per_e * model.sky_e_per_s * scene.exposure.duration_s}


# Its key, sensor.sky_e_per_s, may be left out of a config and has no default of its own: see SensorSection.
UNIFORM_SKY = Effect(
    name="uniform_sky",
    section="sensor",
    keys=(),
    stage=Stage.SKY_RADIANCE,
    noise_model="electrons",
    uniforms=_uniform_sky_level,
    reads=(SKY_MAP_KEY,),
    is_active=lambda values: not values["sky_map"],
    glsl="""\
uniform float uniform_sky_dn;

vec4 uniform_sky(vec4 signal_dn, uvec2 quad) {
    return signal_dn + uniform_sky_dn;
}
""",
)
