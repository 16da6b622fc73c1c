// Chris Wellons's lowbias32: each bit of the input changes half of the bits of the output.
uvec4 hash(uvec4 x) {
    x ^= x >> 16;  x *= 0x7feb352du;
    x ^= x >> 15;  x *= 0x846ca68bu;
    x ^= x >> 16;
    return x;
}
