#version 330 core

// Light as a pinhole has it, gathered by the pixels behind a lens.
//
// What falls into a pixel's patch of the pinhole's plane is the pixel's: a lens moves light, it makes and loses none.
// Light between the pixels of the pinhole's is a cubic B-spline and a little of its second derivative, which together
// are nearest to a Gaussian (tests/gl/test_lens.py): wider than what they go through, by which stars were drawn narrower
// (glstar/render/opengl/distortionpass.py).  Stars were also drawn wider by a pixel on the axis; by how much the pixel's own patch is larger or
// smaller than that, more or less of the second derivatives is taken.  So one place tells the mean over a patch, and
// large ones are asked in several parts.

// PARTS_ACROSS, PARTS_DOWN: in how many parts along its sides a patch is asked; 0 if `parts` says it.

uniform sampler2D light;          // DN a pixel of the pinhole's
uniform float finer;              // how many of its pixels are one of the image, on the axis
uniform float pixel_px2;          // a pixel's own variance along a side; 0 if it does not integrate
#if PARTS_ACROSS > 0
const ivec2 parts = ivec2(PARTS_ACROSS, PARTS_DOWN);
#else
uniform ivec2 parts;
#endif

flat in vec3 middle_px;
flat in vec2 by_1;
flat in vec4 by_u_v;
flat in vec4 by_uu_vv;
flat in vec2 by_uv;
flat in vec4 by_uuv_uvv;
flat in vec2 by_uuvv;

out float light_dn;

const vec2 BEND_PX2 = vec2(0.095, 0.02);   // of the second derivative, everywhere and between pixels

// The weights of four pixels in a row for a place so far behind the second of them: of a cubic B-spline's value, its
// slope and its second derivative.
vec4 spline(float t) {
    float u = 1.0 - t, t2 = t * t, u2 = u * u;
    return vec4(u2 * u, 4.0 - 3.0 * t2 * (2.0 - t), 4.0 - 3.0 * u2 * (2.0 - u), t2 * t) / 6.0;
}

vec4 spline_slope(float t) {
    float u = 1.0 - t;
    return vec4(-u * u, t * (3.0 * t - 4.0), u * (4.0 - 3.0 * u), t * t) * 0.5;
}

vec4 spline_bend(float t) {
    float u = 1.0 - t;
    return vec4(u, 3.0 * t - 2.0, 3.0 * u - 2.0, t);
}

vec2 place_px(vec2 uv) {
    vec2 by_v = by_u_v.zw + uv.x * (by_uv + uv.x * by_uuv_uvv.xy);
    vec2 by_vv = by_uu_vv.zw + uv.x * (by_uuv_uvv.zw + uv.x * by_uuvv);
    return by_1 + uv.x * (by_u_v.xy + uv.x * by_uu_vv.xy) + uv.y * (by_v + uv.y * by_vv);
}

// How far the place goes with u and with v.
vec4 slopes_px(vec2 uv) {
    vec2 by_u = by_u_v.xy + 2.0 * uv.x * by_uu_vv.xy
        + uv.y * (by_uv + 2.0 * uv.x * by_uuv_uvv.xy + uv.y * (by_uuv_uvv.zw + 2.0 * uv.x * by_uuvv));
    vec2 by_v = by_u_v.zw + 2.0 * uv.y * by_uu_vv.zw
        + uv.x * (by_uv + 2.0 * uv.y * by_uuv_uvv.zw + uv.x * (by_uuv_uvv.xy + 2.0 * uv.y * by_uuvv));
    return vec4(by_u, by_v);
}

// The light at a place of the pinhole's, spread by half a covariance: along x, along y, and along both.
float light_at(vec2 at_px, vec3 spread_px2) {
    vec2 before = floor(at_px), behind = at_px - before;
    vec2 bend_px2 = spread_px2.xy + 0.5 * (BEND_PX2.x + BEND_PX2.y * behind * (1.0 - behind));
    vec4 across = spline(behind.x) + bend_px2.x * spline_bend(behind.x);
    vec4 down = spline(behind.y) + bend_px2.y * spline_bend(behind.y);
    vec4 across_slope = spline_slope(behind.x), down_slope = 2.0 * spread_px2.z * spline_slope(behind.y);
    // The same texels as texelFetch gives, in less time on software OpenGL.
    vec2 texel = 1.0 / vec2(textureSize(light, 0)), first = (before - 0.5) * texel;
    float sum = 0.0;
    for (int row = 0; row < 4; ++row) {
        vec2 place = first + vec2(0.0, float(row) * texel.y);
        vec4 lights = vec4(textureLod(light, place, 0.0).r,
                           textureLod(light, place + vec2(texel.x, 0.0), 0.0).r,
                           textureLod(light, place + vec2(2.0 * texel.x, 0.0), 0.0).r,
                           textureLod(light, place + vec2(3.0 * texel.x, 0.0), 0.0).r);
        sum += down[row] * dot(across, lights) + down_slope[row] * dot(across_slope, lights);
    }
    return sum;
}

void main() {
    vec2 uv = (gl_FragCoord.xy - middle_px.xy) * middle_px.z;
    vec4 side_px = slopes_px(uv) * middle_px.z / vec4(parts.xx, parts.yy);
    vec3 squares_px2 = vec3(dot(side_px.xz, side_px.xz), dot(side_px.yw, side_px.yw), dot(side_px.xz, side_px.yw));
    vec3 spread_px2 = 0.5 * pixel_px2 * (squares_px2 - vec3(finer * finer, finer * finer, 0.0));
    float sum = 0.0;
    for (int row = 0; row < parts.y; ++row) {
        for (int column = 0; column < parts.x; ++column) {
            vec2 inside_px = (vec2(column, row) + 0.5) / vec2(parts) - 0.5;
            sum += light_at(place_px(uv + inside_px * middle_px.z), spread_px2);
        }
    }
    light_dn = abs(side_px.x * side_px.w - side_px.y * side_px.z) * sum;
}
