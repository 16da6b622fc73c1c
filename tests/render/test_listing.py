"""What truth lists does not depend on how trails are drawn, and what is drawn has nearly all light."""

from dataclasses import replace

import numpy as np
import orjson
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from glstar.render.scene.scene import Frame, Scene
from glstar.render.simulator import Simulator
from glstar.render.truth.frame import frame_truth
from tests.support.reference import light_of
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(640, 480, 600.0)
EXPOSURE = Exposure(NIGHT_UTC_S + 0.4, 0.5)


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as renderer:
        yield renderer


def turning_at(deg_per_s: float) -> Simulator:
    return sky_over_adelaide(LENS, roll_rad=-0.9, yaw_rate_rad_per_s=np.deg2rad(deg_per_s))


def stars_of(scene: Scene) -> list[dict]:
    pixels = np.zeros((LENS.height_px, LENS.width_px), np.uint8)
    return orjson.loads(frame_truth(scene, Frame(pixels, scene.exposure, 0), number=0, file=""))["stars"]


@pytest.mark.parametrize("deg_per_s", [0.0, 10.0, 50.0, 200.0])
def test_the_stars_of_truth_are_the_same_however_trails_are_drawn(deg_per_s):
    simulator = turning_at(deg_per_s)
    analytic = stars_of(simulator.scene(replace(EXPOSURE, trail="analytic")))
    assert len(analytic) > 200
    for exposure in (
        replace(EXPOSURE, trail="sprites"),
        replace(EXPOSURE, trail="auto"),
        replace(EXPOSURE, trail="analytic", path_tolerance_px=0.0),
        replace(EXPOSURE, trail="analytic", path_tolerance_px=0.5, faintest_dn=10.0),
    ):
        assert stars_of(simulator.scene(exposure)) == analytic


def test_truth_lists_every_star_that_a_dense_sampling_finds_on_the_image():
    simulator = turning_at(200.0)
    pointing = simulator.pointing(EXPOSURE.start_utc_s + np.linspace(0, EXPOSURE.duration_s, 2001))
    xy_px = LENS.project(pointing.to_camera(simulator.stars.direction_eq))
    crossing = LENS.contains(xy_px).any(axis=0)

    listed = {star["star_id"] for star in stars_of(simulator.scene(EXPOSURE))}

    assert crossing.sum() > 500
    assert set(simulator.stars.star_id[crossing].tolist()) <= listed


@pytest.mark.parametrize("deg_per_s", [0.0, 10.0, 50.0, 200.0])
def test_less_than_a_thousandth_of_the_light_is_left_out(renderer, deg_per_s):
    simulator = turning_at(deg_per_s)
    drawn, everything = (
        renderer.render(simulator.scene(replace(EXPOSURE, trail="analytic", faintest_dn=dn)), seed=0, light=True)
        for dn in (0.02, 0.0)
    )
    left_out = 1 - drawn.light_dn.sum(dtype=np.float64) / everything.light_dn.sum(dtype=np.float64)
    assert 0 <= left_out <= 1e-3


def test_nothing_is_left_out_at_rest_and_a_larger_limit_leaves_more_out():
    assert len(turning_at(0.0).scene(EXPOSURE).draw_list) == turning_at(0.0).scene(EXPOSURE).visible.size
    fast = turning_at(200.0)
    counts = [
        len(fast.scene(replace(EXPOSURE, trail="analytic", faintest_dn=dn)).draw_list) for dn in (0.0, 0.01, 0.02)
    ]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]


@pytest.mark.parametrize("deg_per_s", [0.0, 2.0, 20.0, 100.0])
def test_the_expected_peak_is_that_of_the_star_s_own_trail(deg_per_s):
    """Of a star drawn alone as 1000 sub-exposures in float64; the brightest pixel may miss the trail's centre."""
    sensor = Sensor(psf_sigma_px=2.5)
    simulator = replace(turning_at(deg_per_s), sensor=sensor)
    stars = [star for star in stars_of(simulator.scene(EXPOSURE)) if star["in_frame"] > 0.2]
    scene = simulator.scene(replace(EXPOSURE, trail="sprites", rate_hz=2000.0))
    number = {star_id: k for k, star_id in enumerate(scene.stars.star_id[scene.visible].tolist())}
    for star in stars[:3]:
        alone = light_of(scene.with_visible(np.array([number[star["star_id"]]])))
        assert star["trail_peak_dn"] == pytest.approx(alone.max(), rel=0.03)
        # A matched filter's ratio: root of the summed squares over the noise of a pixel.
        noise_dn = np.hypot(sensor.sky_std_dn, 12**-0.5)
        assert star["snr"] == pytest.approx(np.sqrt((alone**2).sum()) / noise_dn, rel=0.1)
