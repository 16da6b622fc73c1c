#version 330 core

// From the places of stars to their ways: a column is a star, a row a segment of the exposure.
//
// Within a segment the vector to a star is a quadratic of time, through the segment's beginning, middle and end, and its
// place what a pinhole makes of that (glstar/render/segmentation.py says where an exposure is cut, so that this holds).  What is drawn
// of it is one of four kinds:
//
// NOTHING  it is behind the camera or under the horizon
// SHORT    two Gaussians (trail_short.frag), as a point sprite
// POINT    a bent way run unevenly (trail.frag), as a point sprite: an upright square is filled three
//          times as fast by software OpenGL as two slanted triangles (tests/bench)
// LONG     the same, as a point sprite for each end (trail.frag), and between those, where erf has come to its end, as
//          a quad (trail_between.frag)
//
// Light farther from the way than what is drawn of it is given back to what is left: a fast trail is drawn narrow.
//
// Where a long way goes on into the next as if nothing had happened, neither has an end: they meet in an edge across,
// whose corners both read from `edge`, so that no pixel lies in both or in none.

uniform sampler2D places;         // of place.frag
uniform sampler2D moments;        // fourth numbers: which share of the exposure the segment lasts; what its ends are worth
uniform int   last_moment;
uniform float sigma_px;           // of the Gaussian that is swept
uniform float drawn_sigma_px;     // and of what is drawn, which pixels widen
uniform float largest_point_px;
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that stands still for the whole exposure

layout(location = 0) out vec4 line;    // origin (x, y) in the target, px, where s = p = 0; unit vector along s
layout(location = 1) out vec4 form;    // length, px; bow; skew; amplitude, DN
layout(location = 2) out vec4 extent;  // how far it is drawn, px; steepness; hollow; its kind
layout(location = 3) out vec4 edge;    // both corners of the edge where the way begins, px; the same twice: an end
layout(location = 4) out vec4 bounds;  // of a LONG way: an axis (x, y), and the values of dot(axis, gl_FragCoord) where the
                                       // pixels of the first end stop and those of the last begin
// With m = 2 s / length - 1, which is -1 where the way begins and 1 where it ends, the way is
// p = s (1 - s / length) (bow + skew m), and its light per length 1 + steepness m + hollow (m^2 - 1/3).
// SHORT: line is the centres (x, y) of two Gaussians, form a unit vector along and how much less light falls off along
// it, of the logarithm to base 2, in 1/px^2; extent has their amplitudes, how far they are drawn, and the kind.

const float NOTHING = 0.0, SHORT = 1.0, POINT = 2.0, LONG = 3.0;   // trail.vert
const float SHORT_SIGMA = 2.0, STEEPEST = 0.9, MOST_AT_ENDS = 3.0;   // glstar/render/segmentation.py
// Two Gaussians at 1/2 -+ APART of an even way's time, each as wide as a way of time 1 with WIDTH less for variance,
// have its moments up to the seventh.
const float APART = 0.2540669, WIDTH = 0.0187834;
const float SLANTED_COST = 2.5;   // of a pixel of a slanted quad, in pixels of an upright square
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
// So much may two ways differ where they meet without an end: in light, and in direction, rad.
const float UNEVEN = 2e-3, KINKED = 5e-3;
// The axis of `bounds`, in steps of its length: 24 bits hold its product with gl_FragCoord up to 16384 px from the corner.
const float AXIS_STEPS = 512.0;
const float LN_2 = 0.6931471805599453;
const float SQRT_HALF_PI = 1.2533141373155003;
const float INV_SQRT_2_PI = 0.3989422804014327;

struct Way {
    vec4 line, form, extent;
    float bow_px;                 // how far it bends to the right of s, at its farthest
    vec2 begin_px, end_px;        // on the image
};

vec4 place(int star, int moment) {
    return texelFetch(places, ivec2(star, moment), 0);
}

// The vector in a share of the segment's time.
vec3 on_way(vec3 begin, vec3 middle, vec3 end, float u) {
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
}

// As a bent way; its ends are as far ahead of the camera as `ends`, its middle as 1.
void bend(inout Way way, vec2 chord, vec2 ahead, vec2 ends, float peak_dn, float reach_px) {
    float length_px = length(chord);
    vec2 along = chord / length_px, across = vec2(-along.y, along.x);
    float from_middle = dot(ahead, along) / length_px, aside = dot(ahead, across) / length_px;
    float steepness = clamp(4.0 * from_middle, -STEEPEST, STEEPEST);
    // How much more time than evenly is spent where the way begins and where it ends.
    vec2 slowness = 1.0 / max(2.0 + vec2(4.0, -4.0) * from_middle - ends.yx, 1.0 / MOST_AT_ENDS);
    float hollow = clamp(0.75 * dot(ends, slowness) - 1.5, abs(steepness) - STEEPEST, STEEPEST - abs(steepness));
    float skew = clamp(2.0 * aside * (slowness.y - slowness.x), -1.0, 1.0);
    float bow = aside / max(0.25 - from_middle * from_middle, 0.05) - 2.0 * skew * from_middle;
    way.bow_px = 0.25 * bow * length_px;

    float margin_px = reach_px * (1.0 + min(abs(bow) + abs(skew), 1.0)) + 0.1 * abs(skew) * length_px;
    float wide_px = abs(way.bow_px) + 2.0 * margin_px;
    vec2 at_bow_px = 0.5 * chord + way.bow_px * across;
    vec2 extent_px = max(max(vec2(0.0), chord), at_bow_px) - min(min(vec2(0.0), chord), at_bow_px);
    float square_px = max(extent_px.x, extent_px.y) + 2.0 * (reach_px + SNAPPING_PX);
    bool as_point = square_px <= largest_point_px
        && square_px * square_px < SLANTED_COST * (length_px + 2.0 * reach_px) * wide_px;
    // A quad is the wider the more its way bends, by two thirds of that on one side and by one on the other.
    float outer_px = reach_px + 0.6666667 * abs(way.bow_px), inner_px = reach_px + 0.3333333 * abs(way.bow_px);
    float left = as_point ? share_in_square(square_px, extent_px) : 1.0 - beyond(outer_px).x - beyond(inner_px).x;
    way.line = vec4(way.begin_px, along);
    way.form = vec4(length_px, bow, skew, peak_dn / left * sigma_px * SQRT_HALF_PI / length_px);
    way.extent = vec4(as_point ? reach_px + SNAPPING_PX : margin_px, steepness, hollow, as_point ? POINT : LONG);
}

Way way_of(int star, int segment) {
    int first = 2 * segment;
    vec4 at_begin = place(star, first), at_middle = place(star, first + 1), at_end = place(star, first + 2);
    vec2 starlight = place(star, last_moment + 1).xy;
    float share = texelFetch(moments, ivec2(0, first), 0).w, worth = texelFetch(moments, ivec2(1, first), 0).w;

    // The horizon rises and sinks by 15" a second: in a segment a star crosses it once, at an even rate nearly.
    bool begins_up = at_begin.z >= 0.0, ends_up = at_end.z >= 0.0;
    bool early = begins_up != (at_middle.z >= 0.0);
    vec2 heights = early ? vec2(at_begin.z, at_middle.z) : vec2(at_middle.z, at_end.z);
    float crossing = begins_up == ends_up ? 0.0 : (early ? 0.0 : 0.5) + 0.5 * heights.x / (heights.x - heights.y);
    float rises = begins_up ? 0.0 : crossing, sets = ends_up ? 1.0 : crossing;
    bool unseen = !(begins_up || ends_up) || at_begin.w * at_middle.w * at_end.w == 0.0;

    Way way = Way(vec4(0.0), vec4(0.0), vec4(vec3(0.0), NOTHING), 0.0, vec2(0.0), vec2(0.0));
    if (unseen)
        return way;
    vec3 begin = vec3(at_begin.xy, 1.0) * at_begin.w * worth, middle = vec3(at_middle.xy, 1.0) * at_middle.w;
    vec3 end = vec3(at_end.xy, 1.0) * at_end.w * worth;
    vec3 rising = on_way(begin, middle, end, rises), between = on_way(begin, middle, end, 0.5 * (rises + sets));
    vec3 setting = on_way(begin, middle, end, sets);
    way.begin_px = begins_up ? at_begin.xy : rising.xy / rising.z;
    way.end_px   = ends_up ? at_end.xy : setting.xy / setting.z;
    vec2 middle_px = begins_up && ends_up ? at_middle.xy : between.xy / between.z;
    vec2 chord = way.end_px - way.begin_px, ahead = middle_px - 0.5 * (way.begin_px + way.end_px);
    float peak_dn = vmag_0_peak_dn * starlight.x * share * (sets - rises);
    if (length(chord) < SHORT_SIGMA * drawn_sigma_px)
        shorten(way, chord, ahead, peak_dn, starlight.y);
    else
        bend(way, chord, ahead, vec2(rising.z, setting.z) / between.z, peak_dn, starlight.y);
    return way;
}

// Where it goes at one of its ends, a unit vector nearly.
vec2 direction(Way way, float end) {
    vec2 along = way.line.zw;
    return along - (end * way.form.y + way.form.z) * vec2(-along.y, along.x);
}

// And its light there.
float light_dn(Way way, float end) {
    return way.form.w * (1.0 + end * way.extent.y + 0.6666667 * way.extent.z);
}

// The corners of the edge between a way and the next, or the same point twice.
vec4 edge_between(Way way, Way next, float reach_px) {
    vec2 light = vec2(light_dn(way, 1.0), light_dn(next, -1.0));
    vec2 arrives = direction(way, 1.0), leaves = direction(next, -1.0);
    bool are_long = min(way.form.x - 2.0 * way.extent.x, next.form.x - 2.0 * next.extent.x) > 0.0;
    bool goes_on = way.extent.w == LONG && next.extent.w == LONG && are_long && way.end_px == next.begin_px
        && abs(light.x - light.y) < UNEVEN * light.x && distance(arrives, leaves) < KINKED;
    vec2 across = normalize(vec2(-arrives.y - leaves.y, arrives.x + leaves.x));
    float high_px = reach_px + max(max(way.bow_px, next.bow_px), 0.0);
    float low_px  = reach_px - min(min(way.bow_px, next.bow_px), 0.0);
    vec2 corner_px = next.begin_px;
    return goes_on ? vec4(corner_px - low_px * across, corner_px + high_px * across) : corner_px.xyxy;
}

// Each pixel of a trail is assigned to one primitive by its coordinate along an axis, because points are squares, quads are
// rounded to a grid, and both overlap.  The axis has integer components, so that both fragment shaders compute the same
// coordinate without any rounding: otherwise both would draw a pixel at the boundary, or neither would.
vec4 bounds_of(Way way) {
    vec2 along = way.line.zw, axis = round(AXIS_STEPS * along);
    float margin_px = min(way.extent.x, 0.5 * way.form.x);
    vec2 first_px = way.begin_px + 0.5 + margin_px * along;
    vec2 last_px  = way.begin_px + 0.5 + (way.form.x - margin_px) * along;
    return vec4(axis, dot(axis, first_px), dot(axis, last_px));
}

void main() {
    int star = int(gl_FragCoord.x), segment = int(gl_FragCoord.y), segments = last_moment / 2;
    Way way = way_of(star, min(segment, segments - 1)), before = way_of(star, max(segment - 1, 0));
    line = way.line;
    form = way.form;
    extent = way.extent;
    bounds = bounds_of(way);
    bool has_neighbours = segment > 0 && segment < segments;
    edge = has_neighbours ? edge_between(before, way, place(star, last_moment + 1).y) : vec4(0.0);
}
