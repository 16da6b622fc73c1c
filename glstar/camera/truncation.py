"""Where the point spread functions of stars are truncated."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FAINTEST_COMPONENT_DN", "PLAIN", "RENORMALIZED", "TRUNCATION_DN", "Truncation", "gaussian_radius_px"]

Float = NDArray[np.float64]

# The point spread function of a star is truncated where its signal over the whole exposure falls below this, DN.
TRUNCATION_DN: Final = 0.02
# A Gaussian of several is drawn where it is at least this, DN: a tenth of what is cut off a single Gaussian.
FAINTEST_COMPONENT_DN: Final = 0.1 * TRUNCATION_DN


@dataclass(frozen=True, slots=True)
class Truncation:
    """Limits of the radius at which a star's point spread function is truncated, besides `TRUNCATION_DN`.

    Attributes
    ----------
    peak_fraction : float
        The signal at the radius, over the peak, is at most this.
    min_sigma : float
        Smallest radius, sigma.
    min_px : float
        Smallest radius, px.
    """

    peak_fraction: float
    min_sigma: float
    min_px: float = 0.0


# Flux outside the radius is lost: 1e-3 of it at 3.5 sigma.
PLAIN: Final = Truncation(peak_fraction=1e-4, min_sigma=3.5)
# Flux outside the radius is added to the rest.  Below 1.2 px, the sum over the pixels of a narrow trail would depend on
# its position between pixel centres.
RENORMALIZED: Final = Truncation(peak_fraction=1e-3, min_sigma=1.5, min_px=1.2)


def gaussian_radius_px(
    sigma_px: float, peak_dn: ArrayLike, reduction: Float, *, renormalized: bool, faintest_dn: float = 0.0
) -> Float:
    """Return the radius at which Gaussians are truncated.

    Parameters
    ----------
    sigma_px : float
        Standard deviation, px.
    peak_dn : (...) array_like
        Amplitudes of stars that do not move, DN.
    reduction : (...) float64
        Factor by which motion reduces them.
    renormalized : bool
        Whether the flux outside the radius is added to the rest.
    faintest_dn : float
        Signal below which nothing matters, however faint the star is, DN.

    Returns
    -------
    (...) float64
        px.
    """
    limits = RENORMALIZED if renormalized else PLAIN
    peak, most = np.asarray(peak_dn, dtype=np.float64), 1 / limits.peak_fraction
    of_peak = np.minimum(most, peak / faintest_dn) if faintest_dn else most
    contrast = np.maximum(peak / TRUNCATION_DN, of_peak) / reduction
    radius_sigma = np.sqrt(2 * np.log(np.maximum(contrast, 1.0)))
    return np.asarray(np.maximum(sigma_px * radius_sigma, max(limits.min_sigma * sigma_px, limits.min_px)))
