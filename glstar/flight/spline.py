"""A smooth curve through attitudes, and the rates and accelerations of rotation vectors that it is fitted with."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float, Mask
from glstar.rotation import multiply, quaternion_from_turn, turn_between

# Below this angle, rad, the closed forms lose digits by cancellation; three terms of the series are exact there.
_SERIES_RAD = 0.1


def rate_of_vector(turn_rad: Float) -> Float:
    """Return the matrices from the time derivatives of rotation vectors, (n, 3) rad, to body rates, (n, 3, 3)."""
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    half = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    return np.asarray(np.eye(3) - _scaled(half, cross) + _scaled(_third(angle), cross @ cross))


def vector_of_rate(turn_rad: Float) -> Float:
    """Return the inverses of the matrices of `rate_of_vector`, (n, 3, 3)."""
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    small = angle < _SERIES_RAD
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    factor = np.where(small, 1 / 12 + square / 720 + square**2 / 30240, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    return np.asarray(np.eye(3) + cross / 2 + _scaled(factor, cross @ cross))


def angular_acceleration(turn_rad: Float, derivative: Float) -> Float:
    """Return the angular acceleration of a body whose rotation vector changes at a constant rate.

    `turn_rad`, `derivative` (n, 3): rotation vectors, rad, and their time derivatives, rad/s.  Returns (n, 3) in body
    axes, rad/s^2.
    """
    angle = np.linalg.norm(turn_rad, axis=-1)
    small = angle < _SERIES_RAD
    x, square = np.where(small, 1.0, angle), angle * angle
    first = np.where(small, -1 / 12 + square / 180 - square**2 / 6720, (x * np.sin(x) + 2 * np.cos(x) - 2) / x**4)
    second = np.where(
        small, -1 / 60 + square / 1260 - square**2 / 60480, (3 * np.sin(x) - x * np.cos(x) - 2 * x) / x**5
    )
    along = np.sum(turn_rad * derivative, axis=-1)
    once = np.cross(turn_rad, derivative)
    acceleration: Float = (
        -(along * first)[:, np.newaxis] * once
        + (along * second)[:, np.newaxis] * np.cross(turn_rad, once)
        + _third(angle)[:, np.newaxis] * np.cross(derivative, once)
    )
    return acceleration


def cubic(step_s: Float, turn_rad: Float, begin: Float, end: Float) -> Float:
    """Return cubic polynomials for rotation vectors that start at zero, from their derivatives at both ends.

    `step_s` (n,): length of each interval, s; `turn_rad` (n, 3): rotation vector at its end, rad; `begin`, `end` (n,
    3): time derivatives at its start and end, rad/s.  Returns (n, 3, 3) coefficients of time, its square and its cube.
    """
    h = step_s[:, np.newaxis]
    mean = turn_rad / h
    return np.stack([begin, (3 * mean - 2 * begin - end) / h, (begin + end - 2 * mean) / h**2], axis=-2)


def apply(matrix: Float, vector: Float) -> Float:
    """Return (n, 3, 3) matrices times (n, 3) vectors."""
    return np.asarray((matrix @ vector[..., np.newaxis])[..., 0])


def _third(angle: Float) -> Float:
    """Return (x - sin x) / x^3."""
    small = angle < _SERIES_RAD
    safe, square = np.where(small, 1.0, angle), angle * angle
    return np.where(small, 1 / 6 - square / 120 + square**2 / 5040, (safe - np.sin(safe)) / safe**3)


def _cross(v: Float) -> Float:
    """Return the skew-symmetric matrices of the cross product by each vector, (n, 3, 3)."""
    matrix = np.zeros((len(v), 3, 3))
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return np.asarray(matrix - matrix.transpose(0, 2, 1))


def _scaled(factor: Float, matrix: Float) -> Float:
    return factor[:, np.newaxis, np.newaxis] * matrix


# The iteration for the rates at the samples stops when it changes the turns by less than this, rad: 2e-5".
_CONVERGED_RAD = 1e-10
_MAX_ITERATIONS = 20
# Larger turns between two samples are ambiguous and are not fitted, rad.
_MAX_TURN_RAD = np.deg2rad(90.0)
# Bandwidth of a block tridiagonal matrix of 3 x 3 blocks, on either side of the diagonal.
_BANDWIDTH = 5


@dataclass(frozen=True, slots=True, eq=False)
class RotationSpline:
    """A curve through attitudes with continuous turn rate and angular acceleration.

    Between two samples the rotation vector from the first of them is a cubic polynomial of time.

    The equations are those of `scipy.spatial.transform.RotationSpline`, but for the boundary conditions: SciPy uses the
    mean rate of the first and the last interval; here it is the rate of a parabola through three samples, which is
    accurate to second order.  SciPy's class also has no gaps.
    """

    t_s: Float  # (n,) n >= 2: sample times, s, strictly increasing
    q_body_ned: Float  # (n, 4) unit quaternions (w, x, y, z)
    # (n - 1, 3, 3) coefficients of each polynomial, in the body frame at its first sample: those of the time since that
    # sample, its square and its cube; rad/s, rad/s^2, rad/s^3.
    coefficients: Float

    @classmethod
    def through(cls, t_s: ArrayLike, q_body_ned: ArrayLike, *, broken: ArrayLike | None = None) -> Self:
        """Fit the curve through attitudes.

        `t_s` (n,) n >= 2: sample times, s, strictly increasing; `q_body_ned` (n, 4): unit quaternions (w, x, y, z), of
        either sign; `broken` (n - 1,) bool: intervals that are gaps.  In a gap, and in an interval with a turn of more
        than 90 deg, the turn rate is constant, as for slerp; the curves on its two sides are independent.
        """
        t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
        step_s = np.diff(t)
        turn_rad = turn_between(q[:-1], q[1:])
        linear = np.linalg.norm(turn_rad, axis=-1) > _MAX_TURN_RAD
        if broken is not None:
            linear |= np.asarray(broken, dtype=np.bool_)
        coefficients = cubic(step_s, turn_rad, *_node_rates(step_s, turn_rad, q, linear))
        coefficients[linear, 0] = turn_rad[linear] / step_s[linear, np.newaxis]
        coefficients[linear, 1:] = 0.0
        return cls(t, q, coefficients)

    @classmethod
    def joined(cls, curves: Sequence[Self]) -> Self:
        """Concatenate curves sorted by time, without overlaps, with a constant turn rate between each two."""
        parts = [curves[0].coefficients]
        for before, after in pairwise(curves):
            bridge = np.zeros((1, 3, 3))
            bridge[0, 0] = turn_between(before.q_body_ned[-1], after.q_body_ned[0]) / (after.t_s[0] - before.t_s[-1])
            parts += [bridge, after.coefficients]
        t_s, q_body_ned = (np.concatenate([getattr(c, name) for c in curves]) for name in ("t_s", "q_body_ned"))
        return cls(t_s, q_body_ned, np.concatenate(parts))

    def at(self, t_s: ArrayLike) -> Float:
        """Return the attitudes at times within the range of the samples, s, as unit quaternions (..., 4)."""
        t = np.asarray(t_s, dtype=np.float64)
        before = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, self.t_s.size - 2)
        s = (t - self.t_s[before])[..., np.newaxis]
        linear, square, cube = np.moveaxis(self.coefficients[before], -2, 0)
        return multiply(quaternion_from_turn(((cube * s + square) * s + linear) * s), self.q_body_ned[before])


def _node_rates(step_s: Float, turn_rad: Float, q: Float, linear: Mask) -> tuple[Float, Float]:
    """Return the time derivatives of the rotation vector at the start and at the end of each interval, rad/s.

    At the start of an interval the derivative is the body rate; at its end it is the body rate times `vector_of_rate`.
    """
    count = step_s.size + 1
    mean = turn_rad / step_s[:, np.newaxis]
    smooth = ~linear
    begins = np.concatenate(([False], smooth)) < np.concatenate((smooth, [False]))
    ends = np.concatenate(([False], smooth)) > np.concatenate((smooth, [False]))
    inner = np.zeros(count, dtype=np.bool_)
    inner[1:-1] = smooth[:-1] & smooth[1:]

    # The rates of samples at the ends of a segment are known: their rows of the matrix are those of the identity.
    end_rates = _end_rates(step_s, turn_rad, q, begins, ends, inner)
    to_rate, to_vector = rate_of_vector(turn_rad), vector_of_rate(turn_rad)
    below, above = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    at = np.flatnonzero(inner)
    over = (1 / step_s)[:, np.newaxis, np.newaxis]
    # Rows are divided by their diagonal.
    middle = 4 * (over[at - 1] + over[at])
    below[at] = 2 * over[at - 1] * to_rate[at - 1] / middle
    above[at] = 2 * over[at] * to_vector[at] / middle
    solver = _BandedSolver(below, above)
    constant = end_rates.copy()
    constant[at] = 6 * (mean[at - 1] * over[at - 1, 0] + mean[at] * over[at, 0]) / middle[:, 0]

    rate = end_rates.copy()
    rate[at] = (mean[at - 1] + mean[at]) / 2
    longest_s = np.zeros(count)
    longest_s[at] = np.maximum(step_s[at - 1], step_s[at])
    for _ in range(_MAX_ITERATIONS):
        rate_after = apply(to_vector, rate[1:])
        right = constant.copy()
        right[at] -= angular_acceleration(turn_rad[at - 1], rate_after[at - 1]) / middle[:, 0]
        better = solver.solve(right)
        change_rad = np.max(longest_s * np.linalg.norm(better - rate, axis=-1))
        rate = better
        if change_rad < _CONVERGED_RAD:
            break
    return rate[:-1], apply(to_vector, rate[1:])


def _end_rates(step_s: Float, turn_rad: Float, q: Float, begins: Mask, ends: Mask, inner: Mask) -> Float:
    """Return the rates at both ends of each segment, of parabolas through three samples, else 0; (n, 3), rad/s."""
    mean = turn_rad / step_s[:, np.newaxis]
    rate = np.zeros((inner.size, 3))
    first, last = np.flatnonzero(begins), np.flatnonzero(ends)
    rate[first], rate[last] = mean[first], mean[last - 1]
    first = first[inner[first + 1]]
    last = last[inner[last - 1]]
    for end, near, far in ((first, 1, 2), (last, -1, -2)):
        # Signed steps: negative at the end of a segment.
        h = np.sign(near) * step_s[end + min(near, 0)][:, np.newaxis]
        k = np.sign(near) * step_s[end + (1 if near > 0 else -2)][:, np.newaxis]
        to_near, to_far = turn_between(q[end], q[end + near]), turn_between(q[end], q[end + far])
        rate[end] = to_near / h + (to_near / h - (to_far - to_near) / k) * h / (h + k)
    return rate


class _BandedSolver:
    """Solves block tridiagonal equations with identity blocks on the diagonal, by a banded LU decomposition (LAPACK).

    The matrix is decomposed once for all right-hand sides; `scipy.linalg.solve_banded` would decompose it every time.
    `below`, `above` (n, 3, 3): blocks beside the diagonal; the first one below and the last one above are ignored.
    """

    def __init__(self, below: Float, above: Float) -> None:
        from scipy.linalg import lapack  # noqa: PLC0415 - SciPy, only when a spline is fitted

        self._lapack: Any = lapack
        # LAPACK's banded storage, in columns: the element (i, j) is in row 2 * bandwidth + i - j of column j; the first
        # rows are for the decomposition.
        bands = np.zeros((3 * _BANDWIDTH + 1, 3 * len(below)), order="F")
        diagonal = 2 * _BANDWIDTH
        bands[diagonal] = 1.0
        for row in range(3):
            for column in range(3):
                offset = diagonal + row - column
                bands[offset - 3, column + 3 :: 3] = above[:-1, row, column]
                bands[offset + 3, column:-3:3] = below[1:, row, column]
        self._decomposed, self._pivots, _ = lapack.dgbtrf(bands, _BANDWIDTH, _BANDWIDTH, overwrite_ab=True)

    def solve(self, right_side: Float) -> Float:
        """Return the (n, 3) unknowns for (n, 3) right-hand sides."""
        unknowns, _ = self._lapack.dgbtrs(
            self._decomposed, _BANDWIDTH, _BANDWIDTH, right_side.reshape(-1), self._pivots
        )
        return np.asarray(unknowns.reshape(right_side.shape))
