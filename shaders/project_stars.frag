#version 330 core

// Projection pass: stars in the camera frame at the ends and the middles of the segments of their trails.
//
// A column is a star, a row a time.  Behind a pinhole a texel is the star's position (x, y) in the target, px, 0, and its
// depth (approximately a cosine of the angle to the boresight), 0 if it is behind the camera.  Behind a lens it is the
// star's vector in the camera frame, and 1.  The row after the last time holds the star's brightness, its truncation
// radius, and when it rises and sets.

// STARS_PER_ROW: columns of the texture of stars.

uniform sampler2D stars;          // geocentric apparent unit vectors, and 10^(-0.4 V), in rows of STARS_PER_ROW
// Of each column: the star's index, its truncation radius, px, and transmission; when it rises and sets.
uniform sampler2D chosen;
uniform int       last_time;

#include "projection.glsl"

out vec4 projected;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 choice = texelFetch(chosen, ivec2(texel.x, 0), 0).rgb;
    int index = int(choice.x);
    vec4 star = texelFetch(stars, ivec2(index % STARS_PER_ROW, index / STARS_PER_ROW), 0);

    vec2 rises_and_sets = texelFetch(chosen, ivec2(texel.x, 1), 0).rg;
    Observed seen = observed(star.xyz, min(texel.y, last_time));
#if LENS
    vec4 at_time = vec4(seen.in_camera, 1.0);
#else
    vec4 at_time = vec4(vector_position_px(seen.in_camera), 0.0, is_in_view(seen.in_camera) ? seen.in_camera.z : 0.0);
#endif
    projected = texel.y > last_time ? vec4(star.w * choice.z, choice.y, rises_and_sets) : at_time;
}
