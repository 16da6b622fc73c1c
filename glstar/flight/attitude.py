"""The attitude of an aircraft over UTC, interpolated between the samples of a log.

An autopilot logs its attitude 10 to 50 times a second; an exposure evaluates it 200 times a second.  An `AttitudeTrack`
holds the logged quaternions and interpolates between them.  Where the log has a data gap, or the estimator was reset
(`estimator_resets`: turns that the aircraft did not make), the track has a `Gap`.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from glstar.arrays import Float, Integer, Mask, robust_std
from glstar.errors import TelemetryError, TrackRangeError
from glstar.flight.gyroaided import DATA_GAP_INTERVALS, GyroTrack, gyro_aided
from glstar.flight.spline import RotationSpline
from glstar.rotation import slerp, turn_between
from glstar.sky.place.timescale import CLOCK_GRAIN_S


@dataclass(frozen=True, slots=True)
class _Thresholds:
    """Thresholds of `estimator_resets`."""

    # Smallest reset that is worth a gap: 1.5 deg is 100 px at f = 3871 px.
    least_reset_rad: float = float(np.deg2rad(1.5))
    # Without gyros, a larger change of the turn rate is a reset; a flying wing at 200 deg/s and a vibrating quadrotor
    # stay below two thirds of it.
    largest_acceleration_rad_per_s2: float = float(np.deg2rad(6000.0))
    # With gyros, a reset exceeds this many standard deviations of the usual difference between gyros and attitude.
    gyro_sigma: float = 5.0
    # With gyros, a smaller difference per second may be integration error: 2.5 deg per sample at 10 Hz in a spiral at
    # 180 deg/s.
    gyro_drift_rad_per_s: float = float(np.deg2rad(25.0))


_LIMITS = _Thresholds()


def estimator_resets(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike | None = None,
    rate_rad_per_s: ArrayLike | None = None,
) -> Mask:
    """Return in which intervals between samples the estimator was reset without a message in the log, (n - 1,) bool.

    - `t_s` (n,) n >= 2: times of the attitudes, s, strictly increasing.
    - `q_body_ned` (n, 4): unit quaternions (w, x, y, z).
    - `rate_t_s` (m,), `rate_rad_per_s` (m, 3): gyro readings, if there are any; see `gyro_aided`.

    A turn is a reset if it differs from both of its neighbours by 1.5 deg or more.  Where gyro readings cover it, it
    must also differ as much from the integrated rates, and by five times the usual difference.  Without gyro readings
    it must imply an angular acceleration of more than 6000 deg/s^2: a reset of 3 deg is detected at 50 Hz and above.
    At 10 Hz an aircraft can start a turn of 60 deg within one interval, so only the gyros can distinguish a reset from
    a manoeuvre.
    """
    t, q = np.asarray(t_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64)
    step_s = np.diff(t)
    departure_rad = _departures(step_s, q)
    # During a data gap the aircraft may have turned by any angle.
    suspect: Mask = (departure_rad > _LIMITS.least_reset_rad) & (step_s < DATA_GAP_INTERVALS * np.median(step_s))
    too_fast: Mask = suspect & (departure_rad > _LIMITS.largest_acceleration_rad_per_s2 * step_s**2)
    if rate_t_s is None or rate_rad_per_s is None or not suspect.any():
        return too_fast
    readings = GyroTrack.from_readings(rate_t_s, rate_rad_per_s)
    if readings is None:
        return too_fast
    gyro = readings.synchronised_with(t, q, np.ones(t.size - 1, dtype=np.bool_))
    covered = gyro.covers(t)
    residual_rad = gyro.residuals(t, q)
    usual_rad = robust_std(np.linalg.norm(residual_rad[covered], axis=-1))
    limit_rad = np.maximum(
        max(_LIMITS.least_reset_rad, _LIMITS.gyro_sigma * usual_rad), _LIMITS.gyro_drift_rad_per_s * step_s
    )
    # In a steep spiral the integration error persists: neighbouring intervals have it too.  A reset is one jump.
    zero = np.zeros((1, 3))
    neighbours = (zero, np.concatenate((zero, residual_rad[:-1])), np.concatenate((residual_rad[1:], zero)))
    jump_rad = np.minimum.reduce([np.linalg.norm(residual_rad - other, axis=-1) for other in neighbours])
    return np.asarray(np.where(covered, suspect & (jump_rad > limit_rad), too_fast))


def _departures(step_s: Float, q: Float) -> Float:
    """Return how much each turn differs from both of its neighbours, (n - 1,), rad; 0 for small turns and the ends."""
    departure = np.zeros(step_s.size)
    cosine = np.abs(np.einsum("ij,ij->i", q[1:], q[:-1]))
    large = 1 + np.flatnonzero(cosine[1:-1] < np.cos(_LIMITS.least_reset_rad / 2))
    if not large.size:
        return departure
    turn_rad = turn_between(q[large], q[large + 1])
    # The smaller difference counts: the neighbour of a reset differs from the reset only, and so does the first
    # interval of a manoeuvre.  A timestamp may be wrong although the turn is right: try the median interval as well.
    steps = (step_s[large, np.newaxis], np.median(step_s))
    rates = [turn_between(q[k], q[k + 1]) / step_s[k, np.newaxis] for k in (large - 1, large + 1)]
    differences = [np.linalg.norm(turn_rad - h * rate, axis=-1) for rate in rates for h in steps]
    departure[large] = np.minimum.reduce(differences)
    return departure


# Attitude between two samples: at a constant rate; along a cubic spline; from integrated gyro rates.
Interpolation = Literal["slerp", "spline", "gyro"]

# Reasons of gaps.
DATA_GAP = "a data gap"
JUMP = "a jump"

# By default a pause between samples is a gap if it is longer than this many median intervals, and longer than the
# timing jitter of any log, s.
_MAX_GAP_INTERVALS = 3
_LEAST_GAP_S = 0.1

# Aircraft turn slower than this, rad/s; an estimator that is reset turns faster.
_MAX_RATE_RAD_PER_S = np.deg2rad(3000.0)
# Two samples may have the same timestamp up to rounding: a turn of 1 deg is allowed in no time.
_JUMP_TOLERANCE_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, slots=True)
class Gap:
    """A part of a log across which attitude must not be interpolated."""

    start_utc_s: float  # Times of the samples before and after the gap, UTC seconds since 1970
    stop_utc_s: float
    reason: str  # ``"a data gap"``, ``"a jump"``, ``"a switch of the EKF lane"`` and so on, for messages

    @property
    def duration_s(self) -> float:
        """Length of the gap, s."""
        return self.stop_utc_s - self.start_utc_s


@dataclass(frozen=True, eq=False)
class AttitudeTrack:
    """Recorded attitude over UTC.

    Attributes
    ----------
    utc_s : (n,) float64, n >= 2
        Sample times, UTC seconds since 1970, strictly increasing.
    q_body_ned : (n, 4) float64
        Unit quaternions (w, x, y, z) that turn NED components into body ones.
    gaps : tuple of Gap
        Data gaps and jumps, sorted by time, without overlaps.
    interpolation : {"slerp", "spline", "gyro"}
        How `at` interpolates between two samples.  ``"slerp"``, as in the paper: the turn rate is constant.
        ``"spline"``: turn rate and angular acceleration are continuous (`RotationSpline`).  ``"gyro"``: the integrated
        gyro rates (`gyro_aided`), added by `from_samples`.  Within a gap the turn rate is constant in all three.

    Raises
    ------
    TelemetryError
        If the times do not increase, or there are fewer than two samples.
    """

    utc_s: Float
    q_body_ned: Float
    gaps: tuple[Gap, ...] = ()
    interpolation: Interpolation = "slerp"
    _curve: RotationSpline | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.utc_s.ndim != 1 or self.q_body_ned.shape != (self.utc_s.size, 4):
            raise TelemetryError(
                "an attitude track pairs (n,) times with (n, 4) quaternions,"
                f" not {self.utc_s.shape} with {self.q_body_ned.shape}"
            )
        if self.utc_s.size < 2:
            raise TelemetryError(f"an attitude track needs two samples or more, not {self.utc_s.size}")
        if not np.all(np.diff(self.utc_s) > 0):
            raise TelemetryError("the times of an attitude track must increase")
        if self.interpolation != "slerp" and self._curve is None:
            curve = RotationSpline.through(self.utc_s, self.q_body_ned, broken=_broken(self.utc_s, self.gaps))
            object.__setattr__(self, "_curve", curve)
        for array in (self.utc_s, self.q_body_ned):
            array.flags.writeable = False

    @classmethod
    def from_samples(
        cls,
        utc_s: ArrayLike,
        q_body_ned: ArrayLike,
        *,
        segment: ArrayLike | None = None,
        break_reason: str = "a reset of the estimator",
        max_gap_s: float | None = None,
        interpolation: Interpolation = "slerp",
        rates: tuple[ArrayLike, ArrayLike] | None = None,
    ) -> Self:
        """Return a track from samples as logged: unsorted, repeated, rounded.

        Parameters
        ----------
        utc_s : (n,) array_like
            Sample times, UTC seconds since 1970, in any order; of equal times the first is used.
        q_body_ned : (n, 4) array_like
            Quaternions (w, x, y, z), NED to body, of any norm but zero; samples that are not finite, or all zeros,
            are dropped.
        segment : (n,) array_like of int, optional
            Number of the contiguous segment of each sample; there is a gap between two segments.
        break_reason : str
            Why a new segment begins, for messages.
        max_gap_s : float, optional
            Longest data gap to interpolate across, s.  By default three median intervals, but at least 0.1 s.
            Boundaries of segments and jumps remain gaps: turns faster than 3000 deg/s, and resets of the estimator
            (`estimator_resets`).
        interpolation : {"slerp", "spline", "gyro"}
            See `AttitudeTrack`.
        rates : ((m,) array_like, (m, 3) array_like), optional
            Gyro readings: UTC seconds since 1970, and turn rates about the body axes forward, right, down, rad/s; see
            `gyro_aided`.  Readings help to detect resets of the estimator; ``"gyro"`` requires them.

        Returns
        -------
        AttitudeTrack

        Raises
        ------
        TelemetryError
            If fewer than two samples remain, or ``"gyro"`` is requested without rates.
        """
        if interpolation == "gyro" and rates is None:
            raise TelemetryError(
                'interpolation "gyro" needs the rates of gyros, and there are none; take "spline" (or "slerp")'
            )
        t, q, number = _valid_samples(utc_s, q_body_ned, segment)
        resets = estimator_resets(t, q, *(rates or ()))
        gaps = tuple(_gaps(t, q, number, resets, break_reason, max_gap_s))
        if interpolation == "gyro" and rates is not None:
            curve = gyro_aided(t, q, *rates, broken=_broken(t, gaps))
            return cls(curve.t_s, curve.q_body_ned, gaps, interpolation, curve)
        return cls(t, q, gaps, interpolation)

    @classmethod
    def joined(cls, tracks: Sequence[Self], reason: str) -> Self:
        """Concatenate tracks, with a gap between each two.

        Parameters
        ----------
        tracks : sequence of AttitudeTrack
            One or more with the same interpolation, sorted by time, without overlaps.
        reason : str
            Reason of the gaps between them.

        Returns
        -------
        AttitudeTrack
        """
        gaps = list(tracks[0].gaps)
        for before, after in pairwise(tracks):
            gaps += [Gap(before.last_s, after.first_s, reason), *after.gaps]
        curves = [curve for track in tracks if (curve := track._curve) is not None]  # noqa: SLF001 - of its own class
        return cls(
            np.concatenate([track.utc_s for track in tracks]),
            np.concatenate([track.q_body_ned for track in tracks]),
            tuple(gaps),
            tracks[0].interpolation,
            RotationSpline.joined(curves) if curves else None,
        )

    @property
    def first_s(self) -> float:
        """Time of the first sample, UTC seconds since 1970."""
        return float(self.utc_s[0])

    @property
    def last_s(self) -> float:
        """Time of the last sample, UTC seconds since 1970."""
        return float(self.utc_s[-1])

    @cached_property
    def rate_hz(self) -> float:
        """Sample rate: the inverse of the median interval, Hz."""
        return 1 / float(np.median(np.diff(self.utc_s)))

    def rates(self) -> tuple[Float, Float]:
        """Return the mean turn rate between consecutive samples.

        Returns
        -------
        utc_s : (m,) float64
            Midpoints between samples, UTC seconds since 1970, without gaps and without intervals shorter than half the
            median.
        rate_rad_per_s : (m, 3) float64
            Turn rates about the body axes forward, right, down, rad/s.
        """
        step_s = np.diff(self.utc_s)
        valid = step_s > np.median(step_s) / 2
        valid[np.searchsorted(self.utc_s, [gap.start_utc_s for gap in self.gaps])] = False
        middle_s = (self.utc_s[:-1] + step_s / 2)[valid]
        return middle_s, turn_between(self.q_body_ned[:-1], self.q_body_ned[1:])[valid] / step_s[valid, np.newaxis]

    def at(self, utc_s: ArrayLike) -> Float:
        """Return the attitude at each of the given times.

        Parameters
        ----------
        utc_s : (m,) array_like
            Times, UTC seconds since 1970.

        Returns
        -------
        (m, 4) float64
            Unit quaternions (w, x, y, z), NED to body.

        Raises
        ------
        TrackRangeError
            If a time is outside the track by more than a microsecond; attitude is never extrapolated.

        Notes
        -----
        Teague & Chahl, section 2.6, eq. (41), for ``"slerp"``.
        """
        t = np.asarray(utc_s, dtype=np.float64)
        inside = np.minimum(np.maximum(t, self.utc_s[0]), self.utc_s[-1])
        is_inside = np.abs(t - inside) <= CLOCK_GRAIN_S
        if not is_inside.all():
            raise TrackRangeError(float(t[~is_inside][0]), self.first_s, self.last_s)
        t = inside
        if self._curve is not None:
            return self._curve.at(t)

        # Index of the sample after each time, at least 1.
        after = np.maximum(self.utc_s.searchsorted(t), 1)
        before = after - 1
        before_s = self.utc_s.take(before)
        u = (t - before_s) / (self.utc_s.take(after) - before_s)
        return slerp(self.q_body_ned.take(before, axis=0), self.q_body_ned.take(after, axis=0), u)

    def gap_within(self, start_utc_s: float, stop_utc_s: float) -> Gap | None:
        """Return the longest gap that overlaps a time interval; None if there is none.

        Parameters
        ----------
        start_utc_s, stop_utc_s : float
            The interval, UTC seconds since 1970.

        Returns
        -------
        Gap or None
        """
        first = bisect_right(self.gaps, start_utc_s, key=lambda gap: gap.stop_utc_s)
        last = bisect_left(self.gaps, stop_utc_s, key=lambda gap: gap.start_utc_s)
        return max(self.gaps[first:last], key=lambda gap: gap.duration_s, default=None)

    def covers(self, utc_s: float) -> bool:
        """Return whether there is an attitude at a time: between the first and the last sample, and in no gap.

        Parameters
        ----------
        utc_s : float
            UTC, seconds since 1970.

        Returns
        -------
        bool
        """
        return bool(self.first_s <= utc_s <= self.last_s) and self.gap_within(utc_s, utc_s) is None

    def shifted(self, shift_s: float) -> Self:
        """Return the track with all times shifted.

        Parameters
        ----------
        shift_s : float
            Added to all times, s.

        Returns
        -------
        AttitudeTrack
        """
        gaps = tuple(Gap(gap.start_utc_s + shift_s, gap.stop_utc_s + shift_s, gap.reason) for gap in self.gaps)
        curve = None if self._curve is None else replace(self._curve, t_s=self._curve.t_s + shift_s)
        return replace(self, utc_s=self.utc_s + shift_s, gaps=gaps, _curve=curve)


def mean_rate_hz(t_s: Float) -> float:
    """Return the mean rate of samples at increasing times, (n,) s, without pauses that are data gaps, Hz.

    A scheduler may alternate intervals of 20 and 40 ms, whose median says 50 Hz for 40.
    """
    intervals_s = np.diff(t_s)
    counted = intervals_s[intervals_s <= max(_MAX_GAP_INTERVALS * float(np.median(intervals_s)), _LEAST_GAP_S)]
    return 1 / float(counted.mean())


def _valid_samples(utc_s: ArrayLike, q_body_ned: ArrayLike, segment: ArrayLike | None) -> tuple[Float, Float, Integer]:
    """Return times, unit quaternions and segment numbers of the valid samples, sorted by time."""
    t, q = np.asarray(utc_s, dtype=np.float64), np.asarray(q_body_ned, dtype=np.float64).reshape(-1, 4)
    number = np.zeros(t.shape, dtype=np.int64) if segment is None else np.asarray(segment)
    if t.shape != q.shape[:1] or number.shape != t.shape:
        raise TelemetryError(f"an attitude track pairs times with quaternions, not {t.size} with {len(q)}")
    norm = np.linalg.norm(q, axis=-1)
    valid = np.isfinite(t) & np.isfinite(norm) & (norm > 0)
    t, first = np.unique(t[valid], return_index=True)
    if t.size < 2:
        raise TelemetryError(f"an attitude track needs two samples or more, not {t.size}")
    return t, q[valid][first] / norm[valid][first, np.newaxis], number[valid][first]


def _broken(t: Float, gaps: tuple[Gap, ...]) -> Mask:
    """Return which intervals between samples are within a gap, (n - 1,)."""
    broken = np.zeros(t.size - 1, dtype=np.bool_)
    if gaps:
        starts = np.searchsorted(t, [gap.start_utc_s for gap in gaps])
        stops = np.searchsorted(t, [gap.stop_utc_s for gap in gaps])
        for start, stop in zip(starts, stops, strict=True):
            broken[start:stop] = True
    return broken


def _gaps(
    t: Float, q: Float, segment: Integer, resets: Mask, break_reason: str, max_gap_s: float | None
) -> Iterator[Gap]:
    """Yield the gaps between valid samples, sorted by time."""
    step_s = np.diff(t)
    if max_gap_s is None:
        max_gap_s = max(_LEAST_GAP_S, _MAX_GAP_INTERVALS * float(np.median(step_s)))
    turned_rad = np.linalg.norm(turn_between(q[:-1], q[1:]), axis=-1)
    breaks, paused = np.diff(segment) != 0, step_s > max_gap_s
    jumps = resets | (turned_rad > _MAX_RATE_RAD_PER_S * step_s + _JUMP_TOLERANCE_RAD)
    for k in np.flatnonzero(breaks | paused | jumps):
        reason = break_reason if breaks[k] else DATA_GAP if paused[k] else JUMP
        yield Gap(float(t[k]), float(t[k + 1]), reason)
