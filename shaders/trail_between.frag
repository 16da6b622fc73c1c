#version 330 core

// The light of a star on a long way through one segment of the exposure, at one pixel far from both ends: trail.frag,
// where erf has come to its end.

noperspective in vec2 place;      // s and p, in half widths: trail.frag
flat in vec4 axes;                // how s and p change along x and y, 1/px
flat in vec4 form;                // length; light where the way begins, DN; bow; light gained per length, DN
flat in vec2 part;                // of s, which is lit

out float light_dn;

float light_at(vec2 place) {
    float length = form.x, first_dn = form.y, bow = form.z, gained_dn = form.w;
    float s = place.x, from_way = place.y - bow * s * (length - s);
    // Where s has the pixel on the way, and how much of the way is near, to the first order of the bend.
    float bent_dn = gained_dn * (0.5 * length - 2.0 * s) - first_dn;
    return exp2(-from_way * from_way) * (first_dn + gained_dn * s + bow * from_way * bent_dn);
}

void main() {
    bool is_ours = place.x >= part.x && place.x < part.y;
#if NARROW
    const float APART_PX = 0.3458319986644865, WEIGHT = 0.31890297;
    const float WEIGHTS[3] = float[3](WEIGHT, 1.0 - 2.0 * WEIGHT, WEIGHT);
    float light = 0.0;
    for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 3; ++column)
            light += WEIGHTS[row] * WEIGHTS[column]
                * light_at(place + APART_PX * (vec2(column - 1, row - 1) * mat2(axes)));
#else
    float light = light_at(place);
#endif
    light_dn = is_ours ? light : 0.0;
}
