"""Colour maps of the display: from brightness to colours."""

from enum import StrEnum
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["ColourMap"]


class ColourMap(StrEnum):
    """The colours of a display; all but `TURBO` grow steadily brighter, also in print without colours."""

    GREY = "grey"
    VIRIDIS = "viridis"
    INFERNO = "inferno"
    CIVIDIS = "cividis"
    """For people with and without red-green colour blindness."""
    TURBO = "turbo"
    """A rainbow, for small differences of a flat sky."""

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Red, green, blue by brightness, (256, 3) uint8."""
        return _colours(self)

    def picture(self, brightness: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the colours of an image, as ``display.frag`` draws them.

        Parameters
        ----------
        brightness : (height, width) float32
            0 to 1.

        Returns
        -------
        (height, width, 3) uint8
            Red, green, blue.
        """
        return self.colours[(np.clip(brightness, 0, 1) * 255 + 0.5).astype(np.uint8)]

    @property
    def following(self) -> "ColourMap":
        """The next colour map; of the last one, the first."""
        maps = list(ColourMap)
        return maps[(maps.index(self) + 1) % len(maps)]


@cache
def _colours(colour_map: ColourMap) -> NDArray[np.uint8]:
    levels = np.arange(256, dtype=np.uint8)[:, np.newaxis]
    if colour_map is ColourMap.GREY:
        return np.repeat(levels, 3, axis=1)
    numbers = {
        ColourMap.VIRIDIS: cv2.COLORMAP_VIRIDIS,
        ColourMap.INFERNO: cv2.COLORMAP_INFERNO,
        ColourMap.CIVIDIS: cv2.COLORMAP_CIVIDIS,
        ColourMap.TURBO: cv2.COLORMAP_TURBO,
    }
    return np.ascontiguousarray(cv2.applyColorMap(levels, numbers[colour_map])[:, 0, ::-1])
