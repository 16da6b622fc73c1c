"""Sun, Moon and ground of scenes against the bodies of the ephemeris, and what is said about them."""

from dataclasses import replace

import numpy as np
import pytest

from glstar.camera.exposure import Exposure
from glstar.errors import RenderError
from glstar.render.effects import cloud
from glstar.render.truth.conditions import conditions_report, viewing_conditions
from glstar.sky.observed.solarsystem import observed_bodies
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry.synthetic import ScriptedFlight
from tests.support.scenes import ADELAIDE, NIGHT_UTC_S, camera, sky_over_adelaide

LENS = camera(320, 240, 300.0)


def scene_at(utc: str, **attitude: float):
    """Return the scene of half a second over Adelaide."""
    start_s = parse_utc(utc)
    flight = ScriptedFlight.steady(ADELAIDE, start_s - 2.0, duration_s=10.0, **attitude).flight()
    return replace(sky_over_adelaide(LENS), flight=flight).scene(Exposure(start_s, 0.5))


@pytest.mark.parametrize("utc", ["2024-03-18T09:00:29Z", "2024-03-18T13:45:00Z", "2024-06-21T03:10:59Z"])
def test_the_sun_and_the_moon_are_those_of_the_ephemeris(utc: str) -> None:
    scene = scene_at(utc, roll_rad=0.4, pitch_rad=0.2, yaw_rad=1.0)
    sun, moon = observed_bodies(scene.observing_sky, scene.exposure.mid_utc_s, scene.site, ("Sun", "Moon"))
    # The axis in north, east, down, from the attitude and the mount instead of from the sky's matrices.
    axis_ned = (
        scene.observing_sky.C_ned_eq([scene.exposure.mid_utc_s], scene.site.latitude_rad, scene.site.longitude_rad)[0]
        @ scene.shutter.boresight_eq[1]
    )
    moon_ned = [
        np.cos(moon.altitude_rad) * np.cos(moon.azimuth_rad),
        np.cos(moon.altitude_rad) * np.sin(moon.azimuth_rad),
        -np.sin(moon.altitude_rad),
    ]

    found = viewing_conditions(scene)

    assert found.sun_altitude_rad == pytest.approx(sun.altitude_rad, abs=np.deg2rad(0.02))
    assert found.moon_altitude_rad == pytest.approx(moon.apparent_altitude_rad, abs=np.deg2rad(0.02))
    assert found.moon_illuminated_fraction == pytest.approx(moon.illuminated_fraction, abs=1e-4)
    assert found.moon_separation_rad == pytest.approx(np.arccos(axis_ned @ moon_ned), abs=np.deg2rad(0.02))
    assert found.axis_altitude_rad == pytest.approx(np.arcsin(-axis_ned[2]), abs=np.deg2rad(0.01))


def test_the_sky_is_sampled_evenly_over_the_image() -> None:
    x_px, y_px = np.moveaxis(LENS.project(cloud._rays(LENS)).reshape(37, 49, 2), -1, 0)
    # The middles of 49 parts of 320 columns and of 37 parts of 240 rows; the first pixel begins at -0.5.
    for position_px, side_px, count in ((x_px, 320, 49), (y_px.T, 240, 37)):
        edges_px = np.linspace(-0.5, side_px - 0.5, count + 1)
        middles_px = np.broadcast_to((edges_px[1:] + edges_px[:-1]) / 2, position_px.shape)
        np.testing.assert_allclose(position_px, middles_px, rtol=0, atol=1e-9)


def test_one_line_says_the_light_the_sun_and_the_moon() -> None:
    scene = scene_at("2024-03-18T09:30:00Z")
    sun, moon = observed_bodies(scene.observing_sky, scene.exposure.mid_utc_s, scene.site, ("Sun", "Moon"))
    altitudes = f"Sun {np.rad2deg(sun.altitude_rad):.0f} deg, Moon {np.rad2deg(moon.apparent_altitude_rad):.0f} deg"
    report = conditions_report(scene)
    assert report.startswith(f"nautical twilight: {altitudes}, {moon.illuminated_fraction:.0%} lit, ")
    assert " deg from the axis; limit V 6." in report
    # A Moon below the horizon has neither.
    by_night = conditions_report(scene_at("2024-03-10T11:00:00Z"))
    assert by_night.startswith("night: Sun -23 deg, Moon -20 deg; limit V ")
    assert conditions_report(scene_at("2024-03-18T09:05:00Z")).endswith("deg below the horizon")


def test_day_and_ground_are_warned_of() -> None:
    assert viewing_conditions(scene_at("2024-03-18T03:00:00Z")).warning == "day: the Sun is 56 deg up"
    assert viewing_conditions(scene_at("2024-03-18T09:05:00Z")).warning.startswith(
        "bright twilight: the Sun is 2.0 deg below"
    )
    assert viewing_conditions(scene_at("2024-03-10T11:00:00Z")).warning == ""
    # The camera of the default mount points up: rolled by 100 deg it points 10 deg below the horizon.
    tilted = viewing_conditions(scene_at("2024-03-10T11:00:00Z", roll_rad=np.deg2rad(100)))
    assert tilted.warning == "the camera points at the ground, 10 deg below the horizon (zenith mount)"
    over = viewing_conditions(scene_at("2024-03-10T11:00:00Z", roll_rad=np.pi))
    assert over.warning == "the camera sees only the ground (zenith mount): [mount] says how it is mounted"


def test_a_scene_without_a_sky_is_refused() -> None:
    scene = sky_over_adelaide(LENS).scene(Exposure(NIGHT_UTC_S + 4.0, 0.5))
    with pytest.raises(RenderError, match="knows where they are"):
        viewing_conditions(replace(scene, observing_sky=None))
