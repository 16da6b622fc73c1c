"""Analytic trails in short pieces, each a Gaussian with the mean and the covariance of the star's motion during it.

Where attitude is rough, the segments of `segmentation` are many and short, and most of the time goes into drawing their
borders.  Pieces are as long as the point spread function allows, whatever the motion within them.
"""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.camera.sensor import TRUNCATION_DN
from glstar.render.bodysources import BODIES
from glstar.render.colourscenes import drawn_peak_dn
from glstar.render.horizoncrossing import NEVER, rise_and_set
from glstar.render.openpieces import PixelOpenings, SegmentColumns, columns_around, open_pieces
from glstar.render.pointing import Pointing
from glstar.render.scene import Scene
from glstar.render.segmentation import probe_rays
from glstar.render.starpaths import parameter_at
from glstar.render.trailmodels import AnalyticSegments

__all__ = [
    "FAINT_LIMITS",
    "FAINT_PEAK_DN",
    "PIECES_PER_SPRITE",
    "PIECE_COSTS",
    "PIECE_LIMITS",
    "SNAPPING_PX",
    "DividedScene",
    "PieceCosts",
    "PieceLimits",
    "ScenePart",
    "TrailPieces",
    "in_pieces",
    "trail_pieces",
]

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PieceLimits:
    """How long pieces may be.

    Attributes
    ----------
    length_sigma : float
        Length of the path of a star during a piece, in standard deviations of the star as the pixels record it.
        Gaussians at equal distances h along a line, each with the variance h^2 / 12 of its piece, add up to a line
        with a ripple of 2 exp(-2 pi^2 (1 + h^2 / 12) / h^2): 0.02 % at 1.6.
    error : float
        Largest error of the flux due to the third moments of the motion during a piece, relative to the trail there.
    halvings : int
        How often a piece may be halved for that.
    """

    length_sigma: float = 1.6
    error: float = 1.5e-3
    halvings: int = 6

    @property
    def widening(self) -> float:
        """How much wider a piece may be than a star at rest.

        The variance of a position on a path of length l is at most l^2 / 4: of a star that is half of the time at
        either end.
        """
        return float(np.sqrt(1 + self.length_sigma**2 / 4))

    def reach_px(self, radius_px: Float, sigma_px: float) -> Float:
        """Return how far from any position during a piece a star is drawn, (k,) px: parameters as of `sprite_px`."""
        return np.asarray(radius_px * self.widening + self.length_sigma * sigma_px + SNAPPING_PX)

    def sprite_px(self, radius_px: Float, sigma_px: float) -> Float:
        """Return the largest side of the sprites of stars, px.

        Parameters
        ----------
        radius_px : (k,) float64
            Truncation radii.
        sigma_px : float
            Standard deviation of a star as the pixels record it, px.

        Returns
        -------
        (k,) float64
        """
        path_px = PIECES_PER_SPRITE * self.length_sigma * sigma_px
        return np.asarray(2 * radius_px * self.widening + path_px + 2 * SNAPPING_PX)


@dataclass(frozen=True, slots=True)
class PieceCosts:
    """Where pieces cost less than segments, measured on Mesa llvmpipe with exposures of real flights.

    Attributes
    ----------
    min_segments : int
        The fewest segments.
    pieces_per_segment : float
        The most pieces per segment: twenty cost as much as one of the longest.
    min_faint_sprites : float
        Sprites that cost as much as pieces of another length, and their draw call.
    """

    min_segments: int = 6
    pieces_per_segment: float = 18.0
    min_faint_sprites: float = 1500.0


PIECE_LIMITS: Final = PieceLimits()
# Of stars whose trails are faint everywhere: a ripple of 1.3 % and third moments of 1 % stay below `TRUNCATION_DN`, as
# does the light that is left out around a star.
FAINT_LIMITS: Final = PieceLimits(length_sigma=2.4, error=0.01)
FAINT_PEAK_DN: Final = 40 * TRUNCATION_DN
PIECE_COSTS: Final = PieceCosts()
# Pieces that one point sprite draws.
PIECES_PER_SPRITE: Final = 4
# Rasterizers snap points to a grid: rasterization.glsl.
SNAPPING_PX: Final = 0.125
# Largest magnitude of the third derivative of a Gaussian of unit variance and height, at sqrt(3 - sqrt(6)).
_THIRD_DERIVATIVE: Final = 1.3801
# Segments whose transmission of cloud differs by more than this share no piece.
_PASSAGE_STEP: Final = 0.02
_NONE: Final = np.zeros(0, np.intp)
# Intervals per segment in which the length of a path is measured.
_CHORDS: Final = 4
# Gauss-Legendre quadrature with three nodes, on [0, 1]: exact up to the fifth power.
_NODES: Final = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
_WEIGHTS: Final = np.array([5.0, 8.0, 5.0]) / 18


@dataclass(frozen=True, slots=True, eq=False)
class TrailPieces:
    """A trail as the sum of n Gaussians.

    Attributes
    ----------
    pointing : Pointing
        The mean orientation during each piece: n times.
    covariance_rad2 : (n, 3, 3) float64
        Covariance of the rotation vector from the mean orientation, camera frame.
    time_fraction : (n,) float64
        Duration of each piece as a fraction of the exposure.
    of_segments : (m, n) float64
        Which fraction of each piece lies in each segment of the trails.
    """

    pointing: Pointing
    covariance_rad2: Float
    time_fraction: Float
    of_segments: Float

    def __len__(self) -> int:
        return len(self.time_fraction)


class ScenePart(NamedTuple):
    """Stars that are drawn in pieces of the same lengths.

    Attributes
    ----------
    scene : Scene
        With these stars.
    pieces : TrailPieces
    drawn : (2, k) intp or None
        Under a rolling shutter, the first piece of each star that is drawn, and the one after the last; None for all.
    """

    scene: Scene
    pieces: TrailPieces
    drawn: NDArray[np.intp] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DividedScene:
    """A scene whose stars are drawn in pieces, but for some.

    Attributes
    ----------
    parts : tuple of ScenePart
        The stars that are drawn in pieces: all of them, or bright and faint ones.
    rest : Scene
        Those that are drawn in segments: stars that rise or set during the exposure, or that are never up, and stars
        whose sprites would be larger than the driver draws.
    ends : tuple of SegmentColumns
        Under a rolling shutter, what is drawn in segments of the stars of each part: see `openpieces`.
    """

    parts: tuple[ScenePart, ...]
    rest: Scene
    ends: tuple[SegmentColumns, ...] = ()


def in_pieces(
    scene: Scene,
    trails: AnalyticSegments,
    costs: PieceCosts = PIECE_COSTS,
    *,
    largest_point_px: float = np.inf,
    openings: PixelOpenings | None = None,
) -> DividedScene | None:
    """Return a scene whose stars are plain Gaussians divided into pieces; None where segments cost less.

    Parameters
    ----------
    scene : Scene
    trails : AnalyticSegments
        The scene's.
    costs : PieceCosts, optional
    largest_point_px : float, optional
        The largest point sprite of the driver, px.
    openings : PixelOpenings, optional
        Of a rolling shutter.

    Returns
    -------
    DividedScene or None
        None too for stars so narrow that the area of a pixel is integrated over.
    """
    sensor, drawn = scene.sensor, scene.draw_list
    if sensor.needs_erf or len(trails) < costs.min_segments:
        return None
    rises, sets = rise_and_set(trails, scene.stars.direction_eq[drawn.index]).T
    is_up, is_faint = (rises == 0.0) & (sets == NEVER), _are_faint(scene)
    parts, ends, is_rest = [], [], np.ones(len(drawn), np.bool_)
    for of_part, limits in _classes(
        trails.longest_trail_px(scene.camera), is_up, is_faint, sensor.effective_sigma_px, costs
    ):
        fits = limits.sprite_px(drawn.truncation_radius_px, sensor.effective_sigma_px) <= largest_point_px
        part = _part(scene, trails, of_part & fits, limits, costs)
        if part is None:
            return None
        stars = np.flatnonzero(of_part & fits)
        if openings is not None:
            recorded = _recorded(part, stars, limits, openings)
            if recorded is None:
                return None
            part, stars, around = recorded
            ends.append(around)
        parts.append(part)
        is_rest[stars] = False
    return DividedScene(tuple(parts), replace(scene, draw_list=drawn[is_rest]), tuple(ends))


def _classes(
    trail_px: float, is_up: NDArray[np.bool_], is_faint: NDArray[np.bool_], sigma_px: float, costs: PieceCosts
) -> list[tuple[NDArray[np.bool_], PieceLimits]]:
    """Return which stars are drawn in pieces of which lengths; faint ones as others where few sprites are saved."""
    saved_per_px = (1 / PIECE_LIMITS.length_sigma - 1 / FAINT_LIMITS.length_sigma) / (sigma_px * PIECES_PER_SPRITE)
    if np.count_nonzero(is_up & is_faint) * trail_px * saved_per_px < costs.min_faint_sprites:
        return [(is_up, PIECE_LIMITS)]
    classes = [(is_up & ~is_faint, PIECE_LIMITS), (is_up & is_faint, FAINT_LIMITS)]
    return [one for one in classes if one[0].any()]


def _are_faint(scene: Scene) -> NDArray[np.bool_]:
    """Return whose trails are below `FAINT_PEAK_DN` everywhere, (k,); of the sources of a disc, which add up, none."""
    drawn = scene.draw_list
    if scene.stars.catalogue == BODIES:
        return np.zeros(len(drawn), np.bool_)
    peak_dn = scene.sensor.max_trail_peak_dn(drawn_peak_dn(scene), drawn.min_trail_px)
    return np.asarray(peak_dn < FAINT_PEAK_DN)


def _part(
    scene: Scene, trails: AnalyticSegments, stars: NDArray[np.bool_], limits: PieceLimits, costs: PieceCosts
) -> ScenePart | None:
    """Return some stars in pieces; None where segments cost less."""
    drawn, sigma_px = scene.draw_list[stars], scene.sensor.effective_sigma_px
    most, divided_at = costs.pieces_per_segment * len(trails), _unlike_segments(drawn.passage)
    pieces = trail_pieces(trails, scene.camera, sigma_px, limits, most=most, divided_at=divided_at)
    if pieces is None:
        return None
    if drawn.passage is not None:
        drawn = replace(drawn, passage=(drawn.passage @ pieces.of_segments).astype(np.float32))
    return ScenePart(replace(scene, draw_list=drawn), pieces)


def _recorded(
    part: ScenePart, stars: NDArray[np.intp], limits: PieceLimits, openings: PixelOpenings
) -> tuple[ScenePart, NDArray[np.intp], SegmentColumns] | None:
    """Return the stars of a part of which pieces are recorded in full, their indices, and what else is drawn of them.

    None where stars may be as fast as a rolling shutter.
    """
    scene, sigma_px = part.scene, part.scene.sensor.effective_sigma_px
    assert isinstance(scene.trails, AnalyticSegments)
    times = np.concatenate([[0.0], np.cumsum(part.pieces.time_fraction)])
    reach_px = openings.reach * limits.reach_px(scene.draw_list.truncation_radius_px, sigma_px)
    recorded = open_pieces(scene, part.pieces.pointing, times, reach_px, openings)
    if recorded is None:
        return None
    some = recorded.last > recorded.first
    recorded = recorded.of(some)
    part = ScenePart(
        replace(scene, draw_list=scene.draw_list[some]), part.pieces, np.stack([recorded.first, recorded.last])
    )
    return part, stars[some], columns_around(scene.trails, times, stars[some], recorded)


def _unlike_segments(passage: NDArray[np.float32] | None) -> NDArray[np.intp]:
    """Return the segments that cloud dims otherwise than the segment before."""
    if passage is None or not len(passage):
        return np.zeros(0, np.intp)
    return 1 + np.flatnonzero(np.abs(np.diff(passage, axis=1)).max(axis=0) > _PASSAGE_STEP)


def trail_pieces(
    trails: AnalyticSegments,
    camera: Camera,
    sigma_px: float,
    limits: PieceLimits = PIECE_LIMITS,
    *,
    most: float = np.inf,
    divided_at: NDArray[np.intp] = _NONE,
) -> TrailPieces | None:
    """Return the pieces of the trails of an exposure.

    Parameters
    ----------
    trails : AnalyticSegments
    camera : Camera
        Behind a lens trails are drawn in the undistorted image plane.
    sigma_px : float
        Standard deviation of a star there as the pixels record it, px.
    limits : PieceLimits, optional
    most : float
        The most pieces.
    divided_at : (k,) intp
        Segments before which pieces end.

    Returns
    -------
    TrailPieces or None
        None if there are more than `most`.
    """
    path = _CameraPath(trails, camera)
    bounds = np.union1d(path.bounds_of_equal_lengths(limits.length_sigma * sigma_px), divided_at)
    for _ in range(limits.halvings):
        if len(bounds) - 1 > most:
            return None
        pieces, error = path.pieces(bounds, sigma_px)
        uneven = np.flatnonzero(error > limits.error)
        if not uneven.size:
            break
        bounds = np.insert(bounds, uneven + 1, (bounds[uneven] + bounds[uneven + 1]) / 2)
    return pieces


class _CameraPath:
    """The orientation of the camera over an exposure as `AnalyticSegments` describe it; parameters of `trail_pieces`.

    Times are numbers of segments: 1.5 is the middle of the second.
    """

    def __init__(self, trails: AnalyticSegments, camera: Camera) -> None:
        self._trails = trails
        self._camera = camera
        self._rays = probe_rays(camera)
        self._weight = trails.end_weight
        weight = self._weight[:, np.newaxis, np.newaxis]
        C = trails.pointing.C_camera_eq
        self._start, self._middle, self._end = C[:-2:2] * weight, C[1::2], C[2::2] * weight

    def _orientation(self, segment: NDArray[np.intp], u: Float) -> Float:
        """Return orientations times a factor of nearly 1, (k, 3, 3), at elapsed fractions of segments, (k,) both."""
        u = parameter_at(u, self._weight[segment])[:, np.newaxis, np.newaxis]
        start, middle, end = (C.take(segment, axis=0) for C in (self._start, self._middle, self._end))
        return np.asarray(start + u * (4 * middle - 3 * start - end + 2 * u * (start - 2 * middle + end)))

    def bounds_of_equal_lengths(self, length_px: float) -> Float:
        """Return the ends of pieces in which the fastest star of the image moves by at most this, (n + 1,)."""
        count = len(self._trails)
        segment = np.repeat(np.arange(count), _CHORDS + 1)
        u = np.tile(np.linspace(0.0, 1.0, _CHORDS + 1), count)
        directions = np.swapaxes(self._middle, 1, 2) @ self._rays
        in_camera = self._orientation(segment, u).reshape(count, _CHORDS + 1, 3, 3) @ directions[:, np.newaxis]
        xy = self._camera.pinhole.project(np.swapaxes(in_camera, -1, -2))
        chords_px = np.nan_to_num(np.linalg.norm(np.diff(xy, axis=1), axis=-1)).max(axis=-1).ravel()
        elapsed_px = np.concatenate([[0.0], np.cumsum(chords_px)])
        pieces = max(1, int(np.ceil(elapsed_px[-1] / length_px)))
        inner = np.interp(elapsed_px[-1] * np.arange(1, pieces) / pieces, elapsed_px, np.arange(len(elapsed_px)))
        return np.concatenate([[0.0], inner / _CHORDS, [float(count)]])

    def pieces(self, bounds: Float, sigma_px: float) -> tuple[TrailPieces, Float]:
        """Return pieces given their ends, and an estimate of the error of the flux of each."""
        nodes = _Quadrature.of(self._trails.time_fraction, bounds)
        C = self._orientation(nodes.segment, nodes.u)
        C_mean = nodes.mean(C)
        change = C @ np.swapaxes(C_mean, 1, 2)[nodes.piece]
        scale = np.trace(change, axis1=1, axis2=2) / 3
        turn_rad = (change - np.swapaxes(change, 1, 2))[:, [2, 0, 1], [1, 2, 0]] / (2 * scale[:, np.newaxis])
        covariance_rad2 = nodes.mean(turn_rad[:, :, np.newaxis] * turn_rad[:, np.newaxis])
        pointing = _interpolated(self._trails.pointing, bounds[:-1] + bounds[1:])
        pieces = TrailPieces(
            replace(pointing, C_camera_eq=C_mean), covariance_rad2, nodes.duration, nodes.of_segments(len(self._trails))
        )
        x_px, y_px = np.moveaxis(turn_rad @ self._px_per_turn, -1, 0).transpose(0, 2, 1)
        xx, yy = x_px * x_px, y_px * y_px
        second = nodes.mean(xx + yy) / sigma_px**2
        third = [nodes.mean(power) ** 2 for power in (xx * x_px, xx * y_px, x_px * yy, yy * y_px)]
        norm = np.sqrt(third[0] + 3 * (third[1] + third[2]) + third[3]) / sigma_px**3
        # The trail where Gaussians of this variance follow each other, over the height of one of them.
        level = np.maximum(1.0, np.sqrt(np.pi / 6 * (1 + second) / np.maximum(second, 1e-12)))
        error = (_THIRD_DERIVATIVE / 6) * norm / (1 + second) ** 1.5 / level
        return pieces, np.asarray(error.max(axis=1))

    @property
    def _px_per_turn(self) -> Float:
        """Displacements of the probes in the image per rotation vector of the camera, (probes, 3, 2) px/rad."""
        x, y = self._rays[:2] / self._rays[2]
        per_turn = np.array([[-x * y, -(1 + y * y)], [1 + x * x, x * y], [-y, x]])
        px = np.array([[self._camera.fx_px, 0.0], [self._camera.skew_px, self._camera.fy_px]])
        return np.asarray(np.moveaxis(per_turn, -1, 0) @ px)


class _Quadrature(NamedTuple):
    """Gauss-Legendre nodes of k intervals, each within one piece and one segment.

    Attributes
    ----------
    segment : (3 k,) intp
    u : (3 k,) float64
        Elapsed fraction of the segment.
    piece : (3 k,) intp
    weight : (3 k,) float64
        Fractions of the piece's duration.
    first : (n,) intp
        The first node of each piece.
    duration : (n,) float64
        Durations of the pieces, fractions of the exposure.
    """

    segment: NDArray[np.intp]
    u: Float
    piece: NDArray[np.intp]
    weight: Float
    first: NDArray[np.intp]
    duration: Float

    @classmethod
    def of(cls, time_fraction: Float, bounds: Float) -> "_Quadrature":
        """Return the nodes for segments of some durations and pieces between some times."""
        ends = np.union1d(bounds, np.arange(len(time_fraction) + 1))
        begins, spans = ends[:-1], np.diff(ends)
        segment = begins.astype(np.intp)
        u = (begins - segment)[:, np.newaxis] + spans[:, np.newaxis] * _NODES
        time = ((time_fraction[segment] * spans)[:, np.newaxis] * _WEIGHTS).ravel()
        first = len(_NODES) * np.searchsorted(ends, bounds[:-1])
        duration = np.add.reduceat(time, first)
        piece = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(time))))
        return cls(np.repeat(segment, len(_NODES)), u.ravel(), piece, time / duration[piece], first, duration)

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
