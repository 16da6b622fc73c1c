"""Curves on the sky (grids, the horizon, constellations), cut at the edges of the image and projected.

A curve is a chain of unit vectors, so close together that the straight chord between two lies within `TOLERANCE_PX` of
the curve on the image.  The chords are cut in space, by the planes through the camera that bound the image (and by the
horizon if the curve ends there), and projected afterwards, so that nothing behind the camera appears on the image.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import asin, ceil, pi, tan
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera, directions_seen
from glstar.sky.catalogue.names import constellations
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.place.apparent import ASTROMETRY, direction
from glstar.sky.place.horizon import HorizonProfile, ned_direction

# Largest distance of a chord from its curve, px of the image.
TOLERANCE_PX = 0.2

# Limits of the length of chords, rad.  Without refraction and distortion a great circle is straight on the image, and
# chords could have any length; short ones are culled better.
_MAX_STEP_RAD = np.deg2rad(5.0)
_MIN_STEP_RAD = np.deg2rad(0.2)

# Step along great circles by which a lens's bend of them is evaluated.
_BEND_STEP_RAD = 1e-3

# Upper bound of the curvature that refraction gives to a straight line, 1/rad: the second derivative of eq. (25) is
# largest at the horizon, 3.2 per radian in standard air.
REFRACTION_CURVATURE = 4.0

# Anchors of labels at the edge that a curve crosses: left, right, top, bottom (0 to 1 across and down the text).
_ANCHOR_AT_EDGE = np.array([[0.0, 0.5], [1.0, 0.5], [0.5, 0.0], [0.5, 1.0]])


class ImageRegion(NamedTuple):
    """A rectangle of the image; its edges are px from the centre of the top-left pixel."""

    left_px: float
    top_px: float
    right_px: float
    bottom_px: float

    @classmethod
    def complete(cls, camera: Camera) -> Self:
        """Return the region of the complete image."""
        return cls(-0.5, -0.5, camera.width_px - 0.5, camera.height_px - 0.5)

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
    """Lines on the image."""

    xy_px: Float  # (n, 2) the points of all lines, one line after another, px
    starts: NDArray[np.intp]  # (m,) intp: index of the first point of each line
    curve: NDArray[np.intp]  # (m,) intp: index of the curve that each line belongs to, in ascending order

    def of_curves(self, first: int, last: int) -> "Polylines":
        """Return the lines of the curves from `first` to before `last`."""
        a, b = np.searchsorted(self.curve, (first, last))
        bounds = np.append(self.starts, len(self.xy_px))
        return Polylines(self.xy_px[bounds[a] : bounds[b]], self.starts[a:b] - bounds[a], self.curve[a:b])


class Crossings(NamedTuple):
    """Where curves cross the edge of a region."""

    curve: NDArray[np.intp]  # (n,) intp: index of the curve
    xy_px: Float  # (n, 2) the position, px
    # (n, 2) the point of a label that lies there if the label is inside the region: across and down, 0 to 1.
    anchor: Float

    def of_curves(self, first: int, last: int) -> "Crossings":
        """Return the crossings of the curves from `first` to before `last`, renumbered from 0."""
        selected = (self.curve >= first) & (self.curve < last)
        return Crossings(self.curve[selected] - first, self.xy_px[selected], self.anchor[selected])


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Curves as chains of vectors."""

    vector: Float  # (n, 3) the vertices of all curves, one curve after another
    curve: NDArray[np.intp]  # (n,) intp: index of the curve that each vertex belongs to
    count: int  # Number of curves
    step_rad: float  # The length of the longest chord, rad

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

        `axis` (3,): a unit vector; `radius_rad`: the cone's radius, rad.  Returns `vector` (k, 3): all vertices of
        chords that touch the cone; `curve` (k,) intp: index of the curve that each belongs to; `joined` (k,) bool:
        whether there is a chord from a vertex to the next one.
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
    """Return the largest length of a chord that stays within `TOLERANCE_PX` of its curve on the image, rad.

    `curvature`: geodesic curvature of the curve, 1/rad; for a parallel, the tangent of its latitude.  A chord of length
    s lies curvature * s^2 / 8 from its curve.  At the corner of the image a pinhole camera magnifies
    this to focal length / cos^2 pixels per radian.  A lens bends great circles, too.
    """
    scale_px_per_rad = camera.max_px_per_rad * (1 + abs(camera.skew_px) / camera.fx_px)
    bend_px = scale_px_per_rad * max(curvature, 1e-9) + _bend_px_per_rad2(camera)
    step_rad = np.sqrt(8 * TOLERANCE_PX / bend_px)
    return float(np.clip(step_rad, _MIN_STEP_RAD, _MAX_STEP_RAD))


@lru_cache(maxsize=8)
def _bend_px_per_rad2(camera: Camera) -> float:
    """Return four times the largest second derivative of positions along great circles, px/rad^2; 0 for a pinhole.

    Where a chord crosses an edge is interpolated linearly between its ends, within a quarter of `TOLERANCE_PX`.
    """
    if camera.lens is None:
        return 0.0
    seen = directions_seen(camera)
    right = np.cross(seen, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    down = np.cross(seen, right)
    largest = 0.0
    for angle_rad in np.arange(12) * np.pi / 12:
        step = _BEND_STEP_RAD * (np.cos(angle_rad) * right + np.sin(angle_rad) * down)
        before, at, after = (camera.project(seen + shift) for shift in (-step, 0.0, step))
        second = np.linalg.norm(after - 2 * at + before, axis=1)
        largest = max(largest, 4 * float(np.nanmax(second)) / _BEND_STEP_RAD**2)
    return largest


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

    Returns (4, 3) inward normals in the camera frame: v is projected into the region if its products with all four are
    positive, which is possible in front of the camera only.
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

    `vector` (n, 3): vertices in the camera frame; `inside` (n, k): distance of each vertex from each of k planes, 4 to
    8, positive inside.  The first four planes are those of `region_planes`, or, with distortion, the edges of
    `inside_region`.  `joined` (n,) bool: whether there is a chord from a vertex to the next one; `curve` (n,) intp:
    index of the curve that each vertex belongs to, in ascending order.
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


# Spacings of the grids: degrees of declination and altitude, minutes of right ascension.  The widest is used that is
# at most the half diagonal of the image.
_SPACINGS = ((10, 60), (5, 20), (2, 10), (1, 5))

COMPASS_POINTS = (
    "N",
    "NNE",
    "NE",
    "ENE",
    "E",
    "ESE",
    "SE",
    "SSE",
    "S",
    "SSW",
    "SW",
    "WSW",
    "W",
    "WNW",
    "NW",
    "NNW",
)

# The end of a constellation's line is a catalogue star if one lies within this angle; the farthest known is 9".
_SAME_STAR_RAD = np.deg2rad(15 / 3600)
# Magnitude limit of those stars.
_FIGURE_VMAG_LIMIT = 7.0


class Grids:
    """The grids for a camera, sampled as finely as its image needs.

    `altaz`: in apparent directions north, east, down; `equatorial`: in geocentric apparent directions; `altaz_labels`,
    `equatorial_labels`: one label for each curve.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        radius_rad = camera.field_radius_rad
        degrees, minutes = next((pair for pair in _SPACINGS if np.deg2rad(pair[0]) <= radius_rad), _SPACINGS[-1])
        last = 90 - degrees
        step_rad, refracted_step_rad = max_step_rad(camera, 0.0), max_step_rad(camera, REFRACTION_CURVATURE)

        altitudes, azimuths = range(degrees, 90, degrees), range(0, 360, degrees)
        altaz = [_ned(parallel(h, max_step_rad(camera, np.tan(h)))) for h in np.deg2rad(altitudes)]
        for azimuth in azimuths:
            top = 90 if azimuth % 30 == 0 else last
            altaz.append(great_circle(ned_direction(np.deg2rad(azimuth), np.deg2rad([0, top])), step_rad))

        declinations, meridians = range(-last, 90, degrees), range(0, 24 * 60, minutes)
        equatorial = [
            parallel(dec, max_step_rad(camera, REFRACTION_CURVATURE + abs(np.tan(dec))))
            for dec in np.deg2rad(declinations)
        ]
        for minute in meridians:
            top = 90 if minute % 180 == 0 else last
            ends = direction(np.deg2rad(minute / 4), np.deg2rad([-top, 0, top]))
            equatorial.append(great_circle(ends, refracted_step_rad))

        self.altaz, self.equatorial = Curves.of(altaz), Curves.of(equatorial)
        self.altaz_labels = (*(f"alt {h}°" for h in altitudes), *(f"az {az}°" for az in azimuths))
        self.equatorial_labels = (*(f"{dec:+d}°" if dec else "0°" for dec in declinations), *map(_hours, meridians))


# A still aircraft keeps its horizon; one that climbs needs another for every frame.
@lru_cache(maxsize=4)
def horizon_curve(camera: Camera, sine_horizon: float, profile: HorizonProfile | None = None) -> Curves:
    """Return the apparent horizon in directions north, east, down, sampled as finely as the image needs.

    `sine_horizon`: sine of the apparent altitude of the horizon; `profile`: the horizon by azimuth, instead.
    """
    if profile is not None:
        steps = ceil(2 * pi / max_step_rad(camera, tan(max(profile.highest_rad, -profile.lowest_rad))))
        azimuth_rad = np.union1d(np.linspace(0, 2 * pi, steps + 1), profile.azimuths_rad)
        return Curves.of([ned_direction(azimuth_rad, profile.altitude_rad(azimuth_rad))])
    altitude_rad = asin(sine_horizon)
    return Curves.of([_ned(parallel(altitude_rad, max_step_rad(camera, abs(tan(altitude_rad)))))])


def compass_ned(sine_horizon: float, profile: HorizonProfile | None = None) -> Float:
    """Return the directions of the compass points on the horizon, (16, 3) float64 north, east, down.

    `sine_horizon`: sine of the apparent altitude of the horizon; `profile`: the horizon by azimuth, instead.
    """
    azimuth_rad = np.arange(len(COMPASS_POINTS)) * (2 * np.pi / len(COMPASS_POINTS))
    return ned_direction(azimuth_rad, asin(sine_horizon) if profile is None else profile.altitude_rad(azimuth_rad))


def _ned(by_azimuth: Float) -> Float:
    """Return directions of longitude = azimuth and latitude = altitude as north, east, down: z changes its sign."""
    return by_azimuth * [1.0, 1.0, -1.0]


def _hours(minutes: int) -> str:
    hours, rest = divmod(minutes, 60)
    return f"{hours}h{rest:02d}" if rest else f"{hours}h"


class ConstellationFigures:
    """The lines and the names of the constellations at the epoch of a star field.

    `catalogue`: its proper motions move the ends of the lines; ends that are no stars of the catalogue stay at J2000.
    """

    def __init__(self, catalogue: StarCatalogue) -> None:
        figures = constellations()
        self.names = tuple(figure.name for figure in figures)
        self._label_rad = np.array([figure.label_rad for figure in figures])
        lines = [line for figure in figures for line in figure.lines_rad]
        self._lengths = [len(line) for line in lines]
        self._ends = _with_proper_motion(np.concatenate(lines), catalogue)
        self._prepared_for: tuple[float, Camera] | None = None
        self._curves = Curves.of([])
        self._label_eq = np.empty((0, 3))

    def curves(self, epoch_utc_s: float, camera: Camera) -> Curves:
        """Return the lines in geocentric apparent directions; `epoch_utc_s`: UTC seconds since 1970."""
        self._prepare(epoch_utc_s, camera)
        return self._curves

    def label_eq(self, epoch_utc_s: float, camera: Camera) -> Float:
        """Return the directions of the names, (n, 3) float64, geocentric apparent; parameters as of `curves`."""
        self._prepare(epoch_utc_s, camera)
        return self._label_eq

    def _prepare(self, epoch_utc_s: float, camera: Camera) -> None:
        if self._prepared_for == (epoch_utc_s, camera):
            return
        # Either kind of astrometry will do: they agree to 0.7".
        to_apparent = ASTROMETRY["erfa"].apparent_directions
        ends = np.split(to_apparent(*self._ends, epoch_utc_s), np.cumsum(self._lengths)[:-1])
        step_rad = max_step_rad(camera, REFRACTION_CURVATURE)
        self._curves = Curves.of([great_circle(line, step_rad) for line in ends])
        no_motion = np.zeros(len(self._label_rad))
        ra_rad, dec_rad = self._label_rad[:, 0], self._label_rad[:, 1]
        self._label_eq = to_apparent(ra_rad, dec_rad, no_motion, no_motion, epoch_utc_s)
        self._prepared_for = (epoch_utc_s, camera)


def _with_proper_motion(j2000_rad: Float, catalogue: StarCatalogue) -> tuple[Float, Float, Float, Float]:
    """Return right ascension, declination and proper motions of the stars at J2000 positions (n, 2)."""
    ra_rad, dec_rad = j2000_rad.T.copy()
    pm_ra, pm_dec = np.zeros_like(ra_rad), np.zeros_like(ra_rad)
    bright = np.flatnonzero(catalogue.vmag <= _FIGURE_VMAG_LIMIT)
    bright = bright[np.argsort(catalogue.dec_rad[bright])]
    star_dec = catalogue.dec_rad[bright]
    star_direction, end_direction = catalogue.direction[bright], direction(ra_rad, dec_rad)
    south = np.searchsorted(star_dec, dec_rad - _SAME_STAR_RAD)
    north = np.searchsorted(star_dec, dec_rad + _SAME_STAR_RAD)
    for i, (first, last) in enumerate(zip(south.tolist(), north.tolist(), strict=True)):
        chord = np.linalg.norm(star_direction[first:last] - end_direction[i], axis=1)
        if chord.size and chord.min() < _SAME_STAR_RAD:
            star = bright[first + int(chord.argmin())]
            ra_rad[i], dec_rad[i] = catalogue.ra_rad[star], catalogue.dec_rad[star]
            pm_ra[i], pm_dec[i] = catalogue.pm_ra_cosdec_rad_per_yr[star], catalogue.pm_dec_rad_per_yr[star]
    return ra_rad, dec_rad, pm_ra, pm_dec
