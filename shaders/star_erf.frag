#version 330 core

// Sub-exposure pass: flux of one star in four sub-exposures, integrated over one pixel as products of differences of erf.
//
// For point spread functions narrower than 1.1 px, for which a widened Gaussian (star.frag) is not accurate.

flat in vec4  centres_01_px;
flat in vec4  centres_23_px;
flat in float peak_dn;

uniform float psf_sigma_px;

out float light_dn;

const float HALF_PI = 1.5707963267948966;

#include "erf.glsl"
#include "mosaic.glsl"
#include "sub_exposures.glsl"

vec4 erf(vec4 x) {
    vec4 t = 1.0 / (1.0 + ERF_P * abs(x));
    return sign(x) * (1.0 - ERFC_POLYNOMIAL(t) * exp(-x * x));
}

vec2 integrals(vec4 centres_px) {
    vec4 offsets_px = gl_FragCoord.xyxy - 0.5 - centres_px;
    float width_px = psf_sigma_px * sqrt(2.0);
    vec4 across = erf((offsets_px + 0.5) / width_px) - erf((offsets_px - 0.5) / width_px);
    return across.xz * across.yw;
}

void main() {
#if ROWS
    set_open_fractions();
    vec2 flux = open_fractions.xy * integrals(moved_px(centres_01_px, late.xy))
        + open_fractions.zw * integrals(moved_px(centres_23_px, late.zw));
#else
    vec2 flux = integrals(centres_01_px) + integrals(centres_23_px);
#endif
    light_dn = in_mosaic(peak_dn * HALF_PI * psf_sigma_px * psf_sigma_px * (flux.x + flux.y));
}
