#version 330 core

// Piece pass: a star during four consecutive pieces of the exposure, as a point sprite that covers all four Gaussians.
//
// A piece is as long as the point spread function allows, whatever the motion during it: a Gaussian with the mean and the
// covariance of the star's path (glstar/render/readout/pieces.py).

// STARS_PER_ROW: columns of the texture of stars.  PIECES_PER_SPRITE: 4.  ROWS: 1 under a rolling shutter, which draws only
// pieces during which all rows that a star lights are open.

in uvec2 sprite;                  // column of the star in `chosen`, and number of four pieces

uniform sampler2D stars;          // geocentric apparent unit vectors, and 10^(-0.4 V), in rows of STARS_PER_ROW
uniform sampler2D chosen;         // of each column: the star's index, its truncation radius, px, and transmission
// Under a rolling shutter in a second row: the first piece that is drawn of the star, and the one after the last.
uniform sampler2D passage;        // transmission of cloud by column and piece; one texel of 1 without
uniform float sigma_px;           // of the Gaussians that are drawn: pixel_kernel.glsl
uniform float effective_sigma_px; // of a star as the pixels record it
uniform float vmag_0_peak_dn;     // peak of a star of magnitude 0 that does not move during the whole exposure

#if ROWS
uniform int first_piece;          // of the draw call
#endif

// Explained in trail_pieces.frag.
flat out vec4 centres_x, centres_y;
flat out vec4 falloff_xx, falloff_xy, falloff_yy;
flat out vec4 amplitudes_dn;

#include "projection.glsl"
#include "rasterization.glsl"
#include "target.glsl"
#include "gaussian_tail.glsl"

#if MOSAIC
uniform sampler2D tints_of_stars; // by column
flat out vec4 tints;              // mosaic.glsl
#endif

const float HALF_LOG2_E = 0.7213475204444817;   // 1 / (2 ln 2): for exp2
const float FAR_PX = 1e6;

struct Piece {
    vec2 centre_px;               // in the target
    vec3 covariance_px2;          // xx, xy, yy, with that of the point spread function
    float light;                  // duration, a fraction of the exposure, times transmission of cloud; 0: not drawn
};

// The covariance of a position, px^2, given how it changes with the rotation vector of the camera, and the covariance of
// that.
vec3 moved_px2(vec3 x_px, vec3 y_px, vec4 upper, vec4 lower) {
    mat3 covariance = mat3(upper.xyz, vec3(upper.y, lower.xy), vec3(upper.z, lower.yz));
    vec3 of_x = covariance * x_px;
    return vec3(dot(x_px, of_x), dot(y_px, of_x), dot(y_px, covariance * y_px));
}

Piece piece_of(vec3 direction_eq, int row, float radius_px) {
    vec4 upper = texelFetch(pointing, ivec2(5, row), 0), lower = texelFetch(pointing, ivec2(6, row), 0);
    Observed seen = observed(direction_eq, row);
    bool is_seen = is_in_view(seen.in_camera) && seen.height >= 0.0
        && seen.sine_altitude >= SINE_OF_LOWEST_ALTITUDE + sine_horizon;
#if LENS
    vec3 vector = is_seen ? seen.in_camera : vec3(0.0, 0.0, 1.0);
    LensPoint point = through_lens(vector);
    vec2 centre_px = point.px;
    mat2x3 per_vector = transpose(point.per_vector);
    vec3 x_px = cross(vector, per_vector[0]), y_px = cross(vector, per_vector[1]);
#else
    vec2 tangent = seen.in_camera.xy / (is_seen ? seen.in_camera.z : 1.0);
    vec2 centre_px = target_position_px(tangent);
    vec3 right = vec3(-tangent.x * tangent.y, 1.0 + tangent.x * tangent.x, -tangent.y);
    vec3 down  = vec3(-1.0 - tangent.y * tangent.y, tangent.x * tangent.y, tangent.x);
    vec3 x_px = focal_px.x * right + skew_px * down, y_px = focal_px.y * down;
#endif
    // Far outside the image a star may move by any distance during a piece.
    bool is_near = all(greaterThan(centre_px, vec2(-2.0 * radius_px)))
        && all(lessThan(centre_px, target_px + 2.0 * radius_px));
#if ROWS
    vec2 drawn = texelFetch(chosen, ivec2(int(sprite.x), 1), 0).rg;
    is_near = is_near && float(row + first_piece) >= drawn.x && float(row + first_piece) < drawn.y;
#endif
    if (!(is_seen && is_near))
        return Piece(vec2(0.0), vec3(1.0, 0.0, 1.0), 0.0);
    vec3 covariance_px2 = moved_px2(x_px, y_px, upper, lower) + sigma_px * sigma_px * vec3(1.0, 0.0, 1.0);
    float transmission = texelFetch(passage, min(ivec2(int(sprite.x), row), textureSize(passage, 0) - 1), 0).r;
    return Piece(centre_px, covariance_px2, upper.w * transmission);
}

// Standard deviations along x and y, as the pixels record them.
vec2 recorded_px(Piece piece) {
    return sqrt(piece.covariance_px2.xz + (effective_sigma_px * effective_sigma_px - sigma_px * sigma_px));
}

// Fraction of a Gaussian in a square around another point.
float fraction_in_square(vec2 from_middle_px, vec2 width_px, float half_px) {
    vec2 far = (half_px + abs(from_middle_px)) / width_px, near = (half_px - abs(from_middle_px)) / width_px;
    return (1.0 - unit_gaussian_tail(far.x).x - unit_gaussian_tail(near.x).x)
        * (1.0 - unit_gaussian_tail(far.y).x - unit_gaussian_tail(near.y).x);
}

void main() {
    vec3 choice = texelFetch(chosen, ivec2(int(sprite.x), 0), 0).rgb;
    int index = int(choice.x);
    vec4 star = texelFetch(stars, ivec2(index % STARS_PER_ROW, index / STARS_PER_ROW), 0);
    float radius_px = choice.y, peak_dn = vmag_0_peak_dn * star.w * choice.z;
#if MOSAIC
    tints = texelFetch(tints_of_stars, ivec2(int(sprite.x), 0), 0);
#endif
    Piece pieces[PIECES_PER_SPRITE];
    vec2 low_px = vec2(FAR_PX), high_px = vec2(-FAR_PX);
    for (int k = 0; k < PIECES_PER_SPRITE; ++k) {
        Piece piece = piece_of(star.xyz, int(sprite.y) * PIECES_PER_SPRITE + k, radius_px);
        vec2 reach_px = radius_px * recorded_px(piece) / effective_sigma_px + SNAPPING_PX;
        low_px  = piece.light > 0.0 ? min(low_px, piece.centre_px - reach_px) : low_px;
        high_px = piece.light > 0.0 ? max(high_px, piece.centre_px + reach_px) : high_px;
        vec3 px2 = piece.covariance_px2;
        float determinant = px2.x * px2.z - px2.y * px2.y;
        vec3 falloff = HALF_LOG2_E / determinant * vec3(-px2.z, 2.0 * px2.y, -px2.x);
        centres_x[k] = piece.centre_px.x + 0.5;
        centres_y[k] = piece.centre_px.y + 0.5;
        falloff_xx[k] = falloff.x;
        falloff_xy[k] = falloff.y;
        falloff_yy[k] = falloff.z;
        amplitudes_dn[k] = peak_dn * piece.light * sigma_px * sigma_px * inversesqrt(determinant);
        pieces[k] = piece;
    }
    vec2 middle_px = 0.5 * (low_px + high_px), size_px = high_px - low_px;
    float half_px = 0.5 * max(size_px.x, size_px.y), all_flux = 0.0, drawn_flux = 0.0;
    for (int k = 0; k < PIECES_PER_SPRITE; ++k) {
        Piece piece = pieces[k];
        all_flux += piece.light;
        drawn_flux += piece.light == 0.0 ? 0.0 : piece.light
            * fraction_in_square(piece.centre_px - middle_px, recorded_px(piece), half_px);
    }
    amplitudes_dn *= all_flux / max(drawn_flux, 1e-9);
    // A clipped point would send all of the call through a slower part of llvmpipe.  This one lies in a corner of the
    // clip volume and is dark.
    if (all_flux == 0.0 || !is_point_over(low_px, high_px)) {
        gl_Position = vec4(-1.0, -1.0, 0.0, 1.0);
        gl_PointSize = 1.0;
        amplitudes_dn = vec4(0.0);
    }
}
