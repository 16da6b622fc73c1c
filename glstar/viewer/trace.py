"""Lines of many samples, thinned for a screen of few pixels."""

from math import log2

import numpy as np
from numpy.typing import NDArray

__all__ = ["Trace"]

Float = NDArray[np.float64]


class Trace:
    """A line through samples, broken here and there.

    It keeps itself at every halving of its samples, each made when it is first asked for, so that panning and zooming
    compute nothing.

    Parameters
    ----------
    x, y : (n,) float64
        The samples, `x` rising.
    broken : (n - 1,) bool
        Whether the line is broken between each sample and the next.
    """

    def __init__(self, x: Float, y: Float, broken: NDArray[np.bool_]) -> None:
        self._x, self._y = x, y
        # Where an unbroken stretch begins.
        self._begins = np.append(True, broken)[: x.size]
        self._levels: dict[int, tuple[Float, Float]] = {}

    def thinned(self, start: float, stop: float, columns: int) -> tuple[Float, Float]:
        """Return what a plot of so many pixel columns needs to draw the same picture.

        Parameters
        ----------
        start, stop : float
            The part that is shown, in the units of x.
        columns : int
            How wide it is shown, px.

        Returns
        -------
        x, y : (m,) float64
            The samples themselves where there are few; otherwise the least and the greatest of each handful of them,
            about a column's.  NaN in y where the line is broken.  The neighbours of the part belong to it, so
            that the line leaves the picture.
        """
        first, last = self._x.searchsorted((start, stop)).tolist()
        in_a_column = (last - first) / max(columns, 1)
        x, y = self._level(max(round(log2(in_a_column)), 0) if in_a_column > 0 else 0)
        begin, end = x.searchsorted((start, stop)).tolist()
        # A handful and the mark of a break to either side.
        shown = slice(max(begin - 3, 0), end + 3)
        return x[shown], y[shown]

    def _level(self, level: int) -> tuple[Float, Float]:
        """Return the line with the least and the greatest of each 2 ** level samples."""
        if level not in self._levels:
            self._levels[level] = self._made(level)
        return self._levels[level]

    def _made(self, level: int) -> tuple[Float, Float]:
        n, handful = self._x.size, 2**level
        groups = np.arange(n) % handful == 0
        # Where it breaks more often than there are handfuls, the screen is filled and shows no break.
        begins = self._begins if level == 0 or self._begins.sum() <= n / handful else np.zeros(n, dtype=np.bool_)
        first = np.flatnonzero(groups | begins)
        if first.size == n:
            x, y = self._x[:, np.newaxis], self._y[:, np.newaxis]
        else:
            last = np.append(first[1:], n) - 1
            least, greatest = np.minimum.reduceat(self._y, first), np.maximum.reduceat(self._y, first)
            falls = self._y[first] > self._y[last]
            x = np.stack([self._x[first], self._x[last]], axis=-1)
            y = np.stack([np.where(falls, greatest, least), np.where(falls, least, greatest)], axis=-1)
        # Before each stretch but the first stands a sample of nothing.
        breaks = np.flatnonzero(begins[first][1:]) + 1
        width = x.shape[1]
        return np.insert(x.ravel(), breaks * width, x[breaks, 0]), np.insert(y.ravel(), breaks * width, np.nan)
