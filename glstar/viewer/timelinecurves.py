"""The curves that the timeline can show: which there are, and those that follow from the position of the aircraft."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.flight import Flight
from glstar.sky.geodesy import geocentric_m
from glstar.viewer.trace import Trace

__all__ = ["CurveSpec", "TimelineCurve", "motion_traces"]

Float = NDArray[np.float64]

# Interval over which speeds are measured, s: GPS positions come five times a second at most.
_SPEED_INTERVAL_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class CurveSpec:
    """What the timeline writes beside a plot.

    Attributes
    ----------
    label : str
        In the menu of curves.
    unit : str
        At the axis.
    names : tuple of str
        Of the lines.
    about : str
        What they are.
    """

    label: str
    unit: str
    names: tuple[str, ...]
    about: str


class TimelineCurve(StrEnum):
    """A plot of the timeline."""

    ATTITUDE = "attitude"
    RATES = "rates"
    HEIGHT = "height"
    SPEED = "speed"
    STARS = "stars"
    LIMIT = "limiting magnitude"
    SNR = "signal-to-noise ratio"

    @property
    def spec(self) -> CurveSpec:
        """Its label, its unit and the names of its lines."""
        return _SPECS[self]

    @property
    def is_sampled(self) -> bool:
        """Whether it follows from simulated exposures, which are computed in the background."""
        return self in {TimelineCurve.STARS, TimelineCurve.LIMIT, TimelineCurve.SNR}


_SPECS: Final = {
    TimelineCurve.ATTITUDE: CurveSpec(
        "Attitude", "deg", ("roll", "pitch", "yaw"), "roll, pitch and yaw of the aircraft"
    ),
    TimelineCurve.RATES: CurveSpec(
        "Angular rates", "deg/s", ("forward", "right", "down"), "about the forward, right and down axes of the body"
    ),
    TimelineCurve.HEIGHT: CurveSpec("Height", "m", ("height",), "height of the aircraft as the log has it"),
    TimelineCurve.SPEED: CurveSpec(
        "Speed", "m/s", ("ground", "climb"), "horizontal and upward speed of the aircraft, averaged over a second"
    ),
    TimelineCurve.STARS: CurveSpec(
        "Number of stars", "stars", ("stars",), "catalogue stars whose trails may touch the image, as truth lists them"
    ),
    TimelineCurve.LIMIT: CurveSpec(
        "Limiting magnitude",
        "V mag",
        ("at rest", "trail"),
        "faintest star on the optical axis with a signal-to-noise ratio of 5: at rest, and with its trail",
    ),
    TimelineCurve.SNR: CurveSpec(
        "SNR of the selected star", "SNR", ("star",), "expected signal-to-noise ratio of the star selected in the image"
    ),
}


def motion_traces(flight: Flight, origin_s: float) -> dict[TimelineCurve, tuple[Trace, ...]]:
    """Return height, ground speed and climb over time.

    Parameters
    ----------
    flight : Flight
    origin_s : float
        UTC seconds since 1970, from which the times of the curves count.

    Returns
    -------
    dict of TimelineCurve to tuple of Trace
        m, and m/s; a flight with a single position has a constant height and no speed.
    """
    position = flight.position
    if position.utc_s.size < 2:
        ends_s = np.array([flight.attitude.first_s, flight.attitude.last_s])
        height_m = np.full(2, float(position.height_m[0]))
        return {TimelineCurve.HEIGHT: (_trace(ends_s - origin_s, height_m),), TimelineCurve.SPEED: ()}
    utc_s, first_s, last_s = position.utc_s, position.utc_s[0], position.utc_s[-1]
    before_s, after_s = (np.clip(utc_s + side * _SPEED_INTERVAL_S / 2, first_s, last_s) for side in (-1, 1))
    before, after = position.coordinates(before_s), position.coordinates(after_s)
    interval_s = after_s - before_s
    moved_m = np.linalg.norm(geocentric_m(*after) - geocentric_m(*before), axis=-1)
    climbed_m = after[2] - before[2]
    ground_m = np.sqrt(np.maximum(moved_m**2 - climbed_m**2, 0.0))
    second = utc_s - origin_s
    return {
        TimelineCurve.HEIGHT: (_trace(second, position.height_m),),
        TimelineCurve.SPEED: (_trace(second, ground_m / interval_s), _trace(second, climbed_m / interval_s)),
    }


def _trace(second: Float, value: Float) -> Trace:
    return Trace(second, value, np.zeros(max(second.size - 1, 0), dtype=np.bool_))
