#version 330 core

// Where stars stand at the ends and in the middles of the segments of their trails: a column is a star, a row a moment.
//
// The way from a star to its place is star.vert's, Teague & Chahl eqs. (22)-(35) without an angle.  A texel is the
// star's place (x, y) in the target, px, how far above the apparent horizon it stands (a sine, nearly), and how far ahead
// of the camera (a cosine, nearly), 0 behind it.  The row after the last moment has how bright the star is and how far
// it is drawn.

uniform sampler2D stars;          // geocentric apparent unit vectors, and 10^(-0.4 V), in rows of STARS_A_ROW
uniform sampler2D chosen;         // of each column: the star's number and its reach, px
uniform sampler2D moments;        // as star.vert reads them
uniform int   last_moment;
uniform float refraction_scale;   // eq. (28); 0 for no air
uniform vec2  focal_px;           // fx, fy
uniform vec2  principal_px;       // cx, cy
uniform float skew_px;
uniform float apron_px;           // by how much the target is larger than the image, on each side

out vec4 place;

const int   STARS_A_ROW = 1024;
const float SINE_OF_LOWEST_ALTITUDE = -0.017452406437283512;   // -1 deg

// How much of the zenith lifts a star of this sine of altitude to where it appears: horizon.refraction_displacement.
float refraction_displacement(float s) {
    float above = 8.431267579e-3 + s * (9.001200823e-2 - 5.085505610e-2 * s);
    float below = 1.0 + s * (27.89442102 + s * (303.4601537 - 171.7474067 * s));
    return refraction_scale * above / below;
}

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    vec2 choice = texelFetch(chosen, ivec2(texel.x, 0), 0).rg;
    int number = int(choice.x);
    vec4 star = texelFetch(stars, ivec2(number % STARS_A_ROW, number / STARS_A_ROW), 0);

    int row = min(texel.y, last_moment);
    vec3 right_eq    = texelFetch(moments, ivec2(0, row), 0).xyz;
    vec3 down_eq     = texelFetch(moments, ivec2(1, row), 0).xyz;
    vec3 ahead_eq    = texelFetch(moments, ivec2(2, row), 0).xyz;
    vec3 zenith_eq   = texelFetch(moments, ivec2(3, row), 0).xyz;
    vec3 velocity_eq = texelFetch(moments, ivec2(4, row), 0).xyz;

    vec3  direction = star.xyz + velocity_eq;
    float sine_altitude = dot(direction, zenith_eq);
    float lift = refraction_displacement(max(sine_altitude, SINE_OF_LOWEST_ALTITUDE));
    direction += lift * zenith_eq;

    vec3 in_camera = vec3(dot(right_eq, direction), dot(down_eq, direction), dot(ahead_eq, direction));
    bool is_ahead = in_camera.z > 1e-9;
    vec2 ahead = in_camera.xy / (is_ahead ? in_camera.z : 1.0);
    vec2 xy_px = focal_px * ahead + principal_px + vec2(skew_px * ahead.y, 0.0) + apron_px;
    // Even the thickest air lifts nothing from under -1 deg above the horizon.
    float height = sine_altitude + lift;
    height = sine_altitude < SINE_OF_LOWEST_ALTITUDE ? min(height, -1e-6) : height;
    place = texel.y > last_moment ? vec4(star.w, choice.y, 0.0, 0.0) : vec4(xy_px, height, is_ahead ? in_camera.z : 0.0);
}
