"""Analytic trails in short pieces, each a Gaussian with the mean and the covariance of the star's motion during it.

Where attitude is rough, the segments of `segmentation` are many and short, and most of the time goes into drawing their
borders.  Pieces are as long as the point spread function allows, whatever the motion within them.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import TRUNCATION_DN
from glstar.render.motion.trailmodels import AnalyticSegments, CameraPath, TrailPieces
from glstar.render.readout.openings import EndPieces, PixelOpenings, end_pieces, open_pieces, open_spans
from glstar.render.scene.bodies import BODIES
from glstar.render.scene.occlusion import NEVER, rise_and_set
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import drawn_peak_dn


@dataclass(frozen=True, slots=True)
class PieceLimits:
    """How long pieces may be."""

    # Length of the path of a star during a piece, in standard deviations of the star as the pixels record it; Gaussians
    # at equal distances h along a line, each with the variance h^2 / 12 of its piece, add up to a line with a ripple of
    # 2 exp(-2 pi^2 (1 + h^2 / 12) / h^2): 0.01 % at 1.55.
    length_sigma: float = 1.55
    # Largest error of the flux due to the third moments of the motion during a piece, relative to its height.
    skewness_error: float = 2e-3
    # Largest error due to the fourth cumulants; it is at least that of a uniform motion over `length_sigma`, 0.42 %:
    # where a star moves on, neighbouring pieces make up for it; where it turns back, they do not.
    kurtosis_error: float = 4.7e-3
    halvings: int = 6  # How often a piece may be halved for these

    @property
    def widening(self) -> float:
        """How much wider a piece may be than a star at rest.

        The variance of a position on a path of length l is at most l^2 / 4, of a star half of the time at either end.
        """
        return float(np.sqrt(1 + self.length_sigma**2 / 4))

    def reach_px(self, radius_px: Float, sigma_px: float) -> Float:
        """Return how far from any position during a piece stars are drawn, (k,) px; parameters as for `sprite_px`."""
        return np.asarray(radius_px * self.widening + self.length_sigma * sigma_px + SNAPPING_PX)

    def sprite_px(self, radius_px: Float, sigma_px: float) -> Float:
        """Return the largest side of the sprites of stars, (k,) px.

        `radius_px` (k,): truncation radii; `sigma_px`: standard deviation of a star as the pixels record it, px.
        """
        path_px = PIECES_PER_SPRITE * self.length_sigma * sigma_px
        return np.asarray(2 * radius_px * self.widening + path_px + 2 * SNAPPING_PX)


@dataclass(frozen=True, slots=True)
class PieceCosts:
    """Where pieces cost less than segments, measured on Mesa llvmpipe with exposures of real flights."""

    min_segments: int = 6  # The fewest segments
    pieces_per_segment: float = 18.0  # The most pieces per segment: twenty cost as much as one of the longest
    min_faint_sprites: float = 1500.0  # Sprites that cost as much as pieces of another length, and their draw call


PIECE_LIMITS = PieceLimits()
# Of stars whose trails are faint everywhere: a ripple of 1.3 %, third moments of 1 % and fourth cumulants of 1.8 % stay
# below `TRUNCATION_DN`, as does the light that is left out around a star.
FAINT_LIMITS = PieceLimits(length_sigma=2.4, skewness_error=0.01, kurtosis_error=0.018)
FAINT_PEAK_DN = 40 * TRUNCATION_DN
PIECE_COSTS = PieceCosts()
# On wide pixels: stars have shorter trails of fewer segments there.
WIDE_PIXEL_COSTS = PieceCosts(min_segments=24)
# Under a rolling shutter, the fewest pieces: one that is recorded in part is divided where segments end.
FEWEST_PIECES = 16
# Pieces that one point sprite draws.
PIECES_PER_SPRITE = 4
# Rasterizers snap points to a grid: rasterization.glsl.
SNAPPING_PX = 0.125
# Segments whose transmission of cloud differs by more than this share no piece.
_PASSAGE_STEP = 0.02
_NONE = np.zeros(0, np.intp)


class ScenePart(NamedTuple):
    """Stars that are drawn in pieces of the same lengths."""

    scene: Scene  # With these stars
    pieces: TrailPieces
    # (2, k) intp or None: under a rolling shutter, the first piece of each star that is recorded in full, and the one
    # after the last; None for all.
    drawn: NDArray[np.intp] | None = None
    ends: EndPieces | None = None  # Under a rolling shutter, the pieces of the same stars that are recorded in part


@dataclass(frozen=True, slots=True, eq=False)
class DividedScene:
    """A scene whose stars are drawn in pieces, but for some."""

    parts: tuple[ScenePart, ...]  # The stars that are drawn in pieces: all of them, or bright and faint ones
    # The stars that are drawn in segments: those that rise or set during the exposure, or that are never up, and those
    # whose sprites would be larger than the driver draws.
    rest: Scene


def in_pieces(
    scene: Scene,
    trails: AnalyticSegments,
    costs: PieceCosts = PIECE_COSTS,
    *,
    largest_point_px: float = np.inf,
    openings: PixelOpenings | None = None,
) -> DividedScene | None:
    """Return a scene whose stars are plain Gaussians divided into pieces; None where segments cost less.

    `trails`: the scene's;
    `largest_point_px`: the largest point sprite of the driver, px; `openings`: those of a rolling shutter.
    """
    sensor, drawn = scene.sensor, scene.draw_list
    if len(trails) < costs.min_segments:
        return None
    rises, sets = rise_and_set(trails, scene.stars.direction_eq[drawn.index], scene.camera).T
    is_up, is_faint = (rises == 0.0) & (sets == NEVER), _are_faint(scene)
    path, parts, is_rest = CameraPath(trails, scene.camera), [], np.ones(len(drawn), np.bool_)
    for of_part, limits in _classes(
        trails.longest_trail_px(scene.camera), is_up, is_faint, sensor.effective_sigma_px, costs
    ):
        fits = limits.sprite_px(drawn.truncation_radius_px, sensor.effective_sigma_px) <= largest_point_px
        fewest = 1 if openings is None else FEWEST_PIECES
        part = _part(scene, path, of_part & fits, limits, costs, fewest)
        if part is None:
            return None
        stars = np.flatnonzero(of_part & fits)
        if openings is not None:
            passage = None if drawn.passage is None else drawn.passage[stars]
            recorded = _recorded(part, path, passage, limits, openings)
            if recorded is None:
                return None
            part, is_recorded = recorded
            stars = stars[is_recorded]
        parts.append(part)
        is_rest[stars] = False
    return DividedScene(tuple(parts), replace(scene, draw_list=drawn[is_rest]))


def _classes(
    trail_px: float, is_up: NDArray[np.bool_], is_faint: NDArray[np.bool_], sigma_px: float, costs: PieceCosts
) -> list[tuple[NDArray[np.bool_], PieceLimits]]:
    """Return which stars are drawn in pieces of which lengths; faint ones as others where few sprites are saved."""
    saved_per_px = (1 / PIECE_LIMITS.length_sigma - 1 / FAINT_LIMITS.length_sigma) / (sigma_px * PIECES_PER_SPRITE)
    if np.count_nonzero(is_up & is_faint) * trail_px * saved_per_px < costs.min_faint_sprites:
        return [(is_up, PIECE_LIMITS)]
    classes = [(is_up & ~is_faint, PIECE_LIMITS), (is_up & is_faint, FAINT_LIMITS)]
    return [(stars, limits) for stars, limits in classes if stars.any()]


def _are_faint(scene: Scene) -> NDArray[np.bool_]:
    """Return whose trails are below `FAINT_PEAK_DN` everywhere, (k,); of the sources of a disc, which add up, none."""
    drawn = scene.draw_list
    if scene.stars.catalogue == BODIES:
        return np.zeros(len(drawn), np.bool_)
    peak_dn = scene.sensor.max_trail_peak_dn(drawn_peak_dn(scene), drawn.min_trail_px)
    return np.asarray(peak_dn < FAINT_PEAK_DN)


def _part(
    scene: Scene, path: CameraPath, stars: NDArray[np.bool_], limits: PieceLimits, costs: PieceCosts, fewest: int
) -> ScenePart | None:
    """Return some stars in pieces; None where segments cost less."""
    drawn, sigma_px = scene.draw_list[stars], scene.sensor.effective_sigma_px
    most, divided_at = costs.pieces_per_segment * len(path), _unlike_segments(drawn.passage)
    pieces = _divided(path, sigma_px, limits, most, divided_at, fewest)
    if pieces is None:
        return None
    if drawn.passage is not None:
        drawn = replace(drawn, passage=(drawn.passage @ pieces.of_segments).astype(np.float32))
    return ScenePart(replace(scene, draw_list=drawn), pieces)


def _recorded(
    part: ScenePart,
    path: CameraPath,
    passage: NDArray[np.float32] | None,
    limits: PieceLimits,
    openings: PixelOpenings,
) -> tuple[ScenePart, NDArray[np.bool_]] | None:
    """Return the part with the stars of which pieces are recorded in full, and which of its stars these are.

    `passage`: transmission of its stars by segment.  None where stars may be as fast as a rolling shutter.
    """
    scene, pieces, sigma_px = part.scene, part.pieces, part.scene.sensor.effective_sigma_px
    reach_px = limits.reach_px(scene.draw_list.truncation_radius_px, sigma_px)
    spans = open_spans(scene, reach_px, openings)
    if spans is None:
        return None
    recorded = open_pieces(spans, path.times(pieces.bounds))
    is_recorded = recorded.last > recorded.first
    recorded, drawn = recorded.of(is_recorded), scene.draw_list[is_recorded]
    passage = None if passage is None else passage[is_recorded]
    ends = end_pieces(path, pieces.bounds, np.arange(len(drawn)), recorded, passage)
    full = np.stack([recorded.first, recorded.last])
    return ScenePart(replace(scene, draw_list=drawn), pieces, full, ends), is_recorded


def _unlike_segments(passage: NDArray[np.float32] | None) -> NDArray[np.intp]:
    """Return the segments in which cloud transmits another fraction than in the segment before."""
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
    """Return the pieces of the trails of an exposure; None if there are more than `most`.

    `sigma_px`: standard deviation of a star as the pixels record it, px; `divided_at` (k,) intp: segments before which
    pieces end.
    """
    return _divided(CameraPath(trails, camera), sigma_px, limits, most, divided_at)


def _divided(
    path: CameraPath,
    sigma_px: float,
    limits: PieceLimits,
    most: float,
    divided_at: NDArray[np.intp],
    fewest: int = 1,
) -> TrailPieces | None:
    """Return the pieces of a path, at least some: see `trail_pieces`."""
    bounds = np.union1d(path.bounds_of_equal_lengths(limits.length_sigma * sigma_px, fewest), divided_at)
    for _ in range(limits.halvings):
        if len(bounds) - 1 > most:
            return None
        moments = path.moments(bounds)
        skewness, kurtosis = path.errors(moments, sigma_px)
        uneven = np.flatnonzero((skewness > limits.skewness_error) | (kurtosis > limits.kurtosis_error))
        if not uneven.size:
            break
        bounds = np.insert(bounds, uneven + 1, (bounds[uneven] + bounds[uneven + 1]) / 2)
    return path.pieces(moments)
