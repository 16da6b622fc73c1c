"""A star's trail cut into segments that are each drawn whole: where an exposure is cut, and by which bound.

Within a segment the vector to a star is taken for a quadratic of time, through where it is at the segment's beginning,
middle and end, and its place for what a pinhole makes of that: a conic, on which a steady turn is seen, too (`way`).
`trail.frag` has the light of such a way in closed form.  A segment is as long as the bound allows, whatever turns the
camera: one may do for a steady turn of degrees, and between two beats of a vibration there are several.
"""

from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.camera.model import Camera
from glstar.render.scene import Pointing
from glstar.render.starpaths import end_weights
from glstar.rotation import turn_from_matrix
from glstar.sky.horizon import refraction_displacement

__all__ = ["SHORT_SIGMA", "segment_times"]

Float = NDArray[np.float64]
# Where segments begin and end.
Segments = tuple[Float, Float]
# The ways of probes in each segment, and how much too great its error is: drawn truly enough up to 1, NaN if not known.
Seen = tuple[Float, Float]

# How far a star may stand from where it is drawn at the same time, px ...
_PLACE_PX: Final = 0.02
# ... how much of the trail's own light that may cost or add, anywhere ...
_TRAIL_SHARE: Final = 5e-3
# ... and how much of the light of the star standing still.
_PEAK_SHARE: Final = 5e-4

# A way shorter than this many sigma is drawn as two Gaussians: way.frag.
SHORT_SIGMA: Final = 2.0
# No way is drawn with light that varies more than this from its middle to its end, or with more than this many times
# as much where it begins or ends: way.frag.
_STEEPEST: Final = 0.9
_MOST_AT_ENDS: Final = 3.0

# A segment is looked at this often at the least, and twice between any two samples of the log.
_LEAST_LOOKS: Final = 8
_SHORTEST_S: Final = 2e-5

# A turn rate that changes by less than this share of itself at a sample of the log is even there.
_UNEVEN_TURN: Final = 1e-3
# Into so many parts a segment is cut at once, at the most: what its error says is less sure the larger that is.
_MOST_PARTS: Final = 24
# And into so many where there is no telling.
_UNKNOWN_PARTS: Final = 4

# What a segment costs on software OpenGL, in sub-exposures: 1.3 sprites of four each (tests/bench).
_SUB_EXPOSURES_A_SEGMENT: Final = 4 * 1.3


def segment_times(
    pointings_at: Callable[..., list[Pointing]],
    knots_s: Float,
    camera: Camera,
    sigma_px: float,
    *,
    sub_exposures: Callable[[float], int] | None = None,
) -> Float | None:
    """Return the ends and the middles of the segments of an exposure.

    Parameters
    ----------
    pointings_at : callable
        Where the camera looks at each of some moments, for several sets of moments: `Simulator.pointings`.
    knots_s : (n,) float64
        The exposure's beginning and end, and between them the moments at which the turn rate may change at once: the
        samples of the log.  A segment that has to be cut is cut at one where it does, and evenly where there is none.
    camera : Camera
        The stars of its whole field are looked after: its corners, the middles of its sides and its middle.  Behind a
        lens trails are drawn as in a pinhole, and bent afterwards.
    sigma_px : float
        Standard deviation of a star as the pixels record it, px.
    sub_exposures : callable, optional
        How many sub-exposures sprites take for trails of a length, px; where sprites may be drawn instead.

    Returns
    -------
    (2 m + 1,) float64 or None
        UTC seconds since 1970: the beginning, the middle and the end of the first segment, which is the second's
        beginning, and so on.  None if the exposure is so rough that it wants more segments than sprites would cost.
    """
    course = _Course(pointings_at, knots_s, camera, sigma_px)
    segments = knots_s[:1], knots_s[-1:]
    if sub_exposures is None:
        seen = course.looked_at(segments)
    else:
        # Both are asked for at once: `_Course.looked_at`.
        parts = _parts(knots_s, sub_exposures(0.0))
        seen = course.looked_at(parts, segments)
        if _is_rough(course, parts, *next(seen), sub_exposures):
            return None
    _, excess = next(seen)
    starts = np.sort(np.concatenate([begins for begins, _ in course.refined(segments, excess)]))
    times = np.empty(2 * len(starts) + 1)
    times[:-1:2] = starts
    times[-1] = knots_s[-1]
    times[1::2] = (times[:-1:2] + times[2::2]) / 2
    return times


def _parts(knots_s: Float, sub_exposures: int) -> Segments:
    """Return even parts of an exposure, not so many as segments would still pay.

    Where several of them want to be cut, too many are wanted.
    """
    marks_s = np.linspace(knots_s[0], knots_s[-1], max(1, int(0.7 * (sub_exposures / _SUB_EXPOSURES_A_SEGMENT))) + 1)
    return marks_s[:-1], marks_s[1:]


def _is_rough(
    course: "_Course", parts: Segments, xy: Float, excess: Float, sub_exposures: Callable[[float], int]
) -> bool:
    """Return whether an exposure, of which parts have been looked at, wants so many segments that sprites cost less."""
    if (excess <= 1.0).all():
        return False
    steps_px = np.linalg.norm(np.diff(xy, axis=0), axis=-1)
    most = sub_exposures(float(np.nansum(steps_px, axis=(0, 1)).max())) / _SUB_EXPOSURES_A_SEGMENT
    accepted = 0
    for begins, left in course.refined(parts, excess):
        accepted += len(begins)
        if accepted + left > most:
            return True
    return False


class _Course:
    """How the camera turns during an exposure, looked at segment by segment; parameters are `segment_times`'s."""

    def __init__(
        self, pointings_at: Callable[..., list[Pointing]], knots_s: Float, camera: Camera, sigma_px: float
    ) -> None:
        self._pointings_at = pointings_at
        self._knots_s = knots_s
        self._camera = camera
        self._sigma_px = sigma_px
        self._at_knots: Pointing | None = None

    def looked_at(self, *several: Segments) -> Iterator[Seen]:
        """Yield of sets of segments the ways of the probes, and how much too great each segment's error is."""
        moments_s = [self._looks_s(begins, ends) for begins, ends in several]
        # With the first looks, for to ask takes longer than to answer.
        if self._at_knots is None:
            self._at_knots, *pointings = self._pointings_at(self._knots_s, *moments_s)
        else:
            pointings = self._pointings_at(*moments_s)
        for (begins, ends), pointing in zip(several, pointings, strict=True):
            xy, depth = _probes(pointing, len(begins), self._camera)
            long_s = ends - begins
            excess = _excess(xy, depth, long_s / (self._knots_s[-1] - self._knots_s[0]), self._sigma_px)
            excess[long_s < _SHORTEST_S] = 0.0
            yield xy, excess

    def _looks_s(self, begins: Float, ends: Float) -> Float:
        """Return the moments at which segments are looked at, equally many for each, one segment after the other."""
        within = int((self._knots_s.searchsorted(ends) - self._knots_s.searchsorted(begins)).max())
        looks = _LEAST_LOOKS
        while looks < 2 * within:
            looks *= 2
        moments_s = begins[:, np.newaxis] + (ends - begins)[:, np.newaxis] * _even_shares(looks + 1)
        moments_s[:, -1] = ends
        return moments_s.ravel()

    def refined(self, segments: Segments, excess: Float) -> Iterator[tuple[Float, int]]:
        """Yield, cut after cut, where segments begin that are drawn truly, and how many parts of others are left."""
        begins, ends = segments
        while not (fine := excess <= 1.0).all():
            true_begins = begins[fine]
            begins, ends = self._cut(begins[~fine], ends[~fine], excess[~fine])
            yield true_begins, len(begins)
            _, excess = next(self.looked_at((begins, ends)))
        yield begins, 0

    def _cut(self, begins: Float, ends: Float, excess: Float) -> Segments:
        """Return the parts of segments: cut at the kink nearest to the middle, or evenly."""
        kinks_s, middles = self._kinks_s, (begins + ends) / 2
        after = np.minimum(np.maximum(kinks_s.searchsorted(middles), 1), len(kinks_s) - 1)
        before_s, after_s = kinks_s[after - 1], kinks_s[after]
        # Of two as near the earlier one, whatever the last digit of the exposure's time.
        nearest = np.where(middles - before_s < after_s - middles + _SHORTEST_S, before_s, after_s)
        at_kink = (nearest > begins) & (nearest < ends)
        if at_kink.all():
            return np.concatenate([begins, nearest]), np.concatenate([nearest, ends])
        starts, stops = _even_parts(begins[~at_kink], ends[~at_kink], excess[~at_kink])
        begins, ends, nearest = begins[at_kink], ends[at_kink], nearest[at_kink]
        return np.concatenate([begins, nearest, starts]), np.concatenate([nearest, ends, stops])

    @cached_property
    def _kinks_s(self) -> Float:
        """The knots at which the turn rate does change at once, and the exposure's beginning and end."""
        assert self._at_knots is not None
        C = self._at_knots.C_camera_eq
        turns = C[1:] @ np.swapaxes(C[:-1], 1, 2)
        rate = turn_from_matrix(turns) / np.diff(self._knots_s)[:, np.newaxis]
        change = np.linalg.norm(np.diff(rate, axis=0), axis=1)
        uneven = change > _UNEVEN_TURN * np.linalg.norm(rate, axis=1).max()
        kinks_s: Float = self._knots_s[np.concatenate([[True], uneven, [True]])]
        return kinks_s


def _even_parts(begins: Float, ends: Float, excess: Float) -> Segments:
    """Return the parts of segments, each cut evenly into as many as its error asks for."""
    # That goes with the third power of a segment's length.
    known = np.where(np.isfinite(excess), np.cbrt(excess), _UNKNOWN_PARTS)
    counts = np.ceil(known).clip(2, _MOST_PARTS).astype(np.intp)
    whose = np.repeat(np.arange(len(counts)), counts)
    part = np.arange(len(whose)) - (np.cumsum(counts) - counts)[whose]
    step_s = ((ends - begins) / counts)[whose]
    starts = begins[whose] + part * step_s
    return starts, np.where(part == counts[whose] - 1, ends[whose], begins[whose] + (part + 1) * step_s)


def _probes(pointing: Pointing, segments: int, camera: Camera) -> tuple[Float, Float]:
    """Return the ways of stars all over the field in the middle of each segment, (looks, segments, 9, 2) px.

    And how far ahead of the camera they are at the segments' beginnings, middles and ends, (3, segments, 9), weighted.
    """
    C = pointing.C_camera_eq.reshape(segments, -1, 3, 3)
    looks = C.shape[1]
    directions = np.swapaxes(C[:, looks // 2], 1, 2) @ _rays(camera)
    zenith_eq = pointing.zenith_eq.reshape(segments, -1, 3)
    velocity_eq = pointing.velocity_eq.reshape(segments, -1, 3)
    lift = refraction_displacement(zenith_eq @ directions, pointing.refraction_scale)
    moved = directions[:, np.newaxis] + velocity_eq[..., np.newaxis]
    moved += lift[:, :, np.newaxis] * zenith_eq[..., np.newaxis]
    in_camera = (C @ moved).transpose(1, 0, 3, 2)
    depth = in_camera[[0, looks // 2, -1], ..., 2]
    depth[[0, 2]] *= end_weights(C[:, 0], C[:, -1])[:, np.newaxis]
    return camera.pinhole.project(in_camera), depth


# Each exposure of a flight asks for the same camera's.
@lru_cache(maxsize=64)
def _rays(camera: Camera) -> Float:
    """Return where the probes stand before the camera, (3, 9 or less) unit vectors."""
    columns, rows = (
        (edge * np.array([-0.5, 0.0, 0.5]) + (edge - 1) / 2) for edge in (camera.width_px, camera.height_px)
    )
    rays = camera.unproject([(x, y) for y in rows for x in columns]).T
    rays = rays[:, np.isfinite(rays).all(axis=0)]
    rays /= np.linalg.norm(rays, axis=0)
    rays.flags.writeable = False
    return rays


def _excess(xy: Float, depth: Float, share: Float, sigma_px: float) -> Float:
    """Return how many times as great as allowed the error of segments is: of what `_probes` tells.

    Not a number, or infinite, where a probe has left the sky before the camera, or its way cannot be drawn at all.
    """
    off = xy - xy[0]
    off_x, off_y = off[..., 0], off[..., 1]
    chord_x, chord_y = off_x[-1], off_y[-1]
    length = np.hypot(chord_x, chord_y)
    safe_length = np.where(length > 0, length, 1.0)
    along_x, along_y = np.where(length > 0, chord_x, 1.0) / safe_length, chord_y / safe_length
    s = off_x * along_x + off_y * along_y
    p = off_y * along_x - off_x * along_y
    short = length < SHORT_SIGMA * sigma_px
    astray, error = np.zeros(short.shape), np.zeros(short.shape)
    # Most exposures want but one of the two.
    if np.count_nonzero(short) < short.size:
        astray, error = _as_way(s, p, depth, length, sigma_px)
    if np.count_nonzero(short):
        astray, error = np.where(short, 0.0, astray), np.where(short, _as_two_gaussians(s, p, length, sigma_px), error)

    level = 2.5 * sigma_px / np.maximum(length, 1e-9)
    level = np.minimum(1.0, share[:, np.newaxis] * np.minimum(4.0, level))
    excess = np.maximum(astray * (1 / _PLACE_PX), error * np.maximum(1 / _TRAIL_SHARE, level * (1 / _PEAK_SHARE)))
    return np.asarray(excess.max(axis=-1))


def _as_two_gaussians(s: Float, p: Float, length: Float, sigma_px: float) -> Float:
    """Return the error of two Gaussians, (segments, probes): the moments of where they put light, and of where it is.

    Places along the chord and across it, (looks, segments, probes) px, and its length.
    """
    half = len(s) // 2
    ahead = s[half] - length / 2
    off_s, off_p = s - (length / 2 + 2 * ahead / 3), p - 2 * p[half] / 3
    off_s2, off_p2 = off_s * off_s, off_p * off_p
    seen = np.stack([off_s, off_p, off_s2, off_p2, off_s * off_p]).reshape(5, len(s), -1)
    astray_s, astray_p, along2, bent, slanted = (_simpson_weights(len(s)) @ seen).reshape(5, *length.shape)
    spread = np.abs(along2 - (length * length / 12 + 4 * ahead * ahead / 45))
    moved = (spread + bent + np.abs(slanted)) / (2 * sigma_px**2)
    extent2 = (off_s2 + off_p2).max(axis=0) / sigma_px**2
    return np.asarray(0.61 / sigma_px * np.hypot(astray_s, astray_p) + moved + 4e-4 * extent2 * extent2 * extent2)


def _as_way(s: Float, p: Float, depth: Float, length: Float, sigma_px: float) -> tuple[Float, Float]:
    """Return how far from its place a star is drawn at the most, px, and the error, both (segments, probes).

    As a bent way with light that varies along it, as way.frag makes it of the same: places of one time are compared.
    """
    half = len(s) // 2
    safe_length = np.maximum(length, 1e-9)
    x, bend = s / safe_length, p[half] / safe_length
    before, after = depth[0] / depth[1], depth[2] / depth[1]
    leaves, arrives = 4 * x[half] - after, 4 - 4 * x[half] - before
    is_drawn = np.minimum(leaves, arrives) > 1 / _MOST_AT_ENDS
    leaves, arrives = np.maximum(leaves, 1 / _MOST_AT_ENDS), np.maximum(arrives, 1 / _MOST_AT_ENDS)
    steepness, hollow = 4 * x[half] - 2, 0.75 * (before / leaves + after / arrives) - 1.5
    skew = 2 * bend * (1 / arrives - 1 / leaves)
    bow = bend / np.maximum(x[half] * (1 - x[half]), 0.05) - skew * (2 * x[half] - 1)
    is_drawn &= np.abs(steepness) + np.abs(hollow) < _STEEPEST

    from_middle = 2 * x - 1
    to_ends = x * (1 - x)
    passed = x - to_ends * (steepness + hollow * from_middle * (2 / 3))
    light = 1 + steepness * from_middle + hollow * (2 / 3 - 4 * to_ends)
    late = passed - _even_shares(len(s))[:, np.newaxis, np.newaxis]
    off_along = length * late / np.maximum(light, 0.1)
    off_across = p - length * to_ends * (bow + skew * from_middle)
    off = np.sqrt((off_along * off_along + off_across * off_across).max(axis=0))
    # What moves along the way is seen where the light is uneven for it, and no more than what moves across.
    uneven = np.abs(np.diff(late, axis=0)).max(axis=0) * (len(s) - 1)
    along = np.minimum(uneven, np.abs(off_along).max(axis=0) * (0.7 / sigma_px))
    # Of what the slope of a way's ends to its chord does to the light, a tenth to a quarter of its square is left out.
    error = along + np.abs(off_across).max(axis=0) * (0.7 / sigma_px) + 0.3 * bow * bow
    return off, np.where(is_drawn, error, np.inf)


@lru_cache(maxsize=16)
def _even_shares(looks: int) -> Float:
    """Return which share of a segment has passed at each of so many even looks, 0 to 1."""
    shares = np.arange(looks) / (looks - 1)
    shares.flags.writeable = False
    return shares


@lru_cache(maxsize=16)
def _simpson_weights(looks: int) -> Float:
    """Return how much of a mean each of so many even looks is worth, an odd number."""
    weights = np.where(np.arange(looks) % 2, 4.0, 2.0) / (3 * (looks - 1))
    weights[[0, -1]] /= 2
    weights.flags.writeable = False
    return weights
