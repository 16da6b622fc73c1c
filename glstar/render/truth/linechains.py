"""Paths of stars as chains of straight lines, and the signal that the lines leave at a point."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import pi, sqrt
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Float32
from glstar.render.motion.trailmodels import AnalyticSegments, TrailModel
from glstar.render.readout.rows import OpenPath, RecordedTimes
from glstar.render.readout.stacking import StackedTrails
from glstar.render.scene.scene import Scene
from glstar.render.truth.lightsums import PAIRS_AT_ONCE

Stars = slice | NDArray[np.intp]

# Lines of an exposure, at least.
_MIN_PARTS = 16
# Lines that are shorter than this, sigma, are wide Gaussians instead: the difference is below 1e-3.
_SHORT_SIGMA = 1.0
# Lines whose ends are farther than this, sigma, add less than 1e-5.
_FAR_SIGMA = 5.0
# Lines that are shorter than this have no length, px.
_NO_LENGTH_PX = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class LineChain:
    """Paths of m stars as chains of n lines."""

    middle_px: Float  # (2, n, m) middles of the lines, px
    step_px: Float  # (2, n, m) from their starts to their ends, px; 0 where a star is not visible
    length_px: Float  # (n, m) lengths of the lines, px
    duration: Float  # (n,) the fraction of the exposure of each line
    # (n, m) bool or None: which lines have an end that is not visible; None if all are visible.
    hidden: NDArray[np.bool_] | None
    # (n, m) or None: under a rolling shutter, the fraction of each star's own exposure of each line; None for
    # `duration`.
    recorded: Float | None

    @classmethod
    def of(cls, xy_px: Float, duration: Float, recorded: Float | None) -> Self:
        """Return the chain through positions, (2, n + 1, m) px; NaN where a star is not visible."""
        step_px = xy_px[:, 1:] - xy_px[:, :-1]
        length_px = np.sqrt(step_px[0] * step_px[0] + step_px[1] * step_px[1])  # five times as fast as hypot
        hidden = None
        if not np.isfinite(length_px.sum()):
            hidden, xy_px = ~np.isfinite(length_px), np.nan_to_num(xy_px)
            step_px[:, hidden] = 0.0
            length_px[hidden] = 0.0
        return cls((xy_px[:, 1:] + xy_px[:, :-1]) / 2, step_px, length_px, duration, hidden, recorded)

    def __len__(self) -> int:
        return len(self.duration)

    def __getitem__(self, stars: Stars) -> Self:
        """Return the chain of some stars."""
        hidden = None if self.hidden is None else self.hidden[:, stars]
        recorded = None if self.recorded is None else self.recorded[:, stars]
        vectors = self.middle_px[..., stars], self.step_px[..., stars]
        return type(self)(*vectors, self.length_px[:, stars], self.duration, hidden, recorded)

    @property
    def is_whole(self) -> NDArray[np.bool_]:
        """Which stars are visible all the time, (m,)."""
        is_hidden = np.zeros(self.middle_px.shape[2:], np.bool_) if self.hidden is None else self.hidden.any(axis=0)
        return np.asarray(~is_hidden)

    @property
    def weight(self) -> Float:
        """The fraction of each star's flux that each line has, (n, m)."""
        weight = self.recorded
        if weight is None:
            weight = np.broadcast_to(self.duration[:, np.newaxis], self.length_px.shape)
        return weight if self.hidden is None else np.where(self.hidden, 0.0, weight)

    def near(self, point_px: Float, reach_px: Float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return which lines are nearer to a point of their star, (m, 2) px, than a distance, (m,) px.

        Lines are numbers of a table of lines and stars, and the numbers of their stars: most lines are too far to
        matter.
        """
        reach = self.length_px / 2
        reach += reach_px
        reach *= reach
        is_near = square_distance_px2(self.middle_px, *point_px.T) < reach
        if self.hidden is not None:
            is_near &= ~self.hidden
        line, star = is_near.nonzero()
        return line * is_near.shape[1] + star, star


@dataclass(frozen=True, slots=True, eq=False)
class NearLines:
    """Lines that are near points, one of each star, and all long or all short, for Gaussians of one width.

    There are p lines; lengths are in sigma.
    """

    point: NDArray[np.intp]  # (p,) the point of each line
    sigma_px: float
    is_long: bool
    # (6, p): columns and rows of their middles, from the point; columns and rows of unit vectors along them; half of
    # the lengths of long lines, or 1 over the variance along short ones, which are Gaussians; the height of the density
    # along a line, with the fraction of the star's flux that arrives, 1/px^2.
    lines: Float32

    @classmethod
    def of(
        cls,
        chain: LineChain,
        points: Stars,
        point_px: Float,
        reach_px: Float,
        sigma_px: float,
        passing: Float | float,
    ) -> Iterator[Self]:
        """Yield the long and the short lines of a chain that are near a point of their star, (m, 2) px.

        `points`: the numbers of the points; `reach_px` (m,): how far from them the signal is evaluated; `passing`
        (n, m) or float: which fraction of the flux arrives during each line.
        """
        near, star = chain.near(point_px, reach_px + _FAR_SIGMA * sigma_px)
        length_px = np.maximum(chain.length_px.ravel().take(near), _NO_LENGTH_PX)
        light = chain.duration.take(near // chain.length_px.shape[1])
        if chain.recorded is not None:
            light = chain.recorded.ravel().take(near)
        light = light * (passing if isinstance(passing, float) else passing.ravel().take(near))
        step_x_px, step_y_px = (px.ravel().take(near) for px in chain.step_px)
        # A line without a length has a direction too: without one its light would not fall with the distance.
        step_x_px[length_px <= _NO_LENGTH_PX] = _NO_LENGTH_PX
        lines = np.stack(
            [
                *(
                    (px.ravel().take(near) - at.take(star)) / sigma_px
                    for px, at in zip(chain.middle_px, point_px.T, strict=True)
                ),
                step_x_px / length_px,
                step_y_px / length_px,
                length_px / sigma_px,
                light / (sqrt(2 * pi) * sigma_px**2),
            ]
        )
        point = star if isinstance(points, slice) else points[star]
        is_long = lines[4] >= _SHORT_SIGMA
        if (long := np.flatnonzero(is_long)).size:
            some = lines.take(long, axis=1)
            some[5] /= some[4]
            some[4] /= 2
            yield cls(point[long], sigma_px, True, some.astype(np.float32))
        if (short := np.flatnonzero(~is_long)).size:
            some = lines.take(short, axis=1)
            some[4] = 1 / (1 + some[4] * some[4] / 12)
            some[5] *= np.sqrt(some[4] / (2 * pi))
            yield cls(point[short], sigma_px, False, some.astype(np.float32))

    def of_points(self, points: NDArray[np.bool_]) -> Self:
        """Return the lines near some of the points, which get new numbers."""
        some = np.flatnonzero(points[self.point])
        number = np.cumsum(points) - 1
        return replace(self, point=number[self.point[some]], lines=self.lines.take(some, axis=1))

    def signal(self, x_px: Float, y_px: Float) -> Float:
        """Return the signal of stars at some places around their points, over their flux, (k, m) 1/px^2.

        `x_px` and `y_px` (k, m): from the points.
        """
        x, y = ((off_px / self.sigma_px).astype(np.float32) for off_px in (x_px, y_px))
        places, count = x.shape
        signal = np.zeros(x.size)
        at_once = max(1, PAIRS_AT_ONCE // places)
        for first in range(0, len(self.point), at_once):
            some = slice(first, first + at_once)
            point = self.point[some]
            light = self._light(x.take(point, axis=1), y.take(point, axis=1), some)
            place = point + count * np.arange(places)[:, np.newaxis]
            signal += np.bincount(place.ravel(), light.ravel(), minlength=len(signal))
        return signal.reshape(places, count)

    def _light(self, x: Float32, y: Float32, some: slice) -> Float32:
        """Return the light of some lines at offsets from their points, (k, p)."""
        middle_x, middle_y, along_x, along_y, extent, height = self.lines[:, some]
        x -= middle_x
        y -= middle_y
        s, across = x * along_x, x * along_y
        s += y * along_y
        y *= along_x
        across -= y
        across *= across
        if not self.is_long:
            s *= s
            s *= extent
            across += s
        across *= np.float32(-0.5)
        light: Float32 = np.exp(across, out=across)
        if self.is_long:
            after, before = normal_from_middle(np.stack([s + extent, s - extent]))
            after -= before
            light *= after
        light *= height
        return light


def square_distance_px2(middle_px: Sequence[Float] | Float, x_px: Float, y_px: Float) -> Float:
    """Return the squared distances of middles of lines from points, square px."""
    distance2 = middle_px[0] - x_px
    distance2 *= distance2
    down = middle_px[1] - y_px
    down *= down
    distance2 += down
    return distance2


def line_chains(
    scene: Scene, direction_eq: Float, nodes_px: Float | None = None, recorded: RecordedTimes | None = None
) -> Iterator[LineChain]:
    """Yield the chain of each short exposure of a stacked image, or of the exposure, while its rows are open.

    `direction_eq` (m, 3) are apparent unit vectors, `nodes_px` (2, n, m) their `ConicPaths.nodes_px` if known, and
    `recorded` says when a rolling shutter records them.
    """
    trails = scene.trails if scene.listing is None else scene.listing.trails
    if not isinstance(trails, StackedTrails):
        xy_px, duration = _path(scene, trails, direction_eq, nodes_px)
        yield LineChain.of(*_while_open(scene, xy_px, duration, recorded))
        return
    rows = [None] * len(trails.shorts) if recorded is None else recorded.shorts
    for short, times in zip(trails.shorts, rows, strict=True):
        xy_px, duration = _path(scene, short, direction_eq, None)
        yield LineChain.of(*_while_open(scene, xy_px, duration / len(trails.shorts), times))


def _path(scene: Scene, trails: TrailModel, direction_eq: Float, nodes_px: Float | None) -> tuple[Float, Float]:
    """Return positions along paths, (2, n, m) px, and the fractions of the exposure between them, (n - 1,)."""
    if isinstance(trails, AnalyticSegments) and 2 * len(trails) >= _MIN_PARTS:
        if nodes_px is None:
            nodes_px = np.moveaxis(scene.camera.project(trails.pointing.to_camera(direction_eq)), -1, 0)
        return nodes_px, np.repeat(trails.time_fraction / 2, 2)
    if isinstance(trails, AnalyticSegments):
        parts = 2 * -(-_MIN_PARTS // (2 * len(trails)))
        weight = np.repeat(trails.time_fraction / parts, parts)
        times = np.concatenate([[0.0], np.cumsum(weight)])
        xy_px = trails.positions(scene.camera, direction_eq, np.minimum(times, 1.0))
        return np.moveaxis(xy_px, -1, 0), weight
    xy_px = np.moveaxis(scene.camera.project(trails.pointing.to_camera(direction_eq)), -1, 0)
    xy_px = np.concatenate([xy_px, xy_px[:, -1:]], axis=1)
    return xy_px, np.full(xy_px.shape[1] - 1, 1 / (xy_px.shape[1] - 1))


def _while_open(
    scene: Scene, xy_px: Float, duration: Float, recorded: RecordedTimes | None
) -> tuple[Float, Float, Float | None]:
    """Return the arguments of `LineChain.of`: under a rolling shutter, the path between a star's opening and closing.

    What is before and after is left as lines of no length and no light.
    """
    exposure = scene.exposure.first
    if exposure.readout_s == 0:
        return xy_px, duration, None
    share = duration.sum()
    ends_s = (exposure.span_s / share) * np.concatenate([[0.0], np.cumsum(duration)])
    times = OpenPath.along(xy_px, ends_s, exposure, scene.camera) if recorded is None else OpenPath.of(recorded)
    ends_s = ends_s[:, np.newaxis]
    # Most of the path is between the opening and the closing of all stars.
    before = slice(0, int(np.searchsorted(ends_s[:, 0], times.opens_s.max(initial=0.0))))
    after = slice(int(np.searchsorted(ends_s[:, 0], times.closes_s.min(initial=np.inf), side="right")), None)
    xy_px = xy_px.copy()
    xy_px[:, before] = np.where(ends_s[before] < times.opens_s, times.first_px[:, np.newaxis], xy_px[:, before])
    xy_px[:, after] = np.where(ends_s[after] > times.closes_s, times.last_px[:, np.newaxis], xy_px[:, after])
    open_s = np.diff(ends_s.clip(times.opens_s, times.closes_s), axis=0)
    open_s *= share / np.maximum(times.closes_s - times.opens_s, 1e-12)
    return xy_px, duration, open_s


def normal_from_middle(z: Float32) -> Float32:
    """Return the integral of the unit Gaussian from 0 to z, to 3e-7: Abramowitz & Stegun, 26.2.17."""
    # Farther out the tail is below 1e-9, and its exponential would be a slow, tiny number.
    distance = np.minimum(np.abs(z), np.float32(6.0))
    t = distance * np.float32(0.2316419)
    t += 1
    np.divide(1, t, out=t)
    tail = t * np.float32(1.330274429)
    for coefficient in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        tail += np.float32(coefficient)
        tail *= t
    distance *= distance
    distance *= np.float32(-0.5)
    tail *= np.exp(distance, out=distance)
    tail *= np.float32(1 / sqrt(2 * pi))
    np.subtract(np.float32(0.5), tail, out=tail)
    integral: Float32 = np.copysign(tail, z, out=tail)
    return integral
