#version 330 core

// Sub-exposure pass: one star in four consecutive sub-exposures, as a point sprite that covers all four Gaussians.
//
// A vertex is a star, an instance is four sub-exposures.  Software OpenGL spends as much time on setting a sprite up as on
// filling it, so that four sub-exposures per sprite take half the time of one (tests/bench).
//
// Pixel (0, 0) is the CENTRE of the top-left pixel, x to the right, y down.  Row 0 of the target is the image's top row:
// y grows with gl_Position.y and with gl_FragCoord.y, and nothing is ever flipped.

// SUB_EXPOSURES_PER_SPRITE: 4.  PASSAGE_COLUMNS: columns of the texture of cloud.

in vec3  direction_eq;            // geocentric apparent unit vector, true equator and equinox
in float brightness;              // 10^(-0.4 V): flux relative to a star of magnitude 0
in float truncation_radius_px;    // up to which the star's Gaussian is drawn
in float transmission;            // of the air in the star's direction
#if MOSAIC
in vec4  tints_of_star;
flat out vec4 tints;              // mosaic.glsl
#endif

in float passage_column;          // of the star among those that are drawn

#include "projection.glsl"
#include "rasterization.glsl"

uniform vec2  target_px;          // width and height of the target
uniform sampler2D passage;        // transmission of cloud by star and instance, in rows of PASSAGE_COLUMNS; 1 without
uniform int   passage_instances;  // values for each star; 0 without cloud
uniform int   passage_first;      // the first instance of this call
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 in one sub-exposure, eqs. (37), (43)

flat out vec4  centres_01_px;     // (x, y) of two sub-exposures in the target; gl_PointCoord would inherit the
flat out vec4  centres_23_px;     // rasterizer's snapping
flat out float peak_dn;           // of the Gaussian of one sub-exposure
#if ROWS
flat out vec2 step_px;            // motion from one sub-exposure to the next
flat out float first_number;      // number of the first of the four
uniform int first_instance;
#endif

const float FAR_PX = 1e6;         // so distant that no flux arrives
const vec2  NOWHERE_PX = vec2(FAR_PX);

// Position of the star in one sub-exposure.
vec2 centre_px(int row) {
    Observed seen = observed(direction_eq, row);
    bool below_horizon = seen.sine_altitude < SINE_OF_LOWEST_ALTITUDE + sine_horizon || seen.height < 0.0;
    if (below_horizon || !is_in_view(seen.in_camera)) {
        return NOWHERE_PX;
    }
    return vector_position_px(seen.in_camera);
}

void main() {
    vec2 centres_px[SUB_EXPOSURES_PER_SPRITE];
    vec2 low_px = vec2(FAR_PX), high_px = vec2(-FAR_PX);
    for (int k = 0; k < SUB_EXPOSURES_PER_SPRITE; ++k) {
        vec2 centre = centre_px(gl_InstanceID * SUB_EXPOSURES_PER_SPRITE + k);
        centres_px[k] = centre;
        // Stars outside the guard band do not affect the image and must not enlarge the sprite.
        bool near = all(greaterThan(centre, vec2(-0.5))) && all(lessThan(centre, target_px - 0.5));
        low_px  = near ? min(low_px, centre)  : low_px;
        high_px = near ? max(high_px, centre) : high_px;
    }
    centres_01_px = vec4(centres_px[0], centres_px[1]);
    centres_23_px = vec4(centres_px[2], centres_px[3]);
    peak_dn = vmag_0_peak_dn * brightness * transmission;
#if MOSAIC
    tints = tints_of_star;
#endif
    if (passage_instances > 0) {
        int texel = int(passage_column) * passage_instances + passage_first + gl_InstanceID;
        peak_dn *= texelFetch(passage, ivec2(texel % PASSAGE_COLUMNS, texel / PASSAGE_COLUMNS), 0).r;
    }
#if ROWS
    bool known = max(centres_px[0].x, centres_px[SUB_EXPOSURES_PER_SPRITE - 1].x) < FAR_PX;
    step_px = known ? (centres_px[SUB_EXPOSURES_PER_SPRITE - 1] - centres_px[0]) / float(SUB_EXPOSURES_PER_SPRITE - 1)
                    : vec2(0.0);
    first_number = float((first_instance + gl_InstanceID) * SUB_EXPOSURES_PER_SPRITE);
#endif

    vec2 extent_px = high_px - low_px;
    vec2 middle_px = (high_px + low_px) / 2.0;
    bool hidden = extent_px.x < 0.0;
    gl_PointSize = hidden ? 1.0 : 2.0 * (truncation_radius_px + SNAPPING_PX) + max(extent_px.x, extent_px.y);
    gl_Position = hidden ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(2.0 * (middle_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}
