#version 330 core

// Light as a pinhole has it, gathered by the pixels behind a lens.
//
// A pixel is a patch of the image; the lens makes it a patch of the pinhole's plane, with corners that were computed in
// float64.  What falls into the patch is the pixel's: a lens moves light, it makes and loses none.  Light between the
// pixels of the pinhole's is a cubic B-spline: wider than what it goes through by 1/3 px^2 at every place alike,
// by which stars were drawn narrower (glstar/gl/warp.py).

uniform sampler2D light;          // DN a pixel of the pinhole's
uniform sampler2D shift_px;       // by how much corners of pixels stand elsewhere in the pinhole's plane, px of the image
uniform vec2  origin_px;          // where the pinhole's light begins
uniform float finer;              // how many of its pixels are one of the image
uniform int   apron_px;
uniform int   least_samples;      // along each side of a pixel
uniform int   most_samples;

out float light_dn;

const float NOWHERE_PX = 1e8;     // corners farther off see nothing

float cross_product(vec2 a, vec2 b) {
    return a.x * b.y - a.y * b.x;
}

// The weights of four pixels in a row for a place so far behind the second of them.
vec4 spline(float t) {
    float u = 1.0 - t, t2 = t * t, u2 = u * u;
    return vec4(u2 * u, 4.0 - 3.0 * t2 * (2.0 - t), 4.0 - 3.0 * u2 * (2.0 - u), t2 * t) / 6.0;
}

float light_at(vec2 place_px) {
    vec2 before = floor(place_px);
    vec4 across = spline(place_px.x - before.x), down = spline(place_px.y - before.y);
    ivec2 pixel = ivec2(before);
    float sum = 0.0;
    for (int row = 0; row < 4; ++row) {
        vec4 lights = vec4(
            texelFetch(light, pixel + ivec2(-1, row - 1), 0).r, texelFetch(light, pixel + ivec2(0, row - 1), 0).r,
            texelFetch(light, pixel + ivec2(1, row - 1), 0).r, texelFetch(light, pixel + ivec2(2, row - 1), 0).r);
        sum += down[row] * dot(across, lights);
    }
    return sum;
}

void main() {
    light_dn = 0.0;
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec2 top_left     = texelFetch(shift_px, pixel, 0).rg;
    vec2 top_right    = texelFetch(shift_px, pixel + ivec2(1, 0), 0).rg + vec2(1.0, 0.0);
    vec2 bottom_left  = texelFetch(shift_px, pixel + ivec2(0, 1), 0).rg + vec2(0.0, 1.0);
    vec2 bottom_right = texelFetch(shift_px, pixel + ivec2(1, 1), 0).rg + vec2(1.0, 1.0);
    if (max(max(top_left.x, top_right.x), max(bottom_left.x, bottom_right.x)) > NOWHERE_PX) {
        return;
    }
    vec2 start_px = (vec2(pixel) - 0.5 - origin_px) * finer + float(apron_px);
    float area = 0.5 * abs(cross_product(bottom_right - top_left, bottom_left - top_right)) * finer * finer;
    float side = finer * max(max(distance(top_left, top_right), distance(bottom_left, bottom_right)),
                             max(distance(top_left, bottom_left), distance(top_right, bottom_right)));
    // Half a pixel apart a spline's ripples cancel.
    int samples = clamp(int(ceil(2.0 * side - 0.05)), least_samples, most_samples);
    float sum = 0.0;
    for (int row = 0; row < samples; ++row) {
        float down = (float(row) + 0.5) / float(samples);
        vec2 left = mix(top_left, bottom_left, down), right = mix(top_right, bottom_right, down);
        for (int column = 0; column < samples; ++column) {
            float across = (float(column) + 0.5) / float(samples);
            sum += light_at(start_px + finer * mix(left, right, across));
        }
    }
    light_dn = area * sum / float(samples * samples);
}
