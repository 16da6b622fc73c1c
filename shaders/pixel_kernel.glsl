// Integration of flux over the area of a pixel, for trail.frag, trail_middle.frag, trail_short.frag and trail_pieces.frag.
//
// NARROW: 1 for pixels that integrate over their area under a point spread function narrower than 1.1 px.  Then three
// Gaussians per side have the moments of a square pixel up to the sixth order, whatever the direction of the trail; their
// variance is added to that of the point spread function (passes/trail.py).  From 1.1 px on a single Gaussian widened by the
// variance of the pixel is sufficient (Sensor.effective_sigma_px).

// Flux at a position; the shader that includes this file defines it.
float flux_at(vec2 position);

// Flux in the pixel around a position, in DN or in the unit of flux_at.  The matrix transforms px to positions.
float flux_in_pixel(vec2 position, mat2 per_px) {
#if NARROW
    const float OFFSET_PX = 0.3458319986644865, WEIGHT = 0.31890297;
    const float WEIGHTS[3] = float[3](WEIGHT, 1.0 - 2.0 * WEIGHT, WEIGHT);
    float flux = 0.0;
    for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 3; ++column)
            flux += WEIGHTS[row] * WEIGHTS[column]
                * flux_at(position + OFFSET_PX * (vec2(column - 1, row - 1) * per_px));
    return flux;
#else
    return flux_at(position);
#endif
}
