"""The renderer as slowly and plainly as NumPy can say it: what `GLRenderer` must draw, on any driver."""

import math
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.scene import Frame, Scene


class ReferenceRenderer:
    """Draws scenes one star and one sub-exposure at a time, in float64."""

    driver = "NumPy"

    def render(self, scene: Scene, *, seed: int, light: bool = False) -> Frame:
        """Draw a scene; its noise has the sensor's statistics but not the bytes of the GPU's."""
        light_dn = self.light(scene)
        sensor = scene.sensor
        noise_dn = np.random.default_rng(seed).normal(sensor.sky_mean_dn, sensor.sky_std_dn, light_dn.shape)
        limited = np.clip(light_dn + noise_dn, 0, sensor.saturation_dn)
        pixels = np.floor(limited + 0.5).astype(np.uint16 if sensor.bit_depth > 8 else np.uint8)
        return Frame(pixels, scene.exposure, seed, light_dn.astype(np.float32) if light else None)

    def light(self, scene: Scene) -> NDArray[np.float64]:
        """Return the light before noise, (height, width) float64, DN."""
        camera, sensor = scene.camera, scene.sensor
        peak_dn = sensor.peak_dn(scene.stars.vmag[scene.visible], scene.exposure.duration_s) / len(scene.pointing)
        centres = camera.project(scene.pointing.to_camera(scene.stars.direction_eq[scene.visible]))
        image = np.zeros((camera.height_px, camera.width_px))
        for at_moment in centres:
            for (x, y), peak, reach in zip(at_moment, peak_dn, scene.reach_px, strict=True):
                if not np.isfinite(x):
                    continue
                columns = np.arange(max(0, np.ceil(x - reach)), min(camera.width_px - 1, np.floor(x + reach)) + 1)
                rows = np.arange(max(0, np.ceil(y - reach)), min(camera.height_px - 1, np.floor(y + reach)) + 1)
                if columns.size and rows.size:
                    patch = peak * np.outer(_profile(rows - y, sensor), _profile(columns - x, sensor))
                    image[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1] += patch
        return image

    def close(self) -> None:
        """Nothing to give back."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _profile(offset_px, sensor):
    if sensor.needs_erf:
        return integrated_profile(offset_px, sensor.psf_sigma_px)
    share = sensor.psf_sigma_px / sensor.drawn_sigma_px
    return share * np.exp(-0.5 * (offset_px / sensor.drawn_sigma_px) ** 2)


def integrated_profile(offset_px, sigma_px):
    """Return a Gaussian of peak 1 integrated over each pixel: the truth that a widened one stands for."""
    erf = np.vectorize(math.erf)
    width_px = sigma_px * np.sqrt(2)
    return sigma_px * np.sqrt(np.pi / 2) * (erf((offset_px + 0.5) / width_px) - erf((offset_px - 0.5) / width_px))
