"""The uniform sky of the electron model."""

from collections.abc import Mapping

from glstar.render.effects.effect import Effect, Stage, UniformValue, Values
from glstar.render.effects.skymap import SKY_MAP_KEY
from glstar.render.scene import Scene

__all__ = ["UNIFORM_SKY"]


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
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
    uniforms=_uniforms,
    reads=(SKY_MAP_KEY,),
    is_active=lambda values: not values["sky_map"],
    glsl="""\
uniform float uniform_sky_dn;

vec4 uniform_sky(vec4 signal_dn, uvec2 quad) {
    return signal_dn + uniform_sky_dn;
}
""",
)
