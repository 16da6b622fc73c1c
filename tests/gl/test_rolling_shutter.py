"""A rolling shutter, against thousands of positions of each star that are recorded by the rows that are open then."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from glstar.camera.exposure import Exposure
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.simulator import Simulator
from tests.support.lenses import LENSES, camera_with
from tests.support.rollingshutter import rolling_light
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide
from tests.support.trails import BRIGHT, demo_flight, light, most_of_the_time_on_the_image, vibrating, with_stars

# No pixel may differ by more than this fraction of the brightest pixel of the star's own trail, and no sum of flux by
# more than this fraction of it.
FRACTION = 2e-3
SMALL = camera(240, 180, 967.7425)
READOUT_S = 0.087


def turning(axis: str, deg_per_s: float) -> Simulator:
    rate = {f"{axis}_rate_rad_per_s": np.deg2rad(deg_per_s)}
    return replace(sky_over_adelaide(SMALL, vmag_limit=6.0, refraction=False, **rate), sensor=BRIGHT)


def accelerating() -> Simulator:
    """Return the view from an aircraft that rolls and pitches from 20 to 60 deg/s within two seconds."""
    t = np.arange(0.0, 2.0, 0.005)
    turned_rad = np.deg2rad(20.0 * t + 10.0 * t**2)
    attitude = Rotation.from_rotvec(np.outer(turned_rad, [0.8, 0.6, 0.0]))
    q = np.roll(attitude.inv().as_quat(), 1, axis=1)  # SciPy's are (x, y, z, w)
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, q, interpolation="spline")
    return replace(turning("roll", 0.0), flight=Flight(track, PositionTrack.fixed(ADELAIDE)))


def errors(renderer: GLRenderer, simulator: Simulator, exposure: Exposure, samples: int = 4_000) -> tuple[float, float]:
    """Return the errors of the worst pixel and of the flux of the star that is longest on the image, as fractions."""
    scene = simulator.scene(exposure)
    (star,) = most_of_the_time_on_the_image(scene, 1)
    expected = rolling_light(simulator, exposure, int(star), samples)
    drawn = light(renderer, with_stars(scene, star))
    assert expected.max() > 100
    return np.abs(drawn - expected).max() / expected.max(), abs(drawn.sum() / expected.sum() - 1)


# Exposures longer and shorter than the readout, all four directions, 0 to 150 deg/s.
@pytest.mark.parametrize(
    ("axis", "deg_per_s", "readout", "duration_s"),
    [
        ("pitch", 0.0, "down", 0.5),
        ("roll", 1.0, "up", 0.02),
        ("pitch", 10.0, "down", 0.02),
        ("pitch", 10.0, "left", 0.5),
        ("roll", 10.0, "right", 0.02),
        ("roll", 60.0, "up", 0.5),
        ("roll", 60.0, "down", 0.02),
        ("pitch", 60.0, "right", 0.5),
        ("roll", 150.0, "down", 0.5),
        ("roll", 150.0, "up", 0.02),
        ("pitch", 150.0, "left", 0.02),
        ("yaw", 150.0, "right", 0.02),
    ],
)
def test_a_straight_trail_is_recorded_row_by_row(renderer, axis, deg_per_s, readout, duration_s):
    exposure = Exposure(NIGHT_UTC_S + 0.4, duration_s, trail="analytic", readout_s=READOUT_S, readout=readout)
    assert max(errors(renderer, turning(axis, deg_per_s), exposure, 2_000 + int(150 * deg_per_s))) <= FRACTION


@pytest.mark.parametrize("readout", ["down", "left"])
@pytest.mark.parametrize("duration_s", [0.3, 0.02])
def test_an_accelerating_trail_is_recorded_row_by_row(renderer, duration_s, readout):
    exposure = Exposure(NIGHT_UTC_S + 1.0, duration_s, trail="analytic", readout_s=READOUT_S, readout=readout)
    assert max(errors(renderer, accelerating(), exposure, 8_000)) <= FRACTION


@pytest.mark.parametrize("duration_s", [0.5, 0.02])
def test_a_bent_trail_is_recorded_row_by_row(renderer, duration_s):
    exposure = Exposure(NIGHT_UTC_S + 0.4, duration_s, trail="analytic", readout_s=READOUT_S)
    assert max(errors(renderer, turning("yaw", 60.0), exposure, 8_000)) <= FRACTION


# Stars of 0.9 px are drawn in segments, wider ones in pieces.
@pytest.mark.parametrize(("sigma_px", "duration_s"), [(1.2, 0.3), (1.2, 0.02), (0.9, 0.3)])
def test_a_vibration_of_20_hz_is_recorded_row_by_row(renderer, sigma_px, duration_s):
    simulator = vibrating(20.0, 1.0)
    simulator = replace(simulator, sensor=replace(simulator.sensor, psf_sigma_px=sigma_px))
    exposure = Exposure(NIGHT_UTC_S + 0.7, duration_s, trail="analytic", readout_s=READOUT_S)
    assert max(errors(renderer, simulator, exposure)) <= FRACTION


@pytest.mark.parametrize("duration_s", [0.5, 0.02])
def test_the_worst_of_a_flight_is_recorded_row_by_row(renderer, duration_s):
    simulator, worst_s = demo_flight()
    exposure = Exposure(worst_s - 0.3, duration_s, trail="analytic", readout_s=READOUT_S)
    assert max(errors(renderer, simulator, exposure)) <= FRACTION


@pytest.mark.parametrize(("sigma_px", "deg_per_s"), [(0.4, 3.0), (0.8, 0.0), (0.8, 3.0), (3.0, 3.0)])
def test_every_point_spread_function_is_recorded_row_by_row(renderer, sigma_px, deg_per_s):
    simulator = replace(turning("pitch", deg_per_s), sensor=replace(BRIGHT, psf_sigma_px=sigma_px))
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.05, trail="analytic", readout_s=READOUT_S)
    assert max(errors(renderer, simulator, exposure)) <= FRACTION


@pytest.mark.parametrize("readout", ["down", "left"])
@pytest.mark.parametrize("sigma_px", [0.8, 1.2])
def test_sub_exposures_are_recorded_row_by_row(renderer, sigma_px, readout):
    """With enough of them the ends of a trail are as exact as its middle."""
    simulator = replace(
        turning("roll", 10.0), sensor=Sensor(psf_sigma_px=sigma_px, reference_peak_dn=1e6, bit_depth=16)
    )
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.2, 1000.0, "sprites", READOUT_S, readout)
    assert max(errors(renderer, simulator, exposure)) <= FRACTION


def test_a_star_that_moves_along_the_readout_is_recorded_for_longer(renderer):
    """By 1 / (1 - v tau), v its speed in rows per second and tau the time between rows."""
    simulator = turning("roll", 20.0)
    exposure = Exposure(NIGHT_UTC_S + 0.45, 0.05, trail="analytic", readout_s=0.02, readout="down")
    still = replace(exposure, readout_s=0.0)
    fluxes = []
    for readout in ("down", "up"):
        scene = simulator.scene(replace(exposure, readout=readout))
        (star,) = most_of_the_time_on_the_image(scene, 1)
        fluxes.append(light(renderer, with_stars(scene, star)).sum())
    scene = simulator.scene(still)
    full = light(renderer, with_stars(scene, star)).sum()
    opens, _, closes = scene.camera.project(scene.shutter.to_camera(scene.stars.direction_eq[[star]]))[:, 0, 1]
    advance = (closes - opens) / exposure.duration_s * exposure.readout_s / (SMALL.height_px - 1)
    assert abs(advance) > 0.02
    assert fluxes[0] / full == pytest.approx(1 / (1 - advance), rel=FRACTION)
    assert fluxes[1] / full == pytest.approx(1 / (1 + advance), rel=FRACTION)


def test_a_readout_of_no_time_draws_the_same_pixels_as_a_global_shutter(renderer):
    simulator = turning("pitch", 10.0)
    exposure = Exposure(NIGHT_UTC_S + 0.4, 0.2, trail="analytic")
    drawn = [renderer.render(simulator.scene(replace(exposure, readout=r)), seed=3).pixels for r in ("down", "left")]
    assert np.array_equal(*drawn)


# Without a rolling shutter too; longer and shorter than the readout; narrow stars.
@pytest.mark.parametrize(
    ("name", "deg_per_s", "duration_s", "readout_s", "readout", "trail", "sigma_px"),
    [
        ("fisheye", 0.0, 0.05, 0.0, "down", "analytic", 1.2),
        ("barrel", 0.0, 0.05, 0.0, "down", "analytic", 0.7),
        ("barrel", 10.0, 0.05, 0.0, "down", "analytic", 1.2),
        ("pincushion", 60.0, 0.05, 0.0, "down", "analytic", 1.2),
        ("fisheye", 10.0, 0.2, READOUT_S, "down", "analytic", 1.2),
        ("barrel", 30.0, 0.05, READOUT_S, "left", "sprites", 1.2),
        ("fisheye", 60.0, 0.05, READOUT_S, "right", "analytic", 1.2),
        ("pincushion", 60.0, 0.02, READOUT_S, "up", "analytic", 0.7),
        ("fisheye", 150.0, 0.02, READOUT_S, "up", "analytic", 1.2),
        ("barrel", 150.0, 0.05, READOUT_S, "left", "analytic", 1.2),
        ("fisheye", 150.0, 0.02, READOUT_S, "up", "analytic", 0.7),
        ("barrel", 60.0, 0.2, READOUT_S, "down", "analytic", 0.4),
    ],
)
def test_behind_a_lens_the_rows_of_the_distorted_image_are_recorded(
    renderer, name, deg_per_s, duration_s, readout_s, readout, trail, sigma_px
):
    exposure = Exposure(NIGHT_UTC_S + 0.4, duration_s, 1000.0, trail, readout_s, readout)
    assert max(errors_behind_lens(renderer, name, deg_per_s, exposure, sigma_px)) <= FRACTION


def errors_behind_lens(
    renderer: GLRenderer, name: str, deg_per_s: float, exposure: Exposure, sigma_px: float
) -> tuple[float, float]:
    """Return the errors of the worst pixel and of the flux of a star behind a lens, as fractions."""
    turn = {"roll_rate_rad_per_s": np.deg2rad(deg_per_s)}
    simulator = sky_over_adelaide(camera_with(LENSES[name]), vmag_limit=5.0, refraction=False, **turn)
    simulator = replace(simulator, sensor=replace(BRIGHT, psf_sigma_px=sigma_px))
    scene = simulator.scene(exposure)
    star = most_of_the_time_on_the_image(scene, 3)[1]
    expected = rolling_light(simulator, exposure, int(star), 1000 + int(30 * deg_per_s))
    drawn = light(renderer, with_stars(scene, star))
    return np.abs(drawn - expected).max() / expected.max(), abs(drawn.sum() / expected.sum() - 1)


def test_softpipe_records_rows_as_precisely(renderer):
    """The same tests, of which a few are run in a process that draws with the other software driver of Mesa."""
    if "Mesa" not in renderer.driver:
        pytest.skip("the OpenGL driver is not Mesa's")
    chosen = "(straight and (150.0-up or 60.0-down)) or (vibration and 0.02) or (lens and fisheye-60)"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, "-k", chosen]
    environment = {**os.environ, "GALLIUM_DRIVER": "softpipe"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200, check=False)
    assert re.search(r"^4 passed", done.stdout, re.MULTILINE), done.stdout[-2000:] + done.stderr[-2000:]
