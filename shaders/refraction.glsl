// Atmospheric refraction without trigonometric functions: a rational fit to eq. (25), exact to 0.002" down to -1 deg.
// The same as horizon.refraction_displacement in float64.

uniform float refraction_scale;   // eq. (28); 0 for no refraction
uniform float sine_horizon;       // of the apparent altitude of the horizon; 0 without dip

const float SINE_OF_LOWEST_ALTITUDE = -0.017452406437283512;   // -1 deg

// Displacement of a star towards the zenith, as a vector of this length along the zenith's unit vector.
float refraction_displacement(float sine_altitude) {
    float s = max(sine_altitude, SINE_OF_LOWEST_ALTITUDE);
    float numerator = 8.431267579e-3 + s * (9.001200823e-2 - 5.085505610e-2 * s);
    float denominator = 1.0 + s * (27.89442102 + s * (303.4601537 - 171.7474067 * s));
    return refraction_scale * numerator / denominator;
}
