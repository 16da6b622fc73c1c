#version 330 core

// One star in one segment of the exposure: a point sprite around the star's way, as wide as its light reaches, or, where
// that would be mostly empty, a quad along it.
//
// An instance is a segment; a star is one vertex as a point and four as a quad.  Within a segment a star's place is a
// quadratic of time, through its places at the segment's beginning, middle and end (glstar/trail.py says where an
// exposure is cut, so that this holds).
//
// SHAPE: 0, a short way as a point, of two Gaussians (trail_short.frag); 1, a longer one as a point, and 2, as a quad
// (trail.frag), of which a long one consists of two ends; 3, the quad between those (trail_between.frag).  Software OpenGL fills an upright square three times as fast as two slanted triangles (tests/bench).

uniform sampler2D places;         // of place.frag
uniform sampler2D moments;        // the first texel's fourth number: which share of the exposure the segment lasts
uniform int   last_moment;
uniform vec2  target_px;          // width and height of the target
uniform float sigma_px;
uniform float largest_point_px;
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that stands still for the whole exposure

#if SHAPE == 0
flat out vec4  centres_px;        // (x, y) of two Gaussians, in the target
flat out vec2  along;             // unit vector
flat out vec2  narrowing_per_px2; // how much less light falls off along the way, of the logarithm to base 2
flat out vec2  amplitudes_dn;
#else
flat out vec2  origin_px;         // where s = p = 0, in the target
flat out vec2  along;             // unit vector
flat out float length_px;         // of the way
flat out float steepness;         // at the way's end the star is so much slower than in its middle: -0.9 to 0.9
flat out float bow_per_px;        // the way is p = bow s (length - s)
flat out float amplitude_dn;
#endif

const int   VERTICES[4] = int[4](1, 1, 8, 4);
const float SHORT_SIGMA = 2.0, STEEPEST = 0.9;   // glstar/trail.py
// Two Gaussians at 1/2 -+ APART of an even way's time, each as wide as a way of time 1 with WIDTH less for variance,
// have its moments up to the seventh.
const float APART = 0.2540669, WIDTH = 0.0187834;
const float SLANTED_COST = 2.5;   // of a pixel of a slanted quad, in pixels of an upright square
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
const float LN_2 = 0.6931471805599453;
const float SQRT_HALF_PI = 1.2533141373155003;

vec4 place(int star, int moment) {
    return texelFetch(places, ivec2(star, moment), 0);
}

// The place in a share of the segment's time.
vec2 on_way(vec2 begin, vec2 middle, vec2 end, float u) {
    return begin + u * (4.0 * middle - 3.0 * begin - end + u * 2.0 * (begin - 2.0 * middle + end));
}

void main() {
    int star = gl_VertexID / VERTICES[SHAPE], first = 2 * gl_InstanceID;
    vec4 at_begin = place(star, first), at_middle = place(star, first + 1), at_end = place(star, first + 2);
    vec2 starlight = place(star, last_moment + 1).xy;
    float reach_px = starlight.y;
    float share = texelFetch(moments, ivec2(0, first), 0).w;

    // The horizon rises and sinks by 15" a second: in a segment a star crosses it once, at an even rate nearly.
    bool begins_up = at_begin.z >= 0.0, ends_up = at_end.z >= 0.0;
    bool early = begins_up != (at_middle.z >= 0.0);
    vec2 heights = early ? vec2(at_begin.z, at_middle.z) : vec2(at_middle.z, at_end.z);
    float crossing = begins_up == ends_up ? 0.0 : (early ? 0.0 : 0.5) + 0.5 * heights.x / (heights.x - heights.y);
    float rises = begins_up ? 0.0 : crossing, sets = ends_up ? 1.0 : crossing;
    bool unseen = !(begins_up || ends_up) || at_begin.w * at_middle.w * at_end.w == 0.0;
    vec2 begin  = on_way(at_begin.xy, at_middle.xy, at_end.xy, rises);
    vec2 middle = on_way(at_begin.xy, at_middle.xy, at_end.xy, 0.5 * (rises + sets));
    vec2 end    = on_way(at_begin.xy, at_middle.xy, at_end.xy, sets);
    begin = begins_up ? at_begin.xy : begin;
    end   = ends_up ? at_end.xy : end;

    vec2  chord = end - begin, ahead = middle - 0.5 * (begin + end);
    float chord_px = length(chord);
    bool is_short = chord_px < SHORT_SIGMA * sigma_px;
    float peak_dn = vmag_0_peak_dn * starlight.x * share * (sets - rises);
    vec2 low_px, high_px;
#if SHAPE == 0
    // At a turning point the way leads there and back: its axis is where it leads to.
    vec2  axis = chord_px > 2.0 * length(ahead) ? chord : ahead;
    along = length(axis) > 1e-6 * sigma_px ? normalize(axis) : vec2(1.0, 0.0);
    vec2  mean = begin + 0.5 * chord + ahead * (4.0 * (0.25 - APART * APART - WIDTH));
    vec2  apart = APART * chord;
    centres_px = vec4(mean - apart, mean + apart);
    vec2  rates_px = vec2(dot(chord, along)) + 8.0 * APART * dot(ahead, along) * vec2(1.0, -1.0);
    vec2  variances_px2 = sigma_px * sigma_px + WIDTH * rates_px * rates_px;
    narrowing_per_px2 = (0.5 / LN_2) * (1.0 / (sigma_px * sigma_px) - 1.0 / variances_px2);
    amplitudes_dn = 0.5 * peak_dn * sigma_px * inversesqrt(variances_px2);
    low_px  = mean - abs(apart) - reach_px - SNAPPING_PX;
    high_px = mean + abs(apart) + reach_px + SNAPPING_PX;
    bool as_point = true;
    unseen = unseen || !is_short;
#else
    along = chord / max(chord_px, 1e-9);
    vec2  across = vec2(-along.y, along.x);
    float ahead_px = dot(ahead, along), p_middle = dot(ahead, across);
    length_px = chord_px;
    steepness = clamp(4.0 * ahead_px / max(chord_px, 1e-9), -STEEPEST, STEEPEST);
    float x = clamp(0.5 + ahead_px / max(chord_px, 1e-9), 0.1, 0.9);
    float bow_px = p_middle / (4.0 * x * (1.0 - x));
    bow_per_px = 4.0 * bow_px / max(chord_px * chord_px, 1e-9);
    origin_px = begin + along * (ahead_px / 1.5 - steepness * chord_px / 6.0);
    amplitude_dn = peak_dn * sigma_px * SQRT_HALF_PI / max(length_px, 1e-9);

    vec2 to_end_px = length_px * along, to_bow_px = bow_px * across;
    low_px  = origin_px + min(min(vec2(0.0), to_end_px), 0.5 * to_end_px + to_bow_px) - reach_px - SNAPPING_PX;
    high_px = origin_px + max(max(vec2(0.0), to_end_px), 0.5 * to_end_px + to_bow_px) + reach_px + SNAPPING_PX;
    float side_px = max(high_px.x - low_px.x, high_px.y - low_px.y);
    float slanted = min(abs(bow_per_px) * length_px, 1.0) * reach_px;
    float low_p  = min(bow_px, 0.0) - reach_px - slanted;
    float high_p = max(bow_px, 0.0) + reach_px + slanted;
    bool as_point = side_px <= largest_point_px
        && side_px * side_px < SLANTED_COST * (length_px + 2.0 * reach_px) * (high_p - low_p);
    unseen = unseen || is_short;
#endif

#if SHAPE >= 2
    float margin_px = reach_px + slanted;
    bool is_long = length_px > 2.0 * margin_px;
#if SHAPE == 2
    bool is_end = (gl_VertexID & 4) != 0;
    unseen = unseen || as_point || (is_end && !is_long);
    float from_px = is_end ? length_px - margin_px : -margin_px;
    float to_px   = is_long && !is_end ? margin_px : length_px + margin_px;
#else
    unseen = unseen || as_point || !is_long;
    float from_px = margin_px, to_px = length_px - margin_px;
#endif
    float s = (gl_VertexID & 1) == 0 ? from_px : to_px;
    float p = (gl_VertexID & 2) == 0 ? low_p : high_p;
    vec2 corner_px = origin_px + s * along + p * across;
    gl_Position = unseen ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(2.0 * (corner_px + 0.5) / target_px - 1.0, 0.0, 1.0);
#else
    // A point whose centre lies outside the target is not drawn at all: what is outside is cut off.
    low_px  = max(low_px, vec2(-0.5));
    high_px = min(high_px, target_px - 0.5);
    vec2 size_px = high_px - low_px, centre_px = 0.5 * (low_px + high_px);
    unseen = unseen || !as_point || any(lessThanEqual(size_px, vec2(0.0)));
    gl_PointSize = unseen ? 1.0 : max(size_px.x, size_px.y);
    gl_Position = unseen ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(2.0 * (centre_px + 0.5) / target_px - 1.0, 0.0, 1.0);
#endif
}
