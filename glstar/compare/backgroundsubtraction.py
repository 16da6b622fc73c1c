"""Real images made ready: the sky taken off, the noise known, what is burnt out marked.

The paper rectifies its images before it measures them.  Here both images are compared as the sensor has them: the
simulated one is drawn through the camera's lens where the camera has one.
"""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.background import background_of

__all__ = ["SubtractedImage", "subtract_background"]

# Where a pixel holds this share of the largest number, it tells only that there was more.
_SATURATED_SHARE: Final = 0.98


@dataclass(frozen=True, slots=True, eq=False)
class SubtractedImage:
    """A real image above its sky.

    Attributes
    ----------
    above_dn : (height, width) float32
        Digital numbers less the sky's level around.
    noise_dn : (height, width) float32
        Standard deviation of the sky's noise, DN.
    usable : (height, width) bool
        Which pixels are not at the sensor's limit.
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
        """The share of pixels at the sensor's limit."""
        return 1.0 - float(self.usable.mean())

    def significance(self, sigma_px: float) -> NDArray[np.float32]:
        """Return how many times its noise each pixel is, once smoothed by a star's width, (height, width) float32."""
        smooth = cv2.GaussianBlur(self.above_dn / self.noise_dn, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
        # The median of absolute values of a Gaussian is 0.6745 of its standard deviation.
        return np.asarray(smooth / max(float(np.median(np.abs(smooth[::3, ::3]))) / 0.6745, 1e-6), dtype=np.float32)


def subtract_background(pixels: NDArray[Any], *, saturation_dn: float) -> SubtractedImage:
    """Return a real image above its sky.

    Parameters
    ----------
    pixels : (height, width) uint8, uint16 or float32
        Digital numbers.
    saturation_dn : float
        The largest that the sensor gives.

    Returns
    -------
    SubtractedImage
    """
    image = pixels.astype(np.float64)
    background = background_of(image)
    return SubtractedImage(
        (image - background.level_dn).astype(np.float32),
        background.noise_dn.astype(np.float32),
        np.asarray(image < _SATURATED_SHARE * saturation_dn),
    )
