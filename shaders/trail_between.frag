#version 330 core

// The light of a star on a long way through one segment of the exposure, at one pixel far from both ends: trail.frag,
// where erf has come to its end.

noperspective in vec2 place;      // s and p, in half widths: trail.frag
flat in vec4 axes;                // how s and p change along x and y, 1/px
flat in vec4 form;                // of p on the way, what goes with s, s^2 and s^3; and see light
flat in vec4 light;               // what is constant, and goes with s and s^2, DN; of what goes with p, what is constant,
                                  // and in form what goes with s
flat in vec4 owned;               // trail.frag

out float light_dn;

float light_at(vec2 place) {
    float s = place.x, from_way = place.y - s * (form.x + s * (form.y + s * form.z));
    // Where s has the pixel on the way, and how much of the way is near, to the first order of the bend and the second
    // of the slope.
    float bent_dn = light.w + s * form.w, slope = form.x + 2.0 * s * form.y, steep = slope * slope;
    float straight_dn = light.x + s * (light.y + s * light.z);
    return exp2(from_way * from_way * (steep - 1.0)) * ((1.0 - 0.5 * steep) * straight_dn + from_way * bent_dn);
}

void main() {
    float along = dot(owned.xy, gl_FragCoord.xy);
    bool is_ours = along >= owned.z && along < owned.w;
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
    light_dn = is_ours ? found : 0.0;
}
