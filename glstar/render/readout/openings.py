"""Which pieces of a star's trail a rolling shutter records in full, and which in part, near its opening and closing.

A piece during which all rows that it lights are open contributes as under a global shutter.  Where a row opens or
closes during a piece, the fragment has to find the limits of its own row (`EndPieces`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.model import Camera
from glstar.render.motion.pointing import MotionTable, Pointing
from glstar.render.motion.trailmodels import AnalyticSegments, CameraPath
from glstar.render.scene.occlusion import NEVER, rise_and_set
from glstar.render.scene.scene import Scene

# Minimum number of times between which the meeting of a star with an opening row is found by a line.
_ZONE_TIMES = 12
# Margin around a drawn star, px: the error of a quadratic between the times of segments.
_PATH_PX = 0.5
# Rounding error of times, fractions of an exposure.
_ROUNDING = 1e-12
# Speed of stars relative to that of the readout above which no trail is divided.
_FASTEST = 0.9


@dataclass(frozen=True, slots=True)
class PixelOpenings:
    """When the pixels of a drawn image open, in fractions of the time from the first opening to the last closing."""

    open_time: float  # How long each pixel is open
    per_px: float  # Upper bound of the change of the opening time per pixel
    # Opening times, (n,), at positions on the image, (n, 2) px; beside the image any.
    at: Callable[[Float], Float]


class OpenPieces(NamedTuple):
    """Which pieces of the trails of k stars a rolling shutter records in full."""

    first: NDArray[np.intp]  # (k,) intp: from the first to the one before the last; none where they are equal
    last: NDArray[np.intp]
    # (k,) bounds of the times at which the first row that a star lights opens, and the last one closes: fractions of
    # the exposure.
    opens: Float
    closes: Float

    def of(self, stars: NDArray[np.bool_]) -> "OpenPieces":
        """Return the pieces of some stars."""
        return OpenPieces(self.first[stars], self.last[stars], self.opens[stars], self.closes[stars])


@dataclass(frozen=True, slots=True, eq=False)
class SegmentColumns:
    """Parts of trails that are drawn in segments."""

    star: NDArray[np.intp]  # (c,) intp: index into the draw list
    rises_and_sets: Float  # (c, 2) when a part begins and ends: see `occlusion.rise_and_set`

    def of(self, columns: slice | NDArray[np.bool_]) -> "SegmentColumns":
        """Return some of the parts."""
        return SegmentColumns(self.star[columns], self.rises_and_sets[columns])


def whole_trails(scene: Scene, trails: AnalyticSegments) -> SegmentColumns:
    """Return the whole trails of a scene's stars as parts."""
    rises_and_sets = rise_and_set(trails, scene.stars.direction_eq[scene.draw_list.index], scene.camera)
    return SegmentColumns(np.arange(len(scene.draw_list)), rises_and_sets)


def overtaking(trails: AnalyticSegments, camera: Camera, openings: PixelOpenings) -> float:
    """Return an upper bound of the speed of stars on the image, relative to the readout's speed."""
    rate_rad = trails.pointing.rotation_rad / np.repeat(trails.time_fraction / 2, 2)
    return float(rate_rad.max() * camera.max_px_per_rad * openings.per_px)


class OpenSpans(NamedTuple):
    """When all rows are open that a star lights, of k stars, and when any of them is: fractions of the exposure."""

    begin: Float  # (k,) all are open from the first to the second, if that is later; NaN if unknown
    end: Float
    opens: Float  # (k,) bounds of the times at which the first one opens, and the last one closes
    closes: Float


def open_spans(scene: Scene, reach_px: Float, openings: PixelOpenings) -> OpenSpans | None:
    """Return when all rows are open that the stars of a scene light; None where stars may be as fast as the readout.

    The stars are up throughout the exposure; `reach_px` (k,): how far from its position each is drawn.

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
    xy_px = scene.camera.project(in_camera)
    return openings.at(xy_px.reshape(-1, 2)).reshape(xy_px.shape[:-1])


def _meeting(times: Float, is_inner: NDArray[np.bool_], opens: Float, last: float) -> tuple[Float, Float]:
    """Return when stars meet the rows that open, and bounds of the error of that row's opening, (k,) both.

    `times` (n,); `is_inner` (n,) bool: which times are halfway between their neighbours on a smooth path; `opens` (n,
    k): when the rows open in which the stars are then; they meet once, where this is the time; `last`: when the last
    row opens.  A line between two times differs from a quadratic by an eighth of the second difference at most; here
    by a quarter.
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
    """Return which pieces of trails, with ends (n + 1,) at fractions of the exposure, are recorded in full."""
    first = np.searchsorted(ends, np.nan_to_num(spans.begin, nan=1.0) - _ROUNDING)
    last = np.searchsorted(ends, np.nan_to_num(spans.end, nan=0.0) + _ROUNDING, side="right") - 1
    return OpenPieces(first, np.maximum(first, last), spans.opens, spans.closes)


# Segments are divided where the longest trail is longer than this during each, standard deviations.
_WORTH_SIGMA = 30.0
# Length of the path of the fastest star during a piece at an end, standard deviations.
_LENGTH_SIGMA = 1.6


@dataclass(frozen=True, slots=True, eq=False)
class EndPieces:
    """Pieces of trails that a rolling shutter records in part; each lies within one segment."""

    pointing: Pointing  # At the start, the middle and the end of each of n pieces: 3 n times
    begin: Float  # (n,) fractions of the exposure
    duration: Float
    star: NDArray[np.intp]  # (c,) intp: which star, an index into the draw list, is drawn during which piece
    piece: NDArray[np.intp]
    # (k, n) float32 or None: what cloud transmits of each star in the draw list during each piece; None without cloud.
    passage: NDArray[np.float32] | None = None


def end_pieces(
    path: CameraPath,
    bounds: Float,
    stars: NDArray[np.intp],
    recorded: OpenPieces,
    passage: NDArray[np.float32] | None = None,
) -> EndPieces:
    """Return the pieces of the trails of stars, (k,) indices into the draw list, that are recorded in part.

    `bounds` (n + 1,): ends of the pieces, numbers of segments; `recorded`: which of them are recorded in full, of each
    star at least one; `passage` (m, s) float32: transmission of each star of the draw list during each segment.
    """
    ends = np.union1d(bounds, np.arange(len(path) + 1))
    times = path.times(ends)
    opens = (np.searchsorted(times, recorded.opens, side="right") - 1).clip(0)
    closes = np.searchsorted(times, recorded.closes).clip(max=len(times) - 1)
    begin, stop = (np.searchsorted(ends, bounds[of]) for of in (recorded.first, recorded.last))
    first = np.concatenate([np.minimum(opens, begin), stop])
    count = np.concatenate([begin, np.maximum(closes, stop)]) - first
    piece = np.arange(count.sum()) + np.repeat(first - (np.cumsum(count) - count), count)
    drawn, piece = np.unique(piece, return_inverse=True)
    return EndPieces(
        path.pointings(ends[drawn], ends[drawn + 1]),
        times[drawn],
        times[drawn + 1] - times[drawn],
        np.repeat(np.tile(stars, 2), count),
        piece,
        None if passage is None else passage[:, ends[drawn].astype(np.intp)],
    )


class DividedTrails(NamedTuple):
    """The trails of a scene's stars in parts."""

    while_open: SegmentColumns  # While all rows are open that a star lights
    ends: EndPieces  # Before and after, of the same stars
    whole: SegmentColumns  # The trails of the other stars, which rise or set


def are_worth_dividing(trails: AnalyticSegments, camera: Camera, sigma_px: float) -> bool:
    """Return whether trails of Gaussians are long enough for `divided_trails` to save time under a rolling shutter."""
    return trails.longest_trail_px(camera) >= _WORTH_SIGMA * sigma_px * len(trails)


def divided_trails(scene: Scene, trails: AnalyticSegments, openings: PixelOpenings) -> DividedTrails | None:
    """Return the trails of a scene in parts; None where that costs more, or stars may be as fast as the readout."""
    sigma_px, radius_px = scene.sensor.effective_sigma_px, scene.draw_list.truncation_radius_px
    if not are_worth_dividing(trails, scene.camera, sigma_px):
        return None
    spans = open_spans(scene, radius_px, openings)
    if spans is None:
        return None
    path, last_opening = CameraPath(trails, scene.camera), 1.0 - openings.open_time
    even = path.bounds_of_equal_lengths(_LENGTH_SIGMA * sigma_px)
    at, number = path.times(even), np.arange(len(path) + 1)
    limits = np.interp([last_opening, openings.open_time], trails.marks, number)
    bounds = np.union1d(even[(at <= last_opening) | (at >= openings.open_time)], limits)
    times, whole = path.times(bounds), whole_trails(scene, trails)
    recorded = open_pieces(spans, times)
    is_split = (whole.rises_and_sets == [0.0, NEVER]).all(axis=1) & (recorded.last > recorded.first)
    recorded, split = recorded.of(is_split), whole.of(is_split)
    while_open = replace(split, rises_and_sets=np.column_stack([times[recorded.first], times[recorded.last]]))
    ends = end_pieces(path, bounds, split.star, recorded, scene.draw_list.passage)
    return DividedTrails(while_open, ends, whole.of(~is_split))
