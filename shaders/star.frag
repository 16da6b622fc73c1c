#version 330 core

// The light of one star in one sub-exposure, at one pixel: Teague & Chahl eqs. (42), (43), at the star's sub-pixel
// position.  For pixels that integrate over their area sigma is widened by the pixel's own variance and the peak
// lowered, so that the light stays what it was (Sensor.drawn_sigma_px, Sensor.drawn_peak).

flat in vec2  centre_px;
flat in float peak_dn;

uniform float falloff_per_px2;    // 1 / (2 sigma^2 ln 2): of the logarithm to base 2

out float light_dn;

void main() {
    vec2 offset_px = gl_FragCoord.xy - 0.5 - centre_px;
    light_dn = peak_dn * exp2(-falloff_per_px2 * dot(offset_px, offset_px));
}
