"""The full well: pixels hold no more electrons."""

from collections.abc import Mapping

from glstar.camera.electrons import ElectronModel
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["FULL_WELL"]


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"full_well_dn": model.dn_per_e * model.full_well_e}


FULL_WELL = Effect(
    name="full_well",
    section="sensor",
    keys=(
        Key(
            "full_well_e",
            default=ElectronModel().full_well_e,
            allowed="a positive number of electrons",
            above=0.0,
            control=Control("Full well", 100.0, 200_000.0, "%.0f e", logarithmic=True),
        ),
    ),
    stage=Stage.FULL_WELL,
    noise_model="electrons",
    uniforms=_uniforms,
    glsl="""\
uniform float full_well_dn;

vec4 full_well(vec4 signal_dn, uvec2 quad) {
    return min(signal_dn, full_well_dn);
}
""",
)
