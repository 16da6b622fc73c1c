"""The renderer as slowly and plainly as NumPy can say it: what `GLRenderer` must draw, on any driver."""

import math
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.camera.sensor import Sensor
from glstar.render.scene import Frame, Scene

Float = NDArray[np.float64]

# Every star is drawn to where nothing is left of it; the GPU stops earlier, and must show that it may.
_REACH_SIGMA = 7.0


class ReferenceRenderer:
    """Draws scenes one star and one sub-exposure at a time, in float64."""

    driver = "NumPy"

    def render(self, scene: Scene, *, seed: int, light: bool = False) -> Frame:
        """Draw a scene; its noise has the sensor's statistics but not the bytes of the GPU's."""
        light_dn, sensor = light_of(scene), scene.sensor
        noise_dn = np.random.default_rng(seed).normal(sensor.sky_mean_dn, sensor.sky_std_dn, light_dn.shape)
        limited = np.clip(light_dn + noise_dn, 0, sensor.saturation_dn)
        pixels = np.floor(limited + 0.5).astype(np.uint16 if sensor.bit_depth > 8 else np.uint8)
        return Frame(pixels, scene.exposure, seed, light_dn.astype(np.float32) if light else None)

    def close(self) -> None:
        """Nothing to give back."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def light_of(scene: Scene) -> Float:
    """Return the light before noise, (height, width) float64, DN: eqs (42), (43) at sub-pixel positions."""
    camera, sensor = scene.camera, scene.sensor
    reach = _REACH_SIGMA * sensor.drawn_sigma_px
    peak_dn = sensor.peak_dn(scene.stars.camera_mag[scene.visible], scene.exposure.duration_s)
    image = np.zeros((camera.height_px, camera.width_px))
    for centres, share in zip(*_ways(scene), strict=True):
        for (x, y), peak in zip(centres, share * peak_dn, strict=True):
            if not np.isfinite(x):
                continue
            columns = np.arange(max(0, math.ceil(x - reach)), min(camera.width_px - 1, math.floor(x + reach)) + 1)
            rows = np.arange(max(0, math.ceil(y - reach)), min(camera.height_px - 1, math.floor(y + reach)) + 1)
            if columns.size and rows.size:
                patch = peak * np.outer(profile(rows - y, sensor), profile(columns - x, sensor))
                image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += patch
    return image


def _ways(scene: Scene) -> tuple[Float, Float]:
    """Return where the stars are at many moments, (n, k, 2) px, and what share of the light each moment has, (n,).

    With sprites, the sub-exposures.  Swept, each segment's way, on which vectors to stars are quadratics of time, at
    moments 0.4 sigma apart: so close together, Gaussians add up to the integral over the way.
    """
    vectors = scene.pointing.to_camera(scene.stars.direction_eq[scene.visible])
    xy = scene.camera.project(vectors)
    if scene.exposure.trail == "sprites":
        return xy, np.full(len(xy), 1 / len(xy))
    ways, shares = [], []
    for segment, share in enumerate(scene.segment_share):
        knots = slice(2 * segment, 2 * segment + 3)
        begin, middle, end = vectors[knots]
        C_begin, _, C_end = scene.pointing.C_camera_eq[knots]
        turn_rad = math.acos(min(1.0, (np.trace(C_end @ C_begin.T) - 1) / 2))
        begin, end = begin / math.cos(turn_rad / 4) ** 2, end / math.cos(turn_rad / 4) ** 2
        longest_px = np.nanmax(np.linalg.norm(np.diff(xy[knots], axis=0), axis=2).sum(axis=0))
        n = 4 + math.ceil(longest_px / (0.4 * scene.sensor.psf_sigma_px))
        u = ((np.arange(n) + 0.5) / n)[:, np.newaxis, np.newaxis]
        way = begin + u * (4 * middle - 3 * begin - end + 2 * u * (begin - 2 * middle + end))
        ways.append(scene.camera.project(way))
        shares.append(np.full(n, share / n))
    return np.concatenate(ways), np.concatenate(shares)


def profile(offset_px: ArrayLike, sensor: Sensor) -> Float:
    """Return one axis of a star's profile, of peak 1 before the pixels have their say, as the sensor's model has it."""
    offset = np.asarray(offset_px, dtype=np.float64)
    if sensor.needs_erf:
        return integrated_profile(offset, sensor.psf_sigma_px)
    share = sensor.psf_sigma_px / sensor.drawn_sigma_px
    return share * np.exp(-0.5 * (offset / sensor.drawn_sigma_px) ** 2)


_erf = np.vectorize(math.erf, otypes=[np.float64])


def integrated_profile(offset_px: ArrayLike, sigma_px: float) -> Float:
    """Return one axis of a Gaussian of peak 1 integrated over each pixel: what a real sensor records."""
    offset, width_px = np.asarray(offset_px, dtype=np.float64), sigma_px * math.sqrt(2)
    return sigma_px * math.sqrt(math.pi / 2) * (_erf((offset + 0.5) / width_px) - _erf((offset - 0.5) / width_px))
