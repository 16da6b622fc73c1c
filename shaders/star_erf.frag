#version 330 core

// The light of one star in one sub-exposure, integrated over one pixel: a product of differences of erf.
//
// For point spread functions narrower than 0.7 px, which a widened Gaussian (star.frag) no longer stands for.

flat in vec2  centre_px;
flat in float peak_dn;

uniform float psf_sigma_px;

out float light_dn;

const float HALF_PI = 1.5707963267948966;

// Abramowitz & Stegun 7.1.26, to 1.5e-7.
vec2 erf(vec2 x) {
    vec2 t = 1.0 / (1.0 + 0.3275911 * abs(x));
    vec2 tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return sign(x) * (1.0 - tail * exp(-x * x));
}

void main() {
    vec2 offset_px = gl_FragCoord.xy - 0.5 - centre_px;
    float width_px = psf_sigma_px * sqrt(2.0);
    vec2 across = erf((offset_px + 0.5) / width_px) - erf((offset_px - 0.5) / width_px);
    light_dn = peak_dn * HALF_PI * psf_sigma_px * psf_sigma_px * across.x * across.y;
}
