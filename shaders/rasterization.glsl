// Rasterizers snap points to a grid of 1/16 px or finer: sprites are larger by this, px.
const float SNAPPING_PX = 0.125;
