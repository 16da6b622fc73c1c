#version 330 core

// Patches of the image behind a lens, of which only those are drawn that light falls on: most of the sky is dark, and
// software OpenGL executes both sides of an if.
//
// A vertex is a patch, drawn as a point: software OpenGL lights the pixels along the seam of two triangles twice.  Within
// a patch places of the pinhole's plane are a biquadratic of where a pixel stands in it, u to the right and v down, from
// -1 to 1 (glstar/render/opengl/distortionpass.py).

in vec3 square_px;                // its left and top edge on the image and its side, px
in vec4 seen_px;                  // what it sees of the pinhole's plane: left, top, right, bottom, px of the image
in vec2 at_1;                     // the coefficients, px of the image
in vec4 at_u_v;
in vec4 at_uu_vv;
in vec2 at_uv;
in vec4 at_uuv_uvv;
in vec2 at_uuvv;

uniform sampler2D lit;            // whether there is any light in a block of the pinhole's pixels
uniform vec2  viewport_px;        // width and height
uniform float block_px;
uniform vec2  origin_px;          // where the pinhole's light begins
uniform float finer;              // how many of its pixels are one of the image
uniform float apron_px;

flat out vec3 middle_px;          // of the patch, and 2 over its side
flat out vec2 by_1;               // the coefficients, px of the pinhole's light
flat out vec4 by_u_v;
flat out vec4 by_uu_vv;
flat out vec2 by_uv;
flat out vec4 by_uuv_uvv;
flat out vec2 by_uuvv;

const float REACH_PX = 3.0;       // the spline's, and some

bool is_lit() {
    ivec2 most = textureSize(lit, 0) - 1;
    vec2 start_px = apron_px - origin_px * finer;
    ivec2 low = clamp(ivec2((start_px + finer * seen_px.xy - REACH_PX) / block_px), ivec2(0), most);
    ivec2 high = clamp(ivec2((start_px + finer * seen_px.zw + REACH_PX) / block_px), ivec2(0), most);
    for (int row = low.y; row <= high.y; ++row) {
        for (int column = low.x; column <= high.x; ++column) {
            if (texelFetch(lit, ivec2(column, row), 0).r > 0.0) {
                return true;
            }
        }
    }
    return false;
}

void main() {
    middle_px = vec3(square_px.xy + 0.5 * square_px.z, 2.0 / square_px.z);
    by_1 = (at_1 - origin_px) * finer + apron_px;
    by_u_v = at_u_v * finer;
    by_uu_vv = at_uu_vv * finer;
    by_uv = at_uv * finer;
    by_uuv_uvv = at_uuv_uvv * finer;
    by_uuvv = at_uuvv * finer;
    gl_Position = vec4(is_lit() ? 2.0 * middle_px.xy / viewport_px - 1.0 : vec2(2.0), 0.0, 1.0);
    gl_PointSize = square_px.z;
}
