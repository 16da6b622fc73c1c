// Mosaic of colour filters: a pixel records the light of one colour.

#if MOSAIC
// Flux of the star in pixels (even column, even row), (odd, even), (even, odd), (odd, odd) of the target, over that in the
// mean of the colours.
flat in vec4 tints;
#endif

// The light that a pixel records, given that in the mean of the colours.
float in_mosaic(float light_dn) {
#if MOSAIC
    vec2 odd = 2.0 * fract(0.5 * (gl_FragCoord.xy - 0.5));
    vec2 of_row = odd.y > 0.5 ? tints.zw : tints.xy;
    return light_dn * (odd.x > 0.5 ? of_row.y : of_row.x);
#else
    return light_dn;
#endif
}
