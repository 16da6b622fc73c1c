"""The histogram of an image: how many pixels have each brightness."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Histogram"]

Float = NDArray[np.float64]

# Largest number of bins, and of rows that are counted.
_BINS: Final = 256
_ROWS: Final = 1000
# Share of the pixels, in percent, that the range of the bins contains at least.
_SHOWN_PERCENT: Final = 99.99


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """The histogram of an image.

    Attributes
    ----------
    level_dn : (n,) float64
        The middle of each bin, DN; bins are one or more whole digital numbers wide.
    fraction : (n,) float64
        Share of the pixels in each bin.
    """

    level_dn: Float
    fraction: Float

    @classmethod
    def of(cls, pixels: NDArray[Any]) -> "Histogram":
        """Return the histogram of an image.

        Parameters
        ----------
        pixels : (height, width) uint8 or uint16
            Digital numbers; of large images every second, third ... row is counted.

        Returns
        -------
        Histogram
            From the lowest digital number to that below which 99.99 % of the pixels are; brighter pixels are in the
            last bin.
        """
        counts = np.bincount(pixels[:: max(1, -(-pixels.shape[0] // _ROWS))].ravel())
        share = np.cumsum(counts) / counts.sum()
        first = int(np.searchsorted(share, 0.0, side="right"))
        last = max(int(np.searchsorted(share, _SHOWN_PERCENT / 100)), first + 1)
        width = -(-(last + 1 - first) // _BINS)
        edges = np.arange(first, last + 1, width)
        binned = np.add.reduceat(counts[first:], edges[edges < len(counts)] - first)
        level_dn = np.asarray(edges[: len(binned)] + (width - 1) / 2, dtype=np.float64)
        return cls(level_dn, np.divide(binned, counts.sum(), dtype=np.float64))
