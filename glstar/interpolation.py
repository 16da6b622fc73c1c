"""Attitude between the samples of a log: a smooth curve through them, and what the gyros felt in between.

slerp (`glstar.rotation.slerp`) turns at one rate from each sample to the next and changes it at once.
`RotationSpline` turns smoothly: rate and angular acceleration are continuous.  `gyro_aided` knows better than any curve
how an aircraft vibrates, where the log has rates: it makes of few attitudes as many as there are readings of the gyros.
`unfelt_turns` finds turns of the estimator that no aircraft has made.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.rotation import conjugate, multiply, quaternion_from_turn, turn_from_quaternion

__all__ = ["RotationSpline"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Below this turn (rad) differences of sines lose digits, and three terms of their series are exact.
_SERIES_RAD: Final = 0.1
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
        turn_rad = _turns(q[:-1], q[1:])
        apart = np.linalg.norm(turn_rad, axis=-1) > _WIDEST_TURN_RAD
        if broken is not None:
            apart |= np.asarray(broken, dtype=np.bool_)
        coefficients = np.zeros((step_s.size, 3, 3))
        h = step_s[:, np.newaxis]
        rate, rate_after = _node_rates(step_s, turn_rad, q, apart)
        coefficients[:, 0] = rate
        coefficients[:, 1] = (3 * turn_rad / h - 2 * rate - rate_after) / h
        coefficients[:, 2] = (rate + rate_after - 2 * turn_rad / h) / h**2
        coefficients[apart, 0] = turn_rad[apart] / h[apart]
        coefficients[apart, 1:] = 0.0
        return cls(t, q, coefficients)

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


def _turns(q_before: Float, q_after: Float) -> Float:
    """Return the rotation vectors that lead from attitudes to attitudes, in the body's frame, rad."""
    return turn_from_quaternion(multiply(q_after, conjugate(q_before)))


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
    to_rate, to_vector = _rate_of_vector(turn_rad), _vector_of_rate(turn_rad)
    below, diagonal, above = np.zeros((n, 3, 3)), np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    at = np.flatnonzero(inner)
    over = (1 / step_s)[:, np.newaxis, np.newaxis]
    diagonal[:] = np.eye(3)
    # Divided by the diagonal of the row, so that each is the identity but for its neighbours.
    middle = 4 * (over[at - 1] + over[at])
    below[at] = 2 * over[at - 1] * to_rate[at - 1] / middle
    above[at] = 2 * over[at] * to_vector[at] / middle
    solver = _BlockTridiagonal.of(below, diagonal, above)
    known = given.copy()
    known[at] = 6 * (mean[at - 1] * over[at - 1, 0] + mean[at] * over[at, 0]) / middle[:, 0]

    rate = given.copy()
    rate[at] = (mean[at - 1] + mean[at]) / 2
    longest_s = np.zeros(n)
    longest_s[at] = np.maximum(step_s[at - 1], step_s[at])
    for _ in range(_MOST_ROUNDS):
        rate_after = _apply(to_vector, rate[1:])
        right = known.copy()
        right[at] -= _bend(turn_rad[at - 1], rate_after[at - 1]) / middle[:, 0]
        better = solver.solve(right)
        change_rad = np.max(longest_s * np.linalg.norm(better - rate, axis=-1))
        rate = better
        if change_rad < _SETTLED_RAD:
            break
    return rate[:-1], _apply(to_vector, rate[1:])


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
        to_near, to_far = _turns(q[end], q[end + near]), _turns(q[end], q[end + far])
        rate[end] = to_near / h + (to_near / h - (to_far - to_near) / k) * h / (h + k)
    return rate


def _rate_of_vector(turn_rad: Float) -> Float:
    """Return the matrices that make the body's rate of the change of its rotation vector."""
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    return np.eye(3) - _scaled(np.sinc(angle / (2 * np.pi)) ** 2 / 2, cross) + _scaled(_third(angle), cross @ cross)


def _vector_of_rate(turn_rad: Float) -> Float:
    """Return the matrices that make the change of a rotation vector of the body's rate."""
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    small = angle < _SERIES_RAD
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    factor = np.where(
        small, 1 / 12 + square / 720 + square**2 / 30240, (1 - safe / 2 / np.tan(safe / 2)) / safe**2
    )
    return np.eye(3) + cross / 2 + _scaled(factor, cross @ cross)


def _third(angle: Float) -> Float:
    """Return (x - sin x) / x^3."""
    small = angle < _SERIES_RAD
    safe, square = np.where(small, 1.0, angle), angle * angle
    return np.where(small, 1 / 6 - square / 120 + square**2 / 5040, (safe - np.sin(safe)) / safe**3)


def _bend(turn_rad: Float, change: Float) -> Float:
    """Return the angular acceleration of a rotation vector that changes evenly, rad/s^2."""
    angle = np.linalg.norm(turn_rad, axis=-1)
    small = angle < _SERIES_RAD
    x, square = np.where(small, 1.0, angle), angle * angle
    first = np.where(
        small, -1 / 12 + square / 180 - square**2 / 6720, (x * np.sin(x) + 2 * np.cos(x) - 2) / x**4
    )
    second = np.where(
        small, -1 / 60 + square / 1260 - square**2 / 60480, (3 * np.sin(x) - x * np.cos(x) - 2 * x) / x**5
    )
    along = np.sum(turn_rad * change, axis=-1)
    once = np.cross(turn_rad, change)
    return (
        -(along * first)[:, np.newaxis] * once
        + (along * second)[:, np.newaxis] * np.cross(turn_rad, once)
        + _third(angle)[:, np.newaxis] * np.cross(change, once)
    )


def _cross(v: Float) -> Float:
    """Return the (n, 3, 3) matrices of the cross product by each of some vectors."""
    matrix = np.zeros((len(v), 3, 3))
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return matrix - matrix.transpose(0, 2, 1)


def _scaled(factor: Float, matrix: Float) -> Float:
    return factor[:, np.newaxis, np.newaxis] * matrix


def _apply(matrix: Float, vector: Float) -> Float:
    product: Float = (matrix @ vector[..., np.newaxis])[..., 0]
    return product


@dataclass(frozen=True, slots=True, eq=False)
class _BlockTridiagonal:
    """Equations each of which knows two neighbours, solved by cyclic reduction.

    Every other unknown is put into the equations of its neighbours until one is left: O(n), in log2(n) steps of whole
    arrays.  Stable, for the diagonal outweighs what is beside it.
    """

    levels: tuple[tuple[Float, Float, Float, Float, Float], ...]
    last: Float

    @classmethod
    def of(cls, below: Float, diagonal: Float, above: Float) -> Self:
        """Eliminate; each argument holds (n, 3, 3) blocks."""
        levels = []
        while (n := len(diagonal)) > 1:
            # A last equation that says nothing gives each that is eliminated two neighbours.
            below, diagonal, above = (_odd(block) for block in (below, diagonal, above))
            if n % 2 == 0:
                diagonal[-1] = np.eye(3)
            inverse = np.linalg.inv(diagonal[1::2])
            left, right = inverse @ below[1::2], inverse @ above[1::2]
            from_left, from_right = below[2::2], above[:-1:2]
            levels.append((inverse, left, right, from_left, from_right))
            kept = diagonal[::2].copy()
            kept[1:] -= from_left @ right
            kept[:-1] -= from_right @ left
            below, above = np.zeros_like(kept), np.zeros_like(kept)
            below[1:], above[:-1] = -from_left @ left, -from_right @ right
            half = (n + 1) // 2
            below, diagonal, above = below[:half], kept[:half], above[:half]
        return cls(tuple(levels), np.linalg.inv(diagonal))

    def solve(self, right_side: Float) -> Float:
        """Return the (n, 3) unknowns of (n, 3) right sides."""
        sides: list[Float] = []
        side = right_side
        for inverse, _, _, from_left, from_right in self.levels:
            sides.append(side)
            whole = _odd(side)
            eliminated = _apply(inverse, whole[1::2])
            kept = whole[::2].copy()
            kept[1:] -= _apply(from_left, eliminated)
            kept[:-1] -= _apply(from_right, eliminated)
            side = kept[: (len(side) + 1) // 2]
        found = _apply(self.last, side)
        for (inverse, left, right, _, _), side in zip(reversed(self.levels), reversed(sides), strict=True):
            whole = _odd(side).copy()
            odd = _apply(inverse, whole[1::2])
            whole[: len(side) : 2] = found
            odd -= _apply(left, whole[:-1:2]) + _apply(right, whole[2::2])
            whole[1::2] = odd
            found = whole[: len(side)]
        return found


def _odd(blocks: Float) -> Float:
    """Return blocks in an odd number: with one of zeros more, if need be."""
    return blocks if len(blocks) % 2 else np.concatenate((blocks, np.zeros_like(blocks[:1])))
