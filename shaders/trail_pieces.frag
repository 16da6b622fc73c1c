#version 330 core

// Piece pass: flux of a star during four pieces of the exposure at one pixel.

flat in vec4 centres_x, centres_y;      // of four Gaussians, in the coordinates of gl_FragCoord
flat in vec4 falloff_xx, falloff_xy, falloff_yy;    // coefficients of their exponents of 2, 1/px^2
flat in vec4 amplitudes_dn;

out float light_dn;

#include "mosaic.glsl"
#include "pixel_kernel.glsl"

float flux_at(vec2 position) {
    vec4 x = position.x - centres_x, y = position.y - centres_y;
    vec4 gaussians = exp2(x * (falloff_xx * x + falloff_xy * y) + falloff_yy * y * y);
    return dot(amplitudes_dn, gaussians);
}

void main() {
    light_dn = in_mosaic(flux_in_pixel(gl_FragCoord.xy, mat2(1.0)));
}
