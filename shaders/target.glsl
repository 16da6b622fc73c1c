// Primitives in the target: trail.vert and trail_rows.vert.

uniform vec2  target_px;          // width and height of the target

vec4 clip_position(vec2 position_px) {
    return vec4(2.0 * (position_px + 0.5) / target_px - 1.0, 0.0, 1.0);
}

// Sets a point that covers a rectangle, clipped to the target: a point whose centre lies outside is not drawn at all.
// Returns whether anything is left.
bool is_point_over(vec2 low_px, vec2 high_px) {
    low_px  = max(low_px, vec2(-0.5));
    high_px = min(high_px, target_px - 0.5);
    vec2 size_px = high_px - low_px;
    gl_PointSize = max(max(size_px.x, size_px.y), 1.0);
    gl_Position = clip_position(0.5 * (low_px + high_px));
    return all(greaterThan(size_px, vec2(0.0)));
}
