"""Analytic trails, against sums of 20 000 sub-exposures in float64."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.flight import AttitudeTrack, Flight, PositionTrack
from glstar.render.opengl import GLRenderer
from glstar.render.scene.culling import DrawList
from glstar.render.simulator import Simulator
from glstar.rotation import quaternion_from_euler
from tests.scripts.trail_search import analytic, differences, random_simulator, worst_pixel
from tests.support.reference import light_of
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, with_stars_at
from tests.support.trails import (
    BRIGHT,
    BRIGHT_STARS,
    LENS,
    demo_flight,
    light,
    most_of_the_time_on_the_image,
    vibrating,
    with_stars,
)

# No pixel may differ by more than this fraction of the brightest pixel of the star's own trail.
TRAIL_FRACTION = 2e-3
SUB_EXPOSURES = 20_000


def worst_fraction(
    renderer: GLRenderer, simulator: Simulator, start_s: float, duration_s: float, stars: int = 2
) -> float:
    """Return the largest difference of a pixel, as a fraction of the brightest of the same trail."""
    analytic = simulator.scene(Exposure(start_s, duration_s, trail="analytic"))
    fine = simulator.scene(Exposure(start_s, duration_s, SUB_EXPOSURES / duration_s, "sprites"))
    assert analytic.trails.time_fraction.sum() == pytest.approx(1.0)
    fractions = []
    for star in most_of_the_time_on_the_image(analytic, stars):
        expected = light_of(with_stars(fine, star))
        fractions.append(np.abs(light(renderer, with_stars(analytic, star)) - expected).max() / expected.max())
    return max(fractions)


def test_the_worst_second_of_a_flight_is_that_of_20000_sub_exposures(renderer):
    simulator, worst_s = demo_flight()
    assert worst_fraction(renderer, simulator, worst_s - 0.5, 1.0) <= TRAIL_FRACTION


@pytest.mark.parametrize("interpolation", ["slerp", "spline"])
def test_a_vibration_of_20_hz_is_that_of_20000_sub_exposures(renderer, interpolation):
    simulator = vibrating(20.0, 1.0, interpolation=interpolation)
    assert worst_fraction(renderer, simulator, NIGHT_UTC_S + 0.7, 0.5, stars=1) <= TRAIL_FRACTION


@pytest.mark.parametrize("axis", ["roll", "pitch", "yaw"])
def test_a_turn_of_200_deg_per_s_is_that_of_20000_sub_exposures(renderer, axis):
    turn = {f"{axis}_rate_rad_per_s": np.deg2rad(200.0)}
    simulator = replace(sky_over_adelaide(LENS, vmag_limit=4.0, **turn), sensor=BRIGHT)
    assert worst_fraction(renderer, simulator, NIGHT_UTC_S + 0.2, 0.5, stars=1) <= TRAIL_FRACTION


@pytest.mark.parametrize("seed", [14, 45, 69])
def test_no_pixel_of_a_frame_full_of_trails_is_drawn_twice_or_not_at_all(renderer, seed):
    """Frames on which version 0.1.0 drew a pixel twice or not at all; `poe search-trails` draws many more."""
    fraction, _, _ = worst_pixel(renderer, seed)
    assert fraction <= 0.01


def test_softpipe_draws_no_pixel_of_a_frame_full_of_trails_twice_or_not_at_all(renderer, tmp_path):
    """Frames on which it did, by up to 55 %, where the triangles of a quad shared the wrong diagonal."""
    if "Mesa" not in renderer.driver:
        pytest.skip("the OpenGL driver is not Mesa's")
    seeds, file = [18, 30, 42], tmp_path / "softpipe.npy"
    program = """
import sys
import numpy as np
from glstar.render.opengl import GLRenderer
from tests.scripts.trail_search import analytic, random_simulator
with GLRenderer.headless() as renderer:
    assert "softpipe" in renderer.driver
    np.save(sys.argv[1], [analytic(renderer, random_simulator(int(seed))[0]) for seed in sys.argv[2:]])
"""
    environment = {**os.environ, "GALLIUM_DRIVER": "softpipe"}
    subprocess.run([sys.executable, "-c", program, file, *map(str, seeds)], env=environment, timeout=200, check=True)
    for seed, on_softpipe in zip(seeds, np.load(file), strict=True):
        assert differences(on_softpipe, analytic(renderer, random_simulator(seed)[0])).max() <= 0.005


def test_a_star_that_passes_90_deg_from_the_boresight_leaves_no_flux(renderer):
    """A pinhole projects it to infinity then: its path is not a conic there, and no part of it is on the image."""
    simulator = replace(sky_over_adelaide(LENS, vmag_limit=6.5, roll_rate_rad_per_s=np.deg2rad(200.0)), sensor=BRIGHT)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.2, 0.5, trail="analytic"))
    cosine = scene.trails.pointing.boresight_eq @ scene.stars.direction_eq.T
    passing = (cosine.max(axis=0) < np.cos(np.deg2rad(50.0))) & (np.abs(cosine).min(axis=0) < np.sin(np.deg2rad(2.0)))
    stars = np.flatnonzero(passing).astype(np.int32)
    assert stars.size > 100
    assert light(renderer, replace(scene, draw_list=DrawList(stars, np.full(stars.size, 5.0)))).max() == 0.0


@pytest.mark.parametrize("deg_per_s", [0.0, 0.5, 3.0, 20.0])
@pytest.mark.parametrize(
    "sensor",
    [
        pytest.param(Sensor(psf_sigma_px=0.3), id="narrow"),
        pytest.param(Sensor(psf_sigma_px=0.5), id="erf"),
        pytest.param(Sensor(psf_sigma_px=0.9), id="widest of erf"),
        pytest.param(Sensor(psf_sigma_px=1.1), id="narrowest widened"),
        pytest.param(Sensor(pixel="sampled"), id="sampled"),
        pytest.param(Sensor(psf_sigma_px=3.0, bit_depth=16, reference_peak_dn=30000.0), id="wide"),
    ],
)
def test_every_point_spread_function_is_integrated_exactly(renderer, sensor, deg_per_s):
    simulator = sky_over_adelaide(camera(320, 240, 300.0), sensor=sensor, yaw_rate_rad_per_s=np.deg2rad(deg_per_s))
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 4, 0.5, trail="analytic"))
    for star in most_of_the_time_on_the_image(scene, 3):
        expected = light_of(with_stars(scene, star))
        assert np.abs(light(renderer, with_stars(scene, star)) - expected).max() <= TRAIL_FRACTION * expected.max()


@pytest.mark.parametrize(
    ("sigma_px", "step_deg", "seed"), [(0.35, 0.15, 0), (0.35, 0.15, 1), (0.6, 0.4, 4), (1.2, 0.4, 4)]
)
def test_a_random_walk_is_drawn_as_its_segments(renderer, sigma_px, step_deg, seed):
    """Hundreds of paths of all lengths, also of two sigma, on many of which the star comes to a stop."""
    random, t = np.random.default_rng(seed), np.arange(0.0, 1.5, 0.005)
    angles_rad = np.cumsum(random.normal(size=(t.size, 3)) * np.deg2rad(step_deg), axis=0)
    q = quaternion_from_euler(*angles_rad.T)
    track = AttitudeTrack.from_samples(NIGHT_UTC_S + t, q, interpolation="spline")
    sensor = replace(BRIGHT, psf_sigma_px=sigma_px)
    simulator = Simulator.of(Flight(track, PositionTrack.fixed(ADELAIDE)), BRIGHT_STARS, LENS, Mount(), sensor)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.3, 0.5, trail="analytic"))
    assert len(scene.trails) > 300
    star = with_stars(scene, most_of_the_time_on_the_image(scene, 1))
    expected = light_of(star)
    assert np.abs(light(renderer, star) - expected).max() <= TRAIL_FRACTION * expected.max()


@pytest.mark.parametrize("deg_per_s", [0.0, 20.0])
def test_the_trails_of_stars_beside_a_corner_extend_into_the_image(renderer, deg_per_s):
    """The star is farther from the boresight than any pixel of the image."""
    lens, wide = camera(), replace(BRIGHT, psf_sigma_px=3.0)
    rolling = sky_over_adelaide(lens, sensor=wide, refraction=False, yaw_rate_rad_per_s=np.deg2rad(deg_per_s))
    corners = np.array([[-4.0, -4.0], [323.0, -4.0], [-4.0, 243.0], [323.0, 243.0]])
    exposure = Exposure(NIGHT_UTC_S + 0.7, 0.5, trail="analytic")
    simulator = with_stars_at(rolling, corners, np.full(4, 2.0), exposure.mid_utc_s)

    drawn = light(renderer, simulator.scene(exposure))

    fine = light_of(simulator.scene(Exposure(NIGHT_UTC_S + 0.7, 0.5, 4000.0, "sprites")))
    for rows in (slice(0, 120), slice(120, 240)):
        for columns in (slice(0, 160), slice(160, 320)):
            expected = fine[rows, columns]
            assert expected.max() > 1000
            assert np.abs(drawn[rows, columns] - expected).max() <= 0.01 * expected.max()


def test_a_steady_turn_is_a_few_segments_and_a_vibration_many():
    steady = sky_over_adelaide(LENS, yaw_rate_rad_per_s=np.deg2rad(10.0))
    segments = [
        len(s.scene(Exposure(NIGHT_UTC_S + 0.7, 0.5, trail="analytic")).trails) for s in (steady, vibrating(20.0, 1.0))
    ]
    assert segments[0] == 1
    assert segments[1] >= 100


def test_a_fast_trail_has_no_sampling_ripple(renderer):
    """Along the middle of a trail the flux increases or decreases monotonically."""
    simulator = replace(sky_over_adelaide(LENS, pitch_rate_rad_per_s=np.deg2rad(150.0)), sensor=BRIGHT)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.2, 0.5, trail="analytic"))
    (star,) = most_of_the_time_on_the_image(scene, 1)
    drawn = light(renderer, with_stars(scene, star))
    along = drawn.sum(axis=int(np.ptp(np.argwhere(drawn > drawn.max() / 2), axis=0).argmin()))
    middle = along[40:-40]
    ripple = np.diff(middle, 2)
    assert np.abs(ripple).max() <= 2e-3 * middle.max()


def test_a_star_that_sets_during_the_exposure_is_drawn_until_then(renderer):
    """In an hour's exposure of the western horizon."""
    t = NIGHT_UTC_S + np.array([0.0, 3600.0])
    q = quaternion_from_euler(np.zeros(2), np.zeros(2), np.full(2, -np.pi / 2))
    track = AttitudeTrack.from_samples(t, q, max_gap_s=1e4)
    lens = camera(200, 150, 300.0)
    sky = sky_over_adelaide(lens).sky
    ahead = Mount(roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0)
    simulator = Simulator.of(Flight(track, PositionTrack.fixed(ADELAIDE)), sky, lens, ahead, BRIGHT)
    analytic = simulator.scene(Exposure(NIGHT_UTC_S, 3600.0, trail="analytic"))
    fine = simulator.scene(Exposure(NIGHT_UTC_S, 3600.0, 5000 / 3600, "sprites"))
    path = lens.project(analytic.trails.pointing.to_camera(analytic.stars.direction_eq[analytic.visible]))
    sets = analytic.visible[lens.contains(path[0], -10) & np.isnan(path[-1, :, 0])]
    assert sets.size > 0
    for star in sets[:2]:
        expected = light_of(with_stars(fine, star))
        assert np.abs(light(renderer, with_stars(analytic, star)) - expected).max() <= 2e-2 * expected.max()


def test_the_total_flux_equals_that_of_sub_exposures(renderer):
    for deg_per_s in (0.0, 2.0, 10.0, 60.0):
        simulator = sky_over_adelaide(camera(1014, 760, 967.7), roll_rad=-0.9, yaw_rate_rad_per_s=np.deg2rad(deg_per_s))
        analytic, sprites = (
            simulator.scene(Exposure(NIGHT_UTC_S + 0.2, 0.5, trail=trail)) for trail in ("analytic", "sprites")
        )
        # Trails that are below 0.02 DN everywhere are not drawn.
        assert light(renderer, analytic).sum() == pytest.approx(light(renderer, sprites).sum(), rel=5e-3)


@pytest.mark.parametrize("sigma_px", [0.35, 0.6, 1.2, 3.0])
@pytest.mark.parametrize("turning", ["10 deg/s", "60 deg/s", "200 deg/s", "20 Hz of 1 deg"])
def test_the_faintest_stars_of_a_fast_rotation_have_all_their_flux(renderer, sigma_px, turning):
    """Their trails are truncated at 1.5 sigma, and the flux outside is added to what is drawn."""
    wide, sensor = camera(1014, 760, 500.0), Sensor(psf_sigma_px=sigma_px)
    if turning.endswith("deg/s"):
        rate = {"roll_rad": -0.9, "yaw_rate_rad_per_s": np.deg2rad(float(turning.split()[0]))}
        simulator = sky_over_adelaide(wide, sensor=sensor, **rate)
    else:
        simulator = replace(vibrating(20.0, 1.0), camera=wide, sensor=sensor, stars=sky_over_adelaide(wide).stars)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.7, 0.2, trail="analytic"))
    drawn_stars = scene.draw_list.index
    xy = wide.project(scene.trails.pointing.to_camera(scene.stars.direction_eq[drawn_stars]))
    inside = drawn_stars[wide.contains(xy, -20.0).all(axis=0)]
    faint = inside[np.argsort(-scene.stars.camera_mag[inside])][:60]
    drawn = light(renderer, with_stars(scene, faint)).sum()
    assert drawn == pytest.approx(sensor.flux_dn(sensor.peak_dn(scene.stars.camera_mag[faint], 0.2)).sum(), rel=2e-3)


def test_many_stars_and_many_segments_take_several_calls(renderer, monkeypatch):
    simulator = vibrating(20.0, 0.5)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.7, 0.2, trail="analytic"))
    expected = light(renderer, scene)
    monkeypatch.setattr("glstar.render.opengl.passes.trail._STARS_PER_CALL", 7)
    monkeypatch.setattr("glstar.render.opengl.passes.trail._SEGMENTS_PER_CALL", 9)
    with GLRenderer(renderer.context) as other:
        np.testing.assert_allclose(light(other, scene), expected, rtol=0, atol=1e-6 * expected.max())
