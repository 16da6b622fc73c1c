"""A measured map of the sky's brightness over the image: gradients, vignetting and glow in place of one level."""

from collections.abc import Hashable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.camera.pixelpattern import read_map, resampled
from glstar.errors import ConfigError
from glstar.render.effects.effect import Effect, EffectTexture, Key, Stage, UniformValue, Values, quads_of
from glstar.render.scene import Scene

__all__ = ["SKY_MAP", "SKY_MAP_KEY", "relative_sky"]

SKY_MAP_KEY = Key("sky_map", default="", allowed="the path of an image: PNG, TIFF, FITS or NPY")


def relative_sky(file: str) -> NDArray[np.float32]:
    """Return the brightness of the sky over its mean.

    Parameters
    ----------
    file : str
        A map of any size that covers the image.

    Returns
    -------
    (rows, columns) float32
        Of mean 1; row 0 is the top.

    Raises
    ------
    ConfigError
        If it cannot be read, or is not brighter than 0 on the mean.
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


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    sensor = scene.sensor
    if sensor.electrons is None:
        return {"sky_map_dn": sensor.sky_mean_dn}
    return {"sky_map_dn": sensor.electrons.dn_per_e * sensor.electrons.sky_e_per_s * scene.exposure.duration_s}


def _texels(values: Values, scene: Scene) -> NDArray[np.float32]:
    # Resampled here: the filter of a GPU divides the distance between texels into 256 steps, which are visible.
    return quads_of(resampled(relative_sky(str(values["sky_map"])), scene.camera.width_px, scene.camera.height_px))


def _depends_on(values: Values, scene: Scene) -> Hashable:
    return values["sky_map"], scene.camera.width_px, scene.camera.height_px


def _truth(values: Values, _scene: Scene) -> Mapping[str, Any]:
    return {"sky_map": values["sky_map"]}


# In place of the uniform sky of both noise models.  It was measured behind the lens, so it has the lens's vignetting.
SKY_MAP = Effect(
    name="sky_map",
    section="sensor",
    keys=(SKY_MAP_KEY,),
    stage=Stage.SKY,
    uniforms=_uniforms,
    textures=(EffectTexture("relative_sky", _texels, _depends_on),),
    truth=_truth,
    is_active=lambda values: bool(values["sky_map"]),
    glsl="""\
uniform sampler2D relative_sky;
uniform float sky_map_dn;

vec4 sky_map(vec4 signal_dn, uvec2 quad) {
    return signal_dn + sky_map_dn * texelFetch(relative_sky, ivec2(quad), 0);
}
""",
)
