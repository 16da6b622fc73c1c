"""Synthetic flights as flights: positions on the ellipsoid, seeds, limits."""

from math import radians

import erfa
import numpy as np
import pytest
from pyproj import Geod, Proj

from glstar.errors import ConfigError
from glstar.flight.synthetic.gusts import VibrationLine
from glstar.flight.synthetic.paths import Wind
from glstar.flight.synthetic.syntheticflight import FLIGHT_PATHS, SyntheticFlight
from glstar.rotation import euler_from_quaternion, turn_between
from glstar.sky.place.site import Site

ADELAIDE = Site(radians(-34.93), radians(138.60), 300.0)
NIGHT_UTC_S = 1710068400.0


def synthetic(path: str, **settings: object) -> SyntheticFlight:
    if path == "waypoints":
        settings.setdefault("waypoints", (ADELAIDE, Site(radians(-34.925), radians(138.605), 340.0)))
    return SyntheticFlight(path, ADELAIDE, NIGHT_UTC_S, **settings)


@pytest.mark.parametrize("path", FLIGHT_PATHS)
def test_every_path_gives_a_flight_without_gaps(path: str) -> None:
    flight = synthetic(path, gusts_20ft_m_per_s=7.7).flight()

    assert flight.attitude.first_s == NIGHT_UTC_S
    assert flight.attitude.gaps == ()
    # UTC in float64 has a resolution of 0.24 microseconds.
    assert flight.attitude.rate_hz == pytest.approx(200.0, rel=1e-4)
    assert flight.name == f"synthetic {path}"
    assert np.abs(turn_between(flight.attitude.q_body_ned[:-1], flight.attitude.q_body_ned[1:])).max() < 0.02


def test_an_orbit_has_its_radius_on_the_ellipsoid() -> None:
    flight = synthetic("orbit", radius_m=600.0, wind=Wind(5, 3), duration_s=150.0).flight()

    places = flight.position
    centre = np.array(erfa.gd2gc(1, ADELAIDE.longitude_rad, ADELAIDE.latitude_rad, ADELAIDE.height_m))
    flown = np.array(erfa.gd2gc(1, places.longitude_rad, places.latitude_rad, places.height_m))
    np.testing.assert_allclose(np.linalg.norm(flown - centre, axis=1), 600.0, rtol=0, atol=0.05)


@pytest.mark.parametrize("guidance", ["ground", "attitude"])
def test_an_orbit_takes_the_time_of_its_turns(guidance: str) -> None:
    for turns, settings in ((1.0, {}), (2.0, {"turns": 2.0})):
        made = synthetic("orbit", guidance=guidance, **settings)
        attitude = made.flight().attitude
        assert attitude.last_s - attitude.first_s == pytest.approx(turns * 2 * np.pi * 150 / 18, abs=0.01)
        assert made.length_s == pytest.approx(attitude.last_s - attitude.first_s, abs=1e-6)
        # After full turns the aircraft has the attitude of the start.
        assert np.linalg.norm(turn_between(attitude.q_body_ned[:1], attitude.q_body_ned[-1:])) < 1.5e-3


def test_the_same_seed_gives_the_same_flight_and_another_seed_another() -> None:
    settings = {"gusts_20ft_m_per_s": 7.7, "vibration": (VibrationLine(90.0, 1e-4),), "duration_s": 5.0}

    first, again, other = (synthetic("orbit", **settings, seed=seed).flight().attitude for seed in (4, 4, 5))

    np.testing.assert_array_equal(first.q_body_ned, again.q_body_ned)
    assert not np.array_equal(first.q_body_ned, other.q_body_ned)


def test_still_ignores_the_wind() -> None:
    attitude = synthetic("still", gusts_20ft_m_per_s=23.2, roll_rad=0.1).flight().attitude

    assert np.ptp(attitude.q_body_ned, axis=0).max() == 0


def test_a_spin_turns_at_its_rate() -> None:
    _, rates = synthetic("spin", yaw_rate_rad_per_s=0.3, duration_s=4.0).flight().attitude.rates()

    np.testing.assert_allclose(rates, np.broadcast_to([0, 0, 0.3], rates.shape), rtol=0, atol=1e-9)


WGS84 = Geod(ellps="WGS84")
MERCATOR = Proj("+proj=merc +ellps=WGS84")
# Latitude, longitude and course of the start, deg: towards all quarters, near a pole, and across the date line.
ROUTES = [
    (60, 10, 60),
    (-34.93, 138.6, 300),
    (0, -75, 90),
    (0, 20, 0),
    (55, 179.5, 100),
    (-70, -179.9, 265),
    (80, 5, 40),
]


def flown_deg(place_deg: tuple[float, float], course_deg: float, **settings: object) -> np.ndarray:
    """Return longitudes and latitudes every 20 s or so of a transit of 1000 km at 250 m/s, (2, n) deg."""
    site = Site(*np.deg2rad(place_deg))
    settings = {"airspeed_m_per_s": 250.0, "duration_s": 4000.0, "rate_hz": 1.0} | settings
    flight = SyntheticFlight("transit", site, NIGHT_UTC_S, heading_rad=radians(course_deg), **settings).flight()
    return np.rad2deg([flight.position.longitude_rad, flight.position.latitude_rad])[:, ::20]


@pytest.mark.parametrize(("latitude_deg", "longitude_deg", "course_deg"), ROUTES)
def test_a_great_circle_is_the_geodesic_of_geographiclib(
    latitude_deg: float, longitude_deg: float, course_deg: float
) -> None:
    longitude, latitude = flown_deg((latitude_deg, longitude_deg), course_deg, route="great_circle")

    run_m = 5000.0 * np.arange(longitude.size)
    start = np.broadcast_arrays(longitude_deg, latitude_deg, course_deg, run_m)[:3]
    true_longitude, true_latitude, _ = WGS84.fwd(*start, run_m)
    _, _, off_m = WGS84.inv(longitude, latitude, true_longitude, true_latitude)
    assert run_m[-1] == 1e6
    assert np.abs(off_m).max() < 0.001


@pytest.mark.parametrize(("latitude_deg", "longitude_deg", "course_deg"), ROUTES)
def test_a_rhumb_line_is_straight_on_mercators_map_and_has_its_length(
    latitude_deg: float, longitude_deg: float, course_deg: float
) -> None:
    longitude, latitude = flown_deg((latitude_deg, longitude_deg), course_deg)

    x, y = MERCATOR(longitude - longitude[0], latitude)  # x without jumps at the date line
    towards = np.unwrap(np.arctan2(np.diff(x), np.diff(y)))
    np.testing.assert_allclose(np.exp(1j * towards), np.exp(1j * radians(course_deg)), rtol=0, atol=1e-8)
    # Along a rhumb line the distance is that along the meridian over the cosine of the course; GeographicLib's.
    cosine = np.cos(radians(course_deg))
    if abs(cosine) > 1e-6:
        north_m = WGS84.inv(np.zeros_like(latitude), np.full_like(latitude, latitude[0]), 0 * latitude, latitude)[2]
        run_m = north_m / abs(cosine)
        np.testing.assert_allclose(run_m, 5000.0 * np.arange(latitude.size), rtol=0, atol=0.01)


def test_a_transit_in_wind_keeps_its_course_over_the_ground_and_its_airspeed() -> None:
    wind = Wind(12.0, -9.0)
    flight = SyntheticFlight(
        "transit", Site(1.0, 0.2), NIGHT_UTC_S, duration_s=3000.0, rate_hz=1.0, airspeed_m_per_s=60.0, wind=wind,
        heading_rad=radians(70.0), route="great_circle",
    ).flight()  # fmt: skip

    longitude, latitude = np.rad2deg([flight.position.longitude_rad, flight.position.latitude_rad])
    azimuth_deg, _, step_m = WGS84.inv(longitude[:-1], latitude[:-1], longitude[1:], latitude[1:])
    assert azimuth_deg[-1] - azimuth_deg[0] > 1.5  # the course of a great circle changes
    middle = np.deg2rad(azimuth_deg) + np.deg2rad(np.gradient(azimuth_deg)) / 2
    north, east = step_m * np.cos(middle) - 12.0, step_m * np.sin(middle) + 9.0
    np.testing.assert_allclose(np.hypot(north, east), 60.0, rtol=0, atol=2e-3)
    _, _, yaw = euler_from_quaternion(flight.attitude.q_body_ned)
    np.testing.assert_allclose(np.unwrap(np.arctan2(east, north)), (yaw[:-1] + yaw[1:]) / 2, rtol=0, atol=1e-5)


def test_a_transit_ends_before_a_pole() -> None:
    assert flown_deg((80.9, 0.0), 0.0)[1, -1] == pytest.approx(89.86, abs=0.02)
    for route in ("rhumb", "great_circle"):
        with pytest.raises(ConfigError, match="crosses a pole"):
            flown_deg((81.0, 0.0), 0.0, route=route)


def test_a_transit_north_follows_the_meridian() -> None:
    places = synthetic("transit", airspeed_m_per_s=50.0, duration_s=200.0).flight().position

    metres = np.linalg.norm(
        np.subtract(
            erfa.gd2gc(1, places.longitude_rad[-1], places.latitude_rad[-1], 300.0),
            erfa.gd2gc(1, places.longitude_rad[0], places.latitude_rad[0], 300.0),
        )
    )
    assert metres == pytest.approx(10_000, abs=1.0)
    assert np.ptp(places.longitude_rad) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"path": "loop"}, "one of orbit, transit, waypoints, hover, spin, still, not 'loop'"),
        ({"path": "orbit", "radius_m": 0.0}, "radius_m above 0, not 0"),
        ({"path": "hover", "duration_s": -3.0}, "duration_s above 0, not -3"),
        ({"path": "hover", "duration_s": 1e6}, "more than 10,000,000 attitudes"),
        ({"path": "waypoints"}, "two or more of them, not 0"),
    ],
)
def test_impossible_flights_are_refused(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SyntheticFlight(**{"site": ADELAIDE, "start_utc_s": NIGHT_UTC_S} | settings)


def test_a_flight_across_a_pole_is_refused() -> None:
    north = SyntheticFlight("transit", Site(radians(89.85), 0.0), NIGHT_UTC_S, airspeed_m_per_s=250.0)

    with pytest.raises(ConfigError, match="crosses a pole"):
        north.flight()
