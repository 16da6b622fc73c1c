#version 330 core

// The image as the camera's processing writes it, on the screen: zoom only, no display stretch.
//
// A screen pixel is the mean of the values that it covers, as image viewers show them.  A magnified image pixel is a
// square.  Positions are px from the picture's top-left corner, y down; row 0 of the texture is the top.

uniform usampler2D processed;            // red, green and blue, 0 to 255
uniform vec4  screen_from_fragment_px;   // the target's position in the panel, and its directions across and down
uniform vec4  backdrop;                  // colour behind the picture
uniform vec2  corner_px;                 // position of the panel's top-left corner on the picture
uniform float image_px_per_screen_px;    // side of a screen pixel on the picture
uniform int   night;                     // 1: shades of red, for dark-adapted eyes

out vec4 colour;

// Largest number of image pixels read along a side of a screen pixel; of more, every second, third ... is read.
const int MAX_TEXELS = 16;
const float WHITE = 255.0;

vec3 value_at(vec2 position_px) {
    return vec3(texelFetch(processed, clamp(ivec2(position_px), ivec2(0), textureSize(processed, 0) - 1), 0).rgb);
}

// The mean over a rectangle, weighted by area.
vec3 mean_value(vec2 from_px, vec2 to_px) {
    vec2 first = floor(from_px), final = ceil(to_px) - 1.0;
    vec2 stride = floor((final - first) / float(MAX_TEXELS)) + 1.0;
    vec3 sum = vec3(0.0);
    float weights = 0.0;
    for (float y = first.y; y <= final.y; y += stride.y) {
        float tall = min(y + 1.0, to_px.y) - max(y, from_px.y);
        for (float x = first.x; x <= final.x; x += stride.x) {
            float weight = max(tall * (min(x + 1.0, to_px.x) - max(x, from_px.x)), 1e-6);
            sum += weight * value_at(vec2(x, y));
            weights += weight;
        }
    }
    return sum / weights;
}

void main() {
    vec2 screen_px = screen_from_fragment_px.xy + screen_from_fragment_px.zw * floor(gl_FragCoord.xy);
    vec2 from_px = corner_px + screen_px * image_px_per_screen_px;
    vec2 to_px = from_px + image_px_per_screen_px;
    vec2 centre_px = (from_px + to_px) * 0.5;
    vec2 size_px = vec2(textureSize(processed, 0));
    vec3 value = image_px_per_screen_px > 1.0 ? mean_value(from_px, to_px) : value_at(floor(centre_px));
    vec3 shown = value / WHITE;
    bool outside = any(lessThan(centre_px, vec2(0.0))) || any(greaterThanEqual(centre_px, size_px));
    vec3 tinted = night != 0 ? vec3(max(shown.r, max(shown.g, shown.b)), 0.0, 0.0) : shown;
    colour = outside ? backdrop : vec4(tinted, 1.0);
}
