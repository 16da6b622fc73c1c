"""The time axis of a plot: which part of the flight it shows, and where its ticks are."""

from datetime import UTC, datetime, timedelta
from math import ceil, floor, inf, log10

import numpy as np

__all__ = ["TimeAxis"]

# Steps that people count in: seconds by tens, time of day by sixties.
_TENS = (1.0, 2.0, 5.0, 10.0)
_TIMES_OF_DAY_S = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0)
_HOURS_S = (3600.0, 7200.0, 10800.0, 21600.0, 43200.0, 86400.0)

# A tick's label has so much room, px.
_LABEL_PX = 90

# The play head is kept between these shares of the axis.
_NEAR, _FAR = 0.1, 0.9

# Nobody needs to see less of a flight at once, s.
_SHORTEST_S = 0.01
# What sums of seconds are off by, and more, s.
_HAIR_S = 1e-6


class TimeAxis:
    """Which part of a flight is shown.

    Parameters
    ----------
    length_s : float
        How long the flight lasts, s.
    most_s : float
        How much of a flight that grows is shown, s, until somebody says otherwise.

    Attributes
    ----------
    start_s, stop_s : float
        The ends of what is shown, s from the flight's first attitude.
    """

    def __init__(self, length_s: float, *, most_s: float = inf) -> None:
        self._first_s, self._last_s, self._most_s = 0.0, length_s, most_s
        self.start_s, self.stop_s = 0.0, 0.0
        self._show_all()

    @property
    def span_s(self) -> float:
        """How much is shown, s."""
        return self.stop_s - self.start_s

    def fit(self) -> None:
        """Show the whole flight."""
        self._most_s = inf
        self._show_all()

    def grow(self, first_s: float, last_s: float) -> None:
        """Take note of how much there is by now of a flight; where its end was shown it stays in the picture.

        Parameters
        ----------
        first_s, last_s : float
            s from the flight's first attitude.
        """
        if (first_s, last_s) == (self._first_s, self._last_s):
            return
        whole, at_end, span_s = self._fitted, self.stop_s > self._limits[1] - _HAIR_S, self.span_s
        self._first_s, self._last_s = first_s, last_s
        if whole and last_s - first_s <= self._most_s:
            self._show_all()
        elif whole or at_end:
            self._show(last_s, min(span_s, self._most_s))
        else:
            self._show(self.start_s, span_s)

    def zoom(self, at_s: float, factor: float) -> None:
        """Show more or less of the flight, around a moment that stays where it is on the screen.

        Parameters
        ----------
        at_s : float
            The moment, s from the flight's first attitude.
        factor : float
            How many times as much is shown; below 1 less.
        """
        self._most_s = inf
        whole_s = self._limits[1] - self._limits[0]
        span_s = min(max(self.span_s * factor, min(_SHORTEST_S, whole_s)), whole_s)
        share = (at_s - self.start_s) / self.span_s
        self._show(at_s - share * span_s, span_s)

    def pan(self, seconds: float) -> None:
        """Show what comes later, or earlier where negative; the flight's ends are the limits.

        Parameters
        ----------
        seconds : float
            By how much, s.
        """
        self._show(self.start_s + seconds, self.span_s)

    def follow(self, second: float) -> None:
        """Bring a moment into the picture: a little where it has just left, into the middle from far away.

        Parameters
        ----------
        second : float
            s from the flight's first attitude.
        """
        share = (second - self.start_s) / self.span_s
        if share < -1 or share > 2:
            self._show(second - self.span_s / 2, self.span_s)
        elif not _NEAR <= share <= _FAR:
            self.pan((share - (_NEAR if share < _NEAR else _FAR)) * self.span_s)

    def ticks(self, width_px: float, *, first_utc_s: float | None = None) -> tuple[list[float], list[str]]:
        """Return where the axis is marked, and with what.

        Parameters
        ----------
        width_px : float
            How wide it is, px.
        first_utc_s : float, optional
            The flight's first attitude, UTC seconds since 1970: the marks are times of day then, and otherwise seconds
            from the first attitude.

        Returns
        -------
        seconds : list of float
            s from the flight's first attitude.
        labels : list of str
        """
        least_s = self.span_s * _LABEL_PX / max(width_px, _LABEL_PX)
        origin_s = first_utc_s or 0.0
        step_s = _step_s(least_s, of_day=first_utc_s is not None)
        # Times of day are counted from midnight, for a float64 knows 1.7e9 s not well enough for fine steps.
        origin_s = origin_s % 86400
        numbers = np.arange(ceil((self.start_s + origin_s) / step_s), floor((self.stop_s + origin_s) / step_s) + 1)
        seconds = [float(second) for second in numbers * step_s - origin_s]
        if first_utc_s is None:
            decimals = max(-floor(log10(step_s) + 1e-9), 0)
            return seconds, [f"{second:.{decimals}f}" for second in seconds]
        return seconds, [_time_of_day(float(of_day), step_s) for of_day in numbers * step_s]

    @property
    def _limits(self) -> tuple[float, float]:
        # A hair's breadth at the ends, that the play head can be seen there.
        margin_s = (self._last_s - self._first_s) / 200
        return self._first_s - margin_s, self._last_s + margin_s

    @property
    def _fitted(self) -> bool:
        start_s, stop_s = self._limits
        return self.span_s > stop_s - start_s - _HAIR_S

    def _show_all(self) -> None:
        self.start_s, self.stop_s = self._limits

    def _show(self, start_s: float, span_s: float) -> None:
        first_s, last_s = self._limits
        self.start_s = min(max(start_s, first_s), max(last_s - span_s, first_s))
        self.stop_s = min(self.start_s + span_s, last_s)


def _step_s(least_s: float, *, of_day: bool) -> float:
    """Return the least step that people count in, and that leaves room for labels."""
    if of_day and least_s > 1:
        return next((step_s for step_s in _TIMES_OF_DAY_S + _HOURS_S if step_s >= least_s), _HOURS_S[-1])
    decade = 10.0 ** floor(log10(least_s))
    return next(tens * decade for tens in _TENS if tens * decade >= least_s * (1 - 1e-9))


def _time_of_day(seconds: float, step_s: float) -> str:
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(seconds * 1e6))
    if step_s >= 60:
        return f"{moment:%H:%M}"
    decimals = max(-floor(log10(step_s) + 1e-9), 0)
    return f"{moment:%H:%M:%S}" + (f"{moment.microsecond / 1e6:.{decimals}f}"[1:] if decimals else "")
