"""Removal of damaged samples: times, positions and rates that no flight has."""

import numpy as np
from numpy.typing import NDArray

from glstar.sky.site import HEIGHTS_M
from glstar.telemetry.source import PositionSamples

__all__ = [
    "UNIT_TOLERANCE",
    "YEAR_2010_S",
    "YEAR_2100_S",
    "is_zero_position",
    "no_position_samples",
    "position_samples",
    "quaternion_lengths",
    "spikes",
    "valid_rare_times",
    "valid_rates",
    "valid_times",
]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Largest deviation of the norm of a quaternion from 1: rounding to float32 gives 1e-6, damage more than 1 %.
UNIT_TOLERANCE = 0.01
# Dates outside these years are wrong, UTC seconds since 1970: a receiver whose 10-bit week number has rolled over
# reports a date 19.6 years ago, one without a fix reports 1980 or 1970.
YEAR_2010_S = 1262304000.0
YEAR_2100_S = 4102444800.0

# A sample that differs this much from the median of itself and its two neighbours is damaged.
_CLOCK_SPIKE_S = 1.0
_POSITION_SPIKE_DEG = 0.01
# Positions this close to 0 N 0 E mean that there is no fix, deg: an estimator without an origin drifts by some metres.
_ZERO_POSITION_DEG = 0.001
# Gyros of autopilots measure up to 2000 deg/s, some up to 4000 deg/s.
_MAX_GYRO_RATE_RAD_PER_S = np.deg2rad(5000.0)
# Times this far from the median belong to no flight: a month, s.
_MAX_DURATION_S = 30 * 86400.0


def spikes(values: Float, limit: float) -> Mask:
    """Return which values differ from the median of themselves and their two neighbours by more than a limit.

    Parameters
    ----------
    values : (n,) float64
    limit : float
        Largest difference, in the unit of the values.

    Returns
    -------
    (n,) bool
    """
    if values.size < 3:
        return np.zeros(values.size, dtype=bool)
    neighbours = np.lib.stride_tricks.sliding_window_view(values, 3)
    middle = np.median(neighbours, axis=-1)
    with np.errstate(invalid="ignore"):  # infinity minus infinity
        spike: Mask = np.abs(values - np.concatenate([middle[:1], middle, middle[-1:]])) > limit
    return spike


def valid_times(clock_s: Float) -> Mask:
    """Return which times of a log are valid.

    Parameters
    ----------
    clock_s : (n,) float64
        Times in the order of the log, s.

    Returns
    -------
    (n,) bool
        False for times that are not finite, that are spikes, or that differ from the median by a month or more.
    """
    return valid_rare_times(clock_s) & ~spikes(clock_s, _CLOCK_SPIKE_S)


def valid_rare_times(clock_s: Float) -> Mask:
    """Return which times of rare events, with any intervals, are valid.

    Parameters
    ----------
    clock_s : (n,) float64
        Times in the order of the log, s.

    Returns
    -------
    (n,) bool
        False for times that are not finite, or that differ from the median by a month or more.
    """
    finite = np.isfinite(clock_s)
    if not finite.any():
        return finite
    near: Mask = np.abs(clock_s - np.median(clock_s[finite])) < _MAX_DURATION_S
    return finite & near


def position_samples(
    clock_s: Float, latitude_deg: Float, longitude_deg: Float, height_m: Float, source: str
) -> PositionSamples:
    """Return the valid positions of a log.

    Parameters
    ----------
    clock_s, latitude_deg, longitude_deg, height_m : (n,) float64
        Samples in the order of the log; s, deg, m.
    source : str
        Where they come from, for messages.

    Returns
    -------
    PositionSamples
    """
    with np.errstate(invalid="ignore"):
        valid = (np.abs(latitude_deg) <= 90) & (np.abs(longitude_deg) <= 180)
        valid &= (height_m >= HEIGHTS_M[0]) & (height_m <= HEIGHTS_M[1])
        valid &= ~is_zero_position(latitude_deg, longitude_deg)
    valid &= valid_times(clock_s)
    valid &= ~spikes(latitude_deg, _POSITION_SPIKE_DEG) & ~spikes(longitude_deg, _POSITION_SPIKE_DEG)
    return PositionSamples(
        clock_s[valid], np.deg2rad(latitude_deg[valid]), np.deg2rad(longitude_deg[valid]), height_m[valid], source
    )


def is_zero_position(latitude_deg: Float, longitude_deg: Float) -> Mask:
    """Return which positions are 0 N 0 E, as receivers without a fix report.

    Parameters
    ----------
    latitude_deg, longitude_deg : (n,) float64

    Returns
    -------
    (n,) bool
        Within 0.001 deg.
    """
    with np.errstate(invalid="ignore"):
        mask: Mask = (np.abs(latitude_deg) <= _ZERO_POSITION_DEG) & (np.abs(longitude_deg) <= _ZERO_POSITION_DEG)
    return mask


def quaternion_lengths(q: Float) -> Float:
    """Return the lengths of quaternions, among them damaged ones.

    Parameters
    ----------
    q : (..., 4) float64

    Returns
    -------
    (...) float64
        Infinite where the square of a component has no float64.
    """
    with np.errstate(over="ignore"):
        return np.asarray(np.linalg.norm(q, axis=-1))


def no_position_samples(source: str) -> PositionSamples:
    """Return an empty batch of positions.

    Parameters
    ----------
    source : str
        Why there are none, for messages.

    Returns
    -------
    PositionSamples
    """
    nothing = np.empty(0)
    return PositionSamples(nothing, nothing, nothing, nothing, source)


def valid_rates(rate_rad_per_s: Float) -> Mask:
    """Return which gyro rates are valid.

    Parameters
    ----------
    rate_rad_per_s : (n, 3) float64
        Turn rates, rad/s.

    Returns
    -------
    (n,) bool
        False for rates that are not finite, or exceed the range of autopilot gyros.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        valid: Mask = (np.abs(rate_rad_per_s) < _MAX_GYRO_RATE_RAD_PER_S).all(axis=-1)
    return valid
