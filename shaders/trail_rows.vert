#version 330 core

// Trail pass under a rolling shutter: geometry of the segments during which a row that the star lights opens or closes
// (PARTLY_OPEN of star_path.frag).
//
// SHAPE: 0, SHORT segments, a point; 1, POINT segments, a point; 2, LONG segments, a quad over that part of the path during
// which any row is open.  A segment is one primitive: the limits of its integral (trail.frag) divide the flux between
// segments, so that primitives may overlap.

// COMPONENTS: of star_path.frag.

in uvec2 segment;                 // column (star) and row (segment) of the path textures

uniform sampler2D chords, shapes, fluxes, openings_of_paths;      // of star_path.frag
#if COMPONENTS
uniform sampler2D joints;
flat out float falloff_per_px2, sigma_px;
#endif
uniform float half_width_px;      // half width at half maximum of the point spread function: unit of length in trail.frag

flat out vec2 clock;
#if SHAPE == 0
flat out vec4 path_px;
flat out vec2 ahead_px;
flat out float amplitude_dn;
#else
flat out vec4 axes;
flat out vec2 origin_px;
flat out vec4 shape;
flat out vec3 flux;
#endif

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
    vec4 times = texelFetch(openings_of_paths, texel, 0);
    bool is_drawn;
    clock = times.xy;

#if SHAPE == 0
    path_px = vec4(chord.xy + 0.5, chord.zw);
    ahead_px = path.xy;
    amplitude_dn = profile.x;
#if COMPONENTS
    vec4 width = texelFetch(joints, texel, 0);
    falloff_per_px2 = width.x;
    sigma_px = width.y;
#endif
    vec2 end_px = chord.xy + chord.zw, middle_px = chord.xy + 0.5 * chord.zw + path.xy;
    vec2 low_px = min(min(chord.xy, end_px), middle_px), high_px = max(max(chord.xy, end_px), middle_px);
    is_drawn = profile.w == SHORT + PARTLY_OPEN && is_point_over(low_px - profile.z, high_px + profile.z);
#else
    vec2 start_px = chord.xy, along = chord.zw, normal = vec2(-along.y, along.x);
    float length_px = path.x, curvature = path.y, asymmetry = path.z, amplitude = path.w;
    float length = length_px / half_width_px, sagitta_px = 0.25 * curvature * length_px;
    axes = vec4(along, normal) / half_width_px;
    origin_px = start_px + 0.5;
    shape = vec4(length, 1.0 / length, curvature, asymmetry);
    flux = vec3(profile.yz, amplitude);
#endif

#if SHAPE == 1
    vec2 to_end_px = length_px * along, apex_px = 0.5 * to_end_px + sagitta_px * normal;
    vec2 low_px = min(min(vec2(0.0), to_end_px), apex_px), high_px = max(max(vec2(0.0), to_end_px), apex_px);
    is_drawn = profile.w == POINT + PARTLY_OPEN
        && is_point_over(start_px + low_px - profile.x, start_px + high_px + profile.x);
#elif SHAPE == 2
    bool is_far = (gl_VertexID & 1) != 0, is_high = is_high_corner(gl_VertexID, along);
    float s = is_far ? times.w * length_px + profile.x : times.z * length_px - profile.x;
    float p = is_high ? max(sagitta_px, 0.0) + profile.x : min(sagitta_px, 0.0) - profile.x;
    gl_Position = clip_position(start_px + s * along + p * normal);
    is_drawn = profile.w == LONG + PARTLY_OPEN && times.w > times.z;
#endif

    if (!is_drawn)
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}
