// A uniform motion as two Gaussians: star_path.frag, trail_short.frag.
//
// Two Gaussians at the times 1/2 -+ OFFSET of a uniform motion of duration 1, each as wide as a motion over a time with
// variance VARIANCE, have its moments up to the seventh order.
const float OFFSET = 0.2540669, VARIANCE = 0.0187834;
const float LN_2 = 0.6931471805599453;
