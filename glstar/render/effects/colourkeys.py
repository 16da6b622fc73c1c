"""Colours of stars and of the sky: keys of the camera's band and of its mosaic."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from glstar.camera.colourband import BAND_CHOICES, MOSAIC_CHOICES, ColourBand
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene import Scene
from glstar.sky.starcolours import USUAL_BV, star_colours

__all__ = ["COLOUR_BAND", "MOSAIC_OF_SKY", "MOSAIC_OF_STARS"]

_PLAIN = ColourBand()
_MOSAIC = Key(
    "mosaic",
    _PLAIN.mosaic,
    allowed="one of none, rggb, bggr, grbg, gbrg",
    choices=MOSAIC_CHOICES,
    control=Control("Mosaic"),
)


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    colour, stars = scene.sensor.colour, scene.stars
    unknown = stars.star_id[scene.visible][np.isnan(star_colours(stars))[scene.visible]]
    band = {"band": colour.band, "mosaic": colour.mosaic, "assumed_bv": USUAL_BV, "without_bv": unknown.tolist()}
    return {"colour": band}


COLOUR_BAND = Effect(
    name="colour_band",
    section="sensor",
    keys=(
        Key(
            "band",
            _PLAIN.band,
            allowed=f"one of {', '.join(BAND_CHOICES)}",
            choices=BAND_CHOICES,
            control=Control("Band"),
        ),
        Key("band_slope", _PLAIN.band_slope, allowed="a number of magnitudes", minimum=-3.0, maximum=3.0),
        Key("band_curvature", _PLAIN.band_curvature, allowed="a number of magnitudes", minimum=-3.0, maximum=3.0),
        _MOSAIC,
        Key("sky_bv", _PLAIN.sky_bv, allowed="a colour from -0.3 to 1.7", minimum=-0.3, maximum=1.7),
    ),
    stage=Stage.STARS,
    glsl="",
    truth=_truth,
    is_active=lambda values: values["band"] != "v",
)


def _has_mosaic(values: Values) -> bool:
    return values["mosaic"] != "none"


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    colour = scene.sensor.colour
    level = colour.sky_ratio
    rows = [tuple(level[colour.channel_at(column, row)] for column in (0, 1)) for row in (0, 1)]
    return {"mosaic_even_row": rows[0], "mosaic_odd_row": rows[1]}


# The sky is uniform between these two: its level in each colour multiplies the sum of sky and stars, and stars are
# divided by it first.
MOSAIC_OF_STARS = Effect(
    name="mosaic_of_stars",
    section="sensor",
    keys=(),
    reads=(_MOSAIC,),
    stage=Stage.STARS,
    uniforms=_uniforms,
    glsl="""\
uniform vec2 mosaic_even_row, mosaic_odd_row;   // level of the background in the pixels of each colour, over its mean

vec4 mosaic_levels(uvec2 quad) {
    return ((quad.y & 1u) == 0u ? mosaic_even_row : mosaic_odd_row).xyxy;
}

vec4 mosaic_of_stars(vec4 signal_dn, uvec2 quad) {
    return signal_dn / mosaic_levels(quad);
}
""",
    is_active=_has_mosaic,
)
MOSAIC_OF_SKY = Effect(
    name="mosaic_of_sky",
    section="sensor",
    keys=(),
    reads=(_MOSAIC,),
    stage=Stage.FIXED_PATTERN,
    uniforms=_uniforms,
    glsl="""\
vec4 mosaic_of_sky(vec4 signal_dn, uvec2 quad) {
    return signal_dn * mosaic_levels(quad);
}
""",
    is_active=_has_mosaic,
)
