"""A smooth curve through attitudes."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.flight.rotationvector import apply, bend, cubic, rate_of_vector, vector_of_rate
from glstar.flight.tridiagonal import BlockTridiagonal
from glstar.rotation import multiply, quaternion_from_turn, turn_between

__all__ = ["RotationSpline"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The rates at the samples are found anew until no turn between two changes by more, rad: 2e-5".
_SETTLED_RAD: Final = 1e-10
_MOST_ROUNDS: Final = 20
# Of an aircraft that turned further between two samples nobody knows which way it went.
_WIDEST_TURN_RAD: Final = np.deg2rad(90.0)


@dataclass(frozen=True, slots=True, eq=False)
class RotationSpline:
    """A curve through attitudes whose rate and angular acceleration are continuous.

    Between two samples the turn from the first of them is a cubic polynomial of time, as a rotation vector.

    Attributes
    ----------
    t_s : (n,) float64, n >= 2
        Sample times, s, strictly increasing.
    q_body_ned : (n, 4) float64
        Unit quaternions (w, x, y, z).
    coefficients : (n - 1, 3, 3) float64
        Of the turn after each sample but the last, in the frame of that sample: those of the time since it, its square
        and its cube; rad/s, rad/s^2, rad/s^3.

    Notes
    -----
    The equations are those of `scipy.spatial.transform.RotationSpline`.  Departs from it at the ends, where SciPy takes
    the mean rate of the first and the last segment: here the rate of a parabola through three samples, which is right
    to the second order.
    """

    t_s: Float
    q_body_ned: Float
    coefficients: Float

    @classmethod
    def through(cls, t_s: ArrayLike, q_body_ned: ArrayLike, *, broken: ArrayLike | None = None) -> Self:
        """Return the curve through attitudes.

        Parameters
        ----------
        t_s : (n,) array_like, n >= 2
            Sample times, s, strictly increasing; in any steps.
        q_body_ned : (n, 4) array_like
            Unit quaternions (w, x, y, z), of either sign.
        broken : (n - 1,) array_like of bool, optional
            Between which samples the record is broken.  A broken segment is turned through at one rate, as by slerp,
            and so is one of more than 90 deg; what lies on its two sides does not know of each other.

        Returns
        -------
        RotationSpline
        """
        t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
        step_s = np.diff(t)
        turn_rad = turn_between(q[:-1], q[1:])
        apart = np.linalg.norm(turn_rad, axis=-1) > _WIDEST_TURN_RAD
        if broken is not None:
            apart |= np.asarray(broken, dtype=np.bool_)
        coefficients = cubic(step_s, turn_rad, *_node_rates(step_s, turn_rad, q, apart))
        coefficients[apart, 0] = turn_rad[apart] / step_s[apart, np.newaxis]
        coefficients[apart, 1:] = 0.0
        return cls(t, q, coefficients)

    @classmethod
    def joined(cls, curves: Sequence[Self]) -> Self:
        """Return curves that follow each other as one, which turns at one rate from each to the next.

        Parameters
        ----------
        curves : sequence of RotationSpline
            One or more, in the order of time; none overlaps another.

        Returns
        -------
        RotationSpline
        """
        parts = [curves[0].coefficients]
        for before, after in pairwise(curves):
            bridge = np.zeros((1, 3, 3))
            bridge[0, 0] = turn_between(before.q_body_ned[-1], after.q_body_ned[0]) / (after.t_s[0] - before.t_s[-1])
            parts += [bridge, after.coefficients]
        t_s, q_body_ned = (np.concatenate([getattr(c, name) for c in curves]) for name in ("t_s", "q_body_ned"))
        return cls(t_s, q_body_ned, np.concatenate(parts))

    def at(self, t_s: ArrayLike) -> Float:
        """Return the attitude at each of the given times.

        Parameters
        ----------
        t_s : (...) array_like
            Times between the first sample and the last, s.

        Returns
        -------
        (..., 4) float64
            Unit quaternions (w, x, y, z).
        """
        t = np.asarray(t_s, dtype=np.float64)
        before = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, self.t_s.size - 2)
        s = (t - self.t_s[before])[..., np.newaxis]
        linear, square, cube = np.moveaxis(self.coefficients[before], -2, 0)
        return multiply(quaternion_from_turn(((cube * s + square) * s + linear) * s), self.q_body_ned[before])


def _node_rates(step_s: Float, turn_rad: Float, q: Float, apart: Mask) -> tuple[Float, Float]:
    """Return how fast the rotation vector of each segment changes at its beginning and at its end, rad/s.

    At the beginning that is the body's rate; at the end `to_vector` takes the body's rate there to it.
    """
    n = step_s.size + 1
    mean = turn_rad / step_s[:, np.newaxis]
    whole = ~apart
    begins = np.concatenate(([False], whole)) < np.concatenate((whole, [False]))
    ends = np.concatenate(([False], whole)) > np.concatenate((whole, [False]))
    inner = np.zeros(n, dtype=np.bool_)
    inner[1:-1] = whole[:-1] & whole[1:]

    # What is not inside of a stretch has a rate of its own: its row of the system says so.
    given = _end_rates(step_s, turn_rad, q, begins, ends, inner)
    to_rate, to_vector = rate_of_vector(turn_rad), vector_of_rate(turn_rad)
    below, diagonal, above = np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    at = np.flatnonzero(inner)
    over = (1 / step_s)[:, np.newaxis, np.newaxis]
    diagonal[:] = np.eye(3)
    # Divided by the diagonal of the row, so that each is the identity but for its neighbours.
    middle = 4 * (over[at - 1] + over[at])
    below[at] = 2 * over[at - 1] * to_rate[at - 1] / middle
    above[at] = 2 * over[at] * to_vector[at] / middle
    solver = BlockTridiagonal.of(below, diagonal, above)
    known = given.copy()
    known[at] = 6 * (mean[at - 1] * over[at - 1, 0] + mean[at] * over[at, 0]) / middle[:, 0]

    rate = given.copy()
    rate[at] = (mean[at - 1] + mean[at]) / 2
    longest_s = np.zeros(n)
    longest_s[at] = np.maximum(step_s[at - 1], step_s[at])
    for _ in range(_MOST_ROUNDS):
        rate_after = apply(to_vector, rate[1:])
        right = known.copy()
        right[at] -= bend(turn_rad[at - 1], rate_after[at - 1]) / middle[:, 0]
        better = solver.solve(right)
        change_rad = np.max(longest_s * np.linalg.norm(better - rate, axis=-1))
        rate = better
        if change_rad < _SETTLED_RAD:
            break
    return rate[:-1], apply(to_vector, rate[1:])


def _end_rates(step_s: Float, turn_rad: Float, q: Float, begins: Mask, ends: Mask, inner: Mask) -> Float:
    """Return the rates at both ends of each stretch, rad/s: those of parabolas through three samples."""
    mean = turn_rad / step_s[:, np.newaxis]
    rate = np.zeros((inner.size, 3))
    first, last = np.flatnonzero(begins), np.flatnonzero(ends)
    rate[first], rate[last] = mean[first], mean[last - 1]
    first = first[inner[first + 1]]
    last = last[inner[last - 1]]
    for end, near, far in ((first, 1, 2), (last, -1, -2)):
        # Signed steps: before the last sample time runs backwards.
        h = np.sign(near) * step_s[end + min(near, 0)][:, np.newaxis]
        k = np.sign(near) * step_s[end + (1 if near > 0 else -2)][:, np.newaxis]
        to_near, to_far = turn_between(q[end], q[end + near]), turn_between(q[end], q[end + far])
        rate[end] = to_near / h + (to_near / h - (to_far - to_near) / k) * h / (h + k)
    return rate
