"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers.

Paths are chains of straight lines.  What each line receives from the others is summed for each star; around the lines
that receive most, the signal is computed exactly.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, exp, pi, sqrt
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Float32
from glstar.camera.model import Camera
from glstar.camera.sensor.pointspread import PsfComponent
from glstar.camera.sensor.sensor import (
    PIXEL_PART_VARIANCE_PX2,
    PIXEL_PLACES_PX,
    PIXEL_WEIGHTS,
    Sensor,
    noise_equivalent_area_px2,
)
from glstar.render.readout.rows import RecordedTimes
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import psf_scale
from glstar.render.scene.transmission import Transmission
from glstar.render.truth.lightsums import FAR_SIGMA, Gaussians, light_sums
from glstar.render.truth.linechains import (
    LineChain,
    NearLines,
    Stars,
    line_chains,
    normal_from_middle,
    square_distance_px2,
)
from glstar.sky.photometry import USUAL_BV

# Lines of a path, at most: groups of neighbours if there are more; and as far as lines are divided.
_MOST_LINES = 600
_MOST_DIVIDED = 300
# Lines that are together shorter than this, sigma, are one group.
_SHORT_SIGMA = 1.5
# Lines that are longer than this, sigma, are divided, because another part of the path may cross them anywhere.
_LONG_SIGMA = 4.0
# Lines of a path along which the signal is evaluated exactly; their separation, sigma; and part of the largest
# signal at the middle of a line that they have.
_CANDIDATES = 3
_SEPARATION_SIGMA = 2.0
_PROMISING = 0.85
# If a smaller part of a trail than this is on the image, the part of its light there is not known.
_LEAST_SHARE = 1e-6
# Where no light is, px.
_FAR_PX = 1e7


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
    on_image, lit = _parts_on_image(lines, camera, outside_px, sigma_px / sqrt(2))
    signals, overlaps = _signals_and_overlaps(lines, sigma_px, outside_px < FAR_SIGMA * sigma_px)
    clouded = [transmission for transmission in transmissions if transmission is not None]
    passing = lines.means(_joined(clouded)) if clouded else np.ones_like(lines.weight)
    nearby = _smoothed(lines, passing, sigma_px, on_image) if clouded else passing
    # Of lines beside the image, what arrives at its border.
    light: Float = np.where(lines.weight > 0, signals * nearby, 0.0)
    beside = (outside_px > 0).nonzero()
    sigmas = outside_px[beside] / sigma_px
    light[beside] = np.where(sigmas < FAR_SIGMA, light[beside] * np.exp(-0.5 * sigmas * sigmas), -sigmas)
    lit *= lines.weight
    square = np.einsum("nm,nm,nm,nm->m", lit, overlaps, passing, nearby)
    share = np.einsum("nm,nm->m", on_image, lines.weight)
    square = np.where(share > _LEAST_SHARE, square / np.maximum(share, _LEAST_SHARE), 0.0)
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
            parts = max(1, min(ceil(longest_px / (_LONG_SIGMA * sigma_px)), _MOST_DIVIDED // count))
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


def _parts_on_image(lines: _Lines, camera: Camera, outside_px: Float, sigma_px: float) -> tuple[Float, Float]:
    """Return which parts of lines are on the image, and which parts of the light of a width along them, (n, m) both.

    `outside_px` (n, m): `Camera.distance_outside_px` of their middles.
    """
    on_image = (outside_px <= 0).astype(np.float64)
    lit = on_image.copy()
    half_px = np.sqrt(np.square(lines.step_px).sum(axis=0)) / 2
    across = (np.abs(outside_px) < half_px + 4 * sigma_px).nonzero()
    middle_px, half_step_px = lines.middle_px[:, *across].T, lines.step_px[:, *across].T / 2
    # Inwards from the border to both ends; a line that is along it has two equal ends.
    first, last = (-camera.distance_outside_px(at) for at in (middle_px - half_step_px, middle_px + half_step_px))
    low, high = np.minimum(first, last) - 0.01 * sigma_px, np.maximum(first, last) + 0.01 * sigma_px
    on_image[across] = (high / (high - low)).clip(0.0, 1.0)
    integrals = []
    for end in (high, low):
        z = (end / sigma_px).astype(np.float32)
        integrals.append(z * (normal_from_middle(z) + 0.5) + np.exp(-0.5 * z * z) / sqrt(2 * pi))
    lit[across] = ((integrals[0] - integrals[1]) * sigma_px / (high - low)).clip(0.0, 1.0)
    return on_image, lit


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
        near = square_distance_px2(lines.middle_px, *middle_px.T) < separation_px * separation_px
        signals[near.nonzero()] = -np.inf  # for few of many, faster than by the mask
    middles_px, steps_px = zip(*chosen, strict=True)
    return np.stack(middles_px), np.stack(steps_px)


def _signals_and_overlaps(lines: _Lines, sigma_px: float, is_needed: NDArray[np.bool_]) -> tuple[Float32, Float32]:
    """Return the signals of stars and of stars sqrt(2) times as wide at the middles of all lines, (n, m) 1/px^2.

    `is_needed` (n, m): of which lines; those of others may be too small.

    A line is exact in its own middle, and a Gaussian elsewhere: of its variance for the wide stars, together within
    3 %, and for the others of that which makes their signal the square of the wide one.  Groups of lines are Gaussians
    of twice their variance, because the mean over another group that is alike is sought, not the signal at its middle.
    """
    x, y = (lines.middle_px - lines.middle_px[:, :1]) / (sqrt(2) * sigma_px)  # single precision begins here
    step_x, step_y = step = (lines.step_px / (sqrt(2) * sigma_px)).astype(np.float32)
    if lines.spread_px2 is None:
        xx, xy, yy = (one * other / 12 for one, other in ((step_x, step_x), (step_x, step_y), (step_y, step_y)))
        determinant = 1 + xx + yy
    else:
        xx, xy, yy = lines.spread_px2 / sigma_px**2
        determinant = np.maximum((1 + xx) * (1 + yy) - xy * xy, 1.0)
    own = lines.weight / np.sqrt(determinant)
    values = x, y, -0.5 * (1 + yy) / determinant, xy / determinant, -0.5 * (1 + xx) / determinant, own
    half = np.sqrt(3 * np.maximum(np.stack([xx, yy]), 0.0)).astype(np.float32)
    wide, narrow = light_sums(Gaussians(*(each.astype(np.float32) for each in values)), half, is_needed)
    length2 = np.square(step).sum(axis=0)
    length = np.sqrt(np.maximum(length2, 1e-6))
    for signal, scale in ((wide, 1.0), (narrow, sqrt(2))):
        at = scale * length
        if lines.spread_px2 is None:
            signal[...] += lines.weight * (sqrt(2 * np.pi) * 2 * normal_from_middle(at / 2) / at) - own
        signal[...] *= scale * scale / (4 * np.pi * sigma_px * sigma_px)
    return narrow, wide


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
    Gaussian across and a difference of error functions along, for each Gaussian of a star's profile as pixels record
    it.  It is evaluated at the points that `brightest_points` finds.  A Gaussian at rest has the area 4 pi sigma^2,
    and a long trail of length L the area 2 sqrt(pi) sigma L.  Areas of other profiles are larger by a factor for
    stars at rest and another for long trails, between which it is interpolated.
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


# Where along the lines of candidates the signal is evaluated, from their middles, parts of their length; then around
# the best place, at these steps, (2, 5), and of these lengths, sigma.
_ALONG = np.array([0.0, -0.25, 0.25, -0.5, 0.5])[:, np.newaxis]
_AROUND = np.array([[-1, 1, 0, 0, 1], [0, 0, -1, 1, 1]])[..., np.newaxis]
_AROUND_SIGMA = (0.6, 0.3)
# It is not evaluated around places with a smaller part than this of the signal of a star's best place, nor where it
# is the same along the line, largest over smallest, and on both of its sides, logarithm of the ratio: gains of 0.1 %.
_WORTHWHILE = 0.9
_EVEN = 1.003
_SYMMETRIC = 0.05


class _Part(NamedTuple):
    """Stars with the same profile in one short exposure."""

    chain: LineChain
    transmission: Float | None
    stars: Stars
    gaussians: list[tuple[float, float, Float]]

    def near(self, point_px: Float, reach_px: Float) -> Iterator[NearLines]:
        """Yield the lines near a point of each star of the scene, (m, 2) and (m,) px."""
        point_px, reach_px = point_px[self.stars], reach_px[self.stars]
        for fraction, sigma_px, offset_px in self.gaussians:
            passing = fraction if self.transmission is None else fraction * self.transmission
            yield from NearLines.of(self.chain, self.stars, point_px - offset_px, reach_px, sigma_px, passing)


class _Search:
    """The largest signals on the image near a line of each of m stars.

    Attributes
    ----------
    largest : (m,) array
    may_gain : (m,) bool array
        Whether the signal differs along the line or on its sides, so that it may be larger beside the best place.
    """

    def __init__(self, sigma_px: float, near: Sequence[NearLines], limits_px: Sequence[Float]) -> None:
        self.largest, self._best_px = np.zeros(limits_px[0].shape[-1]), np.zeros_like(limits_px[0])
        self._sigma_px, self._near, self._limits_px = sigma_px, near, limits_px
        self.may_gain = np.ones(len(self.largest), np.bool_)

    @classmethod
    def along(cls, camera: Camera, sigma_px: float, parts: Sequence[_Part], middle_px: Float, step_px: Float) -> Self:
        """Search along lines, given their middles, (m, 2) px, and vectors from their starts to their ends."""
        length_px = np.maximum(np.linalg.norm(step_px, axis=1), 1e-9)
        along = step_px / length_px[:, np.newaxis]
        along[length_px <= 1e-9] = 1.0, 0.0
        length_px = np.maximum(length_px, _AROUND_SIGMA[0] * sigma_px)
        reach_px = length_px / 2 + 3 * _AROUND_SIGMA[0] * sigma_px
        near = [lines for part in parts for lines in part.near(middle_px, reach_px)]
        size_px = np.array([camera.width_px, camera.height_px])
        search = cls(sigma_px, near, [(edge - middle_px).T[:, np.newaxis] for edge in (-0.5, size_px - 0.5)])
        (x, y), side_px = along.T, _AROUND_SIGMA[0] * sigma_px
        along_px = np.array([x, y])[:, np.newaxis] * (length_px * _ALONG)
        beside_px = np.array([-y, x])[:, np.newaxis] * (side_px * np.array([[-1.0], [1.0]]))
        signal = np.maximum(search._signal_at(np.concatenate([along_px, beside_px], axis=1)), 1e-30)
        on_line, (left, right) = signal[: len(_ALONG)], signal[len(_ALONG) :]
        search.may_gain = (on_line.max(axis=0) > _EVEN * on_line.min(axis=0)) | (
            np.abs(np.log(left / right)) > _SYMMETRIC
        )
        return search

    def of(self, stars: NDArray[np.bool_]) -> "_Search":
        """Return the search of some stars."""
        near = [lines.of_points(stars) for lines in self._near]
        search = _Search(self._sigma_px, near, [px[..., stars] for px in self._limits_px])
        search.largest, search._best_px = self.largest[stars], self._best_px[..., stars]
        return search

    def around(self) -> None:
        """Evaluate the signal around the best places: a paraboloid through its logarithms has its peak elsewhere."""
        for step_sigma in _AROUND_SIGMA:
            step_px, at_px = step_sigma * self._sigma_px, self._best_px.copy()
            middle = np.log(np.maximum(self.largest, 1e-30))
            signal = self._signal_at(at_px + step_px * _AROUND)
            left, right, above, below, beside = np.log(np.maximum(signal, 1e-30))
            slope_x, slope_y = (right - left) / 2, (below - above) / 2
            xx, yy, xy = left + right - 2 * middle, above + below - 2 * middle, beside - right - below + middle
            determinant = xx * yy - xy * xy
            is_peak = (xx < 0) & (determinant > 1e-9)
            scale = np.where(is_peak, determinant, 1.0)
            towards = np.stack(
                [
                    np.where(is_peak, (xy * slope_y - yy * slope_x) / scale, slope_x),
                    np.where(is_peak, (xy * slope_x - xx * slope_y) / scale, slope_y),
                ]
            )
            length = np.sqrt(np.square(towards).sum(axis=0))
            towards *= step_px * np.minimum(1.0, 2.0 / np.maximum(length, 1e-9))
            self._signal_at(at_px + towards[:, np.newaxis])

    def _signal_at(self, place_px: Float) -> Float:
        """Return the signal at places, (2, k, m) px, or the nearest ones of the image, (k, m); keep the largest."""
        x_px, y_px = place_px = place_px.clip(*self._limits_px)
        signal = np.zeros(x_px.shape)
        for lines in self._near:
            signal += lines.signal(x_px, y_px)
        best, star = signal.argmax(axis=0), np.arange(len(self.largest))
        is_larger = signal[best, star] > self.largest
        best, star = best[is_larger], star[is_larger]
        self.largest[star] = signal[best, star]
        self._best_px[:, 0, star] = place_px[:, best, star]
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
    searches = [
        _Search.along(scene.camera, scene.sensor.effective_sigma_px, parts, middle_px, step_px)
        for middle_px, step_px in zip(points.point_px, points.step_px, strict=True)
    ]
    largest: Float = np.max([search.largest for search in searches], axis=0)
    promising = _WORTHWHILE * largest
    for search in searches:
        is_worthwhile = search.may_gain & (search.largest > promising)
        refined = search.of(is_worthwhile)
        refined.around()
        largest[is_worthwhile] = np.maximum(largest[is_worthwhile], refined.largest)
    return largest


# Pixels integrate Gaussians narrower than this, px: a wider one differs from one widened by their variance by 0.3 %.
_NARROW_PX = 0.9


def _profiles(sensor: Sensor, scales: Float) -> Iterator[tuple[Stars, list[tuple[float, float, Float]]]]:
    """Yield the stars with each profile, and its Gaussians: fraction of the flux, sigma in px, offset (x, y) in px."""
    for scale in np.unique(scales).tolist():
        components = sensor.point_spread.components(sensor.psf_sigma_px, scale=scale)
        stars = slice(None) if sensor.point_spread.is_gaussian else np.flatnonzero(scales == scale)
        yield stars, [part for one in components for part in _recorded(sensor, one)]


def _recorded(sensor: Sensor, component: PsfComponent) -> list[tuple[float, float, Float]]:
    """Return a Gaussian of a star as pixels record it: fractions of the flux, sigma in px, offsets (x, y) in px."""
    alone, offset_px = sensor.of_component(component), np.array(component.offset_px)
    if not alone.needs_erf or component.sigma_px > _NARROW_PX:
        return [(component.flux_fraction, alone.effective_sigma_px, offset_px)]
    sigma_px = sqrt(component.sigma_px**2 + PIXEL_PART_VARIANCE_PX2)
    return [
        (component.flux_fraction * across * down, sigma_px, offset_px + np.array([x_px, y_px]))
        for x_px, across in zip(PIXEL_PLACES_PX, PIXEL_WEIGHTS, strict=True)
        for y_px, down in zip(PIXEL_PLACES_PX, PIXEL_WEIGHTS, strict=True)
    ]


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
    rest_per_px2 = sum(
        fraction * exp(-0.5 * (off_px @ off_px) / sigma_px**2) / (2 * pi * sigma_px**2)
        for one in sensor.point_spread.circular(sensor.psf_sigma_px)
        for fraction, sigma_px, off_px in _recorded(sensor, one)
    )
    concentration = np.minimum(peak * scales**2 / rest_per_px2, 1.0)
    return np.asarray((along_line + (at_rest - along_line) * concentration) * scales ** (1 + concentration))


def _transmissions(chains: Sequence[LineChain], passage: Transmission | None) -> list[Float | None]:
    """Return what cloud transmits of the stars during each line of each chain, (n, m); None for all."""
    if passage is None:
        return [None] * len(chains)
    means = passage.means(np.concatenate([chain.duration for chain in chains]))
    return list(np.split(means, np.cumsum([len(chain) for chain in chains])[:-1]))
