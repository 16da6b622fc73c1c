"""The ways of stars over an exposure, and where somebody who counts looks at them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Parabolas", "Places", "moments_a_block"]

Float = NDArray[np.float64]

# So many places are found at a time, and of a sky of many stars a few moments: they stay in the processor's own memory.
_PLACES_A_BLOCK: Final = 1 << 15
_LEAST_MOMENTS_A_BLOCK: Final = 8


def moments_a_block(stars: int) -> int:
    """Return how many moments of so many stars are looked at together.

    Parameters
    ----------
    stars : int

    Returns
    -------
    int
    """
    return max(_LEAST_MOMENTS_A_BLOCK, _PLACES_A_BLOCK // max(stars, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """The ways of m stars over a part of an exposure, known at n moments.

    Attributes
    ----------
    xy_px : (2, n, m) float64
        Columns and rows, px; NaN behind the camera and under the horizon.
    share : (n,) float64
        How much of the exposure each of the moments stands for.
    """

    xy_px: Float
    share: Float

    @property
    def box_px(self) -> Float:
        """The lowest and the highest column and row of each way, (2, m, 2) px; NaN where a part of it has no place."""
        return _box(self.xy_px.min(axis=1), self.xy_px.max(axis=1))

    @property
    def sum_px(self) -> Float:
        """The places that are looked at, each times its share, added up, (2, m) px; NaN as in the box."""
        return np.stack([self.share @ places for places in self.xy_px])

    def looks(self, which: NDArray[np.intp]) -> Iterator[tuple[Float, Float]]:
        """Return where some of the stars are, a block of moments at a time.

        Parameters
        ----------
        which : (k,) intp

        Yields
        ------
        xy_px : (n, k, 2) float64
            Places (x, y), px; NaN behind the camera and under the horizon.
        share : (n,) float64
            How much of the exposure each of the moments stands for.
        """
        if which.size:
            yield np.moveaxis(self.xy_px.take(which, axis=2), 0, -1), self.share


@dataclass(frozen=True, slots=True, eq=False)
class Parabolas:
    """The ways of m stars over an exposure, bent and unevenly run, as swept trails are drawn: a parabola a segment.

    Attributes
    ----------
    knots_px : (2, 2 s + 1, m) float64
        Columns and rows at the beginning, the middle and the end of the first of s segments, which is the beginning of
        the second, and so on, px; NaN behind the camera and under the horizon.
    share : (s,) float64
        How much of the exposure each segment lasts.
    counts : (s,) intp
        Into how many parts each segment is cut; a star is looked at in the middle of each.
    """

    knots_px: Float
    share: Float
    counts: NDArray[np.intp]

    @property
    def box_px(self) -> Float:
        """What `Places.box_px` is, or a little more."""
        begin, middle, end = self._parts(self.knots_px)
        # A parabola does not leave the triangle of its ends and of where its tangents there meet.
        corner = 2 * middle - (begin + end) / 2
        ends = self.knots_px[:, ::2]
        return _box(np.minimum(ends.min(axis=1), corner.min(axis=1)), np.maximum(ends.max(axis=1), corner.max(axis=1)))

    @property
    def sum_px(self) -> Float:
        """What `Places.sum_px` is of all that is looked at."""
        # Simpson's rule, less what so many looks fall short of it.
        at_ends = self.share * (1 - 1 / self.counts**2) / 6
        weight = np.zeros(self.knots_px.shape[1])
        weight[:-1:2] += at_ends
        weight[2::2] += at_ends
        weight[1::2] = self.share - 2 * at_ends
        return np.stack([weight @ places for places in self.knots_px])

    def looks(self, which: NDArray[np.intp]) -> Iterator[tuple[Float, Float]]:
        """Return where some of the stars are, as `Places.looks` does."""
        if not which.size:
            return
        begin, middle, end = self._parts(self.knots_px.take(which, axis=2))
        rate, bend = 4 * middle - 3 * begin - end, 2 * (begin - 2 * middle + end)
        segment = np.repeat(np.arange(len(self.counts)), self.counts)
        first = np.repeat(np.cumsum(self.counts) - self.counts, self.counts)
        u = (np.arange(len(segment)) - first + 0.5) / self.counts[segment]
        share = self.share[segment] / self.counts[segment]
        together = moments_a_block(len(which))
        for start in range(0, len(segment), together):
            block = slice(start, start + together)
            k, when = segment[block], u[block, np.newaxis]
            k = k[:1] if k[0] == k[-1] else k
            xy = when * bend.take(k, axis=1)
            xy += rate.take(k, axis=1)
            xy *= when
            xy += begin.take(k, axis=1)
            yield np.moveaxis(xy, 0, -1), share[block]

    @staticmethod
    def _parts(knots_px: Float) -> tuple[Float, Float, Float]:
        """Return the beginning, the middle and the end of each segment."""
        return knots_px[:, :-2:2], knots_px[:, 1::2], knots_px[:, 2::2]


def _box(lowest: Float, highest: Float) -> Float:
    return np.moveaxis(np.stack([lowest, highest]), 1, -1)
