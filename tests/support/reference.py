"""A slow and plain NumPy renderer: the reference for `GLRenderer` on any driver."""

import math
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.scene.scene import Frame, Scene

Float = NDArray[np.float64]

# Truncation radius of every star, sigma: 2e-11 of the peak.  `GLRenderer` truncates earlier, which the tests justify.
_TRUNCATION_SIGMA = 7.0


class ReferenceRenderer:
    """Draws scenes one star and one sub-exposure at a time, in float64."""

    driver = "NumPy"

    def render(self, scene: Scene, *, seed: int, light: bool = False) -> Frame:
        """Draw a scene; its noise has the statistics of `GLRenderer`'s but other values."""
        light_dn, sensor = light_of(scene), scene.sensor
        noise_dn = np.random.default_rng(seed).normal(sensor.sky_mean_dn, sensor.sky_std_dn, light_dn.shape)
        limited = np.clip(light_dn + noise_dn, 0, sensor.saturation_dn)
        pixels = np.floor(limited + 0.5).astype(np.uint16 if sensor.bit_depth > 8 else np.uint8)
        return Frame(pixels, scene.exposure, seed, light_dn.astype(np.float32) if light else None)

    def close(self) -> None:
        """Do nothing: there are no resources."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def light_of(scene: Scene) -> Float:
    """Return the noiseless signal, (height, width) float64, DN: eqs (42), (43) at sub-pixel positions."""
    camera, sensor = scene.camera, scene.sensor
    radius_px = _TRUNCATION_SIGMA * sensor.effective_sigma_px
    peak_dn = sensor.peak_dn(scene.stars.camera_mag[scene.visible], scene.exposure.duration_s)
    image = np.zeros((camera.height_px, camera.width_px))
    for centres, time_fraction in zip(*_samples(scene), strict=True):
        for (x, y), peak in zip(centres, time_fraction * peak_dn, strict=True):
            if not np.isfinite(x):
                continue
            columns, rows = _within(x, radius_px, camera.width_px), _within(y, radius_px, camera.height_px)
            if columns.size and rows.size:
                patch = peak * np.outer(profile(rows - y, sensor), profile(columns - x, sensor))
                image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += patch
    return image


def _within(centre_px: float, radius_px: float, count: int) -> NDArray[np.intp]:
    """Return the columns or rows of an image within a radius of a coordinate."""
    return np.arange(max(0, math.ceil(centre_px - radius_px)), min(count - 1, math.floor(centre_px + radius_px)) + 1)


def _samples(scene: Scene) -> tuple[Float, Float]:
    """Return sampled positions of the visible stars, (n, k, 2) px, and the time fraction of each sample, (n,).

    `SubExposures` are sampled as they are.  The conic path of each of `AnalyticSegments` is sampled every 0.4 sigma,
    where a sum of Gaussians equals the integral along the path.
    """
    vectors = scene.trails.pointing.to_camera(scene.stars.direction_eq[scene.visible])
    xy = scene.camera.project(vectors)
    if not isinstance(scene.trails, AnalyticSegments):
        return xy, np.full(len(xy), 1 / len(xy))
    samples, time_fractions = [], []
    for segment, time_fraction in enumerate(scene.trails.time_fraction):
        nodes = slice(2 * segment, 2 * segment + 3)
        start, middle, end = vectors[nodes]
        C_start, _, C_end = scene.trails.pointing.C_camera_eq[nodes]
        rotation_rad = math.acos(min(1.0, (np.trace(C_end @ C_start.T) - 1) / 2))
        start, end = start / math.cos(rotation_rad / 4) ** 2, end / math.cos(rotation_rad / 4) ** 2
        longest_px = np.nanmax(np.linalg.norm(np.diff(xy[nodes], axis=0), axis=2).sum(axis=0))
        n = 4 + math.ceil(longest_px / (0.4 * scene.sensor.psf_sigma_px))
        u = ((np.arange(n) + 0.5) / n)[:, np.newaxis, np.newaxis]
        path = start + u * (4 * middle - 3 * start - end + 2 * u * (start - 2 * middle + end))
        samples.append(scene.camera.project(path))
        time_fractions.append(np.full(n, time_fraction / n))
    return np.concatenate(samples), np.concatenate(time_fractions)


def profile(offset_px: ArrayLike, sensor: Sensor) -> Float:
    """Return one axis of a star's profile as the sensor records it, for a point spread function of peak 1."""
    offset = np.asarray(offset_px, dtype=np.float64)
    if sensor.needs_erf:
        return integrated_profile(offset, sensor.psf_sigma_px)
    peak = sensor.psf_sigma_px / sensor.effective_sigma_px
    return peak * np.exp(-0.5 * (offset / sensor.effective_sigma_px) ** 2)


def integrated_profile(offset_px: ArrayLike, sigma_px: float) -> Float:
    """Return one axis of a Gaussian of peak 1 integrated over each pixel, as a real sensor records it."""
    offset, width_px = np.asarray(offset_px, dtype=np.float64), sigma_px * math.sqrt(2)
    integral = erf((offset + 0.5) / width_px) - erf((offset - 0.5) / width_px)
    return np.asarray(sigma_px * math.sqrt(math.pi / 2) * integral)
