"""Lens distortion, by OpenCV's models: from the undistorted image plane to the distorted one and back.

A point of the undistorted plane is (x, y) = (X / Z, Y / Z) of a direction in the camera frame; the camera matrix turns
the distorted point (x', y') into pixels.  With r the distance from the axis, q = r^2 and theta = arctan(r):

==============  ===================================================================  ============================
model           r'                                                                   coefficients
==============  ===================================================================  ============================
``plumb_bob``   r (1 + k1 q + k2 q^2 + k3 q^3), and tangential distortion p1, p2     k1, k2, p1, p2, k3
``rational``    r (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3),       k1, k2, p1, p2, k3, k4, k5, k6,
                tangential distortion, thin prism s1 .. s4, tilted sensor            s1, s2, s3, s4, tau_x, tau_y
``fisheye``     theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)        k1, k2, k3, k4
==============  ===================================================================  ============================

The polynomials are not monotonic everywhere: beyond some radius, stars outside the field would come back into the
image.  A lens ends at that radius (`Lens.limit`), and directions beyond it have no pixel position.  To add a model,
write its two functions and add a line to `LENS_MODELS`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float
from glstar.errors import CalibrationError

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
    numerator = np.array([1, k[0], k[1], k[4]])
    denominator = np.array([1, *k[5:8]])
    polynomial = np.polynomial.polynomial
    # d(r N/D)/dr = (N D + 2 q (N' D - N D')) / D^2, in powers of q.
    crossed = polynomial.polysub(
        polynomial.polymul(polynomial.polyder(numerator), denominator),
        polynomial.polymul(numerator, polynomial.polyder(denominator)),
    )
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

LENS_MODELS: dict[str, LensFormulas] = {
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
    prism_x = 2 * (s1 + 2 * s2 * q)
    prism_y = 2 * (s3 + 2 * s4 * q)
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


# The coefficients of each model, in OpenCV's order.
COEFFICIENTS = {name: model.coefficients for name, model in LENS_MODELS.items()}
# Numbers of coefficients that do not split a pair such as p1, p2.
_COUNTS_WITH_WHOLE_PAIRS = (2, 4, 5, 6, 7, 8, 12, 14)
# Largest field angle: the tangent of 90 deg is infinite.
_MAX_FIELD_RAD = np.deg2rad(89.5)
# Entries of the table of radii from which Newton's method starts.
_TABLE_SIZE = 1024
_MAX_STEPS = 12
# Newton's method stops at this error, in tangents: a hundred millionth of a pixel at f = 10 000 px.
_CONVERGED = 1e-12
# Larger errors after the last step mean that the point has no undistorted position.
_MAX_ERROR = 1e-10
# Points that are undistorted together; limits memory.
_BLOCK = 1 << 18


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens with distortion.

    Attributes
    ----------
    model : {"plumb_bob", "rational", "fisheye"}
        OpenCV's models; ROS calls them plumb_bob, rational_polynomial and equidistant.
    coefficients : tuple of float
        In OpenCV's order; those that are left out are zero.

    Raises
    ------
    CalibrationError
        If the model is unknown, there are too many coefficients, or one is not a finite number.
    """

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise CalibrationError(f"there is no lens model {self.model!r}; there are {', '.join(LENS_MODELS)}")
        names = LENS_MODELS[self.model].coefficients
        if len(self.coefficients) > len(names):
            raise CalibrationError(
                f"{len(self.coefficients)} distortion coefficients are too many for {self.model}: {', '.join(names)}"
            )
        for name, number in zip(names, self.coefficients, strict=False):
            if not isfinite(number):
                raise CalibrationError(f"the lens has {name} = {number}; it must be a finite number")

    @property
    def limit(self) -> float:
        """Largest distance of an undistorted point from the axis: the tangent of the largest field angle, or inf."""
        return _limit(self)

    @property
    def keys(self) -> dict[str, str | list[float]]:
        """The keys ``lens`` and ``distortion`` of ``[camera]`` and of the truth."""
        return {"lens": self.model, "distortion": list(self.coefficients)}

    def distort(self, xy: ArrayLike) -> Float:
        """Return distorted points.

        Parameters
        ----------
        xy : (..., 2) array_like
            Undistorted points, tangents (X / Z, Y / Z).

        Returns
        -------
        (..., 2) float64
            Distorted points, which the camera matrix turns into pixels; NaN beyond the `limit`.
        """
        points = np.asarray(xy, dtype=np.float64)
        x, y = points[..., 0], points[..., 1]
        q = x * x + y * y
        q = np.where(q < self.limit**2, q, np.nan)
        ratio, _ = self._radial(q)
        distorted = np.empty((*q.shape, 2))
        np.multiply(x, ratio, out=distorted[..., 0])
        np.multiply(y, ratio, out=distorted[..., 1])
        if self._has_tangential_terms:
            shift = tangential(self.coefficients, x, y, q)
            distorted[..., 0] += shift[0]
            distorted[..., 1] += shift[1]
        if not is_tilted(self.model, self.coefficients):
            return distorted
        return _transformed(tilt_homography(self.coefficients), distorted)

    def undistort(self, xy: ArrayLike) -> Float:
        """Return undistorted points: the inverse of `distort`.

        Parameters
        ----------
        xy : (..., 2) array_like
            Distorted points: pixels multiplied by the inverse of the camera matrix.

        Returns
        -------
        (..., 2) float64
            Tangents (X / Z, Y / Z); NaN for points that no direction within the `limit` reaches.

        Notes
        -----
        Newton's method, started from a table of the radial part.  It is more accurate than OpenCV's undistortPoints,
        which stops earlier.
        """
        points = np.asarray(xy, dtype=np.float64)
        if is_tilted(self.model, self.coefficients):
            inverse = np.asarray(np.linalg.inv(tilt_homography(self.coefficients)), dtype=np.float64)
            points = _transformed(inverse, points)
        flat = points.reshape(-1, 2)
        undistorted = np.empty_like(flat)
        for first in range(0, len(flat), _BLOCK):
            undistorted[first : first + _BLOCK] = self._undistorted(flat[first : first + _BLOCK])
        return undistorted.reshape(points.shape)

    def _undistorted(self, distorted: Float) -> Float:
        radius, distorted_radius = _table(self)
        r_distorted = np.hypot(distorted[:, 0], distorted[:, 1])
        # With tangential terms the image extends farther on one side, so the start may lie at the end of the table.
        r = np.interp(r_distorted, distorted_radius, radius)
        scale = np.where(r_distorted > 0, r / np.maximum(r_distorted, 1e-300), 1.0)
        x, y = distorted[:, 0] * scale, distorted[:, 1] * scale
        max_q = (2 * radius[-1]) ** 2
        error = np.full(len(distorted), np.inf)
        with np.errstate(all="ignore"):  # points without a solution diverge and become NaN
            for _ in range(_MAX_STEPS):
                q = np.minimum(x * x + y * y, max_q)
                ratio, slope = self._radial(q)
                error_x, error_y = x * ratio - distorted[:, 0], y * ratio - distorted[:, 1]
                j00, j01, j11 = ratio + 2 * slope * x * x, 2 * slope * x * y, ratio + 2 * slope * y * y
                j10 = j01
                if self._has_tangential_terms:
                    shift = tangential(self.coefficients, x, y, q)
                    error_x, error_y = error_x + shift[0], error_y + shift[1]
                    a00, a01, a10, a11 = tangential_derivatives(self.coefficients, x, y, q)
                    j00, j01, j10, j11 = j00 + a00, j01 + a01, j10 + a10, j11 + a11
                error = np.hypot(error_x, error_y)
                if not (error > _CONVERGED).any():
                    break
                determinant = j00 * j11 - j01 * j10
                x = x - (j11 * error_x - j01 * error_y) / determinant
                y = y - (j00 * error_y - j10 * error_x) / determinant
            valid = (error < _MAX_ERROR) & (x * x + y * y < self.limit**2)
        return np.where(valid[:, np.newaxis], np.column_stack([x, y]), np.nan)

    def _radial(self, q: Float) -> tuple[Float, Float]:
        return LENS_MODELS[self.model].radial(self.coefficients, q)

    @property
    def _has_tangential_terms(self) -> bool:
        return has_tangential_terms(self.model, self.coefficients)

    def rotated_by_quarter(self) -> "Lens":
        """Return the lens of the same camera rotated by 90 deg: new x is old y, and new y is old -x.

        Returns
        -------
        Lens
            OpenCV's model tilts a sensor about x, then about y.  For a sensor that is tilted about both, the rotated
            model also includes a roll of the camera of about tau_x tau_y; a fit of the attitude absorbs it.
        """
        if not self._has_tangential_terms and not is_tilted(self.model, self.coefficients):
            return self
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *_ = padded(self.coefficients)
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        tilted = quarter @ tilt_rotation(self.coefficients) @ quarter.T
        # The roll about the axis that leaves a rotation about x, then about y.
        roll = np.arctan2(tilted[1, 0], tilted[1, 1])
        c, s = np.cos(roll), np.sin(roll)
        rolled = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        tilted = tilted @ rolled.T
        tau_x = np.arctan2(tilted[1, 2], tilted[1, 1])
        tau_y = np.arctan2(tilted[2, 0], tilted[0, 0])
        # Tangential and thin-prism coefficients are vectors in the image plane.
        (p2, p1), (s1, s3), (s2, s4) = (
            (rolled @ quarter)[:2, :2] @ vector for vector in ((p2, p1), (s1, s3), (s2, s4))
        )
        rotated = (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y)
        # A coefficient that was left out need not be zero after the rotation.
        count = next(count for count in _COUNTS_WITH_WHOLE_PAIRS if count >= len(self.coefficients))
        return Lens(self.model, tuple(float(number) for number in rotated[:count]))

    def __str__(self) -> str:
        names = LENS_MODELS[self.model].coefficients
        terms = [f"{name}={number:g}" for name, number in zip(names, self.coefficients, strict=False) if number]
        return " ".join([self.model, *terms])


def _transformed(homography: Float, xy: Float) -> Float:
    """Return points transformed by a homography."""
    mapped = xy @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


@lru_cache(maxsize=64)
def _limit(lens: Lens) -> float:
    return LENS_MODELS[lens.model].limit(lens.coefficients)


@lru_cache(maxsize=64)
def _table(lens: Lens) -> tuple[Float, Float]:
    """Return undistorted radii and their distorted radii, both increasing."""
    max_angle_rad = min(np.arctan(lens.limit), _MAX_FIELD_RAD)
    # Dense towards the limit, where the inverse is steepest.
    radius = np.tan(max_angle_rad * np.sin(np.linspace(0, np.pi / 2, _TABLE_SIZE)))
    distorted = radius * LENS_MODELS[lens.model].radial(lens.coefficients, radius * radius)[0]
    return radius, np.maximum.accumulate(distorted)
