"""Dark current, by temperature and exposure time."""

from collections.abc import Mapping

from glstar.camera.electrons import ElectronModel
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["DARK_CURRENT"]

_DEFAULT = ElectronModel()


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {"dark_dn": model.dn_per_e * model.dark_e_per_s * scene.exposure.duration_s}


DARK_CURRENT = Effect(
    name="dark_current",
    section="sensor",
    keys=(
        Key(
            "dark_current_e_per_s",
            default=_DEFAULT.dark_current_e_per_s,
            allowed="a number of electrons per second, 0 or more",
            minimum=0.0,
            control=Control("Dark current", 0.0, 100.0, "%.2f e/s at 25 C", logarithmic=True),
        ),
        Key(
            "dark_doubling_c",
            default=_DEFAULT.dark_doubling_c,
            allowed="a positive number of degrees Celsius",
            above=0.0,
        ),
        Key(
            "temperature_c",
            default=_DEFAULT.temperature_c,
            allowed="degrees Celsius, from -100 to 150",
            minimum=-100.0,
            maximum=150.0,
            control=Control("Temperature", -20.0, 80.0, "%.1f C"),
        ),
    ),
    stage=Stage.DARK_CURRENT,
    noise_model="electrons",
    uniforms=_uniforms,
    glsl="""\
uniform float dark_dn;

vec4 dark_current(vec4 signal_dn, uvec2 quad) {
    return signal_dn + dark_dn;
}
""",
)
