"""Formulas of OpenCV's lens models.

A lens maps a point (x, y) = (X / Z, Y / Z) of the undistorted image plane, at r from the axis, to the distorted point
(x', y').  With q = r^2 and theta = arctan(r):

==============  ===================================================================  ============================
model           r'                                                                   coefficients
==============  ===================================================================  ============================
``plumb_bob``   r (1 + k1 q + k2 q^2 + k3 q^3), and tangential distortion p1, p2     k1, k2, p1, p2, k3
``rational``    r (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3),       k1, k2, p1, p2, k3, k4, k5, k6,
                tangential distortion, thin prism s1 .. s4, tilted sensor            s1, s2, s3, s4, tau_x, tau_y
``fisheye``     theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)        k1, k2, k3, k4
==============  ===================================================================  ============================

To add a model, write its two functions and add a line to `LENS_MODELS`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "LENS_MODELS",
    "LensFormulas",
    "LensModel",
    "has_tangential_terms",
    "is_tilted",
    "padded",
    "tangential",
    "tangential_derivatives",
    "tilt_homography",
    "tilt_rotation",
]

Float = NDArray[np.float64]
Coefficients = tuple[float, ...]
LensModel = Literal["plumb_bob", "rational", "fisheye"]


@dataclass(frozen=True, slots=True)
class LensFormulas:
    """A lens model.

    Attributes
    ----------
    coefficients : tuple of str
        Names in OpenCV's order.
    radial : callable
        (coefficients, q) to r' / r and its derivative with respect to q, for q = r^2 of shape (n,).
    limit : callable
        Coefficients to the r at which r' is largest or infinite; inf if it grows without end.
    has_tangential_terms : bool
        Whether coefficients 2, 3 and 8 to 13 are p1, p2, thin prism and tilt.
    """

    coefficients: tuple[str, ...]
    radial: Callable[[Coefficients, Float], tuple[Float, Float]]
    limit: Callable[[Coefficients], float]
    has_tangential_terms: bool = False


def padded(coefficients: Coefficients, count: int = 14) -> Coefficients:
    """Return coefficients in OpenCV's order with zeros for those that are left out."""
    return coefficients + (0.0,) * (count - len(coefficients))


def _polynomial_radial(coefficients: Coefficients, q: Float) -> tuple[Float, Float]:
    k1, k2, _, _, k3, k4, k5, k6, *_ = padded(coefficients)
    numerator = 1 + q * (k1 + q * (k2 + q * k3))
    numerator_slope = k1 + q * (2 * k2 + q * 3 * k3)
    if not (k4 or k5 or k6):
        return numerator, numerator_slope
    denominator = 1 + q * (k4 + q * (k5 + q * k6))
    denominator = np.where(denominator == 0, np.nan, denominator)  # a pole
    denominator_slope = k4 + q * (2 * k5 + q * 3 * k6)
    ratio = numerator / denominator
    return ratio, (numerator_slope - ratio * denominator_slope) / denominator


def _polynomial_limit(coefficients: Coefficients) -> float:
    k = padded(coefficients)
    numerator, denominator = np.array([1, k[0], k[1], k[4]]), np.array([1, *k[5:8]])
    polynomial = np.polynomial.polynomial
    # d(r N/D)/dr = (N D + 2 q (N' D - N D')) / D^2, in powers of q.
    left = polynomial.polymul(polynomial.polyder(numerator), denominator)
    right = polynomial.polymul(numerator, polynomial.polyder(denominator))
    crossed = polynomial.polysub(left, right)
    derivative = polynomial.polyadd(polynomial.polymul(numerator, denominator), polynomial.polymulx(2 * crossed))
    return float(np.sqrt(min(_smallest_root(derivative), _smallest_root(denominator))))


def _fisheye_radial(coefficients: Coefficients, q: Float) -> tuple[Float, Float]:
    k1, k2, k3, k4 = padded(coefficients, 4)
    r = np.sqrt(q)
    theta = np.arctan(r)
    t2 = theta * theta
    distorted = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    distorted_slope = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + q)
    # Near the axis the quotients are replaced by their series.
    on_axis = r < 1e-5
    safe_r = np.where(on_axis, 1.0, r)
    ratio = np.where(on_axis, 1.0 + (k1 - 1 / 3) * q, distorted / safe_r)
    slope = np.where(on_axis, k1 - 1 / 3, (distorted_slope - ratio) / (2 * safe_r * safe_r))
    return ratio, slope


def _fisheye_limit(coefficients: Coefficients) -> float:
    k = padded(coefficients, 4)
    theta = np.sqrt(_smallest_root([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]]))
    return float(np.tan(theta)) if theta < np.pi / 2 else float("inf")


def _smallest_root(ascending: ArrayLike) -> float:
    """Return the smallest positive real root of a polynomial that is 1 at 0; inf if there is none."""
    # In powers of 1 / q the leading coefficient is that 1, however small the others are.
    roots = np.polynomial.polynomial.polyroots(np.asarray(ascending, dtype=np.float64)[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-9)]
    return 1 / float(real.max()) if real.size else float("inf")


_POLYNOMIAL = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")

LENS_MODELS: Final[dict[str, LensFormulas]] = {
    "plumb_bob": LensFormulas(_POLYNOMIAL[:5], _polynomial_radial, _polynomial_limit, has_tangential_terms=True),
    "rational": LensFormulas(_POLYNOMIAL, _polynomial_radial, _polynomial_limit, has_tangential_terms=True),
    "fisheye": LensFormulas(("k1", "k2", "k3", "k4"), _fisheye_radial, _fisheye_limit),
}


def has_tangential_terms(model: str, coefficients: Coefficients) -> bool:
    """Return whether points are also moved at right angles to the radius."""
    return LENS_MODELS[model].has_tangential_terms and any((*coefficients[2:4], *coefficients[8:12]))


def is_tilted(model: str, coefficients: Coefficients) -> bool:
    """Return whether the sensor is tilted."""
    return LENS_MODELS[model].has_tangential_terms and any(coefficients[12:])


def tangential(coefficients: Coefficients, x: Float, y: Float, q: Float) -> tuple[Float, Float]:
    """Return the contributions of tangential distortion and thin prism to x' and y'."""
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = padded(coefficients)
    xy2 = 2 * x * y
    return (
        p1 * xy2 + p2 * (q + 2 * x * x) + q * (s1 + q * s2),
        p1 * (q + 2 * y * y) + p2 * xy2 + q * (s3 + q * s4),
    )


def tangential_derivatives(
    coefficients: Coefficients, x: Float, y: Float, q: Float
) -> tuple[Float, Float, Float, Float]:
    """Return the derivatives of `tangential`: dx'/dx, dx'/dy, dy'/dx, dy'/dy."""
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = padded(coefficients)
    prism_x, prism_y = 2 * (s1 + 2 * s2 * q), 2 * (s3 + 2 * s4 * q)
    return (
        2 * p1 * y + 6 * p2 * x + prism_x * x,
        2 * p1 * x + 2 * p2 * y + prism_x * y,
        2 * p1 * x + 2 * p2 * y + prism_y * x,
        6 * p1 * y + 2 * p2 * x + prism_y * y,
    )


def tilt_rotation(coefficients: Coefficients) -> Float:
    """Return the rotation of a tilted sensor, (3, 3): about x, then about y."""
    tau_x, tau_y = padded(coefficients)[12:]
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    return np.asarray(
        np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    )


def tilt_homography(coefficients: Coefficients) -> Float:
    """Return the homography of a tilted sensor, (3, 3), that of OpenCV's computeTiltProjectionMatrix."""
    rotation = tilt_rotation(coefficients)
    onto_z = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    return np.asarray(onto_z @ rotation)
