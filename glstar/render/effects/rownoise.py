"""Noise that all pixels of a row share, and the drift of the black level from frame to frame."""

from collections.abc import Mapping

from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene

__all__ = ["ROW_NOISE"]


def _uniforms(values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    model = scene.sensor.electrons
    assert model is not None
    return {
        "row_noise_dn": model.dn_per_e * float(values["row_noise_e"]),
        "black_drift_dn": float(values["black_drift_dn"]),
    }


ROW_NOISE = Effect(
    name="row_noise",
    section="sensor",
    keys=(
        Key(
            "row_noise_e",
            default=0.0,
            allowed="a number of electrons, 0 or more",
            minimum=0.0,
            control=Control("Row noise", 0.0, 10.0, "%.2f e", logarithmic=True),
        ),
        Key(
            "black_drift_dn",
            default=0.0,
            allowed="a number of DN, 0 or more",
            minimum=0.0,
            control=Control("Black drift", 0.0, 16.0, "%.2f DN", logarithmic=True),
        ),
    ),
    stage=Stage.NOISE,
    noise_model="electrons",
    uniforms=_uniforms,
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
