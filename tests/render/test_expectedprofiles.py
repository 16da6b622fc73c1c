"""The peak and the signal-to-noise ratio in truth of stars that are no plain Gaussians, against what is drawn."""

import json

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.render.opengl import GLRenderer
from glstar.render.truth.frame import frame_truth
from tests.support.scenes import NIGHT_UTC_S, camera, sky_over_adelaide, with_stars_at

LENS = camera(241, 181, 300.0)
# Variances in DN^2 of the sky, 3 DN, and of rounding.
NOISE_DN = (9 + 1 / 12) ** 0.5
PROFILES = {
    "gaussian": {},
    "moffat": {"psf": "moffat", "psf_beta": 2.5},
    "wings": {"psf_wing_fraction": 0.4, "psf_wing_sigma_px": 5.0, "psf_halo_fraction": 0.05},
    "elliptical": {"psf_ellipticity": 0.4, "psf_angle_deg": 30.0},
    "growing": {"psf_growth": 0.8, "psf": "moffat"},
    "tilted": {"psf_tilt": 0.5, "psf_tilt_angle_deg": 200.0, "psf": "moffat"},
}


@pytest.fixture(scope="module")
def renderer():
    with GLRenderer.headless() as one:
        yield one


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize(("deg_per_s", "peak", "snr"), [(0.0, 0.01, 0.02), (15.0, 0.02, 0.06)])
@pytest.mark.parametrize("xy_px", [(120.0, 90.0), (205.0, 150.0)])
def test_truth_has_the_peak_and_the_signal_to_noise_ratio_of_what_is_drawn(
    renderer, profile, deg_per_s, peak, snr, xy_px
):
    sensor = Sensor(psf_sigma_px=1.6, effects={f"sensor.{key}": value for key, value in PROFILES[profile].items()})
    rates = {"yaw_rate_rad_per_s": 0.0, "pitch_rate_rad_per_s": np.deg2rad(deg_per_s)}
    simulator = sky_over_adelaide(LENS, sensor=sensor, refraction=False, **rates)
    simulator = with_stars_at(simulator, [xy_px], [1.0], NIGHT_UTC_S + 0.5)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.4, 0.2, path_tolerance_px=0.0))
    frame = renderer.render(scene, seed=0, light=True)
    (star,) = json.loads(frame_truth(scene, frame, number=0, file="a"))["stars"]
    light = frame.light_dn.astype(np.float64)
    assert star["trail_peak_dn"] == pytest.approx(light.max(), rel=peak, abs=0)
    assert star["snr"] == pytest.approx(np.sqrt((light**2).sum()) / NOISE_DN, rel=snr, abs=0)


@pytest.mark.parametrize("sigma_px", [0.2, 0.3, 0.5, 0.8])
@pytest.mark.parametrize(("deg_per_s", "profile"), [(0.0, "gaussian"), (15.0, "gaussian"), (0.0, "moffat")])
def test_truth_has_the_peak_of_stars_narrower_than_a_pixel(renderer, sigma_px, deg_per_s, profile):
    """As a pixel in the middle of a star records it: a Gaussian widened by the pixel has 12 % more at sigma 0.3."""
    sensor = Sensor(psf_sigma_px=sigma_px, effects={f"sensor.{key}": value for key, value in PROFILES[profile].items()})
    rates = {"yaw_rate_rad_per_s": 0.0, "pitch_rate_rad_per_s": np.deg2rad(deg_per_s)}
    simulator = sky_over_adelaide(LENS, sensor=sensor, refraction=False, **rates)
    simulator = with_stars_at(simulator, [(120.0, 90.0)], [1.0], NIGHT_UTC_S + 0.5)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.4, 0.2, path_tolerance_px=0.0))
    frame = renderer.render(scene, seed=0, light=True)
    (star,) = json.loads(frame_truth(scene, frame, number=0, file="a"))["stars"]
    assert star["trail_peak_dn"] == pytest.approx(float(frame.light_dn.max()), rel=0.01, abs=0)
