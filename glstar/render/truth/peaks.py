"""Expected brightness of star trails: the signal at the brightest point, and the area that its light covers.

Paths are chains of straight lines.  Around the lines that receive most light, the signal is computed exactly.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import exp, pi, sqrt
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
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
from glstar.render.truth.brightest import FAR_PX, BrightestPoints, brightest_points
from glstar.render.truth.linechains import LineChain, NearLines, Stars, line_chains
from glstar.sky.photometry import USUAL_BV


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
# Signals that are at least this part of the largest are the same.
_SAME = 0.995


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
    searches: list[_Search] = []
    is_even: NDArray[np.bool_] = np.zeros(points.promised_per_px2.shape[1:], np.bool_)
    for middle_px, step_px, promised in zip(points.point_px, points.step_px, points.promised_per_px2, strict=True):
        # Where a trail is steady, the other lines that promise the same are as bright.
        is_same = is_even & (promised > _SAME * points.promised_per_px2[0])
        at_px = np.where(is_same[:, np.newaxis], FAR_PX, middle_px)
        searches.append(_Search.along(scene.camera, scene.sensor.effective_sigma_px, parts, at_px, step_px))
        is_even = ~searches[0].may_gain
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
