"""The curves of the timeline, computed from a flight on any thread, and its axis.

Lines of many samples are thinned for a screen of few pixels.  The axis has the part of the flight shown, and its ticks.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from math import ceil, floor, inf, log2, log10
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.flight import AttitudeTrack, Flight
from glstar.rotation import euler_from_quaternion
from glstar.sky.place.site import geocentric_m


class Trace:
    """A line through samples, with breaks.

    Thinned versions, each with half the samples of the one before, are computed when they are first needed and kept, so
    that panning and zooming compute nothing.  `x`, `y` (n,): the samples, `x` ascending; `broken` (n - 1,) bool:
    whether the line is broken between each sample and the next.
    """

    def __init__(self, x: Float, y: Float, broken: NDArray[np.bool_]) -> None:
        self._x, self._y = x, y
        # Whether each sample is the first of an unbroken segment.
        self._begins = np.append(True, broken)[: x.size]
        self._levels: dict[int, tuple[Float, Float]] = {}
        # The last part, and the points left of the last one that stayed the same.
        self._part: tuple[float, ...] = ()
        self._straight: tuple[tuple[float, ...], tuple[Float, Float]] = (), (x, y)

    def thinned(self, start: float, stop: float, columns: int, tolerance: float = 0.0) -> tuple[Float, Float]:
        """Return the points that a plot of a given width needs to draw the same picture.

        `start`, `stop`: the part that is shown, in the units of x; `columns`: its width, px; `tolerance`: largest
        distance of the line from a point that is left out, in the units of y.  Points are left out of a part that stays
        the same for two calls: while it moves, finding them would take longer than drawing them.  Returns x and y,
        (m,): the samples themselves if there are few; otherwise the minimum and the maximum of each group of samples,
        about one group for each column.  At breaks, y is NaN; the next points outside the part are included, so that
        the line continues to the edges.
        """
        first, last = self._x.searchsorted((start, stop)).tolist()
        in_a_column = (last - first) / max(columns, 1)
        level = max(round(log2(in_a_column)), 0) if in_a_column > 0 else 0
        x, y = self._level(level)
        begin, end = x.searchsorted((start, stop)).tolist()
        # One group and the NaN of a break to either side.
        shown = slice(max(begin - 3, 0), end + 3)
        part: tuple[float, ...] = level, begin, end, tolerance
        if part != self._part or not tolerance:
            self._part = part
            return x[shown], y[shown]
        if self._straight[0] != part:
            left = _corners(x[shown], y[shown], tolerance)
            self._straight = part, (x[shown][left], y[shown][left])
        return self._straight[1]

    def _level(self, level: int) -> tuple[Float, Float]:
        """Return the line with the minimum and the maximum of each 2 ** level samples."""
        if level not in self._levels:
            self._levels[level] = self._made(level)
        return self._levels[level]

    def _made(self, level: int) -> tuple[Float, Float]:
        n, size = self._x.size, 2**level
        groups = np.arange(n) % size == 0
        # A line with more breaks than groups fills the screen, and no break is visible.
        begins = self._begins if level == 0 or self._begins.sum() <= n / size else np.zeros(n, dtype=np.bool_)
        first = np.flatnonzero(groups | begins)
        if first.size == n:
            x, y = self._x[:, np.newaxis], self._y[:, np.newaxis]
        else:
            last = np.append(first[1:], n) - 1
            minimum, maximum = np.minimum.reduceat(self._y, first), np.maximum.reduceat(self._y, first)
            falls = self._y[first] > self._y[last]
            x = np.stack([self._x[first], self._x[last]], axis=-1)
            y = np.stack([np.where(falls, maximum, minimum), np.where(falls, minimum, maximum)], axis=-1)
        # A NaN before each segment but the first.
        breaks = np.flatnonzero(begins[first][1:]) + 1
        width = x.shape[1]
        return np.insert(x.ravel(), breaks * width, x[breaks, 0]), np.insert(y.ravel(), breaks * width, np.nan)


def _corners(x: Float, y: Float, tolerance: float) -> list[int]:
    """Return the points of a line that the others lie within a tolerance of, above or below.

    The swinging door (Bristol 1990): from the last point kept, a line to each next point is tried, whose slope has to
    lie between those that pass by all points in between.  The extrema are kept, so that the axis stays the same, and
    the ends of unbroken parts.
    """
    if not np.isfinite(y).any():
        return list(range(len(y)))
    breaks = np.flatnonzero(np.isnan(y))
    fixed = {
        *breaks.tolist(),
        *(breaks - 1).tolist(),
        *(breaks + 1).tolist(),
        int(np.nanargmin(y)),
        int(np.nanargmax(y)),
    }
    at, height = x.tolist(), y.tolist()
    kept, last, low, high = [0], 0, -inf, inf
    for point in range(1, len(at)):
        run, rise = at[point] - at[last], height[point] - height[last]
        if run <= 0 or not low <= rise / run <= high:
            last, low, high = point - 1, -inf, inf
            kept.append(last)
            run, rise = at[point] - at[last], height[point] - height[last]
        if run <= 0 or point in fixed:
            last, low, high = point, -inf, inf
            kept.append(last)
        else:
            low, high = max(low, (rise - tolerance) / run), min(high, (rise + tolerance) / run)
    return sorted({*kept, len(at) - 1})


# The angles; the rates about forward, right and down are labelled alike.
ANGLES = ("roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True, eq=False)
class FlightLines:
    """Roll, pitch, yaw and the angular rates of the body over time; times are seconds from an origin."""

    attitude: AttitudeTrack
    second: Float  # (n,) the times of its samples, s from the origin
    angles_rad: Float  # (3, n) roll, pitch and yaw
    angles: tuple[Trace, ...]  # Roll, pitch and yaw, deg
    rates: tuple[Trace, ...]  # About forward, right and down, deg/s
    gaps_s: Float  # (m, 2) start and end of each gap, s from the origin

    @classmethod
    def of(cls, attitude: AttitudeTrack, origin_s: float) -> Self:
        """Return the curves of a flight; `origin_s`: UTC seconds since 1970."""
        second = attitude.utc_s - origin_s
        angles_rad = np.stack(euler_from_quaternion(attitude.q_body_ned))
        gaps_s = np.array([(gap.start_utc_s, gap.stop_utc_s) for gap in attitude.gaps]).reshape(-1, 2) - origin_s
        angles = _angles(second, np.rad2deg(angles_rad), gaps_s)
        return cls(attitude, second, angles_rad, angles, _rates(attitude, origin_s), gaps_s)


def _angles(second: Float, angles_deg: Float, gaps_s: Float) -> tuple[Trace, ...]:
    gaps = np.zeros(second.size - 1, dtype=np.bool_)
    gaps[np.searchsorted(second, gaps_s[:, 0])] = True
    # An angle that passes 180 deg continues at -180 deg: the line is broken there.
    return tuple(Trace(second, angle_deg, gaps | (np.abs(np.diff(angle_deg)) > 180)) for angle_deg in angles_deg)


def _rates(attitude: AttitudeTrack, origin_s: float) -> tuple[Trace, ...]:
    utc_s, rate_rad_per_s = attitude.rates()
    after = np.searchsorted(utc_s, [gap.start_utc_s for gap in attitude.gaps])
    gaps = np.zeros(max(utc_s.size - 1, 0), dtype=np.bool_)
    gaps[after[(after > 0) & (after < utc_s.size)] - 1] = True
    rate_deg_per_s = np.ascontiguousarray(np.rad2deg(rate_rad_per_s).T)
    return tuple(Trace(utc_s - origin_s, rate, gaps) for rate in rate_deg_per_s)


# Interval over which speeds are measured, s: GPS positions come five times a second at most.
_SPEED_INTERVAL_S = 1.0


@dataclass(frozen=True, slots=True)
class CurveSpec:
    """What the timeline writes beside a plot."""

    label: str  # In the menu of curves
    unit: str  # At the axis
    names: tuple[str, ...]  # Names of the lines
    about: str  # What they are


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


_SPECS = {
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
    """Return height, m, and ground speed and climb, m/s, over time.

    A flight with a single position has a constant height and no speed.  `origin_s`: UTC seconds since 1970, from which
    the times of the curves count.
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


# Intervals of ticks: decimal for seconds, sexagesimal for the time of day.
_TENS = (1.0, 2.0, 5.0, 10.0)
_TIMES_OF_DAY_S = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0)
_HOURS_S = (3600.0, 7200.0, 10800.0, 21600.0, 43200.0, 86400.0)

# Smallest distance of two labelled ticks, px.
_LABEL_PX = 90

# The play head is kept between these fractions of the axis.
_NEAR, _FAR = 0.1, 0.9

# Smallest part of a flight that can be shown, s.
_MIN_SPAN_S = 0.01
# Tolerance when times are compared, s: more than the rounding of sums of seconds.
_TOLERANCE_S = 1e-6


class TimeAxis:
    """The part of a flight that is shown.

    `length_s`: duration of the flight, s; `max_span_s`: longest part of a growing flight that is shown, s, until the
    user zooms.  `start_s`, `stop_s`: the ends of the part shown, s from the flight's first attitude.
    """

    def __init__(self, length_s: float, *, max_span_s: float = inf) -> None:
        self._first_s = 0.0
        self._last_s = length_s
        self._max_span_s = max_span_s
        self.start_s, self.stop_s = 0.0, 0.0
        self._show_all()

    @property
    def span_s(self) -> float:
        """Length of the part shown, s."""
        return self.stop_s - self.start_s

    def fit(self) -> None:
        """Show the complete flight."""
        self._max_span_s = inf
        self._show_all()

    def grow(self, first_s: float, last_s: float) -> None:
        """Set the ends of a growing flight; if its end was shown, it stays in view.

        `first_s`, `last_s`: s from the flight's first attitude.
        """
        if (first_s, last_s) == (self._first_s, self._last_s):
            return
        shows_all, span_s = self._fitted, self.span_s
        at_end = self.stop_s > self._limits[1] - _TOLERANCE_S
        self._first_s, self._last_s = first_s, last_s
        if shows_all and last_s - first_s <= self._max_span_s:
            self._show_all()
        elif shows_all or at_end:
            self._show(last_s, min(span_s, self._max_span_s))
        else:
            self._show(self.start_s, span_s)

    def zoom(self, at_s: float, factor: float) -> None:
        """Show more or less of the flight, around a time that keeps its position on the screen.

        `at_s`: the time, s from the flight's first attitude; `factor`: multiplies the length of the part shown.
        """
        self._max_span_s = inf
        flight_s = self._limits[1] - self._limits[0]
        span_s = min(max(self.span_s * factor, min(_MIN_SPAN_S, flight_s)), flight_s)
        fraction = (at_s - self.start_s) / self.span_s
        self._show(at_s - fraction * span_s, span_s)

    def pan(self, seconds: float) -> None:
        """Move the part shown to later times, or earlier ones, within the flight.

        `seconds`: s; negative for earlier times.
        """
        self._show(self.start_s + seconds, self.span_s)

    def follow(self, second: float) -> None:
        """Bring a time into view: to the edge if it is just outside, to the middle if it is far away.

        `second`: s from the flight's first attitude.
        """
        fraction = (second - self.start_s) / self.span_s
        if fraction < -1 or fraction > 2:
            self._show(second - self.span_s / 2, self.span_s)
        elif not _NEAR <= fraction <= _FAR:
            self.pan((fraction - (_NEAR if fraction < _NEAR else _FAR)) * self.span_s)

    def ticks(self, width_px: float, *, first_utc_s: float | None = None) -> tuple[list[float], list[str]]:
        """Return the ticks of the axis, s from the flight's first attitude, and their labels.

        `width_px`: width of the axis, px; `first_utc_s`: the flight's first attitude, UTC seconds since 1970: the
        labels are times of day then, and otherwise seconds from the first attitude.
        """
        min_s = self.span_s * _LABEL_PX / max(width_px, _LABEL_PX)
        origin_s = first_utc_s or 0.0
        step_s = _step_s(min_s, of_day=first_utc_s is not None)
        # Times of day count from midnight: at 1.7e9 s, float64 is too coarse for fine ticks.
        origin_s = origin_s % 86400
        numbers = np.arange(ceil((self.start_s + origin_s) / step_s), floor((self.stop_s + origin_s) / step_s) + 1)
        seconds = [float(second) for second in numbers * step_s - origin_s]
        if first_utc_s is None:
            decimals = max(-floor(log10(step_s) + 1e-9), 0)
            return seconds, [f"{second:.{decimals}f}" for second in seconds]
        return seconds, [_time_of_day(float(of_day), step_s) for of_day in numbers * step_s]

    @property
    def _limits(self) -> tuple[float, float]:
        # A margin at either end, in which the play head stays visible.
        margin_s = (self._last_s - self._first_s) / 200
        return self._first_s - margin_s, self._last_s + margin_s

    @property
    def _fitted(self) -> bool:
        start_s, stop_s = self._limits
        return self.span_s > stop_s - start_s - _TOLERANCE_S

    def _show_all(self) -> None:
        self.start_s, self.stop_s = self._limits

    def _show(self, start_s: float, span_s: float) -> None:
        first_s, last_s = self._limits
        self.start_s = min(max(start_s, first_s), max(last_s - span_s, first_s))
        self.stop_s = min(self.start_s + span_s, last_s)


def _step_s(min_s: float, *, of_day: bool) -> float:
    """Return the smallest usual interval of ticks that is at least the given one."""
    if of_day and min_s > 1:
        return next((step_s for step_s in _TIMES_OF_DAY_S + _HOURS_S if step_s >= min_s), _HOURS_S[-1])
    decade = 10.0 ** floor(log10(min_s))
    return next(tens * decade for tens in _TENS if tens * decade >= min_s * (1 - 1e-9))


def _time_of_day(seconds: float, step_s: float) -> str:
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(seconds * 1e6))
    if step_s >= 60:
        return f"{time:%H:%M}"
    decimals = max(-floor(log10(step_s) + 1e-9), 0)
    return f"{time:%H:%M:%S}" + (f"{time.microsecond / 1e6:.{decimals}f}"[1:] if decimals else "")
