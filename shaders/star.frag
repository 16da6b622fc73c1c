#version 330 core

// Sub-exposure pass: flux of one star in four sub-exposures at one pixel, Teague & Chahl eqs. (42), (43), at the star's
// sub-pixel position.  For pixels that integrate over their area sigma is widened by the variance of the pixel and the
// peak lowered so that the flux is preserved (Sensor.effective_sigma_px, Sensor.effective_peak).

flat in vec4  centres_01_px;
flat in vec4  centres_23_px;
flat in float peak_dn;

uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): for exp2

out float light_dn;

#include "mosaic.glsl"
#include "sub_exposures.glsl"

vec2 gaussians(vec4 centres_px) {
    vec4 offsets_px = gl_FragCoord.xyxy - 0.5 - centres_px;
    vec4 squares_px2 = offsets_px * offsets_px;
    return exp2(-falloff_per_px2 * (squares_px2.xz + squares_px2.yw));
}

void main() {
#if ROWS
    set_open_fractions();
    vec2 flux = open_fractions.xy * gaussians(moved_px(centres_01_px, late.xy))
        + open_fractions.zw * gaussians(moved_px(centres_23_px, late.zw));
#else
    vec2 flux = gaussians(centres_01_px) + gaussians(centres_23_px);
#endif
    light_dn = in_mosaic(peak_dn * (flux.x + flux.y));
}
