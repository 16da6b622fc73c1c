#version 330 core

// Tiles of the image behind a lens, of which only those are drawn that light falls on: most of the sky is dark, and
// software OpenGL executes both sides of an if.
//
// An instance is a tile, four vertices are its corners.

uniform sampler2D lit;            // whether there is any light in a block of the pinhole's pixels
uniform sampler2D shift_px;       // by how much corners of pixels stand elsewhere in the pinhole's plane, px of the image
uniform ivec2 image_px;           // width and height
uniform int   tile_px;
uniform int   block_px;
uniform vec2  origin_px;          // where the pinhole's light begins
uniform float finer;              // how many of its pixels are one of the image
uniform int   apron_px;

const float NOWHERE_PX = 1e8;     // corners farther off see nothing
const float MARGIN_PX = 5.0;      // the spline's reach, and what a lens bends the sides of a tile

bool is_lit(ivec2 first, ivec2 last) {
    vec2 low_px = vec2(NOWHERE_PX), high_px = vec2(-NOWHERE_PX);
    for (int k = 0; k < 4; ++k) {
        ivec2 corner = ivec2((k & 1) == 0 ? first.x : last.x, (k >> 1) == 0 ? first.y : last.y);
        vec2 shift = texelFetch(shift_px, corner, 0).rg;
        if (shift.x > NOWHERE_PX) {
            return true;
        }
        vec2 place_px = (vec2(corner) - 0.5 + shift - origin_px) * finer + float(apron_px);
        low_px = min(low_px, place_px);
        high_px = max(high_px, place_px);
    }
    ivec2 most = textureSize(lit, 0) - 1;
    ivec2 low = clamp(ivec2(low_px - MARGIN_PX) / block_px, ivec2(0), most);
    ivec2 high = clamp(ivec2(high_px + MARGIN_PX) / block_px, ivec2(0), most);
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
    int tiles_a_row = (image_px.x + tile_px - 1) / tile_px;
    ivec2 first = ivec2(gl_InstanceID % tiles_a_row, gl_InstanceID / tiles_a_row) * tile_px;
    ivec2 last = min(first + tile_px, image_px);
    ivec2 corner = ivec2((gl_VertexID & 1) == 0 ? first.x : last.x, (gl_VertexID >> 1) == 0 ? first.y : last.y);
    vec2 place = is_lit(first, last) ? 2.0 * vec2(corner) / vec2(image_px) - 1.0 : vec2(2.0);
    gl_Position = vec4(place, 0.0, 1.0);
}
