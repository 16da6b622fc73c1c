#version 330 core

// Projection pass: pixel positions of stars at the ends and the middles of the segments of their trails.
//
// A column is a star, a row a time.  A texel is the star's position (x, y) in the target, px, its height above the
// apparent horizon (approximately a sine), and its depth (approximately a cosine of the angle to the boresight), 0 if it
// is behind the camera.  The row after the last time holds the star's brightness and truncation radius.

// STARS_PER_ROW: columns of the texture of stars.

uniform sampler2D stars;          // geocentric apparent unit vectors, and 10^(-0.4 V), in rows of STARS_PER_ROW
uniform sampler2D chosen;         // of each column: the star's index, its truncation radius, px, and transmission
uniform int       last_time;

#include "projection.glsl"

out vec4 projected;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec3 choice = texelFetch(chosen, ivec2(texel.x, 0), 0).rgb;
    int index = int(choice.x);
    vec4 star = texelFetch(stars, ivec2(index % STARS_PER_ROW, index / STARS_PER_ROW), 0);

    Observed seen = observed(star.xyz, min(texel.y, last_time));
    bool in_front = seen.in_camera.z > 1e-9;
    vec2 xy_px = target_position_px(seen.in_camera.xy / (in_front ? seen.in_camera.z : 1.0));
    // No refraction lifts a star above the horizon from 1 deg below it.
    float height = seen.sine_altitude < SINE_OF_LOWEST_ALTITUDE + sine_horizon ? min(seen.height, -1e-6) : seen.height;
    projected = texel.y > last_time ? vec4(star.w * choice.z, choice.y, 0.0, 0.0)
                                    : vec4(xy_px, height, in_front ? seen.in_camera.z : 0.0);
}
