"""Photographs of stars with known truth, drawn by the reference renderer, from an aircraft at rest."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.calibrate.identify.platesolution import PlateSolution, ReferenceStars
from glstar.calibrate.photo.photograph import Photograph
from glstar.camera.exposure import Exposure
from glstar.camera.model import Camera
from glstar.camera.sensor.sensor import Sensor
from glstar.render.motion.trailmodels import SubExposures
from glstar.render.scene.scene import Scene
from glstar.sky.catalogue.reading import StarCatalogue
from glstar.sky.observed.stars import Sky
from tests.support.reference import light_of
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

EXPOSURE_S = 0.5
_SIDEREAL_RAD_PER_S = 7.292e-5
ALL_STARS = StarCatalogue.open("bsc5").brighter_than(99.0)


@dataclass(frozen=True)
class StarPhoto:
    """A photograph and its truth."""

    image: Photograph
    lens: Camera
    sensor: Sensor
    sky: Sky
    scene: Scene
    exposure: Exposure

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        *,
        fov_deg: float = 40.0,
        size: tuple[int, int] = (800, 600),
        seed: int = 1,
        exposure_s: float = EXPOSURE_S,
        light: bool = True,
        colours: Callable[[int], NDArray[np.float64]] | None = None,
        **attitude: float,
    ) -> Self:
        lens = camera(*size, f_px=size[0] / 2 / np.tan(np.deg2rad(fov_deg) / 2))
        attitude = {"roll_rad": 0.05, "pitch_rad": 0.07, "yaw_rad": 1.2} | attitude
        simulator = sky_over_adelaide(
            lens, sensor=sensor, vmag_limit=99.0, duration_s=max(10.0, exposure_s + 8), **attitude
        )
        if colours is not None:
            # Deviations of each star's brightness from its catalogue magnitude.
            stars = simulator.stars
            simulator = replace(simulator, stars=replace(stars, measured_mag=stars.vmag + colours(len(stars))))
        exposure = Exposure(NIGHT_UTC_S + 4, exposure_s, trail="sprites")
        scene = simulator.scene(Exposure(exposure.mid_utc_s - EXPOSURE_S / 2, EXPOSURE_S, trail="sprites"))
        # The aircraft does not move, and the sky hardly moves in half a second: one time suffices.
        moments = max(1, round(1.5 * _SIDEREAL_RAD_PER_S * exposure_s * lens.fx_px / sensor.psf_sigma_px))
        pointing = scene.shutter[1:2] if moments == 1 else simulator.pointing(exposure.sub_utc_s(moments))
        scene = replace(scene, exposure=exposure, trails=SubExposures(pointing))
        light_dn = light_of(scene) if light else np.zeros((size[1], size[0]))
        noise_dn = np.random.default_rng(seed).normal(sensor.sky_mean_dn, sensor.sky_std_dn, (size[1], size[0]))
        pixels = np.floor(np.clip(light_dn + noise_dn, 0, sensor.saturation_dn) + 0.5)
        image = Photograph(Path("drawn.png"), pixels, sensor.bit_depth, "grey", None)
        return cls(image, lens, sensor, simulator.sky, scene, exposure)

    @property
    def reference(self) -> ReferenceStars:
        return ReferenceStars.over(self.sky, self.exposure.mid_utc_s, self.scene.site)

    @property
    def solution(self) -> PlateSolution:
        """The true solution."""
        return PlateSolution(self.lens, self.scene.shutter.C_camera_eq[1])

    def true_xy_px(self, star_id: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return the true positions of stars, by number."""
        xy = self.lens.project(self.scene.shutter.to_camera(self.scene.stars.direction_eq)[1])
        row = {int(number): k for k, number in enumerate(self.scene.stars.star_id)}
        return np.asarray(xy[[row[int(number)] for number in star_id]])

    def with_pixels(self, pixels: NDArray[np.float64]) -> Photograph:
        return replace(self.image, pixels_dn=pixels)
