// Counter-based random numbers: a hash of pixel and seed, the same on every run and every driver.

flat in uint seed;
flat in uvec4 seed_hashes;

#include "hash.glsl"

// Which of four pixels have their shot noise already: those that may be full.
bvec4 has_shot_noise = bvec4(false);

// Random bits of four neighbouring pixels of a row.
uvec4 random_bits(uvec2 quad) {
    // Row and column are hashed one after the other: with a sum of their hashes, two rows whose hashes are close would
    // have the same noise, shifted.  Four hashes per row, because some of a million hashes of 32 bits are equal, but
    // never four at once.
    uvec4 rows = hash(quad.y + seed_hashes);
    return hash(rows ^ (quad.x * 0x9e3779b9u));
}

// Four standard normal deviates from random bits (Box-Muller).  The angle is within 45 deg of the x axis, where short
// polynomials give sine and cosine (Cephes), and is then rotated into one of four quadrants.
vec4 normal_deviates(uvec4 bits) {
    const float HALF_PI = 1.5707963267948966, MINUS_2_LN_2 = -1.3862943611198906;
    vec2 radius = sqrt(MINUS_2_LN_2 * log2((vec2(bits.xy >> 8) + 0.5) / 16777216.0));
    vec2 angle = HALF_PI * ((vec2(bits.zw >> 9) + 0.5) / 8388608.0 - 0.5);
    vec2 square = angle * angle;
    vec2 sine = angle * (1.0 + square * (-1.6666654611e-1 + square * (8.3321608736e-3 - square * 1.9515295891e-4)));
    vec2 cosine = 1.0 - 0.5 * square
        + square * square * (4.166664568298827e-2 + square * (-1.388731625493765e-3 + square * 2.443315711809948e-5));
    cosine = mix(cosine, -cosine, equal(bits.zw & 1u, uvec2(0u)));
    bvec2 turned = equal(bits.zw & 2u, uvec2(0u));
    return vec4(radius * mix(cosine, sine, turned), radius * mix(sine, cosine, turned));
}

// Poisson counts of four pixels, DN, from their means and normal deviates, with the third moment.
vec4 counted_dn(vec4 mean_dn, float dn_per_e, uvec2 quad) {
    vec4 z = normal_deviates(random_bits(quad + uvec2(0u, 0x40000000u)));
    float h_dn = dn_per_e / 6.0;
    return mean_dn - h_dn + z * (sqrt(max(mean_dn * dn_per_e - 2.0 * h_dn * h_dn, 0.0)) + h_dn * z);
}
