"""Curves on the sky, and what of them falls on the image.

A curve is a row of unit vectors, near enough to each other that the straight chord between two lies within
`TOLERANCE_PX` of the curve on the image.  The chords are cut in space, by the planes through the camera that bound the
image (and by the horizon where a curve shall end there), and projected after that: what is behind the camera never
comes across the image.
"""

from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.sky.apparent import direction

__all__ = [
    "REFRACTION_BEND",
    "TOLERANCE_PX",
    "Crossings",
    "Curves",
    "ImageRegion",
    "Polylines",
    "cut",
    "finest_step_rad",
    "great_circle",
    "inside_window",
    "parallel",
    "window_planes",
]

Float = NDArray[np.float64]

# How far a chord may lie from its curve, px of the image.
TOLERANCE_PX: Final = 0.2

# Chords of great circles are straight on the image however long they are; shorter ones are culled better.
_LONGEST_RAD: Final = np.deg2rad(5.0)
_SHORTEST_RAD: Final = np.deg2rad(0.2)

# How sharply refraction bends a straight line at the horizon, and no sharper anywhere, 1/rad: the second derivative of
# eq. (25) is 3.2 per radian there, in standard air.
REFRACTION_BEND: Final = 4.0

# Where a label stands beside the edge that its curve crosses: left, right, top, bottom (0 to 1 across the text).
_ANCHOR_AT_EDGE = np.array([[0.0, 0.5], [1.0, 0.5], [0.5, 0.0], [0.5, 1.0]])


class ImageRegion(NamedTuple):
    """A part of the image, px."""

    left_px: float
    top_px: float
    right_px: float
    bottom_px: float

    def contains(self, xy_px: Float) -> NDArray[np.bool_]:
        """Return which of some positions (..., 2) lie in the window; NaN is nowhere."""
        x, y = xy_px[..., 0], xy_px[..., 1]
        within = (x >= self.left_px) & (x <= self.right_px) & (y >= self.top_px) & (y <= self.bottom_px)
        return np.asarray(within)


class Polylines(NamedTuple):
    """Lines on the image.

    Attributes
    ----------
    xy_px : (n, 2) float64
        Their points one after another, px.
    starts : (m,) intp
        Which point is the first of each line.
    curve : (m,) intp
        Which curve each line is of, in rising order.
    """

    xy_px: Float
    starts: NDArray[np.intp]
    curve: NDArray[np.intp]

    def of_curves(self, first: int, last: int) -> "Polylines":
        """Return the lines of some of the curves, the last of them excluded."""
        a, b = np.searchsorted(self.curve, (first, last))
        bounds = np.append(self.starts, len(self.xy_px))
        return Polylines(self.xy_px[bounds[a] : bounds[b]], self.starts[a:b] - bounds[a], self.curve[a:b])


class Crossings(NamedTuple):
    """Where curves cross the edge of a window.

    Attributes
    ----------
    curve : (n,) intp
        Which curve.
    xy_px : (n, 2) float64
        Where, px.
    anchor : (n, 2) float64
        Which point of a text that stands inside the window falls there: across and down, 0 to 1.
    """

    curve: NDArray[np.intp]
    xy_px: Float
    anchor: Float

    def of_curves(self, first: int, last: int) -> "Crossings":
        """Return the crossings of some of the curves, the last of them excluded, counted from the first."""
        these = (self.curve >= first) & (self.curve < last)
        return Crossings(self.curve[these] - first, self.xy_px[these], self.anchor[these])


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Curves as chains of vectors.

    Attributes
    ----------
    vector : (n, 3) float64
        Their vertices one after another.
    curve : (n,) intp
        Which curve each vertex belongs to.
    count : int
        How many curves there are.
    step_rad : float
        The longest chord, rad.
    """

    vector: Float
    curve: NDArray[np.intp]
    count: int
    step_rad: float

    @classmethod
    def of(cls, chains: list[Float]) -> Self:
        """Return chains of unit vectors, each (n, 3), as curves in their order."""
        if not chains:
            return cls(np.empty((0, 3)), np.empty(0, dtype=np.intp), 0, 0.0)
        chord = max(np.linalg.norm(np.diff(chain, axis=0), axis=1).max(initial=0.0) for chain in chains)
        curve = np.repeat(np.arange(len(chains)), [len(chain) for chain in chains])
        return cls(np.concatenate(chains), curve, len(chains), float(2 * np.arcsin(min(chord / 2, 1.0))))

    def near(self, axis: Float, radius_rad: float) -> tuple[Float, NDArray[np.intp], NDArray[np.bool_]]:
        """Return what may fall into a cone.

        Parameters
        ----------
        axis : (3,) float64
            A unit vector.
        radius_rad : float
            The cone's radius, rad.

        Returns
        -------
        vector : (k, 3) float64
            Every vertex of a chord that touches the cone.
        curve : (k,) intp
            Which curve each belongs to.
        joined : (k,) bool
            Whether there is a chord from a vertex to the next.
        """
        reach_rad = radius_rad + self.step_rad
        kept = np.arange(len(self.vector))
        if reach_rad < np.pi:
            kept = np.flatnonzero(self.vector @ axis > np.cos(reach_rad))
        curve = self.curve[kept]
        joined = np.zeros(len(kept), dtype=np.bool_)
        joined[:-1] = (kept[1:] - kept[:-1] == 1) & (curve[1:] == curve[:-1])
        return self.vector[kept], curve, joined


def finest_step_rad(camera: Camera, bend: float) -> float:
    """Return how long a chord may be.

    Parameters
    ----------
    camera : Camera
    bend : float
        How sharply the curve turns away from a great circle: the tangent of the latitude of a parallel.

    Returns
    -------
    float
        rad.  A chord of length s lies bend s^2 / 8 from its curve, and at the image's corner a pinhole stretches that
        by focal length / cos^2.  A lens bends great circles too, whose chords are longer by 1 / cos^2 in its plane.
    """
    stretch_px = camera.most_px_per_rad * (1 + abs(camera.skew_px) / camera.fx_px)
    bend += camera.bend / np.cos(camera.reach_rad) ** 2
    step_rad = np.sqrt(8 * TOLERANCE_PX / (stretch_px * max(bend, 1e-9)))
    return float(np.clip(step_rad, _SHORTEST_RAD, _LONGEST_RAD))


def parallel(latitude_rad: float, step_rad: float) -> Float:
    """Return a whole parallel, (n, 3) unit vectors, in chords of at most a step; every 5 deg there is a vertex."""
    n = 72 * ceil(2 * np.pi * np.cos(latitude_rad) / step_rad / 72)
    return direction(np.linspace(0, 2 * np.pi, n + 1), latitude_rad)


def great_circle(ends: Float, step_rad: float) -> Float:
    """Return the great circle's arcs between unit vectors (n, 3), in chords of at most a step."""
    chain = [ends[:1]]
    for a, b in pairwise(ends):
        angle_rad = 2 * np.arcsin(min(float(np.linalg.norm(b - a)) / 2, 1.0))
        n = max(1, ceil(angle_rad / step_rad))
        share = np.arange(1, n + 1)[:, np.newaxis] * (angle_rad / n)
        chain.append(
            (np.sin(angle_rad - share) * a + np.sin(share) * b) / np.sin(angle_rad) if n > 1 else b[np.newaxis]
        )
    return np.concatenate(chain)


def window_planes(camera: Camera, window: ImageRegion) -> Float:
    """Return the four planes through the camera that bound a window: left, right, top, bottom.

    Parameters
    ----------
    camera : Camera
    window : ImageRegion

    Returns
    -------
    (4, 3) float64
        Normals in the camera frame, inwards: v is seen in the window where all four products with v are positive,
        which is only ahead of the camera.
    """
    x, y, z = camera.K
    return np.stack([x - window.left_px * z, window.right_px * z - x, y - window.top_px * z, window.bottom_px * z - y])


def inside_window(xy_px: Float, window: ImageRegion) -> Float:
    """Return how far places (n, 2) are inside the left, right, top and bottom edge of a window, (n, 4) px."""
    x, y = xy_px[:, 0], xy_px[:, 1]
    return np.stack([x - window.left_px, window.right_px - x, y - window.top_px, window.bottom_px - y], axis=1)


def cut(
    vector: Float, inside: Float, joined: NDArray[np.bool_], curve: NDArray[np.intp], camera: Camera
) -> tuple[Polylines, Crossings]:
    """Cut chains of chords by planes through the camera, and project what is left.

    Parameters
    ----------
    vector : (n, 3) float64
        Vertices in the camera frame.
    inside : (n, k) float64
        How far each is on the inner side of each plane, for the k of 4 to 8 planes; the first four are those of
        `window_planes`, or, behind a lens, what `inside_window` says.
    joined : (n,) bool
        Whether there is a chord from a vertex to the next.
    curve : (n,) intp
        Which curve each vertex belongs to, in rising order.
    camera : Camera

    Returns
    -------
    Polylines, Crossings
    """
    # One bit a plane: chords with both ends outside of one and the same plane are out of sight.
    outside = np.packbits(inside < 0, axis=1)[:, 0]
    maybe = np.flatnonzero(joined[:-1] & (outside[:-1] & outside[1:] == 0))
    from_u, to_u = np.zeros(len(maybe)), np.ones(len(maybe))
    entered, left = np.zeros(len(maybe), dtype=np.intp), np.zeros(len(maybe), dtype=np.intp)
    crossing = np.flatnonzero(outside[maybe] | outside[maybe + 1])
    a, b = inside[maybe[crossing]], inside[maybe[crossing] + 1]
    enters, leaves = (a < 0) & (b >= 0), (a >= 0) & (b < 0)
    at = a / np.where(enters | leaves, a - b, np.inf)
    number = np.arange(len(crossing))
    entered[crossing] = (enters * at).argmax(axis=1)
    left[crossing] = (leaves * (at - 1)).argmin(axis=1)
    from_u[crossing] = (enters * at)[number, entered[crossing]]
    to_u[crossing] = 1 + (leaves * (at - 1))[number, left[crossing]]

    seen = from_u < to_u
    maybe, from_u, to_u = maybe[seen], from_u[seen], to_u[seen]
    entered, left = entered[seen], left[seen]
    start, chord = vector[maybe], vector[maybe + 1] - vector[maybe]
    ends = camera.project(np.array([start + from_u[:, np.newaxis] * chord, start + to_u[:, np.newaxis] * chord]))
    entering, leaving = from_u > 0, to_u < 1
    edge = np.concatenate([entered[entering], left[leaving]])
    at_edge = edge < len(_ANCHOR_AT_EDGE)
    index = np.concatenate([maybe[entering], maybe[leaving]])[at_edge]
    crossings = Crossings(
        curve=curve[index],
        xy_px=np.concatenate([ends[0, entering], ends[1, leaving]])[at_edge],
        anchor=_ANCHOR_AT_EDGE[edge[at_edge]],
    )
    # A line goes on where a chord begins at the whole end of the one before it.
    new = np.ones(len(maybe), dtype=np.bool_)
    new[1:] = (np.diff(maybe) != 1) | entering[1:] | leaving[:-1]
    return _chained(ends, new, curve[maybe]), crossings


def _chained(ends: Float, new: NDArray[np.bool_], curve: NDArray[np.intp]) -> Polylines:
    """Return chords (2, n, 2) as polylines, in which the end of one is the start of the next that is not new."""
    first = np.flatnonzero(new)
    starts = first + np.arange(len(first))
    xy = np.empty((len(new) + len(first), 2))
    xy[starts] = ends[0, first]
    xy[np.arange(len(new)) + np.cumsum(new)] = ends[1]
    return Polylines(xy, starts, curve[first])
