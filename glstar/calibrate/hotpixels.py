"""Hot pixels of one photograph: single bright pixels that no star explains."""

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from glstar.calibrate.jointpsf import JointPsf

__all__ = ["HotPixels", "find_hot_pixels"]

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# A hot pixel exceeds the sky by this, standard deviations: noise does so in one of 10^15 pixels.
_BRIGHT: Final = 8.0
# Its four neighbours have less light than beside the narrowest star by this, standard deviations.
_DARK_NEIGHBOURS: Final = 4.0
_NEIGHBOURS: Final = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class HotPixels:
    """Single bright pixels; in one photograph, tracks of particles across one pixel look the same.

    Attributes
    ----------
    x_px, y_px : (n,) intp
        Columns and rows.
    excess_dn : (n,) float64
        Above the sky; a saturated pixel has at least that.
    """

    x_px: Index
    y_px: Index
    excess_dn: Float

    def __len__(self) -> int:
        return len(self.x_px)

    def dark_frame_dn(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return a map for ``dark_frame``: the excess at the hot pixels and 0 elsewhere.

        Parameters
        ----------
        shape : tuple of int
            Rows and columns of the image.

        Returns
        -------
        (height, width) float32
            DN.
        """
        frame = np.zeros(shape, np.float32)
        frame[self.y_px, self.x_px] = self.excess_dn
        return frame


def find_hot_pixels(above_dn: Float, variance_dn2: Float, dn_per_e: float, joint: JointPsf) -> HotPixels:
    """Return the single bright pixels that are narrower than any star.

    Parameters
    ----------
    above_dn : (height, width) float64
        The image above its sky, DN.
    variance_dn2 : (height, width) float64
        Of the sky and the sensor, DN^2.
    dn_per_e : float
        Variance of further light over its level, DN; 0 for the paper's noise.
    joint : JointPsf
        Shape of the stars.

    Returns
    -------
    HotPixels
        None of them at the edge.

    Notes
    -----
    A star's light in the four neighbours of its brightest pixel, over that pixel, is least where the star is centred on
    the pixel.  Beside a hot pixel there is less than that, beyond the noise of all five pixels.  Stars much narrower
    than a pixel, sigma below 0.3 px, look like hot pixels, and none is found among them.
    """
    least = light_beside_star(joint)
    beside = cv2.filter2D(above_dn, -1, _NEIGHBOURS, borderType=cv2.BORDER_REFLECT)
    noise2 = variance_dn2 + dn_per_e * np.maximum(above_dn, 0)
    beside_noise2 = 4 * variance_dn2 + dn_per_e * np.maximum(beside, 0)
    missing = least * above_dn - beside
    hot = (above_dn > _BRIGHT * np.sqrt(variance_dn2)) & (
        missing > _DARK_NEIGHBOURS * np.sqrt(beside_noise2 + least**2 * noise2)
    )
    # Half of a star's light is missing at least: the profile of stars is not known better.
    hot &= missing > least * above_dn / 2
    hot[[0, -1]] = False
    hot[:, [0, -1]] = False
    y_px, x_px = np.nonzero(hot)
    return HotPixels(x_px, y_px, above_dn[hot])


def light_beside_star(joint: JointPsf) -> float:
    """Return the light in the four neighbours of a pixel over the pixel's, for the narrowest star, centred on it.

    Parameters
    ----------
    joint : JointPsf

    Returns
    -------
    float
    """
    centre = beside = 0.0
    for one in replace(joint.psf, psf_ellipticity=0.0).components(joint.sigma_px, scale=joint.psf.scale_range[0]):
        scale = 1 / (np.sqrt(2) * one.sigma_px)
        middle = erf(0.5 * scale)
        next_to_it = (erf(1.5 * scale) - middle) / 2
        centre += one.flux_fraction * middle**2
        beside += 4 * one.flux_fraction * middle * next_to_it
    return float(beside / centre)
