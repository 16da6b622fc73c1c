"""The background level of the sky."""

from glstar.camera.sensor import Sensor
from glstar.render.effects.effect import Control, Effect, Key, Stage
from glstar.render.effects.skymap import SKY_MAP_KEY

__all__ = ["SKY_LEVEL"]

SKY_LEVEL = Effect(
    name="sky_level",
    section="sensor",
    keys=(
        Key(
            "sky_mean_dn",
            default=Sensor().sky_mean_dn,
            allowed="a number of DN, 0 or more",
            minimum=0.0,
            control=Control("Sky", 0.0, 4096.0, "%.1f DN", logarithmic=True),
        ),
    ),
    stage=Stage.SKY,
    noise_model="paper",
    reads=(SKY_MAP_KEY,),
    is_active=lambda values: not values["sky_map"],
    glsl="""\
// Mean of Teague & Chahl eq. (40), added once to the sum of all starlight.
uniform float sky_mean_dn;

vec4 sky_level(vec4 signal_dn, uvec2 quad) {
    return signal_dn + sky_mean_dn;
}
""",
)
