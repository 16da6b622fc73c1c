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

    def around(self, middle_px: Float, half_px: Float) -> list[NearLines]:
        """Return for each Gaussian the lines that matter along any of k lines of each star, (k, m, 2) and (k, m) px."""
        middle_px, half_px = middle_px[:, self.stars], half_px[:, self.stars]
        centre_px = (middle_px.min(axis=0) + middle_px.max(axis=0)) / 2
        # The search goes on from a point of one of the lines, by less than half of it.
        reach_px = (np.linalg.norm(middle_px - centre_px, axis=-1) + 2 * half_px).max(axis=0)
        return [
            NearLines.of(self.chain, centre_px - offset_px, reach_px, sigma_px, self.transmission)
            for _, sigma_px, offset_px in self.gaussians
        ]

    def near(self, around: list[NearLines], middle_px: Float, half_px: Float) -> list[SignalOfLines]:
        """Return those of lines that matter along a line of each star of the scene, (m, 2) and (m,) px."""
        middle_px, half_px = middle_px[self.stars], half_px[self.stars]
        return [
            lines.nearer(middle_px - offset_px, half_px)
            for lines, (_, _, offset_px) in zip(around, self.gaussians, strict=True)
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

    def __init__(self, camera: Camera, parts: Sequence[_Part], points: BrightestPoints) -> None:
        count = points.point_px.shape[1]
        self.largest = np.zeros(count)
        self.point_px, self.step_px = np.zeros((count, 2)), np.zeros((count, 2))
        self._last_px = np.array([camera.width_px, camera.height_px]) - 0.5
        half_px = np.linalg.norm(points.step_px, axis=-1) / 2
        self._parts = [(part, part.around(points.point_px, half_px)) for part in parts]

    def along(self, middle_px: Float, step_px: Float, places: Sequence[float]) -> None:
        """Evaluate the signal at places along a line of each star, from its middle, (m, 2) px, parts of its step."""
        half_px = np.linalg.norm(step_px, axis=1) / 2
        near = [(part, part.near(around, middle_px, half_px)) for part, around in self._parts]
        for place in places:
            point_px, signal = (middle_px + place * step_px).clip(-0.5, self._last_px), np.zeros(len(middle_px))
            for part, lines in near:
                signal[part.stars] += part.signal_at(point_px, lines)
            is_larger = signal > self.largest
            np.copyto(self.largest, signal, where=is_larger)
            np.copyto(self.point_px, point_px, where=is_larger[:, np.newaxis])
            np.copyto(self.step_px, step_px, where=is_larger[:, np.newaxis])


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
    search = _Search(scene.camera, parts, points)
    for middle_px, step_px in zip(points.point_px, points.step_px, strict=True):
        search.along(middle_px, step_px, _ALONG)
    for place in _NEARER:
        search.along(search.point_px.copy(), search.step_px.copy(), (-place, place))
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
