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
        "noise_dn_per_e": model.dn_per_e,
        "noise_e_per_dn": 1.0 / model.dn_per_e,
        "read_variance_e2": model.read_noise_e**2,
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
            control=Control("behind the gain", 0.0, 50.0, "%.2f e", logarithmic=True),
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
uniform float noise_dn_per_e, noise_e_per_dn, read_variance_e2;

// A Poisson count of mean m plus Gaussian read noise of sigma r has the variance v = m + r^2 and the third central
// moment m.  The polynomial z + a (z^2 - 1) of a normal deviate z has the variance 1 + 2 a^2 and the third moment
// 6 a + 8 a^3; a is the series that gives the skewness m / v^1.5, to 0.004 down to 0.5 electrons without read noise.
vec4 shot_noise(vec4 signal_dn, uvec2 quad) {
    vec4 mean_e = max(signal_dn * noise_e_per_dn, 0.0);
    vec4 variance_e2 = mean_e + (read_variance_e2 + 1e-9);
    vec4 per_sigma = inversesqrt(variance_e2);
    vec4 x = min(mean_e * per_sigma * per_sigma * per_sigma * (1.0 / 6.0), 1.0 / 3.0);
    vec4 square = x * x;
    vec4 a = x + x * square * (5.0 / 3.0 + 29.0 / 6.0 * square);
    vec4 z = normal_deviates(random_bits(quad));
    vec4 unit = inversesqrt(variance_e2 * (1.0 + 2.0 * a * a)) * (z + a * (z * z - 1.0));
    return signal_dn + noise_dn_per_e * variance_e2 * unit;
}
""",
)
