"""What of a damaged log is sound: samples that an aircraft can have meant."""

import numpy as np
from numpy.typing import NDArray

from glstar.sky.site import HEIGHTS_M
from glstar.telemetry.source import PositionSamples

__all__ = [
    "UNIT_TOLERANCE",
    "YEAR_2010_S",
    "YEAR_2100_S",
    "no_places",
    "nowhere",
    "places",
    "sound_rates",
    "sound_times",
    "spikes",
]

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A float32 quaternion is of unit length to a millionth.  What is a per cent off is a damaged record.
UNIT_TOLERANCE = 0.01
# A receiver whose ten-bit week has rolled over tells a date 19.6 years ago, one without a fix 1980 or 1970.
YEAR_2010_S = 1262304000.0
YEAR_2100_S = 4102444800.0

# A time or place that departs from both of its neighbours by more is a damaged record, not a flight.
_CLOCK_SPIKE_S = 1.0
_PLACE_SPIKE_DEG = 0.01
_NOWHERE_DEG = 0.001
# Gyros of autopilots measure 2000 deg/s, some 4000.
_FASTEST_GYRO_RAD_PER_S = np.deg2rad(5000.0)
# No flight is as long as this.
_MONTH_S = 30 * 86400.0


def spikes(values: Float, limit: float) -> Mask:
    """Return which values lie further than a limit from the median of themselves and their two neighbours.

    Parameters
    ----------
    values : (n,) float64
    limit : float
        In the unit of the values.

    Returns
    -------
    (n,) bool
    """
    if values.size < 3:
        return np.zeros(values.size, dtype=bool)
    neighbours = np.lib.stride_tricks.sliding_window_view(values, 3)
    middle = np.median(neighbours, axis=-1)
    with np.errstate(invalid="ignore"):  # infinity less infinity
        spike: Mask = np.abs(values - np.concatenate([middle[:1], middle, middle[-1:]])) > limit
    return spike


def sound_times(clock_s: Float) -> Mask:
    """Return which times of a log belong to its flight.

    Parameters
    ----------
    clock_s : (n,) float64
        Times in the order of the log, s.

    Returns
    -------
    (n,) bool
        False for what is not finite, jumps away for one sample, or lies a month from the rest.
    """
    finite = np.isfinite(clock_s)
    if not finite.any():
        return finite
    near: Mask = np.abs(clock_s - np.median(clock_s[finite])) < _MONTH_S
    return finite & near & ~spikes(clock_s, _CLOCK_SPIKE_S)


def places(clock_s: Float, latitude_deg: Float, longitude_deg: Float, height_m: Float, source: str) -> PositionSamples:
    """Return the places of a log without what is none.

    Parameters
    ----------
    clock_s, latitude_deg, longitude_deg, height_m : (n,) float64
        In the order of the log; s, deg, m.
    source : str
        Where they come from, in words.

    Returns
    -------
    PositionSamples
    """
    with np.errstate(invalid="ignore"):
        known = (np.abs(latitude_deg) <= 90) & (np.abs(longitude_deg) <= 180)
        known &= (height_m >= HEIGHTS_M[0]) & (height_m <= HEIGHTS_M[1])
        known &= ~nowhere(latitude_deg, longitude_deg)
    known &= sound_times(clock_s)
    known &= ~spikes(latitude_deg, _PLACE_SPIKE_DEG) & ~spikes(longitude_deg, _PLACE_SPIKE_DEG)
    return PositionSamples(
        clock_s[known], np.deg2rad(latitude_deg[known]), np.deg2rad(longitude_deg[known]), height_m[known], source
    )


def nowhere(latitude_deg: Float, longitude_deg: Float) -> Mask:
    """Return which places are 0 N 0 E, what a receiver without a fix says.

    Parameters
    ----------
    latitude_deg, longitude_deg : (n,) float64

    Returns
    -------
    (n,) bool
        Within 0.001 deg: an estimator without an origin wanders.
    """
    with np.errstate(invalid="ignore"):
        mask: Mask = (np.abs(latitude_deg) <= _NOWHERE_DEG) & (np.abs(longitude_deg) <= _NOWHERE_DEG)
    return mask


def no_places(source: str) -> PositionSamples:
    """Return no places, and why there are none.

    Parameters
    ----------
    source : str
        Why, in words.

    Returns
    -------
    PositionSamples
    """
    nothing = np.empty(0)
    return PositionSamples(nothing, nothing, nothing, nothing, source)


def sound_rates(rate_rad_per_s: Float) -> Mask:
    """Return which rates a gyro can have measured.

    Parameters
    ----------
    rate_rad_per_s : (n, 3) float64
        Turn rates, rad/s.

    Returns
    -------
    (n,) bool
        False for what is not finite, or faster than any gyro of an autopilot measures.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        sound: Mask = (np.abs(rate_rad_per_s) < _FASTEST_GYRO_RAD_PER_S).all(axis=-1)
    return sound
