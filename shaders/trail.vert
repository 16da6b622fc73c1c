#version 330 core

// What encloses the light of a star's way through one segment of the exposure: way.frag.
//
// SHAPE: 0, SHORT ways, a point each; 1, POINT ways and both ends of LONG ones, two points each; 2, what is between those
// ends, a quad.  Who lights a pixel of a long way is asked of where it lies along the
// way, for points are squares, and quads are rounded to a grid.

in uvec2 way;                     // star and segment

uniform sampler2D lines, forms, extents, edges;
uniform vec2  target_px;          // width and height of the target

#if SHAPE == 0
// As in way.frag; where s = p = 0 is at a pixel's centre as gl_FragCoord has it.
flat out vec4 line;
flat out vec4 form;
flat out vec2 amplitudes_dn;
#else
uniform float half_width_px;      // of the point spread at half its maximum: lengths are told in it

#if SHAPE == 1
flat out vec2 origin_px;          // where s = p = 0, as gl_FragCoord has it
#else
noperspective out vec2 place;     // s and p
#endif
flat out vec4 axes;               // how s and p change along x and y, 1/px
flat out vec4 form;               // see who lights it
flat out vec2 part;               // of s, which is lit
vec4 line;
#endif

const float SHORT = 1.0, POINT = 2.0, LONG = 3.0;   // way.frag
const float ALL_PX = 1e9;
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
const float GRID_PX = 1.0 / 256.0; // and corners on this one: what is interpolated between them is exact there

vec4 on_target(vec2 place_px) {
    return vec4(2.0 * (place_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}

void main() {
    ivec2 texel = ivec2(way);
    vec4 extent = texelFetch(extents, texel, 0);
    line = texelFetch(lines, texel, 0);
    form = texelFetch(forms, texel, 0);
    vec2 along = line.zw, across = vec2(-line.w, line.z);
    bool is_drawn;

#if SHAPE > 0
    vec4 before = texelFetch(edges, texel, 0), after = texelFetch(edges, texel + ivec2(0, 1), 0);
    bool begins = before.xy == before.zw, ends = after.xy == after.zw;
    // One that goes on is long, whatever the last digit of its length says.
    bool is_long = extent.w == LONG || !begins || !ends;
    float margin_px = min(extent.x, 0.5 * form.x);
    bool is_far = (gl_VertexID & 1) != 0;
    axes = vec4(along, across) / half_width_px;
#endif

#if SHAPE < 2
    vec2 low_px, high_px;
#if SHAPE == 0
    amplitudes_dn = extent.xy;
    is_drawn = extent.w == SHORT;
    low_px  = min(line.xy, line.zw) - extent.z;
    high_px = max(line.xy, line.zw) + extent.z;
#else
    is_drawn = is_long ? (is_far ? ends : begins) : extent.w == POINT && !is_far;
    part = is_long ? (is_far ? vec2(form.x - margin_px, ALL_PX) : vec2(-ALL_PX, margin_px)) : vec2(-ALL_PX, ALL_PX);
    vec2 to_end_px = form.x * along, at_bow_px = 0.5 * to_end_px + 0.25 * form.z * form.x * form.x * across;
    float middle_s = is_far ? form.x + 0.5 * (extent.x - margin_px) : 0.5 * (margin_px - extent.x);
    vec2 middle_px = middle_s * along + 0.5 * (extent.y + extent.z) * across;
    vec2 size_of_end_px = mat2(abs(along), abs(across)) * vec2(margin_px + extent.x, extent.z - extent.y);
    vec2 half_of_end_px = 0.5 * size_of_end_px + SNAPPING_PX;
    low_px  = line.xy + (is_long ? middle_px - half_of_end_px : min(min(vec2(0.0), to_end_px), at_bow_px) - extent.x);
    high_px = line.xy + (is_long ? middle_px + half_of_end_px : max(max(vec2(0.0), to_end_px), at_bow_px) + extent.x);
#endif
    // A point whose centre lies outside the target is not drawn at all: what is outside is cut off.
    low_px  = max(low_px, vec2(-0.5));
    high_px = min(high_px, target_px - 0.5);
    vec2 size_px = high_px - low_px;
    is_drawn = is_drawn && all(greaterThan(size_px, vec2(0.0)));
    vec2 centre_px = 0.5 * (low_px + high_px);
    gl_PointSize = is_drawn ? max(size_px.x, size_px.y) : 1.0;
    gl_Position = is_drawn ? on_target(centre_px) : vec4(2.0, 2.0, 2.0, 1.0);
#if SHAPE == 1
    origin_px = line.xy + 0.5;
    form = vec4(form.x / half_width_px, form.y, form.z * half_width_px, form.w);
#endif
#else
    bool is_high = (gl_VertexID & 2) != 0, goes_on = is_far ? !ends : !begins;
    is_drawn = is_long && form.x > 2.0 * margin_px;
    vec4 shared_px = is_far ? after : before;
    float s = is_far ? form.x - margin_px + 1.0 : margin_px - 1.0;
    vec2 own_px = line.xy + s * along + (is_high ? extent.z : extent.y) * across;
    vec2 corner_px = GRID_PX * round((goes_on ? (is_high ? shared_px.zw : shared_px.xy) : own_px) / GRID_PX);
    gl_Position = is_drawn ? on_target(corner_px) : vec4(2.0, 2.0, 2.0, 1.0);
    place = (corner_px - line.xy) * mat2(axes);
    part = vec2(begins ? margin_px : -ALL_PX, ends ? form.x - margin_px : ALL_PX);
    form = vec4(form.x / half_width_px, 2.0 * form.w * (1.0 - form.y), form.z * half_width_px,
                4.0 * form.w * form.y / form.x * half_width_px);
#endif
#if SHAPE == 0
    line += 0.5;
#else
    part /= half_width_px;
#endif
}
