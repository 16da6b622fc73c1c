"""How scenes are composed: sub-exposures, culling, mounts."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.config import Config
from glstar.errors import TrackRangeError
from glstar.flight import AttitudeTrack, PositionTrack
from glstar.render.motion.trailmodels import AnalyticSegments
from glstar.render.simulator import Simulator
from glstar.rotation import multiply, quaternion_from_euler
from glstar.sky.place.horizon import ned_direction, ned_to_azimuth_altitude_rad
from glstar.telemetry.synthetic import ScriptedFlight
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, star_field, with_stars_at

ARCSEC = np.pi / 648000
EXPOSURE = Exposure(NIGHT_UTC_S + 4, 0.5)
IN_SPRITES = replace(EXPOSURE, trail="sprites")


def test_a_still_camera_takes_200_sub_exposures_a_second():
    assert len(sky_over_adelaide(camera()).scene(IN_SPRITES).trails.pointing) == 100


@pytest.mark.parametrize("deg_per_s", [60.0, 200.0])
def test_a_fast_one_takes_enough_to_avoid_sampling_ripple(deg_per_s):
    """n = ceil(longest trail / 1.5 sigma); for a rolling aircraft the longest trail crosses the corner of the image."""
    lens = camera(1014, 760, 967.7425)
    scene = sky_over_adelaide(lens, roll_rate_rad_per_s=np.deg2rad(deg_per_s)).scene(IN_SPRITES)
    middle_trail_px = lens.fx_px * np.deg2rad(deg_per_s) * 0.5
    fastest_px = middle_trail_px / np.cos(lens.field_radius_rad) ** 2
    n = len(scene.trails.pointing)
    assert middle_trail_px / (1.5 * 1.2) <= n <= fastest_px / (1.5 * 1.2) + 1


@pytest.mark.parametrize(("tremble_deg", "sigma_px"), [(0.0, 1.05), (0.1, 1.2), (0.1, 1.05), (0.1, 0.4)])
def test_trails_are_analytic_however_rough_the_log_and_narrow_the_stars(tremble_deg, sigma_px):
    """Noise of a tenth of a degree at 200 Hz requires a segment every few samples."""
    steady = sky_over_adelaide(camera(1014, 760, 967.7425), roll_rate_rad_per_s=np.deg2rad(10.0))
    track = steady.flight.attitude
    tremble_rad = np.deg2rad(tremble_deg) * np.random.default_rng(5).standard_normal((3, track.utc_s.size))
    q_body_ned = multiply(quaternion_from_euler(*tremble_rad), track.q_body_ned)
    rough = AttitudeTrack.from_samples(track.utc_s, q_body_ned)
    simulator = replace(
        steady.with_flight(replace(steady.flight, attitude=rough)),
        sensor=replace(steady.sensor, psf_sigma_px=sigma_px),
    )

    scene = simulator.scene(EXPOSURE)

    assert EXPOSURE.trail == "auto"
    assert scene.exposure == replace(EXPOSURE, trail="analytic")
    assert isinstance(scene.trails, AnalyticSegments)


def test_an_exposure_outside_the_flight_is_refused():
    with pytest.raises(TrackRangeError, match="after it ends"):
        sky_over_adelaide(camera()).scene(Exposure(NIGHT_UTC_S + 9.8, 0.5))


@pytest.mark.parametrize("rates", [{}, {"yaw_rate_rad_per_s": 1.0}, {"pitch_rate_rad_per_s": 2.5}])
def test_no_star_that_touches_the_image_is_culled(rates):
    simulator = sky_over_adelaide(camera(), **rates)
    scene = simulator.scene(EXPOSURE)
    xy = simulator.camera.project(scene.trails.pointing.to_camera(simulator.stars.direction_eq))
    radius_px = simulator.sensor.truncation_radius_px(simulator.sensor.peak_dn(simulator.stars.vmag, 0.5))
    touching = np.flatnonzero(simulator.camera.contains(xy, radius_px).any(axis=0))
    assert set(touching) <= set(scene.visible)
    assert len(scene.visible) < 1.5 * len(touching) + 20


@pytest.mark.parametrize("trail", ["analytic", "sprites"])
@pytest.mark.parametrize("axis", ["roll", "pitch", "yaw"])
def test_no_star_that_grazes_a_corner_between_two_samples_is_culled(trail, axis):
    """At 200 deg/s a star may be on the image only between two samples."""
    lens, narrow = camera(), Sensor(psf_sigma_px=0.35)
    simulator = sky_over_adelaide(lens, sensor=narrow, **{f"{axis}_rate_rad_per_s": np.deg2rad(200.0)})
    random = np.random.default_rng(3)
    beside_px = random.uniform(0.0, 1.0, (200, 2))
    corners_px = np.where(random.random((200, 2)) < 0.5, beside_px, [319, 239] - beside_px)
    exposure = Exposure(NIGHT_UTC_S + 1.6, 0.5, trail=trail)  # from -40 to 60 deg
    pointing = simulator.pointing(exposure.start_utc_s + random.uniform(0.01, 0.49, 200))
    rays = lens.unit_vectors(corners_px)
    stars = star_field(np.einsum("nij,ni->nj", pointing.C_camera_eq, rays) - pointing.velocity_eq, np.full(200, 2.0))
    still_air = replace(simulator, stars=stars, sky=replace(simulator.sky, refraction=False))

    scene = still_air.scene(exposure)

    up = np.flatnonzero(np.sum(stars.direction_eq * pointing.zenith_eq, axis=1) > 0.05)
    assert up.size > 100
    assert set(up) <= set(scene.visible)


def test_the_paper_s_mount_points_to_the_zenith_of_a_level_aircraft():
    simulator = sky_over_adelaide(camera(), yaw_rad=0.3)
    pointing = simulator.pointing(np.array([NIGHT_UTC_S + 1]))
    np.testing.assert_allclose(pointing.boresight_eq, pointing.zenith_eq, rtol=0, atol=1e-12)
    C_ned_eq = simulator.sky.C_ned_eq([NIGHT_UTC_S + 1], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
    right, down = pointing.C_camera_eq[0, :2] @ C_ned_eq.T
    np.testing.assert_allclose(right, ned_direction(0.3, 0.0), rtol=0, atol=1e-12)  # forward
    np.testing.assert_allclose(down, ned_direction(0.3 - np.pi / 2, 0.0), rtol=0, atol=1e-12)  # the left wing


def test_the_literal_reading_points_along_the_left_wing():
    simulator = sky_over_adelaide(camera(), mount=Mount(reading="literal"))
    pointing = simulator.pointing(np.array([NIGHT_UTC_S + 1]))
    C_ned_eq = simulator.sky.C_ned_eq([NIGHT_UTC_S + 1], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
    np.testing.assert_allclose(C_ned_eq @ pointing.boresight_eq[0], [0.0, -1.0, 0.0], rtol=0, atol=1e-12)


def test_the_sky_turns_during_the_exposure():
    """7.5" in half a second at the celestial equator, which the paper's 1 Hz update leaves out."""
    pointing = sky_over_adelaide(camera()).scene(EXPOSURE).trails.pointing
    turned = np.arccos(np.clip(pointing.zenith_eq[0] @ pointing.zenith_eq[-1], -1, 1))
    expected = np.deg2rad(15.041 / 3600) * 0.5 * np.cos(ADELAIDE.latitude_rad)
    assert turned == pytest.approx(expected, rel=1e-3)


def test_several_arrays_of_times_in_one_call_have_the_same_result_as_one_by_one():
    simulator = sky_over_adelaide(camera(), yaw_rate_rad_per_s=1.0)
    sets = [EXPOSURE.sub_utc_s(n) for n in (7, 1, 64)]
    for together, times_s in zip(simulator.motion.pointings(*sets), sets, strict=True):
        single = simulator.pointing(times_s)
        for what in ("C_camera_eq", "zenith_eq", "velocity_eq", "refraction_scale"):
            np.testing.assert_allclose(getattr(together, what), getattr(single, what), rtol=0, atol=1e-11)


def test_the_truncation_radius_grows_with_brightness():
    scene = sky_over_adelaide(camera(1014, 760, 967.7)).scene(EXPOSURE)
    order = np.argsort(scene.stars.vmag[scene.visible])
    assert (np.diff(scene.draw_list.truncation_radius_px[order]) <= 1e-9).all()
    assert scene.draw_list.truncation_radius_px.min() >= 3.5 * Sensor().effective_sigma_px


def test_a_star_that_rises_or_sets_is_truncated_like_a_trail():
    """Not like a star that does not move: it leaves no flux while it is hidden."""
    simulator = sky_over_adelaide(camera(), roll_rate_rad_per_s=np.deg2rad(200.0))
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 0.2, 0.5, trail="analytic"))
    path = scene.camera.project(scene.trails.pointing.to_camera(scene.stars.direction_eq[scene.visible]))
    sometimes_hidden = np.isnan(path[..., 0]).any(axis=0)
    peak_dn = scene.sensor.peak_dn(scene.stars.camera_mag[scene.visible], 0.5)

    assert sometimes_hidden.sum() > 20
    assert (scene.draw_list.truncation_radius_px < scene.sensor.truncation_radius_px(peak_dn, renormalized=True))[
        sometimes_hidden
    ].all()


def test_a_thirty_second_exposure_of_all_stars_stays_within_memory():
    import tracemalloc  # noqa: PLC0415

    simulator = sky_over_adelaide(camera(1014, 760, 967.7))
    tracemalloc.start()
    simulator.scene(Exposure(NIGHT_UTC_S + 1, 8.0, rate_hz=800.0))
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 100e6


def test_a_star_that_leaves_the_image_fast_does_not_require_millions_of_sub_exposures():
    """2000 deg/s: 10 deg between two samples, after which a star at the border is projected far outside the image."""
    lens = camera(1014, 760, 967.7425)
    n = len(sky_over_adelaide(lens, roll_rate_rad_per_s=np.deg2rad(2000)).scene(EXPOSURE).trails.pointing)
    assert n <= lens.fx_px * np.deg2rad(1000) / np.cos(lens.field_radius_rad) ** 2 / (1.5 * 1.2) + 1


def test_vibration_faster_than_the_sub_exposures_is_not_missed():
    """One degree at 20 Hz, with 20 sub-exposures per second: all of them fall on the same phase."""
    flight = ScriptedFlight(
        lambda t: quaternion_from_euler(np.deg2rad(1) * np.sin(2 * np.pi * 20 * t), 0 * t, 0 * t),
        ADELAIDE,
        NIGHT_UTC_S,
        duration_s=3.0,
        rate_hz=400.0,
    ).flight()
    still = sky_over_adelaide(camera())
    simulator = Simulator.of(flight, still.sky, still.camera, still.mount, still.sensor)
    exposure = Exposure(NIGHT_UTC_S + 1, 1.0, rate_hz=20.0)
    fastest_px_per_s = 300 * np.deg2rad(1) * 2 * np.pi * 20
    assert len(simulator.scene(exposure).trails.pointing) >= fastest_px_per_s / (1.5 * 1.2)


def test_another_camera_sensor_or_air_uses_the_same_star_field():
    simulator = sky_over_adelaide(camera())
    other = replace(simulator, camera=camera(100, 80), sensor=Sensor(bit_depth=16), mount=Mount(), pressure_hpa=900.0)
    assert other.stars is simulator.stars
    assert other.scene(EXPOSURE).camera.width_px == 100


THIN_COLD_AIR = {"pressure_hpa": 505.0, "temperature_c": -20.0}


def eq_25_times_eq_28_rad(altitude_rad: np.ndarray, pressure_hpa: float, temperature_c: float) -> np.ndarray:
    """Return the refraction of true altitudes as the paper prints it, with the constant that is zero at the zenith."""
    degrees = np.rad2deg(altitude_rad)
    standard_arcmin = 1.02 / np.tan(np.deg2rad(degrees + 10.3 / (degrees + 5.11))) + 0.0019279
    return np.deg2rad(standard_arcmin / 60) * pressure_hpa / 1010 * 283 / (273 + temperature_c)


def test_stars_are_refracted_by_the_air_at_the_aircraft():
    """Half the pressure of sea level and 30 degrees less: at 20 degrees of altitude 89" instead of 158"."""
    simulator = replace(sky_over_adelaide(camera(), roll_rad=1.0), **THIN_COLD_AIR)
    scene = simulator.scene(EXPOSURE)
    pointing = scene.shutter[1:2]
    C_ned_eq = simulator.sky.C_ned_eq([EXPOSURE.mid_utc_s], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
    directions = scene.stars.direction_eq[scene.visible]

    _, true_rad = ned_to_azimuth_altitude_rad((directions + pointing.velocity_eq[0]) @ C_ned_eq.T)
    drawn_ned = pointing.to_camera(directions)[0] @ pointing.C_camera_eq[0] @ C_ned_eq.T
    _, drawn_rad = ned_to_azimuth_altitude_rad(drawn_ned)

    seen = np.isfinite(drawn_rad) & (true_rad > 0)
    assert seen.sum() > 20
    assert true_rad[seen].min() < np.deg2rad(25)
    expected_rad = eq_25_times_eq_28_rad(true_rad[seen], **THIN_COLD_AIR)
    np.testing.assert_allclose((drawn_rad - true_rad)[seen], expected_rad, rtol=0, atol=0.05 * ARCSEC)
    assert scene.site.pressure_hpa == 505.0


def test_the_air_of_the_config_is_the_simulators():
    flight = sky_over_adelaide(camera()).flight
    config = Config().override(**{f"air.{key}": value for key, value in THIN_COLD_AIR.items()})

    scene = config.simulator(flight).scene(EXPOSURE)

    assert scene.trails.pointing.refraction_scale == pytest.approx(505 / 1010 * 283 / 253, rel=1e-12)
    without = config.override(**{"sky.refraction": False}).simulator(flight).scene(EXPOSURE)
    assert without.trails.pointing.refraction_scale == 0.0


def test_diurnal_aberration_is_towards_the_east():
    """0.32" cos(latitude) of diurnal aberration, towards the east point."""
    pointing = sky_over_adelaide(camera()).pointing(np.array([NIGHT_UTC_S + 1]))
    C_ned_eq = sky_over_adelaide(camera()).sky.C_ned_eq(
        [NIGHT_UTC_S + 1], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad
    )[0]

    north, east, down = C_ned_eq @ pointing.velocity_eq[0] / ARCSEC

    assert east == pytest.approx(0.3200 * np.cos(ADELAIDE.latitude_rad), abs=0.001)
    assert (north, down) == (pytest.approx(0, abs=1e-9), pytest.approx(0, abs=1e-9))


@pytest.mark.parametrize("trail", ["analytic", "sprites"])
@pytest.mark.parametrize("sigma_px", [0.5, 1.2, 3.0])
def test_stars_outside_the_border_are_drawn_up_to_their_truncation_radius(trail, sigma_px):
    lens, sensor = camera(), Sensor(psf_sigma_px=sigma_px)
    peak_dn = float(sensor.peak_dn(1.0, EXPOSURE.duration_s))
    radius_px = float(sensor.truncation_radius_px(peak_dn, renormalized=trail == "analytic"))
    beyond_px = np.array([0.5, 3.0, radius_px - 0.2, radius_px + 3.0])
    corner = np.array([lens.width_px - 0.5, lens.height_px - 0.5])
    xy_px = np.concatenate(
        [
            np.column_stack([-0.5 - beyond_px, np.full(4, 60.0)]),
            np.column_stack([corner[0] + beyond_px, np.full(4, 90.0)]),
            np.column_stack([np.full(4, 120.0), -0.5 - beyond_px]),
            np.column_stack([np.full(4, 150.0), corner[1] + beyond_px]),
        ]
    )
    still = sky_over_adelaide(lens, sensor=sensor, refraction=False)
    simulator = with_stars_at(still, xy_px, np.full(16, 1.0), EXPOSURE.mid_utc_s)

    visible = simulator.scene(replace(EXPOSURE, trail=trail)).visible

    seen = np.isin(np.arange(16), visible).reshape(4, 4)
    assert seen[:, :3].all()
    assert not seen[:, 3].any()


def test_the_site_is_the_position_in_the_middle_of_the_exposure():
    """At 300 m/s due north, over two seconds."""
    still = sky_over_adelaide(camera())
    t_s = np.array([0.0, 10.0])
    track = PositionTrack(
        NIGHT_UTC_S + t_s, ADELAIDE.latitude_rad + 300.0 * t_s / 6.371e6, np.full(2, 2.4), np.array([50.0, 60.0])
    )
    scene = replace(still, flight=replace(still.flight, position=track)).scene(Exposure(NIGHT_UTC_S + 4, 2.0))

    assert scene.site.latitude_rad == pytest.approx(ADELAIDE.latitude_rad + 1500.0 / 6.371e6, abs=1e-3 / 6.371e6)
    assert scene.site.height_m == pytest.approx(55.0, abs=1e-6)
    moved_rad = np.arccos(np.clip(scene.shutter.zenith_eq[0] @ scene.shutter.zenith_eq[2], -1, 1))
    sky_turned_rad = np.deg2rad(15.041 / 3600) * 2.0 * np.cos(ADELAIDE.latitude_rad)
    assert moved_rad == pytest.approx(np.hypot(600.0 / 6.371e6, sky_turned_rad), rel=1e-3)


def test_drawn_positions_follow_the_motion_at_any_time():
    simulator = sky_over_adelaide(camera(), roll_rate_rad_per_s=np.deg2rad(100.0))
    scene = simulator.scene(EXPOSURE)
    time = np.linspace(0.0, 1.0, 41)
    directions = scene.stars.direction_eq[scene.visible]
    pointing = simulator.pointing(EXPOSURE.start_utc_s + time * EXPOSURE.duration_s)
    expected = simulator.camera.project(pointing.to_camera(directions))
    on_image = simulator.camera.contains(expected)
    drawn = scene.positions(directions, time)
    assert on_image.sum() > 1000
    assert np.linalg.norm(drawn - expected, axis=-1)[on_image].max() <= 0.03
