#version 330 core

// What encloses the light of a star's way through one segment of the exposure: way.frag.
//
// SHAPE: 0, SHORT ways, a point each; 1, POINT ways and both ends of LONG ones, two points each; 2, what is between those
// ends, a quad.

in uvec2 way;                     // star and segment

uniform sampler2D lines, forms, extents, edges, bounds;
uniform vec2  target_px;          // width and height of the target
uniform float half_width_px;      // of the point spread at half its maximum: what lights long ways tells lengths in it

// For trail_short.frag, trail.frag and trail_between.frag, where it is said what these are.
flat out vec4 form;
#if SHAPE == 0
flat out vec4 line;
flat out vec2 amplitudes_dn;
#else
flat out vec4 axes;
flat out vec4 owned;
#endif
#if SHAPE == 1
flat out vec2 beside;
flat out vec2 origin_px;
flat out vec3 light;
#elif SHAPE == 2
flat out vec4 light;
noperspective out vec2 place;
#endif

const float SHORT = 1.0, POINT = 2.0, LONG = 3.0;   // way.frag
const float ALL = 1e9;            // no bound
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
const float TILT = 2e-3;          // of the axis of `bounds`, whose components are rounded, rad
const float GRID_PX = 1.0 / 256.0;  // and corners on this one: what is interpolated between them is exact there

vec4 on_target(vec2 place_px) {
    return vec4(2.0 * (place_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}

// A point that covers a rectangle; what of it lies outside the target is cut off, for a point whose centre does is not
// drawn at all.  Returns whether anything is left.
bool is_point_over(vec2 low_px, vec2 high_px) {
    low_px  = max(low_px, vec2(-0.5));
    high_px = min(high_px, target_px - 0.5);
    vec2 size_px = high_px - low_px;
    gl_PointSize = max(max(size_px.x, size_px.y), 1.0);
    gl_Position = on_target(0.5 * (low_px + high_px));
    return all(greaterThan(size_px, vec2(0.0)));
}

void main() {
    ivec2 texel = ivec2(way);
    vec4 found = texelFetch(lines, texel, 0), shape = texelFetch(forms, texel, 0), extent = texelFetch(extents, texel, 0);
    bool is_drawn;

#if SHAPE == 0
    line = found + 0.5;
    form = shape;
    amplitudes_dn = extent.xy;
    is_drawn = extent.w == SHORT
        && is_point_over(min(found.xy, found.zw) - extent.z, max(found.xy, found.zw) + extent.z);
#else
    vec4 bound = texelFetch(bounds, texel, 0);
    vec4 before = texelFetch(edges, texel, 0), after = texelFetch(edges, texel + ivec2(0, 1), 0);
    bool begins = before.xy == before.zw, ends = after.xy == after.zw;
    // One that goes on is long, whatever the last digit of its length says.
    bool is_long = extent.w == LONG || !begins || !ends, is_far = (gl_VertexID & 1) != 0;
    vec2 begin_px = found.xy, along = found.zw, across = vec2(-along.y, along.x);
    float length_px = shape.x, bow = shape.y, skew = shape.z, amplitude_dn = shape.w;
    float steepness = extent.y, hollow = extent.z;
    float length = length_px / half_width_px, bow_px = 0.25 * bow * length_px;
    float margin_px = min(extent.x, 0.5 * length_px);
    vec2 beside_px = vec2(min(bow_px, 0.0) - extent.x, max(bow_px, 0.0) + extent.x);
    axes = vec4(along, across) / half_width_px;
#endif

#if SHAPE == 1
    vec2 to_end_px = length_px * along;
    vec2 at_bow_px = 0.5 * to_end_px + bow_px * across;
    float middle_s = is_far ? length_px + 0.5 * (extent.x - margin_px) : 0.5 * (margin_px - extent.x);
    vec2 middle_px = middle_s * along + 0.5 * (beside_px.x + beside_px.y) * across;
    float width_px = beside_px.y - beside_px.x;
    vec2 size_px = mat2(abs(along), abs(across)) * vec2(margin_px + extent.x + TILT * width_px, width_px);
    vec2 half_px = 0.5 * size_px + SNAPPING_PX;
    vec2 low_px  = is_long ? middle_px - half_px : min(min(vec2(0.0), to_end_px), at_bow_px) - extent.x;
    vec2 high_px = is_long ? middle_px + half_px : max(max(vec2(0.0), to_end_px), at_bow_px) + extent.x;
    owned = vec4(bound.xy, is_long && is_far ? bound.w : -ALL, is_long && !is_far ? bound.z : ALL);
    // A point is wider than the quad it goes on as, and no more of the light may be left.
    beside = is_long ? beside_px / half_width_px : vec2(-ALL, ALL);
    origin_px = begin_px + 0.5;
    form = vec4(length, 1.0 / length, bow, skew);
    light = vec3(steepness, hollow, amplitude_dn);
    is_drawn = (is_long ? (is_far ? ends : begins) : extent.w == POINT && !is_far)
        && is_point_over(begin_px + low_px, begin_px + high_px);
#elif SHAPE == 2
    bool is_high = (gl_VertexID & 2) != 0, goes_on = is_far ? !ends : !begins;
    vec4 shared_px = is_far ? after : before;
    float s = is_far ? length_px - margin_px + 1.0 : margin_px - 1.0;
    vec2 own_px = begin_px + s * along + (is_high ? beside_px.y : beside_px.x) * across;
    vec2 corner_px = GRID_PX * round((goes_on ? (is_high ? shared_px.zw : shared_px.xy) : own_px) / GRID_PX);
    gl_Position = on_target(corner_px);
    owned = vec4(bound.xy, begins ? bound.z : -ALL, ends ? bound.w : ALL);
    place = (corner_px - begin_px) * mat2(axes);
    float first_dn = 2.0 * amplitude_dn * (1.0 - steepness + 0.6666667 * hollow);
    float gained_dn = 4.0 * amplitude_dn / length * (steepness - 2.0 * hollow);
    light = vec4(first_dn, gained_dn, 8.0 * amplitude_dn / (length * length) * hollow,
                 bow / length * (gained_dn * length - first_dn));
    form = vec4(bow - skew, (3.0 * skew - bow) / length, -2.0 * skew / (length * length), -3.0 * bow / length * gained_dn);
    is_drawn = is_long && length_px > 2.0 * margin_px;
#endif

    if (!is_drawn)
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}
