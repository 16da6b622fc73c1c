"""Shot noise and read noise of the electron model."""

from collections.abc import Mapping
from math import sqrt
from typing import Any, Final

from glstar.camera.electrons import ElectronModel
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["SHOT_NOISE"]

_DEFAULT = ElectronModel()
# Skewness up to which a shorter formula has the third moment of the noise to 5e-4.
_LITTLE_SKEWNESS: Final = 0.3


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {
        "shot_dn_per_e": model.dn_per_e,
        "shot_read_variance_dn2": (model.dn_per_e * model.read_noise_e) ** 2 + 1e-9,
    }


def _options(_values: Values, scene: Scene) -> Mapping[str, int]:
    """Return whether pixels of some signal are skewed: m / (m + r^2)^1.5 is largest where m is 2 r^2, in electrons."""
    model = scene.sensor.electrons
    assert model is not None
    return {"SHOT_SKEWED": int(2 / sqrt(27) > _LITTLE_SKEWNESS * model.read_noise_e)}


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
    options=_options,
    truth=_truth,
    glsl="""\
uniform float shot_dn_per_e, shot_read_variance_dn2;

// A Poisson count plus Gaussian read noise of variance r2 has the variance v and a third central moment m3.
// The polynomial signal - h + z (sigma + h z) of a normal deviate z has the variance sigma^2 + 2 h^2, which is v, and
// the third moment 6 sigma^2 h + 8 h^3.  Up to a skewness m3 / v^1.5 of 0.3, h = m3 / (6 v) makes it m3 to 5e-4 v^1.5.
// SHOT_SKEWED: 1 if pixels may be more skewed.  Then h is fitted up to 1.3: 0.6 electrons without read noise.
vec4 shot_noise(vec4 signal_dn, uvec2 quad) {
    vec4 variance_dn2 = max(signal_dn, 0.0) * shot_dn_per_e + shot_read_variance_dn2;
#if SHOT_SKEWED
    vec4 skewness_dn = shot_dn_per_e - shot_dn_per_e * shot_read_variance_dn2 / variance_dn2;
    skewness_dn = min(skewness_dn, 1.3 * sqrt(variance_dn2));
    vec4 h_dn = skewness_dn * (0.16654166 + 0.00343932 * skewness_dn * skewness_dn / variance_dn2);
#else
    float sixth_dn = shot_dn_per_e / 6.0;
    vec4 h_dn = sixth_dn - sixth_dn * shot_read_variance_dn2 / variance_dn2;
#endif
    vec4 sigma_dn = sqrt(variance_dn2 - 2.0 * h_dn * h_dn);
    vec4 z = normal_deviates(random_bits(quad));
    return signal_dn - h_dn + z * (sigma_dn + h_dn * z);
}
""",
)
