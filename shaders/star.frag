#version 330 core

// The light of one star in one sub-exposure, at one pixel: Teague & Chahl eqs. (42), (43), at the star's sub-pixel
// position.  For pixels that integrate over their area (equations.md section 7) sigma is widened by the pixel's own
// variance and the peak lowered, so that the light stays what it was.

flat in vec2  centre_px;
flat in float peak_dn;

uniform float drawn_sigma_px;
uniform float drawn_peak;         // of the drawn Gaussian, over that of the point spread function

out float light_dn;

void main() {
    vec2 offset_px = gl_FragCoord.xy - 0.5 - centre_px;
    light_dn = peak_dn * drawn_peak * exp(-dot(offset_px, offset_px) / (2.0 * drawn_sigma_px * drawn_sigma_px));
}
