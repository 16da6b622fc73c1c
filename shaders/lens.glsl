// From vectors in the camera frame to positions in the target: Camera.project and Camera.project_with_rates in float64.
//
// LENS: 0, a pinhole.  Otherwise a lens maps in two steps (glstar/camera/distortion.py): the angle from the axis to a
// distance from the axis, and the point at that distance to another point (Brown & Conrady, thin prism, tilted sensor).
// 1: the first distance is the tangent; 2: it is in the texture `lens_profile`, and there is no second step; 3: both.

uniform vec2  focal_px;           // fx, fy
uniform vec2  principal_px;       // cx, cy
uniform float skew_px;
uniform float guard_band_px;      // width of the border of the target around the image

// Position in the target, px, of a point in the image plane: of a pinhole, (x / z, y / z) of a vector.
vec2 target_position_px(vec2 point) {
    return focal_px * point + principal_px + vec2(skew_px * point.y, 0.0) + guard_band_px;
}

#if LENS
uniform float lens_limit;         // cosine of the largest angle from the axis that has a position

// Whether a vector has a position.  The vector 0 of unused texels has none.
bool is_in_view(vec3 in_camera) {
    return in_camera.z > lens_limit * length(in_camera);
}

struct LensPoint {
    vec2   px;                    // in the target
    mat3x2 per_vector;            // its derivatives with respect to the vector
};

#if LENS != 1
// Values g of point = g(s) (x, y) sqrt(2 / (1 + z)) of unit vectors, s = (1 - z) / 2, at even steps of s from 0, and their
// slopes, per step.
uniform sampler2D lens_profile;
uniform float lens_steps_per_s;

// Value and slope, per s, of the cubic Hermite spline.
vec2 profile_at(float s) {
    float at = s * lens_steps_per_s, before = clamp(floor(at), 0.0, float(textureSize(lens_profile, 0).x - 2));
    vec2 near = texelFetch(lens_profile, ivec2(int(before), 0), 0).rg;
    vec2 far = texelFetch(lens_profile, ivec2(int(before) + 1, 0), 0).rg;
    float t = min(at - before, 1.0), rise = far.x - near.x;
    vec2 bend = vec2(3.0 * rise - 2.0 * near.y - far.y, near.y + far.y - 2.0 * rise);
    return vec2(near.x + t * (near.y + t * (bend.x + t * bend.y)),
                lens_steps_per_s * (near.y + t * (2.0 * bend.x + 3.0 * t * bend.y)));
}
#endif

#if LENS != 2
uniform vec3 lens_k123, lens_k456;
uniform vec2 lens_p12;
uniform vec4 lens_s1234;
uniform mat3 lens_tilt;           // homography

// A point moved by the second step; per_point: its derivatives.
vec2 moved_by_lens(vec2 point, out mat2 per_point) {
    float q = dot(point, point);
    vec3 k = lens_k123, d = lens_k456;
    float over = 1.0 / (1.0 + q * (d.x + q * (d.y + q * d.z))), ratio = (1.0 + q * (k.x + q * (k.y + q * k.z))) * over;
    float slope = (k.x + q * (2.0 * k.y + 3.0 * q * k.z) - ratio * (d.x + q * (2.0 * d.y + 3.0 * q * d.z))) * over;
    vec2 swapped = lens_p12.yx, prism = lens_s1234.xz + q * lens_s1234.yw;
    float along = 2.0 * dot(swapped, point);
    // p1, p2 as a vector across the image: (p2, p1) q + 2 point (p2 x + p1 y).
    vec2 moved = ratio * point + swapped * q + along * point + q * prism;
    vec2 per_q = slope * point + swapped + prism + q * lens_s1234.yw;
    per_point = outerProduct(2.0 * per_q, point) + outerProduct(2.0 * point, swapped) + mat2(ratio + along);
    vec3 tilted = lens_tilt * vec3(moved, 1.0);
    moved = tilted.xy / tilted.z;
    mat2 plane = mat2(lens_tilt) - outerProduct(moved, vec2(lens_tilt[0].z, lens_tilt[1].z));
    per_point = plane * per_point / tilted.z;
    return moved;
}
#endif

// The position of a vector that is in view, and its derivatives.
LensPoint through_lens(vec3 v) {
    float n = length(v);
#if LENS == 1
    float scale = 1.0 / v.z;
    vec3 scale_per_v = vec3(0.0, 0.0, -scale * scale);
#else
    float scale = inversesqrt(0.5 * n * (n + v.z));
    vec3 scale_per_v = (-0.5 * scale * scale * scale) * ((1.0 + 0.5 * v.z / n) * v + vec3(0.0, 0.0, 0.5 * n));
#endif
    vec2 point = scale * v.xy;
    mat3x2 per_v = outerProduct(v.xy, scale_per_v);
    per_v[0].x += scale;
    per_v[1].y += scale;
#if LENS != 1
    vec2 profile = profile_at(0.25 * dot(point, point));
    per_v = profile.x * per_v + outerProduct(point, (0.5 * profile.y) * (point * per_v));
    point *= profile.x;
#endif
#if LENS != 2
    mat2 per_point;
    point = moved_by_lens(point, per_point);
    per_v = per_point * per_v;
#endif
    return LensPoint(target_position_px(point), mat2(focal_px.x, 0.0, skew_px, focal_px.y) * per_v);
}
#else
bool is_in_view(vec3 in_camera) {
    return in_camera.z > 1e-9;
}
#endif

// Position in the target, px, of a vector that is in view; of another one, any.
vec2 vector_position_px(vec3 in_camera) {
#if LENS
    return through_lens(in_camera).px;
#else
    return target_position_px(in_camera.xy / (is_in_view(in_camera) ? in_camera.z : 1.0));
#endif
}
