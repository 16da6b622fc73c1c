#version 330 core

// The light of a star on a long way through one segment of the exposure, at one pixel far from both ends: trail.frag,
// where erf has come to its end.

flat in vec4 line;                // way.frag
flat in vec4 form;                // length; light where the way begins, DN; bow; light gained per px
flat in vec2 part_px;             // of s, which is lit

uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): of the logarithm to base 2

out float light_dn;

float light_at(vec2 offset_px) {
    float length_px = form.x, first_dn = form.y, bow_per_px = form.z, dn_per_px = form.w;
    float s = dot(offset_px, line.zw), p = line.z * offset_px.y - line.w * offset_px.x;
    float from_way = p - bow_per_px * s * (length_px - s);
    // Where s has the pixel on the way, and how much of the way is near, to the first order of the bend.
    float bent_dn = dn_per_px * (0.5 * length_px - 2.0 * s) - first_dn;
    return exp2(-falloff_per_px2 * from_way * from_way) * (first_dn + dn_per_px * s + bow_per_px * from_way * bent_dn);
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
    light_dn = is_ours ? light : 0.0;
}
