"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers.

Paths are chains of straight lines.  Neighbouring stars have similar paths: what each line receives from all others is
computed for a grid of example directions over the image, and interpolated for the stars.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Float32
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor, noise_equivalent_area_px2
from glstar.render.motion.trailmodels import AnalyticSegments, TrailModel
from glstar.render.readout.rows import OpenPath, RecordedTimes
from glstar.render.readout.stacking import StackedTrails
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import psf_scale
from glstar.render.scene.transmission import Transmission
from glstar.sky.photometry import USUAL_BV

Stars = slice | NDArray[np.intp]

# Lines of an exposure, at least.
_MIN_PARTS = 16
# Lines that are shorter than this, sigma, are wide Gaussians instead: the difference is below 1e-4.
_SHORT_SIGMA = 0.5
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

    def near(self, point_px: Float, reach_px: Float) -> NDArray[np.intp]:
        """Return which lines are nearer to a point of their star, (m, 2) px, than a distance, (m,) px.

        They are numbers of a table of lines and stars: most lines are too far to matter.
        """
        off_px = point_px.T[:, np.newaxis] - self.middle_px
        reach = self.length_px / 2 + reach_px
        reach *= reach
        is_near = np.einsum("anm,anm->nm", off_px, off_px) < reach
        if self.hidden is not None:
            is_near &= ~self.hidden
        return np.flatnonzero(is_near)

    def signal_at(
        self, point_px: Float, sigma_px: float, transmission: Float | None, near: NDArray[np.intp] | None = None
    ) -> Float:
        """Return the signal of stars with a standard deviation at a point each, over their flux, (m,) 1/px^2.

        `point_px` (m, 2) are positions (x, y); `transmission` (n, m) is what reaches the camera during each line;
        `near`: the lines that matter there, if known.
        """
        if near is None:
            near = self.near(point_px, np.full(len(point_px), _FAR_SIGMA * sigma_px))
        line, star = np.divmod(near, len(point_px))
        length_px = np.maximum(self.length_px.ravel().take(near), 1e-9)
        along_x, along_y = (step.ravel().take(near) / length_px for step in self.step_px)
        off_x, off_y = (
            (at.take(star) - middle.ravel().take(near)) / sigma_px
            for at, middle in zip(point_px.T, self.middle_px, strict=True)
        )
        s = off_x * along_x + off_y * along_y
        across = off_x * along_y - off_y * along_x
        weight = self.duration.take(line) if self.recorded is None else self.recorded.ravel().take(near)
        signal = weight * _density(s, length_px / sigma_px) * np.exp(-0.5 * across * across)
        if transmission is not None:
            signal *= transmission.ravel().take(near)
        summed = np.bincount(star, signal, minlength=len(point_px))
        return np.asarray(summed / (np.sqrt(2 * np.pi) * sigma_px**2))


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


def _density(s: Float, length: Float) -> Float:
    """Return the light per sigma of lines at a distance s from their middles along them; lengths in sigma."""
    density = np.empty_like(s)
    is_short = length < _SHORT_SIGMA
    short, long = np.flatnonzero(is_short), np.flatnonzero(~is_short)
    size = length.take(short)
    variance = 1 + size * size / 12
    off = s.take(short)
    density[short] = np.exp(-0.5 * off * off / variance) / np.sqrt(2 * np.pi * variance)
    size, at = length.take(long), s.take(long)
    density[long] = (normal_cumulative(at + size / 2) - normal_cumulative(at - size / 2)) / size
    return density


def normal_cumulative(z: Float) -> Float:
    """Return the cumulative distribution of the unit Gaussian to 1e-7: Abramowitz & Stegun, 26.2.17."""
    t = 1 / (1 + 0.2316419 * np.abs(z))
    polynomial = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * polynomial
    return np.asarray(np.where(z < 0, tail, 1 - tail))


# Example directions across and down the image.
_GRID = (8, 6)
_SMALLEST_GRID = (3, 2)
# Pairs of lines of all example directions, at most: 20 ms.
_MOST_PAIRS = 8_000_000
# Lines of a path, at most: groups of neighbours if there are more.  `snr` of two seconds of vibration at 37 Hz is 15 %
# too large with 64 straight groups, and 1.5 % off (median) with 400 that have a width; both take the same time.
_MOST_LINES = 400
# Lines of a path along which the signal is evaluated exactly.
_CANDIDATES = 3
# Pairs of lines that are computed at once: more of them fall out of the processor's cache.
_BLOCK = 32_768
# Light that is farther than this, in units of the exponent, does not count; and smaller numbers are slow.
_FAR_EXPONENT = np.float32(-40.0)


@dataclass(frozen=True, slots=True, eq=False)
class BrightestPoints:
    """Points of m trails at which the signal is largest, and the integral of its square."""

    # (k, m, 2) the k points of each trail on the image that promise most light, or the nearest ones to the image, px:
    # middles of lines.
    point_px: Float
    step_px: Float  # (k, m, 2) from the starts to the ends of these lines, px
    # (m,) the integral of the squared signal over the squared flux above the cloud, 1/px^2; of a path that is partly on
    # the image, that over the part on it, divided by this part of the time.
    square_per_px2: Float


def brightest_points(
    scene: Scene,
    direction_eq: Float,
    chains: Sequence[LineChain],
    transmissions: Sequence[Float | None],
) -> BrightestPoints:
    """Return where stars leave most light on the image.

    `direction_eq` (m, 3) are apparent unit vectors, `chains` their paths in each short exposure, and `transmissions`
    what reaches the camera during each line of each chain, (n, m) or None. The square of the signal of a path, summed
    over the image, is the mean along the path of the signal that stars sqrt(2) times as wide would leave: two Gaussians
    overlap like one with the sum of their variances.
    """
    lines = _Lines.of(chains)
    outside_px = scene.camera.distance_outside_px(lines.middle_px.transpose(1, 2, 0))
    on_image = (outside_px <= 0).astype(np.float64)
    signals, overlaps = _interpolated(scene, direction_eq, lines)
    clouded = [transmission for transmission in transmissions if transmission is not None]
    passing = _grouped(_joined(clouded), mean=True) if clouded else np.ones_like(lines.weight)
    nearby = _smoothed(lines, passing, scene.sensor.effective_sigma_px, on_image) if clouded else passing
    light: Float = np.where(lines.weight > 0, signals * nearby, 0.0)
    light = np.where(outside_px > 0, -outside_px, light)
    on_image *= lines.weight
    square = np.einsum("nm,nm,nm,nm->m", on_image, overlaps, passing, nearby)
    square /= np.maximum(on_image.sum(axis=0), 1e-30)
    return BrightestPoints(*_candidates(lines, light), square)


class _Lines(NamedTuple):
    """The lines of several chains one after the other: at most some hundred, or groups of them."""

    middle_px: Float  # (2, n, m) middles (x, y), and vectors from the starts to the ends, px
    step_px: Float
    weight: Float  # (n, m) the fraction of each star's flux
    is_whole: NDArray[np.bool_]  # (m,) bool: which stars are visible all the time
    # (3, n, m) or None: the variance along x, the covariance and the variance along y of the light of groups, px^2.
    spread_px2: Float | None = None

    @classmethod
    def of(cls, chains: Sequence[LineChain]) -> Self:
        """Return the lines of chains."""
        middle_px, step_px = (_joined([getattr(chain, name) for chain in chains]) for name in ("middle_px", "step_px"))
        weight = _joined([chain.weight for chain in chains])
        is_whole = np.all([chain.is_whole for chain in chains], axis=0)
        if len(weight) <= _MOST_LINES:
            return cls(middle_px, step_px, weight, is_whole)
        middles, steps = _grouped(middle_px, mean=True), _grouped(step_px)
        spread_px2 = np.stack(
            [
                _grouped(step_px[i] * step_px[j] / 12 + middle_px[i] * middle_px[j], mean=True)
                - middles[i] * middles[j]
                for i, j in ((0, 0), (0, 1), (1, 1))
            ]
        )
        return cls(middles, steps, _grouped(weight), is_whole, spread_px2)


def _joined(values: list[Float]) -> Float:
    """Return the values of several chains one after the other, without a copy of those of a single one."""
    return values[0] if len(values) == 1 else np.concatenate(values, axis=-2)


def _grouped(values: Float, *, mean: bool = False) -> Float:
    """Return the sums or means of groups of consecutive lines, (..., k, m) of (..., n, m), that are not too many."""
    count = values.shape[-2]
    size = -(-count // _MOST_LINES)
    if size == 1:
        return values
    whole = count - count % size
    sums = values[..., :whole, :].reshape(*values.shape[:-2], count // size, size, values.shape[-1]).sum(axis=-2)
    sizes = np.full(sums.shape[-2], size)
    if whole < count:
        sums = np.concatenate([sums, values[..., whole:, :].sum(axis=-2, keepdims=True)], axis=-2)
        sizes = np.append(sizes, count - whole)
    return np.asarray(sums / sizes[:, np.newaxis] if mean else sums)


def _smoothed(lines: _Lines, passing: Float, sigma_px: float, on_image: Float) -> Float:
    """Return what cloud transmits of the light that arrives at each line from its neighbours, (n, m).

    The neighbours are those of one star, for all.
    """
    if not passing.shape[1]:
        return passing
    star = int(on_image.sum(axis=0).argmax())
    off_px = lines.middle_px[:, :, np.newaxis, star] - lines.middle_px[:, np.newaxis, :, star]
    near = np.exp(np.einsum("aij,aij->ij", off_px, off_px) / (-4 * sigma_px**2))
    near *= np.maximum(lines.weight[:, star], 1e-12)
    return np.asarray((near @ passing) / near.sum(axis=1)[:, np.newaxis])


def _candidates(lines: _Lines, signals: Float) -> tuple[Float, Float]:
    """Return the middles of the lines with the largest signals, and their steps, (k, m, 2) px both."""
    stars, chosen = np.arange(signals.shape[1]), []
    for _ in range(min(_CANDIDATES, len(signals))):
        best = signals.argmax(axis=0)
        chosen.append(best)
        signals[best, stars] = -np.inf
    middle_px, step_px = (
        np.stack([each[:, best, stars].T for best in chosen]) for each in (lines.middle_px, lines.step_px)
    )
    return middle_px, step_px


def _interpolated(scene: Scene, direction_eq: Float, lines: _Lines) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the signal at the middle of each line, and that of stars sqrt(2) times as wide, (n, m) 1/px^2."""
    sigma_px, camera = scene.sensor.effective_sigma_px, scene.camera
    columns, rows = _grid_size(len(lines.weight))
    if len(direction_eq) <= columns * rows:
        return _signals_and_overlaps(lines, sigma_px)
    at_px = np.nan_to_num(camera.project(scene.shutter[1:2].to_camera(direction_eq, below_horizon=True))[0]).T
    size_px = np.array([camera.width_px, camera.height_px])
    low_px, high_px = at_px.min(axis=1).clip(-size_px, 0), at_px.max(axis=1).clip(size_px, 2 * size_px)
    x_px, y_px = (np.linspace(low_px[k], high_px[k], count) for k, count in enumerate((columns, rows)))
    example_px = np.stack(np.meshgrid(x_px, y_px), axis=-1).reshape(-1, 2)
    examples = _Lines.of(list(_chains_through(scene, example_px)))
    near = _bilinear(at_px, x_px, y_px) * examples.is_whole[:, np.newaxis]
    near = near / np.maximum(near.sum(axis=0), 1e-6)
    signals, overlaps = _signals_and_overlaps(examples, sigma_px)
    # In double precision: the rounding of a product depends on how many threads OpenBLAS has, and truth must not.
    return signals.astype(np.float64) @ near, overlaps.astype(np.float64) @ near


def _chains_through(scene: Scene, xy_px: Float) -> Iterator[LineChain]:
    """Yield the chains of directions that are at some positions in the middle of the exposure, (k, 2) px."""
    in_camera = scene.camera.unit_vectors(xy_px)
    in_camera = np.where(np.isnan(in_camera), np.array([0.0, 0.0, -1.0]), in_camera)  # behind it
    return line_chains(scene, in_camera @ scene.shutter.C_camera_eq[1])


def _grid_size(count: int) -> tuple[int, int]:
    """Return the numbers of example directions across and down for paths of `count` lines."""
    scale = min(1.0, sqrt(_MOST_PAIRS / (_GRID[0] * _GRID[1] * count * count)))
    columns, rows = (max(int(most * scale), least) for most, least in zip(_GRID, _SMALLEST_GRID, strict=True))
    return columns, rows


def _bilinear(xy_px: Float, x_px: Float, y_px: Float) -> Float:
    """Return the weights of the nodes of a grid at positions, (nodes, m), row by row; clamped at its border."""
    hats = []
    for at_px, nodes_px in zip(xy_px, (x_px, y_px), strict=True):
        steps = (at_px.clip(nodes_px[0], nodes_px[-1]) - nodes_px[:, np.newaxis]) / (nodes_px[1] - nodes_px[0])
        hats.append((1 - np.abs(steps)).clip(0.0))
    return np.asarray((hats[1][:, np.newaxis] * hats[0]).reshape(-1, xy_px.shape[1]))


def _signals_and_overlaps(lines: _Lines, sigma_px: float) -> tuple[Float32, Float32]:
    """Return the signals of stars and of stars sqrt(2) times as wide at the middles of all lines, (n, m) 1/px^2.

    A line is exact in its own middle, and a Gaussian elsewhere: of its variance for the wide stars, together within
    3 %, and for the others of that which makes their signal the square of the wide one.  Groups of lines are Gaussians
    of twice their variance, because the mean over another group that is alike is sought, not the signal at its middle.
    """
    from_start_px = lines.middle_px - lines.middle_px[:, :1]  # single precision begins here
    in_sigma = (px.T / (sqrt(2) * sigma_px) for px in (*from_start_px, *lines.step_px))
    x, y, step_x, step_y, weight = (np.ascontiguousarray(each, np.float32) for each in (*in_sigma, lines.weight.T))
    length2 = step_x * step_x + step_y * step_y
    if lines.spread_px2 is None:
        xx, xy, yy = (one * other / 12 for one, other in ((step_x, step_x), (step_x, step_y), (step_y, step_y)))
        determinant = 1 + length2 / 12
    else:
        xx, xy, yy = np.ascontiguousarray(lines.spread_px2.swapaxes(1, 2) / sigma_px**2, np.float32)
        determinant = (1 + xx) * (1 + yy) - xy * xy
    # The exponent is a x^2 + b x y + c y^2.
    a, b, c = -0.5 * (1 + yy) / determinant, xy / determinant, -0.5 * (1 + xx) / determinant
    wide, narrow = np.empty_like(weight), np.empty_like(weight)
    height = weight / np.sqrt(determinant)
    per_block = max(1, _BLOCK // x.shape[1] ** 2)
    for first in range(0, len(x), per_block):
        block = slice(first, first + per_block)
        dx, dy = (axis[block, :, np.newaxis] - axis[block, np.newaxis] for axis in (x, y))
        exponent = a[block, np.newaxis] * dx
        exponent += b[block, np.newaxis] * dy
        exponent *= dx
        dy *= dy
        dy *= c[block, np.newaxis]
        exponent += dy
        # Rounding may exceed 0 beside very long lines.
        np.clip(exponent, _FAR_EXPONENT, np.float32(0.0), out=exponent)
        np.exp(exponent, out=exponent)
        # Without OpenBLAS, for the same reason.
        np.einsum("kij,kj->ki", exponent, height[block], out=wide[block])
        exponent *= exponent
        np.einsum("kij,kj->ki", exponent, height[block], out=narrow[block])
    length = np.sqrt(np.maximum(length2, 1e-6))
    for each, scale in ((wide, 1.0), (narrow, sqrt(2))):
        at = scale * length
        if lines.spread_px2 is None:
            each[...] += weight * (sqrt(2 * np.pi) * (2 * normal_cumulative(at / 2) - 1) / at) - height
        each[...] *= scale * scale / (4 * np.pi * sigma_px * sigma_px)
    return narrow.T, wide.T


@dataclass(frozen=True, slots=True)
class TrailPeaks:
    """Expected brightness of m stars."""

    # (m,) signal at the brightest point of a trail on the image, over the flux of the star.
    peak_fraction_per_px2: Float
    # (m,) noise-equivalent area of the trail: the squared flux over the integral of the squared signal; that of a part
    # of the trail is the same part of it.
    area_px2: Float


def trail_peaks(
    scene: Scene,
    direction_eq: Float,
    passage: Transmission | None = None,
    nodes_px: Float | None = None,
    recorded: RecordedTimes | None = None,
    *,
    bv: Float | float = USUAL_BV,
) -> TrailPeaks:
    """Return the expected brightness of trails along the true paths of stars.

    `direction_eq` (m, 3): geocentric apparent unit vectors, true equator and equinox; `passage`: what cloud transmits
    of the stars: the peak is that of the dimmed trail, over the flux above the cloud; `nodes_px` (2, n, m): their
    `ConicPaths.nodes_px`, if these are known; `recorded`: when a rolling shutter records them: fractions are of the
    flux that it records; `bv` (m,) or float: their colours B - V.  The path is a chain of lines, whose light is a
    Gaussian across and a difference of error functions along, for each Gaussian of a star's profile.  It is evaluated
    at the points that `brightest_points` finds.  A Gaussian at rest has the area 4 pi sigma^2, and a long trail of
    length L the area 2 sqrt(pi) sigma L.  Areas of other profiles are larger by a factor for stars at rest and another
    for long trails, between which it is interpolated.
    """
    chains = list(line_chains(scene, direction_eq, nodes_px, recorded))
    transmissions = _transmissions(chains, passage)
    points = brightest_points(scene, direction_eq, chains, transmissions)
    scales = psf_scale(scene, direction_eq, bv)
    profiles = list(_profiles(scene.sensor, scales))
    peak = _largest_signal(scene, points, chains, transmissions, profiles)
    mean = np.ones(1) if passage is None else passage.mean
    dimmed = peak / np.maximum(mean, 1e-30)
    area_px2 = mean * mean / np.maximum(points.square_per_px2, 1e-30)
    # No signal is everywhere larger than its peak; of a path off the image nothing else is known.
    area_px2 = np.where(points.square_per_px2 > 0, area_px2, sqrt(2) / np.maximum(dimmed, 1e-30))
    return TrailPeaks(peak, _area_over_core(scene.sensor, scales, dimmed) * area_px2)


# Where along the lines of candidates the signal is evaluated, from their middles, parts of their length; and then on
# both sides of the best point.
_ALONG = (0.0, -0.25, 0.25, -0.5, 0.5)
_NEARER = (1 / 8, 1 / 16, 1 / 32)


class _Part(NamedTuple):
    """Stars with the same profile in one short exposure."""

    chain: LineChain
    transmission: Float | None
    stars: Stars
    gaussians: list[tuple[float, float, Float]]

    def near(self, middle_px: Float, step_px: Float) -> list[NDArray[np.intp]]:
        """Return the lines that matter along a line of each star of the scene, (m, 2) px, for each Gaussian."""
        middle_px, half_px = middle_px[self.stars], np.linalg.norm(step_px[self.stars], axis=1) / 2
        return [
            self.chain.near(middle_px - offset_px, half_px + _FAR_SIGMA * sigma_px)
            for _, sigma_px, offset_px in self.gaussians
        ]

    def signal_at(self, point_px: Float, near: list[NDArray[np.intp]]) -> Float:
        """Return the signal at a point of each star of the scene, (m, 2) px, of those with this profile."""
        signals = [
            fraction * self.chain.signal_at(point_px[self.stars] - offset_px, sigma_px, self.transmission, lines)
            for (fraction, sigma_px, offset_px), lines in zip(self.gaussians, near, strict=True)
        ]
        return np.asarray(np.sum(signals, axis=0))


class _Search:
    """The largest signals on the image that have been found, and where."""

    def __init__(self, camera: Camera, parts: Sequence[_Part], count: int) -> None:
        self.largest = np.zeros(count)
        self.point_px, self.step_px = np.zeros((count, 2)), np.zeros((count, 2))
        self._parts, self._last_px = parts, np.array([camera.width_px, camera.height_px]) - 0.5

    def along(self, middle_px: Float, step_px: Float, places: Sequence[float]) -> None:
        """Evaluate the signal at places along a line of each star, from its middle, (m, 2) px, parts of its step."""
        near = [part.near(middle_px, step_px) for part in self._parts]
        for place in places:
            point_px, signal = (middle_px + place * step_px).clip(-0.5, self._last_px), np.zeros(len(middle_px))
            for part, lines in zip(self._parts, near, strict=True):
                signal[part.stars] += part.signal_at(point_px, lines)
            is_larger = signal > self.largest
            self.largest = np.where(is_larger, signal, self.largest)
            self.point_px = np.where(is_larger[:, np.newaxis], point_px, self.point_px)
            self.step_px = np.where(is_larger[:, np.newaxis], step_px, self.step_px)


def _largest_signal(
    scene: Scene,
    points: BrightestPoints,
    chains: Sequence[LineChain],
    transmissions: Sequence[Float | None],
    profiles: Sequence[tuple[Stars, list[tuple[float, float, Float]]]],
) -> Float:
    """Return the largest signal of stars along the lines that promise most light, with their profiles, (m,)."""
    parts = [
        _Part(chain[stars], None if transmission is None else transmission[:, stars], stars, gaussians)
        for chain, transmission in zip(chains, transmissions, strict=True)
        for stars, gaussians in profiles
    ]
    search = _Search(scene.camera, parts, points.point_px.shape[1])
    for middle_px, step_px in zip(points.point_px, points.step_px, strict=True):
        search.along(middle_px, step_px, _ALONG)
    for place in _NEARER:
        search.along(search.point_px, search.step_px, (-place, place))
    return search.largest


def _profiles(sensor: Sensor, scales: Float) -> Iterator[tuple[Stars, list[tuple[float, float, Float]]]]:
    """Yield the stars with each profile, and its Gaussians: fraction of the flux, sigma in px, offset (x, y) in px."""
    if sensor.point_spread.is_gaussian:
        yield slice(None), [(1.0, sensor.effective_sigma_px, np.zeros(2))]
        return
    for scale in np.unique(scales).tolist():
        yield (
            np.flatnonzero(scales == scale),
            [
                (one.flux_fraction, sensor.of_component(one).effective_sigma_px, np.array(one.offset_px))
                for one in sensor.point_spread.components(sensor.psf_sigma_px, scale=scale)
            ],
        )


def _area_over_core(sensor: Sensor, scales: Float, peak: Float) -> Float | float:
    """Return the noise-equivalent areas of trails, over those that Gaussians of the width on the axis would leave."""
    if sensor.point_spread.is_gaussian:
        return 1.0
    parts = [
        (one.flux_fraction, sensor.of_component(one).effective_sigma_px ** 2)
        for one in sensor.point_spread.circular(sensor.psf_sigma_px)
    ]
    core_px2 = sensor.effective_sigma_px**2
    at_rest = noise_equivalent_area_px2(sensor) / (4 * np.pi * core_px2)
    overlap = sum(f * g / sqrt(2 * np.pi * (s + t)) for f, s in parts for g, t in parts)
    along_line = 1 / (sqrt(4 * np.pi * core_px2) * overlap)
    rest_per_px2 = sum(fraction / (2 * np.pi * variance) for fraction, variance in parts)
    concentration = np.minimum(peak * scales**2 / rest_per_px2, 1.0)
    return np.asarray((along_line + (at_rest - along_line) * concentration) * scales ** (1 + concentration))


def _transmissions(chains: Sequence[LineChain], passage: Transmission | None) -> list[Float | None]:
    """Return what cloud transmits of the stars during each line of each chain, (n, m); None for all."""
    if passage is None:
        return [None] * len(chains)
    means = passage.means(np.concatenate([chain.duration for chain in chains]))
    return list(np.split(means, np.cumsum([len(chain) for chain in chains])[:-1]))
