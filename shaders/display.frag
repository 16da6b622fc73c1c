#version 330 core

// From digital numbers to the screen: zoom, contrast, comparison with a real image.  The data stay what they are.
//
// A pixel of the screen is the mean of what it covers of the picture, in digital numbers and before any stretch: faint
// stars neither vanish nor twinkle where the picture is shown smaller than it is.  Where it is shown larger, its pixels
// are squares.  Places are px from the picture's top-left corner, y down; row 0 of either texture is the top.

// COMPARES: whether there is a real image.  SHRINKS: how much of the picture a pixel of the screen covers along a side:
// 0, one texel or less; 1, two or less; 2, more.

uniform usampler2D simulated;
uniform usampler2D real;          // as large as the simulated one
uniform vec2  corner_px;          // which place of the picture the panel's corner shows
uniform float px_a_pixel;         // how much of the picture a pixel of the screen covers, along x and along y

uniform int   comparison;         // what is shown: see the constants
uniform float wipe;               // 0 to 1: simulated to the left of it
uniform vec4  covered_px;         // the part that the real image covers: left, top, right, bottom
uniform float simulated_white_dn;
uniform float real_white_dn;
uniform float real_black;         // taken off a real image, share of its white
uniform float real_gain;

uniform float black;              // what is shown black, share of white
uniform float boost;              // how many times as bright, as a longer exposure would be
uniform float softening;          // of the asinh stretch; 0 for a linear one
uniform int   night;              // red on black, for dark-adapted eyes

uniform vec3  more_rgb;           // the colours of a difference: more light on the real image, and less
uniform vec3  less_rgb;

out vec4 colour;

const int SIMULATED = 0, REAL = 1, WIPE = 2, DIFFERENCE = 3, SIDE_BY_SIDE = 4;
const int MOST_TEXELS = 16;       // a side; more are sampled every so many

#if SHRINKS == 0
// The picture's pixels are squares.
float mean_dn(usampler2D picture, vec2 from_px, vec2 to_px) {
    ivec2 last = textureSize(picture, 0) - 1;
    return float(texelFetch(picture, clamp(ivec2(floor((from_px + to_px) * 0.5)), ivec2(0), last), 0).r);
}
#elif SHRINKS == 1
// The mean of a picture between two places, weighted by area: three texels a side at most.
float row_dn(usampler2D picture, ivec3 columns, int row, vec3 weights) {
    return dot(weights, vec3(float(texelFetch(picture, ivec2(columns.x, row), 0).r),
                             float(texelFetch(picture, ivec2(columns.y, row), 0).r),
                             float(texelFetch(picture, ivec2(columns.z, row), 0).r)));
}

float mean_dn(usampler2D picture, vec2 from_px, vec2 to_px) {
    ivec2 last = textureSize(picture, 0) - 1;
    ivec2 first = clamp(ivec2(floor(from_px)), ivec2(0), last);
    ivec2 second = min(first + 1, last), third = min(first + 2, last);
    vec2 into_px = to_px - vec2(first);
    vec2 weight_0 = min(into_px, 1.0) - (from_px - vec2(first));
    vec2 weight_1 = clamp(into_px - 1.0, 0.0, 1.0);
    vec2 weight_2 = clamp(into_px - 2.0, 0.0, 1.0);
    vec3 across = vec3(weight_0.x, weight_1.x, weight_2.x), down = vec3(weight_0.y, weight_1.y, weight_2.y);
    ivec3 columns = ivec3(first.x, second.x, third.x);
    vec3 rows = vec3(row_dn(picture, columns, first.y, across),
                     row_dn(picture, columns, second.y, across),
                     row_dn(picture, columns, third.y, across));
    return dot(rows, down) / (px_a_pixel * px_a_pixel);
}
#else
// The mean of a picture between two places, weighted by area, of any size.
float mean_dn(usampler2D picture, vec2 from_px, vec2 to_px) {
    ivec2 last = textureSize(picture, 0) - 1;
    ivec2 first = clamp(ivec2(floor(from_px)), ivec2(0), last);
    ivec2 final = clamp(ivec2(ceil(to_px)) - 1, first, last);
    ivec2 stride = (final - first) / MOST_TEXELS + 1;
    float sum = 0.0, weights = 0.0;
    for (int y = first.y; y <= final.y; y += stride.y) {
        float tall = min(float(y + 1), to_px.y) - max(float(y), from_px.y);
        for (int x = first.x; x <= final.x; x += stride.x) {
            float weight = max(tall * (min(float(x + 1), to_px.x) - max(float(x), from_px.x)), 1e-6);
            sum += weight * float(texelFetch(picture, ivec2(x, y), 0).r);
            weights += weight;
        }
    }
    return sum / weights;
}
#endif

float simulated_share(vec2 from_px, vec2 to_px) {
    return min(mean_dn(simulated, from_px, to_px) / simulated_white_dn, 1.0);
}

#if COMPARES
bool is_covered(vec2 place_px) {
    return all(greaterThanEqual(place_px, covered_px.xy)) && all(lessThan(place_px, covered_px.zw));
}

float real_share(vec2 from_px, vec2 to_px) {
    if (!is_covered((from_px + to_px) * 0.5))
        return 0.0;
    return clamp((min(mean_dn(real, from_px, to_px) / real_white_dn, 1.0) - real_black) * real_gain, 0.0, 1.0);
}
#endif

float asinh_of(float x) {
    return log(x + sqrt(x * x + 1.0));
}

// From light to brightness, both 0 to 1: glstar.viewer.display.Stretch.
float stretched(float share, float from) {
    float light = clamp((share - from) * boost, 0.0, 1.0);
    return softening > 0.0 ? asinh_of(softening * light) / asinh_of(softening) : light;
}

void main() {
    vec2 from_px = corner_px + floor(gl_FragCoord.xy) * px_a_pixel;
    vec2 to_px = from_px + px_a_pixel;
    vec2 place_px = (from_px + to_px) * 0.5;
    vec2 size_px = vec2(textureSize(simulated, 0));
#if COMPARES
    bool right = comparison == SIDE_BY_SIDE && place_px.x >= size_px.x;
    float shift_px = right ? size_px.x : 0.0;
    from_px.x -= shift_px;
    to_px.x -= shift_px;
    place_px.x -= shift_px;
    float light = simulated_share(from_px, to_px), theirs = real_share(from_px, to_px);
    bool is_real = comparison == REAL || right || (comparison == WIPE && place_px.x >= wipe * size_px.x);
    vec3 shown = vec3(stretched(is_real ? theirs : light, black));
    if (comparison == DIFFERENCE) {
        float brightness = is_covered(place_px) ? stretched(abs(theirs - light), 0.0) : 0.0;
        shown = brightness * (theirs > light ? more_rgb : less_rgb);
    }
#else
    vec3 shown = vec3(stretched(simulated_share(from_px, to_px), black));
#endif
    bool outside = any(lessThan(place_px, vec2(0.0))) || any(greaterThanEqual(place_px, size_px));
    vec3 seen = night != 0 ? vec3(max(shown.r, max(shown.g, shown.b)), 0.0, 0.0) : shown;
    colour = outside ? vec4(0.0) : vec4(seen, 1.0);
}
