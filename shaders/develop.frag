#version 330 core

// Develop pass: from the noiseless signal to digital numbers.  Crops the guard band and applies the effects of
// glstar/render/effects in their order.
//
// A fragment is one texel of 16 bytes, which holds 16 pixels of 8 bits or 8 pixels of 16 bits side by side.  On software
// OpenGL this takes half the time (tests/bench): fetching the signal of sixteen pixels takes as long as that of one.

// SIXTEEN_BITS: 1 for pixels of 16 bits, 0 for 8 bits.
// OUTPUT: 0 for digital numbers; 1 for these and the largest signal of the fragment's pixels before charge moves along
// lines (glstar/render/opengl/passes/develop.py); 2 for that signal only, of four pixels of chosen lines.
// LINES: 1 if charge moves along columns, 2 along rows, 0 if none has moved or yet to move.

uniform sampler2D signal;         // DN, with the guard band
flat in vec2 image_px;            // width, height without the guard band
flat in vec2 texels_per_px;       // of signal: 1 / width, 1 / height
flat in float guard_band_px;

#if OUTPUT < 2
layout(location = 0) out uvec4 texel;
#else
layout(location = 0) out vec4 quad_dn;
uniform sampler2D chosen_lines;   // the column of each quad or the row
#endif
#if OUTPUT == 1
layout(location = 1) out float largest_dn;
#endif

// Where develop draws the pixels: the column of their fragment and their row, each + 0.5.
vec2 fragment = gl_FragCoord.xy;

// Effects process four neighbouring pixels of a row at a time: quad = (x / 4, y) of the first of them.

vec4 columns_px(uvec2 quad) {
    return float(4u * quad.x) + vec4(0.0, 1.0, 2.0, 3.0);
}

float row_px(uvec2 quad) {
    return float(quad.y);
}

// Number of pixels of a fragment, and the column of their middle, or the last of the image.
const float SPAN_PX = SIXTEEN_BITS == 1 ? 8.0 : 16.0;

float middle_column_px() {
    return min(SPAN_PX * floor(fragment.x) + 0.5 * (SPAN_PX - 1.0), image_px.x - 1.0);
}

// The four pixels of a quad between two columns at which nodes over the image are read: the first column of the quad and
// of the next one, or of all pixels of the fragment, which the compiler shares between quads; at most the image's edge.
float end_column_px(uvec2 quad, bool by_quads, bool last) {
    float column_px = by_quads ? float(4u * (quad.x + (last ? 1u : 0u)))
                               : SPAN_PX * (floor(fragment.x) + (last ? 1.0 : 0.0));
    return min(column_px, image_px.x - 0.5);
}

// Where to read nodes from edge to edge of the image, at the first or at the last of the two columns.
vec2 node_of(ivec2 nodes, uvec2 quad, bool by_quads, bool last) {
    vec2 pixel = vec2(end_column_px(quad, by_quads, last), floor(fragment.y)) + 0.5;
    return (pixel / image_px * (vec2(nodes) - 1.0) + 0.5) / vec2(nodes);
}

vec4 between_nodes(uvec2 quad, bool by_quads, float first, float last) {
    float left_px = end_column_px(quad, by_quads, false), right_px = end_column_px(quad, by_quads, true);
    return mix(vec4(first), vec4(last), (columns_px(quad) - left_px) / (right_px - left_px));
}

#if OUTPUT == 0 && LINES != 0
// The signal of lines whose charge has moved, four pixels a texel, and the number among these of each line.
uniform sampler2D moved_dn, number_of_line;

vec4 with_moved_charge(vec4 signal_dn, uvec2 quad) {
    float line = LINES == 1 ? float(quad.x) : float(quad.y);
    float number = textureLod(number_of_line, vec2((line + 0.5) / float(textureSize(number_of_line, 0).x), 0.5), 0.0).r;
    vec2 at = LINES == 1 ? vec2(number, quad.y) : vec2(quad.x, number);
    return textureLod(moved_dn, (at + 0.5) / vec2(textureSize(moved_dn, 0)), 0.0);
}
#elif OUTPUT == 1
vec4 largest = vec4(0.0);

vec4 with_moved_charge(vec4 signal_dn, uvec2 quad) {
    largest = max(largest, signal_dn);
    return signal_dn;
}
#endif

#include "noise.glsl"
#include "effects.glsl"

vec4 developed_dn(uvec2 quad) {
    // The same texels as texelFetch returns, a quarter faster on software OpenGL.
    vec2 step = vec2(texels_per_px.x, 0.0);
    vec2 first = (vec2(4u * quad.x, quad.y) + 0.5 + guard_band_px) * texels_per_px;
    vec4 signal_dn = vec4(textureLod(signal, first, 0.0).r, textureLod(signal, first + step, 0.0).r,
                          textureLod(signal, first + 2.0 * step, 0.0).r, textureLod(signal, first + 3.0 * step, 0.0).r);
    return with_effects(signal_dn, quad);
}

#if OUTPUT < 2
uvec4 digital_numbers(uvec2 quad) {
    return uvec4(developed_dn(quad));
}

#if SIXTEEN_BITS
uvec2 packed_dn(uvec2 quad) {
    uvec4 dn = digital_numbers(quad);
    return dn.xz | dn.yw << 16;
}
#else
uint packed_dn(uvec2 quad) {
    uvec4 dn = digital_numbers(quad);
    return dn.x | dn.y << 8 | dn.z << 16 | dn.w << 24;
}
#endif

void main() {
    uvec2 quad = uvec2(gl_FragCoord.xy), next = uvec2(1u, 0u);
#if SIXTEEN_BITS
    quad.x *= 2u;
    texel = uvec4(packed_dn(quad), packed_dn(quad + next));
#else
    quad.x *= 4u;
    texel = uvec4(packed_dn(quad), packed_dn(quad + next), packed_dn(quad + 2u * next), packed_dn(quad + 3u * next));
#endif
#if OUTPUT == 1
    largest_dn = max(max(largest.x, largest.y), max(largest.z, largest.w));
#endif
}
#else
void main() {
    uvec2 quad = uvec2(gl_FragCoord.xy);
    uint line = uint(texelFetch(chosen_lines, ivec2(LINES == 1 ? quad.x : quad.y, 0), 0).r);
    quad = LINES == 1 ? uvec2(line, quad.y) : uvec2(quad.x, line);
    fragment = vec2(floor(4.0 * float(quad.x) / SPAN_PX), quad.y) + 0.5;
    quad_dn = developed_dn(quad);
}
#endif
