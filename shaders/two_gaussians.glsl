// A uniform motion as two Gaussians: star_path.frag, end_pieces.vert, trail_short.frag.
//
// Two Gaussians at the times 1/2 -+ OFFSET of a uniform motion of duration 1, each as wide as a motion over a time with
// variance VARIANCE, have its moments up to the seventh order.
// COMPONENTS: of star_path.frag.  Then both are the same Gaussian, with the variance of the motion, which is at most half a
// standard deviation of the star: that differs by 1e-4 of the peak.
#if COMPONENTS
const float OFFSET = 0.0, VARIANCE = 1.0 / 12.0, RATE_CHANGE = 0.0;
#else
const float OFFSET = 0.2540669, VARIANCE = 0.0187834;
// Of a motion whose speed or direction changes evenly, position u chord + 4 u (1 - u) ahead, each Gaussian is widened along
// chord +- RATE_CHANGE ahead: then the third moments are those of the motion too, to first order of ahead.  RATE_CHANGE is
// (12 / 180) / (6 OFFSET VARIANCE); the change of the rate itself would be 8 OFFSET = 2.03.
const float RATE_CHANGE = 2.3282816;
#endif
const float LN_2 = 0.6931471805599453;

// A vector whose product with the distance from the centre, squared, is the exponent (of 2) by which a Gaussian of standard
// deviation sigma_px is widened along a motion, 1/px.  relative: its peak divided by that of the Gaussian at rest.
vec2 widening_per_px(vec2 rate_px, float sigma_px, out float relative) {
    float variance_px2 = sigma_px * sigma_px + VARIANCE * dot(rate_px, rate_px);
    relative = sigma_px * inversesqrt(variance_px2);
    return rate_px * (sqrt(0.5 * VARIANCE / LN_2) * inversesqrt(variance_px2) / sigma_px);
}

struct TwoGaussians {
    vec4 centres_px;
    vec4 shape;                   // vectors along which they are widened, 1/px
    vec2 amplitudes_dn;
};

// The part of a motion between two elapsed fractions of its time; amplitude_dn is that of a Gaussian that does not move.
TwoGaussians part_of_motion(vec2 elapsed, vec2 start_px, vec2 chord, vec2 ahead_px, float sigma_px, float amplitude_dn) {
    float part = elapsed.y - elapsed.x, middle = 0.5 * (elapsed.x + elapsed.y);
    vec2 times = middle + OFFSET * part * vec2(-1.0, 1.0);
    vec2 off_chord = 4.0 * times * (1.0 - times) - 4.0 * VARIANCE * part * part;
    vec4 centres_px = start_px.xyxy + times.xxyy * chord.xyxy + off_chord.xxyy * ahead_px.xyxy;
    vec2 chord_of_part = part * (chord + (4.0 - 8.0 * middle) * ahead_px), change = RATE_CHANGE * part * part * ahead_px;
    vec2 relative;
    vec4 shape = vec4(widening_per_px(chord_of_part + change, sigma_px, relative.x),
                      widening_per_px(chord_of_part - change, sigma_px, relative.y));
    return TwoGaussians(centres_px, shape, 0.5 * part * amplitude_dn * relative);
}
