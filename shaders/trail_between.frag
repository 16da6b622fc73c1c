#version 330 core

// The light of a star on a long way through one segment of the exposure, at one pixel far from both ends: trail.frag,
// where erf has come to its end.

flat in vec2  origin_px;
flat in vec2  along;
flat in float length_px;
flat in float steepness;
flat in float bow_per_px;
flat in float amplitude_dn;

uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): of the logarithm to base 2

out float light_dn;

float light_at(vec2 offset_px) {
    float s = dot(offset_px, along), p = along.x * offset_px.y - along.y * offset_px.x;
    float from_way = p - bow_per_px * s * (length_px - s);
    float on_way = s + bow_per_px * (length_px - 2.0 * s) * from_way;
    float evenly = 1.0 + steepness * (2.0 * on_way / length_px - 1.0) - bow_per_px * from_way;
    return exp2(-falloff_per_px2 * from_way * from_way) * evenly;
}

void main() {
    vec2 offset_px = gl_FragCoord.xy - 0.5 - origin_px;
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
    light_dn = 2.0 * amplitude_dn * light;
}
