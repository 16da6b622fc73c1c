#version 330 core

// Trail pass: flux of a SHORT segment at one pixel, as two Gaussians, each slightly widened along the path.  They have
// the moments of flux that is spread over the path (star_path.frag).

#if ROWS
flat in vec4 path_px;             // start, in the coordinates of gl_FragCoord, and chord
flat in vec2 ahead_px;            // distance of the middle from that of the chord
flat in float amplitude_dn;       // of a Gaussian that does not move during the segment
flat in vec2 clock;               // of readout.glsl
#if ROWS == 2
flat in vec2 opening_from_path;   // trail_rows.vert
#endif

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

// Elapsed fractions of the segment at which light that is drawn at this pixel begins and ends to be recorded.
vec2 elapsed_limits() {
#if ROWS == 2
    float opens = opening_at(gl_FragCoord.xy) + dot(opening_from_path, gl_FragCoord.xy - path_px.xy);
    vec2 elapsed = (vec2(opens, opens + open_time) - clock.x) * clock.y;
    // Of a star at path_px.xy; at an elapsed fraction u it is u chord + 4 u (1 - u) ahead_px further.
    float along_chord = max(1.0 + dot(opening_from_path, path_px.zw) * clock.y, 0.2);
    vec2 even = clamp(elapsed / along_chord, 0.0, 1.0);
    vec2 bent = 4.0 * even * (1.0 - even) * dot(opening_from_path, ahead_px) * clock.y;
    return clamp((elapsed - bent) / along_chord, 0.0, 1.0);
#else
    return elapsed_while_open(gl_FragCoord.xy, clock);
#endif
}

// The two Gaussians of the part of the path that the row of a pixel records: as `two_gaussians` of star_path.frag.
void set_gaussians() {
    TwoGaussians of_row = part_of_motion(elapsed_limits(), path_px.xy, path_px.zw, ahead_px, sigma_px, amplitude_dn);
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
