"""What the gyros felt between the attitudes of a log."""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.flight.rotationvector import apply, cubic, vector_of_rate
from glstar.flight.spline import RotationSpline
from glstar.rotation import conjugate, matrix_from_quaternion, multiply, quaternion_from_turn, slerp, turn_between
from glstar.statistics import robust_std

__all__ = ["GyroTrack", "gyro_aided", "gyro_lag_s"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Gyros are silent where they do not speak for more than so many usual intervals.
USUAL_INTERVALS: Final = 3
# Stamps of readings of a gyro are late by half a reading, by filters, by the queue of the log: never by more, s.
_LATEST_S: Final = 0.1
# A lag counts where it is so many times its own uncertainty.
_SURE_SIGMA: Final = 5
_LAG_ROUNDS: Final = 3
# So many samples tell it to hundredths of a millisecond.
_ENOUGH_FOR_LAG: Final = 50_000
# A gyro reads 2000 deg/s at most, and one reading that departs from both neighbours by so much is damaged.
_FASTEST_RAD_PER_S: Final = np.deg2rad(3000.0)
_SPIKE_RAD_PER_S: Final = np.deg2rad(300.0)
# A reading so near to a sample, in intervals of the gyros, says nothing new, and the grain of UTC would be a turn.
_TOO_NEAR: Final = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class GyroTrack:
    """What gyros alone say of an attitude: every turn, and not which way is north.

    Attributes
    ----------
    t_s : (n,) float64, n >= 2
        Times of the readings, s, strictly increasing.
    rate_rad_per_s : (n, 3) float64
        Turn rates about the body's axes, rad/s.
    turn_rad : (n - 1, 3) float64
        The turn from each reading to the next, a rotation vector, rad.
    q_body_start : (n, 4) float64
        The attitude relative to that of the first reading.
    silent : (n - 1,) bool
        Between which readings the gyros are silent for so long that nothing is known.
    """

    t_s: Float
    rate_rad_per_s: Float
    turn_rad: Float
    q_body_start: Float
    silent: Mask

    @classmethod
    def of_readings(cls, t_s: ArrayLike, rate_rad_per_s: ArrayLike) -> Self | None:
        """Integrate the rates that a gyro can have meant.

        Parameters
        ----------
        t_s, rate_rad_per_s : (m,) and (m, 3) array_like
            Readings as a log holds them; see `gyro_aided`.

        Returns
        -------
        GyroTrack or None
            None of fewer than two sound readings.
        """
        t, rate = _sound_rates(t_s, rate_rad_per_s)
        return cls.of(t, rate) if t.size > 1 else None

    @classmethod
    def of(cls, t_s: Float, rate_rad_per_s: Float) -> Self:
        """Integrate the rates.

        Parameters
        ----------
        t_s : (n,) float64, n >= 2
            Times of the readings, s, strictly increasing.
        rate_rad_per_s : (n, 3) float64
            Turn rates about the body's axes, rad/s.

        Returns
        -------
        GyroTrack

        Notes
        -----
        The rate between two readings is a cubic through four, and coning is allowed for to the second order: P. G.
        Savage, "Strapdown inertial navigation integration algorithm design part 1", J. Guid. Control Dyn. 21, 1998,
        eqs (31), (32), where the rate changes evenly.
        """
        h = np.diff(t_s)[:, np.newaxis]
        before, after = rate_rad_per_s[:-1], rate_rad_per_s[1:]
        bend = np.zeros_like(rate_rad_per_s)
        slope = (after - before) / h
        # Of three readings in uneven steps the second difference is mostly error.
        even = (h[1:] < 2 * h[:-1]) & (h[:-1] < 2 * h[1:])
        bend[1:-1] = np.where(even, 2 * (slope[1:] - slope[:-1]) / (h[1:] + h[:-1]), 0.0)
        turn = h * (before + after) / 2 - h**3 / 24 * (bend[:-1] + bend[1:]) + h**2 / 12 * np.cross(before, after)
        silent = h[:, 0] > USUAL_INTERVALS * np.median(h)
        return cls(t_s, rate_rad_per_s, turn, _one_after_the_other(quaternion_from_turn(turn)), silent)

    def at(self, t_s: Float) -> Float:
        """Return the attitude relative to that of the first reading, at each of the given times.

        Parameters
        ----------
        t_s : (m,) float64
            Times, s; outside of the track its ends are held.

        Returns
        -------
        (m, 4) float64
        """
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        before = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, self.t_s.size - 2)
        h = (self.t_s[before + 1] - self.t_s[before])[:, np.newaxis]
        u = (t - self.t_s[before])[:, np.newaxis] / h
        turn, rate, last = self.turn_rad[before], self.rate_rad_per_s[before], self.rate_rad_per_s[before + 1]
        # Hermite's cubic: the turn begins with the one rate and ends with the other.
        last = last + np.cross(turn, last) / 2
        part = turn * u**2 * (3 - 2 * u) + h * u * (1 - u) * (rate * (1 - u) - last * u)
        return multiply(quaternion_from_turn(part), self.q_body_start[before])

    def rates_at(self, t_s: Float) -> Float:
        """Return the rates at each of the given times, (m, 3), rad/s."""
        return np.stack([np.interp(t_s, self.t_s, rate) for rate in self.rate_rad_per_s.T], axis=-1)

    def covers(self, t_s: Float) -> Mask:
        """Return between which of the given times the gyros were never silent, (m - 1,)."""
        silences = np.concatenate(([0], np.cumsum(self.silent)))
        index = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, None)
        after = np.clip(np.searchsorted(self.t_s, t_s, side="left"), None, self.t_s.size - 1)
        inside = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1])
        heard: Mask = inside[:-1] & inside[1:] & (silences[after[1:]] == silences[index[:-1]])
        return heard

    def misses(self, t_s: Float, q_body_ned: Float) -> Float:
        """Return by what the gyros miss each turn from attitude to attitude, (m - 1, 3), rad."""
        felt = self.at(t_s)
        return turn_between(multiply(multiply(felt[1:], conjugate(felt[:-1])), q_body_ned[:-1]), q_body_ned[1:])

    def in_step_with(self, t_s: Float, q_body_ned: Float, whole: Mask) -> Self:
        """Return the same by the clock of some attitudes, without the lag of the gyros; see `gyro_lag_s`."""
        return replace(self, t_s=self.t_s - _lag_s(t_s, q_body_ned, self, whole))


def gyro_aided(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike,
    rate_rad_per_s: ArrayLike,
    *,
    broken: ArrayLike | None = None,
) -> RotationSpline:
    """Return a curve as dense as the readings of the gyros: between attitudes the gyros say how the aircraft turned.

    From each sample to the next the rates are integrated; what they miss it by, for gyros drift and estimators correct
    themselves, is spread evenly over the time between.

    Parameters
    ----------
    t_s : (n,) array_like, n >= 2
        Times of the attitudes, s, strictly increasing.
    q_body_ned : (n, 4) array_like
        Unit quaternions (w, x, y, z).
    rate_t_s : (m,) array_like
        Times of the readings, s, by the same clock, in any order.
    rate_rad_per_s : (m, 3) array_like
        Turn rates about the body's axes forward, right, down, rad/s.  Readings that are not finite, or of more than
        3000 deg/s, or more than 300 deg/s away from both of their neighbours, are left out.
    broken : (n - 1,) array_like of bool, optional
        Between which attitudes the record is broken: no samples are put there.

    Returns
    -------
    RotationSpline
        Its samples are the given ones, as they were, and between those that the gyros cover one at each reading; its
        rates there are what the gyros felt.

    Notes
    -----
    The stamps of the gyros may lag behind those of the attitude, by 9.8 ms in a log at 50 Hz, where that costs four
    times the error; the lag that closes the loop best is taken off (`gyro_lag_s`).  Where the gyros are silent for
    three of their intervals or more no samples are added: there the curve is that of `RotationSpline.through` all
    attitudes.
    """
    t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
    alone = RotationSpline.through(t, q, broken=broken)
    readings = GyroTrack.of_readings(rate_t_s, rate_rad_per_s)
    if readings is None:
        return alone
    whole = _whole(t, broken)
    gyro = readings.in_step_with(t, q, whole)
    aided = whole & gyro.covers(t)
    # What the gyros do not know, at the samples; in between it drifts evenly.
    drift = multiply(conjugate(gyro.at(t)), q)
    before = np.searchsorted(t, gyro.t_s, side="right") - 1
    inside = (before >= 0) & (before < t.size - 1)
    inside[inside] = aided[before[inside]]
    near_s = _TOO_NEAR * np.median(np.diff(gyro.t_s))
    inside[inside] = (gyro.t_s[inside] - t[before[inside]] > near_s) & (
        t[before[inside] + 1] - gyro.t_s[inside] > near_s
    )
    new_t, before = gyro.t_s[inside], before[inside]
    part = (new_t - t[before]) / (t[before + 1] - t[before])
    new_q = multiply(gyro.q_body_start[inside], slerp(drift[before], drift[before + 1], part))
    all_t, all_q = np.concatenate((t, new_t)), np.concatenate((q, new_q))
    order = np.argsort(all_t, kind="stable")
    all_t, all_q = all_t[order], all_q[order]

    # What gyros felt at both ends of each piece, and how fast its segment is closed.
    segment = np.clip(np.searchsorted(t, all_t[:-1], side="right") - 1, 0, t.size - 2)
    closing = (turn_between(drift[:-1], drift[1:]) / np.diff(t)[:, np.newaxis])[segment]
    to_body, rate = matrix_from_quaternion(gyro.at(all_t)), gyro.rates_at(all_t)
    begin, end = (apply(to_body[k], closing) + rate[k] for k in (slice(-1), slice(1, None)))
    step_s, turn_rad = np.diff(all_t), turn_between(all_q[:-1], all_q[1:])
    felt = cubic(step_s, turn_rad, begin, apply(vector_of_rate(turn_rad), end))
    coefficients = np.where(aided[segment][:, np.newaxis, np.newaxis], felt, alone.coefficients[segment])
    return RotationSpline(all_t, all_q, coefficients)


def gyro_lag_s(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike,
    rate_rad_per_s: ArrayLike,
    *,
    broken: ArrayLike | None = None,
) -> float:
    """Return by how much the stamps of gyros are later than those of attitudes, s.

    Parameters
    ----------
    t_s, q_body_ned, rate_t_s, rate_rad_per_s, broken
        See `gyro_aided`.

    Returns
    -------
    float
        0.0 where the flight does not tell: the lag is less than five times its uncertainty, or more than 0.1 s.

    Notes
    -----
    A lag of L s leaves L (w2 - w1) of the turn between samples with rates w1 and w2, a bias b leaves b (t2 - t1): both
    are fitted to what gyros and attitudes differ by, without outliers.
    """
    t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
    gyro = GyroTrack.of_readings(rate_t_s, rate_rad_per_s)
    return 0.0 if gyro is None else _lag_s(t, q, gyro, _whole(t, broken))


def _whole(t: Float, broken: ArrayLike | None) -> Mask:
    """Return between which attitudes the record is whole, (n - 1,)."""
    return np.ones(t.size - 1, dtype=np.bool_) if broken is None else ~np.asarray(broken, dtype=np.bool_)


def _lag_s(t: Float, q: Float, gyro: GyroTrack, whole: Mask) -> float:
    """Return the lag of integrated gyros, s; see `gyro_lag_s`."""
    t, q, whole = t[:_ENOUGH_FOR_LAG], q[:_ENOUGH_FOR_LAG], whole[: _ENOUGH_FOR_LAG - 1]
    lag_s = 0.0
    for _ in range(_LAG_ROUNDS):
        more_s, sigma_s = _lag_left(t + lag_s, q, gyro, whole & gyro.covers(t + lag_s))
        if not abs(lag_s + more_s) < _LATEST_S or not abs(lag_s + more_s) > _SURE_SIGMA * sigma_s:
            return 0.0
        lag_s += more_s
    return lag_s


def _lag_left(t: Float, q: Float, gyro: GyroTrack, known: Mask) -> tuple[float, float]:
    """Return the lag that is left in gyros and its uncertainty, s; not finite where nothing tells."""
    miss = gyro.misses(t, q)[known]
    step_s, change = np.diff(t)[known], np.diff(gyro.rates_at(t), axis=0)[known]
    columns = np.zeros((*miss.shape, 4))
    columns[:, range(3), range(3)] = step_s[:, np.newaxis]
    columns[:, :, 3] = change
    A, y = columns.reshape(-1, 4), miss.reshape(-1)
    use = np.ones(y.size, dtype=np.bool_)
    for _ in range(_LAG_ROUNDS):
        normal = A[use].T @ A[use]
        if use.sum() <= A.shape[1] or np.linalg.matrix_rank(normal) < A.shape[1]:
            return 0.0, np.inf
        fit = np.linalg.solve(normal, A[use].T @ y[use])
        rest = np.abs(y - A @ fit)
        sigma = robust_std(rest)
        use = rest <= 4 * sigma
    return float(fit[3]), float(sigma * np.sqrt(np.linalg.inv(normal)[3, 3]))


def _sound_rates(t_s: ArrayLike, rate_rad_per_s: ArrayLike) -> tuple[Float, Float]:
    """Return the readings that a gyro can have meant, in order."""
    t = np.asarray(t_s, dtype=np.float64)
    rate = np.asarray(rate_rad_per_s, dtype=np.float64).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        sound = np.isfinite(t) & (np.abs(rate) < _FASTEST_RAD_PER_S).all(axis=-1)
    t, first = np.unique(t[sound], return_index=True)
    rate = rate[sound][first]
    if t.size > 2:
        middle = np.median(np.lib.stride_tricks.sliding_window_view(rate, 3, axis=0), axis=-1)
        wild = np.zeros(t.size, dtype=np.bool_)
        wild[1:-1] = (np.abs(rate[1:-1] - middle) > _SPIKE_RAD_PER_S).any(axis=-1)
        t, rate = t[~wild], rate[~wild]
    return t, rate


def _one_after_the_other(q: Float) -> Float:
    """Return the products of 0, 1, 2 ... quaternions, each on the left of those before it; (n + 1, 4)."""
    # Rows of sqrt(n): the products along all rows at once, then those of the rows.
    width = max(1, int(np.sqrt(len(q))))
    height = -(-len(q) // width)
    rows = np.zeros((height * width, 4))
    rows[:, 0] = 1.0
    rows[: len(q)] = q
    grid = rows.reshape(height, width, 4)
    for k in range(1, width):
        grid[:, k] = multiply(grid[:, k], grid[:, k - 1])
    before = np.zeros((height, 1, 4))
    before[0, 0, 0] = 1.0
    for k in range(1, height):
        before[k] = multiply(grid[k - 1, -1], before[k - 1])
    products = multiply(grid, np.broadcast_to(before, grid.shape)).reshape(-1, 4)[: len(q)]
    products = np.concatenate(([[1.0, 0.0, 0.0, 0.0]], products))
    whole: Float = products / np.linalg.norm(products, axis=-1, keepdims=True)
    return whole
