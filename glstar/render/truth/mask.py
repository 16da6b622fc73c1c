"""Trail masks: which star of a frame's truth each pixel shows."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, hypot, log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.camera.sensor.sensor import Sensor
from glstar.camera.vignetting import Vignetting
from glstar.render.effects.naturalsky import natural_sky_dn
from glstar.render.readout.rows import recorded_samples
from glstar.render.scene.scene import Scene
from glstar.render.scene.starcomponents import colours_used, psf_scale
from glstar.render.truth.linechains import normal_from_middle
from glstar.render.truth.statistics import TrailStatistics

# The largest value of a 16-bit mask.
MOST_TRAILS = 65535
# Paths that are sampled together, to bound memory: 256 paths of 10 000 samples take 40 MB.
_STARS_PER_BLOCK = 256
# Samples of a path whose Gaussians are computed together.
_SAMPLES_PER_BLOCK = 2048
_QUANTISATION_VARIANCE_DN2 = 1 / 12
# Gaussians are drawn up to this distance at most, sigma: beyond it the light of the brightest star is below 1e-7 of it.
_MAX_RADIUS_SIGMA = 6.0
# Of the level that is searched, the part that one of several Gaussians of a star may lack.
_SMALL_PART = 0.02


def mask_threshold_dn(scene: Scene) -> float:
    """Return the signal from which on a pixel belongs to a trail, DN of one short exposure.

    It is the standard deviation of a pixel without stars, from sky, dark current, read noise and rounding; of a stacked
    image over the square root of the number of short exposures.
    """
    sensor, exposure = scene.sensor, scene.exposure
    dn_per_e = 0.0 if sensor.electrons is None else sensor.electrons.dn_per_e
    variance_dn2 = sensor.background_std_dn(exposure.duration_s) ** 2 + dn_per_e * natural_sky_dn(scene)
    return sqrt((variance_dn2 + _QUANTISATION_VARIANCE_DN2) / exposure.frames)


def trail_mask(scene: Scene) -> NDArray[np.uint16]:
    """Return which star dominates each pixel, (height, width) uint16.

    It is k where the k-th entry of ``stars`` in the frame's truth (from 1) has the most noiseless signal of all stars,
    and at least `mask_threshold_dn`, and 0 elsewhere. The entries of ``bodies`` are numbered after the stars, and the
    entries of ``satellites`` after the bodies; only the first 65535 entries are in the mask. The signal is the sum of
    the Gaussians of the point spread function at samples of the star's path, every 1.5 sigma or closer, each integrated
    over the pixels: within 0.1 % of the integral along the path.
    """
    shape = scene.camera.height_px, scene.camera.width_px
    mask, strongest_dn = np.zeros(shape, np.uint16), np.full(shape, mask_threshold_dn(scene), np.float32)
    first = _add_stars(mask, strongest_dn, scene, 0)
    bodies = scene.body_scene
    if bodies is not None:
        first += _add_bodies(mask, strongest_dn, bodies, first)
    for satellite in scene.satellites:
        first += _add_stars(mask, strongest_dn, satellite, first)
    return mask


def _add_stars(mask: NDArray[np.uint16], strongest_dn: NDArray[np.float32], scene: Scene, first: int) -> int:
    """Mark the trails of the stars that truth lists; return their number."""
    listed = np.flatnonzero(TrailStatistics(scene).touching)
    flux_dn = _flux_dn(scene)[listed]
    for number, patch in _signals(scene, listed, flux_dn, float(strongest_dn.min())):
        if first + number < MOST_TRAILS:
            patch.mark(mask, strongest_dn, first + number + 1)
    return len(listed)


def _add_bodies(mask: NDArray[np.uint16], strongest_dn: NDArray[np.float32], sources: Scene, first: int) -> int:
    """Mark the bodies that truth lists, each the sum of its sources; return their number."""
    body = sources.stars.star_id[sources.visible]
    touching = TrailStatistics(sources).touching > 0
    flux_dn = _flux_dn(sources)
    listed = np.unique(body[touching]).tolist()
    for number, which in enumerate(listed):
        total = np.zeros(mask.shape, np.float32)
        of_body = np.flatnonzero(touching & (body == which))
        for _, patch in _signals(sources, of_body, flux_dn[of_body], float(strongest_dn.min()) / len(of_body)):
            total[patch.window] += patch.signal_dn
        if first + number < MOST_TRAILS:
            dominant = total > strongest_dn
            mask[dominant], strongest_dn[dominant] = first + number + 1, total[dominant]
    return len(listed)


def _flux_dn(scene: Scene) -> Float:
    """Return the flux of the visible stars at rest, (k,) DN."""
    return np.asarray(scene.sensor.flux_dn(scene.sensor.peak_dn(scene.observed_mag, scene.exposure.duration_s)))


@dataclass(frozen=True, slots=True)
class _Gaussian:
    """One of the Gaussians of a star."""

    flux_fraction: float
    sigma_px: float
    recorded_sigma_px: float  # With the width of a pixel
    offset_px: tuple[float, float]
    is_narrow: bool  # Whether its integral over a pixel differs from a Gaussian of this width

    def reach_px(self, flux_dn: float, faintest_dn: float) -> int:
        """Return how far from its middle it may exceed a level in a star of some flux, px; 0 if nowhere."""
        ratio = self.flux_fraction * flux_dn / (2 * pi * self.recorded_sigma_px**2 * faintest_dn)
        if ratio <= 1:
            return 0
        return ceil(self.recorded_sigma_px * min(sqrt(2 * log(ratio)), _MAX_RADIUS_SIGMA)) + 1

    def in_pixels(self, offset_px: Float) -> Float:
        """Return its fraction in pixels at some offsets from its middle along one axis."""
        if self.is_narrow:
            ends = (np.stack([offset_px + 0.5, offset_px - 0.5]) / self.sigma_px).astype(np.float32)
            after, before = normal_from_middle(ends)
            return np.asarray(after - before, np.float64)
        sigma_px = self.recorded_sigma_px
        return np.exp(-0.5 * (offset_px / sigma_px) ** 2) / (sqrt(2 * pi) * sigma_px)


class _Patch:
    """The signal of one trail in a rectangle of the image."""

    def __init__(self, low: tuple[int, int], size: tuple[int, int]) -> None:
        self._low, self._size = low, size
        self._signal = np.zeros(size[0] * size[1])

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image."""
        return tuple(slice(low, low + size) for low, size in zip(self._low, self._size, strict=True))  # type: ignore[return-value]

    @property
    def signal_dn(self) -> NDArray[np.float32]:
        """DN, (rows, columns)."""
        return self._signal.reshape(self._size).astype(np.float32)

    def add(self, xy_px: Float, flux_dn: Float, gaussian: _Gaussian, reach_px: int) -> None:
        """Add one Gaussian of a star at n positions (x, y) with fluxes (n,); what is outside the rectangle is lost."""
        rows, columns = self._size
        offset = np.arange(-reach_px, reach_px + 1)
        xy_px, flux_dn = xy_px + gaussian.offset_px, flux_dn * gaussian.flux_fraction
        for first in range(0, len(xy_px), _SAMPLES_PER_BLOCK):
            xy, flux = xy_px[first : first + _SAMPLES_PER_BLOCK], flux_dn[first : first + _SAMPLES_PER_BLOCK]
            column, row = (np.rint(xy[:, axis]).astype(np.intp)[:, np.newaxis] + offset for axis in (0, 1))
            across, down = (gaussian.in_pixels(at - xy[:, axis : axis + 1]) for axis, at in enumerate((column, row)))
            column, row = column - self._low[1], row - self._low[0]
            across = np.where((column >= 0) & (column < columns), across, 0.0)
            down = np.where((row >= 0) & (row < rows), down, 0.0) * flux[:, np.newaxis]
            at = row.clip(0, rows - 1)[:, :, np.newaxis] * columns + column.clip(0, columns - 1)[:, np.newaxis]
            light = down[:, :, np.newaxis] * across[:, np.newaxis]
            self._signal += np.bincount(at.ravel(), light.ravel(), len(self._signal))

    def mark(self, mask: NDArray[np.uint16], strongest_dn: NDArray[np.float32], value: int) -> None:
        """Give the pixels to this trail in which it is the strongest."""
        signal_dn, window = self.signal_dn, self.window
        dominant = signal_dn > strongest_dn[window]
        mask[window][dominant], strongest_dn[window][dominant] = value, signal_dn[dominant]


def _signals(scene: Scene, stars: NDArray[np.intp], flux_dn: Float, faintest_dn: float) -> Iterator[tuple[int, _Patch]]:
    """Yield the signals of some of the visible stars that may exceed a level, and their positions in the selection."""
    camera, shown = scene.camera, scene.visible[stars]
    scales = psf_scale(scene, scene.stars.direction_eq[shown], colours_used(scene.stars, shown))
    profiles = {scale: _gaussians(scene.sensor, scale) for scale in np.unique(scales).tolist()}
    for begin in range(0, len(stars), _STARS_PER_BLOCK):
        some = stars[begin : begin + _STARS_PER_BLOCK]
        xy_px, weight = _samples(scene, some)
        for k in range(len(some)):
            flux, gaussians = float(flux_dn[begin + k]), profiles[float(scales[begin + k])]
            # Several Gaussians may exceed the level together.
            least_dn = faintest_dn if len(gaussians) == 1 else _SMALL_PART * faintest_dn
            reaches = [(one, reach_px) for one in gaussians if (reach_px := one.reach_px(flux, least_dn))]
            if not reaches:
                continue
            farthest_px = max(reach_px + ceil(hypot(*one.offset_px)) for one, reach_px in reaches)
            near = (weight[:, k] > 0) & camera.contains(xy_px[:, k], farthest_px)
            if not near.any():
                continue
            xy, star_dn = xy_px[near, k], flux * weight[near, k]
            patch = _patch_around(xy, farthest_px, (camera.height_px, camera.width_px))
            for gaussian, reach_px in reaches:
                patch.add(xy, star_dn, gaussian, reach_px)
            yield begin + k, patch


def _gaussians(sensor: Sensor, scale: float) -> list[_Gaussian]:
    """Return the Gaussians of stars whose core is wider than on the axis by a factor."""
    gaussians = []
    for one in sensor.point_spread.components(sensor.psf_sigma_px, scale=scale):
        alone = sensor.of_component(one)
        recorded_px = alone.effective_sigma_px
        gaussians.append(_Gaussian(one.flux_fraction, one.sigma_px, recorded_px, one.offset_px, alone.needs_erf))
    return gaussians


def _patch_around(xy_px: Float, radius_px: int, shape: tuple[int, int]) -> _Patch:
    """Return the empty patch of the image that is closer than a radius to some positions."""
    low = np.maximum(np.rint(xy_px.min(axis=0)).astype(int)[::-1] - radius_px, 0)
    high = np.minimum(np.rint(xy_px.max(axis=0)).astype(int)[::-1] + radius_px + 1, shape)
    size = np.maximum(high - low, 1)
    low = np.minimum(low, np.array(shape) - size)
    return _Patch((int(low[0]), int(low[1])), (int(size[0]), int(size[1])))


def _samples(scene: Scene, stars: NDArray[np.intp]) -> tuple[Float, Float]:
    """Return samples of the true paths of some visible stars, (n, m, 2) px, and their parts of the exposure, (n, m)."""
    directions = scene.stars.direction_eq[scene.visible[stars]]
    if scene.exposure.readout_s and scene.motion is not None:
        samples = recorded_samples(scene, directions)
    else:
        samples = (
            (xy, time_fraction, np.repeat(time_fraction[:, np.newaxis], len(stars), axis=1))
            for paths in scene.star_paths(directions)
            for xy, time_fraction in paths.samples(np.arange(len(stars)))
        )
    xy_px, time_fraction, weight = map(np.concatenate, zip(*samples, strict=True))
    passage = scene.attenuation.steady_transmission(directions)
    if passage is not None:
        end = np.cumsum(time_fraction)
        weight = weight * passage.at(end - time_fraction / 2)
    hidden = np.isnan(xy_px[..., 0])
    xy_px = np.where(hidden[..., np.newaxis], -1e6, xy_px)
    vignetting = Vignetting.of(scene.sensor.effects)
    if vignetting.vignetting != "none":
        on_image = scene.camera.contains(xy_px)
        weight[on_image] *= vignetting.of_stars(scene.camera, xy_px[on_image])
    return xy_px, np.where(hidden, 0.0, weight)
