"""Vignetting of the lens, for stars and for the sky, and the image circle, beyond which it shows nothing."""

from collections.abc import Hashable, Mapping
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glstar.camera.vignetting import VIGNETTINGS, Vignetting, image_grid
from glstar.render.effects.effect import Control, Effect, EffectTexture, Key, Stage, UniformValue, Values, quads_of
from glstar.render.effects.sky import UNIFORM_SKY, beyond_lens, uniform_sky_dn
from glstar.render.scene.scene import Scene

_DEFAULT = Vignetting()
# Texels of a measured flat field, along x and along y: the light of a lens changes by percents between them.
_TEXELS = (129, 97)
# Relative change of the light by second derivatives that are left out.
_TOLERANCE = 5e-6
_COEFFICIENT = "a number from -1000 to 1000"

# Behind a lens whose image circle is much smaller than the image, the coefficients are large.
_KEYS = (
    Key(
        "vignetting",
        _DEFAULT.vignetting,
        '"none", "cos4", "polynomial" or "flat"',
        Control("Vignetting"),
        choices=VIGNETTINGS,
    ),
    *(
        Key(name, 0.0, _COEFFICIENT, minimum=-1000.0, maximum=1000.0)
        for name in ("vignetting_r2", "vignetting_r4", "vignetting_r6")
    ),
    Key("vignetting_file", "", "the path of a flat field: PNG, TIFF, FITS or NPY"),
)


def _sky_dn(scene: Scene) -> float:
    """Return the level of the uniform sky in front of the lens, which has been added with that on the axis; or 0."""
    sensor = scene.sensor
    is_added = sensor.noise == UNIFORM_SKY.noise_model and UNIFORM_SKY.is_active(UNIFORM_SKY.values(sensor))
    return uniform_sky_dn(scene) if is_added else 0.0


def _two_vectors(coefficients: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return up to eight coefficients as the shader has them: four and four, filled with zeros."""
    filled = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    return filled[:4], filled[4:]


def _uniforms(_values: Values, scene: Scene) -> Mapping[str, UniformValue]:
    camera = scene.camera
    fit = Vignetting.of(scene.sensor.effects).fit(camera)
    sky_dn = _sky_dn(scene)
    sky = tuple(sky_dn * (of_sky - of_star) for of_star, of_sky in zip(fit.star, fit.sky, strict=True))
    star_low, star_high = _two_vectors(fit.star)
    sky_low, sky_high = _two_vectors(sky)
    largest = sqrt(fit.largest_q)
    return {
        "falloff_star_low": star_low,
        "falloff_star_high": star_high,
        "falloff_sky_low": sky_low,
        "falloff_sky_high": sky_high,
        "falloff_bend": fit.bend,
        "falloff_per_px": (1 / (camera.fx_px * largest), 1 / (camera.fy_px * largest)),
        "falloff_principal_px": (camera.cx_px, camera.cy_px),
        "falloff_shear": camera.skew_px / camera.fx_px,
    }


def _options(_values: Values, scene: Scene) -> Mapping[str, int]:
    """Return how many terms the polynomials have, and whether their second derivatives matter within a fragment."""
    camera = scene.camera
    fit = Vignetting.of(scene.sensor.effects).fit(camera)
    half_px = 4 if scene.sensor.bit_depth > 8 else 8
    change = fit.curvature * (half_px / min(camera.fx_px, camera.fy_px)) ** 2 / 2
    return {"FALLOFF_TERMS": len(fit.star), "FALLOFF_CURVED": int(change > _TOLERANCE)}


def _truth(_values: Values, scene: Scene) -> Mapping[str, Any]:
    return {"vignetting": Vignetting.of(scene.sensor.effects).vignetting}


def _texels(_values: Values, scene: Scene) -> NDArray[np.float32]:
    vignetting = Vignetting.of(scene.sensor.effects)
    xy = image_grid(scene.camera, *_TEXELS)
    star, sky = vignetting.of_stars(scene.camera, xy), vignetting.of_sky(scene.camera, xy)
    return np.stack([star, sky], axis=-1).astype(np.float32)


def _depends_on(_values: Values, scene: Scene) -> Hashable:
    return Vignetting.of(scene.sensor.effects), scene.camera


LENS_FALLOFF = Effect(
    name="lens_falloff",
    section="lens",
    keys=_KEYS,
    stage=Stage.TRANSMISSION,
    uniforms=_uniforms,
    truth=_truth,
    is_active=lambda values: values["vignetting"] in {"cos4", "polynomial"},
    options=_options,
    glsl="""\
// Transmission for stars, and what the uniform sky differs from them, DN: polynomials of w with FALLOFF_TERMS terms.
uniform vec4 falloff_star_low, falloff_star_high, falloff_sky_low, falloff_sky_high;
// The distance from the principal point is 1 at the largest on the image: per pixel of a column and of a row.
uniform vec2 falloff_per_px, falloff_principal_px;
uniform float falloff_shear, falloff_bend;

// FALLOFF_CURVED: 1 if the second derivatives along the row matter within a fragment.
#if FALLOFF_CURVED
#define FALLOFF vec3
#else
#define FALLOFF vec2
#endif

// Value, slope and half of the second derivative of a polynomial, by Horner's rule.
FALLOFF falloff_series(float w, vec4 low, vec4 high) {
    float terms[8] = float[8](low.x, low.y, low.z, low.w, high.x, high.y, high.z, high.w);
    FALLOFF found = FALLOFF(0.0);
    found.x = terms[FALLOFF_TERMS - 1];
    for (int power = FALLOFF_TERMS - 2; power >= 0; --power) {
#if FALLOFF_CURVED
        found = found * w + vec3(terms[power], found.xy);
#else
        found = found * w + vec2(terms[power], found.x);
#endif
    }
    return found;
}

// The four pixels of a quad, given a polynomial at the middle of the fragment, how w changes from there along the row,
// and where the middle of the quad is: quadratic in px between the quads, linear in each of them.
vec4 falloff_of_quad(FALLOFF of_w, vec2 w_per_px, float quad_px) {
    float slope = of_w.y * w_per_px.x;
#if FALLOFF_CURVED
    float bend = of_w.y * w_per_px.y + of_w.z * w_per_px.x * w_per_px.x;
    float middle = of_w.x + quad_px * (slope + quad_px * bend);
    slope += 2.0 * quad_px * bend;
#else
    float middle = of_w.x + quad_px * slope;
#endif
    return middle + vec4(-1.5, -0.5, 0.5, 1.5) * slope;
}

// The polynomials are evaluated once per fragment, in the middle of its pixels; the compiler shares that between quads.
vec4 lens_falloff(vec4 signal_dn, uvec2 quad) {
    vec2 from_axis = (vec2(middle_column_px(), floor(fragment.y)) - falloff_principal_px) * falloff_per_px;
    from_axis.x -= falloff_shear * from_axis.y;
    float u = dot(from_axis, from_axis);
    // Slope and half of the second derivative of u along the row; the lens shows nothing beyond the largest u, 1.
    vec2 u_per_px = falloff_per_px.x * vec2(2.0 * from_axis.x, falloff_per_px.x);
    u_per_px = u < 1.0 ? u_per_px : vec2(0.0);
    u = min(u, 1.0);
    float bent = 1.0 / (1.0 + falloff_bend * u), w = (1.0 + falloff_bend) * u * bent;
    float w_per_u = (1.0 + falloff_bend) * bent * bent;
    vec2 w_per_px = w_per_u * vec2(u_per_px.x, u_per_px.y - falloff_bend * bent * u_per_px.x * u_per_px.x);
    FALLOFF star = falloff_series(w, falloff_star_low, falloff_star_high);
    FALLOFF sky = falloff_series(w, falloff_sky_low, falloff_sky_high);
    float quad_px = columns_px(quad).x + 1.5 - middle_column_px();
    return signal_dn * falloff_of_quad(star, w_per_px, quad_px) + falloff_of_quad(sky, w_per_px, quad_px);
}
""",
)

FLAT_FALLOFF = Effect(
    name="flat_falloff",
    section="lens",
    keys=(),
    stage=Stage.TRANSMISSION,
    uniforms=lambda _values, scene: {"flat_sky_dn": _sky_dn(scene)},
    textures=(EffectTexture("falloff_of_star_and_sky", _texels, _depends_on),),
    truth=_truth,
    is_active=lambda values: values["vignetting"] == "flat",
    reads=_KEYS,
    glsl="""\
uniform sampler2D falloff_of_star_and_sky;
uniform float flat_sky_dn;

vec4 flat_falloff(vec4 signal_dn, uvec2 quad) {
    vec4 x = (columns_px(quad) + 0.5) / image_px.x;
    float y = (row_px(quad) + 0.5) / image_px.y;
    vec2 first = textureLod(falloff_of_star_and_sky, vec2(x.x, y), 0.0).rg;
    vec2 last = textureLod(falloff_of_star_and_sky, vec2(x.w, y), 0.0).rg;
    vec4 along = vec4(0.0, 1.0, 2.0, 3.0) / 3.0;
    vec4 star = mix(first.rrrr, last.rrrr, along), sky = mix(first.gggg, last.gggg, along);
    return (signal_dn - flat_sky_dn) * star + flat_sky_dn * sky;
}
""",
)


def _seen_by_lens(_values: Values, scene: Scene) -> NDArray[np.float32]:
    """Return 1 at pixels that the lens shows, by quads; the shader reads it only if there are others."""
    beyond = beyond_lens(scene.camera)
    assert beyond is not None
    return quads_of(np.where(beyond, np.float32(0), np.float32(1)))


# After all light, measured backgrounds and flare too.
IMAGE_CIRCLE = Effect(
    name="image_circle",
    section="lens",
    keys=(),
    stage=Stage.SKY,
    textures=(
        EffectTexture(
            "seen_by_lens",
            _seen_by_lens,
            lambda _values, scene: scene.camera,
            per_quad=True,
        ),
    ),
    options=lambda _values, scene: {"IMAGE_CIRCLE": int(beyond_lens(scene.camera) is not None)},
    glsl="""\
// IMAGE_CIRCLE: 1 if the lens shows nothing at some pixels.
#if IMAGE_CIRCLE
uniform sampler2D seen_by_lens;
#endif

vec4 image_circle(vec4 signal_dn, uvec2 quad) {
#if IMAGE_CIRCLE
    signal_dn *= texelFetch(seen_by_lens, ivec2(quad), 0);
#endif
    return signal_dn;
}
""",
)
