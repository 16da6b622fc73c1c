#version 330 core

// One star in four sub-exposures on end: a point sprite wide enough for all four Gaussians.
//
// A vertex is a star, an instance is four sub-exposures; software OpenGL spends as long on setting a sprite up as on
// filling it, so that four to a sprite draw in half the time of one to a sprite (tests/bench).  Teague & Chahl
// eqs. (22)-(35), without an angle: built-in asin is 80" wrong on software OpenGL, and the celestial pole and the
// zenith are places like any other.
//
// Pixel (0, 0) is the CENTRE of the top-left pixel, x to the right, y down.  Row 0 of the target is the image's top
// row: y grows with gl_Position.y and with gl_FragCoord.y, and nothing is ever turned over.

in vec3  direction_eq;            // geocentric apparent unit vector, true equator and equinox
in float brightness;              // 10^(-0.4 V): how many times as bright as a star of magnitude 0
in float reach_px;                // how far from its centre the star is drawn: the sprite's radius belongs to the star

// A row is a sub-exposure, of five texels: the three rows of C_camera_eq (right, down, ahead: the boresight), the unit
// vector to the zenith, and the observer's velocity with the turning Earth in units of the speed of light.
uniform sampler2D sub_exposures;

uniform float refraction_scale;   // eq. (28); 0 for no air
uniform vec2  focal_px;           // fx, fy
uniform vec2  principal_px;       // cx, cy
uniform float skew_px;
uniform float apron_px;           // by how much the target is larger than the image, on each side
uniform vec2  target_px;          // width and height of the target
uniform float vmag_0_peak_dn;     // peak that a star of magnitude 0 gains in one sub-exposure, eqs. (37), (43)

flat out vec4  centres_01_px;     // (x, y) of two sub-exposures, in the target; gl_PointCoord would inherit the
flat out vec4  centres_23_px;     // rasteriser's snapping
flat out float peak_dn;           // of one sub-exposure's Gaussian

const int   SUB_EXPOSURES_A_SPRITE = 4;
const float SINE_OF_LOWEST_ALTITUDE = -0.017452406437283512;   // -1 deg
const float SNAPPING_PX = 0.125;  // rasterisers place points on a grid of 1/16 px and finer
const float FAR_PX = 1e6;         // so far away that no light arrives
const vec2  NOWHERE_PX = vec2(FAR_PX);

// How much of the zenith lifts a star of this sine of altitude to where it appears: horizon.refraction_displacement.
float refraction_displacement(float s) {
    float above = 8.431267579e-3 + s * (9.001200823e-2 - 5.085505610e-2 * s);
    float below = 1.0 + s * (27.89442102 + s * (303.4601537 - 171.7474067 * s));
    return refraction_scale * above / below;
}

// Where the star stands in one sub-exposure: Pointing.to_camera and Camera.project.
vec2 centre_px(int row) {
    vec3 right_eq    = texelFetch(sub_exposures, ivec2(0, row), 0).xyz;
    vec3 down_eq     = texelFetch(sub_exposures, ivec2(1, row), 0).xyz;
    vec3 ahead_eq    = texelFetch(sub_exposures, ivec2(2, row), 0).xyz;
    vec3 zenith_eq   = texelFetch(sub_exposures, ivec2(3, row), 0).xyz;
    vec3 velocity_eq = texelFetch(sub_exposures, ivec2(4, row), 0).xyz;

    vec3  direction = direction_eq + velocity_eq;
    float sine_altitude = dot(direction, zenith_eq);
    float lift = refraction_displacement(max(sine_altitude, SINE_OF_LOWEST_ALTITUDE));
    direction += lift * zenith_eq;

    vec3 in_camera = vec3(dot(right_eq, direction), dot(down_eq, direction), dot(ahead_eq, direction));
    bool sunk = sine_altitude < SINE_OF_LOWEST_ALTITUDE || sine_altitude + lift < 0.0;
    if (sunk || in_camera.z <= 1e-9) {
        return NOWHERE_PX;
    }
    vec2 ahead = in_camera.xy / in_camera.z;
    return focal_px * ahead + principal_px + vec2(skew_px * ahead.y, 0.0) + apron_px;
}

void main() {
    vec2 centres_px[SUB_EXPOSURES_A_SPRITE];
    vec2 low_px = vec2(FAR_PX), high_px = vec2(-FAR_PX);
    for (int k = 0; k < SUB_EXPOSURES_A_SPRITE; ++k) {
        vec2 centre = centre_px(gl_InstanceID * SUB_EXPOSURES_A_SPRITE + k);
        centres_px[k] = centre;
        // Light from beyond the apron does not reach the image, and must not stretch the sprite.
        bool near = all(greaterThan(centre, vec2(-0.5))) && all(lessThan(centre, target_px - 0.5));
        low_px  = near ? min(low_px, centre)  : low_px;
        high_px = near ? max(high_px, centre) : high_px;
    }
    centres_01_px = vec4(centres_px[0], centres_px[1]);
    centres_23_px = vec4(centres_px[2], centres_px[3]);
    peak_dn = vmag_0_peak_dn * brightness;

    vec2 extent_px = high_px - low_px;
    vec2 middle_px = (high_px + low_px) / 2.0;
    bool unseen = extent_px.x < 0.0;
    gl_PointSize = unseen ? 1.0 : 2.0 * (reach_px + SNAPPING_PX) + max(extent_px.x, extent_px.y);
    gl_Position = unseen ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(2.0 * (middle_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}
