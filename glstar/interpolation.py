"""Attitude between the samples of a log: a smooth curve through them, and what the gyros felt in between.

slerp (`glstar.rotation.slerp`) turns at one rate from each sample to the next and changes it at once.
`RotationSpline` turns smoothly: rate and angular acceleration are continuous.  `gyro_aided` knows better than any curve
how an aircraft vibrates, where the log has rates: it puts as many samples between as there are readings of the gyros.
`unfelt_turns` finds turns of the estimator that no aircraft has made.
"""

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.rotation import (
    conjugate,
    matrix_from_quaternion,
    multiply,
    quaternion_from_turn,
    slerp,
    turn_from_quaternion,
)

__all__ = ["GyroTrack", "RotationSpline", "gyro_aided", "gyro_lag_s", "unfelt_turns"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Below this turn (rad) differences of sines lose digits, and three terms of their series are exact.
_SERIES_RAD: Final = 0.1
# The rates at the samples are found anew until no turn between two changes by more, rad: 2e-5".
_SETTLED_RAD: Final = 1e-10
_MOST_ROUNDS: Final = 20
# Of an aircraft that turned further between two samples nobody knows which way it went.
_WIDEST_TURN_RAD: Final = np.deg2rad(90.0)

# Gyros are silent where they do not speak for more than so many usual intervals.
_USUAL_INTERVALS: Final = 3
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

# An estimator's reset that is worth a gap: 1.5 deg is 100 px at f = 3871 px.
_LEAST_RESET_RAD: Final = np.deg2rad(1.5)
_RESET_SPREADS: Final = 5
# What gyros miss of a spiral at 180 deg/s changes by less from sample to sample; at 10 Hz 2.5 deg.
_FASTEST_DRIFT_RAD_PER_S: Final = np.deg2rad(25.0)
# See `unfelt_turns`.
_FASTEST_CHANGE_RAD_PER_S2: Final = np.deg2rad(6000.0)


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
        coefficients = _cubic(step_s, turn_rad, *_node_rates(step_s, turn_rad, q, apart))
        coefficients[apart, 0] = turn_rad[apart] / step_s[apart, np.newaxis]
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
        silent = h[:, 0] > _USUAL_INTERVALS * np.median(h)
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
    rate_t, rate = _sound_rates(rate_t_s, rate_rad_per_s)
    alone = RotationSpline.through(t, q, broken=broken)
    if rate_t.size < 2:
        return alone
    whole = np.ones(t.size - 1, dtype=np.bool_) if broken is None else ~np.asarray(broken, dtype=np.bool_)
    gyro = GyroTrack.of(rate_t, rate)
    gyro = replace(gyro, t_s=gyro.t_s - _lag_s(t, q, gyro, whole))
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
    closing = (_turns(drift[:-1], drift[1:]) / np.diff(t)[:, np.newaxis])[segment]
    to_body, rate = matrix_from_quaternion(gyro.at(all_t)), gyro.rates_at(all_t)
    begin, end = (_apply(to_body[k], closing) + rate[k] for k in (slice(-1), slice(1, None)))
    step_s, turn_rad = np.diff(all_t), _turns(all_q[:-1], all_q[1:])
    felt = _cubic(step_s, turn_rad, begin, _apply(_vector_of_rate(turn_rad), end))
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
    rate_t, rate = _sound_rates(rate_t_s, rate_rad_per_s)
    if rate_t.size < 2:
        return 0.0
    whole = np.ones(t.size - 1, dtype=np.bool_) if broken is None else ~np.asarray(broken, dtype=np.bool_)
    return _lag_s(t, q, GyroTrack.of(rate_t, rate), whole)


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
    miss = _misses(t, q, gyro)[known]
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
        spread = _spread(rest)
        use = rest <= 4 * spread
    return float(fit[3]), float(spread * np.sqrt(np.linalg.inv(normal)[3, 3]))


def _misses(t: Float, q: Float, gyro: GyroTrack) -> Float:
    """Return by what the gyros miss each turn from sample to sample, (n - 1, 3), rad."""
    felt = gyro.at(t)
    return _turns(multiply(multiply(felt[1:], conjugate(felt[:-1])), q[:-1]), q[1:])


def _spread(departures: Float) -> float:
    """Return the standard deviation of normal numbers whose absolute values have this median."""
    return float(1.4826 * np.median(departures)) if departures.size else 0.0


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


def unfelt_turns(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike | None = None,
    rate_rad_per_s: ArrayLike | None = None,
) -> Mask:
    """Return between which samples the attitude turned as no aircraft did: an estimator was reset, and nobody said so.

    Parameters
    ----------
    t_s : (n,) array_like, n >= 2
        Times of the attitudes, s, strictly increasing.
    q_body_ned : (n, 4) array_like
        Unit quaternions (w, x, y, z).
    rate_t_s, rate_rad_per_s : (m,) and (m, 3) array_like, optional
        The readings of the gyros, where there are any; see `gyro_aided`.

    Returns
    -------
    (n - 1,) bool
        Where one turn departs from both of its neighbours by 1.5 deg or more, and where gyros heard it all: by as much
        from what they felt, and by five times what they usually miss; elsewhere: by more than an angular acceleration
        of 6000 deg/s^2 can make.

    Notes
    -----
    By the attitude alone a reset of 3 deg is found at 50 Hz and above; at 10 Hz an aircraft may turn by 60 deg in an
    interval that it did not turn by before, and only the gyros tell.  A flying wing at 200 deg/s and a vibrating
    quadrotor stay under two thirds of 6000 deg/s^2.
    """
    t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
    step_s = np.diff(t)
    departure_rad = _departures(step_s, q)
    # In a silence an aircraft may turn as it likes.
    suspect: Mask = (departure_rad > _LEAST_RESET_RAD) & (step_s < _USUAL_INTERVALS * np.median(step_s))
    unfelt: Mask = suspect & (departure_rad > _FASTEST_CHANGE_RAD_PER_S2 * step_s**2)
    if rate_t_s is None or rate_rad_per_s is None or not suspect.any():
        return unfelt
    rate_t, rate = _sound_rates(rate_t_s, rate_rad_per_s)
    if rate_t.size < 2:
        return unfelt
    gyro = GyroTrack.of(rate_t, rate)
    gyro = replace(gyro, t_s=gyro.t_s - _lag_s(t, q, gyro, np.ones(t.size - 1, dtype=np.bool_)))
    heard = gyro.covers(t)
    miss_rad = _misses(t, q, gyro)
    usual_rad = _spread(np.linalg.norm(miss_rad[heard], axis=-1))
    limit_rad = np.maximum(max(_LEAST_RESET_RAD, _RESET_SPREADS * usual_rad), _FASTEST_DRIFT_RAD_PER_S * step_s)
    # Of what is missed for long, as in a steep spiral, the neighbours miss as much: that is no jump.
    outer = np.zeros((1, 3))
    others = (outer, np.concatenate((outer, miss_rad[:-1])), np.concatenate((miss_rad[1:], outer)))
    jump_rad = np.minimum.reduce([np.linalg.norm(miss_rad - other, axis=-1) for other in others])
    found: Mask = np.where(heard, suspect & (jump_rad > limit_rad), unfelt)
    return found


def _departures(step_s: Float, q: Float) -> Float:
    """Return by what each turn departs from both of its neighbours, (n - 1,), rad; 0 for small turns and the ends."""
    departure = np.zeros(step_s.size)
    cosine = np.abs(np.einsum("ij,ij->i", q[1:], q[:-1]))
    large = 1 + np.flatnonzero(cosine[1:-1] < np.cos(_LEAST_RESET_RAD / 2))
    if not large.size:
        return departure
    turn_rad = _turns(q[large], q[large + 1])
    # From the nearer neighbour: what is beside a reset departs from that alone, and so does the onset of a manoeuvre.
    # A stamp may be wrong while the turn is right: the usual interval counts as well.
    steps = (step_s[large, np.newaxis], np.median(step_s))
    rates = [_turns(q[k], q[k + 1]) / step_s[k, np.newaxis] for k in (large - 1, large + 1)]
    ways = [np.linalg.norm(turn_rad - h * rate, axis=-1) for rate in rates for h in steps]
    departure[large] = np.minimum.reduce(ways)
    return departure


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


def _cubic(step_s: Float, turn_rad: Float, begin: Float, end: Float) -> Float:
    """Return the coefficients of rotation vectors that begin and end with the given changes, rad/s."""
    h = step_s[:, np.newaxis]
    mean = turn_rad / h
    return np.stack([begin, (3 * mean - 2 * begin - end) / h, (begin + end - 2 * mean) / h**2], axis=-2)


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
    half = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    matrix: Float = np.eye(3) - _scaled(half, cross) + _scaled(_third(angle), cross @ cross)
    return matrix


def _vector_of_rate(turn_rad: Float) -> Float:
    """Return the matrices that make the change of a rotation vector of the body's rate."""
    angle = np.linalg.norm(turn_rad, axis=-1)
    cross = _cross(turn_rad)
    small = angle < _SERIES_RAD
    safe = np.where(small, 1.0, angle)
    square = angle * angle
    factor = np.where(small, 1 / 12 + square / 720 + square**2 / 30240, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    matrix: Float = np.eye(3) + cross / 2 + _scaled(factor, cross @ cross)
    return matrix


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
    first = np.where(small, -1 / 12 + square / 180 - square**2 / 6720, (x * np.sin(x) + 2 * np.cos(x) - 2) / x**4)
    second = np.where(
        small, -1 / 60 + square / 1260 - square**2 / 60480, (3 * np.sin(x) - x * np.cos(x) - 2 * x) / x**5
    )
    along = np.sum(turn_rad * change, axis=-1)
    once = np.cross(turn_rad, change)
    bend: Float = (
        -(along * first)[:, np.newaxis] * once
        + (along * second)[:, np.newaxis] * np.cross(turn_rad, once)
        + _third(angle)[:, np.newaxis] * np.cross(change, once)
    )
    return bend


def _cross(v: Float) -> Float:
    """Return the (n, 3, 3) matrices of the cross product by each of some vectors."""
    matrix = np.zeros((len(v), 3, 3))
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    skew: Float = matrix - matrix.transpose(0, 2, 1)
    return skew


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
            inverse = _inverse(diagonal[1::2])
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
        return cls(tuple(levels), _inverse(diagonal))

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


def _inverse(blocks: Float) -> Float:
    return np.asarray(np.linalg.inv(blocks), dtype=np.float64)


def _odd(blocks: Float) -> Float:
    """Return blocks in an odd number: with one of zeros more, if need be."""
    return blocks if len(blocks) % 2 else np.concatenate((blocks, np.zeros_like(blocks[:1])))
