"""The ways of stars over an exposure, and where somebody who counts looks at them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera

__all__ = ["Conics", "Places", "end_weights", "moments_a_block"]

Float = NDArray[np.float64]

# So many places are found at a time, and of a sky of many stars a few moments: they stay in the processor's own memory.
_PLACES_A_BLOCK: Final = 1 << 15
_LEAST_MOMENTS_A_BLOCK: Final = 8

# How often a swept trail is looked at by those who count where it is.
_LEAST_LOOKS: Final = 100


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


@dataclass(frozen=True, eq=False)
class Conics:
    """The ways of m stars over an exposure, bent and unevenly run, as swept trails are drawn: a conic a segment.

    In each of s segments the vector to a star is a quadratic of time, through its beginning, its middle and its end.
    What a pinhole makes of that is a conic; a lens bends it.

    Attributes
    ----------
    camera : Camera
    knots : (3, 2 s + 1, m) float64
        Vectors in the camera frame at the beginning, the middle and the end of the first segment, which is the
        beginning of the second, and so on; NaN under the horizon.
    weight : (s,) float64
        What both ends of each segment are worth: `end_weights`.
    share : (s,) float64
        How much of the exposure each segment lasts.
    apart_px : float
        How far apart stars on the image are looked at, at the most and behind the pinhole.
    """

    camera: Camera
    knots: Float
    weight: Float
    share: Float
    apart_px: float

    @cached_property
    def counts(self) -> NDArray[np.intp]:
        """Into how many parts each segment is cut, (s,); a star is looked at in the middle of each."""
        chord_px = self._knots_px[:, 2::2] - self._knots_px[:, :-2:2]
        length_px = np.sqrt((chord_px * chord_px).sum(axis=0))  # in a fifth of hypot's time
        seen = self.camera.pinhole.contains(self._knots_px[:, 1::2].transpose(1, 2, 0))
        longest_px = np.fmax.reduce(length_px, axis=1, where=seen, initial=0.0)
        counts = np.maximum(np.ceil(longest_px / self.apart_px), np.ceil(_LEAST_LOOKS * self.share))
        return np.asarray(counts, dtype=np.intp)

    def pieces(self) -> Iterator["Conics"]:
        """Return the same ways a few segments at a time: in a part of a turn most stars are on the image or off it.

        Yields
        ------
        Conics
            All stars, over the next part of the exposure: of some two hundred looks, if a segment has not more.
        """
        piece = np.cumsum(self.counts) // (2 * _LEAST_LOOKS)
        if piece[-1] == 0:
            yield self
            return
        first = np.flatnonzero(np.diff(piece, prepend=-1))
        for begin, end in zip(first, [*first[1:], len(piece)], strict=True):
            knots = self.knots[:, 2 * begin : 2 * end + 1]
            yield replace(self, knots=knots, weight=self.weight[begin:end], share=self.share[begin:end])

    @property
    def box_px(self) -> Float:
        """What `Places.box_px` is, or a little more; behind a pinhole."""
        begin, middle, end = self._parts(self.knots)
        # A conic does not leave the triangle of its ends and of where its tangents there meet.
        corner = _projected(self.camera.pinhole, 2 * middle - (begin + end) / 2)
        ends = self._knots_px[:, ::2]
        return _box(np.minimum(ends.min(axis=1), corner.min(axis=1)), np.maximum(ends.max(axis=1), corner.max(axis=1)))

    @property
    def sum_px(self) -> Float:
        """What `Places.sum_px` is of looks without end; behind a pinhole."""
        # Boole's rule: ways are so smooth that it has all of their digits.
        begin, rate, bend = self._quadratics()
        early, late = (_projected(self.camera.pinhole, begin + u * (rate + u * bend)) for u in (0.25, 0.75))
        begin, middle, end = self._knots_px[:, :-2:2], self._knots_px[:, 1::2], self._knots_px[:, 2::2]
        nineties: Float = 7 * (begin + end) + 32 * (early + late) + 12 * middle
        return np.stack([self.share @ places for places in nineties]) / 90

    def places(self, segment: NDArray[np.intp], passed: Float) -> Float:
        """Return where all the stars are at some moments.

        Parameters
        ----------
        segment : (n,) intp
            The segment of each moment.
        passed : (n,) float64
            Which share of it has passed.

        Returns
        -------
        (n, m, 2) float64
            Places (x, y), px; NaN behind the camera and under the horizon.
        """
        return self.camera.project(_quadratic(self._quadratics(), segment, passed).transpose(1, 2, 0))

    def looks(self, which: NDArray[np.intp]) -> Iterator[tuple[Float, Float]]:
        """Return where some of the stars are, as `Places.looks` does."""
        if not which.size:
            return
        quadratics = self._quadratics(which)
        segment = np.repeat(np.arange(len(self.counts)), self.counts)
        first = np.repeat(np.cumsum(self.counts) - self.counts, self.counts)
        passed = (np.arange(len(segment)) - first + 0.5) / self.counts[segment]
        share = self.share[segment] / self.counts[segment]
        together = moments_a_block(len(which))
        for start in range(0, len(segment), together):
            block = slice(start, start + together)
            vectors = _quadratic(quadratics, segment[block], passed[block])
            yield self.camera.project(vectors.transpose(1, 2, 0)), share[block]

    def _parts(self, knots: Float) -> tuple[Float, Float, Float]:
        """Return the beginning, the middle and the end of each segment, weighted."""
        weight = self.weight[:, np.newaxis]
        return knots[:, :-2:2] * weight, knots[:, 1::2], knots[:, 2::2] * weight

    def _quadratics(self, which: NDArray[np.intp] | None = None) -> tuple[Float, Float, Float]:
        """Return the coefficients of vectors as quadratics of the share of a segment that has passed, of some stars."""
        begin, middle, end = self._parts(self.knots if which is None else self.knots.take(which, axis=2))
        return begin, 4 * middle - 3 * begin - end, 2 * (begin - 2 * middle + end)

    @cached_property
    def _knots_px(self) -> Float:
        """Columns and rows at all knots behind the pinhole, (2, 2 s + 1, m) px."""
        return _projected(self.camera.pinhole, self.knots)


def end_weights(begins: Float, ends: Float) -> Float:
    """Return what the ends of turns are worth, their middles 1, so that quadratics through the three have their ways.

    Parameters
    ----------
    begins, ends : (n, 3, 3) float64
        Rotation matrices into the camera frame where each of n turns begins and ends.

    Returns
    -------
    (n,) float64

    Notes
    -----
    A vector that turns by an angle is a + b cos + c sin of it.  Times 1 + t^2, with t the tangent of half the angle,
    that is a quadratic of t, and so of time if t goes with time, as it nearly does.  A pinhole does not see the factor,
    which is 1 / cos^2(turn / 4) where a turn begins and ends, if the angle is told from its middle.
    """
    chord = ends - begins
    sine2 = np.einsum("nij,nij->n", chord, chord) / 8  # of half the turn
    weights: Float = 2 / (1 + np.sqrt(np.maximum(1 - sine2, 0.0)))
    return weights


def _quadratic(coefficients: tuple[Float, Float, Float], segment: NDArray[np.intp], passed: Float) -> Float:
    """Return quadratics, (3, n, m), of coefficients, (3, s, m) each, at moments in segments, both (n,)."""
    when = passed[:, np.newaxis]
    k = segment[:1] if segment[0] == segment[-1] else segment
    begin, rate, bend = (of.take(k, axis=1) for of in coefficients)
    vectors = when * bend
    vectors += rate
    vectors *= when
    vectors += begin
    return vectors


def _projected(camera: Camera, vectors: Float) -> Float:
    """Return columns and rows, (2, n, m) px, of vectors in the camera frame, (3, n, m)."""
    return camera.project(vectors.transpose(1, 2, 0)).transpose(2, 0, 1)


def _box(lowest: Float, highest: Float) -> Float:
    return np.moveaxis(np.stack([lowest, highest]), 1, -1)
