"""Saturation and rounding of the analogue-digital converter."""

from collections.abc import Mapping

from glstar.camera.sensor import Sensor
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["QUANTISATION"]


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    return {"saturation_dn": float(scene.sensor.saturation_dn)}


QUANTISATION = Effect(
    name="quantisation",
    section="sensor",
    keys=(
        Key(
            "bit_depth",
            default=Sensor().bit_depth,
            allowed="a whole number from 1 to 16",
            minimum=1,
            maximum=16,
            control=Control("Bits", 1, 16),
        ),
    ),
    stage=Stage.QUANTISATION,
    uniforms=_uniforms,
    glsl="""\
uniform float saturation_dn;

vec4 quantisation(vec4 signal_dn, uvec2 quad) {
    return floor(clamp(signal_dn, 0.0, saturation_dn) + 0.5);
}
""",
)
