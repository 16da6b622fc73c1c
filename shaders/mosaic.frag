#version 330 core

// Mosaic pass: keeps the signal of one colour in its pixels, and discards it in the others.

uniform sampler2D signal;         // of all pixels in this colour, DN, with the guard band
uniform int guard_band_px;
uniform ivec4 is_kept;            // 1 for pixels (even column, even row), (odd, even), (even, odd), (odd, odd)

out float light_dn;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    ivec2 parity = (texel + guard_band_px) & 1;   // of the pixel: the guard band may be odd
    if (is_kept[2 * parity.y + parity.x] == 0) {
        discard;
    }
    light_dn = texelFetch(signal, texel, 0).r;
}
