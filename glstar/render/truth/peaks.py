"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers.

Paths are chains of straight lines.  What each line receives from the others is summed for each star, over those blocks
of consecutive lines that are near each other.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, sqrt
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Float32
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor, noise_equivalent_area_px2
from glstar.render.readout.rows import RecordedTimes
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import psf_scale
from glstar.render.scene.transmission import Transmission
from glstar.render.truth.linechains import (
    LineChain,
    NearLines,
    SignalOfLines,
    Stars,
    line_chains,
    normal_cumulative,
)
from glstar.sky.photometry import USUAL_BV

# Lines of a path, at most: groups of neighbours if there are more.
_MOST_LINES = 300
# Lines that are together shorter than this, sigma, are one group.
_SHORT_SIGMA = 1.5
# Lines that are longer than this, sigma, are divided, because another part of the path may cross them anywhere.
_LONG_SIGMA = 6.0
# Consecutive lines of a block.
_BLOCK_LINES = 8
# Blocks that are at a larger distance than this, sigma, do not count: 4e-4 of the light of wide stars.
_FAR_SIGMA = 5.0
# Lines of a path along which the signal is evaluated exactly; their separation, sigma; and part of the largest
# signal at the middle of a line that they have.
_CANDIDATES = 3
_SEPARATION_SIGMA = 2.0
_PROMISING = 0.85
# Where no light is, px.
_FAR_PX = 1e7
# Pairs of lines that are computed at once: more of them fall out of the processor's cache.
_PAIRS = 32_768
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
    camera: Camera, sigma_px: float, chains: Sequence[LineChain], transmissions: Sequence[Float | None]
) -> BrightestPoints:
    """Return where stars of a width leave most light on the image.

    `chains` are their paths in each short exposure, and `transmissions` what reaches the camera during each line of
    each chain, (n, m) or None. The square of the signal of a path, summed over the image, is the mean along the path of
    the signal that stars sqrt(2) times as wide would leave: two Gaussians overlap like one with the sum of their
    variances.
    """
    lines = _Lines.of(chains, sigma_px, camera)
    outside_px = camera.distance_outside_px(lines.middle_px.transpose(1, 2, 0))
    on_image = (outside_px <= 0).astype(np.float64)
    signals, overlaps = _signals_and_overlaps(lines, sigma_px, on_image > 0)
    clouded = [transmission for transmission in transmissions if transmission is not None]
    passing = lines.means(_joined(clouded)) if clouded else np.ones_like(lines.weight)
    nearby = _smoothed(lines, passing, sigma_px, on_image) if clouded else passing
    light: Float = np.where(lines.weight > 0, signals * nearby, 0.0)
    light = np.where(outside_px > 0, -outside_px, light)
    on_image *= lines.weight
    square = np.einsum("nm,nm,nm,nm->m", on_image, overlaps, passing, nearby)
    square /= np.maximum(on_image.sum(axis=0), 1e-30)
    return BrightestPoints(*_candidates(lines, light, _SEPARATION_SIGMA * sigma_px), square)


class _Lines(NamedTuple):
    """The lines of several chains one after the other: at most some hundred; groups of them, or parts of long ones."""

    middle_px: Float  # (2, n, m) middles (x, y), and vectors from the starts to the ends, px
    step_px: Float
    weight: Float  # (n, m) the fraction of each star's flux
    # (3, n, m) or None: the variance along x, the covariance and the variance along y of the light of groups, px^2.
    spread_px2: Float | None = None
    first: NDArray[np.intp] | None = None  # The first line of each group
    parts: int = 1  # Or into how many parts they are divided

    @classmethod
    def of(cls, chains: Sequence[LineChain], sigma_px: float, camera: Camera) -> Self:
        """Return the lines of chains, for stars of a width."""
        # Far outside, the polynomial of a lens may be anywhere.
        middle_px, step_px = (
            _joined([getattr(chain, name) for chain in chains]).clip(-_FAR_PX, _FAR_PX)
            for name in ("middle_px", "step_px")
        )
        weight, length_px = (_joined([getattr(chain, name) for chain in chains]) for name in ("weight", "length_px"))
        count = len(weight)
        on_image = length_px[camera.contains(np.moveaxis(middle_px, 0, -1))]
        usual_px, longest_px = (on_image.mean(), np.quantile(on_image, 0.95)) if on_image.size else (1.0, 1.0)
        group = max(-(-count // _MOST_LINES), min(int(_SHORT_SIGMA * sigma_px / max(usual_px, 1e-9)), count // 8))
        if group <= 1:
            parts = max(1, min(ceil(longest_px / (_LONG_SIGMA * sigma_px)), _MOST_LINES // count))
            along = np.tile((np.arange(parts) + 0.5) / parts - 0.5, count)[:, np.newaxis]
            middle_px, step_px, weight = (np.repeat(each, parts, axis=-2) for each in (middle_px, step_px, weight))
            return cls(middle_px + along * step_px, step_px / parts, weight / parts, parts=parts)
        # Groups of the lines of one chain: to the next one is a gap.
        first = np.concatenate([np.arange(*ends, group) for ends in pairwise(np.cumsum([0, *map(len, chains)]))])
        light, steps = np.maximum(weight, 1e-12), _grouped(step_px, first)
        total = _grouped(light, first)
        middles = _grouped(light * middle_px, first) / total
        spread_px2 = np.stack(
            [
                _grouped(light * (step_px[i] * step_px[j] / 12 + middle_px[i] * middle_px[j]), first) / total
                - middles[i] * middles[j]
                for i, j in ((0, 0), (0, 1), (1, 1))
            ]
        )
        return cls(middles, steps, _grouped(weight, first), spread_px2, first)

    def means(self, values: Float) -> Float:
        """Return the means of values of the lines of the chains, (..., n, m)."""
        return np.repeat(values if self.first is None else _grouped(values, self.first, mean=True), self.parts, axis=-2)


def _joined(values: list[Float]) -> Float:
    """Return the values of several chains one after the other; a single chain is not copied."""
    return values[0] if len(values) == 1 else np.concatenate(values, axis=-2)


def _grouped(values: Float, first: NDArray[np.intp], *, mean: bool = False) -> Float:
    """Return the sums or means of groups of consecutive lines, (..., k, m) of (..., n, m), given their first lines."""
    sums = np.add.reduceat(values, first, axis=-2)
    return sums / np.diff(first, append=values.shape[-2])[:, np.newaxis] if mean else np.asarray(sums)


def _smoothed(lines: _Lines, passing: Float, sigma_px: float, on_image: Float) -> Float:
    """Return what cloud transmits of the light that arrives at each line from its neighbours, (n, m).

    The neighbours of one star serve for all.
    """
    if not passing.shape[1]:
        return passing
    star = int(on_image.sum(axis=0).argmax())
    off_px = lines.middle_px[:, :, np.newaxis, star] - lines.middle_px[:, np.newaxis, :, star]
    near = np.exp(np.einsum("aij,aij->ij", off_px, off_px) / (-4 * sigma_px**2))
    near *= np.maximum(lines.weight[:, star], 1e-12)
    return np.asarray((near @ passing) / near.sum(axis=1)[:, np.newaxis])


def _candidates(lines: _Lines, signals: Float, separation_px: float) -> tuple[Float, Float]:
    """Return the middles of the lines with the largest signals, and their steps, (k, m, 2) px both.

    They are separate; those that promise little are infinitely far away.
    """
    stars = np.arange(signals.shape[1])
    chosen: list[tuple[Float, Float]] = []
    largest = signals.max(axis=0)
    for _ in range(_CANDIDATES):
        best = signals.argmax(axis=0)
        middle_px, step_px = (each[:, best, stars].T for each in (lines.middle_px, lines.step_px))
        is_promising = signals[best, stars] > _PROMISING * largest if chosen else np.ones(len(stars), np.bool_)
        if not is_promising.any():
            break
        chosen.append((np.where(is_promising[:, np.newaxis], middle_px, _FAR_PX), step_px))
        near = np.square(lines.middle_px - middle_px.T[:, np.newaxis]).sum(axis=0) < separation_px * separation_px
        signals[near] = -np.inf
    middles_px, steps_px = zip(*chosen, strict=True)
    return np.stack(middles_px), np.stack(steps_px)


def _signals_and_overlaps(lines: _Lines, sigma_px: float, on_image: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Return the signals of stars and of stars sqrt(2) times as wide at the middles of all lines, (n, m) 1/px^2.

    `on_image` (n, m): of which lines they are needed; of others they may be too small.

    A line is exact in its own middle, and a Gaussian elsewhere: of its variance for the wide stars, together within
    3 %, and for the others of that which makes their signal the square of the wide one.  Groups of lines are Gaussians
    of twice their variance, because the mean over another group that is alike is sought, not the signal at its middle.
    """
    blocks = _Blocks.of(lines, sigma_px, on_image)
    wide, narrow = blocks.sums()
    length2 = np.square(lines.step_px / (sqrt(2) * sigma_px)).sum(axis=0).astype(np.float32)
    own = lines.weight / np.sqrt(blocks.determinant)
    length = np.sqrt(np.maximum(length2, 1e-6))
    for signal, scale in ((wide, 1.0), (narrow, sqrt(2))):
        at = scale * length
        if lines.spread_px2 is None:
            signal[...] += lines.weight * (sqrt(2 * np.pi) * (2 * normal_cumulative(at / 2) - 1) / at) - own
        signal[...] *= scale * scale / (4 * np.pi * sigma_px * sigma_px)
    return narrow, wide


class _Blocks(NamedTuple):
    """Blocks of consecutive lines of stars, as Gaussians: k blocks of some lines each; lengths in sqrt(2) sigma."""

    at: Float32  # (k, 2, size) middles
    # (k, 4, size) coefficients of x^2, x y and y^2 in the exponents, and the heights
    gaussians: Float32
    bounds: tuple[Float32, Float32]  # (2, m, blocks) smallest and largest x and y
    is_needed: NDArray[np.bool_]  # (m, blocks)
    determinant: Float32  # (n, m)

    @classmethod
    def of(cls, lines: _Lines, sigma_px: float, on_image: NDArray[np.bool_]) -> Self:
        """Return the blocks of lines."""
        from_start_px = lines.middle_px - lines.middle_px[:, :1]  # single precision begins here
        (x, y), (step_x, step_y) = (
            (px / (sqrt(2) * sigma_px)).astype(np.float32) for px in (from_start_px, lines.step_px)
        )
        if lines.spread_px2 is None:
            xx, xy, yy = (one * other / 12 for one, other in ((step_x, step_x), (step_x, step_y), (step_y, step_y)))
            determinant = 1 + xx + yy
        else:
            xx, xy, yy = lines.spread_px2 / sigma_px**2
            determinant = np.maximum((1 + xx) * (1 + yy) - xy * xy, 1.0).astype(np.float32)
            xx, xy, yy = (each.astype(np.float32) for each in (xx, xy, yy))
        height = lines.weight.astype(np.float32) / np.sqrt(determinant)
        size = len(x) if len(x) <= 4 * _BLOCK_LINES else _BLOCK_LINES
        half = np.sqrt(3 * np.maximum(np.stack([xx, yy]), 0.0))
        low, high = (_in_blocks(each, size) for each in (np.stack([x, y]) - half, np.stack([x, y]) + half))
        a, b, c = -0.5 * (1 + yy) / determinant, xy / determinant, -0.5 * (1 + xx) / determinant
        at = np.stack([_in_blocks(each, size) for each in (x, y)], axis=2).reshape(-1, 2, size)
        padded = [_in_blocks(each, size, repeat=each is not height) for each in (a, b, c, height)]
        gaussians = np.stack(padded, axis=2).reshape(-1, 4, size)
        is_needed = np.asarray(_in_blocks(on_image, size).any(axis=-1))
        return cls(at, gaussians, (low.min(axis=-1), high.max(axis=-1)), is_needed, determinant)

    def sums(self) -> tuple[Float32, Float32]:
        """Return the sums of Gaussians, and of their squares over their heights, at each middle, (n, m) both."""
        stars, count = self.is_needed.shape
        size = self.at.shape[2]
        both, at_once = np.zeros((len(self.at), 2, size), np.float32), max(1, _PAIRS // size**2)
        for target, source in self._near(max(1, 8 * _PAIRS // count**2)):
            for first in range(0, len(target), at_once):
                to, of = target[first : first + at_once], source[first : first + at_once]
                # The pairs of blocks are the last axis: loops over a few lines are slow.
                (to_x, to_y), (of_x, of_y), (a, b, c, height) = (
                    np.ascontiguousarray(np.moveaxis(each.take(blocks, axis=0), 0, -1))
                    for each, blocks in ((self.at, to), (self.at, of), (self.gaussians, of))
                )
                dx, dy = to_x[:, np.newaxis] - of_x, to_y[:, np.newaxis] - of_y
                exponent = a * dx
                exponent += b * dy
                exponent *= dx
                dy *= dy
                dy *= c
                exponent += dy
                # Rounding may exceed 0 beside very long lines.
                np.clip(exponent, _FAR_EXPONENT, np.float32(0.0), out=exponent)
                np.exp(exponent, out=exponent)
                sums = np.empty((2, size, len(to)), np.float32)
                for total in sums:
                    # Without OpenBLAS, whose rounding depends on how many threads it has.
                    np.multiply(exponent, height, out=dx).sum(axis=1, out=total)
                    exponent *= exponent
                begins = np.flatnonzero(np.diff(to, prepend=-1))
                both[to[begins]] += np.add.reduceat(np.ascontiguousarray(np.moveaxis(sums, -1, 0)), begins, axis=0)
        lines = len(self.determinant)
        wide, narrow = (np.ascontiguousarray(both[:, kind].reshape(stars, -1)[:, :lines].T) for kind in (0, 1))
        return wide, narrow

    def _near(self, stars_at_once: int) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Yield the rows of blocks that need light, and of blocks near them, (p,) both, some stars at a time."""
        count = self.is_needed.shape[1]
        for first in range(0, len(self.is_needed), stars_at_once):
            stars = slice(first, first + stars_at_once)
            is_near = np.repeat(self.is_needed[stars, :, np.newaxis], count, axis=2)
            for low, high in zip(*(bound[:, stars] for bound in self.bounds), strict=True):
                is_reached = low[:, :, np.newaxis] < high[:, np.newaxis] + np.float32(_FAR_SIGMA / sqrt(2))
                is_near &= is_reached
                is_near &= is_reached.swapaxes(1, 2)
            star, target, source = is_near.nonzero()
            star += first
            star *= count
            yield star + target, star + source


def _in_blocks(values: NDArray[Any], size: int, *, repeat: bool = True) -> NDArray[Any]:
    """Return values of lines, (..., n, m), by star and by block, (..., m, blocks, size); a last block is filled."""
    values = np.moveaxis(values, -2, -1)
    missing = -values.shape[-1] % size
    if missing:
        rest = np.repeat(values[..., -1:], missing, axis=-1) if repeat else np.zeros((*values.shape[:-1], missing))
        values = np.concatenate([values, rest.astype(values.dtype)], axis=-1)
    return np.ascontiguousarray(values).reshape(*values.shape[:-1], -1, size)


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
    if not len(direction_eq):
        return TrailPeaks(np.zeros(0), np.zeros(0))
    chains = list(line_chains(scene, direction_eq, nodes_px, recorded))
    transmissions = _transmissions(chains, passage)
    points = brightest_points(scene.camera, scene.sensor.effective_sigma_px, chains, transmissions)
    scales = psf_scale(scene, direction_eq, bv)
    profiles = list(_profiles(scene.sensor, scales))
    peak = _largest_signal(scene, points, chains, transmissions, profiles)
    mean = np.ones(1) if passage is None else passage.mean
    dimmed = peak / np.maximum(mean, 1e-30)
    area_px2 = mean * mean / np.maximum(points.square_per_px2, 1e-30)
    # No signal is everywhere larger than its peak; of a path off the image nothing else is known.
    area_px2 = np.where(points.square_per_px2 > 0, area_px2, sqrt(2) / np.maximum(dimmed, 1e-30))
    return TrailPeaks(peak, _area_over_core(scene.sensor, scales, dimmed) * area_px2)


# Where along the lines of candidates the signal is evaluated, from their middles, parts of their length; and then how
# far around the best point, sigma.
_ALONG = (0.0, -0.25, 0.25, -0.5, 0.5)
_AROUND_SIGMA = (0.6, 0.3)


class _Part(NamedTuple):
    """Stars with the same profile in one short exposure."""

    chain: LineChain
    transmission: Float | None
    stars: Stars
    gaussians: list[tuple[float, float, Float]]

    def near(self, point_px: Float, reach_px: Float) -> list[SignalOfLines]:
        """Return for each Gaussian the lines that matter near a point of each star of the scene, (m, 2) and (m,) px."""
        point_px, reach_px = point_px[self.stars], reach_px[self.stars]
        return [
            NearLines.of(self.chain, point_px - offset_px, reach_px, sigma_px, self.transmission).signal
            for _, sigma_px, offset_px in self.gaussians
        ]

    def signal_at(self, point_px: Float, near: list[SignalOfLines]) -> Float:
        """Return the signal at a point of each star of the scene, (m, 2) px, of those with this profile."""
        signals = [
            fraction * lines.at(point_px[self.stars] - offset_px)
            for (fraction, _, offset_px), lines in zip(self.gaussians, near, strict=True)
        ]
        return signals[0] if len(signals) == 1 else np.asarray(np.sum(signals, axis=0))


class _Search:
    """The largest signals on the image that have been found, and where."""

    def __init__(self, camera: Camera, sigma_px: float, parts: Sequence[_Part], count: int) -> None:
        self.largest, self.point_px = np.zeros(count), np.zeros((count, 2))
        self._last_px = np.array([camera.width_px, camera.height_px]) - 0.5
        self._parts, self._sigma_px = parts, sigma_px

    def along(self, middle_px: Float, step_px: Float) -> None:
        """Evaluate the signal along a line of each star, given its middle, (m, 2) px, and its step."""
        near = self._near(middle_px, np.linalg.norm(step_px, axis=1) / 2)
        for place in _ALONG:
            self._signal_at(middle_px + place * step_px, near)

    def around(self) -> None:
        """Evaluate the signal around the best points: a paraboloid through its logarithms has its peak elsewhere."""
        near = self._near(self.point_px, np.full(len(self.largest), 3 * _AROUND_SIGMA[0] * self._sigma_px))
        for step_sigma in _AROUND_SIGMA:
            step_px, at_px = step_sigma * self._sigma_px, self.point_px.copy()

            def log_at(x: float, y: float, step_px: float = step_px, at_px: Float = at_px) -> Float:
                signal = self._signal_at(at_px + step_px * np.array([x, y]), near)
                return np.asarray(np.log(np.maximum(signal, 1e-30)))

            middle, left, right, above, below, beside = (
                log_at(*to) for to in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (1, 1))
            )
            slope = np.stack([right - left, below - above], axis=-1) / 2
            xx, yy, xy = left + right - 2 * middle, above + below - 2 * middle, beside - right - below + middle
            determinant = xx * yy - xy * xy
            is_peak = (xx < 0) & (determinant > 1e-9)
            towards = np.stack([xy * slope[:, 1] - yy * slope[:, 0], xy * slope[:, 0] - xx * slope[:, 1]], axis=-1)
            towards = np.where(
                is_peak[:, np.newaxis], towards / np.where(is_peak, determinant, 1.0)[:, np.newaxis], slope
            )
            length = np.linalg.norm(towards, axis=-1, keepdims=True)
            self._signal_at(at_px + step_px * towards * np.minimum(1.0, 2.0 / np.maximum(length, 1e-9)), near)

    def _near(self, point_px: Float, reach_px: Float) -> list[list[SignalOfLines]]:
        return [part.near(point_px, reach_px) for part in self._parts]

    def _signal_at(self, point_px: Float, near: list[list[SignalOfLines]]) -> Float:
        """Return the signal at a point of each star, (m, 2) px, or the nearest one of the image; keep the largest."""
        point_px = point_px.clip(-0.5, self._last_px)
        signal = np.zeros(len(point_px))
        for part, lines in zip(self._parts, near, strict=True):
            signal[part.stars] += part.signal_at(point_px, lines)
        is_larger = signal > self.largest
        np.copyto(self.largest, signal, where=is_larger)
        np.copyto(self.point_px, point_px, where=is_larger[:, np.newaxis])
        return signal


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
    largest = np.zeros(points.point_px.shape[1])
    for middle_px, step_px in zip(points.point_px, points.step_px, strict=True):
        search = _Search(scene.camera, scene.sensor.effective_sigma_px, parts, len(largest))
        search.along(middle_px, step_px)
        search.around()
        np.maximum(largest, search.largest, out=largest)
    return largest


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
