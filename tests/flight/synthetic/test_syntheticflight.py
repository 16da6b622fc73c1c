"""Synthetic flights as flights: positions on the ellipsoid, seeds, limits."""

from math import radians

import erfa
import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.flight.synthetic.gusts import VibrationLine
from glstar.flight.synthetic.paths import Wind
from glstar.flight.synthetic.syntheticflight import FLIGHT_PATHS, SyntheticFlight
from glstar.rotation import turn_between
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


def test_one_turn_is_the_default_of_an_orbit() -> None:
    flight = synthetic("orbit", turns=2.0).flight()

    assert flight.attitude.last_s - flight.attitude.first_s == pytest.approx(2 * 2 * np.pi * 150 / 18, abs=0.01)


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
