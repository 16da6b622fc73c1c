"""The black level: what the converter adds so that noise below zero is not cut off."""

from collections.abc import Mapping

from glstar.camera.electrons import ElectronModel
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["BLACK_LEVEL"]


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"black_level_dn": model.black_level_dn}


BLACK_LEVEL = Effect(
    name="black_level",
    section="sensor",
    keys=(
        Key(
            "black_level_dn",
            default=ElectronModel().black_level_dn,
            allowed="a number of DN, 0 or more",
            minimum=0.0,
            control=Control("Black level", 0.0, 4096.0, "%.1f DN", logarithmic=True),
        ),
    ),
    stage=Stage.QUANTISATION,
    noise_model="electrons",
    uniforms=_uniforms,
    glsl="""\
uniform float black_level_dn;

vec4 black_level(vec4 signal_dn, uvec2 quad) {
    return signal_dn + black_level_dn;
}
""",
)
