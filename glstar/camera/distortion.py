"""Lenses that are no pinholes: OpenCV's distortion models, there and back.

A point of the pinhole's plane, (x, y) = (X / Z, Y / Z), goes to where the lens puts it, (x', y'); the camera matrix
turns that into pixels.  Three models, with OpenCV's names and order of coefficients:

==============  ===================================================================  ============================
model           where a point r from the axis goes, q = r^2, theta = arctan(r)       coefficients
==============  ===================================================================  ============================
``plumb_bob``   r (1 + k1 q + k2 q^2 + k3 q^3), and decentring p1, p2                k1, k2, p1, p2, k3
``rational``    r (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3),       k1, k2, p1, p2, k3, k4, k5, k6,
                decentring, thin prism s1 .. s4, tilted sensor                       s1, s2, s3, s4, tau_x, tau_y
``fisheye``     theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)        k1, k2, k3, k4
==============  ===================================================================  ============================

Polynomials turn back: beyond some radius stars would come in again.  There the lens ends (`Lens.limit`), and what lies
beyond has no place on the image.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import isfinite
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.errors import CalibrationError

__all__ = ["COEFFICIENTS", "Lens", "LensModel"]

Float = NDArray[np.float64]
LensModel = Literal["plumb_bob", "rational", "fisheye"]

COEFFICIENTS: Final = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
# So many coefficients name no arrow in part.
_WHOLE_ARROWS: Final = (2, 4, 5, 6, 7, 8, 12)
# A lens is followed to here and no farther: a plane has no room for what lies beside the camera.
_WIDEST_RAD: Final = np.deg2rad(89.5)
# Where Newton's method starts from, and when it has arrived: a millionth of a pixel at f = 10,000 px.
_TABLE: Final = 1024
_STEPS: Final = 12
_ARRIVED: Final = 1e-12
_CLOSE: Final = 1e-10
# How much is straightened at once.
_BLOCK: Final = 1 << 18


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens that bends straight lines.

    Attributes
    ----------
    model : {"plumb_bob", "rational", "fisheye"}
        OpenCV's models; ROS calls them plumb_bob, rational_polynomial and equidistant.
    coefficients : tuple of float
        In OpenCV's order; those that are left out are zero.

    Raises
    ------
    CalibrationError
        If there is no such model, there are too many coefficients, or one is no finite number.
    """

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in get_args(LensModel):
            raise CalibrationError(f"there is no lens model {self.model!r}; there are {', '.join(COEFFICIENTS)}")
        names = COEFFICIENTS[self.model]
        if len(self.coefficients) > len(names):
            raise CalibrationError(
                f"{len(self.coefficients)} distortion coefficients are too many for {self.model}: {', '.join(names)}"
            )
        for name, number in zip(names, self.coefficients, strict=False):
            if not isfinite(number):
                raise CalibrationError(f"the lens has {name} = {number}; it must be a finite number")

    @property
    def limit(self) -> float:
        """How far from the axis a point of the pinhole's plane may be: the tangent of the widest angle, or inf."""
        return _limit(self)

    @property
    def keys(self) -> dict[str, str | list[float]]:
        """What ``[camera]`` of a config says of it, ``lens`` and ``distortion``; truth says the same."""
        return {"lens": self.model, "distortion": list(self.coefficients)}

    def distort(self, xy: ArrayLike) -> Float:
        """Return where points of the pinhole's plane go.

        Parameters
        ----------
        xy : (..., 2) array_like
            Tangents (X / Z, Y / Z).

        Returns
        -------
        (..., 2) float64
            What the camera matrix turns into pixels; NaN beyond the `limit`.
        """
        points = np.asarray(xy, dtype=np.float64)
        x, y = points[..., 0], points[..., 1]
        q = x * x + y * y
        q = np.where(q < self.limit**2, q, np.nan)
        along, _ = _radial(self, q)
        bent = np.empty((*q.shape, 2))
        np.multiply(x, along, out=bent[..., 0])
        np.multiply(y, along, out=bent[..., 1])
        if _is_off_centre(self):
            aside = _aside(self, x, y, q)
            bent[..., 0] += aside[0]
            bent[..., 1] += aside[1]
        return _through(_tilt(self), bent) if _is_tilted(self) else bent

    def undistort(self, xy: ArrayLike) -> Float:
        """Return which points of the pinhole's plane go to given ones: the inverse of `distort`.

        Parameters
        ----------
        xy : (..., 2) array_like
            Pixels through the inverse of the camera matrix.

        Returns
        -------
        (..., 2) float64
            Tangents (X / Z, Y / Z); NaN where no light arrives from within the `limit`.

        Notes
        -----
        Newton's method from a table of the radial part; OpenCV's undistortPoints stops earlier.
        """
        points = np.asarray(xy, dtype=np.float64)
        if _is_tilted(self):
            points = _through(np.asarray(np.linalg.inv(_tilt(self)), dtype=np.float64), points)
        flat = points.reshape(-1, 2)
        found = np.empty_like(flat)
        for first in range(0, len(flat), _BLOCK):
            found[first : first + _BLOCK] = self._undistorted(flat[first : first + _BLOCK])
        return found.reshape(points.shape)

    def _undistorted(self, wanted: Float) -> Float:
        radius, bent_radius = _table(self)
        r_bent = np.hypot(wanted[:, 0], wanted[:, 1])
        # A decentred lens reaches a little farther on one side: the start may lie at the edge, the end decides.
        r = np.interp(r_bent, bent_radius, radius)
        scale = np.where(r_bent > 0, r / np.maximum(r_bent, 1e-300), 1.0)
        x, y = wanted[:, 0] * scale, wanted[:, 1] * scale
        widest2 = (2 * radius[-1]) ** 2
        miss = np.full(len(wanted), np.inf)
        with np.errstate(all="ignore"):  # what cannot be reached runs away, and is NaN in the end
            for _ in range(_STEPS):
                q = np.minimum(x * x + y * y, widest2)
                along, slope = _radial(self, q)
                off_x, off_y = x * along - wanted[:, 0], y * along - wanted[:, 1]
                j00, j01, j11 = along + 2 * slope * x * x, 2 * slope * x * y, along + 2 * slope * y * y
                j10 = j01
                if _is_off_centre(self):
                    aside = _aside(self, x, y, q)
                    off_x, off_y = off_x + aside[0], off_y + aside[1]
                    a00, a01, a10, a11 = _aside_slopes(self, x, y, q)
                    j00, j01, j10, j11 = j00 + a00, j01 + a01, j10 + a10, j11 + a11
                miss = np.hypot(off_x, off_y)
                if not (miss > _ARRIVED).any():
                    break
                determinant = j00 * j11 - j01 * j10
                x = x - (j11 * off_x - j01 * off_y) / determinant
                y = y - (j00 * off_y - j10 * off_x) / determinant
            sound = (miss < _CLOSE) & (x * x + y * y < self.limit**2)
        return np.where(sound[:, np.newaxis], np.column_stack([x, y]), np.nan)

    def turned(self) -> "Lens":
        """Return the lens of a camera that is held a quarter turn otherwise: what was x is y, what was y is -x.

        Returns
        -------
        Lens
            OpenCV's model tilts a sensor about x and then about y: of one that is tilted about both it is the lens of
            a camera that is also rolled about its axis, by about tau_x tau_y, which the attitude takes up.
        """
        if not _is_off_centre(self) and not _is_tilted(self):
            return self
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *_ = _all(self)
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        tilted = quarter @ _tilt_rotation(self) @ quarter.T
        # The roll before the lens that leaves a turn about x, then about y.
        roll = np.arctan2(tilted[1, 0], tilted[1, 1])
        c, s = np.cos(roll), np.sin(roll)
        rolled = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        tilted = tilted @ rolled.T
        tau_x, tau_y = np.arctan2(tilted[1, 2], tilted[1, 1]), np.arctan2(tilted[2, 0], tilted[0, 0])
        # Decentring and thin prism are arrows.
        (p2, p1), (s1, s3), (s2, s4) = ((rolled @ quarter)[:2, :2] @ arrow for arrow in ((p2, p1), (s1, s3), (s2, s4)))
        turned = (k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y)
        # Where one of an arrow's two numbers was left out, it need not be zero any more.
        count = next(count for count in (*_WHOLE_ARROWS, 14) if count >= len(self.coefficients))
        return Lens(self.model, tuple(float(number) for number in turned[:count]))

    def __str__(self) -> str:
        names = COEFFICIENTS[self.model]
        terms = [f"{name}={number:g}" for name, number in zip(names, self.coefficients, strict=False) if number]
        return " ".join([self.model, *terms])


def _all(lens: Lens) -> tuple[float, ...]:
    """Return all coefficients of OpenCV's order, (14,) or (4,), zeros filled in."""
    count = 4 if lens.model == "fisheye" else 14
    return lens.coefficients + (0.0,) * (count - len(lens.coefficients))


def _radial(lens: Lens, q: Float) -> tuple[Float, Float]:
    """Return by how much points at r^2 = q are moved outwards, r' / r, and its derivative by q."""
    if lens.model == "fisheye":
        return _fisheye(lens, q)
    k1, k2, _, _, k3, k4, k5, k6, *_ = _all(lens)
    above = 1 + q * (k1 + q * (k2 + q * k3))
    above_slope = k1 + q * (2 * k2 + q * 3 * k3)
    if not (k4 or k5 or k6):
        return above, above_slope
    below = 1 + q * (k4 + q * (k5 + q * k6))
    below = np.where(below == 0, np.nan, below)  # the pole itself
    below_slope = k4 + q * (2 * k5 + q * 3 * k6)
    along = above / below
    return along, (above_slope - along * below_slope) / below


def _fisheye(lens: Lens, q: Float) -> tuple[Float, Float]:
    k1, k2, k3, k4 = _all(lens)
    r = np.sqrt(q)
    theta = np.arctan(r)
    t2 = theta * theta
    bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    bent_slope = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + q)
    # On the axis the quotients have limits.
    on_axis = r < 1e-5
    safe_r = np.where(on_axis, 1.0, r)
    along = np.where(on_axis, 1.0 + (k1 - 1 / 3) * q, bent / safe_r)
    slope = np.where(on_axis, k1 - 1 / 3, (bent_slope - along) / (2 * safe_r * safe_r))
    return along, slope


def _is_off_centre(lens: Lens) -> bool:
    """Return whether points are moved other than straight outwards."""
    return lens.model != "fisheye" and any((*lens.coefficients[2:4], *lens.coefficients[8:12]))


def _aside(lens: Lens, x: Float, y: Float, q: Float) -> tuple[Float, Float]:
    """Return what decentring and thin prism add."""
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = _all(lens)
    xy2 = 2 * x * y
    return (
        p1 * xy2 + p2 * (q + 2 * x * x) + q * (s1 + q * s2),
        p1 * (q + 2 * y * y) + p2 * xy2 + q * (s3 + q * s4),
    )


def _aside_slopes(lens: Lens, x: Float, y: Float, q: Float) -> tuple[Float, Float, Float, Float]:
    """Return the derivatives of `_aside`: of x by x and by y, of y by x and by y."""
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = _all(lens)
    prism_x, prism_y = 2 * (s1 + 2 * s2 * q), 2 * (s3 + 2 * s4 * q)
    return (
        2 * p1 * y + 6 * p2 * x + prism_x * x,
        2 * p1 * x + 2 * p2 * y + prism_x * y,
        2 * p1 * x + 2 * p2 * y + prism_y * x,
        6 * p1 * y + 2 * p2 * x + prism_y * y,
    )


def _is_tilted(lens: Lens) -> bool:
    return lens.model == "rational" and any(lens.coefficients[12:])


def _tilt_rotation(lens: Lens) -> Float:
    """Return how a sensor is turned, (3, 3): about x, then about y."""
    tau_x, tau_y = _all(lens)[12:]
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    return np.asarray(
        np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    )


def _tilt(lens: Lens) -> Float:
    """Return the homography of a tilted sensor, (3, 3), as OpenCV's computeTiltProjectionMatrix has it."""
    turned = _tilt_rotation(lens)
    onto_z = np.array([[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1]])
    return np.asarray(onto_z @ turned)


def _through(H: Float, xy: Float) -> Float:
    """Return points through a homography."""
    mapped = xy @ H[:, :2].T + H[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


@lru_cache(maxsize=64)
def _limit(lens: Lens) -> float:
    """Return the tangent at which the radial part turns back or has a pole; inf if it never does."""
    k = _all(lens)
    if lens.model == "fisheye":
        turns = _smallest_root([1, 3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3]])
        theta = np.sqrt(turns)
        return float(np.tan(theta)) if theta < np.pi / 2 else float("inf")
    above, below = np.array([1, k[0], k[1], k[4]]), np.array([1, *k[5:8]])
    polynomial = np.polynomial.polynomial
    # d(r N/D)/dr = (N D + 2 q (N' D - N D')) / D^2, in powers of q.
    crossed = polynomial.polysub(
        polynomial.polymul(polynomial.polyder(above), below), polynomial.polymul(above, polynomial.polyder(below))
    )
    turned = polynomial.polyadd(polynomial.polymul(above, below), polynomial.polymulx(2 * crossed))
    return float(np.sqrt(min(_smallest_root(turned), _smallest_root(below))))


def _smallest_root(ascending: ArrayLike) -> float:
    """Return the smallest positive real root of a polynomial that is 1 at 0; inf if there is none."""
    # In powers of 1 / q the leading coefficient is that 1, however small the others are.
    roots = np.polynomial.polynomial.polyroots(np.asarray(ascending, dtype=np.float64)[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-9)]
    return 1 / float(real.max()) if real.size else float("inf")


@lru_cache(maxsize=64)
def _table(lens: Lens) -> tuple[Float, Float]:
    """Return radii in the pinhole's plane and where they go, both rising."""
    widest = min(np.arctan(lens.limit), _WIDEST_RAD)
    # Densest where a turning lens is steepest: at the end.
    radius = np.tan(widest * np.sin(np.linspace(0, np.pi / 2, _TABLE)))
    bent = radius * _radial(lens, radius * radius)[0]
    return radius, np.maximum.accumulate(bent)
