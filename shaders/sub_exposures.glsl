// Which part of four sub-exposures the row of a pixel records, and where the star is then: star.frag, star_erf.frag.
//
// Without a rolling shutter, all of them at their own positions.

#if ROWS
flat in vec2 step_px;             // star.vert
flat in float first_number;
uniform float sub_time;           // duration of a sub-exposure, as a fraction of the exposure

#include "readout.glsl"

vec4 open_fractions, late;        // of each sub-exposure: the open fraction, and its middle minus that of the sub-exposure

void set_open_fractions() {
    vec4 opens = vec4(opening_at(gl_FragCoord.xy));
    vec4 number = first_number + vec4(0.0, 1.0, 2.0, 3.0);
    vec4 first = clamp(opens / sub_time - number, 0.0, 1.0), last = clamp((opens + open_time) / sub_time - number, 0.0, 1.0);
    open_fractions = last - first;
    late = 0.5 * (first + last) - 0.5;
}

vec4 moved_px(vec4 centres_px, vec2 late_by) {
    return centres_px + late_by.xxyy * step_px.xyxy;
}
#endif
