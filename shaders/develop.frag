#version 330 core

// From light to digital numbers: crop the apron, add the sky and its noise (Teague & Chahl eq. (40), once, to the
// sum), saturate, round.
//
// A fragment is all the pixels that fill a texel of 16 bytes, side by side: the same bytes, in half the time on software
// OpenGL (tests/bench), which waits for the light of sixteen pixels as long as for that of one.  The noise is counted,
// not drawn: a hash of pixels and seed, the same on every run.

// SIXTEEN_BITS: of a pixel; else there are eight.

uniform sampler2D light;          // DN
uniform int   apron_px;
uniform uint  seed;
uniform float sky_mean_dn;
uniform float sky_std_dn;
uniform float saturation_dn;

out uvec4 texel;

// Chris Wellons's lowbias32: every bit of the input turns half of the bits of the output.
uvec4 hash(uvec4 x) {
    x ^= x >> 16;  x *= 0x7feb352du;
    x ^= x >> 15;  x *= 0x846ca68bu;
    x ^= x >> 16;
    return x;
}

// Four standard normal deviates of four words of random bits: Box and Muller's.  The angle is one within 45 deg of the
// x axis, whose sine and cosine are short polynomials (Cephes), turned into one of four quarters.
vec4 deviates(uvec4 words) {
    const float HALF_PI = 1.5707963267948966, MINUS_2_LN_2 = -1.3862943611198906;
    vec2 radius = sqrt(MINUS_2_LN_2 * log2((vec2(words.xy >> 8) + 0.5) / 16777216.0));
    vec2 angle = HALF_PI * ((vec2(words.zw >> 9) + 0.5) / 8388608.0 - 0.5);
    vec2 square = angle * angle;
    vec2 sine = angle * (1.0 + square * (-1.6666654611e-1 + square * (8.3321608736e-3 - square * 1.9515295891e-4)));
    vec2 cosine = 1.0 - 0.5 * square
        + square * square * (4.166664568298827e-2 + square * (-1.388731625493765e-3 + square * 2.443315711809948e-5));
    cosine = mix(cosine, -cosine, equal(words.zw & 1u, uvec2(0u)));
    bvec2 turned = equal(words.zw & 2u, uvec2(0u));
    return vec4(radius * mix(cosine, sine, turned), radius * mix(sine, cosine, turned));
}

// Four pixels side by side.
uvec4 digital_numbers(uvec2 place) {
    // The same texels as texelFetch gives, a quarter faster on software OpenGL.
    vec2 step = vec2(1.0 / float(textureSize(light, 0).x), 0.0);
    vec2 first = vec2(4u * place.x, place.y) + 0.5 + float(apron_px);
    first /= vec2(textureSize(light, 0));
    vec4 light_dn = vec4(textureLod(light, first, 0.0).r, textureLod(light, first + step, 0.0).r,
                         textureLod(light, first + 2.0 * step, 0.0).r, textureLod(light, first + 3.0 * step, 0.0).r);

    // Not a sum: two rows whose hashes lie near each other would share their noise, shifted.
    // Four rows of hashes, for of a million hashes of 32 bits some are alike, but never four of four.
    uvec4 rows = hash(place.y + hash(seed + uvec4(0u, 0x3c6ef372u, 0x78dde6e4u, 0xb54cda56u)));
    uvec4 words = hash(rows ^ (place.x * 0x9e3779b9u));
    vec4 noisy_dn = light_dn + sky_mean_dn + sky_std_dn * deviates(words);
    return uvec4(clamp(noisy_dn, 0.0, saturation_dn) + 0.5);
}

#if SIXTEEN_BITS
uvec2 packed_dn(uvec2 place) {
    uvec4 dn = digital_numbers(place);
    return dn.xz | dn.yw << 16;
}
#else
uint packed_dn(uvec2 place) {
    uvec4 dn = digital_numbers(place);
    return dn.x | dn.y << 8 | dn.z << 16 | dn.w << 24;
}
#endif

void main() {
    uvec2 place = uvec2(gl_FragCoord.xy), next = uvec2(1u, 0u);
#if SIXTEEN_BITS
    place.x *= 2u;
    texel = uvec4(packed_dn(place), packed_dn(place + next));
#else
    place.x *= 4u;
    texel = uvec4(packed_dn(place), packed_dn(place + next), packed_dn(place + 2u * next), packed_dn(place + 3u * next));
#endif
}
