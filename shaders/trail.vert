#version 330 core

// One star in one segment of the exposure: a point sprite around the star's way, as wide as its light reaches, or, where
// that would be mostly empty, a quad along it.
//
// An instance is a segment; a star is one vertex as a point (QUADS 0) and four as a quad (QUADS 1).  Software OpenGL
// fills an upright square three times as fast as two slanted triangles (tests/bench).  Within a segment a star's place is a quadratic of time, through
// its places at the segment's beginning, middle and end (glstar/trail.py says where an exposure is cut, so that this
// holds).  trail.frag draws its light in a frame of its own: s along the chord, p across it, to the right of it.

uniform sampler2D places;         // of place.frag
uniform sampler2D moments;        // the first texel's fourth number: which share of the exposure the segment lasts
uniform int   last_moment;
uniform vec2  target_px;          // width and height of the target
uniform float sigma_px;
uniform float largest_point_px;
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that stands still for the whole exposure

flat out vec2  origin_px;         // where s = p = 0, in the target
flat out vec2  along;             // unit vector
flat out float length_px;         // of the way that is drawn
flat out float falloff_per_px;    // 1 / (sqrt(2) sigma) along the way
flat out float steepness;         // at the way's end the star is so much slower than in its middle: -0.9 to 0.9
flat out float bow_per_px;        // the way is p = bow s (length - s)
flat out float amplitude_dn;

const float SHORT_SIGMA = 0.7, MENDED_SIGMA = 1.5, STEEPEST = 0.9;   // glstar/trail.py
const float LEAST_SIGMA = 0.25;   // a way is drawn this long at the least, or differences of erf would lose their digits
const float SLANTED_COST = 2.5;   // of a pixel of a slanted quad, in pixels of an upright square
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
const float SQRT_HALF_PI = 1.2533141373155003;

vec4 place(int star, int moment) {
    return texelFetch(places, ivec2(star, moment), 0);
}

// The place in a share of the segment's time.
vec2 on_way(vec2 begin, vec2 middle, vec2 end, float u) {
    return begin + u * (4.0 * middle - 3.0 * begin - end + u * 2.0 * (begin - 2.0 * middle + end));
}

void main() {
    int star = QUADS == 1 ? gl_VertexID >> 2 : gl_VertexID, first = 2 * gl_InstanceID;
    vec4 at_begin = place(star, first), at_middle = place(star, first + 1), at_end = place(star, first + 2);
    vec2 starlight = place(star, last_moment + 1).xy;
    float reach_px = starlight.y;
    float share = texelFetch(moments, ivec2(0, first), 0).w;

    // The horizon rises and sinks by 15" a second: in a segment a star crosses it once, at an even rate.
    bool begins_up = at_begin.z >= 0.0, ends_up = at_end.z >= 0.0;
    float crossing = begins_up == ends_up ? 0.0 : at_begin.z / (at_begin.z - at_end.z);
    float rises = begins_up ? 0.0 : crossing, sets = ends_up ? 1.0 : crossing;
    bool unseen = !(begins_up || ends_up) || at_begin.w * at_middle.w * at_end.w == 0.0;
    vec2 begin  = on_way(at_begin.xy, at_middle.xy, at_end.xy, rises);
    vec2 middle = on_way(at_begin.xy, at_middle.xy, at_end.xy, 0.5 * (rises + sets));
    vec2 end    = on_way(at_begin.xy, at_middle.xy, at_end.xy, sets);
    begin = begins_up ? at_begin.xy : begin;
    end   = ends_up ? at_end.xy : end;

    vec2  chord = end - begin;
    float chord_px = length(chord);
    along = chord_px > 1e-6 * sigma_px ? chord / chord_px : vec2(1.0, 0.0);
    vec2  across = vec2(-along.y, along.x);
    vec2  to_middle = middle - begin;
    float s_middle = dot(to_middle, along), p_middle = dot(to_middle, across);
    float ahead_px = s_middle - 0.5 * chord_px;

    float bow_px = 0.0;
    if (chord_px < SHORT_SIGMA * sigma_px) {
        // So short that mean and variance are all that is left of it.
        length_px = LEAST_SIGMA * sigma_px;
        steepness = 0.0;
        bow_per_px = 0.0;
        origin_px = begin + along * (0.5 * (chord_px - length_px) + ahead_px / 1.5) + across * (p_middle / 1.5);
        float variance_px2 = (chord_px * chord_px - length_px * length_px) / 12.0 + ahead_px * ahead_px * (4.0 / 45.0);
        falloff_per_px = inversesqrt(2.0 * (sigma_px * sigma_px + variance_px2));
    } else {
        length_px = chord_px;
        steepness = clamp(4.0 * ahead_px / chord_px, -STEEPEST, STEEPEST);
        float x = clamp(s_middle / chord_px, 0.1, 0.9);
        bow_px = p_middle / (4.0 * x * (1.0 - x));
        bow_per_px = 4.0 * bow_px / (chord_px * chord_px);
        origin_px = begin + along * (ahead_px / 1.5 - steepness * chord_px / 6.0);
        // Light that varies linearly along the way is a little less spread than the star's.
        float missing_px2 = chord_px < MENDED_SIGMA * sigma_px ? pow(steepness * chord_px, 2.0) / 30.0 : 0.0;
        falloff_per_px = inversesqrt(2.0 * (sigma_px * sigma_px + missing_px2));
    }
    amplitude_dn = vmag_0_peak_dn * starlight.x * share * (sets - rises) * sigma_px * SQRT_HALF_PI / length_px;

    float slanted = min(abs(bow_per_px) * length_px, 1.0) * reach_px;
    float low_p  = min(bow_px, 0.0) - reach_px - slanted;
    float high_p = max(bow_px, 0.0) + reach_px + slanted;
    vec2 to_end_px = length_px * along, to_bow_px = bow_px * across;
    vec2 low_px  = origin_px + min(min(vec2(0.0), to_end_px), 0.5 * to_end_px + to_bow_px) - reach_px - SNAPPING_PX;
    vec2 high_px = origin_px + max(max(vec2(0.0), to_end_px), 0.5 * to_end_px + to_bow_px) + reach_px + SNAPPING_PX;
    float side_px = max(high_px.x - low_px.x, high_px.y - low_px.y);
    bool as_point = side_px <= largest_point_px
        && side_px * side_px < SLANTED_COST * (length_px + 2.0 * reach_px) * (high_p - low_p);
#if QUADS
    unseen = unseen || as_point;
    float s = (gl_VertexID & 1) == 0 ? -reach_px - slanted : length_px + reach_px + slanted;
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
