"""The time axis of a plot: the part of the flight it shows, and its ticks."""

from datetime import UTC, datetime, timedelta
from math import ceil, floor, inf, log10

import numpy as np

__all__ = ["TimeAxis"]

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

    Parameters
    ----------
    length_s : float
        Duration of the flight, s.
    max_span_s : float
        Longest part of a growing flight that is shown, s, until the user zooms.

    Attributes
    ----------
    start_s, stop_s : float
        The ends of the part shown, s from the flight's first attitude.
    """

    def __init__(self, length_s: float, *, max_span_s: float = inf) -> None:
        self._first_s, self._last_s, self._max_span_s = 0.0, length_s, max_span_s
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

        Parameters
        ----------
        first_s, last_s : float
            s from the flight's first attitude.
        """
        if (first_s, last_s) == (self._first_s, self._last_s):
            return
        shows_all, at_end, span_s = self._fitted, self.stop_s > self._limits[1] - _TOLERANCE_S, self.span_s
        self._first_s, self._last_s = first_s, last_s
        if shows_all and last_s - first_s <= self._max_span_s:
            self._show_all()
        elif shows_all or at_end:
            self._show(last_s, min(span_s, self._max_span_s))
        else:
            self._show(self.start_s, span_s)

    def zoom(self, at_s: float, factor: float) -> None:
        """Show more or less of the flight, around a time that keeps its position on the screen.

        Parameters
        ----------
        at_s : float
            The time, s from the flight's first attitude.
        factor : float
            Multiplies the length of the part shown.
        """
        self._max_span_s = inf
        flight_s = self._limits[1] - self._limits[0]
        span_s = min(max(self.span_s * factor, min(_MIN_SPAN_S, flight_s)), flight_s)
        fraction = (at_s - self.start_s) / self.span_s
        self._show(at_s - fraction * span_s, span_s)

    def pan(self, seconds: float) -> None:
        """Move the part shown to later times, or earlier ones, within the flight.

        Parameters
        ----------
        seconds : float
            s; negative for earlier times.
        """
        self._show(self.start_s + seconds, self.span_s)

    def follow(self, second: float) -> None:
        """Bring a time into view: to the edge if it is just outside, to the middle if it is far away.

        Parameters
        ----------
        second : float
            s from the flight's first attitude.
        """
        fraction = (second - self.start_s) / self.span_s
        if fraction < -1 or fraction > 2:
            self._show(second - self.span_s / 2, self.span_s)
        elif not _NEAR <= fraction <= _FAR:
            self.pan((fraction - (_NEAR if fraction < _NEAR else _FAR)) * self.span_s)

    def ticks(self, width_px: float, *, first_utc_s: float | None = None) -> tuple[list[float], list[str]]:
        """Return the ticks of the axis and their labels.

        Parameters
        ----------
        width_px : float
            Width of the axis, px.
        first_utc_s : float, optional
            The flight's first attitude, UTC seconds since 1970: the labels are times of day then, and otherwise
            seconds from the first attitude.

        Returns
        -------
        seconds : list of float
            s from the flight's first attitude.
        labels : list of str
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
