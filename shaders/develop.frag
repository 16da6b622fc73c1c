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

// The standard normal deviate of a number between 0 and 1: Giles's approximation of the inverse error function.
float deviate(float probability) {
    float x = 2.0 * probability - 1.0;
    float w = -log((1.0 - x) * (1.0 + x));
    float p;
    if (w < 5.0) {
        w -= 2.5;
        p = 1.50140941 + w * (0.246640727 + w * (-0.00417768164 + w * (-0.00125372503 + w * (0.00021858087
            + w * (-4.39150654e-06 + w * (-3.5233877e-06 + w * (3.43273939e-07 + w * 2.81022636e-08)))))));
    } else {
        w = sqrt(w) - 3.0;
        p = 2.83297682 + w * (1.00167406 + w * (0.00943887047 + w * (-0.0076224613 + w * (0.00573950773
            + w * (-0.00367342844 + w * (0.00134934322 + w * (0.000100950558 + w * -0.000200214257)))))));
    }
    return 1.4142135623730951 * p * x;
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    float exposed_dn = texelFetch(light, pixel + apron_px, 0).r + sky_mean_dn;
    // Not a sum: two rows whose hashes lie near each other would share their noise, shifted.
    uint counter = hash(hash(uint(pixel.y) + hash(seed)) ^ (uint(pixel.x) * 0x9e3779b9u));
    float noisy_dn = exposed_dn + sky_std_dn * deviate((float(counter >> 9) + 0.5) / 8388608.0);
    digital_number = uint(clamp(noisy_dn, 0.0, saturation_dn) + 0.5);
}
