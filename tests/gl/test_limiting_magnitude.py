"""The limiting magnitude of scenes against rendered frames: many noise seeds and a matched filter."""

import re
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.render.effects.cloud import transmission_at
from glstar.render.opengl import GLRenderer
from glstar.render.scene.clouds import cloud_sheet, sheet_crossing
from glstar.render.scene.scene import Scene
from glstar.render.truth.conditions import LimitingMagnitude, conditions_report, limiting_magnitude
from glstar.sky.air.extinction import Extinction
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, with_stars_at

EXPOSURE = Exposure(NIGHT_UTC_S + 4.0, 0.5)
LENS = camera(100, 80, 300.0)
AXIS_PX = [(LENS.width_px - 1) / 2, (LENS.height_px - 1) / 2]
SEEDS = 600
ELECTRONS = {"sensor.noise": "electrons", "sensor.bit_depth": 12}


def scene_of(sensor: Sensor, vmag: float, deg_per_s: float, extinction: Extinction | None = None) -> Scene:
    """Return a scene with one star on the optical axis in the middle of the exposure."""
    simulator = sky_over_adelaide(LENS, sensor=sensor, roll_rad=-0.5, yaw_rate_rad_per_s=np.deg2rad(deg_per_s))
    simulator = replace(simulator, extinction=extinction)
    return with_stars_at(simulator, [AXIS_PX], [vmag], EXPOSURE.mid_utc_s).scene(EXPOSURE)


def measured_snr(renderer: GLRenderer, scene: Scene) -> float:
    """Return the flux of the star over the scatter that its own profile measures in frames of many seeds."""
    light = renderer.render(scene, seed=0, light=True).light_dn
    assert light is not None
    profile = light.astype(np.float64)
    # The background near the star, because a natural sky has a gradient.
    y, x = np.indices(profile.shape)
    dark = (profile < 1e-4 * profile.max()) & (np.hypot(x - AXIS_PX[0], y - AXIS_PX[1]) < 25)
    fluxes = []
    for seed in range(SEEDS):
        pixels = renderer.render(scene, seed=seed).pixels.astype(np.float64)
        fluxes.append(((pixels - pixels[dark].mean()) * profile).sum() / (profile**2).sum())
    # The curvature of a natural sky is a tenth of a faint star.
    assert np.mean(fluxes) == pytest.approx(1.0, abs=0.12)
    return float(1 / np.std(fluxes))


@pytest.mark.parametrize(
    ("keys", "deg_per_s"),
    [
        ({}, 0.0),
        ({}, 12.0),
        (ELECTRONS, 0.0),
        (ELECTRONS | {"sensor.sky_e_per_s": 100.0}, 12.0),
        (ELECTRONS | {"sky.brightness": "natural", "sky.town_mag_arcsec2": 19.0}, 0.0),
        ({"sensor.psf": "moffat", "sensor.psf_beta": 2.5}, 5.0),
    ],
    ids=["paper", "paper-trail", "electrons", "electrons-trail", "natural-sky", "moffat"],
)
def test_a_star_of_the_limiting_magnitude_has_snr_5(
    renderer: GLRenderer, keys: dict[str, object], deg_per_s: float
) -> None:
    sensor = Config().override(**keys).sensor()
    limit = limiting_magnitude(scene_of(sensor, 5.0, deg_per_s))
    snr = measured_snr(renderer, scene_of(sensor, limit.trail_mag, deg_per_s))
    # 600 frames measure the scatter to 3 %.
    assert snr == pytest.approx(5.0, rel=0.1)
    if not deg_per_s:
        assert limit.at_rest_mag == pytest.approx(limit.trail_mag, abs=0.02)


def test_extinction_costs_its_magnitudes_and_town_light_costs_more() -> None:
    plain = limiting_magnitude(scene_of(Sensor(), 5.0, 0.0))
    dimmed = scene_of(Sensor(), 5.0, 0.0, Extinction())
    lost_mag = float(dimmed.extinction_mag(dimmed.shutter.boresight_eq[1] @ dimmed.shutter.zenith_eq[1]))
    assert lost_mag > 0.1
    assert plain.at_rest_mag - limiting_magnitude(dimmed).at_rest_mag == pytest.approx(lost_mag, abs=1e-9)

    lit = [
        Config().override(**ELECTRONS, **{"sky.brightness": "natural", "sky.town_mag_arcsec2": mag}).sensor()
        for mag in (30.0, 19.0)
    ]
    dark, town = (limiting_magnitude(scene_of(sensor, 5.0, 0.0)).at_rest_mag for sensor in lit)
    assert dark - town > 0.5


def test_cloud_costs_the_magnitudes_that_it_takes_on_the_axis_and_is_reported() -> None:
    clear, clouded = (
        scene_of(Config().override(**{"cloud.coverage": coverage, "cloud.edge": 0.2}).sensor(), 5.0, 0.0)
        for coverage in (0.0, 1.0)
    )
    sheet = cloud_sheet(clouded.sensor, clouded.motion)
    crossing = sheet_crossing(
        sheet,
        clouded.shutter.boresight_eq[1] @ clouded.shutter.zenith_eq[1],
        clouded.shutter.boresight_eq[1],
        clouded.shutter.zenith_eq[1],
        (ADELAIDE.latitude_rad, ADELAIDE.longitude_rad, ADELAIDE.height_m),
        EXPOSURE.mid_utc_s,
    )
    lost_mag = -2.5 * np.log10(float(crossing.transmission))
    assert lost_mag > 0.3
    assert limiting_magnitude(clear).at_rest_mag - limiting_magnitude(clouded).at_rest_mag == pytest.approx(
        lost_mag, rel=0, abs=1e-9
    )
    assert "cloud" not in conditions_report(clear)
    percent = int(re.search(r"cloud transmits (\d+) % on average", conditions_report(clouded))[1])
    xy_px = np.stack(np.meshgrid(np.linspace(0, LENS.width_px, 60), np.linspace(0, LENS.height_px, 60)), axis=-1)
    assert percent == pytest.approx(100 * transmission_at(clouded, xy_px).mean(), rel=0, abs=3)


def test_a_saturated_sky_and_a_camera_at_the_ground_have_no_limit() -> None:
    full = Config().override(**ELECTRONS, **{"sky.brightness": "natural", "sky.town_mag_arcsec2": 1.0}).sensor()
    assert limiting_magnitude(scene_of(full, 5.0, 0.0)).text == "no star: the sky saturates"
    below = sky_over_adelaide(LENS, roll_rad=np.pi).scene(EXPOSURE)
    assert np.isnan(limiting_magnitude(below).trail_mag)
    assert LimitingMagnitude(6.25, 4.0).text == "limit V 6.2 at rest, 4.0 as a trail"
