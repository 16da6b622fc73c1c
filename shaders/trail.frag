#version 330 core

// The light of a star on its way through one segment of the exposure, at one pixel.
//
// A Gaussian swept along a straight way at an even rate leaves a Gaussian across and a difference of erf along it.
// This is that, for a way that bends a little, p = bow s (length - s), run at a rate that varies a little: light per
// length 1 + steepness (2 s / length - 1), whose integral against a Gaussian is erf and Gaussians again.
//
// NARROW: pixels that integrate over their area, under a point spread function narrower than 0.7 px.  Three Gaussians
// a side have the moments of a square pixel up to the sixth, whatever the way's direction; from 0.7 px up one widened
// by the pixel's variance does (Sensor.drawn_sigma_px).

flat in vec4 line;                // way.frag
flat in vec4 form;
flat in vec2 part_px;             // of s, which is lit

uniform float sigma_px;
uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): of the logarithm to base 2

out float light_dn;

const float LN_2 = 0.6931471805599453;
const float SQRT_PI = 1.7724538509055159;

// exp(-x^2) and erf(x), Abramowitz & Stegun 7.1.26, to 1.5e-7.
vec2 gaussians(vec2 x) {
    return exp2(x * x / -LN_2);
}

vec2 erf(vec2 x, vec2 gaussian) {
    vec2 t = 1.0 / (1.0 + 0.3275911 * abs(x));
    vec2 tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return sign(x) * (1.0 - tail * gaussian);
}

float light_at(vec2 offset_px) {
    float length_px = form.x, steepness = form.y, bow_per_px = form.z;
    float s = dot(offset_px, line.zw), p = line.z * offset_px.y - line.w * offset_px.x;
    // Beyond its ends the way bends on, for there it meets the neighbouring segments; farther out it goes straight.
    float bent = clamp(s, -2.0 * sigma_px, length_px + 2.0 * sigma_px);
    float slope = bow_per_px * (length_px - 2.0 * bent);
    float from_way = p - bow_per_px * bent * (length_px - bent) - slope * (s - bent);
    float on_way = s + slope * from_way;
    // Towards the centre of the bend more of the way is near.
    float nearer = max(1.0 + 2.0 * bow_per_px * from_way, 0.25);
    float scale = sqrt(LN_2 * falloff_per_px2 * nearer);
    vec2 x = scale * vec2(on_way, length_px - on_way);
    vec2 ends = gaussians(x), integrals = erf(x, ends);
    float per_length = 2.0 * steepness / length_px;
    float evenly = (1.0 + per_length * on_way - steepness) * (integrals.x + integrals.y);
    float unevenly = per_length * (ends.x - ends.y) / (SQRT_PI * scale);
    return exp2(-falloff_per_px2 * from_way * from_way) * (evenly + unevenly) * inversesqrt(nearer);
}

void main() {
    vec2 offset_px = gl_FragCoord.xy - line.xy;
    float s = dot(offset_px, line.zw);
    bool is_ours = s >= part_px.x && s < part_px.y;
#if NARROW
    const float APART_PX = 0.3458319986644865, WEIGHT = 0.31890297;
    const float WEIGHTS[3] = float[3](WEIGHT, 1.0 - 2.0 * WEIGHT, WEIGHT);
    float light = 0.0;
    for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 3; ++column)
            light += WEIGHTS[row] * WEIGHTS[column] * light_at(offset_px + APART_PX * vec2(column - 1, row - 1));
#else
    float light = light_at(offset_px);
#endif
    light_dn = is_ours ? form.w * max(light, 0.0) : 0.0;
}
