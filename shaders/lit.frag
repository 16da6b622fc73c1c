#version 330 core

// Whether there is any light in a block of pixels: most of the sky is dark, and need not be gathered.

uniform sampler2D light;
uniform int block_px;

out float lit;

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * block_px;
    ivec2 past = min(first + block_px, textureSize(light, 0));
    float most = 0.0;
    for (int row = first.y; row < past.y; ++row) {
        for (int column = first.x; column < past.x; ++column) {
            most = max(most, texelFetch(light, ivec2(column, row), 0).r);
        }
    }
    lit = most > 0.0 ? 1.0 : 0.0;
}
