#version 330 core

// Distortion pass: resamples the undistorted signal into the pixels behind a lens.
//
// A pixel receives what falls into its patch of the undistorted plane: a lens preserves flux.  The signal between pixels is
// a cubic B-spline plus a small fraction of its second derivative, which together are closest to a Gaussian
// (tests/gl/test_lens.py).  They widen the signal, so stars are drawn narrower beforehand (passes/lensdistortion.py).  Stars are
// also drawn wider by the area of a pixel on the axis, or of a part of one; the coefficient of the second derivatives
// accounts for the difference between that and the pixel's own patch.  Thus one sample is the mean over a patch, and large
// patches, and those of narrow stars, take several.

// PARTS_ACROSS, PARTS_DOWN: number of samples along the sides of a patch; 0 if `parts` holds it.
// MOSAIC: 1 to draw the pixels of one colour only.

uniform sampler2D light;          // DN per pixel of the undistorted signal
uniform float pixel_px2;          // variance of a pixel along a side; 0 if it does not integrate
uniform float drawn_pixel_px;     // side of the pixel, or part of one, by whose variance stars are drawn wider
#if PARTS_ACROSS > 0
const ivec2 parts = ivec2(PARTS_ACROSS, PARTS_DOWN);
#else
uniform ivec2 parts;
#endif

#if MOSAIC
uniform vec4 is_drawn;            // 1 for pixels (even column, even row), (odd, even), (even, odd), (odd, odd); or 0
#endif

flat in vec3 centre_px;
flat in vec2 by_1;
flat in vec4 by_u_v;
flat in vec4 by_uu_vv;
flat in vec2 by_uv;
flat in vec4 by_uuv_uvv;
flat in vec2 by_uuvv;

out float light_dn;

const vec2 CURVATURE_PX2 = vec2(0.0637, 0.005);   // coefficient of the second derivative: everywhere, and between pixels

// Weights of four pixels in a row at a fractional position behind the second of them: value, first and second derivative
// of a cubic B-spline.
vec4 spline(float t) {
    float u = 1.0 - t, t2 = t * t, u2 = u * u;
    return vec4(u2 * u, 4.0 - 3.0 * t2 * (2.0 - t), 4.0 - 3.0 * u2 * (2.0 - u), t2 * t) / 6.0;
}

vec4 spline_slope(float t) {
    float u = 1.0 - t;
    return vec4(-u * u, t * (3.0 * t - 4.0), u * (4.0 - 3.0 * u), t * t) * 0.5;
}

vec4 spline_curvature(float t) {
    float u = 1.0 - t;
    return vec4(u, 3.0 * t - 2.0, 3.0 * u - 2.0, t);
}

vec2 position_px(vec2 uv) {
    vec2 by_v = by_u_v.zw + uv.x * (by_uv + uv.x * by_uuv_uvv.xy);
    vec2 by_vv = by_uu_vv.zw + uv.x * (by_uuv_uvv.zw + uv.x * by_uuvv);
    return by_1 + uv.x * (by_u_v.xy + uv.x * by_uu_vv.xy) + uv.y * (by_v + uv.y * by_vv);
}

// Derivatives of the position with respect to u and v.
vec4 slopes_px(vec2 uv) {
    vec2 by_u = by_u_v.xy + 2.0 * uv.x * by_uu_vv.xy
        + uv.y * (by_uv + 2.0 * uv.x * by_uuv_uvv.xy + uv.y * (by_uuv_uvv.zw + 2.0 * uv.x * by_uuvv));
    vec2 by_v = by_u_v.zw + 2.0 * uv.y * by_uu_vv.zw
        + uv.x * (by_uv + 2.0 * uv.y * by_uuv_uvv.zw + uv.x * (by_uuv_uvv.xy + 2.0 * uv.y * by_uuvv));
    return vec4(by_u, by_v);
}

// The undistorted signal at a position, blurred by half a covariance: along x, along y, and mixed.
float light_at(vec2 at_px, vec3 half_covariance_px2) {
    vec2 before = floor(at_px), behind = at_px - before;
    vec2 curvature_px2 = half_covariance_px2.xy
        + 0.5 * (CURVATURE_PX2.x + CURVATURE_PX2.y * behind * (1.0 - behind));
    vec4 across = spline(behind.x) + curvature_px2.x * spline_curvature(behind.x);
    vec4 down = spline(behind.y) + curvature_px2.y * spline_curvature(behind.y);
    vec4 across_slope = spline_slope(behind.x), down_slope = 2.0 * half_covariance_px2.z * spline_slope(behind.y);
    // The same texels as texelFetch returns, in less time on software OpenGL.
    vec2 texel = 1.0 / vec2(textureSize(light, 0)), first = (before - 0.5) * texel;
    float sum = 0.0;
    for (int row = 0; row < 4; ++row) {
        vec2 left = first + vec2(0.0, float(row) * texel.y);
        vec4 lights = vec4(textureLod(light, left, 0.0).r,
                           textureLod(light, left + vec2(texel.x, 0.0), 0.0).r,
                           textureLod(light, left + vec2(2.0 * texel.x, 0.0), 0.0).r,
                           textureLod(light, left + vec2(3.0 * texel.x, 0.0), 0.0).r);
        sum += down[row] * dot(across, lights) + down_slope[row] * dot(across_slope, lights);
    }
    return sum;
}

void main() {
#if MOSAIC
    vec2 odd = 2.0 * fract(0.5 * (gl_FragCoord.xy - 0.5));
    vec2 of_row = mix(is_drawn.xy, is_drawn.zw, odd.y);
    if (mix(of_row.x, of_row.y, odd.x) < 0.5)
        discard;
#endif
    vec2 uv = (gl_FragCoord.xy - centre_px.xy) * centre_px.z;
    vec4 side_px = slopes_px(uv) * centre_px.z / vec4(parts.xx, parts.yy);
    vec3 squares_px2 = vec3(dot(side_px.xz, side_px.xz), dot(side_px.yw, side_px.yw), dot(side_px.xz, side_px.yw));
    vec3 half_covariance_px2 = 0.5 * pixel_px2 * (squares_px2 - drawn_pixel_px * drawn_pixel_px * vec3(1.0, 1.0, 0.0));
    float sum = 0.0;
    for (int row = 0; row < parts.y; ++row) {
        for (int column = 0; column < parts.x; ++column) {
            vec2 inside_px = (vec2(column, row) + 0.5) / vec2(parts) - 0.5;
            sum += light_at(position_px(uv + inside_px * centre_px.z), half_covariance_px2);
        }
    }
    light_dn = abs(side_px.x * side_px.w - side_px.y * side_px.z) * sum;
}
