"""Lens distortion: from the undistorted image plane to the distorted one and back.

A point of the undistorted plane is (x, y) = (X / Z, Y / Z) of a direction in the camera frame; the camera matrix turns
the distorted point (x', y') into pixels.  `glstar.camera.lensmodels` has the formulas.

The polynomials of the models are not monotonic everywhere: beyond some radius, stars outside the field would come back
into the image.  A lens ends at that radius (`Lens.limit`), and directions beyond it have no pixel position.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.lensmodels import (
    LENS_MODELS,
    LensModel,
    has_tangential_terms,
    is_tilted,
    padded,
    tangential,
    tangential_derivatives,
    tilt_homography,
    tilt_rotation,
)
from glstar.errors import CalibrationError

__all__ = ["COEFFICIENTS", "Lens", "LensModel"]

Float = NDArray[np.float64]

# The coefficients of each model, in OpenCV's order.
COEFFICIENTS: Final = {name: model.coefficients for name, model in LENS_MODELS.items()}
# Numbers of coefficients that do not split a pair such as p1, p2.
_COUNTS_WITH_WHOLE_PAIRS: Final = (2, 4, 5, 6, 7, 8, 12, 14)
# Largest field angle: the tangent of 90 deg is infinite.
_MAX_FIELD_RAD: Final = np.deg2rad(89.5)
# Entries of the table of radii from which Newton's method starts.
_TABLE_SIZE: Final = 1024
_MAX_STEPS: Final = 12
# Newton's method stops at this error, in tangents: a hundred millionth of a pixel at f = 10 000 px.
_CONVERGED: Final = 1e-12
# Larger errors after the last step mean that the point has no undistorted position.
_MAX_ERROR: Final = 1e-10
# Points that are undistorted together; limits memory.
_BLOCK: Final = 1 << 18


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
        found = np.empty_like(flat)
        for first in range(0, len(flat), _BLOCK):
            found[first : first + _BLOCK] = self._undistorted(flat[first : first + _BLOCK])
        return found.reshape(points.shape)

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
        tau_x, tau_y = np.arctan2(tilted[1, 2], tilted[1, 1]), np.arctan2(tilted[2, 0], tilted[0, 0])
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
