#version 330 core

// The light of a star on its way through one segment of the exposure, at one pixel.
//
// A Gaussian swept along a straight way at an even rate leaves a Gaussian across and a difference of erf along it.
// This is that, for a way that bends a little, run at a rate that varies a little (way.frag has both): light per length
// is a quadratic, whose integral against a Gaussian is erf and Gaussians again.
//
// Lengths are told in half widths of the point spread at half its maximum, where exp2(-1) of the light is left: no
// uniform is wanted then, which software OpenGL looks up anew for every pixel.
//
// NARROW: pixels that integrate over their area, under a point spread function narrower than 0.7 px.  Three Gaussians
// a side have the moments of a square pixel up to the sixth, whatever the way's direction; from 0.7 px up one widened
// by the pixel's variance does (Sensor.drawn_sigma_px).

flat in vec2 origin_px;           // where s = p = 0, as gl_FragCoord has it
flat in vec4 axes;                // how s and p change along x and y, 1/px
flat in vec4 form;                // way.frag: length, 1 / length; bow; skew
flat in vec3 light;               // and steepness; hollow; amplitude, DN
flat in vec2 beside;              // of p, which is lit: from, to
flat in vec4 owned;               // an axis (x, y), and from where to where along it pixels are drawn here: way.frag

out float light_dn;

const float TWO_SIGMA = 1.6986436005760382;     // in half widths: 2 / sqrt(2 ln 2)
const float SQRT_LN_2 = 0.8325546111576977;
const float INV_SQRT_PI_LN_2 = 0.6776658635;    // 1 / sqrt(pi ln 2)
const float HALF_LOG2_E = 0.7213475204444817;   // 1 / (2 ln 2): the variance of exp2(-x^2)

// Both erf(sqrt(ln 2) x) of x and exp2(-x^2), Abramowitz & Stegun 7.1.26, to 1.5e-7.
vec2 erf(vec2 x, vec2 gaussian) {
    vec2 b = 1.0 + (0.3275911 * SQRT_LN_2) * abs(x);
    vec2 t = b.yx / (b.x * b.y);
    vec2 tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return sign(x) * (1.0 - tail * gaussian);
}

float light_at(vec2 place) {
    float length = form.x, per_length = form.y, bow = form.z, skew = form.w, steepness = light.x, hollow = light.y;
    // Beyond its ends the way bends on, for there it meets the neighbouring segments; farther out it goes straight.
    float s = place.x, bent = clamp(s, -TWO_SIGMA, length + TWO_SIGMA);
    float passed = bent * per_length, m = 2.0 * passed - 1.0, left = 1.0 - passed;
    float slope = skew * (6.0 * passed * left - 1.0) - bow * m;
    float from_way = place.y - bent * left * (bow + skew * m) - slope * (s - bent);
    // Where it is slanted, and away from the centre of its bend, less of the way is near; and nearer than p says.
    float sharpness = max(1.0 + slope * slope + 2.0 * per_length * (bow + 3.0 * skew * m) * from_way, 0.25);
    float nearer = inversesqrt(sharpness), leans = slope * from_way / sharpness, on_way = s + leans;
    vec2 x = vec2(on_way, length - on_way) / nearer;
    vec2 ends = exp2(-x * x), integrals = erf(x, ends);
    // The light per length as a quadratic around there, and what a Gaussian leaves of each of its powers between the ends.
    float at = 2.0 * per_length * on_way - 1.0, scale = 2.0 * per_length * nearer;
    vec3 powers = vec3(1.0 + steepness * at + hollow * (at * at - 0.3333333), scale * (steepness + 2.0 * hollow * at),
                       scale * scale * hollow);
    float between = integrals.x + integrals.y;
    vec3 moments = vec3(between, INV_SQRT_PI_LN_2 * (ends.x - ends.y),
                        HALF_LOG2_E * between - INV_SQRT_PI_LN_2 * dot(x, ends));
    return exp2(from_way * (slope * leans - from_way)) * dot(powers, moments) * nearer;
}

void main() {
    vec2 place = (gl_FragCoord.xy - origin_px) * mat2(axes);
    float along = dot(owned.xy, gl_FragCoord.xy);
    bool is_ours = along >= owned.z && along < owned.w && place.y >= beside.x && place.y < beside.y;
#if NARROW
    const float APART_PX = 0.3458319986644865, WEIGHT = 0.31890297;
    const float WEIGHTS[3] = float[3](WEIGHT, 1.0 - 2.0 * WEIGHT, WEIGHT);
    float found = 0.0;
    for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 3; ++column)
            found += WEIGHTS[row] * WEIGHTS[column]
                * light_at(place + APART_PX * (vec2(column - 1, row - 1) * mat2(axes)));
#else
    float found = light_at(place);
#endif
    light_dn = is_ours ? light.z * max(found, 0.0) : 0.0;
}
