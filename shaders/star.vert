#version 330 core

// One star in one sub-exposure: a point sprite wide enough for its Gaussian.
//
// A vertex is a star, an instance is a sub-exposure.  Teague & Chahl eqs. (22)-(35), without an angle: built-in asin
// is 80" wrong on software OpenGL, and the celestial pole and the zenith are places like any other.
//
// Pixel (0, 0) is the CENTRE of the top-left pixel, x to the right, y down.  Row 0 of the target is the image's top
// row: y grows with gl_Position.y and with gl_FragCoord.y, and nothing is ever turned over.

in vec3  direction_eq;         // geocentric apparent unit vector, true equator and equinox
in float brightness;           // 10^(-0.4 V): how many times as bright as a star of magnitude 0
in float reach_px;             // how far from its centre the star is drawn: the sprite's radius belongs to the star

in vec3  camera_right_eq;      // the three rows of C_camera_eq ...
in vec3  camera_down_eq;
in vec3  camera_ahead_eq;      // ... of which the last is the boresight
in vec3  zenith_eq;            // unit vector to the zenith
in vec3  velocity_eq;          // of the observer with the turning Earth, in units of the speed of light

uniform float refraction_scale;   // eq. (28); 0 for no air
uniform vec2  focal_px;           // fx, fy
uniform vec2  principal_px;       // cx, cy
uniform float skew_px;
uniform float apron_px;           // by how much the target is larger than the image, on each side
uniform vec2  target_px;          // width and height of the target

uniform float vmag_0_peak_dn;     // peak that a star of magnitude 0 gains in one sub-exposure, eqs. (37), (43)

flat out vec2  centre_px;         // in the target; gl_PointCoord would inherit the rasteriser's snapping
flat out float peak_dn;           // of this sub-exposure's Gaussian

const float SINE_OF_LOWEST_ALTITUDE = -0.017452406437283512;   // -1 deg
const vec4  CLIPPED = vec4(2.0, 2.0, 2.0, 1.0);

// How much of the zenith lifts a star of this sine of altitude to where it appears: horizon.refraction_lift.
float refraction_lift(float s) {
    float above = 8.431267579e-3 + s * (9.001200823e-2 - 5.085505610e-2 * s);
    float below = 1.0 + s * (27.89442102 + s * (303.4601537 - 171.7474067 * s));
    return refraction_scale * above / below;
}

void main() {
    vec3  direction = direction_eq + velocity_eq;
    float sine_altitude = dot(direction, zenith_eq);
    float lift = refraction_lift(max(sine_altitude, SINE_OF_LOWEST_ALTITUDE));
    direction += lift * zenith_eq;

    vec3 in_camera = vec3(dot(camera_right_eq, direction), dot(camera_down_eq, direction), dot(camera_ahead_eq, direction));
    bool sunk = sine_altitude < SINE_OF_LOWEST_ALTITUDE || sine_altitude + lift < 0.0;
    if (sunk || in_camera.z <= 1e-9) {
        gl_Position = CLIPPED;
        gl_PointSize = 1.0;
        return;
    }

    vec2 ahead = in_camera.xy / in_camera.z;
    centre_px = focal_px * ahead + principal_px + vec2(skew_px * ahead.y, 0.0) + apron_px;

    peak_dn = vmag_0_peak_dn * brightness;
    gl_PointSize = 2.0 * reach_px;
    gl_Position = vec4(2.0 * (centre_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}
