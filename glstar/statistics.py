"""Spreads that a few bad values do not move."""

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["robust_std"]


def robust_std(values: ArrayLike, middle: float = 0.0) -> float:
    """Return the standard deviation that normal values with this median distance from their middle have.

    Parameters
    ----------
    values : array_like
        In any unit.
    middle : float
        In the same unit.

    Returns
    -------
    float
        In the same unit; 0.0 of none.
    """
    off = np.abs(np.asarray(values) - middle)
    return 1.4826 * float(np.median(off)) if off.size else 0.0
