#version 330 core

// Trail pass: flux of a SHORT segment at one pixel, as two Gaussians, each slightly elongated along the path.  They have
// the moments of flux that is spread over the path (star_path.frag).

flat in vec4 centres_px;          // of both Gaussians, in the coordinates of gl_FragCoord
flat in vec4 shape;               // unit vector along the path; reduction of the falloff along it, 1/px^2, for exp2
flat in vec2 amplitudes_dn;

uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): for exp2

out float light_dn;

#include "pixel_kernel.glsl"

float flux_at(vec2 position_px) {
    vec4 offsets_px = position_px.xyxy - centres_px;
    vec4 squares_px2 = offsets_px * offsets_px;
    vec2 s = shape.x * offsets_px.xz + shape.y * offsets_px.yw;
    vec2 gaussians = exp2(shape.zw * s * s - falloff_per_px2 * (squares_px2.xz + squares_px2.yw));
    return dot(amplitudes_dn, gaussians);
}

void main() {
    light_dn = flux_in_pixel(gl_FragCoord.xy, mat2(1.0));
}
