#version 330 core

// Trail pass: flux of a SHORT segment at one pixel, as two Gaussians, each slightly widened along the path.  They have
// the moments of flux that is spread over the path (star_path.frag).

#if ROWS
flat in vec4 path_px;             // start, in the coordinates of gl_FragCoord, and chord
flat in vec2 ahead_px;            // distance of the middle from that of the chord
flat in float amplitude_dn;       // of a Gaussian that does not move during the segment
flat in vec2 clock;               // of readout.glsl

#if COMPONENTS
flat in float sigma_px;           // COMPONENTS: of star_path.frag
#else
uniform float sigma_px;
#endif

vec4 centres_px, shape;
vec2 amplitudes_dn;
#else
flat in vec4 centres_px;          // of both Gaussians, in the coordinates of gl_FragCoord
flat in vec4 shape;               // vectors along which they are widened, 1/px: two_gaussians.glsl
flat in vec2 amplitudes_dn;
#endif

#if COMPONENTS
flat in float falloff_per_px2;
#else
uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): for exp2
#endif

out float light_dn;

#include "pixel_kernel.glsl"
#include "mosaic.glsl"
#if ROWS
#include "readout.glsl"
#include "two_gaussians.glsl"

// The two Gaussians of the part of the path that the row of a pixel records: as `two_gaussians` of star_path.frag.
void set_gaussians() {
    vec2 elapsed = elapsed_while_open(gl_FragCoord.xy, clock);
    TwoGaussians of_row = part_of_motion(elapsed, path_px.xy, path_px.zw, ahead_px, sigma_px, amplitude_dn);
    centres_px = of_row.centres_px;
    shape = of_row.shape;
    amplitudes_dn = of_row.amplitudes_dn;
}
#endif

float flux_at(vec2 position_px) {
#if COMPONENTS
    vec2 offset_px = position_px - centres_px.xy;
    float s = dot(shape.xy, offset_px);
    return 2.0 * amplitudes_dn.x * exp2(s * s - falloff_per_px2 * dot(offset_px, offset_px));
#else
    vec4 offsets_px = position_px.xyxy - centres_px;
    vec4 squares_px2 = offsets_px * offsets_px;
    vec2 s = shape.xz * offsets_px.xz + shape.yw * offsets_px.yw;
    vec2 gaussians = exp2(s * s - falloff_per_px2 * (squares_px2.xz + squares_px2.yw));
    return dot(amplitudes_dn, gaussians);
#endif
}

void main() {
#if ROWS
    set_gaussians();
#endif
    light_dn = in_mosaic(flux_in_pixel(gl_FragCoord.xy, mat2(1.0)));
}
