"""The pixels around the stars of a photograph, and the light that a point spread function has in them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import erf

from glstar.camera.pointspread import PointSpread

__all__ = ["StarStamps", "cut_stamps"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class StarStamps:
    """Pixels around stars.

    Attributes
    ----------
    corner_px : (n, 2) float64
        First column and row of each stamp.
    values_dn : (n, m, m) float64
        Above the sky.
    variance_dn2 : (n, m, m) float64
        Of the sky and the sensor, without the star's own light; infinite for pixels that do not count.
    xy_px : (n, 2) float64
        Positions of the stars.
    trail_px : (n, 2) float64
        Motion during the exposure.
    offset : (n, 2) float64
        Position (x, y) minus the principal point, over half the diagonal.
    bv : (n,) float64
        Colours B - V.
    dn_per_e : float
        Gain: the variance of a star's light over its level, DN.  It acts on the fitted light: the recorded one would
        give pixels that are too dark by chance more weight, and make stars narrower and fainter than they are.
    """

    corner_px: Float
    values_dn: Float
    variance_dn2: Float
    xy_px: Float
    trail_px: Float
    offset: Float
    bv: Float
    dn_per_e: float = 0.0

    def __len__(self) -> int:
        return len(self.xy_px)

    def some(self, k: Index | Mask) -> "StarStamps":
        """Return the stamps of some stars."""
        return StarStamps(
            self.corner_px[k], self.values_dn[k], self.variance_dn2[k], self.xy_px[k], self.trail_px[k],
            self.offset[k], self.bv[k], self.dn_per_e,
        )  # fmt: skip

    def profiles(self, psf: PointSpread, sigma_px: float) -> Float:
        """Return the image of each star for a flux of 1, (n, m, m)."""
        samples, weights = _trail_samples(self.trail_px, sigma_px)
        along = np.arange(self.values_dn.shape[1], dtype=np.float64)
        near = self.xy_px - self.corner_px
        scale = psf.scale_at(self.offset, self.bv)
        light = np.zeros_like(self.values_dn)
        # The core's Gaussians scale with the growth; those of the outer parts do not.
        ones, twos = psf.components(sigma_px, scale=1.0), psf.components(sigma_px, scale=2.0)
        for one, two in zip(ones, twos, strict=True):
            grows = two.sigma_px / one.sigma_px - 1
            width = (one.sigma_px * (1 + grows * (scale - 1)))[:, np.newaxis, np.newaxis]
            axes = []
            for axis in (0, 1):
                offset = one.offset_px[axis] * (1 + grows * (scale - 1))
                centre = (near[:, axis] + offset)[:, np.newaxis] + samples * self.trail_px[:, axis, np.newaxis]
                axes.append(_pixels(along - centre[..., np.newaxis], width))
            across, down = axes
            light += one.flux_fraction * np.einsum("t,nty,ntx->nyx", weights, down, across, optimize=True)
        return light


def cut_stamps(
    above_dn: Float,
    variance_dn2: Float,
    usable: Mask,
    xy_px: Float,
    others_px: Float,
    trail_px: Float,
    offset: Float,
    bv: Float,
    half_px: int,
    dn_per_e: float = 0.0,
) -> tuple[StarStamps, Index]:
    """Return the stamps of stars that lie wholly on the image, and which stars these are.

    Parameters
    ----------
    above_dn, variance_dn2 : (height, width) float64
        The image above its sky, DN, and the variance of its pixels without the light of stars, DN^2.
    usable : (height, width) bool
        Pixels that are not saturated.
    xy_px : (n, 2) float64
        Positions, px.
    others_px : (k, 2) float64
        Positions of all stars: pixels that are nearer to another star do not count.
    trail_px : (n, 2) float64
    offset : (n, 2) float64
        From the principal point, over half the diagonal.
    bv : (n,) float64
        Colours B - V.
    half_px : int
        Half the side of a stamp.
    dn_per_e : float
        Variance of the light of stars over its level, DN.

    Returns
    -------
    StarStamps
    (k,) intp
    """
    height, width = above_dn.shape
    corner = np.rint(xy_px).astype(np.intp) - half_px
    inside = np.flatnonzero(((corner >= 0) & (corner < np.array([width, height]) - 2 * half_px)).all(axis=1))
    along = np.arange(2 * half_px + 1)
    columns, rows = corner[inside, :1] + along, corner[inside, 1:] + along
    place = rows[:, :, np.newaxis], columns[:, np.newaxis, :]
    counts = usable[place]
    tree = KDTree(others_px)
    for k, star in enumerate(inside):
        for other in others_px[tree.query_ball_point(xy_px[star], 2.9 * half_px)]:
            if float(np.hypot(*(other - xy_px[star]))) >= 1.0:
                # What lies closer to the other star than that may have its light.
                r2, other_r2 = (_squares(columns[k], rows[k], one) for one in (xy_px[star], other))
                counts[k] &= other_r2 > np.minimum(r2, (0.6 * half_px) ** 2)
    variance = np.where(counts, variance_dn2[place], np.inf)
    stamps = StarStamps(
        corner[inside].astype(np.float64), above_dn[place], variance, xy_px[inside], trail_px[inside],
        offset[inside], bv[inside], dn_per_e,
    )  # fmt: skip
    return stamps, inside


def _squares(columns: Index, rows: Index, xy_px: Float) -> Float:
    """Return the squared distances of the pixels of a rectangle from a position, px^2."""
    return np.asarray((columns - xy_px[0]) ** 2 + ((rows - xy_px[1]) ** 2)[:, np.newaxis])


def _pixels(offset_px: Float, sigma_px: Float) -> Float:
    """Return one axis of a Gaussian of flux 1, integrated over pixels."""
    upper, lower = (offset_px + 0.5) / (np.sqrt(2) * sigma_px), (offset_px - 0.5) / (np.sqrt(2) * sigma_px)
    return np.asarray(0.5 * (erf(upper) - erf(lower)))


def _trail_samples(trail_px: Float, sigma_px: float) -> tuple[Float, Float]:
    """Return Gauss-Legendre nodes along trails, -1/2 to 1/2, and their weights."""
    longest_px = float(np.linalg.norm(trail_px, axis=1).max(initial=0.0))
    count = 1 if longest_px < 1e-3 else 2 + int(np.ceil(longest_px / max(sigma_px, 0.3)))
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes / 2, weights / 2
