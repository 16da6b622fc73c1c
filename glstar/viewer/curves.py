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

from glstar.apparent import direction
from glstar.camera import Camera

__all__ = [
    "REFRACTION_BEND",
    "TOLERANCE_PX",
    "Crossings",
    "Curves",
    "Polylines",
    "Window",
    "cut",
    "finest_step_rad",
    "great_circle",
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


class Window(NamedTuple):
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
    """

    xy_px: Float
    starts: NDArray[np.intp]


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


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Curves as chains of vectors.

    Attributes
    ----------
    vector : (n, 3) float64
        Their vertices one after another.
    curve : (n,) intp
        Which curve each vertex belongs to.
    step_rad : float
        The longest chord, rad.
    """

    vector: Float
    curve: NDArray[np.intp]
    step_rad: float

    @classmethod
    def of(cls, chains: list[Float]) -> Self:
        """Return chains of unit vectors, each (n, 3), as curves in their order."""
        if not chains:
            return cls(np.empty((0, 3)), np.empty(0, dtype=np.intp), 0.0)
        chord = max(np.linalg.norm(np.diff(chain, axis=0), axis=1).max(initial=0.0) for chain in chains)
        curve = np.repeat(np.arange(len(chains)), [len(chain) for chain in chains])
        return cls(np.concatenate(chains), curve, float(2 * np.arcsin(min(chord / 2, 1.0))))

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
        joined : (k - 1,) bool
            Whether there is a chord between a vertex and the next.
        """
        reach_rad = radius_rad + self.step_rad
        kept = np.arange(len(self.vector))
        if reach_rad < np.pi:
            kept = np.flatnonzero(self.vector @ axis > np.cos(reach_rad))
        curve = self.curve[kept]
        return self.vector[kept], curve, (np.diff(kept) == 1) & (np.diff(curve) == 0)


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
        by focal length / cos^2.
    """
    stretch_px = max(camera.fx_px, camera.fy_px) * (1 + abs(camera.skew_px) / camera.fx_px)
    stretch_px /= np.cos(camera.reach_rad) ** 2
    step_rad = np.sqrt(8 * TOLERANCE_PX / (stretch_px * max(bend, 1e-9)))
    return float(np.clip(step_rad, _SHORTEST_RAD, _LONGEST_RAD))


def parallel(latitude_rad: float, step_rad: float) -> Float:
    """Return a whole parallel, (n, 3) unit vectors, in chords of at most a step."""
    n = max(8, ceil(2 * np.pi * np.cos(latitude_rad) / step_rad))
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


def window_planes(camera: Camera, window: Window) -> Float:
    """Return the four planes through the camera that bound a window: left, right, top, bottom.

    Parameters
    ----------
    camera : Camera
    window : Window

    Returns
    -------
    (4, 3) float64
        Normals in the camera frame, inwards: v is seen in the window where all four products with v are positive,
        which is only ahead of the camera.
    """
    x, y, z = camera.K
    return np.stack([x - window.left_px * z, window.right_px * z - x, y - window.top_px * z, window.bottom_px * z - y])


def cut(
    vector: Float, joined: NDArray[np.bool_], planes: Float, camera: Camera, curve: NDArray[np.intp] | None = None
) -> tuple[Polylines, Crossings]:
    """Cut chains of chords by planes, and project what is left.

    Parameters
    ----------
    vector : (n, 3) float64
        Vertices in the camera frame, of nearly equal length.
    joined : (n - 1,) bool
        Whether there is a chord between a vertex and the next.
    planes : (4 or more, 3) float64
        Normals inwards; the first four are those of `window_planes`.
    camera : Camera
    curve : (n,) intp, optional
        Which curve each vertex belongs to.

    Returns
    -------
    Polylines, Crossings
    """
    height = vector @ planes.T
    outside = height < 0
    maybe = np.flatnonzero(joined & ~(outside[:-1] & outside[1:]).any(axis=1))
    a, b = height[maybe], height[maybe + 1]
    leaves, enters = (a >= 0) & (b < 0), (a < 0) & (b >= 0)
    at = np.where(leaves | enters, a, 0.0) / np.where(leaves | enters, a - b, 1.0)
    first = np.where(enters, at, 0.0)
    last = np.where(leaves, at, 1.0)
    u0, u1 = first.max(axis=1), last.min(axis=1)
    left = np.flatnonzero(u0 < u1)
    maybe, u0, u1 = maybe[left], u0[left, np.newaxis], u1[left, np.newaxis]
    start, chord = vector[maybe], vector[maybe + 1] - vector[maybe]
    ends = camera.project(np.stack([start + u0 * chord, start + u1 * chord]))
    entering, leaving = u0[:, 0] > 0, u1[:, 0] < 1
    edge = np.concatenate([first[left].argmax(axis=1)[entering], last[left].argmin(axis=1)[leaving]])
    at_edge = edge < len(_ANCHOR_AT_EDGE)
    index = np.concatenate([maybe[entering], maybe[leaving]])[at_edge]
    crossings = Crossings(
        curve=np.zeros_like(index) if curve is None else curve[index],
        xy_px=np.concatenate([ends[0, entering], ends[1, leaving]])[at_edge],
        anchor=_ANCHOR_AT_EDGE[edge[at_edge]],
    )
    return _chained(ends, new=_new(maybe, entering, leaving)), crossings


def _new(index: NDArray[np.intp], entering: NDArray[np.bool_], leaving: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which chords do not begin where the one before them ends."""
    new = np.ones(len(index), dtype=np.bool_)
    new[1:] = (np.diff(index) != 1) | entering[1:] | leaving[:-1]
    return new


def _chained(ends: Float, *, new: NDArray[np.bool_]) -> Polylines:
    """Return chords (2, n, 2) as polylines, in which the end of one is the start of the next."""
    number = np.arange(len(new))
    line = np.cumsum(new)
    first = np.flatnonzero(new)
    starts = first + np.arange(len(first))
    xy = np.empty((len(new) + len(first), 2))
    xy[starts] = ends[0, first]
    xy[number + line] = ends[1]
    return Polylines(xy, starts)
