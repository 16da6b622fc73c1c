"""When it is day or twilight during a flight, for the timeline."""

from math import ceil
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.flight import PositionTrack
from glstar.sky.observed import sun_altitude_rad
from glstar.sky.twilight import LIGHT_LEVELS

__all__ = ["light_intervals"]

Float = NDArray[np.float64]

# Interval of the times for which the Sun is computed, s: between them its altitude is a line to 0.004 deg.
_STEP_S: Final = 300.0
# Largest number of those times: 0.1 deg for a flight of four days.
_MOST_TIMES: Final = 300


def light_intervals(position: PositionTrack, first_s: float, last_s: float) -> dict[str, Float]:
    """Return when it is day and when which twilight.

    Parameters
    ----------
    position : PositionTrack
        Of the aircraft.
    first_s, last_s : float
        UTC seconds since 1970.

    Returns
    -------
    dict of str to (n, 2) float64
        Start and end of each interval, UTC seconds since 1970, by the names of `LIGHT_LEVELS` but without night; only
        those that occur.
    """
    count = min(max(ceil((last_s - first_s) / _STEP_S), 1), _MOST_TIMES) + 1
    times_s = np.linspace(first_s, last_s, count)
    altitude_rad = np.array([sun_altitude_rad(float(utc_s), position.at(float(utc_s))) for utc_s in times_s])
    edges_rad = np.array([least_rad for _, least_rad in LIGHT_LEVELS[:-1]])
    crossings = [first_s, last_s]
    for edge_rad in edges_rad:
        above = altitude_rad - edge_rad
        (before,) = np.nonzero((above[1:] > 0) != (above[:-1] > 0))
        fraction = above[before] / (above[before] - above[before + 1])
        crossings += (times_s[before] + fraction * (times_s[before + 1] - times_s[before])).tolist()
    ends_s = np.unique(crossings)
    middle_rad = np.interp((ends_s[1:] + ends_s[:-1]) / 2, times_s, altitude_rad)
    level = (middle_rad[:, np.newaxis] <= edges_rad).sum(axis=1)
    spans_s = np.stack([ends_s[:-1], ends_s[1:]], axis=1)
    found = {name: spans_s[level == k] for k, (name, _) in enumerate(LIGHT_LEVELS[:-1])}
    return {name: spans for name, spans in found.items() if len(spans)}
