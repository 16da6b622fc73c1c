"""Lenses: from a direction in the camera frame to a point of the image plane, which the camera matrix maps to pixels.

A lens acts in two steps.  Its first step maps the angle theta from the optical axis to a distance r from the axis:

=================  ================================================================================  ==================
model              r                                                                                 coefficients
=================  ================================================================================  ==================
``plumb_bob``      tan(theta)                                                                        none
``rational``       tan(theta)                                                                        none
``fisheye``        theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)                     k1, k2, k3, k4
``double_sphere``  s / (a sqrt(s^2 + (xi + c)^2) + (1 - a) (xi + c)) with a = alpha                  xi, alpha
``eucm``           s / (a sqrt(beta s^2 + c^2) + (1 - a) c) with a = alpha                           alpha, beta
``omni``           s / (xi + c)                                                                      xi
=================  ================================================================================  ==================

where s and c are sine and cosine of theta.  The second step moves the point (x, y) found, with q = x^2 + y^2:

=================  ================================================================================  ==================
model              (x', y')                                                                          coefficients
=================  ================================================================================  ==================
``plumb_bob``      (x, y) (1 + k1 q + k2 q^2 + k3 q^3), and tangential distortion p1, p2             k1, k2, p1, p2, k3
``rational``       (x, y) (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3), tangential    k1 to p2, k3 to k6,
                   distortion, thin prism s1 .. s4, and a tilted sensor                              s1 .. s4, tau_x, ..
``omni``           as ``plumb_bob`` without k3                                                       k1, k2, p1, p2
others             (x, y)                                                                            none
=================  ================================================================================  ==================

OpenCV has the first three models and ``omni`` (its omnidir); Kalibr has all but ``rational``.  ``fisheye`` is that of
Kannala & Brandt, IEEE PAMI 28 (2006) 1335; ``omni`` that of Mei & Rives, ICRA 2007; ``eucm`` that of Khomutenko et al.,
IEEE RA-L 1 (2016) 137; ``double_sphere`` that of Usenko et al., 3DV 2018.

The formulas are not monotonic everywhere: beyond some angle, stars outside the field would come back into the image.
A lens ends at that angle (`Lens.limit_rad`), and directions beyond it have no position.  To add a model, write its
functions and add a line to `LENS_MODELS`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import isfinite
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float, joined
from glstar.errors import CalibrationError

Coefficients = tuple[float, ...]
LensModel = Literal["plumb_bob", "rational", "fisheye", "double_sphere", "eucm", "omni"]


@dataclass(frozen=True, slots=True)
class LensFormulas:
    """A lens model.

    Attributes
    ----------
    coefficients : tuple of str
        Their names, in the order of OpenCV or Kalibr.
    radius : callable or None
        The first step: (coefficients, theta) to r and its derivative with respect to theta, for theta of shape (n,),
        rad; None for tan(theta).
    limit_rad : callable
        Coefficients to the theta at which r is largest or infinite, rad; at most pi.
    brown : slice or None
        The second step: which coefficients are k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y, in this
        order; None if there is none.
    bounds : dict of str to tuple of float
        Coefficients that must not be left out, each with its least and largest value, and both in words.
    """

    coefficients: tuple[str, ...]
    radius: Callable[[Coefficients, Float], tuple[Float, Float]] | None = None
    limit_rad: Callable[[Coefficients], float] = lambda _: np.pi / 2
    brown: slice | None = None
    bounds: dict[str, tuple[float, float, str]] = field(default_factory=dict)


def padded(coefficients: Coefficients, count: int = 14) -> Coefficients:
    """Return coefficients in OpenCV's order with zeros for those that are left out."""
    return coefficients + (0.0,) * (count - len(coefficients))


def _fisheye_radius(coefficients: Coefficients, theta: Float) -> tuple[Float, Float]:
    k1, k2, k3, k4 = padded(coefficients, 4)
    t2 = theta * theta
    return (
        theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))),
        1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4))),
    )


def _fisheye_limit_rad(coefficients: Coefficients) -> float:
    k1, k2, k3, k4 = padded(coefficients, 4)
    return float(min(np.sqrt(_smallest_root(np.array([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))), np.pi))


def _double_sphere_radius(coefficients: Coefficients, theta: Float) -> tuple[Float, Float]:
    xi, alpha = coefficients
    s, c = np.sin(theta), np.cos(theta)
    distance = np.hypot(s, xi + c)  # from the second centre
    return _quotient(s, c, alpha * distance + (1 - alpha) * (xi + c), -alpha * xi * s / distance - (1 - alpha) * s)


def _double_sphere_limit_rad(coefficients: Coefficients) -> float:
    # Departs from Usenko et al., eq. (43), whose half space is narrower than that of points with one position.
    xi, alpha = coefficients
    if xi > 1:
        return float(np.arccos(-1 / xi))
    w = min(alpha, 1 - alpha) / max(alpha, 1 - alpha)
    return float(np.arccos(-(xi * (1 - w * w) + w * np.sqrt(1 - xi * xi * (1 - w * w)))))


def _eucm_radius(coefficients: Coefficients, theta: Float) -> tuple[Float, Float]:
    alpha, beta = coefficients
    s, c = np.sin(theta), np.cos(theta)
    distance = np.sqrt(beta * s * s + c * c)
    return _quotient(s, c, alpha * distance + (1 - alpha) * c, alpha * (beta - 1) * s * c / distance - (1 - alpha) * s)


def _eucm_limit_rad(coefficients: Coefficients) -> float:
    alpha, beta = coefficients
    w = min(alpha, 1 - alpha) / max(alpha, 1 - alpha)
    return float(np.pi - np.arctan2(np.sqrt(1 - w * w), w * np.sqrt(beta)))


def _omni_radius(coefficients: Coefficients, theta: Float) -> tuple[Float, Float]:
    s, c = np.sin(theta), np.cos(theta)
    return _quotient(s, c, coefficients[0] + c, -s)


def _omni_limit_rad(coefficients: Coefficients) -> float:
    xi = coefficients[0]
    return float(np.arccos(-xi if xi <= 1 else -1 / xi))


def _quotient(s: Float, c: Float, depth: Float, slope: Float) -> tuple[Float, Float]:
    """Return s / depth and its derivative with respect to theta; `slope` is that of `depth`."""
    with np.errstate(all="ignore"):  # beyond the limit
        r = s / depth
        return r, (c - r * slope) / depth


def _smallest_root(ascending: Float) -> float:
    """Return the smallest positive real root of a polynomial that is 1 at 0; inf if there is none."""
    if not np.any(ascending[1:]):
        return float("inf")
    # In powers of 1 / q the leading coefficient is that 1, however small the others are.
    roots = np.roots(ascending)
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-9)]
    return 1 / float(real.max()) if real.size else float("inf")


_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")

_FROM_0_TO_1 = (0.0, 1.0, "from 0 to 1")
_POSITIVE = (float(np.nextafter(0.0, 1.0)), np.inf, "positive")
_ABOVE_MINUS_1 = (float(np.nextafter(-1.0, 0.0)), np.inf, "above -1")

LENS_MODELS: dict[str, LensFormulas] = {
    "plumb_bob": LensFormulas(_BROWN[:5], brown=slice(None)),
    "rational": LensFormulas(_BROWN, brown=slice(None)),
    "fisheye": LensFormulas(("k1", "k2", "k3", "k4"), _fisheye_radius, _fisheye_limit_rad),
    "double_sphere": LensFormulas(
        ("xi", "alpha"),
        _double_sphere_radius,
        _double_sphere_limit_rad,
        bounds={"xi": _ABOVE_MINUS_1, "alpha": _FROM_0_TO_1},
    ),
    "eucm": LensFormulas(
        ("alpha", "beta"), _eucm_radius, _eucm_limit_rad, bounds={"alpha": _FROM_0_TO_1, "beta": _POSITIVE}
    ),
    "omni": LensFormulas(
        ("xi", *_BROWN[:4]), _omni_radius, _omni_limit_rad, brown=slice(1, None), bounds={"xi": _ABOVE_MINUS_1}
    ),
}


def _brown_factor(coefficients: Coefficients, q: Float) -> tuple[Float, Float]:
    """Return the radial factor of the second step and its derivative with respect to q."""
    k1, k2, _, _, k3, k4, k5, k6, *_ = coefficients
    numerator = 1 + q * (k1 + q * (k2 + q * k3))
    numerator_slope = k1 + q * (2 * k2 + q * 3 * k3)
    if not (k4 or k5 or k6):
        return numerator, numerator_slope
    denominator = 1 + q * (k4 + q * (k5 + q * k6))
    denominator = np.where(denominator == 0, np.nan, denominator)  # a pole
    denominator_slope = k4 + q * (2 * k5 + q * 3 * k6)
    factor = numerator / denominator
    return factor, (numerator_slope - factor * denominator_slope) / denominator


def _brown_point(coefficients: Coefficients, x: Float, y: Float) -> tuple[Float, Float]:
    """Return points moved by the second step, without the tilt of the sensor."""
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = coefficients
    q = x * x + y * y
    factor, _ = _brown_factor(coefficients, q)
    moved_x, moved_y = x * factor, y * factor
    if any((p1, p2, s1, s2, s3, s4)):
        xy2 = 2 * x * y
        moved_x = moved_x + (p1 * xy2 + p2 * (q + 2 * x * x) + q * (s1 + q * s2))
        moved_y = moved_y + (p1 * (q + 2 * y * y) + p2 * xy2 + q * (s3 + q * s4))
    return moved_x, moved_y


def _brown_jacobian(coefficients: Coefficients, x: Float, y: Float) -> tuple[Float, Float, Float, Float]:
    """Return the derivatives of `_brown_point`: dx'/dx, dx'/dy, dy'/dx, dy'/dy."""
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = coefficients
    q = x * x + y * y
    factor, slope = _brown_factor(coefficients, q)
    prism_x = 2 * (s1 + 2 * s2 * q)
    prism_y = 2 * (s3 + 2 * s4 * q)
    across = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
    return (
        factor + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x + prism_x * x,
        across + prism_x * y,
        across + prism_y * x,
        factor + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x + prism_y * y,
    )


@lru_cache(maxsize=64)
def _brown_limit(coefficients: Coefficients) -> float:
    """Return the distance from the axis at which the second step turns or has a pole; inf if there is none."""
    k = coefficients
    numerator = np.array([1, k[0], k[1], k[4]])
    denominator = np.array([1, *k[5:8]])
    # d(r N/D)/dr = (N D + 2 q (N' D - N D')) / D^2, in powers of q.
    power = np.arange(4)
    derivative = np.convolve((1 + 2 * power) * numerator, denominator) - np.convolve(numerator, 2 * power * denominator)
    limit = float(np.sqrt(min(_smallest_root(derivative), _smallest_root(denominator))))
    return _unfolded(coefficients, limit) if any((*k[2:4], *k[8:12])) else limit


def _unfolded(coefficients: Coefficients, limit: float) -> float:
    """Return the distance from the axis, at most `limit`, up to which tangential terms fold no direction back."""
    radii = np.tan(np.linspace(0.0, min(np.arctan(limit), _MAX_FIELD_RAD), _TABLE_SIZE))
    for _ in range(3):
        first = _first_fold(coefficients, radii)
        if first is None:
            return limit
        radii = np.linspace(radii[max(first - 1, 0)], radii[first], _TABLE_SIZE)
    return float(radii[0])


def _first_fold(coefficients: Coefficients, radii: Float) -> int | None:
    """Return the index of the first of increasing radii, (n,), on whose circle a direction is folded; None if none is.

    Where the radial terms stretch by more than the others can bend, nothing folds: only the other circles are sampled,
    and those next to a pole, where rounding decides.
    """
    _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, _, _ = coefficients
    q = radii * radii
    factor, slope = _brown_factor(coefficients, q)
    stretched = np.minimum(factor, factor + 2 * slope * q)
    # The tangential terms are 2 (v r^T + r v^T + (v . r) 1) with v = (p2, p1), those of the prism an outer product.
    bent = radii * (6 * np.hypot(p1, p2) + 2 * np.hypot(s1 + 2 * s2 * q, s3 + 2 * s4 * q))
    doubtful = np.flatnonzero(~((stretched > 1.001 * bent) & (stretched < _NEXT_TO_A_POLE)))
    azimuth_rad = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    cosine, sine = np.cos(azimuth_rad), np.sin(azimuth_rad)
    for start in range(0, len(doubtful), _CIRCLES):
        circles = doubtful[start : start + _CIRCLES]
        xx, xy, yx, yy = _brown_jacobian(coefficients, np.outer(radii[circles], cosine), np.outer(radii[circles], sine))
        folded = (xx * yy - xy * yx <= 0).any(axis=1)
        if folded.any():
            return int(circles[folded.argmax()])
    return None


def _tilt_rotation(coefficients: Coefficients) -> Float:
    """Return the rotation of a tilted sensor, (3, 3): about x, then about y."""
    tau_x, tau_y = coefficients[12:]
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    return np.asarray(
        np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    )


def tilt_homography(coefficients: Coefficients) -> Float:
    """Return the homography of a tilted sensor, (3, 3), as OpenCV's computeTiltProjectionMatrix does.

    `coefficients`: the 14 of `Lens.brown`.
    """
    rotation = _tilt_rotation(coefficients)
    onto_z = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1]])
    return np.asarray(onto_z @ rotation)


# The coefficients of each model, in the order of OpenCV or Kalibr.
COEFFICIENTS = {name: model.coefficients for name, model in LENS_MODELS.items()}
# Numbers of coefficients of the second step that do not split a pair such as p1, p2.
_COUNTS_WITH_WHOLE_PAIRS = (4, 5, 6, 7, 8, 12, 14)
# Margin of the limit, as a difference of cosines: directions along the limit have no position.
_LIMIT_MARGIN = 1e-9
# Largest angle of the tables of tan(theta): the tangent of 90 deg is infinite.
_MAX_FIELD_RAD = np.deg2rad(89.5)
# Entries of the tables from which Newton's method starts.
_TABLE_SIZE = 1024
# Circles around the axis that are searched for folds at a time, and a stretch of directions that only a pole has.
_CIRCLES = 64
_NEXT_TO_A_POLE = 1e4
_MAX_STEPS = 12
# Newton's method stops at this error, in focal lengths: a hundred millionth of a pixel at f = 10 000 px.
_CONVERGED = 1e-12
# Larger errors after the last step mean that the point has no direction.
_MAX_ERROR = 1e-10
# Points whose directions are found together; limits memory.
_BLOCK = 1 << 18


@dataclass(frozen=True, slots=True)
class Lens:
    """A lens that is not a pinhole.

    Attributes
    ----------
    model : {"plumb_bob", "rational", "fisheye", "double_sphere", "eucm", "omni"}
        The first three are OpenCV's models; ROS calls them plumb_bob, rational_polynomial and equidistant.  The others
        are Kalibr's ds, eucm and omni with radtan.
    coefficients : tuple of float
        In the order of OpenCV or Kalibr; those that are left out are zero.  xi, alpha and beta cannot be left out.
    max_angle_rad : float
        Largest angle from the optical axis that reaches the sensor, rad: where the image circle ends.

    Raises
    ------
    CalibrationError
        If the model is unknown, there are too many coefficients or too few, or one is not a finite number, or has no
        meaning in its model.
    """

    model: LensModel
    coefficients: tuple[float, ...]
    max_angle_rad: float = np.pi

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise CalibrationError(f"there is no lens model {self.model!r}; there are {', '.join(LENS_MODELS)}")
        formulas = LENS_MODELS[self.model]
        names = formulas.coefficients
        if len(self.coefficients) > len(names):
            raise CalibrationError(
                f"{len(self.coefficients)} distortion coefficients are too many for {self.model}: {', '.join(names)}"
            )
        if len(self.coefficients) < len(formulas.bounds):
            raise CalibrationError(
                f"{len(self.coefficients)} coefficients are too few for {self.model}: {', '.join(formulas.bounds)}"
            )
        for name, number in zip(names, self.coefficients, strict=False):
            if not isfinite(number):
                raise CalibrationError(f"the lens has {name} = {number}; it must be a finite number")
            least, most, words = formulas.bounds.get(name, (-np.inf, np.inf, ""))
            if not least <= number <= most:
                raise CalibrationError(f"the lens has {name} = {number:g}; {name} of {self.model} is {words}")
        if not 0 < self.max_angle_rad <= np.pi:
            raise CalibrationError(
                f"the image circle ends {np.rad2deg(self.max_angle_rad):g} deg off the axis; it is up to 180 deg"
            )

    @property
    def limit_rad(self) -> float:
        """The largest angle between the optical axis and a direction that has a position, rad; at most pi."""
        return _limit_rad(self)

    @property
    def brown(self) -> Coefficients:
        """The 14 coefficients of the second step in OpenCV's order; all zero if there is none."""
        part = LENS_MODELS[self.model].brown
        return padded(() if part is None else self.coefficients[part])

    @property
    def keys(self) -> dict[str, str | list[float] | float]:
        """The keys ``lens``, ``distortion`` and ``max_angle_deg`` of ``[camera]`` and of the truth."""
        circle = {"max_angle_deg": round(float(np.rad2deg(self.max_angle_rad)), 9)}
        return {
            "lens": self.model,
            "distortion": list(self.coefficients),
            **(circle if self.max_angle_rad < np.pi else {}),
        }

    def radius(self, angle_rad: ArrayLike) -> Float:
        """Return the distances from the axis, in focal lengths, without tangential distortion and tilt.

        Parameters
        ----------
        angle_rad : (...) array_like
            Angles from the optical axis, rad.

        Returns
        -------
        (...) float64
            NaN from the `limit_rad` on.
        """
        angle = np.asarray(angle_rad, dtype=np.float64)
        within = np.where(angle < self.limit_rad, angle, np.nan)
        r = np.tan(within) if LENS_MODELS[self.model].radius is None else _first_step(self, within)[0]
        return np.asarray(r * _brown_factor(self.brown, r * r)[0])

    def project(self, direction: ArrayLike) -> Float:
        """Return the points of directions, which the camera matrix turns into pixels.

        Parameters
        ----------
        direction : (..., 3) array_like
            Vectors in the camera frame (right, down, along the optical axis), of any length.

        Returns
        -------
        (..., 2) float64
            NaN for directions beyond the `limit_rad`.
        """
        return self._projected(np.asarray(direction, dtype=np.float64), None)[0]

    def project_with_rates(self, direction: ArrayLike, rate: ArrayLike) -> tuple[Float, Float]:
        """Return the points of directions and their derivatives.

        Parameters
        ----------
        direction : (..., 3) array_like
            As for `project`.
        rate : (..., 3) array_like
            Derivatives of the vectors with respect to a parameter, such as time.

        Returns
        -------
        points, rates : (..., 2) float64
            NaN for directions beyond the `limit_rad`.
        """
        point, point_rate = self._projected(np.asarray(direction, np.float64), np.asarray(rate, np.float64))
        assert point_rate is not None
        return np.broadcast_to(point, point_rate.shape), point_rate

    def unproject(self, xy: ArrayLike) -> Float:
        """Return the directions of points: the inverse of `project`.

        Parameters
        ----------
        xy : (..., 2) array_like
            Pixels multiplied by the inverse of the camera matrix.

        Returns
        -------
        (..., 3) float64
            Unit vectors in the camera frame; NaN for points that no direction within the `limit_rad` reaches.

        Notes
        -----
        Newton's method, started from tables.  It is more accurate than OpenCV's undistortPoints, which stops earlier.
        """
        points = np.asarray(xy, dtype=np.float64)
        brown = self.brown
        if any(brown[12:]):
            points = _transformed(np.asarray(np.linalg.inv(tilt_homography(brown))), points)
        flat = points.reshape(-1, 2)
        direction = np.empty((len(flat), 3))
        for first in range(0, len(flat), _BLOCK):
            block = flat[first : first + _BLOCK]
            direction[first : first + _BLOCK] = self._direction(_brown_inverse(brown, block) if any(brown) else block)
        return direction.reshape(*points.shape[:-1], 3)

    def _projected(self, direction: Float, rate: Float | None) -> tuple[Float, Float | None]:
        x, y, z = (direction[..., k] for k in range(3))
        rho2 = x * x + y * y
        within = z > (np.cos(self.limit_rad) + _LIMIT_MARGIN) * np.sqrt(rho2 + z * z)
        z = np.where(within, z, np.nan)
        change = None if rate is None else tuple(rate[..., k] for k in range(3))
        if LENS_MODELS[self.model].radius is None:
            x, y = x / z, y / z
            if change is not None:
                change = (change[0] - x * change[2]) / z, (change[1] - y * change[2]) / z
        else:
            x, y, change = self._by_angle(x, y, z, np.sqrt(rho2), change)
        brown = self.brown
        if any(brown[:12]):
            if change is not None:
                xx, xy, yx, yy = _brown_jacobian(brown, x, y)
                change = xx * change[0] + xy * change[1], yx * change[0] + yy * change[1]
            x, y = _brown_point(brown, x, y)
        point = joined(x, y)
        point_rate = None if change is None else joined(change[0], change[1])
        if not any(brown[12:]):
            return point, point_rate
        homography = tilt_homography(brown)
        tilted = _transformed(homography, point)
        if point_rate is not None:
            moved = point_rate @ homography[:, :2].T
            depth = point @ homography[2, :2] + homography[2, 2]
            point_rate = (moved[..., :2] - tilted * moved[..., 2:]) / depth[..., np.newaxis]
        return tilted, point_rate

    def _by_angle(
        self, x: Float, y: Float, z: Float, rho: Float, change: tuple[Float, ...] | None
    ) -> tuple[Float, Float, tuple[Float, ...] | None]:
        """Return the first step of vectors by their angle from the axis, and of their derivatives."""
        r, slope = _first_step(self, np.arctan2(rho, z))
        on_axis = rho == 0
        some_rho = np.where(on_axis, 1.0, rho)
        scale = np.where(on_axis, slope / np.where(on_axis, z, 1.0), r / some_rho)
        if change is not None:
            # Along the radius and at right angles to it.
            out_x, out_y = np.where(on_axis, 1.0, x / some_rho), y / some_rho
            outwards = out_x * change[0] + out_y * change[1]
            along = slope * (z * outwards - rho * change[2]) / (rho * rho + z * z)
            change = (
                out_x * along + scale * (change[0] - out_x * outwards),
                out_y * along + scale * (change[1] - out_y * outwards),
            )
        return x * scale, y * scale, change

    def _direction(self, point: Float) -> Float:
        """Return the unit vectors of points (n, 2) after the first step; NaN beyond the limit."""
        x, y = point.T
        r = np.hypot(x, y)
        if LENS_MODELS[self.model].radius is None:
            direction = np.column_stack([x, y, np.ones_like(x)]) / np.sqrt(1 + r * r)[:, np.newaxis]
        else:
            angle = _angle(self, r)
            scale = np.sin(angle) / np.where(r > 0, r, 1.0)
            direction = np.column_stack([x * scale, y * scale, np.cos(angle)])
        return np.where(direction[:, 2:] > np.cos(self.limit_rad) + _LIMIT_MARGIN, direction, np.nan)

    def rotated_by_quarter(self) -> "Lens":
        """Return the lens of the same camera rotated by 90 deg: new x is old y, and new y is old -x.

        Returns
        -------
        Lens
            OpenCV's model tilts a sensor about x, then about y.  For a sensor that is tilted about both, the rotated
            model also includes a roll of the camera of about tau_x tau_y; a fit of the attitude absorbs it.
        """
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *tilt = self.brown
        part = LENS_MODELS[self.model].brown
        if part is None or not any((p1, p2, s1, s2, s3, s4, *tilt)):
            return self
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        tilted = quarter @ _tilt_rotation(self.brown) @ quarter.T
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
        count = next(count for count in _COUNTS_WITH_WHOLE_PAIRS if count >= len(self.coefficients[part]))
        first = self.coefficients[: len(self.coefficients) - len(self.coefficients[part])]
        return replace(self, coefficients=(*first, *(float(number) for number in rotated[:count])))

    def __str__(self) -> str:
        names = LENS_MODELS[self.model].coefficients
        terms = [f"{name}={number:g}" for name, number in zip(names, self.coefficients, strict=False) if number]
        return " ".join([self.model, *terms])


def _transformed(homography: Float, xy: Float) -> Float:
    """Return points transformed by a homography."""
    mapped = xy @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def _first_step(lens: Lens, angle_rad: Float) -> tuple[Float, Float]:
    """Return the distances from the axis after the first step of `LensFormulas.radius`, and their derivatives."""
    radius = LENS_MODELS[lens.model].radius
    assert radius is not None
    return radius(lens.coefficients, angle_rad)


@lru_cache(maxsize=64)
def _limit_rad(lens: Lens) -> float:
    limit_rad, largest_r = LENS_MODELS[lens.model].limit_rad(lens.coefficients), _brown_limit(lens.brown)
    if LENS_MODELS[lens.model].radius is None:
        limit_rad = np.arctan(largest_r)
    elif np.isfinite(largest_r):
        limit_rad = np.fmin(limit_rad, _angle(lens, np.array([largest_r]))[0])
    return float(min(limit_rad, lens.max_angle_rad))


@lru_cache(maxsize=64)
def _table(lens: Lens) -> tuple[Float, Float]:
    """Return angles from the axis and the distances that the first step gives them, both increasing."""
    limit_rad = LENS_MODELS[lens.model].limit_rad(lens.coefficients) - _LIMIT_MARGIN
    # Dense towards the limit, where the inverse is steepest.
    angle = limit_rad * np.sin(np.linspace(0, np.pi / 2, _TABLE_SIZE))
    return angle, np.maximum.accumulate(_first_step(lens, angle)[0])


def _angle(lens: Lens, r: Float) -> Float:
    """Return the angles from the axis (n,) to which the first step gives some distances; NaN if there are none."""
    angles, distances = _table(lens)
    angle = np.interp(r, distances, angles)
    error = np.full(len(r), np.inf)
    with np.errstate(all="ignore"):  # distances without a solution stay at the end of the table
        for _ in range(_MAX_STEPS):
            found, slope = _first_step(lens, angle)
            error = np.abs(found - r) / (1 + r)
            angle = np.clip(angle - (found - r) / slope, 0.0, angles[-1])
            if not (error > _CONVERGED).any():
                break
    return np.where(error < _MAX_ERROR, angle, np.nan)


@lru_cache(maxsize=64)
def _brown_table(coefficients: Coefficients) -> tuple[Float, Float]:
    """Return distances from the axis before and after the second step, both increasing."""
    max_angle_rad = min(np.arctan(_brown_limit(coefficients)), _MAX_FIELD_RAD)
    radius = np.tan(max_angle_rad * np.sin(np.linspace(0, np.pi / 2, _TABLE_SIZE)))
    return radius, np.maximum.accumulate(radius * _brown_factor(coefficients, radius * radius)[0])


def _brown_inverse(coefficients: Coefficients, moved: Float) -> Float:
    """Return points (n, 2) before the second step; NaN for those that no point within its limit reaches."""
    radius, moved_radius = _brown_table(coefficients)
    r_moved = np.hypot(moved[:, 0], moved[:, 1])
    # With tangential terms the image extends farther on one side, so the start may lie at the end of the table.
    r = np.interp(r_moved, moved_radius, radius)
    scale = np.where(r_moved > 0, r / np.maximum(r_moved, 1e-300), 1.0)
    x, y = moved[:, 0] * scale, moved[:, 1] * scale
    max_r = 2 * radius[-1]
    error = np.full(len(moved), np.inf)
    with np.errstate(all="ignore"):  # points without a solution diverge and become NaN
        for _ in range(_MAX_STEPS):
            inwards = np.minimum(1.0, max_r / np.hypot(x, y))
            x, y = np.where(inwards < 1, x * inwards, x), np.where(inwards < 1, y * inwards, y)
            found_x, found_y = _brown_point(coefficients, x, y)
            error_x, error_y = found_x - moved[:, 0], found_y - moved[:, 1]
            error = np.hypot(error_x, error_y)
            if not (error > _CONVERGED).any():
                break
            xx, xy, yx, yy = _brown_jacobian(coefficients, x, y)
            determinant = xx * yy - xy * yx
            x = x - (yy * error_x - xy * error_y) / determinant
            y = y - (xx * error_y - yx * error_x) / determinant
        valid = (error < _MAX_ERROR) & (np.hypot(x, y) < _brown_limit(coefficients))
    return np.where(valid[:, np.newaxis], np.column_stack([x, y]), np.nan)
