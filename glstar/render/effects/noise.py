"""Gaussian noise of sky and sensor together."""

from glstar.camera.sensor import Sensor
from glstar.render.effects.effect import Control, Effect, Key, Stage

__all__ = ["NOISE"]

NOISE = Effect(
    name="noise",
    section="sensor",
    keys=(
        Key(
            "sky_std_dn",
            default=Sensor().sky_std_dn,
            allowed="a number of DN, 0 or more",
            minimum=0.0,
            control=Control("Noise", 0.0, 1024.0, "%.2f DN", logarithmic=True),
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
