"""The state of the aircraft against closed forms, and the artificial horizon and the map in the window."""

from math import radians

import numpy as np
import pytest
from imgui_bundle import imgui

from glstar.config import Config
from glstar.sky.place.site import Site, north_east_down_m
from glstar.viewer.flight.map import aircraft_state, ground_track_m
from tests.support.windowinput import press, screen
from tests.viewer.conftest import write_flight

HEAD = "utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
START_S = 1710068400.0


def _write(path, *, roll_deg=0.0, pitch_deg=0.0, yaw_deg=0.0, north_deg_per_s=0.0, east_deg_per_s=0.0, climb=0.0):
    rows = [
        f"{START_S + t:.2f},{roll_deg},{pitch_deg},{yaw_deg},"
        f"{-34.93 + north_deg_per_s * t:.9f},{138.6 + east_deg_per_s * t:.9f},{300 + climb * t:.3f}"
        for t in np.arange(0.0, 10.01, 0.05)
    ]
    path.write_text("\n".join([HEAD, *rows]) + "\n", encoding="utf-8")
    return path


def _state(tmp_path, config=None, **flown):
    config = config or Config()
    return aircraft_state(config.simulator(config.open_flight(_write(tmp_path / "flown.csv", **flown))), START_S + 5)


def test_the_speeds_are_those_of_the_ellipsoid(tmp_path):
    state = _state(tmp_path, north_deg_per_s=3e-4, east_deg_per_s=-4e-4, climb=2.5)
    # Radii of curvature of WGS84 at 34.93 deg: in the meridian and across it.
    a_m, e2, phi = 6378137.0, 0.00669437999014, radians(34.93)
    meridian_m = a_m * (1 - e2) / (1 - e2 * np.sin(phi) ** 2) ** 1.5 + 312.5
    across_m = a_m / np.sqrt(1 - e2 * np.sin(phi) ** 2) + 312.5
    expected = np.hypot(meridian_m * radians(3e-4), across_m * np.cos(phi) * radians(4e-4))
    assert state.ground_speed_m_per_s == pytest.approx(expected, rel=1e-4)
    assert state.climb_m_per_s == pytest.approx(2.5, abs=1e-3)


@pytest.mark.parametrize(
    ("attitude", "altitude_deg", "azimuth_deg"),
    [
        # The camera of the default mount points along the body's upward axis.
        ({"roll_deg": 0.001}, 90.0, None),
        ({"roll_deg": 10.0, "yaw_deg": 30.0}, 80.0, 120.0),
        ({"roll_deg": -10.0, "yaw_deg": 30.0}, 80.0, 300.0),
        ({"pitch_deg": -20.0, "yaw_deg": 30.0}, 70.0, 30.0),
        ({"roll_deg": 170.0, "yaw_deg": 0.0}, -80.0, 90.0),
    ],
)
def test_the_camera_points_where_the_body_turns_it(tmp_path, attitude, altitude_deg, azimuth_deg):
    state = _state(tmp_path, **attitude)
    assert np.rad2deg(state.camera_altitude_rad) == pytest.approx(altitude_deg, abs=0.01)
    if azimuth_deg is not None:
        assert np.rad2deg(state.camera_azimuth_rad) == pytest.approx(azimuth_deg, abs=0.01)


@pytest.mark.parametrize(
    ("roll_deg", "view"),
    [
        (10.0, ""),
        (75.0, "a part of the image is below the horizon"),
        (120.0, "the camera points below the horizon"),
    ],
)
def test_it_is_said_when_the_camera_sees_the_ground(tmp_path, roll_deg, view):
    # The default camera sees 21 to 28 deg to the sides of its axis.
    assert _state(tmp_path, roll_deg=roll_deg).view == view


def test_a_fixed_site_has_no_speed(tmp_path):
    path = tmp_path / "fixed.csv"
    path.write_text("utc_s,roll_deg,pitch_deg,yaw_deg\n" + "".join(f"{START_S + t},0,0,{t}\n" for t in range(10)))
    config = Config().override(**{"flight.latitude_deg": -34.93, "flight.longitude_deg": 138.6})
    state = aircraft_state(config.simulator(config.open_flight(path)), START_S + 5)
    assert np.isnan(state.ground_speed_m_per_s)
    assert np.rad2deg(state.site.latitude_rad) == pytest.approx(-34.93)


def test_the_ground_track_crosses_the_date_line(tmp_path):
    rows = [f"{START_S + t},0,0,0,10.0,{(179.999 + 4e-4 * t + 180) % 360 - 180:.6f},0" for t in range(10)]
    (tmp_path / "line.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    flight = Config().open_flight(tmp_path / "line.csv")
    track_m = ground_track_m(flight, flight.position.at(START_S))
    np.testing.assert_allclose(np.diff(track_m[:, 0]), np.full(9, 4e-4 * 109_639), rtol=2e-3, atol=0)
    assert len(ground_track_m(flight, flight.position.at(START_S), points=3)) <= 4


def test_a_speed_is_the_mean_of_a_second(tmp_path):
    """Of t^3 m it rises by 2 h^3 within h of t = 0: by 0.25 m/s on average over half a second before and after."""
    t = np.arange(-5.0, 5.001, 0.05)
    rows = [f"{START_S + 5 + s:.2f},0,0,0,-34.93,138.6,{300 + s**3:.6f}" for s in t]
    (tmp_path / "cubic.csv").write_text("\n".join([HEAD, *rows]) + "\n", encoding="utf-8")
    config = Config()
    simulator = config.simulator(config.open_flight(tmp_path / "cubic.csv"))
    assert aircraft_state(simulator, START_S + 5).climb_m_per_s == pytest.approx(0.25, abs=0.01)
    # At the ends of the flight the mean is that of the half that is known: 5^3 - 4.5^3 in half a second.
    assert aircraft_state(simulator, START_S + 10).climb_m_per_s == pytest.approx((125 - 4.5**3) / 0.5, rel=1e-3)


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(50.0, -40.0), (50.0, 40.0), (-50.0, -40.0), (-50.0, 40.0)])
def test_the_lowest_altitude_is_that_of_a_corner(tmp_path, small, roll_deg, pitch_deg):
    """Each corner is the lowest of one attitude, against directions from the camera's own numbers."""
    state = _state(tmp_path, small, roll_deg=roll_deg, pitch_deg=pitch_deg)
    camera = small.camera()
    x = (np.array([-0.5, 253.5, -0.5, 253.5]) - camera.cx_px) / camera.fx_px
    y = (np.array([-0.5, -0.5, 189.5, 189.5]) - camera.cy_px) / camera.fy_px
    down = np.column_stack([x, y, np.ones(4)]) @ state.C_camera_ned[:, 2] / np.sqrt(x**2 + y**2 + 1)
    assert state.lowest_altitude_rad == pytest.approx(-np.arcsin(down.max()), abs=1e-9)


def test_north_east_and_down_have_their_signs():
    site = Site(radians(-34.93), radians(138.6), 100.0)
    north, east, down = north_east_down_m(site, radians(-34.92), radians(138.61), 150.0)
    assert north > 1000
    assert east > 900
    assert -50.5 < down < -49


def _panel(viewer):
    imgui.set_window_focus("Flight")
    for _ in range(4):
        viewer.frame(0.0)
    return screen(viewer)[::-1].astype(int)


def _pixels_of(image, colour):
    """Return rows and columns of the pixels of a colour, 0 to 1."""
    return np.nonzero((np.abs(image - np.array(colour) * 255) < 4).all(axis=2))


@pytest.mark.parametrize("roll_deg", [30.0, -30.0])
def test_the_ground_is_on_the_side_of_the_lower_wing(make_viewer, tmp_path, roll_deg):
    image = _panel(make_viewer(_write(tmp_path / "banked.csv", roll_deg=roll_deg)))
    ground = _pixels_of(image, (0.36, 0.26, 0.16))
    sky = _pixels_of(image, (0.16, 0.33, 0.55))
    assert min(len(ground[0]), len(sky[0])) > 1000
    assert ground[0].mean() > sky[0].mean() + 20
    assert np.sign(ground[1].mean() - sky[1].mean()) == np.sign(roll_deg)


def test_with_the_nose_up_there_is_more_sky(make_viewer, tmp_path):
    image = _panel(make_viewer(_write(tmp_path / "climbing.csv", pitch_deg=15.0)))
    fraction = len(_pixels_of(image, (0.16, 0.33, 0.55))[0]) / (
        len(_pixels_of(image, (0.16, 0.33, 0.55))[0]) + len(_pixels_of(image, (0.36, 0.26, 0.16))[0])
    )
    # Half the height shows 30 deg, so 15 deg move the horizon by a quarter.
    assert fraction == pytest.approx(0.75, abs=0.05)


def test_at_night_the_panel_is_red_only(make_viewer, tmp_path):
    viewer = make_viewer(_write(tmp_path / "banked.csv", roll_deg=20.0, north_deg_per_s=1e-4))
    press(viewer, "N")
    assert _panel(viewer)[..., 1:].max() == 0


def test_a_gap_shows_no_attitude(make_viewer, tmp_path):
    viewer = make_viewer(write_flight(tmp_path / "gap.csv", gap=True))
    viewer.session.head.seek(viewer.session.head.first_s + 7.0)
    image = _panel(viewer)
    assert len(_pixels_of(image, (0.36, 0.26, 0.16))[0]) == 0
