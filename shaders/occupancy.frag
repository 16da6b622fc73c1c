#version 330 core

// Distortion pass: which blocks of pixels have any flux.  Most of the sky is dark and need not be resampled.

// BLOCK_PX: side of a block.

uniform sampler2D light;          // undistorted; zero outside

out float occupancy;

void main() {
    // The same texels as texelFetch returns, in less time on software OpenGL.
    vec2 texel = 1.0 / vec2(textureSize(light, 0)), first = floor(gl_FragCoord.xy) * float(BLOCK_PX) + 0.5;
    float sum = 0.0;
    for (int row = 0; row < BLOCK_PX; ++row) {
        for (int column = 0; column < BLOCK_PX; ++column) {
            sum += textureLod(light, (first + vec2(column, row)) * texel, 0.0).r;
        }
    }
    occupancy = sum > 0.0 ? 1.0 : 0.0;
}
