"""Attitude between the samples of a log, from integrated gyro rates."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float, Mask, robust_std
from glstar.flight.spline import RotationSpline, apply, cubic, vector_of_rate
from glstar.rotation import (
    conjugate,
    fitted_rotation,
    matrix_from_quaternion,
    multiply,
    quaternion_from_turn,
    slerp,
    turn_between,
    turn_from_matrix,
)

# Two successive gyro readings with an interval above this many median intervals are separated by a data gap.
DATA_GAP_INTERVALS = 3
# Largest lag of gyro timestamps, s: half a sample interval, filters and the queue of the logger add up to less.
_MAX_LAG_S = 0.1
# A lag is applied if it exceeds this many standard deviations.
_LAG_SIGMA = 5
# Rounds of the fit of the lag, and of its rejection of outliers.
_LAG_ROUNDS = 3
# Number of attitudes from which the lag is estimated: enough for a standard deviation of about 0.01 ms.
_LAG_SAMPLES = 50_000
# Autopilot gyros measure up to 2000 deg/s; a faster reading is damaged, rad/s.
_MAX_RATE_RAD_PER_S = np.deg2rad(3000.0)
# A reading that differs this much from both neighbours is damaged, rad/s.
_SPIKE_RAD_PER_S = np.deg2rad(300.0)
# A reading closer to an attitude sample than this fraction of the gyro interval is skipped: it adds no information,
# and the rounding of UTC would become a turn rate.
_LEAST_DISTANCE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class GyroTrack:
    """Integrated gyro rates: the attitude relative to an unknown initial one."""

    t_s: Float  # (n,) n >= 2: times of the readings, s, strictly increasing
    rate_rad_per_s: Float  # (n, 3) turn rates about the body axes, rad/s
    turn_rad: Float  # (n - 1, 3) rotation vector from each reading to the next, rad
    q_body_start: Float  # (n, 4) attitude relative to that at the first reading
    is_gap: Mask  # (n - 1,) bool: intervals that are data gaps

    @classmethod
    def from_readings(cls, t_s: ArrayLike, rate_rad_per_s: ArrayLike) -> Self | None:
        """Integrate the readings of a log that are valid (see `gyro_aided`); None if there are fewer than two."""
        t, rate = _valid_readings(t_s, rate_rad_per_s)
        return cls.from_rates(t, rate) if t.size > 1 else None

    @classmethod
    def from_rates(cls, t_s: Float, rate_rad_per_s: Float) -> Self:
        """Integrate turn rates about the body axes, (n, 3) rad/s, at strictly increasing times, (n,) s, n >= 2.

        The rate between two readings is a cubic polynomial through four readings.  Coning is corrected to second order:
        P. G. Savage, "Strapdown inertial navigation integration algorithm design part 1", J. Guid. Control Dyn. 21,
        1998, eqs (31), (32), for a rate that changes linearly.
        """
        h = np.diff(t_s)[:, np.newaxis]
        before, after = rate_rad_per_s[:-1], rate_rad_per_s[1:]
        curvature = np.zeros_like(rate_rad_per_s)
        slope = (after - before) / h
        # With uneven steps the second difference is mostly noise.
        even = (h[1:] < 2 * h[:-1]) & (h[:-1] < 2 * h[1:])
        curvature[1:-1] = np.where(even, 2 * (slope[1:] - slope[:-1]) / (h[1:] + h[:-1]), 0.0)
        bends = h**3 / 24 * (curvature[:-1] + curvature[1:])
        turn = h * (before + after) / 2 - bends + h**2 / 12 * np.cross(before, after)
        is_gap = h[:, 0] > DATA_GAP_INTERVALS * np.median(h)
        return cls(t_s, rate_rad_per_s, turn, _cumulative_product(quaternion_from_turn(turn)), is_gap)

    def at(self, t_s: Float) -> Float:
        """Return the attitudes relative to that at the first reading, (m, 4); times are clipped to the track."""
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        before = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, self.t_s.size - 2)
        h = (self.t_s[before + 1] - self.t_s[before])[:, np.newaxis]
        u = (t - self.t_s[before])[:, np.newaxis] / h
        turn, rate, last = self.turn_rad[before], self.rate_rad_per_s[before], self.rate_rad_per_s[before + 1]
        # Cubic Hermite interpolation of the rotation vector, with the rates at both ends.
        last = last + np.cross(turn, last) / 2
        part = turn * u**2 * (3 - 2 * u) + h * u * (1 - u) * (rate * (1 - u) - last * u)
        return multiply(quaternion_from_turn(part), self.q_body_start[before])

    def rates_at(self, t_s: Float) -> Float:
        """Return the turn rates, interpolated linearly, (m, 3), rad/s."""
        return np.stack([np.interp(t_s, self.t_s, rate) for rate in self.rate_rad_per_s.T], axis=-1)

    def covers(self, t_s: Float) -> Mask:
        """Return which intervals between the given times have no data gap of the gyros, (m - 1,)."""
        gaps_before = np.concatenate(([0], np.cumsum(self.is_gap)))
        index = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, None)
        after = np.clip(np.searchsorted(self.t_s, t_s, side="left"), None, self.t_s.size - 1)
        inside = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1])
        return np.asarray(inside[:-1] & inside[1:] & (gaps_before[after[1:]] == gaps_before[index[:-1]]))

    def residuals(self, t_s: Float, q_body_ned: Float) -> Float:
        """Return the logged turn minus the integrated turn of each interval, rotation vectors (m - 1, 3), rad."""
        integrated = self.at(t_s)
        predicted = multiply(multiply(integrated[1:], conjugate(integrated[:-1])), q_body_ned[:-1])
        return turn_between(predicted, q_body_ned[1:])

    def synchronised_with(self, t_s: Float, q_body_ned: Float, unbroken: Mask) -> Self:
        """Return the track without the lag of its timestamps relative to the attitudes; see `gyro_lag_s`."""
        return replace(self, t_s=self.t_s - _lag_s(t_s, q_body_ned, self, unbroken))


def gyro_aided(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike,
    rate_rad_per_s: ArrayLike,
    *,
    broken: ArrayLike | None = None,
) -> RotationSpline:
    """Interpolate attitude with gyro rates: the result has a sample at every gyro reading.

    Between two attitude samples, which are kept, the rates are integrated.  The difference between the integrated and
    the logged turn, caused by gyro drift and by corrections of the estimator, is distributed linearly over the
    interval.  The curve's rates at the samples are the gyros' rates.

    - `t_s` (n,) n >= 2: times of the attitudes, s, strictly increasing.
    - `q_body_ned` (n, 4): unit quaternions (w, x, y, z).
    - `rate_t_s` (m,): times of the readings, s, by the same clock, in any order.
    - `rate_rad_per_s` (m, 3): turn rates about the body axes forward, right, down, rad/s.  Readings that are not
      finite, faster than 3000 deg/s, or more than 300 deg/s away from both neighbours are dropped.
    - `broken` (n - 1,) bool: intervals between attitudes that are gaps: no samples are added there.

    Timestamps of gyros may lag behind the attitude's, by 9.8 ms in a log at 50 Hz, which increases the error
    fourfold; the lag is estimated and removed (`gyro_lag_s`).  Where the gyros have a data gap of three intervals or
    more, no samples are added and the curve is `RotationSpline.through` the attitudes.
    """
    t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
    spline = RotationSpline.through(t, q, broken=broken)
    readings = GyroTrack.from_readings(rate_t_s, rate_rad_per_s)
    if readings is None:
        return spline
    unbroken = _unbroken(t, broken)
    gyro = readings.synchronised_with(t, q, unbroken)
    covered = unbroken & gyro.covers(t)
    # Logged attitude minus integrated attitude at the samples; it changes linearly in between.
    drift = multiply(conjugate(gyro.at(t)), q)
    all_t, all_q = _with_readings(t, q, gyro, covered, drift)

    segment = np.clip(np.searchsorted(t, all_t[:-1], side="right") - 1, 0, t.size - 2)
    # The rates at both ends of each interval: those of the gyros, plus the rate at which the drift changes.
    drift_rate = (turn_between(drift[:-1], drift[1:]) / np.diff(t)[:, np.newaxis])[segment]
    to_body, rate = matrix_from_quaternion(gyro.at(all_t)), gyro.rates_at(all_t)
    begin, end = (apply(to_body[k], drift_rate) + rate[k] for k in (slice(-1), slice(1, None)))
    step_s, turn_rad = np.diff(all_t), turn_between(all_q[:-1], all_q[1:])
    aided = cubic(step_s, turn_rad, begin, apply(vector_of_rate(turn_rad), end))
    coefficients = np.where(covered[segment][:, np.newaxis, np.newaxis], aided, spline.coefficients[segment])
    return RotationSpline(all_t, all_q, coefficients)


def _with_readings(t: Float, q: Float, gyro: GyroTrack, covered: Mask, drift: Float) -> tuple[Float, Float]:
    """Return times and attitudes of the samples, and of the gyro readings between samples that the gyros cover."""
    before = np.searchsorted(t, gyro.t_s, side="right") - 1
    inside = (before >= 0) & (before < t.size - 1)
    inside[inside] = covered[before[inside]]
    near_s = _LEAST_DISTANCE * np.median(np.diff(gyro.t_s))
    inside[inside] = (gyro.t_s[inside] - t[before[inside]] > near_s) & (
        t[before[inside] + 1] - gyro.t_s[inside] > near_s
    )
    new_t, before = gyro.t_s[inside], before[inside]
    part = (new_t - t[before]) / (t[before + 1] - t[before])
    new_q = multiply(gyro.q_body_start[inside], slerp(drift[before], drift[before + 1], part))
    all_t, all_q = np.concatenate((t, new_t)), np.concatenate((q, new_q))
    order = np.argsort(all_t, kind="stable")
    return all_t[order], all_q[order]


def gyro_lag_s(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike,
    rate_rad_per_s: ArrayLike,
    *,
    broken: ArrayLike | None = None,
) -> float:
    """Estimate the lag of gyro timestamps behind attitude timestamps, s; parameters as for `gyro_aided`.

    It is 0 if less than five times its standard deviation, or more than 0.1 s.  Between two samples with rates w1 and
    w2 a lag of L s leaves a residual turn of L (w2 - w1), and a bias b leaves b (t2 - t1).  Both are fitted to the
    residuals by least squares, with rejection of outliers.
    """
    t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
    gyro = GyroTrack.from_readings(rate_t_s, rate_rad_per_s)
    return 0.0 if gyro is None else _lag_s(t, q, gyro, _unbroken(t, broken))


def _unbroken(t: Float, broken: ArrayLike | None) -> Mask:
    """Return which intervals between attitudes are not gaps, (n - 1,)."""
    return np.ones(t.size - 1, dtype=np.bool_) if broken is None else ~np.asarray(broken, dtype=np.bool_)


def _lag_s(t: Float, q: Float, gyro: GyroTrack, unbroken: Mask) -> float:
    """Return the lag of integrated gyro rates, s; see `gyro_lag_s`."""
    t, q, unbroken = t[:_LAG_SAMPLES], q[:_LAG_SAMPLES], unbroken[: _LAG_SAMPLES - 1]
    lag_s = 0.0
    for _ in range(_LAG_ROUNDS):
        correction_s, sigma_s = _fit_lag(t + lag_s, q, gyro, unbroken & gyro.covers(t + lag_s))
        if not abs(lag_s + correction_s) < _MAX_LAG_S or not abs(lag_s + correction_s) > _LAG_SIGMA * sigma_s:
            return 0.0
        lag_s += correction_s
    return lag_s


def _fit_lag(t: Float, q: Float, gyro: GyroTrack, usable: Mask) -> tuple[float, float]:
    """Return the remaining lag and its standard deviation, s; (0, inf) if the turns do not determine it."""
    residual = gyro.residuals(t, q)[usable]
    step_s, change = np.diff(t)[usable], np.diff(gyro.rates_at(t), axis=0)[usable]
    columns = np.zeros((*residual.shape, 4))
    columns[:, range(3), range(3)] = step_s[:, np.newaxis]
    columns[:, :, 3] = change
    design = columns.reshape(-1, 4)
    turn = residual.reshape(-1)
    use = np.ones(turn.size, dtype=np.bool_)
    for _ in range(_LAG_ROUNDS):
        normal = design[use].T @ design[use]
        if use.sum() <= design.shape[1] or np.linalg.matrix_rank(normal) < design.shape[1]:
            return 0.0, np.inf
        fit = np.linalg.solve(normal, design[use].T @ turn[use])
        deviation = np.abs(turn - design @ fit)
        sigma = robust_std(deviation)
        use = deviation <= 4 * sigma
    return float(fit[3]), float(sigma * np.sqrt(np.linalg.inv(normal)[3, 3]))


def _valid_readings(t_s: ArrayLike, rate_rad_per_s: ArrayLike) -> tuple[Float, Float]:
    """Return the readings that are not damaged, sorted by time."""
    t = np.asarray(t_s, dtype=np.float64)
    rate = np.asarray(rate_rad_per_s, dtype=np.float64).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        valid = np.isfinite(t) & (np.abs(rate) < _MAX_RATE_RAD_PER_S).all(axis=-1)
    t, first = np.unique(t[valid], return_index=True)
    rate = rate[valid][first]
    if t.size > 2:
        middle = np.median(np.lib.stride_tricks.sliding_window_view(rate, 3, axis=0), axis=-1)
        spike = np.zeros(t.size, dtype=np.bool_)
        spike[1:-1] = (np.abs(rate[1:-1] - middle) > _SPIKE_RAD_PER_S).any(axis=-1)
        t, rate = t[~spike], rate[~spike]
    return t, rate


def _cumulative_product(q: Float) -> Float:
    """Return the products of the first 0, 1, 2 ... quaternions, later ones on the left; (n + 1, 4), normalised."""
    # In rows of sqrt(n) quaternions: the products along all rows at once, then the products of the rows.
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
    return np.asarray(products / np.linalg.norm(products, axis=-1, keepdims=True))


# Attitudes and gyros are compared over at least this time: long enough for the noise of attitudes, s.
_COMPARED_S = 0.5
# Largest difference between the turn rates of attitudes and gyros: constant, and varying beside a fraction of the rate,
# rad/s; a constant one is corrected at each attitude.
_MAX_BIAS_RAD_PER_S = np.deg2rad(1.0)
_MAX_DIFFERENCE_RAD_PER_S, _MAX_DIFFERENCE = np.deg2rad(0.2), 0.2
# Least part of the turns about a second axis that determines the rotation between two sensors.
_SECOND_AXIS = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class GyroAlignment:
    """Whether gyros turn as an attitude does, and the constant rotation between their axes."""

    C_body_gyro: Float | None  # (3, 3) from the axes of the gyros to those of the attitude; None if they do not agree
    residual_deg_per_s: float  # Root mean square of the difference between the rates, without that rotation

    @property
    def angle_deg(self) -> float:
        """The angle of the rotation; 0 without one."""
        return (
            0.0 if self.C_body_gyro is None else float(np.rad2deg(np.linalg.norm(turn_from_matrix(self.C_body_gyro))))
        )

    @classmethod
    def of(cls, t_s: Float, q_body_ned: Float, gyro_t_s: Float, rate_rad_per_s: Float) -> Self | None:
        """Compare attitudes (n, 4) at (n,) s with rates (m, 3) rad/s at (m,) s; None if they share no time.

        A rotation is only accepted if the aircraft turns about two axes, so that it is determined.
        """
        turned, measured = _mean_rates(t_s, q_body_ned, gyro_t_s, rate_rad_per_s)
        if not turned.size:
            return None
        difference = turned - measured
        residual = float(np.sqrt((difference**2).sum(axis=-1).mean()))
        C_body_gyro, scatter = np.eye(3), _scatter(difference)
        about = np.linalg.svd(measured, compute_uv=False)
        if about.size > 1 and about[1] > _SECOND_AXIS * about[0]:
            fitted = fitted_rotation(measured, turned)
            rotated = _scatter(turned - measured @ fitted.T)
            if rotated < scatter / 2 and scatter > _MAX_DIFFERENCE_RAD_PER_S:
                C_body_gyro, scatter, difference = fitted, rotated, turned - measured @ fitted.T
        allowed = _MAX_DIFFERENCE_RAD_PER_S + _MAX_DIFFERENCE * float(np.sqrt((turned**2).sum(axis=-1).mean()))
        agrees = scatter < allowed and np.linalg.norm(difference.mean(axis=0)) < _MAX_BIAS_RAD_PER_S
        return cls(C_body_gyro if agrees else None, np.rad2deg(residual))


def _scatter(difference: Float) -> float:
    """Return the root mean square of differences, (n, 3), about their mean."""
    return float(np.sqrt(((difference - difference.mean(axis=0)) ** 2).sum(axis=-1).mean()))


def _mean_rates(t_s: Float, q_body_ned: Float, gyro_t_s: Float, rate: Float) -> tuple[Float, Float]:
    """Return mean rates (k, 3), rad/s, by attitudes and by gyros over the same intervals of at least `_COMPARED_S`."""
    t_s, first = np.unique(t_s, return_index=True)
    gyro = GyroTrack.from_readings(gyro_t_s, rate)
    if t_s.size < 2 or gyro is None:
        return np.empty((0, 3)), np.empty((0, 3))
    step_s, integrated = np.diff(t_s), gyro.at(t_s)
    usable = (step_s < DATA_GAP_INTERVALS * np.median(step_s)) & gyro.covers(t_s)
    if not usable.any():
        return np.empty((0, 3)), np.empty((0, 3))
    step_s, q = step_s[usable], q_body_ned[first]
    turned, measured = (turn_between(every[:-1], every[1:])[usable] for every in (q, integrated))
    starts = np.arange(0, step_s.size, max(1, int(np.ceil(_COMPARED_S / np.median(step_s)))))
    length_s = np.add.reduceat(step_s, starts)[:, np.newaxis]
    return np.add.reduceat(turned, starts) / length_s, np.add.reduceat(measured, starts) / length_s
