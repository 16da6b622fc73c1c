"""Which pieces of a star's trail a rolling shutter records in full, and what remains near its opening and closing.

A piece during which all rows that it lights are open contributes as under a global shutter.  Where a row opens or
closes during a piece, the fragment has to find the limits of its own row: those parts of the trail are drawn in
segments.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.horizoncrossing import NEVER, rise_and_set
from glstar.render.pointing import Pointing
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments
from glstar.rotation import turn_from_matrix

__all__ = [
    "OpenPieces",
    "PixelOpenings",
    "SegmentColumns",
    "columns_around",
    "joined_columns",
    "open_pieces",
    "overtaking",
    "whole_trails",
]

Float = NDArray[np.float64]

# Steps of the search for the time at which a star meets an opening row: each divides the error by the speed of the
# readout over that of the star.
_STEPS: Final = 4
# Speed of stars relative to that of the readout above which no trail is divided.
_FASTEST: Final = 0.9


@dataclass(frozen=True, slots=True)
class PixelOpenings:
    """When the pixels of a drawn image open, in fractions of the time from the first opening to the last closing.

    Attributes
    ----------
    open_time : float
        How long each pixel is open.
    per_px : float
        Upper bound of the change of the opening time per pixel.
    reach : float
        How far from a star the pixels are whose rows matter, in truncation radii: 1, and more behind a lens.
    at : callable
        Returns the opening times, (n,), of positions on the image, (n, 2) px; of those beside it any.
    """

    open_time: float
    per_px: float
    reach: float
    at: Callable[[Float], Float]


class OpenPieces(NamedTuple):
    """Which pieces of the trails of k stars a rolling shutter records in full.

    Attributes
    ----------
    first, last : (k,) intp
        From the first to the one before the last; none where they are equal.
    opens, closes : (k,) float64
        Bounds of the times at which the first row that a star lights opens, and the last one closes: fractions of the
        exposure.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    opens: Float
    closes: Float

    def of(self, stars: NDArray[np.bool_]) -> "OpenPieces":
        """Return those of some stars."""
        return OpenPieces(self.first[stars], self.last[stars], self.opens[stars], self.closes[stars])


@dataclass(frozen=True, slots=True, eq=False)
class SegmentColumns:
    """Parts of trails that are drawn in segments.

    Attributes
    ----------
    star : (c,) intp
        Index into the draw list; a star may have several parts.
    rises_and_sets : (c, 2) float64
        When a part begins and ends, as `horizoncrossing.rise_and_set` has it.
    first, count : (c,) intp
        The segments that it touches.
    """

    star: NDArray[np.intp]
    rises_and_sets: Float
    first: NDArray[np.intp]
    count: NDArray[np.intp]

    def of(self, columns: slice | NDArray[np.bool_]) -> "SegmentColumns":
        """Return some of the parts."""
        return SegmentColumns(
            self.star[columns], self.rises_and_sets[columns], self.first[columns], self.count[columns]
        )

    def rows_of(self, of_segments: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a table of all segments by parts, (m, c), in rows from the first segment of each part, (n, c)."""
        row = np.arange(self.count.max())[:, np.newaxis]
        segment = np.minimum(self.first + row, len(of_segments) - 1)
        return np.asarray(of_segments[segment, np.arange(len(self.star))] & (row < self.count))


def whole_trails(scene: Scene, trails: AnalyticSegments) -> SegmentColumns:
    """Return the whole trails of a scene's stars as parts."""
    count = len(scene.draw_list)
    rises_and_sets = rise_and_set(trails, scene.stars.direction_eq[scene.draw_list.index])
    first = np.zeros(count, np.intp)
    return SegmentColumns(np.arange(count), rises_and_sets, first, np.full(count, len(trails)))


def joined_columns(several: Sequence[SegmentColumns], segments: int) -> SegmentColumns | None:
    """Return the parts of several sets, such that as many segments follow the first of each part as the longest has.

    Parameters
    ----------
    several : sequence of SegmentColumns
    segments : int
        Number of segments of the whole trails.

    Returns
    -------
    SegmentColumns or None
        None if there are no parts.
    """
    first, count = (np.concatenate([getattr(one, name) for one in several]) for name in ("first", "count"))
    if not len(first):
        return None
    earlier = np.minimum(first, segments - count.max())
    return SegmentColumns(
        np.concatenate([one.star for one in several]),
        np.concatenate([one.rises_and_sets for one in several]),
        earlier,
        count + first - earlier,
    )


def overtaking(trails: AnalyticSegments, camera: Camera, openings: PixelOpenings) -> float:
    """Return an upper bound of the speed of stars on the image, relative to that of the readout."""
    C = trails.pointing.C_camera_eq
    rotation_rad = np.linalg.norm(turn_from_matrix(C[1:] @ np.swapaxes(C[:-1], 1, 2)), axis=1)
    rate_rad = rotation_rad / np.repeat(trails.time_fraction / 2, 2)
    return float(rate_rad.max() * camera.max_px_per_rad * openings.per_px)


def open_pieces(
    scene: Scene, pointing: Pointing, ends: Float, reach_px: Float, openings: PixelOpenings
) -> OpenPieces | None:
    """Return which pieces of the trails of a scene's stars are recorded in full.

    Parameters
    ----------
    scene : Scene
        Its stars are up throughout the exposure.
    pointing : Pointing
        The mean orientation during each of n pieces.
    ends : (n + 1,) float64
        Where pieces begin and end, fractions of the exposure.
    reach_px : (k,) float64
        How far from its mean position during a piece each star is drawn.
    openings : PixelOpenings

    Returns
    -------
    OpenPieces or None
        None where stars may be as fast as the readout.

    Notes
    -----
    A star at p(t) meets an opening row at t = o(p(t)).  Where it is slower than the readout, o(p(t)) is a contraction:
    there is one solution, within the last step of an iteration times r / (1 - r), r the ratio of the speeds.
    """
    assert isinstance(scene.trails, AnalyticSegments)
    ratio = overtaking(scene.trails, scene.camera, openings)
    if ratio > _FASTEST:
        return None
    direction_eq = np.tile(scene.stars.direction_eq[scene.draw_list.index], (2, 1))
    margin = openings.per_px * reach_px * np.array([[1.0], [-1.0]])
    # Behind no horizon: the stars are up.
    plain = Pointing(pointing.C_camera_eq, pointing.zenith_eq, pointing.velocity_eq, pointing.refraction_scale)
    is_closing = np.array([[0.0], [1.0]])
    time = np.zeros_like(margin) + is_closing
    for _ in range(_STEPS):
        piece = (np.searchsorted(ends, time.ravel(), side="right") - 1).clip(0, len(ends) - 2)
        xy_px = scene.camera.pinhole.project(plain[piece].each_to_camera(direction_eq))
        opens = (openings.at(xy_px).reshape(margin.shape) + margin).clip(0.0, 1.0 - openings.open_time)
        before, time = time, opens + is_closing * openings.open_time
    error = np.abs(time - before) * (ratio / (1 - ratio))
    opens_late, closes_early = time[0] + error[0], time[1] - error[1]
    first = np.searchsorted(ends, np.nan_to_num(opens_late, nan=1.0))
    last = np.searchsorted(ends, np.nan_to_num(closes_early, nan=0.0), side="right") - 1
    around = 2 * (margin[0] / (1 - ratio) + error)
    return OpenPieces(first, np.maximum(first, last), opens_late - around[0], closes_early + around[1])


def columns_around(
    trails: AnalyticSegments, ends: Float, stars: NDArray[np.intp], pieces: OpenPieces
) -> SegmentColumns:
    """Return the parts of trails before and after the pieces that are recorded in full.

    Parameters
    ----------
    trails : AnalyticSegments
    ends : (n + 1,) float64
        Where pieces begin and end, fractions of the exposure.
    stars : (k,) intp
        Index of each star in the draw list.
    pieces : OpenPieces
        Theirs: of each star at least one.

    Returns
    -------
    SegmentColumns
    """
    begins, stops = ends[pieces.first], ends[pieces.last]
    parts = np.concatenate([np.column_stack([pieces.opens, begins]), np.column_stack([stops, pieces.closes])])
    parts = parts.clip(0.0, 1.0)
    marks = np.concatenate([[0.0], np.cumsum(trails.time_fraction)])
    first = (np.searchsorted(marks, parts[:, 0], side="right") - 1).clip(0, len(trails) - 1)
    last = (np.searchsorted(marks, parts[:, 1]) - 1).clip(0, len(trails) - 1)
    rises_and_sets = np.zeros((len(parts), 2))
    rises_and_sets[: len(stars), 1] = begins
    rises_and_sets[len(stars) :] = np.column_stack([stops, np.full(len(stars), NEVER)])
    columns = SegmentColumns(np.tile(stars, 2), rises_and_sets, first, np.maximum(last - first + 1, 1))
    return columns.of(parts[:, 1] > parts[:, 0])
