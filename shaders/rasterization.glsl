// Rasterizers snap points to a grid of 1/16 px or finer: sprites are larger by this, px.
const float SNAPPING_PX = 0.125;

// Whether a corner of a quad along a direction is on the side of higher p.  The triangles 0 1 2 and 2 1 3 share the diagonal
// between those two corners that are neither highest nor lowest.  softpipe interpolates the longest edge of a triangle in two
// parts, and of another diagonal would draw some pixels twice or not at all.
bool is_high_corner(int vertex, vec2 along) {
    return ((vertex & 2) != 0) != (along.x * along.y < 0.0);
}
