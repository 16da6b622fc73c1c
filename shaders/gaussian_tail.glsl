const float INV_SQRT_2_PI = 0.3989422804014327;

// Tail of the unit Gaussian beyond z >= 0, and its integral from there: Abramowitz & Stegun 26.2.16, to 1e-5.
vec2 unit_gaussian_tail(float z) {
    float density = INV_SQRT_2_PI * exp(-0.5 * z * z), t = 1.0 / (1.0 + 0.33267 * z);
    float tail = density * t * (0.4361836 + t * (-0.1201676 + t * 0.9372980));
    return vec2(tail, density - z * tail);
}
