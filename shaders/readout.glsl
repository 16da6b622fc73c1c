// Rolling shutter: when the row of a pixel opens, and which part of a segment it records.
//
// Times are fractions of the exposure, from the opening of the first row (0) to the closing of the last (1).  A pixel is
// open when its own row is, wherever the star is whose light it gathers, so that limits of integrals are functions of the
// pixel's row only, and exact for the wings of the point spread function too.
//
// ROWS: 1 under a rolling shutter.

uniform vec3  opening;            // opening time of a position: coefficients of x, y (coordinates of gl_FragCoord) and 1
uniform float open_time;          // for which each row is open

float opening_at(vec2 position_px) {
    return dot(opening, vec3(position_px, 1.0));
}

// Elapsed fractions of a segment at which the row of a pixel opens and closes.  clock: start of the segment, and 1 / its
// duration.
vec2 elapsed_while_open(vec2 position_px, vec2 clock) {
    float opens = opening_at(position_px);
    return clamp((vec2(opens, opens + open_time) - clock.x) * clock.y, 0.0, 1.0);
}

// Fractions of the length of a path at elapsed fractions of its time.  Its flux per length is 1 + slope m + curvature
// (m^2 - 1/3), m = 2 s - 1 (star_path.frag): the time at s is the integral of that.
vec2 lengths_at(vec2 elapsed, float slope, float curvature) {
    vec2 s = elapsed;
    for (int step = 0; step < 4; ++step) {
        vec2 m = 2.0 * s - 1.0, to_ends = s * (1.0 - s);
        vec2 late = s - to_ends * (slope + 0.6666667 * curvature * m) - elapsed;
        s = clamp(s - late / max(1.0 + slope * m + curvature * (0.6666667 - 4.0 * to_ends), 0.1), 0.0, 1.0);
    }
    return s;
}
