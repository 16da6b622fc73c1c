"""Turns of the estimator that no aircraft has made."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.flight.gyroaided import USUAL_INTERVALS, GyroTrack
from glstar.rotation import turn_between
from glstar.statistics import robust_std

__all__ = ["unfelt_turns"]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# An estimator's reset that is worth a gap: 1.5 deg is 100 px at f = 3871 px.
_LEAST_RESET_RAD: Final = np.deg2rad(1.5)
_RESET_SPREADS: Final = 5
# What gyros miss of a spiral at 180 deg/s changes by less from sample to sample; at 10 Hz 2.5 deg.
_FASTEST_DRIFT_RAD_PER_S: Final = np.deg2rad(25.0)
# See `unfelt_turns`.
_FASTEST_CHANGE_RAD_PER_S2: Final = np.deg2rad(6000.0)


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
    suspect: Mask = (departure_rad > _LEAST_RESET_RAD) & (step_s < USUAL_INTERVALS * np.median(step_s))
    unfelt: Mask = suspect & (departure_rad > _FASTEST_CHANGE_RAD_PER_S2 * step_s**2)
    if rate_t_s is None or rate_rad_per_s is None or not suspect.any():
        return unfelt
    readings = GyroTrack.of_readings(rate_t_s, rate_rad_per_s)
    if readings is None:
        return unfelt
    gyro = readings.in_step_with(t, q, np.ones(t.size - 1, dtype=np.bool_))
    heard = gyro.covers(t)
    miss_rad = gyro.misses(t, q)
    usual_rad = robust_std(np.linalg.norm(miss_rad[heard], axis=-1))
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
    turn_rad = turn_between(q[large], q[large + 1])
    # From the nearer neighbour: what is beside a reset departs from that alone, and so does the onset of a manoeuvre.
    # A stamp may be wrong while the turn is right: the usual interval counts as well.
    steps = (step_s[large, np.newaxis], np.median(step_s))
    rates = [turn_between(q[k], q[k + 1]) / step_s[k, np.newaxis] for k in (large - 1, large + 1)]
    ways = [np.linalg.norm(turn_rad - h * rate, axis=-1) for rate in rates for h in steps]
    departure[large] = np.minimum.reduce(ways)
    return departure
