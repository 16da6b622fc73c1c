"""A horizon profile: stars, trails, truth, ground and masks behind it, against closed forms and loops in float64."""

import json
from dataclasses import replace
from itertools import pairwise
from math import atan2, cos, degrees, pi, radians, sin

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from glstar.camera.exposure import Exposure
from glstar.camera.model import Mount
from glstar.camera.sensor.sensor import Sensor
from glstar.cli import app
from glstar.export.imagefiles.masks import ground_mask
from glstar.render.truth.conditions import viewing_conditions
from glstar.render.truth.frame import frame_truth
from glstar.sky.place.horizon import HorizonProfile, ned_direction
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide, star_field

SIDEREAL = 2 * pi * 1.00273790935 / 86400


def profile_of(azimuths_deg, altitudes_deg):
    return HorizonProfile(*(tuple(np.deg2rad(values).tolist()) for values in (azimuths_deg, altitudes_deg)))


# A cliff of 20 deg west of azimuth 280 deg, and 8 deg elsewhere.
CLIFF = profile_of((270.0, 279.999, 280.001, 290.0), (20.0, 20.0, 8.0, 8.0))
SENSOR = Sensor(psf_sigma_px=1.5, bit_depth=16, reference_peak_dn=3e4)
SEEN = camera(320, 240, 500.0)


def simulator_of(profile, stars_deg=((280.0, 14.0),), *, seen=SEEN, sensor=SENSOR, duration_s=120.0, roll_rad=0.0):
    """Return a camera towards the west, 14 deg up, with stars at azimuths and altitudes in the middle of the flight."""
    base = sky_over_adelaide(
        seen,
        sensor=sensor,
        mount=Mount(yaw_rad=0.0, pitch_rad=radians(14.0), roll_rad=roll_rad),
        duration_s=duration_s,
        refraction=False,
        yaw_rad=radians(280.0),
    )
    base = replace(base, sky=replace(base.sky, profile=profile))
    middle_s = NIGHT_UTC_S + duration_s / 2
    C = base.sky.C_ned_eq([middle_s], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
    azimuth, altitude = np.deg2rad(np.array(stars_deg)).T
    return replace(base, stars=star_field(ned_direction(azimuth, altitude) @ C, np.full(len(altitude), 7.0)))


def set_after_s(azimuth_deg, altitude_deg, horizon_deg):
    """Return when a star sets that has an azimuth and an altitude at 0 s, by spherical trigonometry."""
    a, h, phi = radians(azimuth_deg), radians(altitude_deg), ADELAIDE.latitude_rad
    sin_dec = sin(h) * sin(phi) + cos(h) * cos(phi) * cos(a)
    cos_dec = (1 - sin_dec**2) ** 0.5
    hour = atan2(-sin(a) * cos(h), sin(h) * cos(phi) - cos(h) * sin(phi) * cos(a))
    setting = np.arccos((sin(radians(horizon_deg)) - sin(phi) * sin_dec) / (cos(phi) * cos_dec))
    return (setting - hour) / SIDEREAL


@pytest.mark.parametrize(("trail", "stack"), [("analytic", False), ("sprites", False), ("analytic", True)])
def test_a_trail_ends_where_the_star_sets(renderer, trail, stack):
    simulator = simulator_of(CLIFF, [(285.0, 8.05), (285.0, 17.0), (275.0, 19.0)])
    frames = {"frames": 2, "gap_s": 0.0} if stack else {}
    exposure = Exposure(NIGHT_UTC_S + 10.0, 50.0 if stack else 100.0, trail=trail, stack="mean", **frames)
    scene = simulator.scene(exposure)
    frame = renderer.render(scene, seed=0, light=True)
    free = renderer.render(
        replace(simulator, sky=replace(simulator.sky, profile=None)).scene(exposure), seed=0, light=True
    )

    up = (50.0 + set_after_s(285.0, 8.05, 8.0)) / 100.0
    assert 0.55 < up < 0.75
    # Half of the image has one star each: those of the right half, and the one behind the cliff.
    low = slice(145, 240)
    drawn, whole = (float(one.light_dn[low, 160:].sum(dtype=np.float64)) for one in (frame, free))
    np.testing.assert_allclose(drawn / whole, up, rtol=0, atol=0.004)
    assert frame.light_dn[:, :140].max() == 0
    assert free.light_dn[:, :140].max() > 100
    truth = {star["star_id"]: star for star in json.loads(frame_truth(scene, frame, number=0, file="a"))["stars"]}
    assert sorted(truth) == [1, 2]
    assert truth[2]["in_frame"] == 1.0
    np.testing.assert_allclose(truth[1]["in_frame"], up, rtol=0, atol=0.02)
    assert truth[1]["end"] is None
    columns = np.arange(160, 320)
    light = frame.light_dn[low, 160:].sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(truth[1]["centroid_x_px"], light @ columns / light.sum(), rtol=0, atol=0.06)


def test_what_is_above_the_profile_is_found_by_loops_over_azimuths():
    rng = np.random.default_rng(5)
    points = np.sort(rng.uniform(0, 360, 40)), rng.uniform(-3, 60, 40)
    profile = profile_of(*points)
    simulator = simulator_of(profile)
    pointing = simulator.pointing(np.array([NIGHT_UTC_S, NIGHT_UTC_S + 100.0]))
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    is_seen = np.isfinite(pointing.to_camera(directions)[..., 0])
    alone = np.stack([pointing[k : k + 1].each_to_camera(d[np.newaxis])[0] for k in (0, 1) for d in directions])
    np.testing.assert_array_equal(np.isfinite(alone[:, 0]).reshape(2, 400), is_seen)

    around = [(points[0][-1] - 360, points[1][-1]), *zip(*points, strict=True), (points[0][0] + 360, points[1][0])]
    for k, time_s in enumerate((NIGHT_UTC_S, NIGHT_UTC_S + 100.0)):
        C = simulator.sky.C_ned_eq([time_s], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
        for north, east, down in directions @ C.T:
            azimuth, altitude = degrees(atan2(east, north)) % 360, degrees(np.arcsin(-down))
            (x0, y0), (x1, y1) = next((a, b) for a, b in pairwise(around) if b[0] >= azimuth)
            horizon = y0 + (y1 - y0) * (azimuth - x0) / (x1 - x0)
            if abs(altitude - horizon) > 1e-3:
                assert is_seen[k, 0] == (altitude > horizon)
            is_seen[k] = np.roll(is_seen[k], -1)


@pytest.mark.parametrize("roll_rad", [0.0, 0.4])
def test_ground_and_mask_are_below_the_profile(renderer, roll_rad):
    azimuth = np.arange(0.0, 360.0, 1.5)
    altitude = 12 + 4 * np.sin(np.deg2rad(9 * azimuth)) + np.abs(azimuth % 9 - 4.5)
    profile = profile_of(azimuth, altitude)
    sensor = replace(SENSOR, effects={"sky.brightness": "natural", "sky.ground_fraction": 0.01}, sky_std_dn=0.0)
    simulator = simulator_of(profile, sensor=sensor, roll_rad=roll_rad)
    scene = simulator.scene(Exposure(NIGHT_UTC_S + 60.0, 0.5))
    pixels = renderer.render(scene, seed=0).pixels.astype(float)
    mask = ground_mask(scene)

    C = simulator.sky.C_ned_eq([NIGHT_UTC_S + 60.25], ADELAIDE.latitude_rad, ADELAIDE.longitude_rad)[0]
    in_ned = (
        SEEN.unit_vectors(np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1)) @ scene.shutter.C_camera_eq[1]
    )
    in_ned = in_ned @ C.T
    towards = np.rad2deg(np.arctan2(in_ned[..., 1], in_ned[..., 0])) % 360
    height = np.rad2deg(np.arcsin(-in_ned[..., 2])) - np.interp(towards, azimuth, altitude, period=360)
    clear = np.abs(height) > 0.4  # 3 px: straight lines between nodes cut the corners of the profile
    assert clear.mean() > 0.9
    np.testing.assert_array_equal((mask == 255)[clear], height[clear] < 0)
    sky = np.median(pixels[height > 1])
    assert sky > 100
    np.testing.assert_array_equal((pixels < sky / 2)[clear], height[clear] < 0)
    truth = json.loads(frame_truth(scene, renderer.render(scene, seed=0), number=0, file="a"))
    np.testing.assert_allclose(truth["sky_fraction"], (height > 0).mean(), rtol=0, atol=0.01)


def test_the_altitude_of_the_axis_is_above_the_ridge_and_a_wall_is_ground():
    exposure = Exposure(NIGHT_UTC_S + 60.0, 0.5)
    level = profile_of((0.0, 180.0), (10.0, 10.0))
    conditions = viewing_conditions(simulator_of(level).scene(exposure))
    np.testing.assert_allclose(degrees(conditions.axis_altitude_rad), 4.0, rtol=0, atol=0.01)
    assert not conditions.sees_only_ground
    wall = viewing_conditions(simulator_of(profile_of((0.0, 180.0), (45.0, 45.0))).scene(exposure))
    assert wall.sees_only_ground


def test_an_export_writes_the_mask_of_the_ground(tmp_path):
    (tmp_path / "hill.csv").write_text("azimuth_deg,altitude_deg\n0,20\n180,20\n", encoding="utf-8")
    (tmp_path / "c.toml").write_text(
        '[sky]\nhorizon = "hill.csv"\n[mount]\nyaw_deg = 0.0\npitch_deg = 20.0\n', encoding="utf-8"
    )
    flight = (
        "fly:still?latitude_deg=-34.93&longitude_deg=138.60&heading_deg=325&utc_start=2024-03-18T12:00:00Z&duration_s=5"
    )
    arguments = [
        "export",
        flight,
        "-c",
        str(tmp_path / "c.toml"),
        "-o",
        str(tmp_path / "out"),
        "--masks",
        "--every",
        "9",
    ]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0, outcome.output
    verified = CliRunner().invoke(app, [*arguments, "--verify"])
    assert verified.exit_code == 0, verified.output
    mask = cv2.imread(str(tmp_path / "out" / "frame_000000.ground.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose((mask == 255).mean(), 0.5, rtol=0, atol=0.03)
    line = json.loads((tmp_path / "out" / "truth.jsonl").read_text(encoding="utf-8").splitlines()[0])
    rows = [star["y_px"] for star in line["stars"] if star["y_px"] is not None]
    assert 0 < max(rows) < 400


def test_a_star_behind_cloud_and_a_ridge_is_dimmed_once_and_cut(renderer):
    cloud = {"coverage": 1.0, "optical_depth": 1.0, "height_m": 3000.0, "wind_m_s": 0.0}
    sensor = replace(SENSOR, effects={f"cloud.{name}": value for name, value in cloud.items()})
    stars, exposure = [(285.0, 8.02), (275.0, 14.0)], Exposure(NIGHT_UTC_S + 40.0, 40.0)
    level = profile_of((0.0, 180.0), (8.0, 8.0))
    light = [
        renderer.render(simulator_of(profile, stars, sensor=sensor).scene(exposure), seed=0, light=True).light_dn
        for profile in (level, None)
    ]

    up = (20.0 + set_after_s(285.0, 8.02, 8.0)) / 40.0
    cut, whole = (one[150:, 160:].sum(dtype=np.float64) for one in light)
    np.testing.assert_allclose(cut / whole, up, rtol=0, atol=0.01)
    np.testing.assert_allclose(light[0][:, :140], light[1][:, :140], rtol=0, atol=2e-3 * light[1][:, :140].max())
