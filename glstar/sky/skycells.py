"""Cells of the sky: finds the stars near a direction without a look at all of them."""

from dataclasses import dataclass
from math import cos, pi
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["SkyCells"]

Float = NDArray[np.float64]

# Width of a cell, rad: 2 deg.
_CELL_RAD: Final = np.deg2rad(2.0)
# Rounding of dot products may put a star this much outside of its cell, rad.
_SLACK_RAD: Final = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SkyCells:
    """Directions sorted into zones of declination that are divided in right ascension.

    Attributes
    ----------
    directions : (n, 3) float64
        Unit vectors.
    order : (n,) intp
        Indices of the directions, sorted by cell and rising within one.
    first : (c + 1,) intp
        Where each cell begins in `order`.
    centre : (c, 3) float64
        Unit vectors.
    radius_rad : (c,) float64
        Largest angle of a cell's directions from its centre.
    """

    directions: Float
    order: NDArray[np.intp]
    first: NDArray[np.intp]
    centre: Float
    radius_rad: Float

    @classmethod
    def of(cls, directions: Float) -> Self:
        """Sort directions into cells; cells without one are left out.

        Parameters
        ----------
        directions : (n, 3) float64
            Unit vectors.

        Returns
        -------
        SkyCells
        """
        zones = int(np.ceil(pi / _CELL_RAD))
        zone = np.minimum((np.arcsin(directions[:, 2].clip(-1, 1)) + pi / 2) / pi * zones, zones - 1).astype(np.int64)
        middle = (np.arange(zones) + 0.5) * (pi / zones) - pi / 2
        columns = np.maximum(np.ceil(2 * pi * np.cos(middle) / _CELL_RAD), 1).astype(np.int64)
        turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * pi) % 1.0
        cell = zone * int(columns.max() + 1) + np.minimum(turn * columns[zone], columns[zone] - 1).astype(np.int64)
        order = np.argsort(cell, kind="stable")
        first = np.concatenate([[0], np.flatnonzero(np.diff(cell[order])) + 1, [len(order)]]).astype(np.intp)
        sorted_directions = directions[order]
        centre = np.add.reduceat(sorted_directions, first[:-1])
        centre /= np.linalg.norm(centre, axis=1, keepdims=True)
        of = np.repeat(np.arange(len(first) - 1), np.diff(first))
        chord = np.linalg.norm(sorted_directions - centre[of], axis=1)
        radius_rad = 2 * np.arcsin(np.minimum(np.maximum.reduceat(chord, first[:-1]) / 2, 1.0)) + _SLACK_RAD
        return cls(directions, order, first, centre, radius_rad)

    def within(self, axis: Float, radius_rad: float) -> NDArray[np.intp]:
        """Return the directions in a cone.

        Parameters
        ----------
        axis : (3,) float64
            Unit vector.
        radius_rad : float
            Largest angle from the axis, below pi.

        Returns
        -------
        (k,) intp
            Indices, rising.
        """
        near = np.flatnonzero(self.centre @ axis > np.cos(np.minimum(radius_rad + self.radius_rad, pi)))
        if not near.size:
            return np.empty(0, dtype=np.intp)
        index = np.concatenate([self.order[self.first[k] : self.first[k + 1]] for k in near])
        index = index[self.directions.take(index, axis=0) @ axis > cos(radius_rad)]
        index.sort()
        return index
