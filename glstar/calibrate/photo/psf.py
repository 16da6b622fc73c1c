"""The renderer's Gaussian, integrated over pixels, and its fit to stars; shapes of stars elongated by motion."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.special import erf

from glstar.arrays import Float, Index, Mask
from glstar.calibrate.minimise import minimise_each
from glstar.camera.sensor.sensor import MIN_WIDENED_SIGMA_PX, PIXEL_VARIANCE_PX2

# Half the side of a star's stamp, sigma, besides one pixel: it holds 99.9 % of the flux and some sky.
_STAMP_SIGMA = 4.0
_ROUNDS = 40
# Number of stamp pixels fitted at a time.
_BLOCK_PIXELS = 60_000
# Converged when a step changes no star by more than this, px and ln sigma.
_CONVERGED = 1e-4
# Narrowest sigma of a fit, px.
_NARROWEST_PX = 0.1
# The bias correction of fainter stars is that of a star with this signal-to-noise ratio.
_FAINTEST_SD = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class FittedStars:
    """Gaussians fitted to the stars of an image."""

    xy_px: Float  # (n, 2) centres (x, y)
    # (n,) amplitudes of the point spread functions above the sky, as in `glstar.camera.sensor.sensor.Sensor.peak_dn`,
    # DN.
    peak_dn: Float
    peak_sd_dn: Float  # (n,) their standard errors, DN
    sigma_px: Float  # (n,) their standard deviations, px, without the pixel's own width
    ln_sigma_sd: Float  # (n,) the standard errors of their logarithms; 0 if the width was fixed
    sky_dn: Float  # (n,) the level under each star, DN
    misfit_dn: Float  # (n,) root mean square residual of the fit, DN
    converged: Mask  # (n,) bool: whether the fit converged inside the star's stamp

    def __len__(self) -> int:
        return len(self.peak_dn)

    @property
    def unbiased_peak_dn(self) -> Float:
        """The amplitudes without their noise bias, (n,) float64, DN.

        Least squares moves a star to where the noise adds to its flux.  The mean bias is the square of the standard
        error over the amplitude: 1 % at a signal-to-noise ratio of 10 (Box's bias of least squares, for this model).
        """
        return np.asarray(self.peak_dn - self.peak_sd_dn**2 / np.maximum(self.peak_dn, _FAINTEST_SD * self.peak_sd_dn))

    @property
    def unbiased_sigma_px(self) -> Float:
        """The widths without their noise bias, (n,) float64, px.

        For the same reason noise makes stars too sharp: the recorded width is biased by the variance of ln sigma.
        """
        recorded = self.sigma_px**2 / (self.sigma_px**2 + PIXEL_VARIANCE_PX2)
        return np.asarray(self.sigma_px * np.exp(recorded * np.minimum(self.ln_sigma_sd, 1 / _FAINTEST_SD) ** 2))


def profile(offset_px: ArrayLike, sigma_px: float) -> Float:
    """Return one axis of a Gaussian of peak 1, integrated over pixels.

    `offset_px` (...): pixel centre minus star centre, px; `sigma_px`: standard deviation of the point spread function,
    px.  Returns (...): the image of a star is its amplitude times the profiles of both axes.  Teague & Chahl, eqs
    (42), (43).  Departs from eq. (42): a pixel integrates over its area.  From 1.1 px up a widened Gaussian
    approximates that integral, here as in the renderer, so that a fit recovers the sensor's sigma.
    """
    offset = np.asarray(offset_px, dtype=np.float64)
    return _axis(offset, np.array(sigma_px), widened=sigma_px >= MIN_WIDENED_SIGMA_PX)[0]


def dilution(trail_px: Float, sigma_px: float) -> Float:
    """Return the peak of a star's trail over the amplitude of the star at rest.

    `trail_px` (n, 2): vector from one end of the trail to the other, px; `sigma_px`: standard deviation of the point
    spread function, px.  Returns (n,): 1 for a star at rest.
    """
    length = np.maximum(np.linalg.norm(trail_px, axis=1), 1e-6)
    return np.asarray(sigma_px * np.sqrt(2 * np.pi) / length * erf(length / (2 * np.sqrt(2) * sigma_px)))


def draw_stars(
    shape: tuple[int, int], xy_px: Float, peak_dn: Float, sigma_px: ArrayLike, *, trail_px: Float | None = None
) -> Float:
    """Return the noiseless signal of stars, without background.

    `shape` (int, int): height and width of the image, px; `xy_px` (n, 2): their positions, px; `peak_dn` (n,): their
    amplitudes, DN; `sigma_px` float or (n,) array_like: standard deviation of the point spread function, px; `trail_px`
    (n, 2): uniform motion of each star during the exposure; `xy_px` is the middle of its path; by default the stars are
    at rest.  Returns (height, width) DN.  Teague & Chahl, eq. (43).
    """
    light = np.zeros(shape)
    each_sigma_px = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(xy_px))
    if trail_px is not None and len(xy_px):
        steps, weights_ = _exposure_samples(trail_px, float(each_sigma_px.min()))
        positions = xy_px[:, np.newaxis] + steps[:, np.newaxis] * trail_px[:, np.newaxis]
        xy_px, peak_dn = positions.reshape(-1, 2), np.outer(peak_dn, weights_).ravel()
        each_sigma_px = np.repeat(each_sigma_px, len(weights_))
    for (x, y), peak, sigma in zip(xy_px, peak_dn, each_sigma_px.tolist(), strict=True):
        # Radius at which the signal falls to 0.001 DN.
        radius_px = sigma * np.sqrt(2 * np.log(max(peak / 1e-3, 2.0))) + 1
        rows = np.arange(max(0, int(np.ceil(y - radius_px))), min(shape[0], int(np.floor(y + radius_px)) + 1))
        columns = np.arange(max(0, int(np.ceil(x - radius_px))), min(shape[1], int(np.floor(x + radius_px)) + 1))
        if rows.size and columns.size:
            patch = peak * np.outer(profile(rows - y, sigma), profile(columns - x, sigma))
            light[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += patch
    return light


def fit_stars(
    image_dn: Float,
    usable: Mask,
    xy_px: Float,
    *,
    start_sigma_px: float,
    sigma_px: float | None = None,
    trail_px: Float | None = None,
    stamp_trail_px: Float | None = None,
    only: Index | None = None,
) -> FittedStars:
    """Return Gaussians fitted to stars by least squares, all at once.

    `usable` (height, width): pixels that count: not saturated.  `xy_px` (n, 2): positions of the stars to 1 or 2 px;
    each pixel belongs to the nearest star.  `start_sigma_px`: approximate width; `sigma_px`: fixed width, by default
    fitted.  `trail_px` (n, 2): uniform motion during the exposure; the amplitude is that of the star at rest.
    `stamp_trail_px` (n, 2): size the stamps for trails of these lengths, whatever `trail_px` is, so that fits can be
    compared.  `only` (k,): fit and return only these stars; the others keep the pixels nearest to them.
    Levenberg-Marquardt on amplitude, position, ln sigma and sky, with the renderer's model.  Departs from Teague &
    Chahl, eq. (39): the standard deviation of a set of intensities is not a length; the fitted sigma is.
    """
    start = start_sigma_px if sigma_px is None else sigma_px
    trail = np.zeros_like(xy_px) if trail_px is None else trail_px
    longest_px = float(np.linalg.norm(trail if stamp_trail_px is None else stamp_trail_px, axis=1).max(initial=0.0))
    half = int(np.ceil(_STAMP_SIGMA * np.hypot(start, 0.3) + longest_px / 2)) + 1
    # Blocks of a few stars fit into the processor's cache.
    block = max(1, _BLOCK_PIXELS // (2 * half + 1) ** 2)
    corner, stamps, weights = _stamps(image_dn, usable, xy_px, half, np.arange(len(xy_px)) if only is None else only)
    if only is not None:
        xy_px, trail = xy_px[only], trail[only]
    near = xy_px - corner
    fits = _fit_all(stamps, weights, near, trail, start, block, width_free=sigma_px is None)
    if sigma_px is None and fits[3].any():
        typical_px = float(np.exp(np.median(fits[0][fits[3], 3])))
        # Narrow and wide stars have different models: repeat the fit if the starting width chose the wrong one.
        if (typical_px < MIN_WIDENED_SIGMA_PX) != (start < MIN_WIDENED_SIGMA_PX):
            fits = _fit_all(stamps, weights, near, trail, typical_px, block, width_free=True)
    return _fitted_stars(*fits, corner, weights, free=5 if sigma_px is None else 4)


def _fit_all(
    stamps: Float, weights: Float, near: Float, trail: Float, start_px: float, block: int, *, width_free: bool
) -> tuple[Float, Float, Float, Mask]:
    """Return what `_fit_some` returns, for all stars, `block` at a time."""
    fits = [
        _fit_some(
            stamps[k : k + block],
            weights[k : k + block],
            near[k : k + block],
            trail[k : k + block],
            start_px,
            width_free=width_free,
        )
        for k in range(0, len(near), block)
    ]
    if not fits:
        return np.empty((0, 5)), np.empty(0), np.empty((0, 2)), np.empty(0, dtype=np.bool_)
    p, cost, variance, converged = (np.concatenate(parts) for parts in zip(*fits, strict=True))
    return p, cost, variance, converged


def _fitted_stars(
    p: Float, cost: Float, variance: Float, converged: Mask, corner: Float, weights: Float, *, free: int
) -> FittedStars:
    """Return the stars of fitted parameters; `free` is the number of free parameters of each star."""
    misfit_dn = np.sqrt(cost / np.maximum(weights.sum(axis=(1, 2)) - free, 1))
    return FittedStars(
        xy_px=p[:, 1:3] + corner,
        peak_dn=p[:, 0],
        peak_sd_dn=misfit_dn * np.sqrt(variance[:, 0]),
        sigma_px=np.exp(p[:, 3]),
        ln_sigma_sd=misfit_dn * np.sqrt(variance[:, 1]),
        sky_dn=p[:, 4],
        misfit_dn=misfit_dn,
        converged=converged & (weights.sum(axis=(1, 2)) > 2 * free),
    )


def _fit_some(
    stamps: Float, weights: Float, centre: Float, trail: Float, start: float, *, width_free: bool
) -> tuple[Float, Float, Float, Mask]:
    """Return amplitude, x, y, ln sigma and sky of each star (n, 5), its sum of squares, and whether it converged.

    The third value is the variances of amplitude and ln sigma for a pixel noise of 1, (n, 2).
    """
    half = stamps.shape[1] // 2
    p = _first_guess(stamps, weights, centre, start)
    p[:, 0] /= dilution(trail, start)
    model = _Model(stamps, weights, trail, _exposure_samples(trail, start), start >= MIN_WIDENED_SIGMA_PX, width_free)

    def bounded(p: Float) -> Float:
        p[:, 3] = np.clip(p[:, 3], np.log(_NARROWEST_PX), np.log(half + 1.0))
        return p

    p, cost, normal, converged = minimise_each(
        p,
        lambda p, k: model.some(k).normal_equations(p),
        lambda step: np.asarray((np.abs(step[:, 1:4]) < _CONVERGED).all(axis=1)),
        step_of=partial(_step, width_free=width_free),
        bounded=bounded,
        most_steps=_ROUNDS,
    )
    at_home = (np.abs(p[:, 1:3] - half) <= half).all(axis=1)
    # A peak that is not a star may leave a parameter undetermined.
    variance = np.maximum(np.diagonal(np.linalg.pinv(normal, hermitian=True), axis1=1, axis2=2), 0.0)
    variance = np.column_stack([variance[:, 0], variance[:, 4] if width_free else np.zeros(len(p))])
    return p, cost, variance, converged & at_home & np.isfinite(p).all(axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """Stamps (n, m, m), the weights of their pixels, and the model of the stars on them."""

    stamps: Float
    weights: Float
    trail: Float
    samples: tuple[Float, Float]
    widened: bool
    width_free: bool

    def some(self, k: Index) -> "_Model":
        return (
            self
            if len(k) == len(self.stamps)
            else replace(self, stamps=self.stamps[k], weights=self.weights[k], trail=self.trail[k])
        )

    def normal_equations(self, p: Float) -> tuple[Float, Float, Float]:
        """Return each star's sum of squares (n,), J^T r (n, k) and J^T J (n, k, k), for k free parameters.

        These are amplitude, x, y, sky and, if it is free, ln sigma.
        """
        count, side = self.stamps.shape[:2]
        peak, sigma = p[:, 0, np.newaxis, np.newaxis], np.exp(p[:, 3])[:, np.newaxis, np.newaxis]
        # A moving star is a weighted mean of stars along its path: (n, samples, m).
        steps, weights_ = self.samples
        along = np.arange(side, dtype=np.float64)
        x, y = (p[:, k, np.newaxis] + steps * self.trail[:, k - 1, np.newaxis] for k in (1, 2))
        gx, gx_x, gx_s = _axis(along - x[..., np.newaxis], sigma, widened=self.widened)
        gy, gy_y, gy_s = _axis(along - y[..., np.newaxis], sigma, widened=self.widened)
        gx, gx_x, gx_s = (weights_[:, np.newaxis] * g for g in (gx, gx_x, gx_s))

        slopes = np.empty((count, 5 if self.width_free else 4, side, side))
        _outer(gy, gx, slopes[:, 0])
        _outer(gy, peak * gx_x, slopes[:, 1])
        _outer(peak * gy_y, gx, slopes[:, 2])
        slopes[:, 3] = 1.0
        if self.width_free:
            _outer(np.concatenate([peak * gy_s, gy], axis=1), np.concatenate([gx, peak * gx_s], axis=1), slopes[:, 4])
        slopes *= self.weights[:, np.newaxis]
        residual = self.stamps * self.weights - peak * slopes[:, 0] - p[:, 4, np.newaxis, np.newaxis] * slopes[:, 3]
        J, r = slopes.reshape(count, slopes.shape[1], -1), residual.reshape(count, -1, 1)
        return np.sum(residual**2, axis=(1, 2)), (J @ r)[..., 0], J @ np.swapaxes(J, 1, 2)


def _outer(down: Float, across: Float, out: Float) -> None:
    """Fill in the products of rows and columns, (n, m, m), summed over the samples, (n, samples, m)."""
    if down.shape[1] == 1:
        np.multiply(down[:, 0, :, np.newaxis], across[:, 0, np.newaxis], out=out)
    else:
        np.matmul(np.swapaxes(down, 1, 2), across, out=out)


def _exposure_samples(trail_px: Float, sigma_px: float) -> tuple[Float, Float]:
    """Return positions along the trail, from -1/2 to 1/2, and their weights: fractions of the exposure.

    Gauss-Legendre nodes: no sampling ripple, and the exact width and length of the trail with few samples.
    """
    longest_px = float(np.linalg.norm(trail_px, axis=1).max(initial=0.0))
    count = 1 if longest_px == 0 else 2 + int(np.ceil(longest_px / max(sigma_px, 0.3)))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes / 2, weights / 2


def _stamps(image_dn: Float, usable: Mask, xy_px: Float, half: int, only: Index) -> tuple[Float, Float, Float]:
    """Return the first pixels (k, 2) of some stars' stamps, values and weights, (k, m, m): 1 for the star's own."""
    height, width = image_dn.shape
    corner = np.rint(xy_px[only]).astype(np.intp) - half
    along = np.arange(2 * half + 1)
    columns, rows = corner[:, :1] + along, corner[:, 1:] + along
    inside = ((rows >= 0) & (rows < height))[:, :, np.newaxis] & ((columns >= 0) & (columns < width))[:, np.newaxis, :]
    r, c = rows.clip(0, height - 1), columns.clip(0, width - 1)
    place = r[:, :, np.newaxis], c[:, np.newaxis, :]
    counts = inside & usable[place]
    # A pixel belongs to the nearest star.
    row = np.full(len(xy_px), -1)
    row[only] = np.arange(len(only))
    pairs = KDTree(xy_px).query_pairs(3 * half, output_type="ndarray")
    for star, other in np.concatenate([pairs, pairs[:, ::-1]]):
        k = row[star]
        if k >= 0 and (xy_px[star] != xy_px[other]).any():
            (x, y), (other_x, other_y) = xy_px[star], xy_px[other]
            # The nearer of two stars depends on the side of their bisector.
            farther_x = (c[k] - other_x) ** 2 - (c[k] - x) ** 2
            farther_y = (r[k] - other_y) ** 2 - (r[k] - y) ** 2
            counts[k] &= farther_x >= -farther_y[:, np.newaxis]
    return corner.astype(np.float64), image_dn[place], counts.astype(np.float64)


def _first_guess(stamps: Float, weights: Float, centre: Float, sigma_px: float) -> Float:
    """Return start values of amplitude, x, y, ln sigma and sky of each star, (n, 5)."""
    values = np.where(weights > 0, stamps, np.nan)
    values[np.isnan(values).all(axis=(1, 2))] = 0.0
    sky = np.nanmedian(values, axis=(1, 2))
    peak = np.maximum(np.nanmax(values, axis=(1, 2)) - sky, 1e-3)
    return np.column_stack([peak, centre, np.full(len(stamps), np.log(sigma_px)), sky])


def _axis(offset: Float, sigma: Float, *, widened: bool) -> tuple[Float, Float, Float]:
    """Return the profile and its derivatives by the star's position and by ln sigma."""
    if widened:
        variance = sigma**2 + PIXEL_VARIANCE_PX2
        share, away = sigma**2 / variance, offset**2 / variance
        g = np.sqrt(share) * np.exp(-0.5 * away)
        return g, g * offset / variance, g * (1 + share * (away - 1))
    upper, lower = (offset + 0.5) / sigma, (offset - 0.5) / sigma
    at_upper, at_lower = np.exp(-0.5 * upper**2), np.exp(-0.5 * lower**2)
    g = sigma * np.sqrt(np.pi / 2) * (erf(upper / np.sqrt(2)) - erf(lower / np.sqrt(2)))
    return g, at_lower - at_upper, g - sigma * (upper * at_upper - lower * at_lower)


def _step(solution: Float, *, width_free: bool) -> Float:
    """Return the step of each star, (n, 5), from the step of its free parameters; 0 for fixed parameters."""
    step = np.zeros((len(solution), 5))
    # In one step a star moves by at most a pixel, and widens by at most half.
    step[:, 0], step[:, 4] = solution[:, 0], solution[:, 3]
    step[:, 1:3] = solution[:, 1:3].clip(-1, 1)
    if width_free:
        step[:, 3] = solution[:, 4].clip(-0.5, 0.5)
    return step


# Most and fewest stars whose shape is measured, ...
_MOST_SHAPES = 120
_LEAST_SHAPES = 6
# ... each within a window of this half-width, px and sigma.
_WINDOW_PX = 20
_WINDOW_SIGMA = 5
_SHAPE_ROUNDS = 15
_NARROWEST_SHAPE_PX2 = 0.02
# Smallest ratio of the two widths of a trailed star; optical aberrations hardly change the median star.
_ROUND_RATIO = 1.25
# Elongations differ by less than this from the median, over it, in at least this fraction of trailed stars.
_ALIKE = 0.7
_MOST_ALIKE = 0.5
# Variance along a trail in a Gaussian window, over the square of its length: 1/12 for a short trail, and slightly more
# for a long one.
_VARIANCE_FRACTION = 1 / 11


def drawn_out_px(above_dn: Float, usable: Mask, xy_px: Float, sigma_px: float) -> float | None:
    """Return the median length of the trails of the brightest stars without unusable pixels, px; 0 if they are round.

    The parameters are those of `star_shapes`.  Trails belong to stars if most of them are alike; it is None for
    fewer than six stars.
    """
    xx, yy, xy = star_shapes(above_dn, usable, xy_px, sigma_px)
    if len(xx) < _LEAST_SHAPES:
        return None
    # All stars move alike; aberrations of a lens are radial or tangential, and cancel in the median.
    small, large = np.linalg.eigvalsh([[np.median(xx), np.median(xy)], [np.median(xy), np.median(yy)]])
    if large <= _ROUND_RATIO**2 * small:
        return 0.0
    shape = np.column_stack([xx - yy, 2 * xy])
    typical = np.median(shape, axis=0)
    alike = np.linalg.norm(shape - typical, axis=1) < _ALIKE * np.linalg.norm(typical)
    return float(np.sqrt((large - small) / _VARIANCE_FRACTION)) if alike.mean() >= _MOST_ALIKE else 0.0


def star_shapes(above_dn: Float, usable: Mask, xy_px: Float, sigma_px: float) -> tuple[Float, Float, Float]:
    """Return the second moments of stars under a Gaussian window that adapts to each star's shape.

    `above_dn` (height, width): the image without its sky, DN; `usable` (height, width) bool: mask of the usable pixels;
    `xy_px` (n, 2): positions of bright stars, the brightest first; `sigma_px`: approximate width of the stars, px.
    Returns `xx, yy, xy` (k,): variances along x and y and their covariance, pixel included, px^2: of at most 120 stars
    that touch neither the edge nor unusable pixels.
    """
    half = int(np.ceil(max(_WINDOW_PX, _WINDOW_SIGMA * sigma_px)))
    height, width = above_dn.shape
    stamps: list[Float] = []
    for x, y in np.rint(xy_px).astype(int):
        if min(x, y) < half or x + half >= width or y + half >= height:
            continue
        stamp = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
        if usable[stamp].all():
            stamps.append(above_dn[stamp])
        if len(stamps) == _MOST_SHAPES:
            break
    if not stamps:
        none = np.empty(0)
        return none, none, none
    return _windowed_moments(np.array(stamps), sigma_px)


def _windowed_moments(stamps: Float, sigma_px: float) -> tuple[Float, Float, Float]:
    """Return the variances of stars along x and y and their covariance, px^2, for stars whose iteration converges."""
    half = stamps.shape[1] // 2
    along = np.arange(-half, half + 1.0)
    count = len(stamps)
    x, y, xy = np.zeros(count), np.zeros(count), np.zeros(count)
    xx, yy = np.full(count, sigma_px**2 + 1 / 12), np.full(count, sigma_px**2 + 1 / 12)
    for _ in range(_SHAPE_ROUNDS):
        determinant = xx * yy - xy**2
        good = (
            (np.minimum(xx, yy) > _NARROWEST_SHAPE_PX2) & (determinant > _NARROWEST_SHAPE_PX2**2) & (xx + yy < half**2)
        )
        good &= (np.abs(x) < half / 2) & (np.abs(y) < half / 2)
        stamps, x, y, xx, yy, xy, determinant = (array[good] for array in (stamps, x, y, xx, yy, xy, determinant))
        dx, dy = along - x[:, np.newaxis], along - y[:, np.newaxis]
        tilt = (xy / determinant)[:, np.newaxis, np.newaxis] * dy[:, :, np.newaxis] * dx[:, np.newaxis, :]
        across = ((yy / determinant)[:, np.newaxis] * dx**2)[:, np.newaxis, :]
        down = ((xx / determinant)[:, np.newaxis] * dy**2)[:, :, np.newaxis]
        light = np.exp(tilt - 0.5 * (across + down)) * stamps
        columns, rows = light.sum(axis=1), light.sum(axis=2)
        total = np.maximum(columns.sum(axis=1), 1e-9)
        x, y = x + 2 * (columns * dx).sum(axis=1) / total, y + 2 * (rows * dy).sum(axis=1) / total
        xx, yy = 2 * (columns * dx**2).sum(axis=1) / total, 2 * (rows * dy**2).sum(axis=1) / total
        xy = 2 * np.einsum("nij,ni,nj->n", light, dy, dx, optimize=True) / total
    return xx, yy, xy
