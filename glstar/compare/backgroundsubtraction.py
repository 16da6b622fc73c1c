"""Background subtraction of real images, with their noise and a mask of saturated pixels.

The paper rectifies its images before it measures them.  Here both images are compared with their lens distortion: the
simulated one is rendered through the camera's lens model.
"""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.background import background_of

__all__ = ["SubtractedImage", "subtract_background"]

# A pixel above this fraction of the largest digital number counts as saturated.
_SATURATION_FRACTION: Final = 0.98


@dataclass(frozen=True, slots=True, eq=False)
class SubtractedImage:
    """A real image minus its background.

    Attributes
    ----------
    above_dn : (height, width) float32
        Digital numbers minus the local level of the background.
    noise_dn : (height, width) float32
        Standard deviation of the background noise, DN.
    usable : (height, width) bool
        Mask of the pixels that are not saturated.
    """

    above_dn: NDArray[np.float32]
    noise_dn: NDArray[np.float32]
    usable: NDArray[np.bool_]

    @property
    def usual_noise_dn(self) -> float:
        """The median noise, DN."""
        return float(np.median(self.noise_dn[::8, ::8]))

    @property
    def saturated_fraction(self) -> float:
        """The fraction of saturated pixels."""
        return 1.0 - float(self.usable.mean())

    def significance(self, sigma_px: float) -> NDArray[np.float32]:
        """Return the image in units of its noise, smoothed by a star's width, (height, width) float32."""
        smooth = cv2.GaussianBlur(self.above_dn / self.noise_dn, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
        # The median of absolute values of a Gaussian is 0.6745 of its standard deviation.
        return np.asarray(smooth / max(float(np.median(np.abs(smooth[::3, ::3]))) / 0.6745, 1e-6), dtype=np.float32)


def subtract_background(pixels: NDArray[Any], *, saturation_dn: float) -> SubtractedImage:
    """Return a real image minus its background.

    Parameters
    ----------
    pixels : (height, width) uint8, uint16 or float32
        Digital numbers.
    saturation_dn : float
        The digital number at which the sensor saturates.

    Returns
    -------
    SubtractedImage
    """
    image = pixels.astype(np.float64)
    background = background_of(image)
    return SubtractedImage(
        (image - background.level_dn).astype(np.float32),
        background.noise_dn.astype(np.float32),
        np.asarray(image < _SATURATION_FRACTION * saturation_dn),
    )
