"""Magnitudes and brightness."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["brightness_ratio", "magnitude_difference"]


def brightness_ratio(magnitude_difference: ArrayLike) -> NDArray[np.float64]:
    """Return the brightness ratio of a star and its reference, B_x / B_r.

    Parameters
    ----------
    magnitude_difference : (...) array_like
        m_x - m_r, magnitudes: positive for a star fainter than the reference.

    Returns
    -------
    (...) float64

    Notes
    -----
    Teague & Chahl, eq. (37).  Departs from eq. (37), which is printed without the minus sign: a star one magnitude
    fainter is 0.398 times as bright, not 2.51 times.

    Examples
    --------
    >>> float(brightness_ratio(-5.0))
    100.0
    """
    return np.power(10.0, -0.4 * np.asarray(magnitude_difference, dtype=np.float64))


def magnitude_difference(brightness_ratio: ArrayLike) -> NDArray[np.float64]:
    """Return the magnitude difference of a star and its reference, m_x - m_r.

    Parameters
    ----------
    brightness_ratio : (...) array_like
        B_x / B_r, above 0.

    Returns
    -------
    (...) float64
        Magnitudes, positive for a star fainter than the reference.

    Notes
    -----
    Teague & Chahl, eq. (36).
    """
    return -2.5 * np.log10(np.asarray(brightness_ratio, dtype=np.float64))
