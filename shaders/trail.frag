#version 330 core

// Trail pass: flux of one segment of a star's path at one pixel.
//
// A Gaussian that moves uniformly along a straight line leaves a Gaussian across and a difference of error functions along
// it.  Here the line bends slightly and the speed varies slightly (star_path.frag computes both): the flux per length is
// a quadratic function, whose integral over a Gaussian consists of error functions and Gaussians again.
//
// Lengths are in units of the half width at half maximum of the point spread function, where exp2(-1) of the peak is left:
// then no uniform is needed, which software OpenGL would look up for every pixel.

flat in vec2 origin_px;           // where s = p = 0, in the coordinates of gl_FragCoord
flat in vec4 axes;                // derivatives of s and p with respect to x and y, 1/px
flat in vec4 shape;               // star_path.frag: length, 1 / length, curvature, asymmetry
flat in vec3 flux;                // flux slope, flux curvature, amplitude (DN)
#if ROWS
flat in vec2 clock;               // of readout.glsl
#else
flat in vec2 across;              // lowest and highest p that is drawn
flat in vec4 owned;               // an axis (x, y), and the range along it whose pixels are drawn here: star_path.frag
#endif

out float light_dn;

// (1.6 sigma)^2 in squares of half widths, 1.6^2 / (2 ln 2): 0.5 (sqrt(t^2 + FALLOFF) - t) is about the mean of a Gaussian
// that is cut off at t (at its centre 0.80 sigma).
const float FALLOFF = 1.8466496523378731;
const float SQRT_LN_2 = 0.8325546111576977;
const float INV_SQRT_PI_LN_2 = 0.6776658635;    // 1 / sqrt(pi ln 2)
const float HALF_LOG2_E = 0.7213475204444817;   // 1 / (2 ln 2): the variance of exp2(-x^2)

#include "erf.glsl"
#include "pixel_kernel.glsl"
#include "mosaic.glsl"
#if ROWS
#include "readout.glsl"
#endif

vec2 limits;                      // of the integral along s

// erf(sqrt(ln 2) x), given exp2(-x^2).
vec2 erf(vec2 x, vec2 gaussian) {
    vec2 b = 1.0 + (ERF_P * SQRT_LN_2) * abs(x);
    vec2 t = b.yx / (b.x * b.y);
    return sign(x) * (1.0 - ERFC_POLYNOMIAL(t) * gaussian);
}

float flux_at(vec2 position) {
    float length = shape.x, per_length = shape.y, curvature = shape.z, asymmetry = shape.w;
    float flux_slope = flux.x, flux_curvature = flux.y;
    // The curve is expanded to second order at about the mean position, weighted by the point spread function, of the part
    // between the limits.  Beyond an end that is within the curve, where slope and bend are those of the part that lights
    // the pixel.
    vec2 to_limits = vec2(position.x - limits.x, limits.y - position.x), roots = sqrt(to_limits * to_limits + FALLOFF);
    float on_curve = 0.5 * (limits.x + limits.y + roots.x - roots.y);
    float elapsed = on_curve * per_length, m = 2.0 * elapsed - 1.0, remaining = 1.0 - elapsed;
    float slope = asymmetry * (6.0 * elapsed * remaining - 1.0) - curvature * m;
    vec2 off = vec2(on_curve - position.x, position.y - on_curve * remaining * (curvature + asymmetry * m));
    // Where the path is inclined to the chord, and on the outside of its bend, less of it is nearby; and it is closer
    // than p says.
    float sharpness = max(1.0 + slope * slope + 2.0 * per_length * (curvature + 3.0 * asymmetry * m) * off.y, 0.25);
    float narrowing = inversesqrt(sharpness), inclined = slope * off.y - off.x, shift = inclined / sharpness;
    float nearest = on_curve + shift;
    vec2 x = vec2(nearest - limits.x, limits.y - nearest) / narrowing;
    vec2 ends = exp2(-x * x), integrals = erf(x, ends);
    // Flux per length as a quadratic function around there, and the integral of each of its powers over a Gaussian
    // between the ends.
    float at = 2.0 * per_length * nearest - 1.0, scale = 2.0 * per_length * narrowing;
    vec3 powers = vec3(1.0 + flux_slope * at + flux_curvature * (at * at - 0.3333333),
                       scale * (flux_slope + 2.0 * flux_curvature * at),
                       scale * scale * flux_curvature);
    float between = integrals.x + integrals.y;
    vec3 moments = vec3(between, INV_SQRT_PI_LN_2 * (ends.x - ends.y),
                        HALF_LOG2_E * between - INV_SQRT_PI_LN_2 * dot(x, ends));
    return exp2(inclined * shift - dot(off, off)) * dot(powers, moments) * narrowing;
}

void main() {
    vec2 position = (gl_FragCoord.xy - origin_px) * mat2(axes);
#if ROWS
    // A path is drawn by one primitive, which owns all of its pixels.
    vec2 elapsed = elapsed_while_open(gl_FragCoord.xy, clock);
    limits = shape.x * lengths_at(elapsed, flux.x, flux.y);
    light_dn = in_mosaic(elapsed.y > elapsed.x ? flux.z * max(flux_in_pixel(position, mat2(axes)), 0.0) : 0.0);
#else
    limits = vec2(0.0, shape.x);
    float along = dot(owned.xy, gl_FragCoord.xy);
    bool is_owned = along >= owned.z && along < owned.w && position.y >= across.x && position.y < across.y;
    float relative_flux = flux_in_pixel(position, mat2(axes));
    light_dn = in_mosaic(is_owned ? flux.z * max(relative_flux, 0.0) : 0.0);
#endif
}
