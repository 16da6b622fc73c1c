"""Which pieces of a star's trail a rolling shutter records in full, and what remains near its opening and closing.

A piece during which all rows that it lights are open contributes as under a global shutter.  Where a row opens or
closes during a piece, the fragment has to find the limits of its own row: those parts of the trail are drawn in
segments.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.horizoncrossing import NEVER, rise_and_set
from glstar.render.motiontable import MotionTable
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments

__all__ = [
    "DividedTrails",
    "OpenPieces",
    "OpenSpans",
    "PixelOpenings",
    "SegmentColumns",
    "columns_around",
    "divided_trails",
    "joined_columns",
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
# Segments are divided where the longest trail is longer than this during each, standard deviations.
_WORTH_SIGMA: Final = 30.0
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
    if ratio > _FASTEST:
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
    marks = np.concatenate([[0.0], np.cumsum(trails.time_fraction)])
    ends = np.unique(np.concatenate([[begin], marks[(marks > begin) & (marks < end)], [end]]))
    parts = max(2, -(-_ZONE_TIMES // (len(ends) - 1)))
    inner = np.arange(parts) / parts
    times = np.append((ends[:-1, np.newaxis] + np.diff(ends)[:, np.newaxis] * inner).ravel(), end)
    return times, np.append(np.tile(inner > 0, len(ends) - 1), False)


def _opening_times(scene: Scene, times: Float, openings: PixelOpenings) -> Float:
    """Return when the rows open in which stars are at some times, (n, k); NaN where they are not seen."""
    trails = scene.trails
    assert isinstance(trails, AnalyticSegments)
    table = MotionTable(np.concatenate([[0.0], np.cumsum(trails.time_fraction)]), trails.pointing)
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


def open_pieces(scene: Scene, ends: Float, reach_px: Float, openings: PixelOpenings) -> OpenPieces | None:
    """Return which pieces of the trails of a scene's stars are recorded in full.

    Parameters
    ----------
    scene, reach_px, openings
        As of `open_spans`.
    ends : (n + 1,) float64
        Where pieces begin and end, fractions of the exposure.

    Returns
    -------
    OpenPieces or None
        None where stars may be as fast as the readout.
    """
    spans = open_spans(scene, reach_px, openings)
    if spans is None:
        return None
    first = np.searchsorted(ends, np.nan_to_num(spans.begin, nan=1.0))
    last = np.searchsorted(ends, np.nan_to_num(spans.end, nan=0.0), side="right") - 1
    return OpenPieces(first, np.maximum(first, last), spans.opens, spans.closes)


class DividedTrails(NamedTuple):
    """The trails of a scene's stars in parts.

    Attributes
    ----------
    while_open : SegmentColumns
        While all rows are open that a star lights.
    ends : SegmentColumns or None
        Before and after, of the same stars; None of none.
    whole : SegmentColumns
        The trails of the other stars, which rise or set.
    """

    while_open: SegmentColumns
    ends: SegmentColumns | None
    whole: SegmentColumns


def divided_trails(scene: Scene, trails: AnalyticSegments, openings: PixelOpenings) -> DividedTrails | None:
    """Return the trails of a scene in parts; None where that costs more, or stars may be as fast as the readout."""
    sigma_px, radius_px = scene.sensor.effective_sigma_px, scene.draw_list.truncation_radius_px
    if trails.longest_trail_px(scene.camera) < _WORTH_SIGMA * sigma_px * len(trails):
        return None
    spans = open_spans(scene, openings.reach * radius_px, openings)
    if spans is None:
        return None
    whole = whole_trails(scene, trails)
    is_split = (whole.rises_and_sets == [0.0, NEVER]).all(axis=1) & (spans.end > spans.begin)
    of_split = OpenSpans(*(values[is_split] for values in spans))
    around = _columns_around(trails, whole.star[is_split], of_split)
    times = np.column_stack([of_split.begin, of_split.end])
    while_open = replace(whole.of(is_split), rises_and_sets=times)
    return DividedTrails(while_open, joined_columns([around], len(trails)), whole.of(~is_split))


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
    spans = OpenSpans(ends[pieces.first], ends[pieces.last], pieces.opens, pieces.closes)
    return _columns_around(trails, stars, spans)


def _columns_around(trails: AnalyticSegments, stars: NDArray[np.intp], spans: OpenSpans) -> SegmentColumns:
    """Return the parts of trails from an opening to the begin of another part, and from its end to a closing."""
    parts = np.concatenate([np.column_stack([spans.opens, spans.begin]), np.column_stack([spans.end, spans.closes])])
    parts = parts.clip(0.0, 1.0)
    marks = np.concatenate([[0.0], np.cumsum(trails.time_fraction)])
    first = (np.searchsorted(marks, parts[:, 0], side="right") - 1).clip(0, len(trails) - 1)
    last = (np.searchsorted(marks, parts[:, 1]) - 1).clip(0, len(trails) - 1)
    columns = SegmentColumns(np.tile(stars, 2), parts, first, np.maximum(last - first + 1, 1))
    return columns.of(parts[:, 1] > parts[:, 0])
