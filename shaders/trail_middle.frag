#version 330 core

// Trail pass: flux of a LONG segment at one pixel far from both of its ends, where the error functions of trail.frag have
// reached their limits.

noperspective in vec2 position;   // s and p, in half widths: trail.frag
flat in vec4 axes;                // derivatives of s and p with respect to x and y, 1/px
flat in vec4 shape;               // p on the path: coefficients of s, s^2 and s^3; and see flux
flat in vec4 flux;                // coefficients of 1, s and s^2, DN; then of p, and in shape.w that of p s
flat in vec4 owned;               // trail.frag

out float light_dn;

#include "pixel_kernel.glsl"
#include "mosaic.glsl"

float flux_at(vec2 position) {
    float s = position.x, distance = position.y - s * (shape.x + s * (shape.y + s * shape.z));
    // How s and the length of path nearby change with the distance from the path: to first order of its curvature and
    // second order of its slope.
    float off_path_dn = flux.w + s * shape.w, slope = shape.x + 2.0 * s * shape.y, slope2 = slope * slope;
    float on_path_dn = flux.x + s * (flux.y + s * flux.z);
    return exp2(distance * distance * (slope2 - 1.0)) * ((1.0 - 0.5 * slope2) * on_path_dn + distance * off_path_dn);
}

void main() {
    float along = dot(owned.xy, gl_FragCoord.xy);
    bool is_owned = along >= owned.z && along < owned.w;
    float flux_dn = flux_in_pixel(position, mat2(axes));
    light_dn = in_mosaic(is_owned ? flux_dn : 0.0);
}
