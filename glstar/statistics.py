"""Robust statistics."""

import numpy as np
from numpy.typing import ArrayLike


def robust_std(values: ArrayLike, middle: float = 0.0) -> float:
    """Return a robust standard deviation: 1.4826 times the median absolute deviation.

    `values`: values in any unit; `middle`: the value from which deviations are measured, in the same unit.  Returns: in
    the same unit; 0.0 if there are no values.
    """
    off = np.abs(np.asarray(values) - middle)
    return 1.4826 * float(np.median(off)) if off.size else 0.0
