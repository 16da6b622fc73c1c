"""What each line of a star's path receives of the light of the others, as sums over those that are near it.

Paths are chains of lines, and each line is a Gaussian.  Neighbours are computed for all stars at once; blocks of
consecutive lines where a path comes near itself again.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float32

# Consecutive lines of a block.
_BLOCK_LINES = 8
# Blocks that are at a larger distance than this, sigma, do not count: 4e-4 of the light of wide stars.
FAR_SIGMA = 5.0
# Pairs of lines, or of lines and places, that are computed at once: more of them fall out of the processor's cache.
PAIRS_AT_ONCE = 32_768
# Light that is farther than this, in units of the exponent, does not count; and smaller numbers are slow.
_FAR_EXPONENT = np.float32(-40.0)


class Gaussians(NamedTuple):
    """The lines of stars as Gaussians, (n, m) each, in the order of the path; lengths in sqrt(2) sigma."""

    x: Float32  # Middles
    y: Float32
    a: Float32  # Coefficients of x^2, x y and y^2 in the exponents
    b: Float32
    c: Float32
    height: Float32
    half: Float32  # (2, n, m) half of their extents along x and y

    def light(self, line: NDArray[np.intp], star: NDArray[np.intp]) -> Float32:
        """Return the light of all lines of some stars at a middle of each, (n, p) for (p,) both."""
        x, y = (middle[line, star] - middle[:, star] for middle in (self.x, self.y))
        a, b, c, height = (each[:, star] for each in self[2:6])
        return height * _exponential(a * x * x + b * x * y + c * y * y)


def light_sums(lines: Gaussians, is_needed: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Return the sums of Gaussians, and of their squares over their heights, at each middle, (n, m) both.

    `is_needed` (n, m): at which middles.
    """
    count, stars = lines.x.shape
    longest = np.sqrt(np.square(lines.half).sum(axis=0)).max(axis=0, initial=0.0)
    at_once = max(1, PAIRS_AT_ONCE // count)
    both = np.empty((2, count, stars), np.float32)
    for first in range(0, stars, at_once):
        some = slice(first, first + at_once)
        part = Gaussians(*(np.ascontiguousarray(each[..., some]) for each in lines))
        sums = _of_neighbours(part, float(longest[some].max()))
        if count > 2 * _BLOCK_LINES:
            _add_returning(sums, part, is_needed[:, some])
        both[:, :, some] = sums
    return both[0], both[1]


def _of_neighbours(lines: Gaussians, longest: float) -> Float32:
    """Return the sums over the lines of each line's own block and of the next ones, (2, n, m)."""
    count = len(lines.x)
    sums = np.stack([lines.height, lines.height])
    far2 = np.float32((FAR_SIGMA / sqrt(2) + longest) ** 2)
    for separation in range(1, min(count, 2 * _BLOCK_LINES)):
        first: NDArray[np.intp] | slice = slice(0, count - separation)
        if separation > _BLOCK_LINES:
            line = np.arange(count - separation)
            first = line[line % _BLOCK_LINES + separation < 2 * _BLOCK_LINES]
        x, y = (each[separation:][first] - each[first] for each in (lines.x, lines.y))
        xx, yy = x * x, y * y
        near = np.flatnonzero((xx + yy < far2).any(axis=1))
        if not near.size:
            continue
        some = slice(near[0], near[-1] + 1)
        first = first[some] if isinstance(first, np.ndarray) else some
        xx, xy, yy = xx[some], np.multiply(x, y, out=x)[some], yy[some]
        for to, of in ((0, separation), (separation, 0)):
            a, b, c, height = (each[of:][first] for each in lines[2:6])
            light = a * xx
            light += b * xy
            light += c * yy
            _exponential(light)
            height = height * light
            sums[0, to:][first] += height
            height *= light
            sums[1, to:][first] += height
    return sums


def _add_returning(sums: Float32, lines: Gaussians, is_needed: NDArray[np.bool_]) -> None:
    """Add the light of blocks that are near without being neighbours, because a path returns or crosses itself."""
    count, stars = lines.x.shape
    star, target, source = _near_blocks(lines, is_needed)
    within = np.arange(_BLOCK_LINES)[:, np.newaxis]
    at_once = PAIRS_AT_ONCE // _BLOCK_LINES**2
    for begin in range(0, len(star), at_once):
        some = slice(begin, begin + at_once)
        # A last block that is shorter has its last line again, without light.
        to, of = (_BLOCK_LINES * block[some] + within for block in (target, source))
        is_line = of < count
        to, of = (np.minimum(line, count - 1) * stars + star[some] for line in (to, of))
        # The pairs of blocks are the last axis: loops over a few lines are slow.
        x, y = (each.take(to)[:, np.newaxis] - each.take(of) for each in (lines.x, lines.y))
        a, b, c, height = (each.take(of) for each in lines[2:6])
        height *= is_line
        exponent = b * x
        exponent *= y
        x *= x
        x *= a
        exponent += x
        y *= y
        y *= c
        exponent += y
        light = _exponential(exponent)
        begins = np.flatnonzero(np.diff(to[0], prepend=-1))
        to = to[:, begins]
        for square, total in enumerate(sums.reshape(2, -1)):
            if square:
                light *= light
            # Without OpenBLAS, whose rounding depends on how many threads it has.
            total[to] += np.add.reduceat(np.einsum("tsp,sp->tp", light, height), begins, axis=1)


def _near_blocks(
    lines: Gaussians, is_needed: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the stars, blocks that need light and blocks near them, but not next to them, (p,) each."""
    starts = np.arange(0, len(lines.x), _BLOCK_LINES)
    needed = np.logical_or.reduceat(is_needed, starts, axis=0).T
    number = np.arange(len(starts))
    is_near = needed[:, :, np.newaxis] & (np.abs(number[:, np.newaxis] - number) > 1)
    for middle, extent in zip((lines.x, lines.y), lines.half, strict=True):
        low = np.minimum.reduceat(middle - extent, starts, axis=0).T
        high = np.maximum.reduceat(middle + extent, starts, axis=0).T
        is_reached = low[:, :, np.newaxis] < high[:, np.newaxis] + np.float32(FAR_SIGMA / sqrt(2))
        is_near &= is_reached
        is_near &= is_reached.swapaxes(1, 2)
    star, target, source = is_near.nonzero()
    return star, target, source


def _exponential(exponent: Float32) -> Float32:
    """Return the exponential function of negative numbers, in their place."""
    # Rounding may exceed 0 beside very long lines.
    np.clip(exponent, _FAR_EXPONENT, np.float32(0.0), out=exponent)
    return np.exp(exponent, out=exponent)
