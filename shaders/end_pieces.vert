#version 330 core

// End pass: a star during one piece of its trail in which a row opens or closes that it lights, under a rolling shutter, as
// a point sprite.  A piece lies within one segment (glstar/render/readout/openings.py): its path is a quadratic function of time.
// trail_short.frag draws that part of it during which the row of each pixel is open.

// STARS_PER_ROW: columns of the texture of stars.

in uvec2 sprite;                  // column of the star in `chosen`, and number of the piece

uniform sampler2D stars;          // geocentric apparent unit vectors, and 10^(-0.4 V), in rows of STARS_PER_ROW
uniform sampler2D chosen;         // of each column: the star's index, its truncation radius, px, and transmission
uniform sampler2D passage;        // transmission of cloud by column and piece; one texel of 1 without
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that does not move during the whole exposure
// The texture `pointing` of projection.glsl has the start, the middle and the end of each piece.  Fourth components of the
// start: when the piece begins, and its duration, fractions of the exposure.

// Explained in trail_short.frag.
flat out vec4 path_px;
flat out vec2 ahead_px;
flat out float amplitude_dn;
flat out vec2 clock;

#include "projection.glsl"
#include "rasterization.glsl"
#include "target.glsl"
#include "two_gaussians.glsl"
#include "drawn_fraction.glsl"

#if MOSAIC
uniform sampler2D tints_of_stars; // by column
flat out vec4 tints;              // mosaic.glsl
#endif

void main() {
    int column = int(sprite.x), piece = int(sprite.y);
    vec3 choice = texelFetch(chosen, ivec2(column, 0), 0).rgb;
    int index = int(choice.x);
    vec4 star = texelFetch(stars, ivec2(index % STARS_PER_ROW, index / STARS_PER_ROW), 0);
#if MOSAIC
    tints = texelFetch(tints_of_stars, ivec2(column, 0), 0);
#endif
    float begin = texelFetch(pointing, ivec2(0, 3 * piece), 0).w, duration = texelFetch(pointing, ivec2(1, 3 * piece), 0).w;
    float transmission = texelFetch(passage, min(ivec2(column, piece), textureSize(passage, 0) - 1), 0).r;
    clock = vec2(begin, 1.0 / duration);

    vec2 at_px[3];
    bool is_seen = true;
    for (int k = 0; k < 3; ++k) {
        vec3 in_camera = observed(star.xyz, 3 * piece + k).in_camera;
        is_seen = is_seen && is_in_view(in_camera);
        at_px[k] = vector_position_px(in_camera);
    }
    vec2 chord = at_px[2] - at_px[0];
    ahead_px = at_px[1] - 0.5 * (at_px[0] + at_px[2]);
    path_px = vec4(at_px[0] + 0.5, chord);
    float margin_px = choice.y + SNAPPING_PX;
    amplitude_dn = vmag_0_peak_dn * star.w * choice.z * duration * transmission / fraction_of_two_gaussians(margin_px, chord);
    vec2 low_px = min(min(at_px[0], at_px[2]), at_px[1]), high_px = max(max(at_px[0], at_px[2]), at_px[1]);
    // A clipped point would send all of the call through a slower part of llvmpipe.  This one lies in a corner of the
    // clip volume and is dark.
    if (!is_seen || !is_point_over(low_px - margin_px, high_px + margin_px)) {
        gl_Position = vec4(-1.0, -1.0, 0.0, 1.0);
        gl_PointSize = 1.0;
        amplitude_dn = 0.0;
    }
}
