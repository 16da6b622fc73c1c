#version 330 core

// From light to digital numbers: crop the apron, add the sky and its noise (Teague & Chahl eq. (40), once, to the
// sum), saturate, round.
//
// The noise is counted, not drawn: a hash of pixel and seed, the same on every run.

uniform sampler2D light;          // DN
uniform int   apron_px;
uniform uint  seed;
uniform float sky_mean_dn;
uniform float sky_std_dn;
uniform float saturation_dn;

out uint digital_number;

// Chris Wellons's lowbias32: every bit of the input turns half of the bits of the output.
uint hash(uint x) {
    x ^= x >> 16;  x *= 0x7feb352du;
    x ^= x >> 15;  x *= 0x846ca68bu;
    x ^= x >> 16;
    return x;
}

// A standard normal deviate (Box and Muller) of 24 + 24 bits.
float deviate(uint counter) {
    uint again = hash(counter ^ 0x9e3779b9u);
    float u = (float(counter >> 8) + 0.5) / 16777216.0;
    float v = float(again >> 8) / 16777216.0;
    return sqrt(-2.0 * log(u)) * cos(6.283185307179586 * v);
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float exposed_dn = texelFetch(light, pixel + apron_px, 0).r + sky_mean_dn;
    uint counter = hash(uint(pixel.x) + hash(uint(pixel.y) + hash(seed)));
    float noisy_dn = exposed_dn + sky_std_dn * deviate(counter);
    digital_number = uint(clamp(noisy_dn, 0.0, saturation_dn) + 0.5);
}
