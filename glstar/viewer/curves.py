"""Curves on the sky, cut at the edges of the image and projected.

A curve is a chain of unit vectors, so close together that the straight chord between two lies within `TOLERANCE_PX` of
the curve on the image.  The chords are cut in space, by the planes through the camera that bound the image (and by the
horizon if the curve ends there), and projected afterwards, so that nothing behind the camera appears on the image.
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
    "REFRACTION_CURVATURE",
    "TOLERANCE_PX",
    "Crossings",
    "Curves",
    "ImageRegion",
    "Polylines",
    "cut",
    "great_circle",
    "inside_region",
    "max_step_rad",
    "parallel",
    "region_planes",
]

Float = NDArray[np.float64]

# Largest distance of a chord from its curve, px of the image.
TOLERANCE_PX: Final = 0.2

# Limits of the length of chords, rad.  Without refraction and distortion a great circle is straight on the image, and
# chords could have any length; short ones are culled better.
_MAX_STEP_RAD: Final = np.deg2rad(5.0)
_MIN_STEP_RAD: Final = np.deg2rad(0.2)

# Upper bound of the curvature that refraction gives to a straight line, 1/rad: the second derivative of eq. (25) is
# largest at the horizon, 3.2 per radian in standard air.
REFRACTION_CURVATURE: Final = 4.0

# Anchors of labels at the edge that a curve crosses: left, right, top, bottom (0 to 1 across and down the text).
_ANCHOR_AT_EDGE = np.array([[0.0, 0.5], [1.0, 0.5], [0.5, 0.0], [0.5, 1.0]])


class ImageRegion(NamedTuple):
    """A rectangle of the image; its edges are px from the centre of the top-left pixel."""

    left_px: float
    top_px: float
    right_px: float
    bottom_px: float

    def contains(self, xy_px: Float) -> NDArray[np.bool_]:
        """Return which of some positions (..., 2) lie in the region; NaN is outside."""
        x, y = xy_px[..., 0], xy_px[..., 1]
        within = (x >= self.left_px) & (x <= self.right_px) & (y >= self.top_px) & (y <= self.bottom_px)
        return np.asarray(within)

    def intersection(self, other: "ImageRegion") -> "ImageRegion":
        """Return what two regions have in common; its area is zero if they do not overlap."""
        left, top = max(self.left_px, other.left_px), max(self.top_px, other.top_px)
        right, bottom = min(self.right_px, other.right_px), min(self.bottom_px, other.bottom_px)
        return ImageRegion(left, top, max(left, right), max(top, bottom))


class Polylines(NamedTuple):
    """Lines on the image.

    Attributes
    ----------
    xy_px : (n, 2) float64
        The points of all lines, one line after another, px.
    starts : (m,) intp
        Index of the first point of each line.
    curve : (m,) intp
        Index of the curve that each line belongs to, in ascending order.
    """

    xy_px: Float
    starts: NDArray[np.intp]
    curve: NDArray[np.intp]

    def of_curves(self, first: int, last: int) -> "Polylines":
        """Return the lines of the curves from `first` to before `last`."""
        a, b = np.searchsorted(self.curve, (first, last))
        bounds = np.append(self.starts, len(self.xy_px))
        return Polylines(self.xy_px[bounds[a] : bounds[b]], self.starts[a:b] - bounds[a], self.curve[a:b])


class Crossings(NamedTuple):
    """Where curves cross the edge of a region.

    Attributes
    ----------
    curve : (n,) intp
        Index of the curve.
    xy_px : (n, 2) float64
        The position, px.
    anchor : (n, 2) float64
        The point of a label that lies there if the label is inside the region: across and down, 0 to 1.
    """

    curve: NDArray[np.intp]
    xy_px: Float
    anchor: Float

    def of_curves(self, first: int, last: int) -> "Crossings":
        """Return the crossings of the curves from `first` to before `last`, renumbered from 0."""
        these = (self.curve >= first) & (self.curve < last)
        return Crossings(self.curve[these] - first, self.xy_px[these], self.anchor[these])


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Curves as chains of vectors.

    Attributes
    ----------
    vector : (n, 3) float64
        The vertices of all curves, one curve after another.
    curve : (n,) intp
        Index of the curve that each vertex belongs to.
    count : int
        Number of curves.
    step_rad : float
        The length of the longest chord, rad.
    """

    vector: Float
    curve: NDArray[np.intp]
    count: int
    step_rad: float

    @classmethod
    def of(cls, chains: list[Float]) -> Self:
        """Return curves made from chains of unit vectors, each (n, 3)."""
        if not chains:
            return cls(np.empty((0, 3)), np.empty(0, dtype=np.intp), 0, 0.0)
        chord = max(np.linalg.norm(np.diff(chain, axis=0), axis=1).max(initial=0.0) for chain in chains)
        curve = np.repeat(np.arange(len(chains)), [len(chain) for chain in chains])
        return cls(np.concatenate(chains), curve, len(chains), float(2 * np.arcsin(min(chord / 2, 1.0))))

    def near(self, axis: Float, radius_rad: float) -> tuple[Float, NDArray[np.intp], NDArray[np.bool_]]:
        """Return the chords that may touch a cone.

        Parameters
        ----------
        axis : (3,) float64
            A unit vector.
        radius_rad : float
            The cone's radius, rad.

        Returns
        -------
        vector : (k, 3) float64
            All vertices of chords that touch the cone.
        curve : (k,) intp
            Index of the curve that each belongs to.
        joined : (k,) bool
            Whether there is a chord from a vertex to the next one.
        """
        wider_rad = radius_rad + self.step_rad
        kept = np.arange(len(self.vector))
        if wider_rad < np.pi:
            kept = np.flatnonzero(self.vector @ axis > np.cos(wider_rad))
        curve = self.curve[kept]
        joined = np.zeros(len(kept), dtype=np.bool_)
        joined[:-1] = (kept[1:] - kept[:-1] == 1) & (curve[1:] == curve[:-1])
        return self.vector[kept], curve, joined


def max_step_rad(camera: Camera, curvature: float) -> float:
    """Return the largest length of a chord that stays within `TOLERANCE_PX` of its curve on the image.

    Parameters
    ----------
    camera : Camera
    curvature : float
        Geodesic curvature of the curve, 1/rad: of a parallel the tangent of its latitude.

    Returns
    -------
    float
        rad.

    Notes
    -----
    A chord of length s lies curvature * s^2 / 8 from its curve.  At the corner of the image a pinhole camera magnifies
    this to focal length / cos^2 pixels per radian.  Distortion bends great circles, too; there their chords are longer
    by 1 / cos^2 in the image plane.
    """
    scale_px_per_rad = camera.max_px_per_rad * (1 + abs(camera.skew_px) / camera.fx_px)
    curvature += camera.max_curvature / np.cos(camera.field_radius_rad) ** 2
    step_rad = np.sqrt(8 * TOLERANCE_PX / (scale_px_per_rad * max(curvature, 1e-9)))
    return float(np.clip(step_rad, _MIN_STEP_RAD, _MAX_STEP_RAD))


def parallel(latitude_rad: float, step_rad: float) -> Float:
    """Return a circle of latitude, (n, 3) unit vectors, with a vertex at least every step and at every 5 deg."""
    n = 72 * ceil(2 * np.pi * np.cos(latitude_rad) / step_rad / 72)
    return direction(np.linspace(0, 2 * np.pi, n + 1), latitude_rad)


def great_circle(ends: Float, step_rad: float) -> Float:
    """Return the great-circle arcs between consecutive unit vectors (n, 3), with a vertex at least every step."""
    chain = [ends[:1]]
    for a, b in pairwise(ends):
        angle_rad = 2 * np.arcsin(min(float(np.linalg.norm(b - a)) / 2, 1.0))
        n = max(1, ceil(angle_rad / step_rad))
        along_rad = np.arange(1, n + 1)[:, np.newaxis] * (angle_rad / n)
        arc = (
            (np.sin(angle_rad - along_rad) * a + np.sin(along_rad) * b) / np.sin(angle_rad) if n > 1 else b[np.newaxis]
        )
        chain.append(arc)
    return np.concatenate(chain)


def region_planes(camera: Camera, region: ImageRegion) -> Float:
    """Return the four planes through the camera that bound a region: left, right, top, bottom.

    Parameters
    ----------
    camera : Camera
    region : ImageRegion

    Returns
    -------
    (4, 3) float64
        Inward normals in the camera frame: v is projected into the region if its products with all four are positive,
        which is possible in front of the camera only.
    """
    x, y, z = camera.K
    return np.stack([x - region.left_px * z, region.right_px * z - x, y - region.top_px * z, region.bottom_px * z - y])


def inside_region(xy_px: Float, region: ImageRegion) -> Float:
    """Return distances of positions (n, 2) from the left, right, top and bottom edges, (n, 4) px, positive inside."""
    x, y = xy_px[:, 0], xy_px[:, 1]
    return np.stack([x - region.left_px, region.right_px - x, y - region.top_px, region.bottom_px - y], axis=1)


def cut(
    vector: Float, inside: Float, joined: NDArray[np.bool_], curve: NDArray[np.intp], camera: Camera
) -> tuple[Polylines, Crossings]:
    """Cut chains of chords by planes through the camera, and project the parts inside.

    Parameters
    ----------
    vector : (n, 3) float64
        Vertices in the camera frame.
    inside : (n, k) float64
        Distance of each vertex from each of k planes, 4 to 8, positive inside; the first four are those of
        `region_planes`, or, with distortion, the distances of `inside_region`.
    joined : (n,) bool
        Whether there is a chord from a vertex to the next one.
    curve : (n,) intp
        Index of the curve that each vertex belongs to, in ascending order.
    camera : Camera

    Returns
    -------
    Polylines, Crossings
    """
    # One bit for each plane: a chord with both ends outside the same plane is not visible.
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
    # A chord continues the line before it if it begins where the chord before it ends, and neither was cut there.
    new = np.ones(len(maybe), dtype=np.bool_)
    new[1:] = (np.diff(maybe) != 1) | entering[1:] | leaving[:-1]
    return _chained(ends, new, curve[maybe]), crossings


def _chained(ends: Float, new: NDArray[np.bool_], curve: NDArray[np.intp]) -> Polylines:
    """Return chords (2, n, 2) as polylines; each chord that is not new continues the one before it."""
    first = np.flatnonzero(new)
    starts = first + np.arange(len(first))
    xy = np.empty((len(new) + len(first), 2))
    xy[starts] = ends[0, first]
    xy[np.arange(len(new)) + np.cumsum(new)] = ends[1]
    return Polylines(xy, starts, curve[first])
