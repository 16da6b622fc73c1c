"""The ends of trails under a rolling shutter: pieces during which a row opens or closes that their star lights."""

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.camerapath import CameraPath
from glstar.render.horizoncrossing import NEVER
from glstar.render.openpieces import (
    OpenPieces,
    PixelOpenings,
    SegmentColumns,
    open_pieces,
    open_spans,
    whole_trails,
)
from glstar.render.pointing import Pointing
from glstar.render.scene import Scene
from glstar.render.trailmodels import AnalyticSegments

__all__ = ["DividedTrails", "EndPieces", "are_worth_dividing", "divided_trails", "end_pieces"]

Float = NDArray[np.float64]

# Segments are divided where the longest trail is longer than this during each, standard deviations.
_WORTH_SIGMA: Final = 30.0
# Length of the path of the fastest star during a piece at an end, standard deviations.
_LENGTH_SIGMA: Final = 1.6


@dataclass(frozen=True, slots=True, eq=False)
class EndPieces:
    """Pieces of trails that a rolling shutter records in part; each lies within one segment.

    Attributes
    ----------
    pointing : Pointing
        At the start, the middle and the end of each of n pieces: 3 n times.
    begin, duration : (n,) float64
        Fractions of the exposure.
    star, piece : (c,) intp
        Which star, an index into the draw list, is drawn during which piece.
    passage : (k, n) float32 or None
        What cloud transmits of each star in the draw list during each piece; None without cloud.
    """

    pointing: Pointing
    begin: Float
    duration: Float
    star: NDArray[np.intp]
    piece: NDArray[np.intp]
    passage: NDArray[np.float32] | None = None


def end_pieces(
    path: CameraPath,
    bounds: Float,
    stars: NDArray[np.intp],
    recorded: OpenPieces,
    passage: NDArray[np.float32] | None = None,
) -> EndPieces:
    """Return the pieces of trails that are recorded in part.

    Parameters
    ----------
    path : CameraPath
    bounds : (n + 1,) float64
        Where the pieces begin and end that are recorded in full, numbers of segments.
    stars : (k,) intp
        Indices into the draw list.
    recorded : OpenPieces
        Which of those pieces are recorded: of each star at least one.
    passage : (m, s) float32, optional
        What cloud transmits of each star of the draw list during each segment.

    Returns
    -------
    EndPieces
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
    """The trails of a scene's stars in parts.

    Attributes
    ----------
    while_open : SegmentColumns
        While all rows are open that a star lights.
    ends : EndPieces
        Before and after, of the same stars.
    whole : SegmentColumns
        The trails of the other stars, which rise or set.
    """

    while_open: SegmentColumns
    ends: EndPieces
    whole: SegmentColumns


def are_worth_dividing(trails: AnalyticSegments, camera: Camera, sigma_px: float) -> bool:
    """Return whether trails of Gaussians are long enough for `divided_trails` to save time under a rolling shutter."""
    return trails.longest_trail_px(camera) >= _WORTH_SIGMA * sigma_px * len(trails)


def divided_trails(scene: Scene, trails: AnalyticSegments, openings: PixelOpenings) -> DividedTrails | None:
    """Return the trails of a scene in parts; None where that costs more, or stars may be as fast as the readout."""
    sigma_px, radius_px = scene.sensor.effective_sigma_px, scene.draw_list.truncation_radius_px
    if not are_worth_dividing(trails, scene.camera, sigma_px):
        return None
    spans = open_spans(scene, openings.reach * radius_px, openings)
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
