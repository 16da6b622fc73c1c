#version 330 core

// From the places of stars to their ways: a column is a star, a row a segment of the exposure.
//
// Within a segment a star's place is a quadratic of time, through its places at the segment's beginning, middle and end
// (glstar/trail.py says where an exposure is cut, so that this holds).  What is drawn of it is one of four kinds:
//
// NOTHING  it is behind the camera or under the horizon
// SHORT    two Gaussians (trail_short.frag), as a point sprite
// POINT    a bent way run with even acceleration (trail.frag), as a point sprite: an upright square is filled three
//          times as fast by software OpenGL as two slanted triangles (tests/bench)
// LONG     the same, as a point sprite for each end (trail.frag), and between those, where erf has come to its end, as
//          a quad (trail_between.frag)
//
// Light farther from the way than what is drawn of it is given back to what is left: a fast trail is drawn narrow.
//
// Where a long way goes on into the next as if nothing had happened, neither has an end: they meet in an edge across,
// whose corners both read from `edge`, so that no pixel lies in both or in none.

uniform sampler2D places;         // of place.frag
uniform sampler2D moments;        // the first texel's fourth number: which share of the exposure the segment lasts
uniform int   last_moment;
uniform float sigma_px;           // of the Gaussian that is swept
uniform float drawn_sigma_px;     // and of what is drawn, which pixels widen
uniform float largest_point_px;
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that stands still for the whole exposure

layout(location = 0) out vec4 line;    // origin (x, y) in the target, px, where s = p = 0; unit vector along s
layout(location = 1) out vec4 form;    // length, px; steepness; bow, 1/px; amplitude, DN
layout(location = 2) out vec4 extent;  // what trail.vert needs to enclose it, px; its kind
layout(location = 3) out vec4 edge;    // both corners of the edge where the way begins, px; the same twice: an end
// The way is p = bow s (length - s), and its light per length 1 + steepness (2 s / length - 1).
// SHORT: line is the centres (x, y) of two Gaussians, form a unit vector along and how much less light falls off along
// it, of the logarithm to base 2, in 1/px^2; extent has their amplitudes.

const float NOTHING = 0.0, SHORT = 1.0, POINT = 2.0, LONG = 3.0;   // trail.vert
const float SHORT_SIGMA = 2.0, STEEPEST = 0.9;   // glstar/trail.py
// Two Gaussians at 1/2 -+ APART of an even way's time, each as wide as a way of time 1 with WIDTH less for variance,
// have its moments up to the seventh.
const float APART = 0.2540669, WIDTH = 0.0187834;
const float SLANTED_COST = 2.5;   // of a pixel of a slanted quad, in pixels of an upright square
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
// So much may two ways differ where they meet without an end: in light, and in direction, rad.
const float UNEVEN = 2e-3, KINKED = 5e-3;
const float LN_2 = 0.6931471805599453;
const float SQRT_HALF_PI = 1.2533141373155003;
const float INV_SQRT_2_PI = 0.3989422804014327;

struct Way {
    vec4 line, form, extent;
    float kind;
    float bow_px;                 // how far it bends to the right of s, at its farthest
    vec2 begin_px, end_px;        // on the image
};

vec4 place(int star, int moment) {
    return texelFetch(places, ivec2(star, moment), 0);
}

// The place in a share of the segment's time.
vec2 on_way(vec2 begin, vec2 middle, vec2 end, float u) {
    return begin + u * (4.0 * middle - 3.0 * begin - end + u * 2.0 * (begin - 2.0 * middle + end));
}

// What share of a Gaussian's light lies farther to one side than this, and what follows a way so much longer if that
// is summed all along it: Abramowitz & Stegun 26.2.16, to 1e-5.
vec2 beyond(float away_px) {
    float z = away_px / drawn_sigma_px, density = INV_SQRT_2_PI * exp(-0.5 * z * z), t = 1.0 / (1.0 + 0.33267 * z);
    float share = density * t * (0.4361836 + t * (-0.1201676 + t * 0.9372980));
    return vec2(share, density - z * share);
}

// The share of a way's light that is left between two bounds along an axis, both as far from the way's ends.
float share_within(float away_px, float extent_px) {
    float extent = max(extent_px / drawn_sigma_px, 0.1);
    return 1.0 - 2.0 * (beyond(away_px).y - beyond(away_px + extent * drawn_sigma_px).y) / extent;
}

// The share that a square leaves of a way which it encloses.
float share_in_square(float side_px, vec2 extent_px) {
    vec2 away_px = 0.5 * (side_px - extent_px);
    return share_within(away_px.x, extent_px.x) * share_within(away_px.y, extent_px.y);
}

// As two Gaussians.
void shorten(inout Way way, vec2 chord, vec2 ahead, float peak_dn, float reach_px) {
    // At a turning point the way leads there and back: its axis is where it leads to.
    vec2 axis = length(chord) > 2.0 * length(ahead) ? chord : ahead;
    vec2 along = length(axis) > 1e-6 * sigma_px ? normalize(axis) : vec2(1.0, 0.0);
    vec2 mean = way.begin_px + 0.5 * chord + ahead * (4.0 * (0.25 - APART * APART - WIDTH));
    vec2 rates_px = vec2(dot(chord, along)) + 8.0 * APART * dot(ahead, along) * vec2(1.0, -1.0);
    vec2 variances_px2 = sigma_px * sigma_px + WIDTH * rates_px * rates_px;
    vec2 narrowing_per_px2 = (0.5 / LN_2) * (1.0 / (sigma_px * sigma_px) - 1.0 / variances_px2);
    vec2 extent_px = abs(chord);
    float away_px = reach_px + SNAPPING_PX, side_px = 2.0 * (away_px + APART * max(extent_px.x, extent_px.y));
    float left = share_in_square(side_px, extent_px);
    vec2 amplitudes_dn = 0.5 * peak_dn / left * sigma_px * inversesqrt(variances_px2);
    way.line = vec4(mean - APART * chord, mean + APART * chord);
    way.form = vec4(along, narrowing_per_px2);
    way.extent = vec4(amplitudes_dn, away_px, SHORT);
    way.kind = SHORT;
}

// As a bent way.
void bend(inout Way way, vec2 chord, vec2 ahead, float peak_dn, float reach_px) {
    float length_px = length(chord);
    vec2 along = chord / length_px, across = vec2(-along.y, along.x);
    float ahead_px = dot(ahead, along);
    float steepness = clamp(4.0 * ahead_px / length_px, -STEEPEST, STEEPEST);
    float x = clamp(0.5 + ahead_px / length_px, 0.1, 0.9);
    way.bow_px = dot(ahead, across) / (4.0 * x * (1.0 - x));
    float bow_per_px = 4.0 * way.bow_px / (length_px * length_px);

    float slanted_px = min(abs(bow_per_px) * length_px, 1.0) * reach_px;
    float low_p = min(way.bow_px, 0.0) - reach_px - slanted_px, high_p = max(way.bow_px, 0.0) + reach_px + slanted_px;
    float margin_px = reach_px + slanted_px;
    vec2 at_bow_px = 0.5 * chord + way.bow_px * across;
    vec2 extent_px = max(max(vec2(0.0), chord), at_bow_px) - min(min(vec2(0.0), chord), at_bow_px);
    float square_px = max(extent_px.x, extent_px.y) + 2.0 * (reach_px + SNAPPING_PX);
    bool as_point = square_px <= largest_point_px
        && square_px * square_px < SLANTED_COST * (length_px + 2.0 * reach_px) * (high_p - low_p);
    // A quad is the wider the more its way bends, by two thirds of that on one side and by one on the other.
    float outer_px = reach_px + 0.6666667 * abs(way.bow_px), inner_px = reach_px + 0.3333333 * abs(way.bow_px);
    float left = as_point ? share_in_square(square_px, extent_px) : 1.0 - beyond(outer_px).x - beyond(inner_px).x;
    way.line = vec4(way.begin_px + along * (ahead_px / 1.5 - steepness * length_px / 6.0), along);
    way.form = vec4(length_px, steepness, bow_per_px, peak_dn / left * sigma_px * SQRT_HALF_PI / length_px);
    way.kind = as_point ? POINT : LONG;
    way.extent = as_point ? vec4(reach_px + SNAPPING_PX, 0.0, 0.0, POINT) : vec4(margin_px, low_p, high_p, LONG);
}

Way way_of(int star, int segment) {
    int first = 2 * segment;
    vec4 at_begin = place(star, first), at_middle = place(star, first + 1), at_end = place(star, first + 2);
    vec2 starlight = place(star, last_moment + 1).xy;
    float share = texelFetch(moments, ivec2(0, first), 0).w;

    // The horizon rises and sinks by 15" a second: in a segment a star crosses it once, at an even rate nearly.
    bool begins_up = at_begin.z >= 0.0, ends_up = at_end.z >= 0.0;
    bool early = begins_up != (at_middle.z >= 0.0);
    vec2 heights = early ? vec2(at_begin.z, at_middle.z) : vec2(at_middle.z, at_end.z);
    float crossing = begins_up == ends_up ? 0.0 : (early ? 0.0 : 0.5) + 0.5 * heights.x / (heights.x - heights.y);
    float rises = begins_up ? 0.0 : crossing, sets = ends_up ? 1.0 : crossing;
    bool unseen = !(begins_up || ends_up) || at_begin.w * at_middle.w * at_end.w == 0.0;

    Way way = Way(vec4(0.0), vec4(0.0), vec4(0.0), NOTHING, 0.0, vec2(0.0), vec2(0.0));
    if (unseen)
        return way;
    way.begin_px = begins_up ? at_begin.xy : on_way(at_begin.xy, at_middle.xy, at_end.xy, rises);
    way.end_px   = ends_up ? at_end.xy : on_way(at_begin.xy, at_middle.xy, at_end.xy, sets);
    vec2 middle_px = on_way(at_begin.xy, at_middle.xy, at_end.xy, 0.5 * (rises + sets));
    vec2 chord = way.end_px - way.begin_px, ahead = middle_px - 0.5 * (way.begin_px + way.end_px);
    float peak_dn = vmag_0_peak_dn * starlight.x * share * (sets - rises);
    if (length(chord) < SHORT_SIGMA * sigma_px)
        shorten(way, chord, ahead, peak_dn, starlight.y);
    else
        bend(way, chord, ahead, peak_dn, starlight.y);
    return way;
}

// Where it goes at one of its ends, a unit vector nearly.
vec2 direction(Way way, float side) {
    vec2 along = way.line.zw;
    return along + side * way.form.z * way.form.x * vec2(-along.y, along.x);
}

// The corners of the edge between a way and the next, or the same point twice.
vec4 edge_between(Way way, Way next, float reach_px) {
    vec2 light = vec2(way.form.w * (1.0 + way.form.y), next.form.w * (1.0 - next.form.y));
    vec2 arrives = direction(way, -1.0), leaves = direction(next, 1.0);
    bool are_long = min(way.form.x - 2.0 * way.extent.x, next.form.x - 2.0 * next.extent.x) > 0.0;
    bool goes_on = way.kind == LONG && next.kind == LONG && are_long && way.end_px == next.begin_px
        && abs(light.x - light.y) < UNEVEN * light.x && distance(arrives, leaves) < KINKED;
    vec2 across = normalize(vec2(-arrives.y - leaves.y, arrives.x + leaves.x));
    float high_px = reach_px + max(max(way.bow_px, next.bow_px), 0.0);
    float low_px  = reach_px - min(min(way.bow_px, next.bow_px), 0.0);
    vec2 corner_px = next.begin_px;
    return goes_on ? vec4(corner_px - low_px * across, corner_px + high_px * across) : corner_px.xyxy;
}

void main() {
    int star = int(gl_FragCoord.x), segment = int(gl_FragCoord.y), segments = last_moment / 2;
    Way way = way_of(star, min(segment, segments - 1)), before = way_of(star, max(segment - 1, 0));
    line = way.line;
    form = way.form;
    extent = way.extent;
    bool has_neighbours = segment > 0 && segment < segments;
    edge = has_neighbours ? edge_between(before, way, place(star, last_moment + 1).y) : vec4(0.0);
}
