// Projection of stars: from apparent directions to vectors in the camera frame, Teague & Chahl eqs. (22)-(32) without
// trigonometric functions: the built-in asin is 80" wrong on software OpenGL, and the celestial pole and the zenith are
// positions like any other.  The same as Pointing.to_camera in float64.

#include "refraction.glsl"
#include "lens.glsl"

// A row is a time, of five texels (pointingtexture.py): the three rows of C_camera_eq (right, down, boresight), the unit
// vector to the zenith, and the observer's velocity due to the Earth's rotation in units of the speed of light.
uniform sampler2D pointing;

struct Observed {
    vec3  in_camera;              // right, down, along the boresight
    float sine_altitude;          // without refraction
    float height;                 // sine of the altitude above the apparent horizon, approximately
};

// The observed direction of a star at a time.
Observed observed(vec3 direction_eq, int row) {
    vec3 right_eq     = texelFetch(pointing, ivec2(0, row), 0).xyz;
    vec3 down_eq      = texelFetch(pointing, ivec2(1, row), 0).xyz;
    vec3 boresight_eq = texelFetch(pointing, ivec2(2, row), 0).xyz;
    vec3 zenith_eq    = texelFetch(pointing, ivec2(3, row), 0).xyz;
    vec3 velocity_eq  = texelFetch(pointing, ivec2(4, row), 0).xyz;

    vec3  direction = direction_eq + velocity_eq;
    float sine_altitude = dot(direction, zenith_eq);
    float refraction = refraction_displacement(sine_altitude);
    direction += refraction * zenith_eq;
    vec3 in_camera = vec3(dot(right_eq, direction), dot(down_eq, direction), dot(boresight_eq, direction));
    return Observed(in_camera, sine_altitude, sine_altitude + refraction - sine_horizon);
}
