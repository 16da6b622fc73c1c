"""Colours of stars: B - V of the catalogue, or of Hipparcos for the bundled catalogue, which has none."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.sky.starfield import StarField
from glstar.system.resources import asset

__all__ = ["USUAL_BV", "VALID_BV", "star_colours"]

# Mean B - V of the stars of the Bright Star Catalogue; assumed for stars without a measurement.
USUAL_BV: Final = 0.65
# Colours B - V beyond which what depends on them, such as the polynomials of a band, is constant.
VALID_BV: Final = (-0.3, 1.7)

_ALL: Final = slice(None)

Float = NDArray[np.float64]


def star_colours(stars: StarField, some: slice | NDArray[np.integer] = _ALL) -> Float:
    """Return the colours B - V of stars.

    Parameters
    ----------
    stars : StarField
    some : slice or (n,) int
        Which of them.

    Returns
    -------
    (n,) float64
        Magnitudes; NaN where neither the catalogue nor Hipparcos has a colour.
    """
    star_id = stars.star_id[some]
    bv = np.full(len(star_id), np.nan) if stars.bv is None else stars.bv[some].astype(np.float64)
    missing = np.isnan(bv)
    if stars.catalogue == "bsc5" and missing.any():
        numbers, colours = _bundled()
        at = np.searchsorted(numbers, star_id).clip(max=len(numbers) - 1)
        bv = np.where(missing & (numbers[at] == star_id), colours[at], bv)
    return bv


@cache
def _bundled() -> tuple[NDArray[np.int32], Float]:
    """Return numbers (Harvard Revised), increasing, and B - V of Hipparcos for the bundled stars."""
    with np.load(asset("bsc5-colours.npz")) as colours:
        return colours["hr"].astype(np.int32), colours["bv_mmag"] / 1000
