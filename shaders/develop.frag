#version 330 core

// Develop pass: from the noiseless signal to digital numbers.  Crops the guard band and applies the effects of
// glstar/render/effects in their order.
//
// A fragment is one texel of 16 bytes, which holds 16 pixels of 8 bits or 8 pixels of 16 bits side by side.  On software
// OpenGL this takes half the time (tests/bench): fetching the signal of sixteen pixels takes as long as that of one.

// SIXTEEN_BITS: 1 for pixels of 16 bits, 0 for 8 bits.

uniform sampler2D signal;         // DN, with the guard band
flat in vec2 image_px;            // width, height without the guard band
flat in vec2 texels_per_px;       // of signal: 1 / width, 1 / height
flat in float guard_band_px;

out uvec4 texel;

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
    return min(SPAN_PX * floor(gl_FragCoord.x) + 0.5 * (SPAN_PX - 1.0), image_px.x - 1.0);
}

// The four pixels of a quad between two columns at which nodes over the image are read: the first column of the quad and
// of the next one, or of all pixels of the fragment, which the compiler shares between quads; at most the image's edge.
float end_column_px(uvec2 quad, bool by_quads, bool last) {
    float column_px = by_quads ? float(4u * (quad.x + (last ? 1u : 0u)))
                               : SPAN_PX * (floor(gl_FragCoord.x) + (last ? 1.0 : 0.0));
    return min(column_px, image_px.x - 0.5);
}

// Where to read nodes from edge to edge of the image, at the first or at the last of the two columns.
vec2 node_of(ivec2 nodes, uvec2 quad, bool by_quads, bool last) {
    vec2 pixel = vec2(end_column_px(quad, by_quads, last), floor(gl_FragCoord.y)) + 0.5;
    return (pixel / image_px * (vec2(nodes) - 1.0) + 0.5) / vec2(nodes);
}

vec4 between_nodes(uvec2 quad, bool by_quads, float first, float last) {
    float left_px = end_column_px(quad, by_quads, false), right_px = end_column_px(quad, by_quads, true);
    return mix(vec4(first), vec4(last), (columns_px(quad) - left_px) / (right_px - left_px));
}

#include "noise.glsl"
#include "effects.glsl"

uvec4 digital_numbers(uvec2 quad) {
    // The same texels as texelFetch returns, a quarter faster on software OpenGL.
    vec2 step = vec2(texels_per_px.x, 0.0);
    vec2 first = (vec2(4u * quad.x, quad.y) + 0.5 + guard_band_px) * texels_per_px;
    vec4 signal_dn = vec4(textureLod(signal, first, 0.0).r, textureLod(signal, first + step, 0.0).r,
                          textureLod(signal, first + 2.0 * step, 0.0).r, textureLod(signal, first + 3.0 * step, 0.0).r);
    return uvec4(with_effects(signal_dn, quad));
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
}
