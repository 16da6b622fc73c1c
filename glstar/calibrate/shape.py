"""The shape of stars: round, or elongated by motion during the exposure."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["drawn_out_px", "star_shapes"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Most and fewest stars whose shape is measured, ...
_MOST_SHAPES: Final = 120
_LEAST_SHAPES: Final = 6
# ... each within a window of this half-width, px and sigma.
_WINDOW_PX: Final = 20
_WINDOW_SIGMA: Final = 5
_ROUNDS: Final = 15
_NARROWEST_PX2: Final = 0.02
# Smallest ratio of the two widths of a trailed star; optical aberrations hardly change the median star.
_ROUND: Final = 1.25
# Variance along a trail in a Gaussian window, over the square of its length: 1/12 for a short trail, and slightly more
# for a long one.
_VARIANCE_FRACTION: Final = 1 / 11


def drawn_out_px(above_dn: Float, usable: Mask, xy_px: Float, sigma_px: float) -> float:
    """Return the approximate length of the stars' trails, px; 0 if they are round.

    Parameters
    ----------
    above_dn : (height, width) float64
        The image without its sky, DN.
    usable : (height, width) bool
        Mask of the usable pixels.
    xy_px : (n, 2) float64
        Positions of bright stars, the brightest first.
    sigma_px : float
        Approximate width of the stars, px.

    Returns
    -------
    float
        The median trail length of the brightest stars without unusable pixels, px.

    Notes
    -----
    Second moments under a Gaussian window that is adapted to the star's shape until both agree.
    """
    xx, yy, xy = star_shapes(above_dn, usable, xy_px, sigma_px)
    if len(xx) < _LEAST_SHAPES:
        return 0.0
    # All stars move alike; aberrations of a lens are radial or tangential, and cancel in the median.
    small, large = np.linalg.eigvalsh([[np.median(xx), np.median(xy)], [np.median(xy), np.median(yy)]])
    return float(np.sqrt((large - small) / _VARIANCE_FRACTION)) if large > _ROUND**2 * small else 0.0


def star_shapes(above_dn: Float, usable: Mask, xy_px: Float, sigma_px: float) -> tuple[Float, Float, Float]:
    """Return the second moments of stars under a Gaussian window that adapts to each star's shape.

    Parameters
    ----------
    above_dn : (height, width) float64
        The image without its sky, DN.
    usable : (height, width) bool
        Mask of the usable pixels.
    xy_px : (n, 2) float64
        Positions of bright stars, the brightest first.
    sigma_px : float
        Approximate width of the stars, px.

    Returns
    -------
    xx, yy, xy : (k,) float64
        Variances along x and y and their covariance, pixel included, px^2: of at most 120 stars that touch neither
        the edge nor unusable pixels.
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
    return _shapes(np.array(stamps), sigma_px)


def _shapes(stamps: Float, sigma_px: float) -> tuple[Float, Float, Float]:
    """Return the variances of stars along x and y and their covariance, px^2, for stars whose iteration converges."""
    half = stamps.shape[1] // 2
    along = np.arange(-half, half + 1.0)
    count = len(stamps)
    x, y, xy = np.zeros(count), np.zeros(count), np.zeros(count)
    xx, yy = np.full(count, sigma_px**2 + 1 / 12), np.full(count, sigma_px**2 + 1 / 12)
    for _ in range(_ROUNDS):
        determinant = xx * yy - xy**2
        good = (np.minimum(xx, yy) > _NARROWEST_PX2) & (determinant > _NARROWEST_PX2**2) & (xx + yy < half**2)
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
