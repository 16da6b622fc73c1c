"""When stars rise and set during an exposure, in float64.

The horizon moves by 7e-5 rad/s, and float32 directions are good to 6e-8 rad: a crossing that a shader computed would be
up to a millisecond off, in which a star moves by 5 px at 300 deg/s.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.render.pointing import Pointing
from glstar.render.trailmodels import AnalyticSegments

__all__ = ["NEVER", "rise_and_set"]

Float = NDArray[np.float64]

# A fraction of the exposure, beyond its end by more than any rounding.
NEVER: Final = 2.0

# How far the zenith may move between the times of the segments, relative to its largest distance from the first.
_ZENITH_MARGIN: Final = 2.0
# Change of a height, a sine, by rounding.
_ROUNDING: Final = 1e-9


def rise_and_set(trails: AnalyticSegments, direction_eq: NDArray[np.float64]) -> Float:
    """Return when stars rise above the apparent horizon and set.

    Parameters
    ----------
    trails : AnalyticSegments
    direction_eq : (m, 3) float64
        Geocentric apparent unit vectors, true equator and equinox.

    Returns
    -------
    (m, 2) float64
        Elapsed fractions of the exposure: a star is up from the first to the second; if the second is earlier, until
        the second and again from the first.  0 of a star that is up at the start, `NEVER` of a star that does not rise
        or does not set.

    Notes
    -----
    Within a segment the sine of an altitude is the quadratic through its values at the start, the middle and the end.
    """
    pointing = trails.pointing
    moved = np.linalg.norm(pointing.zenith_eq - pointing.zenith_eq[0], axis=1).max()
    height = pointing[:1].heights(direction_eq)[0]
    times = _without_crossing(height >= 0)
    near = np.flatnonzero(np.abs(height) <= _ZENITH_MARGIN * moved + _ROUNDING)
    if near.size:
        times[near] = _crossings(pointing, trails.time_fraction, direction_eq[near])
    return times


def _without_crossing(is_up: NDArray[np.bool_]) -> Float:
    """Return `rise_and_set` of stars that are up, or not, throughout."""
    return np.column_stack([np.where(is_up, 0.0, NEVER), np.full(len(is_up), NEVER)])


def _crossings(pointing: Pointing, time_fraction: Float, direction_eq: Float) -> Float:
    """Return `rise_and_set` of a few stars: from their heights at all times."""
    heights = pointing.heights(direction_eq)
    is_up = heights >= 0
    changes = is_up[1:] != is_up[:-1]
    stars = np.arange(len(direction_eq))
    times = _without_crossing(is_up[0])
    # A star crosses the horizon at most twice a day; the third crossing of a longer exposure is ignored.
    for _ in range(2):
        half = np.argmax(changes, axis=0)
        crosses = np.flatnonzero(changes[half, stars])
        time = _time_of_crossing(heights, time_fraction, half)
        times[crosses, is_up[half, stars].astype(np.intp)[crosses]] = time[crosses]
        changes[half, stars] = False
    return times


def _time_of_crossing(heights: Float, time_fraction: Float, half: NDArray[np.intp]) -> Float:
    """Return when the quadratic through the heights of each star is 0 in one half of a segment, as a fraction."""
    stars, segment = np.arange(heights.shape[1]), half // 2
    start, middle, end = (heights[2 * segment + k, stars] for k in range(3))
    before, after = heights[half, stars], heights[half + 1, stars]
    # Before + (slope + bend v) v, v the elapsed fraction of the half; signs such that it decreases through 0.
    sign = np.where(before >= 0, 1.0, -1.0)
    bend = sign * (start - 2 * middle + end) / 2
    slope = sign * (after - before) - bend
    root = np.sqrt(np.maximum(slope * slope - 4 * bend * sign * before, 0.0)) - slope
    elapsed = np.where(root > 0, 2 * sign * before / np.where(root > 0, root, 1.0), 0.0).clip(0.0, 1.0)
    begins = np.cumsum(time_fraction) - time_fraction
    return np.asarray(begins[segment] + (half % 2 + elapsed) / 2 * time_fraction[segment])
