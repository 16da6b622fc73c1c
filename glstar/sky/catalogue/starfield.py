"""The stars of one epoch for the renderer, and the cells of the sky in which those near a direction are found."""

from dataclasses import dataclass
from math import cos, pi
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float

# Width of a cell, rad: 2 deg.
_CELL_RAD = np.deg2rad(2.0)
# Rounding of dot products may put a star this much outside of its cell, rad.
_SLACK_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class StarField:
    """Apparent directions of stars at one epoch.

    Directions are uploaded to the GPU once and used for hours: apparent places change by 0.03" in the first hour.
    """

    catalogue: str  # The catalogue that numbers the stars, as in `glstar.sky.catalogue.reading.StarCatalogue`
    star_id: NDArray[np.int32]  # (n,) int32: the stars' numbers in that catalogue
    name: tuple[str, ...]  # Proper names or designations; empty for stars without a name
    vmag: NDArray[np.float64]  # (n,) V magnitudes
    # (n, 3) geocentric apparent unit vectors, true equator and equinox of `epoch_utc_s`.
    direction_eq: NDArray[np.float64]
    epoch_utc_s: float  # UTC seconds since 1970
    C_eq_icrs: NDArray[np.float64]  # (3, 3) matrix from ICRS to the true equator and equinox of that epoch
    # (n,) or None: magnitudes in the band of the camera; None if they were not measured.
    measured_mag: NDArray[np.float64] | None = None
    # (n,) or None: colours B - V of the catalogue, NaN where it has none; None if it has none at all.
    bv: NDArray[np.float64] | None = None
    # (n,) bool or None: which of `measured_mag` were measured, where the others are V magnitudes; None if all were.
    is_measured: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        for array in (self.star_id, self.vmag, self.direction_eq, self.C_eq_icrs, self.camera_mag):
            array.flags.writeable = False

    @property
    def camera_mag(self) -> NDArray[np.float64]:
        """The magnitudes with which the stars are rendered, (n,) float64."""
        return self.vmag if self.measured_mag is None else self.measured_mag

    def __len__(self) -> int:
        return int(self.vmag.size)


@dataclass(frozen=True, slots=True, eq=False)
class SkyCells:
    """Directions sorted into zones of declination that are divided in right ascension."""

    directions: Float  # (n, 3) unit vectors
    order: NDArray[np.intp]  # (n,) indices of the directions, sorted by cell and ascending within one
    first: NDArray[np.intp]  # (c + 1,) start of each cell in `order`
    centre: Float  # (c, 3) unit vectors
    radius_rad: Float  # (c,) largest angle of a cell's directions from its centre

    @classmethod
    def of(cls, directions: Float) -> Self:
        """Sort unit vectors, (n, 3), into cells; empty cells are omitted."""
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
        cell_number = np.repeat(np.arange(len(first) - 1), np.diff(first))
        chord = np.linalg.norm(sorted_directions - centre[cell_number], axis=1)
        radius_rad = 2 * np.arcsin(np.minimum(np.maximum.reduceat(chord, first[:-1]) / 2, 1.0)) + _SLACK_RAD
        return cls(directions, order, first, centre, radius_rad)

    def within(self, axis: Float, radius_rad: float) -> NDArray[np.intp]:
        """Return the ascending indices of the directions in a cone.

        `axis` (3,): unit vector; `radius_rad`: largest angle from the axis, below pi.
        """
        near = np.flatnonzero(self.centre @ axis > np.cos(np.minimum(radius_rad + self.radius_rad, pi)))
        if not near.size:
            return np.empty(0, dtype=np.intp)
        index = np.concatenate([self.order[self.first[k] : self.first[k + 1]] for k in near])
        index = index[self.directions.take(index, axis=0) @ axis > cos(radius_rad)]
        index.sort()
        return index
