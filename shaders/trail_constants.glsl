// Kinds of segments of a star's path: see star_path.frag.
const float NOTHING = 0.0, SHORT = 1.0, POINT = 2.0, LONG = 3.0;
