"""Paths through moving air: coordinated turns, the wind triangle, legs between waypoints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glstar.errors import ConfigError
from glstar.flight.synthetic.paths import (
    GRAVITY_M_PER_S2,
    FlownPath,
    LocalMap,
    Wind,
    ground_orbit_period_s,
    held_orbit,
    orbit_over_ground,
    stationary,
    straight,
    through_waypoints,
)
from glstar.sky.place.site import Site

DEG = np.pi / 180
CALM = Wind()


def velocity_m_per_s(path: FlownPath) -> tuple[np.ndarray, np.ndarray]:
    """Return north and east velocities at the middles between samples."""
    return np.diff(path.north_m) / np.diff(path.t_s), np.diff(path.east_m) / np.diff(path.t_s)


def test_in_calm_air_an_orbit_has_the_bank_of_a_coordinated_turn() -> None:
    t_s = np.linspace(0, 60, 12001)

    path = orbit_over_ground(t_s, radius_m=150, airspeed_m_per_s=18, wind=CALM, clockwise=True)

    np.testing.assert_allclose(np.tan(path.bank_rad), 18 * (18 / 150) / GRAVITY_M_PER_S2, rtol=1e-9)
    np.testing.assert_allclose(path.yaw_rad, np.pi / 2 + 18 / 150 * t_s, rtol=0, atol=1e-9)


def test_both_kinds_of_orbit_agree_in_calm_air() -> None:
    t_s = np.linspace(0, 60, 601)
    settings = {"radius_m": 300.0, "airspeed_m_per_s": 22.0, "wind": CALM, "clockwise": False, "bearing_rad": 1.0}

    guided, held = orbit_over_ground(t_s, **settings), held_orbit(t_s, **settings)

    for name in ("north_m", "east_m", "yaw_rad", "bank_rad"):
        np.testing.assert_allclose(getattr(guided, name), getattr(held, name), rtol=0, atol=1e-7, err_msg=name)


@pytest.mark.slow
@given(
    wind_m_per_s=st.floats(0, 15),
    wind_from_rad=st.floats(0, 2 * np.pi),
    radius_m=st.floats(50, 1000),
    clockwise=st.booleans(),
)
def test_in_wind_an_orbit_stays_on_its_circle_at_its_airspeed(
    wind_m_per_s: float, wind_from_rad: float, radius_m: float, clockwise: bool
) -> None:
    wind = Wind.from_direction(wind_m_per_s, wind_from_rad)
    t_s = np.arange(0, 40, 0.002)

    path = orbit_over_ground(t_s, radius_m=radius_m, airspeed_m_per_s=18, wind=wind, clockwise=clockwise)

    np.testing.assert_allclose(np.hypot(path.north_m, path.east_m), radius_m, rtol=1e-9)
    north, east = velocity_m_per_s(path)
    middle = (path.yaw_rad[:-1] + path.yaw_rad[1:]) / 2
    np.testing.assert_allclose(north - wind.north_m_per_s, 18 * np.cos(middle), rtol=0, atol=1e-3)
    np.testing.assert_allclose(east - wind.east_m_per_s, 18 * np.sin(middle), rtol=0, atol=1e-3)
    # The bank is that of the heading's rate, tan(bank) = V omega / g.
    yaw_rate = np.diff(path.yaw_rad) / np.diff(path.t_s)
    bank = np.arctan(18 * yaw_rate / GRAVITY_M_PER_S2)
    np.testing.assert_allclose((path.bank_rad[:-1] + path.bank_rad[1:]) / 2, bank, rtol=0, atol=1e-4)


def test_an_orbit_of_constant_bank_drifts_with_the_wind() -> None:
    t_s = np.arange(0, 400, 0.1)
    wind = Wind.from_direction(15, 0.0)

    path = held_orbit(t_s, radius_m=150, airspeed_m_per_s=18, wind=wind, clockwise=True)

    assert path.north_m[-1] == pytest.approx(150 * np.cos(18 / 150 * t_s[-1]) - 15 * t_s[-1])
    np.testing.assert_allclose(path.bank_rad, path.bank_rad[0], rtol=0, atol=0)


def test_a_transit_crabs_into_the_wind() -> None:
    t_s = np.linspace(0, 100, 11)

    # East along the equator, where the map is exact.
    equator = LocalMap(Site(0.0, 0.3))
    path = straight(t_s, equator, course_rad=90 * DEG, airspeed_m_per_s=20, wind=Wind(north_m_per_s=-10))

    np.testing.assert_allclose(path.north_m, 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(path.east_m, t_s * np.sqrt(300), rtol=1e-12)
    np.testing.assert_allclose(path.yaw_rad, 60 * DEG, rtol=1e-12)


@pytest.mark.parametrize("fly", [orbit_over_ground, held_orbit])
def test_orbits_turn_in_the_configured_direction(fly) -> None:
    t_s = np.arange(0, 5, 0.1)
    right, left = (
        fly(t_s, radius_m=150, airspeed_m_per_s=18, wind=Wind(2, 1), clockwise=clockwise) for clockwise in (True, False)
    )

    assert np.all(np.diff(right.yaw_rad) > 0)
    assert np.all(right.bank_rad > 0)
    assert np.all(np.diff(left.yaw_rad) < 0)
    assert np.all(left.bank_rad < 0)


def test_a_wind_as_fast_as_the_aircraft_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"a wind of 20 m/s carries an aircraft of 18 m/s away"):
        orbit_over_ground(np.arange(9.0), radius_m=150, airspeed_m_per_s=18, wind=Wind(20, 0), clockwise=True)


def test_a_stationary_aircraft_turns_about_its_vertical_axis_only() -> None:
    path = stationary(np.arange(0, 10, 0.5), yaw_rad=0.3, yaw_rate_rad_per_s=0.2)

    np.testing.assert_allclose(path.yaw_rad, 0.3 + 0.2 * path.t_s, rtol=1e-12)
    assert not path.north_m.any()
    assert not path.bank_rad.any()


@pytest.mark.slow
def test_waypoints_are_passed_near_with_limited_bank_and_roll_rate() -> None:
    corners = [(0.0, 0.0, 0.0), (800.0, 0.0, 40.0), (800.0, 700.0, 40.0), (0.0, 700.0, 0.0)]
    wind = Wind(3, -5)

    path = through_waypoints(0.005, corners, airspeed_m_per_s=18, wind=wind)

    for north, east, _ in corners:
        assert np.hypot(path.north_m - north, path.east_m - east).min() < 20
    assert np.abs(path.bank_rad).max() <= 45 * DEG
    assert np.abs(np.diff(path.bank_rad)).max() / 0.005 <= 30.001 * DEG
    assert path.up_m.max() == pytest.approx(40, abs=5)
    north, east = velocity_m_per_s(path)
    level = 18 * np.cos(path.climb_rad[:-1])
    airspeed = np.hypot(north - wind.north_m_per_s, east - wind.east_m_per_s)
    np.testing.assert_allclose(airspeed, level, rtol=0, atol=2e-2)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0.0, 0.0, 0.0)], "needs two of them or more, not 1"),
        ([(0.0, 0.0, 0.0), (0.2, 0.0, 9.0)], r"the leg from waypoint 1 to 2 is 0\.20 m long"),
    ],
)
def test_impossible_waypoints_are_refused(corners: list, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        through_waypoints(0.01, corners, airspeed_m_per_s=18, wind=CALM)


@pytest.mark.parametrize(("clockwise", "bearing_rad"), [(True, 0.3), (False, 2.0)])
def test_an_orbit_in_wind_has_its_radius_its_airspeed_and_its_period(clockwise: bool, bearing_rad: float) -> None:
    wind = Wind.from_direction(9.0, 1.1)
    period_s = ground_orbit_period_s(radius_m=200.0, airspeed_m_per_s=20.0, wind=wind)
    t_s = np.linspace(0, 2 * period_s, 20001)
    path = orbit_over_ground(
        t_s, radius_m=200.0, airspeed_m_per_s=20.0, wind=wind, clockwise=clockwise, bearing_rad=bearing_rad
    )
    np.testing.assert_allclose(np.hypot(path.north_m, path.east_m), 200.0, rtol=1e-12)
    north, east = velocity_m_per_s(path)
    # Wind from 1.1 rad carries towards the opposite direction.
    airspeed = np.hypot(north + 9 * np.cos(1.1), east + 9 * np.sin(1.1))
    np.testing.assert_allclose(airspeed, 20.0, rtol=0, atol=2e-3)
    for at in (10_000, 20_000):
        np.testing.assert_allclose(path.north_m[at], 200 * np.cos(bearing_rad), rtol=0, atol=1e-6)
        np.testing.assert_allclose(path.east_m[at], 200 * np.sin(bearing_rad), rtol=0, atol=1e-6)
