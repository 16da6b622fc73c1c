"""Which pieces of a star's trail a rolling shutter records in full, and what remains near its opening and closing.

A piece during which all rows that it lights are open contributes as under a global shutter.  Where a row opens or
closes during a piece, the fragment has to find the limits of its own row: `endpieces`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.horizoncrossing import rise_and_set
from glstar.render.motiontable import MotionTable
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments

__all__ = [
    "OpenPieces",
    "OpenSpans",
    "PixelOpenings",
    "SegmentColumns",
    "open_pieces",
    "open_spans",
    "overtaking",
    "whole_trails",
]

Float = NDArray[np.float64]

# Times, at least, between which the meeting of a star with an opening row is found by a line.
_ZONE_TIMES: Final = 12
# Further than a star is drawn, px: what a quadratic between the times of segments may be off.
_PATH_PX: Final = 0.5
# Of times, fractions of an exposure.
_ROUNDING: Final = 1e-12
# Speed of stars relative to that of the readout above which no trail is divided.
_FASTEST: Final = 0.9
# Behind a lens, how much wider than the star that is drawn the cut through a path may be: variance, relative.
_MOST_BLURRED: Final = 0.1


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

    @property
    def fastest(self) -> float:
        """Speed of stars relative to that of the readout above which no trail is divided.

        Behind a lens, pixels are resampled from several rows.  That blurs where faster paths are cut, which trail.frag
        corrects and trail_short.frag does not.
        """
        resampling = self.reach - 1.0
        return min(_FASTEST, float(np.sqrt(_MOST_BLURRED * resampling / self.reach))) if resampling else _FASTEST


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
        Index into the draw list.
    rises_and_sets : (c, 2) float64
        When a part begins and ends, as `horizoncrossing.rise_and_set` has it.
    """

    star: NDArray[np.intp]
    rises_and_sets: Float

    def of(self, columns: slice | NDArray[np.bool_]) -> "SegmentColumns":
        """Return some of the parts."""
        return SegmentColumns(self.star[columns], self.rises_and_sets[columns])


def whole_trails(scene: Scene, trails: AnalyticSegments) -> SegmentColumns:
    """Return the whole trails of a scene's stars as parts."""
    rises_and_sets = rise_and_set(trails, scene.stars.direction_eq[scene.draw_list.index])
    return SegmentColumns(np.arange(len(scene.draw_list)), rises_and_sets)


def overtaking(trails: AnalyticSegments, camera: Camera, openings: PixelOpenings) -> float:
    """Return an upper bound of the speed of stars on the image, relative to that of the readout."""
    rate_rad = trails.pointing.rotation_rad / np.repeat(trails.time_fraction / 2, 2)
    return float(rate_rad.max() * camera.max_px_per_rad * openings.per_px)


class OpenSpans(NamedTuple):
    """When all rows are open that a star lights, of k stars, and when any of them is: fractions of the exposure.

    Attributes
    ----------
    begin, end : (k,) float64
        All are open from the first to the second, if that is later; NaN if unknown.
    opens, closes : (k,) float64
        Bounds of the times at which the first one opens, and the last one closes.
    """

    begin: Float
    end: Float
    opens: Float
    closes: Float


def open_spans(scene: Scene, reach_px: Float, openings: PixelOpenings) -> OpenSpans | None:
    """Return when all rows are open that the stars of a scene light.

    Parameters
    ----------
    scene : Scene
        Its stars are up throughout the exposure.
    reach_px : (k,) float64
        How far from its position each star is drawn.
    openings : PixelOpenings

    Returns
    -------
    OpenSpans or None
        None where stars may be as fast as the readout.

    Notes
    -----
    A star at p(t) meets an opening row at t = o(p(t)).  Where it is slower than the readout, o(p(t)) is a contraction:
    there is one solution, and a row that opens by d later meets the star by d / (1 - r) later at most, r the ratio of
    the speeds.
    """
    trails = scene.trails
    assert isinstance(trails, AnalyticSegments)
    ratio = overtaking(trails, scene.camera, openings)
    if ratio > openings.fastest:
        return None
    last_opening = 1.0 - openings.open_time
    times, is_inner = _zone_times(trails, 0.0, last_opening)
    closing_times, is_inner_of_closing = _zone_times(trails, openings.open_time, 1.0)
    at = _opening_times(scene, np.concatenate([times, closing_times]), openings)
    opens, opens_error = _meeting(times, is_inner, at[: len(times)], last_opening)
    closes, closes_error = _meeting(
        closing_times - openings.open_time, is_inner_of_closing, at[len(times) :], last_opening
    )
    margin = openings.per_px * (reach_px + _PATH_PX)
    around_opening, around_closing = ((margin + error) / (1 - ratio) for error in (opens_error, closes_error))
    begin, end = (opens + around_opening).clip(max=last_opening), (closes - around_closing).clip(min=0.0)
    first, last = (opens - around_opening).clip(min=0.0), (closes + around_closing).clip(max=last_opening)
    return OpenSpans(begin, end + openings.open_time, first, last + openings.open_time)


def _zone_times(trails: AnalyticSegments, begin: float, end: float) -> tuple[Float, NDArray[np.bool_]]:
    """Return times that divide the segments of a part of the exposure evenly, and which lie inside of segments."""
    marks = trails.marks
    ends = np.unique(np.concatenate([[begin], marks[(marks > begin) & (marks < end)], [end]]))
    parts = max(2, -(-_ZONE_TIMES // (len(ends) - 1)))
    inner = np.arange(parts) / parts
    times = np.append((ends[:-1, np.newaxis] + np.diff(ends)[:, np.newaxis] * inner).ravel(), end)
    return times, np.append(np.tile(inner > 0, len(ends) - 1), False)


def _opening_times(scene: Scene, times: Float, openings: PixelOpenings) -> Float:
    """Return when the rows open in which stars are at some times, (n, k); NaN where they are not seen."""
    trails = scene.trails
    assert isinstance(trails, AnalyticSegments)
    table = MotionTable(trails.marks, trails.pointing)
    in_camera = table.at(times).to_camera(scene.stars.direction_eq[scene.draw_list.index], below_horizon=True)
    xy_px = scene.camera.pinhole.project(in_camera)
    return openings.at(xy_px.reshape(-1, 2)).reshape(xy_px.shape[:-1])


def _meeting(times: Float, is_inner: NDArray[np.bool_], opens: Float, last: float) -> tuple[Float, Float]:
    """Return when stars meet the rows that open, and bounds of the error of that row's opening, (k,) both.

    Parameters
    ----------
    times : (n,) float64
    is_inner : (n,) bool
        Which times are halfway between their neighbours on a smooth path.
    opens : (n, k) float64
        When the rows open in which the stars are then; they meet once, where this is the time.
    last : float
        When the last row opens.

    Notes
    -----
    A line between two times differs from a quadratic by an eighth of the second difference at most; here by a quarter.
    """
    inner = np.flatnonzero(is_inner)
    bend = np.abs(opens[inner - 1] - 2 * opens[inner] + opens[inner + 1]).max(axis=0) / 4
    late = opens.clip(0.0, last) - times[:, np.newaxis]
    after = np.argmax(late <= 0, axis=0).clip(1)
    stars = np.arange(opens.shape[1])
    early, final = late[after - 1, stars], late[after, stars]
    step = early / np.maximum(early - final, 1e-30)
    return times[after - 1] + step * (times[after] - times[after - 1]), bend


def open_pieces(spans: OpenSpans, ends: Float) -> OpenPieces:
    """Return which pieces of trails are recorded in full.

    Parameters
    ----------
    spans : OpenSpans
        When all rows are open that the stars light.
    ends : (n + 1,) float64
        Where pieces begin and end, fractions of the exposure.

    Returns
    -------
    OpenPieces
    """
    first = np.searchsorted(ends, np.nan_to_num(spans.begin, nan=1.0) - _ROUNDING)
    last = np.searchsorted(ends, np.nan_to_num(spans.end, nan=0.0) + _ROUNDING, side="right") - 1
    return OpenPieces(first, np.maximum(first, last), spans.opens, spans.closes)
