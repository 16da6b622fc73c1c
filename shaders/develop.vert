#version 330 core

// One triangle that covers the image, or with POINTS = 1 a point for each of some fragments, with the numbers that all
// pixels of a frame share.  Software OpenGL reads such an output of the vertex shader in a third of the time that it needs
// for a uniform.

uniform vec2 image_size_px;       // width, height without the guard band
uniform vec2 signal_size_px;      // with the guard band
uniform int signal_border_px;     // width of the guard band
uniform uint noise_seed;
#if POINTS
uniform vec2 target_size;         // fragments
in vec2 point;                    // column and row of a fragment
#endif

flat out vec2 image_px, texels_per_px;
flat out float guard_band_px;
flat out uint seed;
flat out uvec4 seed_hashes;       // see random_bits

#include "hash.glsl"
#include "numbers of effects"

void main() {
#if POINTS
    gl_Position = vec4((point + 0.5) * 2.0 / target_size - 1.0, 0.0, 1.0);
#else
    vec2 corner = vec2((gl_VertexID & 1) * 4 - 1, (gl_VertexID >> 1) * 4 - 1);
    gl_Position = vec4(corner, 0.0, 1.0);
#endif
    image_px = image_size_px;
    texels_per_px = 1.0 / signal_size_px;
    guard_band_px = float(signal_border_px);
    seed = noise_seed;
    seed_hashes = hash(noise_seed + uvec4(0u, 0x3c6ef372u, 0x78dde6e4u, 0xb54cda56u));
    set_numbers_of_effects();
}
