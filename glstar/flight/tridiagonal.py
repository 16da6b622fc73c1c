"""Equations each of which knows two neighbours."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.flight.rotationvector import apply

__all__ = ["BlockTridiagonal"]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BlockTridiagonal:
    """Equations each of which knows two neighbours, solved by cyclic reduction.

    Every other unknown is put into the equations of its neighbours until one is left: O(n), in log2(n) steps of whole
    arrays.  Stable, for the diagonal outweighs what is beside it.

    Attributes
    ----------
    levels : tuple of tuples of five (m, 3, 3) float64
        Of each step the inverses of the blocks that were eliminated, these times what was to their left and right, and
        the blocks that lead to them from the left and the right.
    last : (1, 3, 3) float64
        The inverse of the block that is left.
    """

    levels: tuple[tuple[Float, Float, Float, Float, Float], ...]
    last: Float

    @classmethod
    def of(cls, below: Float, diagonal: Float, above: Float) -> Self:
        """Eliminate; each argument holds (n, 3, 3) blocks."""
        levels = []
        while (n := len(diagonal)) > 1:
            # A last equation that says nothing gives each that is eliminated two neighbours.
            below, diagonal, above = (_odd(block) for block in (below, diagonal, above))
            if n % 2 == 0:
                diagonal[-1] = np.eye(3)
            inverse = _inverse(diagonal[1::2])
            left, right = inverse @ below[1::2], inverse @ above[1::2]
            from_left, from_right = below[2::2], above[:-1:2]
            levels.append((inverse, left, right, from_left, from_right))
            kept = diagonal[::2].copy()
            kept[1:] -= from_left @ right
            kept[:-1] -= from_right @ left
            below, above = np.zeros_like(kept), np.zeros_like(kept)
            below[1:], above[:-1] = -from_left @ left, -from_right @ right
            half = (n + 1) // 2
            below, diagonal, above = below[:half], kept[:half], above[:half]
        return cls(tuple(levels), _inverse(diagonal))

    def solve(self, right_side: Float) -> Float:
        """Return the (n, 3) unknowns of (n, 3) right sides."""
        sides: list[Float] = []
        side = right_side
        for inverse, _, _, from_left, from_right in self.levels:
            sides.append(side)
            whole = _odd(side)
            eliminated = apply(inverse, whole[1::2])
            kept = whole[::2].copy()
            kept[1:] -= apply(from_left, eliminated)
            kept[:-1] -= apply(from_right, eliminated)
            side = kept[: (len(side) + 1) // 2]
        found = apply(self.last, side)
        for (inverse, left, right, _, _), side in zip(reversed(self.levels), reversed(sides), strict=True):
            whole = _odd(side).copy()
            odd = apply(inverse, whole[1::2])
            whole[: len(side) : 2] = found
            odd -= apply(left, whole[:-1:2]) + apply(right, whole[2::2])
            whole[1::2] = odd
            found = whole[: len(side)]
        return found


def _inverse(blocks: Float) -> Float:
    return np.asarray(np.linalg.inv(blocks), dtype=np.float64)


def _odd(blocks: Float) -> Float:
    """Return blocks in an odd number: with one of zeros more, if need be."""
    return blocks if len(blocks) % 2 else np.concatenate((blocks, np.zeros_like(blocks[:1])))
