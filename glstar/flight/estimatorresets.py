"""Detection of estimator resets: turns in the logged attitude that the aircraft did not make."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.flight.gyroaided import DATA_GAP_INTERVALS, GyroTrack
from glstar.rotation import turn_between
from glstar.statistics import robust_std

__all__ = ["estimator_resets"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class _Thresholds:
    """Thresholds of the detection.

    Attributes
    ----------
    least_reset_rad : float
        Smallest reset that is worth a gap: 1.5 deg is 100 px at f = 3871 px.
    largest_acceleration_rad_per_s2 : float
        Without gyros, a larger change of the turn rate is a reset.  A flying wing at 200 deg/s and a vibrating
        quadrotor stay below two thirds of it.
    gyro_sigma : float
        With gyros, a reset exceeds this many standard deviations of the usual difference between gyros and attitude.
    gyro_drift_rad_per_s : float
        With gyros, a smaller difference per second may be integration error: 2.5 deg per sample at 10 Hz in a spiral at
        180 deg/s.
    """

    least_reset_rad: float = float(np.deg2rad(1.5))
    largest_acceleration_rad_per_s2: float = float(np.deg2rad(6000.0))
    gyro_sigma: float = 5.0
    gyro_drift_rad_per_s: float = float(np.deg2rad(25.0))


_LIMITS: Final = _Thresholds()


def estimator_resets(
    t_s: ArrayLike,
    q_body_ned: ArrayLike,
    rate_t_s: ArrayLike | None = None,
    rate_rad_per_s: ArrayLike | None = None,
) -> Mask:
    """Return in which intervals between samples the estimator was reset without a message in the log.

    Parameters
    ----------
    t_s : (n,) array_like, n >= 2
        Times of the attitudes, s, strictly increasing.
    q_body_ned : (n, 4) array_like
        Unit quaternions (w, x, y, z).
    rate_t_s, rate_rad_per_s : (m,) and (m, 3) array_like, optional
        Gyro readings, if there are any; see `gyro_aided`.

    Returns
    -------
    (n - 1,) bool
        True where a turn differs from both of its neighbours by 1.5 deg or more and, where gyro readings cover it,
        differs as much from the integrated rates, and by five times the usual difference.  Without gyro readings the
        turn must imply an angular acceleration of more than 6000 deg/s^2.

    Notes
    -----
    Without gyros a reset of 3 deg is detected at 50 Hz and above.  At 10 Hz an aircraft can start a turn of 60 deg
    within one interval, so only the gyros can distinguish a reset from a manoeuvre.
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
    found: Mask = np.where(covered, suspect & (jump_rad > limit_rad), too_fast)
    return found


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
