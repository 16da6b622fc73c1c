// Fractions of the flux of a star that a primitive draws.  The rest is given back to what it draws.

// COMPONENTS: of star_path.frag, which sets the width.
#if COMPONENTS
float effective_sigma_px;
#else
uniform float effective_sigma_px; // of the star as the pixels of the target record it
#endif

#include "gaussian_tail.glsl"
#include "two_gaussians.glsl"

// Tail of the Gaussian of a star beyond a distance, and the integral of tails from there, in standard deviations.
vec2 gaussian_tail(float distance_px) {
    return unit_gaussian_tail(distance_px / effective_sigma_px);
}

// Fraction of a path's flux between two bounds along an axis, both at the same distance from the path's ends.
float fraction_within(float distance_px, float extent_px) {
    float extent = max(extent_px / effective_sigma_px, 0.1);
    return 1.0 - 2.0 * (gaussian_tail(distance_px).y - gaussian_tail(distance_px + extent * effective_sigma_px).y) / extent;
}

// Fraction of the flux of a path inside a square that encloses it.
float fraction_in_square(float side_px, vec2 extent_px) {
    vec2 distance_px = 0.5 * (side_px - extent_px);
    return fraction_within(distance_px.x, extent_px.x) * fraction_within(distance_px.y, extent_px.y);
}

// Of a path as two Gaussians that is drawn up to a distance from their centres.
float fraction_of_two_gaussians(float margin_px, vec2 chord) {
    vec2 extent_px = abs(chord);
    return fraction_in_square(2.0 * (margin_px + OFFSET * max(extent_px.x, extent_px.y)), extent_px);
}
