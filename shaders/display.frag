#version 330 core

// From digital numbers to the screen: zoom, display stretch, comparison with a real image.  The data do not change.
//
// A screen pixel is the mean of the image pixels that it covers, in digital numbers and before the stretch: faint stars
// neither vanish nor twinkle when the picture is shown smaller than it is.  A magnified image pixel is a square.
// Positions are px from the picture's top-left corner, y down; row 0 of either texture is the top.

// COMPARES: whether there is a real image.
// COLOURED: whether brightness is shown in the colours of a map instead of shades of grey.
// SHRINKS: the side of a screen pixel on the picture: 0, at most one px; 1, at most two; 2, more.

uniform usampler2D simulated;
uniform usampler2D real;                 // of the size of the simulated one
uniform vec4  screen_from_fragment_px;   // the target's position in the panel, and its directions across and down
uniform vec4  backdrop;                  // colour behind the picture
uniform vec2  corner_px;                 // position of the panel's top-left corner on the picture
uniform float image_px_per_screen_px;    // side of a screen pixel on the picture

uniform int   comparison;                // see the constants
uniform float wipe;                      // 0 to 1: simulated to the left of it
uniform vec4  covered_px;                // the part that the real image covers: left, top, right, bottom
uniform float simulated_white_dn;
uniform float real_white_dn;
uniform float real_black;                // subtracted from the real image, as a fraction of its white
uniform float real_gain;                 // multiplies it then

uniform float black;                     // level shown black, as a fraction of white
uniform float boost;                     // gain of the stretch
uniform float softening;                 // scale of the asinh stretch; 0 for a linear one
uniform float per_asinh;                 // 1 / asinh(softening)
uniform int   night;                     // 1: shades of red, for dark-adapted eyes

uniform sampler2D colour_map;            // a row of colours, from dark to bright
uniform vec3  more_rgb;                  // colours of a difference: real image brighter, and fainter
uniform vec3  less_rgb;

out vec4 colour;

// glstar.viewer.picture.content has the same numbers.
const int SIMULATED = 0, REAL = 1, WIPE = 2, DIFFERENCE = 3, SIDE_BY_SIDE = 4;
// Largest number of image pixels read along a side of a screen pixel; of more, every second, third ... is read.
const int MAX_TEXELS = 16;

// A nearest, clamped texture gives the same texels by textureLod as by texelFetch, a third faster on software OpenGL.
float dn_at(usampler2D picture, vec2 position) {
    return float(textureLod(picture, position, 0.0).r);
}

#if SHRINKS == 0
// The image pixel that contains the centre of a screen pixel.
float mean_dn(usampler2D picture, vec2 from_px, vec2 to_px) {
    return dn_at(picture, (floor((from_px + to_px) * 0.5) + 0.5) / vec2(textureSize(picture, 0)));
}
#elif SHRINKS == 1
// The mean over a rectangle, weighted by area; it touches at most three image pixels along each side.
float row_dn(usampler2D picture, vec3 columns, float row, vec3 weights) {
    return dot(weights, vec3(dn_at(picture, vec2(columns.x, row)), dn_at(picture, vec2(columns.y, row)),
                             dn_at(picture, vec2(columns.z, row))));
}

float mean_dn(usampler2D picture, vec2 from_px, vec2 to_px) {
    vec2 first = floor(from_px), into_px = to_px - first;
    vec2 weight_0 = min(into_px, 1.0) - (from_px - first);
    vec2 weight_1 = clamp(into_px - 1.0, 0.0, 1.0);
    vec2 weight_2 = clamp(into_px - 2.0, 0.0, 1.0);
    vec3 across = vec3(weight_0.x, weight_1.x, weight_2.x), down = vec3(weight_0.y, weight_1.y, weight_2.y);
    vec2 texel = 1.0 / vec2(textureSize(picture, 0)), centre = (first + 0.5) * texel;
    vec3 columns = centre.x + vec3(0.0, 1.0, 2.0) * texel.x;
    vec3 rows = vec3(row_dn(picture, columns, centre.y, across),
                     row_dn(picture, columns, centre.y + texel.y, across),
                     row_dn(picture, columns, centre.y + 2.0 * texel.y, across));
    return dot(rows, down) / (image_px_per_screen_px * image_px_per_screen_px);
}
#else
// The mean over a rectangle of any size, weighted by area.
float mean_dn(usampler2D picture, vec2 from_px, vec2 to_px) {
    vec2 first = floor(from_px), final = ceil(to_px) - 1.0;
    vec2 stride = floor((final - first) / float(MAX_TEXELS)) + 1.0, texel = 1.0 / vec2(textureSize(picture, 0));
    float sum = 0.0, weights = 0.0;
    for (float y = first.y; y <= final.y; y += stride.y) {
        float tall = min(y + 1.0, to_px.y) - max(y, from_px.y);
        for (float x = first.x; x <= final.x; x += stride.x) {
            float weight = max(tall * (min(x + 1.0, to_px.x) - max(x, from_px.x)), 1e-6);
            sum += weight * dn_at(picture, (vec2(x, y) + 0.5) * texel);
            weights += weight;
        }
    }
    return sum / weights;
}
#endif

// The simulated image as a fraction of white.
float simulated_signal(vec2 from_px, vec2 to_px) {
    return min(mean_dn(simulated, from_px, to_px) / simulated_white_dn, 1.0);
}

#if COMPARES
bool is_covered(vec2 position_px) {
    return all(greaterThanEqual(position_px, covered_px.xy)) && all(lessThan(position_px, covered_px.zw));
}

// The real image as a fraction of white, its black level subtracted and its gain applied.
float real_signal(vec2 from_px, vec2 to_px) {
    if (!is_covered((from_px + to_px) * 0.5))
        return 0.0;
    return clamp((min(mean_dn(real, from_px, to_px) / real_white_dn, 1.0) - real_black) * real_gain, 0.0, 1.0);
}
#endif

// From signal to brightness, both 0 to 1: glstar.viewer.picture.view.Stretch.
float stretched(float signal, float black_level) {
    float linear = clamp((signal - black_level) * boost, 0.0, 1.0);
    float x = softening * linear;
    return softening > 0.0 ? log(x + sqrt(x * x + 1.0)) * per_asinh : linear;
}

vec3 coloured(float brightness) {
#if COLOURED
    float last = float(textureSize(colour_map, 0).x - 1);
    return texelFetch(colour_map, ivec2(int(brightness * last + 0.5), 0), 0).rgb;
#else
    return vec3(brightness);
#endif
}

void main() {
    vec2 screen_px = screen_from_fragment_px.xy + screen_from_fragment_px.zw * floor(gl_FragCoord.xy);
    vec2 from_px = corner_px + screen_px * image_px_per_screen_px;
    vec2 to_px = from_px + image_px_per_screen_px;
    vec2 centre_px = (from_px + to_px) * 0.5;
    vec2 size_px = vec2(textureSize(simulated, 0));
#if COMPARES
    bool right = comparison == SIDE_BY_SIDE && centre_px.x >= size_px.x;
    float shift_px = right ? size_px.x : 0.0;
    from_px.x -= shift_px;
    to_px.x -= shift_px;
    centre_px.x -= shift_px;
    float ours = simulated_signal(from_px, to_px), theirs = real_signal(from_px, to_px);
    bool is_real = comparison == REAL || right || (comparison == WIPE && centre_px.x >= wipe * size_px.x);
    vec3 shown = coloured(stretched(is_real ? theirs : ours, black));
    if (comparison == DIFFERENCE) {
        float brightness = is_covered(centre_px) ? stretched(abs(theirs - ours), 0.0) : 0.0;
        shown = brightness * (theirs > ours ? more_rgb : less_rgb);
    }
#else
    vec3 shown = coloured(stretched(simulated_signal(from_px, to_px), black));
#endif
    bool outside = any(lessThan(centre_px, vec2(0.0))) || any(greaterThanEqual(centre_px, size_px));
    vec3 tinted = night != 0 ? vec3(max(shown.r, max(shown.g, shown.b)), 0.0, 0.0) : shown;
    colour = outside ? backdrop : vec4(tinted, 1.0);
}
