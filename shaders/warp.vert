#version 330 core

// Distortion pass: patches of the distorted image.  Only those that receive flux are drawn: most of the sky is dark, and
// software OpenGL executes both branches of an if.
//
// A vertex is a patch, drawn as a point: software OpenGL shades the pixels along the seam of two triangles twice.  Within
// a patch, positions in the undistorted plane are a biquadratic function of the pixel's position in it, u to the right and
// v down, from -1 to 1 (glstar/render/opengl/passes/lensdistortion.py).

// SPLINE_SUPPORT_PX: distance up to which the spline of warp.frag reads pixels.

in vec3 square_px;                // left and top edge on the image, and side, px
in vec4 undistorted_px;           // bounds in the undistorted plane: left, top, right, bottom, px of the image
in vec2 at_1;                     // coefficients, px of the image
in vec4 at_u_v;
in vec4 at_uu_vv;
in vec2 at_uv;
in vec4 at_uuv_uvv;
in vec2 at_uuvv;

uniform sampler2D occupancy;      // of blocks of the undistorted signal
uniform vec2  viewport_px;        // width and height
uniform float block_px;
uniform vec2  origin_px;          // where the undistorted signal begins
uniform float oversampling;       // pixels of the undistorted signal per pixel of the image, on the axis
uniform float guard_band_px;

flat out vec3 centre_px;          // of the patch, and 2 / side
flat out vec2 by_1;               // coefficients, px of the undistorted signal
flat out vec4 by_u_v;
flat out vec4 by_uu_vv;
flat out vec2 by_uv;
flat out vec4 by_uuv_uvv;
flat out vec2 by_uuvv;

bool receives_flux() {
    ivec2 most = textureSize(occupancy, 0) - 1;
    vec2 start_px = guard_band_px - origin_px * oversampling;
    ivec2 low = clamp(ivec2((start_px + oversampling * undistorted_px.xy - float(SPLINE_SUPPORT_PX)) / block_px),
                      ivec2(0), most);
    ivec2 high = clamp(ivec2((start_px + oversampling * undistorted_px.zw + float(SPLINE_SUPPORT_PX)) / block_px),
                       ivec2(0), most);
    for (int row = low.y; row <= high.y; ++row) {
        for (int column = low.x; column <= high.x; ++column) {
            if (texelFetch(occupancy, ivec2(column, row), 0).r > 0.0) {
                return true;
            }
        }
    }
    return false;
}

void main() {
    centre_px = vec3(square_px.xy + 0.5 * square_px.z, 2.0 / square_px.z);
    by_1 = (at_1 - origin_px) * oversampling + guard_band_px;
    by_u_v = at_u_v * oversampling;
    by_uu_vv = at_uu_vv * oversampling;
    by_uv = at_uv * oversampling;
    by_uuv_uvv = at_uuv_uvv * oversampling;
    by_uuvv = at_uuvv * oversampling;
    gl_Position = vec4(receives_flux() ? 2.0 * centre_px.xy / viewport_px - 1.0 : vec2(2.0), 0.0, 1.0);
    gl_PointSize = square_px.z;
}
