#version 330 core

// What encloses the light of a star's way through one segment of the exposure: way.frag.
//
// An instance is a segment; a star is one vertex as a point and four a quad.  SHAPE: 0, SHORT ways; 1, POINT ways; 2,
// WHOLE ways and the ends of LONG ones; 3, what is between those.

uniform sampler2D lines, forms, extents, edges;
uniform vec2  target_px;          // width and height of the target

// As in way.frag; where s = p = 0 is at a pixel's centre as gl_FragCoord has it.
flat out vec4 line;
flat out vec4 form;
#if SHAPE == 0
flat out vec2 amplitudes_dn;
#endif

const float SHORT = 1.0, POINT = 2.0, WHOLE = 3.0, LONG = 4.0;   // way.frag
const int   VERTICES[4] = int[4](1, 1, 8, 4);

vec4 on_target(vec2 place_px) {
    return vec4(2.0 * (place_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}

void main() {
    ivec2 texel = ivec2(gl_VertexID / VERTICES[SHAPE], gl_InstanceID);
    vec4 extent = texelFetch(extents, texel, 0);
    line = texelFetch(lines, texel, 0);
    form = texelFetch(forms, texel, 0);
    bool is_drawn;
#if SHAPE < 2
#if SHAPE == 0
    amplitudes_dn = extent.xy;
    is_drawn = extent.w == SHORT;
    vec2 low_px  = min(line.xy, line.zw) - extent.z, high_px = max(line.xy, line.zw) + extent.z;
#else
    is_drawn = extent.w == POINT;
    vec2 to_end_px = form.x * line.zw, across = vec2(-line.w, line.z);
    vec2 at_bow_px = 0.5 * to_end_px + 0.25 * form.z * form.x * form.x * across;
    vec2 low_px  = line.xy + min(min(vec2(0.0), to_end_px), at_bow_px) - extent.x;
    vec2 high_px = line.xy + max(max(vec2(0.0), to_end_px), at_bow_px) + extent.x;
#endif
    // A point whose centre lies outside the target is not drawn at all: what is outside is cut off.
    low_px  = max(low_px, vec2(-0.5));
    high_px = min(high_px, target_px - 0.5);
    vec2 size_px = high_px - low_px;
    is_drawn = is_drawn && all(greaterThan(size_px, vec2(0.0)));
    gl_PointSize = is_drawn ? max(size_px.x, size_px.y) : 1.0;
    gl_Position = is_drawn ? on_target(0.5 * (low_px + high_px)) : vec4(2.0, 2.0, 2.0, 1.0);
#else
    vec4 before = texelFetch(edges, texel, 0), after = texelFetch(edges, texel + ivec2(0, 1), 0);
    bool begins = before.xy == before.zw, ends = after.xy == after.zw;
    // One that goes on is long, whatever the last digit of its length says.
    bool is_long = extent.w == LONG || !begins || !ends;
    float margin_px = extent.x;
    bool is_far = (gl_VertexID & 1) != 0, is_high = (gl_VertexID & 2) != 0;
#if SHAPE == 2
    bool is_end = (gl_VertexID & 4) != 0;
    is_drawn = is_long ? (is_end ? ends : begins) : (extent.w == WHOLE && !is_end);
    float from_px = is_end ? form.x - margin_px : -margin_px;
    float to_px   = is_long && !is_end ? margin_px : form.x + margin_px;
#else
    is_drawn = is_long;
    float from_px = margin_px, to_px = form.x - margin_px;
#endif
    vec2 across = vec2(-line.w, line.z);
    vec2 corner_px = line.xy + (is_far ? to_px : from_px) * line.zw + (is_high ? extent.z : extent.y) * across;
#if SHAPE == 3
    vec4 shared_px = is_far ? after : before;
    corner_px = (is_far ? ends : begins) ? corner_px : (is_high ? shared_px.zw : shared_px.xy);
#endif
    gl_Position = is_drawn ? on_target(corner_px) : vec4(2.0, 2.0, 2.0, 1.0);
#endif
#if SHAPE == 3
    // What of the form trail_between.frag asks for.
    float per_px = 2.0 * form.w * (2.0 * form.y / form.x);
    form = vec4(form.x, 2.0 * form.w * (1.0 - form.y), form.z, per_px);
#endif
#if SHAPE > 0
    line.xy += 0.5;
#else
    line += 0.5;
#endif
}
