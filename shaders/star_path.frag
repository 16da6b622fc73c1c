#version 330 core

// Path pass: from the positions of stars to the shape and the flux of their paths.  A column is a star, a row a segment of
// the exposure.
//
// Within a segment the vector to a star is a quadratic function of time through its values at the start, the middle and the
// end, and its position the projection of that (glstar/render/motion/segmentation.py divides the exposure so that this
// holds): on the sensor, also behind a lens.  A segment is drawn as one of four kinds (trail_constants.glsl):
//
// NOTHING  it is behind the camera or below the horizon
// SHORT    two Gaussians (trail_short.frag), as a point sprite
// POINT    a curved path with varying flux per length (trail.frag), as a point sprite: software OpenGL fills an upright
//          square three times as fast as two slanted triangles (tests/bench)
// LONG     the same, as a point sprite for each end (trail.frag) and a quad between them (trail_middle.frag), where the
//          error functions have reached their limits
//
// Under a rolling shutter (ROWS, readout.glsl) that holds for segments during which all rows that the star lights are open;
// those during which one opens or closes are drawn by trail_rows.vert, one primitive each.
//
// Flux outside the drawn region is added to what is drawn: the trail of a fast star is drawn narrow.
//
// Where a long segment continues smoothly into the next, neither has an end: they meet at a joint across the path, whose
// corners both read from `joint`, so that every pixel belongs to exactly one of them.

// ALL_SHORT: 1 if all segments are SHORT; boundaries are not read then.
// SINGLE: 1 if there is a single segment, which has no joints.
// COMPONENTS: 1 if each column has a Gaussian of its own width, sigma.  All segments are SHORT then, and `joint` holds
// 1 / (2 sigma^2 ln 2), 1/px^2, and sigma, px.

// SHORT_SIGMA, MAX_FLUX_VARIATION, MAX_END_FLUX: glstar.render.motion.segmentation.ShapeLimits.

uniform sampler2D positions;      // of project_stars.frag
uniform sampler2D passage;        // transmission of cloud by star (column) and segment (row); one texel of 1 without
uniform sampler2D pointing;       // fourth components: duration of the segment as a fraction; weight of its ends; start
uniform int   last_time;
uniform float largest_point_px;
#if COMPONENTS
float sigma_px, vmag_0_peak_dn;   // row 2 of chosen, with effective_sigma_px
#else
uniform float sigma_px;           // of the Gaussian that is integrated along the path
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that does not move during the whole exposure
#endif

layout(location = 0) out vec4 chord;      // start (x, y) in the target, px, where s = p = 0; unit vector along s
layout(location = 1) out vec4 shape;      // length, px; curvature; asymmetry; amplitude, DN
layout(location = 2) out vec4 flux;       // distance up to which it is drawn, px; flux slope; flux curvature; kind
layout(location = 3) out vec4 joint;      // both corners of the joint at the start, px; the same point twice: an end
layout(location = 4) out vec4 boundary;  // of LONG: an axis (x, y), and the values of dot(axis, gl_FragCoord) where the
                                          // pixels of the first end stop and those of the last begin
// With m = 2 s / length - 1, from -1 at the start to 1 at the end, the path is
// p = s (1 - s / length) (curvature + asymmetry m), and its flux per length
// 1 + flux slope m + flux curvature (m^2 - 1/3).
#if ROWS
layout(location = 5) out vec4 times;      // clock of readout.glsl; of PARTLY_OPEN: fractions of the length between which any
                                          // row is open
#endif
// SHORT: chord holds the centres (x, y) of two Gaussians; shape the vectors along which they are widened, 1/px
// (two_gaussians.glsl); flux their amplitudes, the distance up to which they are drawn, and the kind.
// SHORT + PARTLY_OPEN: chord holds start and chord, px; shape the distance of the middle from that of the chord, px; flux
// the amplitude of a Gaussian with all the flux, 0, the distance and the kind.

#include "trail_constants.glsl"
#include "rasterization.glsl"
#include "two_gaussians.glsl"
#include "drawn_fraction.glsl"
#if LENS
#include "lens.glsl"
#endif
#if ROWS
#include "readout.glsl"
#endif

#if COMPONENTS
uniform sampler2D chosen;         // of project_stars.frag, and two more rows
#endif

const float ROUNDING = 1e-6;      // of times
// A star may move by this many standard deviations between the openings of rows that are drawn alike: half of it, 1.5e-4 of
// the peak.
const float MAX_SHIFT_SIGMA = 5e-4;
const float SLANTED_COST = 2.5;   // of a pixel of a slanted quad, in pixels of an upright square
// Segments that meet without an end may differ by this: in flux, relative, and in direction, rad.
const float MAX_FLUX_STEP = 2e-3, MAX_KINK = 5e-3;
// Length of the axis of `boundary`: its product with gl_FragCoord fits into 24 bits up to 16384 px from the corner.
const float AXIS_LENGTH = 512.0;
const float SQRT_HALF_PI = 1.2533141373155003;

struct Path {
    vec4 chord, shape, flux;
    float sagitta_px;             // largest distance from the chord, positive to the right of s
    vec2 start_px, end_px;        // in the target
    float amplitude_dn;           // SHORT: of a Gaussian with all the flux
#if ROWS
    vec4 times;
#endif
};

vec4 projected(int star, int time) {
    return texelFetch(positions, ivec2(star, time), 0);
}

// The vector to a star at a parameter of a segment's quadratic, 0 to 1.
vec3 interpolated(vec3 start, vec3 middle, vec3 end, float u) {
    return start + u * (4.0 * middle - 3.0 * start - end + u * 2.0 * (start - 2.0 * middle + end));
}

// The parameter of `interpolated` at an elapsed fraction of a segment, given the weight of its ends: the series of
// starpaths.parameter_at.
float parameter_at(float u, float weight) {
    float x = 2.0 * u - 1.0, tangent2 = weight - 1.0, angle2 = tangent2 * (1.0 - 0.6666667 * tangent2), x2 = x * x * angle2;
    return 0.5 + 0.5 * x * (1.0 + x2 * (0.3333333 + 0.1333333 * x2)) / (1.0 + angle2 * (0.3333333 + 0.1333333 * angle2));
}

// A SHORT path: two Gaussians.
void two_gaussians(inout Path path, vec2 chord, vec2 ahead, float peak_dn, float radius_px) {
    vec2 mean = path.start_px + 0.5 * chord + ahead * (4.0 * (0.25 - OFFSET * OFFSET - VARIANCE));
    vec2 relative;
    path.shape = vec4(widening_per_px(chord + RATE_CHANGE * ahead, sigma_px, relative.x),
                      widening_per_px(chord - RATE_CHANGE * ahead, sigma_px, relative.y));
    float margin_px = radius_px + SNAPPING_PX, drawn_fraction = fraction_of_two_gaussians(margin_px, chord);
    vec2 amplitudes_dn = 0.5 * peak_dn / drawn_fraction * relative;
    path.amplitude_dn = peak_dn / drawn_fraction;
    path.chord = vec4(mean - OFFSET * chord, mean + OFFSET * chord);
    path.flux = vec4(amplitudes_dn, margin_px, SHORT);
}

#if LENS
#define EndRates mat2             // derivatives of the position, px, at the ends, by the elapsed fraction of the path
#else
#define EndRates vec2             // depths of the ends, relative to the middle: those of a pinhole follow
#endif

// A POINT or LONG path: curved, with varying flux per length.
void curved_path(inout Path path, vec2 chord, vec2 ahead, EndRates ends, float peak_dn, float radius_px) {
    float length_px = length(chord);
    vec2 along = chord / length_px, normal = vec2(-along.y, along.x);
    float from_middle = dot(ahead, along) / length_px, offset = dot(ahead, normal) / length_px;
    float flux_slope = clamp(4.0 * from_middle, -MAX_FLUX_VARIATION, MAX_FLUX_VARIATION);
    // Time per length at the start and at the end, relative to uniform motion.
#if LENS
    vec2 slowness = 1.0 / max(along * ends / length_px, 1.0 / MAX_END_FLUX), sideways = normal * ends / length_px;
    float flux_bend = 0.75 * (slowness.x + slowness.y) - 1.5, skewness = -0.5 * dot(sideways, slowness);
#else
    vec2 slowness = 1.0 / max(2.0 + vec2(4.0, -4.0) * from_middle - ends.yx, 1.0 / MAX_END_FLUX);
    float flux_bend = 0.75 * dot(ends, slowness) - 1.5, skewness = 2.0 * offset * (slowness.y - slowness.x);
#endif
    float flux_curvature = clamp(flux_bend, abs(flux_slope) - MAX_FLUX_VARIATION, MAX_FLUX_VARIATION - abs(flux_slope));
    float asymmetry = clamp(skewness, -1.0, 1.0);
    float curvature = offset / max(0.25 - from_middle * from_middle, 0.05) - 2.0 * asymmetry * from_middle;
    path.sagitta_px = 0.25 * curvature * length_px;

    float margin_px = radius_px * (1.0 + min(abs(curvature) + abs(asymmetry), 1.0)) + 0.1 * abs(asymmetry) * length_px;
    float width_px = abs(path.sagitta_px) + 2.0 * margin_px;
    vec2 apex_px = 0.5 * chord + path.sagitta_px * normal;
    vec2 extent_px = max(max(vec2(0.0), chord), apex_px) - min(min(vec2(0.0), chord), apex_px);
    float square_px = max(extent_px.x, extent_px.y) + 2.0 * (radius_px + SNAPPING_PX);
    bool as_point = square_px <= largest_point_px
        && square_px * square_px < SLANTED_COST * (length_px + 2.0 * radius_px) * width_px;
    // A quad is wider than the point spread by the sagitta: two thirds of it on one side and one third on the other.
    float outer_px = radius_px + 0.6666667 * abs(path.sagitta_px), inner_px = radius_px + 0.3333333 * abs(path.sagitta_px);
    float drawn_fraction = as_point ? fraction_in_square(square_px, extent_px)
                                    : 1.0 - gaussian_tail(outer_px).x - gaussian_tail(inner_px).x;
    path.chord = vec4(path.start_px, along);
    path.shape = vec4(length_px, curvature, asymmetry, peak_dn / drawn_fraction * sigma_px * SQRT_HALF_PI / length_px);
    path.flux = vec4(as_point ? radius_px + SNAPPING_PX : margin_px, flux_slope, flux_curvature, as_point ? POINT : LONG);
}

#if ROWS
// The earliest and the latest opening time of the rows that a path may light; rows outside the image do not matter.
vec2 opening_bounds(Path path, vec2 chord, vec2 ahead, float reach_px) {
    vec2 apex_px = path.start_px + 0.5 * chord + 2.0 * ahead + 0.5, first_px = path.start_px + 0.5, last_px = path.end_px + 0.5;
    vec2 low_px = min(min(first_px, last_px), apex_px) - reach_px, high_px = max(max(first_px, last_px), apex_px) + reach_px;
    float middle = opening_at(0.5 * (low_px + high_px)), around = dot(abs(opening.xy), 0.5 * (high_px - low_px));
    vec2 bounds = vec2(middle - around, middle + around);
    return clamp(bounds, 0.0, 1.0 - open_time);
}

// Whether all rows that a SHORT path may light record as much of it, and about the same part: they open and close during the
// segment, and meanwhile the star hardly moves.
bool is_open_alike(vec2 bounds, float begin, float end, float length_px) {
    bool all_during = bounds.x >= begin && bounds.y + open_time <= end + ROUNDING;
    return all_during && length_px * (bounds.y - bounds.x) <= MAX_SHIFT_SIGMA * sigma_px * (end - begin);
}

// Marks a path during which no row that it lights is open, or during which one opens or closes.
void set_openings(inout Path path, vec2 chord, vec2 ahead, vec2 begin_and_duration, float radius_px) {
    float begin = begin_and_duration.x, end = begin + begin_and_duration.y;
    bool is_short = path.flux.w == SHORT;
    float reach_px = radius_px + SNAPPING_PX + (is_short ? 0.0 : 0.1 * abs(path.shape.z) * path.shape.x);
    vec2 bounds = opening_bounds(path, chord, ahead, reach_px);
    bool never = bounds.x >= end || bounds.y + open_time <= begin;
    bool always = bounds.y <= begin + ROUNDING && bounds.x + open_time >= end - ROUNDING;
    vec2 lit = clamp((vec2(bounds.x, bounds.y + open_time) - begin) / max(end - begin, ROUNDING), 0.0, 1.0);
    path.times = vec4(begin, 1.0 / max(end - begin, 1e-9), is_short ? lit : lengths_at(lit, path.flux.y, path.flux.z));
    if (never || always) {
        path.flux.w = never ? NOTHING : path.flux.w;
        return;
    }
    if (is_short && is_open_alike(bounds, begin, end, length(chord))) {
        float opens = opening_at(path.start_px + 0.5 * chord + ahead + 0.5);
        vec2 elapsed = (vec2(opens, opens + open_time) - begin) / (end - begin);
        TwoGaussians recorded = part_of_motion(elapsed, path.start_px, chord, ahead, sigma_px, path.amplitude_dn);
        path.chord = recorded.centres_px;
        path.shape = recorded.shape;
        path.flux.xy = recorded.amplitudes_dn;
        return;
    }
    path.chord = is_short ? vec4(path.start_px, chord) : path.chord;
    path.shape = is_short ? vec4(ahead, 0.0, 0.0) : path.shape;
    path.flux = vec4(is_short ? vec3(path.amplitude_dn, 0.0, path.flux.z) : path.flux.xyz, path.flux.w + PARTLY_OPEN);
}
#endif

// Elapsed fractions of a segment between which a star is above the horizon, given those at which it rises and sets.  A star
// that sets before it rises is up until then and afterwards; in a segment in which it does both, throughout.
vec2 part_above_horizon(vec2 rises_and_sets) {
    vec2 within = clamp(rises_and_sets, 0.0, 1.0);
    bool rises_again = rises_and_sets.y < rises_and_sets.x;
    return rises_again ? vec2(within.y > 0.0 ? 0.0 : within.x, within.x < 1.0 ? 1.0 : within.y) : within;
}

Path path_of(int star, int segment) {
    int first = 2 * segment;
    vec4 at_start = projected(star, first), at_middle = projected(star, first + 1), at_end = projected(star, first + 2);
    vec4 of_star = projected(star, last_time + 1);    // brightness, truncation radius, times of rising and setting
    float duration = texelFetch(pointing, ivec2(0, first), 0).w, weight = texelFetch(pointing, ivec2(1, first), 0).w;
    float begin = texelFetch(pointing, ivec2(2, first), 0).w;

    vec2 within = part_above_horizon((of_star.zw - begin) / duration);
    float rises = within.x, sets = within.y;
    bool starts_up = rises == 0.0, ends_up = sets == 1.0;
    bool hidden = sets <= rises || at_start.w * at_middle.w * at_end.w == 0.0;

    Path path = Path(vec4(0.0), vec4(0.0), vec4(vec3(0.0), NOTHING), 0.0, vec2(0.0), vec2(0.0), 0.0
#if ROWS
        , vec4(0.0)
#endif
    );
    if (hidden)
        return path;
#if LENS
    vec3 start = at_start.xyz * weight, middle = at_middle.xyz, end = at_end.xyz * weight;
#else
    vec3 start = vec3(at_start.xy, 1.0) * at_start.w * weight, middle = vec3(at_middle.xy, 1.0) * at_middle.w;
    vec3 end = vec3(at_end.xy, 1.0) * at_end.w * weight;
#endif
    vec2 parameters = vec2(parameter_at(rises, weight), parameter_at(sets, weight));
    vec3 rising = interpolated(start, middle, end, parameters.x);
    vec3 between = interpolated(start, middle, end, parameter_at(0.5 * (rises + sets), weight));
    vec3 setting = interpolated(start, middle, end, parameters.y);
#if LENS
    // Of the vectors themselves, so that a segment ends exactly where the next one starts.
    LensPoint begins_at = through_lens(starts_up ? at_start.xyz : rising);
    LensPoint ends_at = through_lens(ends_up ? at_end.xyz : setting);
    path.start_px = begins_at.px;
    path.end_px   = ends_at.px;
    vec2 middle_px = vector_position_px(starts_up && ends_up ? middle : between);
    vec3 rate = 4.0 * middle - 3.0 * start - end, change = 4.0 * (start - 2.0 * middle + end);
    vec2 scale = (parameters.y - parameters.x) / vec2(starts_up ? weight : 1.0, ends_up ? weight : 1.0);
    mat2 ends = mat2(begins_at.per_vector * (scale.x * (rate + parameters.x * change)),
                     ends_at.per_vector * (scale.y * (rate + parameters.y * change)));
#else
    path.start_px = starts_up ? at_start.xy : rising.xy / rising.z;
    path.end_px   = ends_up ? at_end.xy : setting.xy / setting.z;
    vec2 middle_px = starts_up && ends_up ? at_middle.xy : between.xy / between.z;
    vec2 ends = vec2(rising.z, setting.z) / between.z;
#endif
    vec2 chord = path.end_px - path.start_px, ahead = middle_px - 0.5 * (path.start_px + path.end_px);
    float transmission = texelFetch(passage, min(ivec2(star, segment), textureSize(passage, 0) - 1), 0).r;
    float peak_dn = vmag_0_peak_dn * of_star.x * duration * (sets - rises) * transmission;
#if ALL_SHORT
    two_gaussians(path, chord, ahead, peak_dn, of_star.y);
#else
    if (length(chord) < SHORT_SIGMA * effective_sigma_px)
        two_gaussians(path, chord, ahead, peak_dn, of_star.y);
    else
        curved_path(path, chord, ahead, ends, peak_dn, of_star.y);
#endif
#if ROWS
    set_openings(path, chord, ahead, vec2(begin + duration * rises, duration * (sets - rises)), of_star.y);
#endif
    return path;
}

// Direction at the start (end = -1) or the end (end = 1), approximately a unit vector.
vec2 direction(Path path, float end) {
    vec2 along = path.chord.zw;
    return along - (end * path.shape.y + path.shape.z) * vec2(-along.y, along.x);
}

// Flux per length there.
float flux_dn(Path path, float end) {
    return path.shape.w * (1.0 + end * path.flux.y + 0.6666667 * path.flux.z);
}

// The corners of the joint between a path and the next, or the same point twice.
vec4 joint_between(Path path, Path next, float radius_px) {
    vec2 both_dn = vec2(flux_dn(path, 1.0), flux_dn(next, -1.0));
    vec2 arrives = direction(path, 1.0), leaves = direction(next, -1.0);
    bool are_long = min(path.shape.x - 2.0 * path.flux.x, next.shape.x - 2.0 * next.flux.x) > 0.0;
    bool continues = path.flux.w == LONG && next.flux.w == LONG && are_long && path.end_px == next.start_px
        && abs(both_dn.x - both_dn.y) < MAX_FLUX_STEP * both_dn.x && distance(arrives, leaves) < MAX_KINK;
    vec2 across = normalize(vec2(-arrives.y - leaves.y, arrives.x + leaves.x));
    float high_px = radius_px + max(max(path.sagitta_px, next.sagitta_px), 0.0);
    float low_px  = radius_px - min(min(path.sagitta_px, next.sagitta_px), 0.0);
    vec2 corner_px = next.start_px;
    return continues ? vec4(corner_px - low_px * across, corner_px + high_px * across) : corner_px.xyxy;
}

// Each pixel of a trail is assigned to one primitive by its coordinate along an axis, because points are squares, quads are
// rounded to a grid, and both overlap.  The axis has integer components, so that both fragment shaders compute the same
// coordinate without any rounding: otherwise both would draw a pixel at the boundary, or neither would.
vec4 boundary_of(Path path) {
    vec2 along = path.chord.zw, axis = round(AXIS_LENGTH * along);
    float margin_px = min(path.flux.x, 0.5 * path.shape.x);
    vec2 first_px = path.start_px + 0.5 + margin_px * along;
    vec2 last_px  = path.start_px + 0.5 + (path.shape.x - margin_px) * along;
    return vec4(axis, dot(axis, first_px), dot(axis, last_px));
}

void main() {
    int star = int(gl_FragCoord.x), segment = int(gl_FragCoord.y), segments = last_time / 2;
#if COMPONENTS
    vec3 component = texelFetch(chosen, ivec2(star, 2), 0).rgb;
    sigma_px = component.x;
    effective_sigma_px = component.y;
    vmag_0_peak_dn = component.z;
#endif
    Path path = path_of(star, min(segment, segments - 1));
    chord = path.chord;
    shape = path.shape;
    flux = path.flux;
#if ROWS
    times = path.times;
#endif
#if ALL_SHORT
    boundary = joint = vec4(0.0);
#if COMPONENTS
    joint.xy = vec2(texelFetch(chosen, ivec2(star, 3), 0).r, sigma_px);
#endif
#else
    boundary = boundary_of(path);
#if SINGLE
    joint = vec4(0.0);
#else
    bool has_neighbours = segment > 0 && segment < segments;
    Path before = path_of(star, max(segment - 1, 0));
    joint = has_neighbours ? joint_between(before, path, projected(star, last_time + 1).y) : vec4(0.0);
#endif
#endif
}
