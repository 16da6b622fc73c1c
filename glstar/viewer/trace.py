"""Lines of many samples, thinned for a screen of few pixels."""

from math import inf, log2

import numpy as np
from numpy.typing import NDArray

__all__ = ["Trace"]

Float = NDArray[np.float64]


class Trace:
    """A line through samples, with breaks.

    Thinned versions, each with half the samples of the one before, are computed when they are first needed and kept, so
    that panning and zooming compute nothing.

    Parameters
    ----------
    x, y : (n,) float64
        The samples, `x` ascending.
    broken : (n - 1,) bool
        Whether the line is broken between each sample and the next.
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

        Parameters
        ----------
        start, stop : float
            The part that is shown, in the units of x.
        columns : int
            Its width, px.
        tolerance : float
            How far the line may pass by a point, in the units of y.  Such points are left out of a part that stays the
            same for two calls: while it moves, finding them would take longer than drawing them.

        Returns
        -------
        x, y : (m,) float64
            The samples themselves if there are few; otherwise the minimum and the maximum of each group of samples,
            about one group for each column.  y is NaN at breaks.  The next points outside the part are included, so
            that the line continues to the edges.
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
