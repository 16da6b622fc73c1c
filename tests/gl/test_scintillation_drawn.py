"""Scintillation as drawn: the flux of each star is that of truth, still and along a trail that varies."""

import json
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, star_field

SEEN = camera(400, 300, 500.0)


def simulator_of(scintillation, turn_rad_per_s=0.0, **effects):
    """Return a camera towards the zenith that sees eight stars far from each other."""
    sensor = Sensor(psf_sigma_px=1.5, bit_depth=16, reference_peak_dn=3e4)
    sensor = replace(sensor, effects={"sky.scintillation": scintillation, **effects})
    mount = Mount(pitch_rad=np.deg2rad(85.0))
    base = sky_over_adelaide(SEEN, sensor=sensor, mount=mount, yaw_rate_rad_per_s=turn_rad_per_s)
    pointing = base.pointing(np.array([NIGHT_UTC_S + 5.0]))
    x, y = np.meshgrid(np.linspace(60, 340, 4), [75.0, 225.0])
    rays = SEEN.unit_vectors(np.stack([x.ravel(), y.ravel()], axis=1))
    return replace(base, stars=star_field(rays @ pointing.C_camera_eq[0], np.full(8, 6.0)))


def fluxes(renderer, simulator, exposure):
    """Return the light around the eight stars, and their entries of truth."""
    scene = simulator.scene(exposure)
    frame = renderer.render(scene, seed=0, light=True)
    stars = json.loads(frame_truth(scene, frame, number=0, file="a"))["stars"]
    tiles = frame.light_dn.astype(np.float64).reshape(2, 150, 4, 100).sum(axis=(1, 3)).ravel()
    return tiles, {star["star_id"]: star for star in stars}, frame.light_dn


@pytest.mark.parametrize("trail", ["analytic", "sprites"])
@pytest.mark.parametrize("frames", [1, 2])
def test_the_flux_of_each_star_is_that_of_truth(renderer, trail, frames):
    exposure = Exposure(NIGHT_UTC_S + 4.95, 0.05, trail=trail, frames=frames, stack="mean")
    drawn, truth, _ = fluxes(renderer, simulator_of(0.38), exposure)
    plain, _, _ = fluxes(renderer, simulator_of(0.0), exposure)
    expected = np.array([truth[number]["scintillation"] for number in range(1, 9)])
    assert expected.std() > 0.03
    np.testing.assert_allclose(drawn / plain, expected, rtol=2e-3, atol=0)


def test_exposures_have_the_standard_deviation_of_their_length(renderer):
    simulator = simulator_of(0.38)
    factors = []
    for k in range(40):
        scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.2 * k, 0.1))
        factors += list(scene.draw_list.passage.mean(axis=1))
    # 0.38 sqrt(2 * 4 ms / 100 ms) sqrt(1 - 4 ms / 100 ms), less by the height of 50 m: 0.6 %.
    np.testing.assert_allclose(np.std(factors), 0.38 * 0.283 * 0.98 * 0.994, rtol=0.15, atol=0)


@pytest.mark.parametrize("cloud", [False, True])
def test_a_trail_varies_and_its_mean_is_that_of_truth(renderer, cloud):
    effects = {"cloud.coverage": 1.0, "cloud.optical_depth": 0.5, "cloud.height_m": 3000.0} if cloud else {}
    exposure = Exposure(NIGHT_UTC_S + 4.95, 0.1)
    drawn, truth, light = fluxes(renderer, simulator_of(0.38, 3.0, **effects), exposure)
    plain, _, smooth = fluxes(renderer, simulator_of(0.0, 3.0, **effects), exposure)
    expected = np.array([truth[number]["scintillation"] for number in range(1, 9)])
    np.testing.assert_allclose(drawn.sum() / plain.sum(), expected.mean(), rtol=0.01, atol=0)
    ratio = light[smooth > 0.3 * smooth.max()] / smooth[smooth > 0.3 * smooth.max()]
    assert ratio.std() > 0.15


def test_behind_thick_cloud_a_trail_varies_as_its_sub_exposures_do(renderer):
    effects = {"cloud.coverage": 1.0, "cloud.optical_depth": 4.5, "cloud.height_m": 3000.0}
    simulator = simulator_of(0.38, 3.0, **effects)
    analytic, sprites = (
        fluxes(renderer, simulator, Exposure(NIGHT_UTC_S + 4.95, 0.1, 5000.0, trail=trail, path_tolerance_px=0.0))[2]
        for trail in ("analytic", "sprites")
    )
    assert np.abs(analytic - sprites).max() < 0.05 * sprites.max()
