#version 330 core

// Trail pass: geometry that encloses the flux of one segment of a star's path.
//
// SHAPE: 0, SHORT segments, one point each; 1, POINT segments and both ends of LONG ones, two points each; 2, the middle of
// LONG segments between those ends, a quad.

// COMPONENTS: of star_path.frag.

in uvec2 segment;                 // column (star) and row (segment) of the path textures

uniform sampler2D chords, shapes, fluxes, joints, boundaries;   // of star_path.frag
uniform float half_width_px;      // half width at half maximum of the point spread function: unit of length in trail.frag

// Explained in trail_short.frag, trail.frag and trail_middle.frag.
flat out vec4 shape;
#if SHAPE == 0
flat out vec4 centres_px;
flat out vec2 amplitudes_dn;
#if COMPONENTS
flat out float falloff_per_px2;
#endif
#else
flat out vec4 axes;
flat out vec4 owned;
#endif
#if SHAPE == 1
flat out vec2 across;
flat out vec2 origin_px;
flat out vec3 flux;
#elif SHAPE == 2
flat out vec4 flux;
noperspective out vec2 position;
#endif

const float UNBOUNDED = 1e9;
const float TILT = 2e-3;          // rounding error of the direction of the boundary axis, rad
const float GRID_PX = 1.0 / 256.0;  // corners of quads lie on this grid: what is interpolated between them is exact there

#include "trail_constants.glsl"
#include "rasterization.glsl"
#include "target.glsl"

#if MOSAIC
uniform sampler2D tints_of_stars; // by column
flat out vec4 tints;              // mosaic.glsl
#endif

void main() {
    ivec2 texel = ivec2(segment);
#if MOSAIC
    tints = texelFetch(tints_of_stars, ivec2(texel.x, 0), 0);
#endif
    vec4 chord = texelFetch(chords, texel, 0), path = texelFetch(shapes, texel, 0), profile = texelFetch(fluxes, texel, 0);
    bool is_drawn;

#if SHAPE == 0
    centres_px = chord + 0.5;
    shape = path;
    amplitudes_dn = profile.xy;
#if COMPONENTS
    falloff_per_px2 = texelFetch(joints, texel, 0).x;
#endif
    is_drawn = profile.w == SHORT
        && is_point_over(min(chord.xy, chord.zw) - profile.z, max(chord.xy, chord.zw) + profile.z);
#else
    vec4 boundary = texelFetch(boundaries, texel, 0);
    vec4 before = texelFetch(joints, texel, 0), after = texelFetch(joints, texel + ivec2(0, 1), 0);
    bool begins = before.xy == before.zw, ends = after.xy == after.zw;
    // A segment that continues is LONG, whatever the rounding of its length.
    bool is_long = profile.w == LONG || !begins || !ends, is_far = (gl_VertexID & 1) != 0;
    vec2 start_px = chord.xy, along = chord.zw, normal = vec2(-along.y, along.x);
    float length_px = path.x, curvature = path.y, asymmetry = path.z, amplitude_dn = path.w;
    float flux_slope = profile.y, flux_curvature = profile.z;
    float length = length_px / half_width_px, sagitta_px = 0.25 * curvature * length_px;
    float margin_px = min(profile.x, 0.5 * length_px);
    vec2 across_px = vec2(min(sagitta_px, 0.0) - profile.x, max(sagitta_px, 0.0) + profile.x);
    axes = vec4(along, normal) / half_width_px;
#endif

#if SHAPE == 1
    vec2 to_end_px = length_px * along;
    vec2 apex_px = 0.5 * to_end_px + sagitta_px * normal;
    float middle_s = is_far ? length_px + 0.5 * (profile.x - margin_px) : 0.5 * (margin_px - profile.x);
    vec2 middle_px = middle_s * along + 0.5 * (across_px.x + across_px.y) * normal;
    float width_px = across_px.y - across_px.x;
    vec2 size_px = mat2(abs(along), abs(normal)) * vec2(margin_px + profile.x + TILT * width_px, width_px);
    vec2 half_px = 0.5 * size_px + SNAPPING_PX;
    vec2 low_px  = is_long ? middle_px - half_px : min(min(vec2(0.0), to_end_px), apex_px) - profile.x;
    vec2 high_px = is_long ? middle_px + half_px : max(max(vec2(0.0), to_end_px), apex_px) + profile.x;
    owned = vec4(boundary.xy, is_long && is_far ? boundary.w : -UNBOUNDED,
                 is_long && !is_far ? boundary.z : UNBOUNDED);
    // A point is wider than the adjacent quad, and must not draw more of the flux than the quad does.
    across = is_long ? across_px / half_width_px : vec2(-UNBOUNDED, UNBOUNDED);
    origin_px = start_px + 0.5;
    shape = vec4(length, 1.0 / length, curvature, asymmetry);
    flux = vec3(flux_slope, flux_curvature, amplitude_dn);
    is_drawn = (is_long ? (is_far ? ends : begins) : profile.w == POINT && !is_far)
        && is_point_over(start_px + low_px, start_px + high_px);
#elif SHAPE == 2
    bool is_high = is_high_corner(gl_VertexID, along), continues = is_far ? !ends : !begins;
    vec4 joint_px = is_far ? after : before;
    float s = is_far ? length_px - margin_px + 1.0 : margin_px - 1.0;
    vec2 own_px = start_px + s * along + (is_high ? across_px.y : across_px.x) * normal;
    vec2 corner_px = GRID_PX * round((continues ? (is_high ? joint_px.zw : joint_px.xy) : own_px) / GRID_PX);
    gl_Position = clip_position(corner_px);
    owned = vec4(boundary.xy, begins ? boundary.z : -UNBOUNDED, ends ? boundary.w : UNBOUNDED);
    position = (corner_px - start_px) * mat2(axes);
    float start_dn = 2.0 * amplitude_dn * (1.0 - flux_slope + 0.6666667 * flux_curvature);
    float slope_dn = 4.0 * amplitude_dn / length * (flux_slope - 2.0 * flux_curvature);
    flux = vec4(start_dn, slope_dn, 8.0 * amplitude_dn / (length * length) * flux_curvature,
                curvature / length * (slope_dn * length - start_dn));
    shape = vec4(curvature - asymmetry, (3.0 * asymmetry - curvature) / length, -2.0 * asymmetry / (length * length),
                 -3.0 * curvature / length * slope_dn);
    is_drawn = is_long && length_px > 2.0 * margin_px;
#endif

    // A clipped primitive would send all of the call through a slower part of llvmpipe.  This one lies in a corner of the
    // clip volume: a quad has no area, a point is dark.
    if (!is_drawn) {
        gl_Position = vec4(-1.0, -1.0, 0.0, 1.0);
        gl_PointSize = 1.0;
#if SHAPE == 0
        amplitudes_dn = vec2(0.0);
#else
        owned = vec4(0.0, 0.0, 1.0, 0.0);
#endif
    }
}
