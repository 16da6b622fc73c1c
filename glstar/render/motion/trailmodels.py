"""The two trail models: an exposure is summed from sub-exposures, or integrated analytically over segments.

A `TrailModel` holds the camera's orientation over one exposure in the form that its renderer pass consumes, and
computes from the same numbers where each star is drawn: truth and overlays use that.  `CameraPath` divides segments
into pieces, each with the mean and the covariance of the motion during it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import ceil
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion import starpaths
from glstar.render.motion.pointing import Pointing

# Distance between sub-exposures along a trail, sigma: a sampling ripple of 0.03 % at 1.5 sigma, 1.4 % at 2, 22 % at 3.
SAMPLE_SPACING_SIGMA = 1.5


class TrailModel(Protocol):
    """How the stars move over one exposure."""

    @property
    def pointing(self) -> Pointing:
        """The camera's orientation at the times that the model is built on."""
        ...

    def __len__(self) -> int:
        """Return the number of sub-exposures or segments."""
        ...

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are drawn at some times of the exposure.

        `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox; `time` (n,): elapsed fraction
        of the exposure, 0 to 1.  Returns (n, m, 2) positions (x, y), px; NaN behind the camera and below the horizon.
        """
        ...

    def star_paths(
        self, camera: Camera, direction_eq: ArrayLike, sigma_px: float
    ) -> Iterator[starpaths.SampledPaths | starpaths.ConicPaths]:
        """Yield the paths of stars as they are drawn, in one or several consecutive parts of the exposure.

        `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox; `sigma_px`: standard
        deviation of a star as the pixels record it, px; it sets the spacing of samples.  Yields: all the stars over a
        part of the exposure.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class SubExposures:
    """A trail as the sum of n sub-exposures of equal length; the stars do not move during a sub-exposure.

    Teague & Chahl, section 2.6.
    """

    pointing: Pointing  # In the middle of each sub-exposure: n times

    def __len__(self) -> int:
        return len(self.pointing)

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are drawn in the sub-exposures that contain some times: see `TrailModel.positions`."""
        index = np.minimum((time * len(self)).astype(np.intp), len(self) - 1)
        return camera.project(self.pointing.to_camera(direction_eq))[index]

    def for_sigma(self, camera: Camera, sigma_px: float) -> "SubExposures":
        """Return fewer sub-exposures, spaced by at most 1.5 sigma, that suffice for a wide point spread function.

        Times are the middles of groups of equal number; `sigma_px`: standard deviation of a star in the image, px.
        """
        path_px = np.concatenate([[0.0], np.cumsum(self.pointing.rotation_rad)]) * camera.max_px_per_rad
        limit_px = SAMPLE_SPACING_SIGMA * sigma_px
        group = 1
        for size in (size for size in range(2, len(self) + 1) if len(self) % size == 0):
            within_px = path_px[size - 1 :: size] - path_px[::size]
            if within_px.max() <= limit_px * (size - 1) / size:
                group = size
        return self if group == 1 else SubExposures(self._middles(group))

    def _middles(self, group: int) -> Pointing:
        """Return the orientations in the middle of groups of sub-exposures."""
        first, last = slice((group - 1) // 2, None, group), slice(group // 2, None, group)
        if group % 2:
            return self.pointing[first]
        # The mean of two orientations: they differ by less than a milliradian.
        early, late = self.pointing[first], self.pointing[last]
        means = {
            name: (getattr(early, name) + getattr(late, name)) / 2
            for name in ("C_camera_eq", "zenith_eq", "velocity_eq")
        }
        return replace(self.pointing, **means)

    def star_paths(
        self,
        camera: Camera,
        direction_eq: ArrayLike,
        sigma_px: float,  # noqa: ARG002 - the protocol's
    ) -> Iterator[starpaths.SampledPaths]:
        """Yield the positions in each sub-exposure: see `TrailModel.star_paths`."""
        for block in self.pointing.blocks(len(np.asarray(direction_eq))):
            xy = camera.project(block.to_camera(direction_eq))
            yield starpaths.SampledPaths(np.moveaxis(xy, -1, 0), np.full(len(block), 1 / len(self)), is_at_rest=True)


@dataclass(frozen=True, slots=True, eq=False)
class AnalyticSegments:
    """A trail as m segments, along each of which the flux is integrated in closed form: see `segmentation`."""

    # At the start, the middle and the end of the first segment, which is the start of the second, and so on: 2 m + 1
    # times.
    pointing: Pointing
    time_fraction: Float  # (m,) duration of each segment as a fraction of the exposure; they add up to 1
    # (2 m,) or None: durations of the halves of each segment, if they differ by the rounding of times.
    half_fraction: Float | None = None

    def __len__(self) -> int:
        return len(self.time_fraction)

    @property
    def marks(self) -> Float:
        """Where segments begin and end, (m + 1,) fractions of the exposure."""
        return np.concatenate([[0.0], np.cumsum(self.time_fraction)])

    def half_fractions(self, span: float) -> Float:
        """Return the durations of the halves of each segment, (2 m,), given the sum of all in exposure times."""
        return np.repeat(self.time_fraction * (span / 2), 2) if self.half_fraction is None else self.half_fraction

    @property
    def end_weight(self) -> Float:
        """Projective weight of the ends of each segment, (m,): see `starpaths.end_weights`."""
        C = self.pointing.C_camera_eq
        return starpaths.end_weights(C[:-2:2], C[2::2])

    def longest_trail_px(self, camera: Camera) -> float:
        """Return an upper bound of the length of any star's trail on the image, px."""
        return float(self.pointing.rotation_rad.sum() * camera.max_px_per_rad)

    def longest_segment_px(self, camera: Camera) -> float:
        """Return an upper bound of the length of any star's path on the image during a segment, px."""
        return float(self.pointing.rotation_rad.reshape(-1, 2).sum(axis=1).max() * camera.max_px_per_rad)

    def positions(self, camera: Camera, direction_eq: ArrayLike, time: Float) -> Float:
        """Return where stars are at some times: see `TrailModel.positions`."""
        ends = self.marks
        segment = np.searchsorted(ends, time, side="right").clip(1, len(ends) - 1) - 1
        paths = self._conic_paths(camera, direction_eq, spacing_px=np.inf)
        return paths.positions(segment, (time - ends[segment]) / self.time_fraction[segment])

    def star_paths(
        self, camera: Camera, direction_eq: ArrayLike, sigma_px: float
    ) -> Iterator[starpaths.SampledPaths | starpaths.ConicPaths]:
        """Yield conic paths, sampled every 1.5 sigma: see `TrailModel.star_paths`."""
        yield from self._conic_paths(camera, direction_eq, SAMPLE_SPACING_SIGMA * sigma_px).pieces()

    def _conic_paths(self, camera: Camera, direction_eq: ArrayLike, spacing_px: float) -> starpaths.ConicPaths:
        nodes = self.pointing.to_camera(direction_eq).transpose(2, 0, 1)
        return starpaths.ConicPaths(camera, nodes, self.end_weight, self.time_fraction, spacing_px)


@dataclass(frozen=True, slots=True)
class SubExposureRule:
    """How many sub-exposures an exposure takes, given the length of its longest trail."""

    min_count: int  # The number for stars that do not move
    spacing_px: float  # Maximum distance between sub-exposures along a trail, px

    def count(self, trail_px: float) -> int:
        """Return the number of sub-exposures for the longest trail: max(min_count, ceil(trail / spacing))."""
        return max(self.min_count, ceil(trail_px / self.spacing_px))


# Largest magnitude of the third derivative of a Gaussian of unit variance and height, at sqrt(3 - sqrt(6)).
_THIRD_DERIVATIVE = 1.3801
# Intervals per segment in which the length of a path is measured.
_CHORDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class TrailPieces:
    """A trail as the sum of n Gaussians."""

    pointing: Pointing  # The mean orientation during each piece: n times
    covariance_rad2: Float  # (n, 3, 3) covariance of the rotation vector from the mean orientation, camera frame
    time_fraction: Float  # (n,) duration of each piece as a fraction of the exposure
    of_segments: Float  # (m, n) fraction of each piece that lies in each segment of the trails
    bounds: Float  # (n + 1,) where pieces begin and end, numbers of segments

    def __len__(self) -> int:
        return len(self.time_fraction)


class CameraPath:
    """The orientation of the camera over an exposure as `AnalyticSegments` describe it.

    Times are numbers of segments: 1.5 is the middle of the second.
    """

    def __init__(self, trails: AnalyticSegments, camera: Camera) -> None:
        self._trails = trails
        self._camera = camera
        self._rays = starpaths.probe_rays(camera)
        self._weight = trails.end_weight
        weight = self._weight[:, np.newaxis, np.newaxis]
        C = trails.pointing.C_camera_eq
        self._start, self._middle, self._end = C[:-2:2] * weight, C[1::2], C[2::2] * weight

    def __len__(self) -> int:
        return len(self._trails)

    def _orientation(self, segment: NDArray[np.intp], u: Float) -> Float:
        """Return orientations times a factor of nearly 1, (k, 3, 3), at elapsed fractions of segments, (k,) both."""
        u = starpaths.parameter_at(u, self._weight[segment])[:, np.newaxis, np.newaxis]
        start, middle, end = (C.take(segment, axis=0) for C in (self._start, self._middle, self._end))
        return np.asarray(start + u * (4 * middle - 3 * start - end + 2 * u * (start - 2 * middle + end)))

    @cached_property
    def _elapsed_px(self) -> Float:
        """The length of the path of the fastest star of the image until the end of each chord, px, from 0 on."""
        count = len(self._trails)
        segment = np.repeat(np.arange(count), _CHORDS + 1)
        u = np.tile(np.linspace(0.0, 1.0, _CHORDS + 1), count)
        directions = np.swapaxes(self._middle, 1, 2) @ self._rays
        in_camera = self._orientation(segment, u).reshape(count, _CHORDS + 1, 3, 3) @ directions[:, np.newaxis]
        xy = self._camera.project(np.swapaxes(in_camera, -1, -2))
        chords_px = np.nan_to_num(np.linalg.norm(np.diff(xy, axis=1), axis=-1)).max(axis=-1).ravel()
        return np.concatenate([[0.0], np.cumsum(chords_px)])

    def bounds_of_equal_lengths(self, length_px: float, fewest: int = 1) -> Float:
        """Return the ends of pieces in which the fastest star moves by at most a length, (n + 1,).

        There are at least `fewest` pieces.
        """
        elapsed_px = self._elapsed_px
        pieces = max(fewest, int(np.ceil(elapsed_px[-1] / length_px)))
        inner = np.interp(elapsed_px[-1] * np.arange(1, pieces) / pieces, elapsed_px, np.arange(len(elapsed_px)))
        return np.concatenate([[0.0], inner / _CHORDS, [float(len(self._trails))]])

    def times(self, bounds: Float) -> Float:
        """Return times, numbers of segments, as fractions of the exposure."""
        return np.asarray(np.interp(bounds, np.arange(len(self) + 1), self._trails.marks))

    def pointings(self, begins: Float, ends: Float) -> Pointing:
        """Return orientations at the start, the middle and the end of n parts of segments, 3 n times.

        `begins`, `ends` (n,): numbers of segments; each part lies within one.  The matrices have a factor of nearly 1.
        """
        at = np.stack([begins, (begins + ends) / 2, ends], axis=1)
        segment = np.repeat(at[:, 1].astype(np.intp), 3)
        C = self._orientation(segment, at.ravel() - segment)
        return replace(_interpolated(self._trails.pointing, 2 * at.ravel()), C_camera_eq=C)

    def moments(self, bounds: Float) -> "PieceMoments":
        """Return the motion during pieces; `bounds` (n + 1,): their ends, numbers of segments."""
        nodes = _Quadrature.of(self._trails.time_fraction, bounds)
        C = self._orientation(nodes.segment, nodes.u)
        C_mean = nodes.mean(C)
        change = C @ np.swapaxes(C_mean, 1, 2)[nodes.piece]
        scale = np.trace(change, axis1=1, axis2=2) / 3
        turn_rad = (change - np.swapaxes(change, 1, 2))[:, [2, 0, 1], [1, 2, 0]] / (2 * scale[:, np.newaxis])
        return PieceMoments(bounds, nodes, C_mean, turn_rad)

    def pieces(self, moments: "PieceMoments") -> TrailPieces:
        """Return pieces with some motion."""
        bounds, nodes, C_mean, turn_rad = moments
        covariance_rad2 = nodes.mean(turn_rad[:, :, np.newaxis] * turn_rad[:, np.newaxis])
        pointing = _interpolated(self._trails.pointing, bounds[:-1] + bounds[1:])
        of_segments = nodes.of_segments(len(self._trails))
        return TrailPieces(replace(pointing, C_camera_eq=C_mean), covariance_rad2, nodes.duration, of_segments, bounds)

    def errors(self, moments: "PieceMoments", sigma_px: float) -> tuple[Float, Float]:
        """Return estimates of the flux errors of each piece, relative to its height, (n,) each.

        The first is from the third moments, the second from the fourth cumulants; `sigma_px`: standard deviation of a
        star as the pixels record it, px.
        """
        x, y = (moments.turn_rad @ along / sigma_px for along in _px_per_turn(self._camera))
        xx, xy, yy = x * x, x * y, y * y
        powers = np.concatenate([xx, xy, yy, xx * x, xx * y, x * yy, yy * y, (xx + yy) ** 2], axis=1)
        means = moments.nodes.mean(powers).reshape(-1, 8, x.shape[1]).swapaxes(0, 1)
        (xx, xy, yy), third, fourth = means[:3], means[3:7] ** 2, means[7]
        second = xx + yy
        norm = np.sqrt(third[0] + 3 * (third[1] + third[2]) + third[3])
        skewness = (_THIRD_DERIVATIVE / 6) * norm / (1 + second) ** 1.5
        # In the middle of a Gaussian its fourth derivative, 3, is largest, and that of fourth order across it is 1.
        cumulant = fourth - second**2 - 2 * (xx**2 + 2 * xy**2 + yy**2)
        kurtosis = np.abs(cumulant) / 8 / (1 + second) ** 2
        return skewness.max(axis=1), kurtosis.max(axis=1)


# Every exposure of a flight has the same camera.
@lru_cache(maxsize=64)
def _px_per_turn(camera: Camera) -> Float:
    """Return displacements of the probes in the image, x and y, per rotation vector of the camera, (2, 3, probes)."""
    rays = starpaths.probe_rays(camera).T
    rates_px = [camera.project_with_rates(rays, np.cross(axis, rays))[1].T for axis in np.eye(3)]
    px_per_turn = np.ascontiguousarray(np.stack(rates_px, axis=1))
    px_per_turn.flags.writeable = False
    return px_per_turn


class PieceMoments(NamedTuple):
    """The motion of the camera during n pieces."""

    bounds: Float  # (n + 1,) their ends, numbers of segments
    nodes: "_Quadrature"  # Of k times
    C_mean: Float  # (n, 3, 3) the mean orientations
    turn_rad: Float  # (k, 3) rotation vectors from the mean orientation of the piece, camera frame


class _Quadrature(NamedTuple):
    """Gauss-Legendre nodes of k intervals, each within one piece and one segment."""

    segment: NDArray[np.intp]  # (3 k,) intp
    u: Float  # (3 k,) elapsed fraction of the segment
    piece: NDArray[np.intp]  # (3 k,) intp
    weight: Float  # (3 k,) fractions of the piece's duration
    first: NDArray[np.intp]  # (n,) intp: the first node of each piece
    duration: Float  # (n,) durations of the pieces, fractions of the exposure

    @classmethod
    def of(cls, time_fraction: Float, bounds: Float) -> "_Quadrature":
        """Return the nodes for segments of some durations and pieces between some times."""
        ends = np.union1d(bounds, np.arange(len(time_fraction) + 1))
        begins, spans = ends[:-1], np.diff(ends)
        segment = begins.astype(np.intp)
        u = (begins - segment)[:, np.newaxis] + spans[:, np.newaxis] * starpaths.QUADRATURE_NODES
        time = ((time_fraction[segment] * spans)[:, np.newaxis] * starpaths.QUADRATURE_WEIGHTS).ravel()
        first = len(starpaths.QUADRATURE_NODES) * np.searchsorted(ends, bounds[:-1])
        duration = np.add.reduceat(time, first)
        piece = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(time))))
        return cls(
            np.repeat(segment, len(starpaths.QUADRATURE_NODES)),
            u.ravel(),
            piece,
            time / duration[piece],
            first,
            duration,
        )

    def of_segments(self, count: int) -> Float:
        """Return `TrailPieces.of_segments` of some segments."""
        fractions = np.zeros((count, len(self.first)))
        np.add.at(fractions, (self.segment, self.piece), self.weight)
        return fractions

    def mean(self, values: Float) -> Float:
        """Return means over the duration of each piece, (n, ...), of values at the nodes, (3 k, ...)."""
        weight = self.weight.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray(np.add.reduceat(values * weight, self.first, axis=0))


def _interpolated(pointing: Pointing, at: Float) -> Pointing:
    """Return what is above the camera at some times, numbers of half segments; the orientation is not interpolated."""
    index = np.minimum(at.astype(np.intp), len(pointing) - 2)
    rest = (at - index)[:, np.newaxis]

    def between(values: Float) -> Float:
        return np.asarray((1 - rest) * values[index] + rest * values[index + 1])

    return replace(pointing, zenith_eq=between(pointing.zenith_eq), velocity_eq=between(pointing.velocity_eq))
