#version 330 core

// The light of a star on a short way through one segment of the exposure, at one pixel: two Gaussians, each a little
// longer along the way than across it, with the moments of light that is spread over the way (way.frag).
//
// NARROW: see trail.frag.

flat in vec4 line;                // way.frag: two centres, as gl_FragCoord has them
flat in vec4 form;                // a unit vector; how much less light falls off along it
flat in vec2 amplitudes_dn;

uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): of the logarithm to base 2

out float light_dn;

float light_at(vec2 pixel) {
    vec4 offsets_px = pixel.xyxy - line;
    vec4 squares_px2 = offsets_px * offsets_px;
    vec2 s = form.x * offsets_px.xz + form.y * offsets_px.yw;
    vec2 gaussians = exp2(form.zw * s * s - falloff_per_px2 * (squares_px2.xz + squares_px2.yw));
    return dot(amplitudes_dn, gaussians);
}

void main() {
    vec2 pixel = gl_FragCoord.xy;
#if NARROW
    const float APART_PX = 0.3458319986644865, WEIGHT = 0.31890297;
    const float WEIGHTS[3] = float[3](WEIGHT, 1.0 - 2.0 * WEIGHT, WEIGHT);
    light_dn = 0.0;
    for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 3; ++column)
            light_dn += WEIGHTS[row] * WEIGHTS[column] * light_at(pixel + APART_PX * vec2(column - 1, row - 1));
#else
    light_dn = light_at(pixel);
#endif
}
