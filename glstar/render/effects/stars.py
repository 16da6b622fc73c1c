"""Profile, wings, halo, ellipticity and varying width of stars: keys of what the star passes draw.

Colours of stars and of the sky: keys of the camera's band and of its mosaic.

Scintillation of stars: keys of a process that multiplies the light of each star along its trail.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from glstar.camera.sensor.colourband import BAND_CHOICES, MOSAIC_CHOICES, ColourBand
from glstar.camera.sensor.pointspread import PointSpread
from glstar.render.effects.effect import Control, Effect, Key, Stage, UniformValue, Values
from glstar.render.scene.scene import Scene
from glstar.sky.air.extinction import SMALL_LENS_RMS
from glstar.sky.photometry import USUAL_BV, star_colours

_PLAIN_POINT_SPREAD = PointSpread()


def _is_no_gaussian(values: Values) -> bool:
    return not PointSpread.of({f"sensor.{key}": value for key, value in values.items()}).is_gaussian


def _point_spread_truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    sensor = scene.sensor
    components = sensor.point_spread.circular(sensor.psf_sigma_px)
    return {
        "psf": {
            "psf_sigma_px": sensor.psf_sigma_px,
            **sensor.point_spread.keys,
            "gaussians": [[one.flux_fraction, one.sigma_px] for one in components],
        }
    }


POINT_SPREAD = Effect(
    name="point_spread",
    section="sensor",
    keys=(
        Key(
            "psf",
            _PLAIN_POINT_SPREAD.psf,
            allowed="'gaussian' or 'moffat'",
            choices=("gaussian", "moffat"),
            control=Control("Star profile"),
        ),
        Key(
            "psf_beta",
            _PLAIN_POINT_SPREAD.psf_beta,
            allowed="an exponent from 2 to 20",
            minimum=2.0,
            maximum=20.0,
            control=Control("Moffat beta", 2.0, 8.0, "%.2f"),
        ),
        Key(
            "psf_wing_fraction",
            _PLAIN_POINT_SPREAD.psf_wing_fraction,
            allowed="a fraction from 0 to 0.9",
            minimum=0.0,
            maximum=0.9,
            control=Control("Wings", 0.0, 0.5, "%.3f of the flux"),
        ),
        Key(
            "psf_wing_sigma_px",
            _PLAIN_POINT_SPREAD.psf_wing_sigma_px,
            allowed="a number of pixels from 0.1 to 40",
            minimum=0.1,
            maximum=40.0,
            control=Control("Wing sigma", 1.0, 20.0, "%.2f px"),
        ),
        Key(
            "psf_halo_fraction",
            _PLAIN_POINT_SPREAD.psf_halo_fraction,
            allowed="a fraction from 0 to 0.5",
            minimum=0.0,
            maximum=0.5,
            control=Control("Halo", 0.0, 0.1, "%.4f of the flux"),
        ),
        Key(
            "psf_halo_radius_px",
            _PLAIN_POINT_SPREAD.psf_halo_radius_px,
            allowed="a number of pixels from 1 to 40",
            minimum=1.0,
            maximum=40.0,
            control=Control("Halo radius", 1.0, 40.0, "%.1f px"),
        ),
        Key(
            "psf_growth",
            _PLAIN_POINT_SPREAD.psf_growth,
            allowed="a fraction from 0 to 4",
            minimum=0.0,
            maximum=4.0,
            control=Control("Growth to the corners", 0.0, 2.0, "%.3f"),
        ),
        Key(
            "psf_ellipticity",
            _PLAIN_POINT_SPREAD.psf_ellipticity,
            allowed="a number from 0 to 0.4",
            minimum=0.0,
            maximum=0.4,
            control=Control("Ellipticity", 0.0, 0.4, "%.3f"),
        ),
        Key(
            "psf_angle_deg",
            0.0,
            allowed="degrees from -360 to 360",
            minimum=-360.0,
            maximum=360.0,
            control=Control("Major axis", -90.0, 90.0, "%.0f deg"),
        ),
        Key(
            "psf_tilt",
            _PLAIN_POINT_SPREAD.psf_tilt,
            allowed="a fraction from 0 to 0.9",
            minimum=0.0,
            maximum=0.9,
            control=Control("Tilt of the sensor", 0.0, 0.9, "%.3f"),
        ),
        Key(
            "psf_tilt_angle_deg",
            0.0,
            allowed="degrees from -360 to 360",
            minimum=-360.0,
            maximum=360.0,
            control=Control("Wider towards", -180.0, 180.0, "%.0f deg"),
        ),
        Key(
            "psf_colour_growth",
            _PLAIN_POINT_SPREAD.psf_colour_growth,
            allowed="a fraction from -0.5 to 0.5",
            minimum=-0.5,
            maximum=0.5,
            control=Control("Growth with B - V", -0.5, 0.5, "%.3f"),
        ),
    ),
    stage=Stage.STARS,
    glsl="",
    truth=_point_spread_truth,
    is_active=_is_no_gaussian,
)


_PLAIN_BAND = ColourBand()
_MOSAIC = Key(
    "mosaic",
    _PLAIN_BAND.mosaic,
    allowed="one of none, rggb, bggr, grbg, gbrg",
    choices=MOSAIC_CHOICES,
    control=Control("Mosaic"),
)


def _colour_truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
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
            _PLAIN_BAND.band,
            allowed=f"one of {', '.join(BAND_CHOICES)}",
            choices=BAND_CHOICES,
            control=Control("Band"),
        ),
        Key("band_slope", _PLAIN_BAND.band_slope, allowed="a number of magnitudes", minimum=-3.0, maximum=3.0),
        Key("band_curvature", _PLAIN_BAND.band_curvature, allowed="a number of magnitudes", minimum=-3.0, maximum=3.0),
        _MOSAIC,
        Key("sky_bv", _PLAIN_BAND.sky_bv, allowed="a colour from -0.3 to 1.7", minimum=-0.3, maximum=1.7),
    ),
    stage=Stage.STARS,
    glsl="",
    truth=_colour_truth,
    is_active=lambda values: values["band"] != "v",
)


def _has_mosaic(values: Values) -> bool:
    return values["mosaic"] != "none"


def _mosaic_uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
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
    uniforms=_mosaic_uniforms,
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
    uniforms=_mosaic_uniforms,
    glsl="""\
vec4 mosaic_of_sky(vec4 signal_dn, uvec2 quad) {
    return signal_dn * mosaic_levels(quad);
}
""",
    is_active=_has_mosaic,
)


def _scintillates(values: Values) -> bool:
    return bool(values["scintillation"])


SCINTILLATION = Effect(
    name="scintillation",
    section="sky",
    keys=(
        Key(
            "scintillation",
            default=0.0,
            allowed="a relative standard deviation from 0 to 1; 0 is none",
            minimum=0.0,
            maximum=1.0,
            control=Control("Scintillation", 0.0, 2 * SMALL_LENS_RMS, "%.2f"),
        ),
        Key("scintillation_seed", default=0, allowed="a whole number, 0 or more", minimum=0),
    ),
    stage=Stage.STARS,
    is_active=_scintillates,
    glsl="",
)
