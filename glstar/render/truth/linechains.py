"""Paths of stars as chains of straight lines, and the signal that the lines leave at a point."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.render.motion.trailmodels import AnalyticSegments, TrailModel
from glstar.render.readout.rows import OpenPath, RecordedTimes
from glstar.render.readout.stacking import StackedTrails
from glstar.render.scene.scene import Scene

Stars = slice | NDArray[np.intp]

# Lines of an exposure, at least.
_MIN_PARTS = 16
# Lines that are shorter than this, sigma, are wide Gaussians instead: the difference is below 1e-3.
_SHORT_SIGMA = 1.0
# Lines whose ends are farther than this, sigma, add less than 1e-5.
_FAR_SIGMA = 5.0


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
        is_near = _square_distance(self.middle_px, *point_px.T) < reach
        if self.hidden is not None:
            is_near &= ~self.hidden
        line, star = is_near.nonzero()
        return line * is_near.shape[1] + star, star


@dataclass(frozen=True, slots=True, eq=False)
class NearLines:
    """Lines that are near a point of their star, for Gaussians of one width."""

    star: NDArray[np.intp]  # (p,) the star of each line
    sigma_px: float
    middle_px: tuple[Float, Float]  # (p,) columns and rows of their middles, px
    along: tuple[Float, Float]  # (p,) columns and rows of unit vectors along them
    length_px: Float  # (p,) their lengths, px
    weight: Float  # (p,) the fraction of the star's flux
    transmission: Float | None  # (p,) what reaches the camera during each line; None for all

    @classmethod
    def of(
        cls, chain: LineChain, point_px: Float, reach_px: Float, sigma_px: float, transmission: Float | None
    ) -> Self:
        """Return the lines of a chain that are near a point of their star, (m, 2) px.

        `reach_px` (m,): how far from the point the signal is evaluated; `transmission` (n, m).
        """
        near, star = chain.near(point_px, reach_px + _FAR_SIGMA * sigma_px)
        length_px = chain.length_px.ravel().take(near)
        if chain.recorded is None:
            weight = chain.duration.take(near // chain.length_px.shape[1])
        else:
            weight = chain.recorded.ravel().take(near)
        shortest_px = np.maximum(length_px, 1e-9)
        along_x, along_y = (step.ravel().take(near) / shortest_px for step in chain.step_px)
        middle_x, middle_y = (middle.ravel().take(near) for middle in chain.middle_px)
        passing = None if transmission is None else transmission.ravel().take(near)
        return cls(star, sigma_px, (middle_x, middle_y), (along_x, along_y), length_px, weight, passing)

    @property
    def signal(self) -> "SignalOfLines":
        """Their signal as a function of the point."""
        return SignalOfLines(self, _Density.of(np.maximum(self.length_px, 1e-9) / self.sigma_px))


def _square_distance(middle_px: Sequence[Float] | Float, x_px: Float, y_px: Float) -> Float:
    """Return the squared distances of middles of lines from points, square px."""
    distance2 = middle_px[0] - x_px
    distance2 *= distance2
    down = middle_px[1] - y_px
    down *= down
    distance2 += down
    return distance2


class SignalOfLines(NamedTuple):
    """The signal of lines that are near a point of their star, as a function of the point."""

    lines: NearLines
    density: "_Density"

    def at(self, point_px: Float) -> Float:
        """Return the signal of stars at a point each, (m, 2) px, over their flux, (m,) 1/px^2."""
        lines = self.lines
        off_x, off_y = (at.take(lines.star) for at in point_px.T)
        off_x -= lines.middle_px[0]
        off_y -= lines.middle_px[1]
        off_x /= lines.sigma_px
        off_y /= lines.sigma_px
        along_x, along_y = lines.along
        s, across = off_x * along_x, off_x * along_y
        off_x = off_y * along_y
        s += off_x
        off_y *= along_x
        across -= off_y
        signal = self.density.at(s)
        signal *= lines.weight
        signal *= _half_square_exponential(across)
        if lines.transmission is not None:
            signal *= lines.transmission
        summed = np.bincount(lines.star, signal, minlength=len(point_px))
        return np.asarray(summed / (np.sqrt(2 * np.pi) * lines.sigma_px**2))


class _Density(NamedTuple):
    """The light of lines along them; lengths in sigma."""

    short: NDArray[np.intp] | None  # Indices of short lines and of the others; None for all of a kind
    long: NDArray[np.intp] | None
    variance: Float  # Of short lines, square sigma
    height: Float  # Square roots of 2 pi times the variances
    length: Float  # Of the others, sigma
    half: Float  # Half of these

    @classmethod
    def of(cls, length: Float) -> Self:
        """Return the light of lines of some lengths, (p,)."""
        is_short = length < _SHORT_SIGMA
        short, long = np.flatnonzero(is_short), np.flatnonzero(~is_short)
        is_mixed = short.size and long.size
        of_short, of_long = (
            (length.take(short), length.take(long)) if is_mixed else (length[: short.size], length[: long.size])
        )
        variance = 1 + of_short * of_short / 12
        return cls(
            short if is_mixed else None,
            long if is_mixed else None,
            variance,
            np.sqrt(2 * np.pi * variance),
            of_long,
            of_long / 2,
        )

    def at(self, s: Float) -> Float:
        """Return the light per sigma at distances from the middles of the lines, (p,)."""
        if self.short is None or self.long is None:
            return self._of_long(s) if self.length.size else self._of_short(s)
        density = np.empty_like(s)
        density[self.short] = self._of_short(s.take(self.short))
        density[self.long] = self._of_long(s.take(self.long))
        return density

    def _of_short(self, s: Float) -> Float:
        density = -0.5 * s
        density *= s
        density /= self.variance
        np.exp(density, out=density)
        density /= self.height
        return density

    def _of_long(self, s: Float) -> Float:
        after, before = normal_cumulative(np.stack([s + self.half, s - self.half]))
        return np.asarray((after - before) / self.length)


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


def normal_cumulative(z: Float) -> Float:
    """Return the cumulative distribution of the unit Gaussian to 1e-7: Abramowitz & Stegun, 26.2.17."""
    t = np.abs(z)
    t *= 0.2316419
    t += 1
    np.divide(1, t, out=t)
    polynomial = t * 1.330274429
    for coefficient in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        polynomial += coefficient
        polynomial *= t
    tail = _half_square_exponential(z) / np.sqrt(2 * np.pi)
    tail *= polynomial
    cumulative = np.asarray(1 - tail)
    np.copyto(cumulative, tail, where=z < 0)
    return cumulative


def _half_square_exponential(z: Float) -> Float:
    """Return exp(-z^2 / 2)."""
    exponential = -0.5 * z
    exponential *= z
    return np.exp(exponential, out=exponential)
