"""Noise: Gaussian in the paper's model; shot noise, read noise, row noise and black drift in the model of electrons."""

from collections.abc import Mapping
from math import sqrt
from typing import Any

from glstar.camera.sensor.sensor import ElectronModel, Sensor
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values, electron_model
from glstar.render.scene.scene import Scene

NOISE = Effect(
    name="noise",
    section="sensor",
    keys=(
        Key(
            "sky_std_dn",
            Sensor().sky_std_dn,
            "a number of DN, 0 or more",
            Control("Noise", 0.0, 1024.0, "%.2f DN", logarithmic=True),
            minimum=0.0,
            scales=True,
        ),
    ),
    stage=Stage.NOISE,
    noise_model="paper",
    glsl="""\
// Standard deviation of Teague & Chahl eq. (40), added once to the sum of all starlight.
uniform float sky_std_dn;

vec4 noise(vec4 signal_dn, uvec2 quad) {
    return signal_dn + sky_std_dn * normal_deviates(random_bits(quad));
}
""",
)


_MODEL = ElectronModel()
# Skewness up to which a shorter formula has the third moment of the noise to 5e-4.
_LITTLE_SKEWNESS = 0.3


# Shot noise reaches this number of standard deviations: pixels that are closer to the full well may be cut by it.
_NEAR_FULL_SIGMA = 6.0


def _may_be_full_dn(scene: Scene) -> float:
    """Return the mean signal m from which shot noise may fill a pixel: m + 6 sqrt(m) is the full well, in electrons."""
    model = electron_model(scene)
    half = _NEAR_FULL_SIGMA / 2
    return model.dn_per_e * (sqrt(half * half + model.full_well_e) - half) ** 2


FULL_PIXELS = Effect(
    name="full_pixels",
    section="sensor",
    keys=(),
    stage=Stage.SHOT_NOISE,
    noise_model="electrons",
    uniforms=lambda _values, scene: {
        "counted_dn_per_e": electron_model(scene).dn_per_e,
        "counted_from_dn": _may_be_full_dn(scene),
    },
    glsl="""\
uniform float counted_dn_per_e, counted_from_dn;

// Shot noise belongs to the light: the full well cuts it, and blooming moves it.  Of pixels that cannot be full,
// `shot_noise` adds it with the read noise.
vec4 full_pixels(vec4 signal_dn, uvec2 quad) {
    has_shot_noise = greaterThan(signal_dn, vec4(counted_from_dn));
    if (!any(has_shot_noise)) return signal_dn;
    return mix(signal_dn, counted_dn(signal_dn, counted_dn_per_e, quad), has_shot_noise);
}
""",
)


def _shot_noise_uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = electron_model(scene)
    return {
        "shot_dn_per_e": model.dn_per_e,
        "shot_from_dn": _may_be_full_dn(scene),
        "shot_full_dn": model.dn_per_e * model.full_well_e,
        "shot_read_variance_dn2": (model.dn_per_e * model.read_noise_e) ** 2 + 1e-9,
    }


def _shot_noise_options(_values: Values, scene: Scene) -> Mapping[str, int]:
    """Return whether pixels of some signal are skewed: m / (m + r^2)^1.5 is largest where m is 2 r^2, in electrons."""
    return {"SHOT_SKEWED": int(2 / sqrt(27) > _LITTLE_SKEWNESS * electron_model(scene).read_noise_e)}


def _electron_model_truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    model = electron_model(scene)
    return {
        "sensor": {
            "noise": "electrons",
            "vmag_0_e_per_s": model.vmag_0_e_per_s,
            "dn_per_e": model.dn_per_e,
            "black_level_dn": model.black_level_dn,
            "read_noise_e": model.read_noise_e,
            "full_well_e": model.full_well_e,
            "temperature_c": model.temperature_c,
            "sky_e": model.sky_e_per_s * scene.exposure.duration_s,
            "dark_e": model.dark_e_per_s * scene.exposure.duration_s,
        }
    }


SHOT_NOISE = Effect(
    name="shot_noise",
    section="sensor",
    keys=(
        Key(
            "read_noise_before_gain_e",
            _MODEL.read_noise_before_gain_e,
            "a number of electrons, 0 or more",
            Control("Read noise", 0.0, 50.0, "%.2f e", logarithmic=True),
            minimum=0.0,
        ),
        Key(
            "read_noise_after_gain_e",
            _MODEL.read_noise_after_gain_e,
            "a number of electrons, 0 or more",
            Control("Read noise after gain", 0.0, 50.0, "%.2f e", logarithmic=True),
            minimum=0.0,
        ),
        Key(
            "gain_dn_per_e",
            _MODEL.gain_dn_per_e,
            "a positive number of DN per electron",
            Control("Conversion", 0.001, 100.0, "%.4f DN/e", logarithmic=True),
            above=0.0,
        ),
        Key(
            "analogue_gain",
            _MODEL.analogue_gain,
            "a positive factor",
            Control("Analogue gain", 1.0, 64.0, "x %.2f", logarithmic=True),
            above=0.0,
        ),
    ),
    stage=Stage.NOISE,
    noise_model="electrons",
    uniforms=_shot_noise_uniforms,
    options=_shot_noise_options,
    truth=_electron_model_truth,
    glsl="""\
uniform float shot_dn_per_e, shot_read_variance_dn2, shot_from_dn, shot_full_dn;

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
    vec4 noisy_dn = signal_dn - h_dn + z * (sigma_dn + h_dn * z);
    // Pixels that other pixels' charge has filled are full, and those that it has nearly filled may be.
    bvec4 may_be_full = greaterThan(signal_dn, vec4(shot_from_dn));
    if (any(has_shot_noise) || any(may_be_full)) {
        vec4 charge_dn = min(counted_dn(signal_dn, shot_dn_per_e, quad), shot_full_dn);
        charge_dn = mix(charge_dn, signal_dn, has_shot_noise);
        charge_dn = mix(charge_dn, signal_dn, greaterThanEqual(signal_dn, vec4(shot_full_dn)));
        vec4 read_dn = charge_dn + sqrt(shot_read_variance_dn2) * z;
        noisy_dn = mix(mix(noisy_dn, read_dn, may_be_full), read_dn, has_shot_noise);
    }
    return noisy_dn;
}
""",
)


def _row_noise_uniforms(values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    return {
        "row_noise_dn": electron_model(scene).dn_per_e * float(values["row_noise_e"]),
        "black_drift_dn": float(values["black_drift_dn"]),
    }


ROW_NOISE = Effect(
    name="row_noise",
    section="sensor",
    keys=(
        Key(
            "row_noise_e",
            0.0,
            "a number of electrons, 0 or more",
            Control("Row noise", 0.0, 10.0, "%.2f e", logarithmic=True),
            minimum=0.0,
        ),
        Key(
            "black_drift_dn",
            0.0,
            "a number of DN, 0 or more",
            Control("Black drift", 0.0, 16.0, "%.2f DN", logarithmic=True),
            minimum=0.0,
            scales=True,
        ),
    ),
    stage=Stage.NOISE,
    noise_model="electrons",
    uniforms=_row_noise_uniforms,
    is_active=lambda values: bool(values["row_noise_e"] or values["black_drift_dn"]),
    options=lambda values, _scene: {"BLACK_DRIFT": int(values["black_drift_dn"] != 0)},
    glsl="""\
uniform float row_noise_dn, black_drift_dn;

// Hashes of other numbers than those of the pixels: one deviate for the row, one for the frame.
vec4 row_noise(vec4 signal_dn, uvec2 quad) {
    uvec4 of_frame = hash(seed ^ uvec4(0x51ed270bu, 0xa3b19535u, 0x1f83d9abu, 0x5be0cd19u));
    float row = normal_deviates(hash(of_frame ^ (quad.y * 0x9e3779b9u))).x;
#if BLACK_DRIFT
    return signal_dn + row_noise_dn * row + black_drift_dn * normal_deviates(of_frame).x;
#else
    return signal_dn + row_noise_dn * row;
#endif
}
""",
)
