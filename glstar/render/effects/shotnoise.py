"""Shot noise and read noise of the electron model."""

from collections.abc import Mapping
from typing import Any

from glstar.camera.electrons import ElectronModel
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["SHOT_NOISE"]

_DEFAULT = ElectronModel()


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {
        "shot_dn_per_e": model.dn_per_e,
        "shot_read_variance_dn2": (model.dn_per_e * model.read_noise_e) ** 2 + 1e-9,
    }


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    model, duration_s = scene.sensor.electrons, scene.exposure.duration_s
    assert model is not None
    return {
        "sensor": {
            "noise": "electrons",
            "vmag_0_e_per_s": model.vmag_0_e_per_s,
            "dn_per_e": model.dn_per_e,
            "black_level_dn": model.black_level_dn,
            "read_noise_e": model.read_noise_e,
            "full_well_e": model.full_well_e,
            "temperature_c": model.temperature_c,
            "sky_e": model.sky_e_per_s * duration_s,
            "dark_e": model.dark_e_per_s * duration_s,
        }
    }


SHOT_NOISE = Effect(
    name="shot_noise",
    section="sensor",
    keys=(
        Key(
            "read_noise_before_gain_e",
            default=_DEFAULT.read_noise_before_gain_e,
            allowed="a number of electrons, 0 or more",
            minimum=0.0,
            control=Control("Read noise", 0.0, 50.0, "%.2f e", logarithmic=True),
        ),
        Key(
            "read_noise_after_gain_e",
            default=_DEFAULT.read_noise_after_gain_e,
            allowed="a number of electrons, 0 or more",
            minimum=0.0,
            control=Control("Read noise after gain", 0.0, 50.0, "%.2f e", logarithmic=True),
        ),
        Key(
            "gain_dn_per_e",
            default=_DEFAULT.gain_dn_per_e,
            allowed="a positive number of DN per electron",
            above=0.0,
            control=Control("Conversion", 0.001, 100.0, "%.4f DN/e", logarithmic=True),
        ),
        Key(
            "analogue_gain",
            default=_DEFAULT.analogue_gain,
            allowed="a positive factor",
            above=0.0,
            control=Control("Analogue gain", 1.0, 64.0, "x %.2f", logarithmic=True),
        ),
    ),
    stage=Stage.NOISE,
    noise_model="electrons",
    uniforms=_uniforms,
    truth=_truth,
    glsl="""\
uniform float shot_dn_per_e, shot_read_variance_dn2;

// A Poisson count of mean m plus Gaussian read noise of sigma r has the variance v = m + r^2 and the third central
// moment m.  The polynomial f z + g (z^2 - 1) of a normal deviate z has the variance f^2 + 2 g^2 and the third moment
// 6 f^2 g + 8 g^3.  f and g are fitted to the variance 1 (to 2e-4) and to the skewness s = m / v^1.5 (to 5e-4) up to
// s = 1.3: 0.6 electrons without read noise.
vec4 shot_noise(vec4 signal_dn, uvec2 quad) {
    vec4 shot_dn2 = max(signal_dn, 0.0) * shot_dn_per_e;
    vec4 variance_dn2 = shot_dn2 + shot_read_variance_dn2;
    vec4 per_sigma = inversesqrt(variance_dn2);
    vec4 s = min(shot_dn_per_e * shot_dn2 * (per_sigma * per_sigma * per_sigma), 1.3);
    vec4 q = s * s;
    vec4 f = 1.0 - q * (0.02772169 + q * 0.00161842);
    vec4 g = s * (0.16654166 + q * 0.00343932);
    vec4 z = normal_deviates(random_bits(quad));
    return signal_dn + variance_dn2 * per_sigma * (f * z + g * (z * z - 1.0));
}
""",
)
