"""Keys of what the star passes draw: point spread functions, colours and scintillation of stars.

The mosaic of the colour filters also has GLSL in the develop pass, for the colour of the sky.
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


def _point_spread_truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    sensor = scene.sensor
    components = sensor.point_spread.circular(sensor.psf_sigma_px)
    return {
        "psf": {
            "psf_sigma_px": sensor.psf_sigma_px,
            **sensor.point_spread.keys,
            "gaussians": [[component.flux_fraction, component.sigma_px] for component in components],
        }
    }


def _psf_key(name: str, allowed: str, minimum: float, maximum: float, control: Control) -> Key:
    """Return a key that is a number, with the default of `PointSpread`; angles, which it has in radians, are 0."""
    return Key(
        name,
        getattr(_PLAIN_POINT_SPREAD, name, 0.0),
        allowed,
        control,
        minimum=minimum,
        maximum=maximum,
        changes_light=True,
    )


POINT_SPREAD = Effect(
    name="point_spread",
    section="sensor",
    keys=(
        Key(
            "psf",
            _PLAIN_POINT_SPREAD.psf,
            "'gaussian' or 'moffat'",
            Control("Star profile"),
            choices=("gaussian", "moffat"),
            changes_light=True,
        ),
        _psf_key("psf_beta", "an exponent from 2 to 20", 2.0, 20.0, Control("Moffat beta", 2.0, 8.0, "%.2f")),
        _psf_key(
            "psf_wing_fraction", "a fraction from 0 to 0.9", 0.0, 0.9, Control("Wings", 0.0, 0.5, "%.3f of the flux")
        ),
        _psf_key(
            "psf_wing_sigma_px",
            "a number of pixels from 0.1 to 40",
            0.1,
            40.0,
            Control("Wing sigma", 1.0, 20.0, "%.2f px"),
        ),
        _psf_key(
            "psf_halo_fraction", "a fraction from 0 to 0.5", 0.0, 0.5, Control("Halo", 0.0, 0.1, "%.4f of the flux")
        ),
        _psf_key(
            "psf_halo_radius_px",
            "a number of pixels from 1 to 40",
            1.0,
            40.0,
            Control("Halo radius", 1.0, 40.0, "%.1f px"),
        ),
        _psf_key("psf_growth", "a fraction from 0 to 4", 0.0, 4.0, Control("Growth to the corners", 0.0, 2.0, "%.3f")),
        _psf_key("psf_ellipticity", "a number from 0 to 0.4", 0.0, 0.4, Control("Ellipticity", 0.0, 0.4, "%.3f")),
        _psf_key(
            "psf_angle_deg", "degrees from -360 to 360", -360.0, 360.0, Control("Major axis", -90.0, 90.0, "%.0f deg")
        ),
        _psf_key("psf_tilt", "a fraction from 0 to 0.9", 0.0, 0.9, Control("Tilt of the sensor", 0.0, 0.9, "%.3f")),
        _psf_key(
            "psf_tilt_angle_deg",
            "degrees from -360 to 360",
            -360.0,
            360.0,
            Control("Wider towards", -180.0, 180.0, "%.0f deg"),
        ),
        _psf_key(
            "psf_colour_growth",
            "a fraction from -0.5 to 0.5",
            -0.5,
            0.5,
            Control("Growth with B - V", -0.5, 0.5, "%.3f"),
        ),
    ),
    stage=Stage.STARS,
    glsl="",
    truth=_point_spread_truth,
    is_active=lambda values: not PointSpread.of_keys(values).is_gaussian,
)


_PLAIN_BAND = ColourBand()
_MOSAIC = Key(
    "mosaic",
    _PLAIN_BAND.mosaic,
    "one of none, rggb, bggr, grbg, gbrg",
    Control("Mosaic"),
    choices=MOSAIC_CHOICES,
    changes_light=True,
)


def _colour_truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    colour = scene.sensor.colour
    stars = scene.stars
    unknown = stars.star_id[scene.visible][np.isnan(star_colours(stars))[scene.visible]]
    return {
        "colour": {
            "band": colour.band,
            "mosaic": colour.mosaic,
            "assumed_bv": USUAL_BV,
            "without_bv": unknown.tolist(),
        }
    }


COLOUR_BAND = Effect(
    name="colour_band",
    section="sensor",
    keys=(
        Key(
            "band",
            _PLAIN_BAND.band,
            f"one of {', '.join(BAND_CHOICES)}",
            Control("Band"),
            choices=BAND_CHOICES,
            changes_light=True,
        ),
        *(
            Key(
                name,
                getattr(_PLAIN_BAND, name),
                "a number of magnitudes, -3 to 3",
                minimum=-3.0,
                maximum=3.0,
                changes_light=True,
            )
            for name in ("band_slope", "band_curvature")
        ),
        _MOSAIC,
        Key("sky_bv", _PLAIN_BAND.sky_bv, "a colour from -0.3 to 1.7", minimum=-0.3, maximum=1.7),
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


# The sky is uniform between these two effects: its level in each colour multiplies the sum of sky and stars, and stars
# are divided by it first.
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


SCINTILLATION = Effect(
    name="scintillation",
    section="sky",
    keys=(
        Key(
            "scintillation",
            0.0,
            "a relative standard deviation from 0 to 1; 0 is none",
            Control("Scintillation", 0.0, 2 * SMALL_LENS_RMS, "%.2f"),
            minimum=0.0,
            maximum=1.0,
        ),
        Key("scintillation_seed", 0, "a whole number, 0 or more", minimum=0),
    ),
    stage=Stage.STARS,
    is_active=lambda values: bool(values["scintillation"]),
    glsl="",
)
