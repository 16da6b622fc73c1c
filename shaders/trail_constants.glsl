// Kinds of segments of a star's path: see star_path.frag.
const float NOTHING = 0.0, SHORT = 1.0, POINT = 2.0, LONG = 3.0;
// Added to the kind of a segment during which a row that it lights opens or closes (readout.glsl).
const float PARTLY_OPEN = 10.0;
