#version 330 core

// Enlarge pass: light that was drawn at a reduced resolution, in the pixels of a finer target.
//
// Linear interpolation between four pixels: glstar/render/scene/reduction.py has its errors.

uniform sampler2D reduced;        // light per pixel of the image, DN
uniform vec2 texels_per_px, first; // from gl_FragCoord to a position in `reduced`, 0 to 1 across it

out float light_dn;

void main() {
    light_dn = textureLod(reduced, gl_FragCoord.xy * texels_per_px + first, 0.0).r;
}
