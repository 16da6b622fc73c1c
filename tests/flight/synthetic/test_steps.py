"""Steps of the autopilot that flies waypoints, transfer functions of gusts, and settings of synthetic flights."""

from dataclasses import fields
from math import pi, radians

import numpy as np
import pytest

from glstar.errors import ConfigError
from glstar.flight.spline import RotationSpline
from glstar.flight.synthetic.gusts import AttitudeResponse, DrydenGusts, LinearSystem
from glstar.flight.synthetic.paths import LocalMap, Wind, _Autopilot, _Leg, straight, through_waypoints
from glstar.flight.synthetic.syntheticflight import SyntheticFlight
from glstar.rotation import quaternion_from_euler, quaternion_from_turn, turn_between
from glstar.sky.place.site import Site

G = 9.80665
LEG = _Leg((30.0, -20.0, 100.0), (330.0, 380.0, 160.0))
WIND = Wind(3.0, -5.0)
SITE = Site(radians(-34.93), radians(138.60), 300.0)


def stepped(
    place: tuple[float, float, float], yaw: float, bank: float, climb: float, leg: _Leg = LEG, step_s: float = 0.02
) -> np.ndarray:
    """Return the row of an aircraft at 18 m/s after a step from a state of its choice."""
    pilot = _Autopilot(leg, 18.0, WIND, step_s)
    pilot._north, pilot._east, pilot._up = place
    pilot._yaw, pilot._bank, pilot._climb = yaw, bank, climb
    pilot.follow(leg)
    return np.array(pilot.row())


STATES = [
    ((60.0, 50.0, 110.0), 0.8, 0.1, 0.02),
    ((100.0, 90.0, 118.0), 1.1, -0.2, 0.05),
    ((200.0, 200.0, 150.0), 0.9, 0.05, 0.1),
    ((50.0, 30.0, 60.0), -2.0, 0.3, -0.05),
    ((340.0, 410.0, 150.0), 1.0, -0.1, 0.0),
    ((10.0, -60.0, 130.0), 0.2, 0.0, 0.1),
    ((180.0, 180.0, 131.0), 0.93, 0.6, 0.01),
]


@pytest.mark.parametrize("state", STATES)
def test_a_step_of_the_autopilot_follows_its_law_of_guidance(state: tuple) -> None:
    (north, east, up), yaw, bank, climb = state
    after = stepped(*state)
    # It moves by the attitude in the middle of the step, and turns as in a coordinated turn.
    middle_climb, middle_yaw, middle_bank = (climb + after[5]) / 2, (yaw + after[3]) / 2, (bank + after[4]) / 2
    level = 18 * np.cos(middle_climb)
    moved = np.array([level * np.cos(middle_yaw) + 3, level * np.sin(middle_yaw) - 5, 18 * np.sin(middle_climb)])
    np.testing.assert_allclose(after[:3] - [north, east, up], moved * 0.02, rtol=0, atol=1e-10)
    assert after[3] - yaw == pytest.approx(G * np.tan(middle_bank) / 18 * 0.02, abs=1e-12)
    # Guidance to a point four seconds ahead on the leg, which is 500 m long with 3 : 4 as its course, in the plane.
    here, along, start = complex(north, east), complex(0.6, 0.8), complex(30, -20)
    velocity = 18 * np.cos(climb) * np.exp(1j * yaw) + complex(3, -5)
    speed = abs(velocity)
    gone = ((here - start) * along.conjugate()).real
    target = start + along * (min(gone, 500) + 4 * speed)
    off = np.angle((target - here) / velocity)
    acceleration = 2 * speed**2 * np.sin(np.clip(off, -pi / 2, pi / 2)) / abs(target - here)
    wanted = np.clip(np.arctan(acceleration / G), -pi / 4, pi / 4)
    roll_rate = np.clip((wanted - bank) / 0.4, -pi / 6, pi / 6)
    assert after[4] - bank == pytest.approx(roll_rate * 0.02, abs=1e-12)
    # The height of the leg, 60 m over 500 m, is reached in the time of the look-ahead.
    height = 100 + 60 * np.clip(gone / 500, 0, 1)
    slope = 0.12 * speed / 18 + (height - up) / (4 * speed)
    climb_rate = (np.clip(slope, -radians(15), radians(15)) - climb) / 1.0
    assert after[5] - climb == pytest.approx(climb_rate * 0.02, abs=1e-12)


def test_a_path_through_waypoints_begins_on_its_course_into_the_wind() -> None:
    path = through_waypoints(
        0.1, [LEG.start_m, (90.0, 60.0, 112.0), (90.0, 100.0, 100.0)], airspeed_m_per_s=18, wind=WIND
    )
    assert (path.north_m[0], path.east_m[0], path.up_m[0], path.bank_rad[0], path.climb_rad[0]) == (30, -20, 100, 0, 0)
    start = 18 * np.exp(1j * path.yaw_rad[0]) + complex(3, -5)
    assert np.angle(start) == pytest.approx(np.arctan2(80, 60), abs=1e-9)
    np.testing.assert_allclose(np.diff(path.t_s), 0.1, rtol=1e-9)
    # It ends abeam of the last waypoint, by its last step.
    assert path.east_m[-2] < 100 <= path.east_m[-1]
    with pytest.raises(ConfigError) as caught:
        through_waypoints(0.1, [(0, 0, 0), (30, 40, 0)], airspeed_m_per_s=5.0, wind=Wind(3, -4))
    assert str(caught.value) == (
        "a wind of 5 m/s carries an aircraft of 5 m/s away: it cannot follow a path over the ground; fly faster, or"
        " take less wind"
    )


def transfer(system: LinearSystem, omega: float) -> np.ndarray:
    """Return the transfer function from the noises to the outputs."""
    return system.C @ np.linalg.solve(1j * omega * np.eye(len(system.A)) - system.A, system.B)


@pytest.mark.parametrize("omega", [0.2, 3.0, 40.0])
def test_gust_rates_follow_the_gusts_that_cause_them(omega: float) -> None:
    gusts = DrydenGusts(9.0, 120.0, 21.0, 2.5)
    found = transfer(gusts.system(), omega)
    # Four independent noises: of u, of v and r, of w and q, and of p.
    noise = np.array([0, 1, 2, 3, 2, 1])
    np.testing.assert_array_equal(np.abs(found) > 1e-12, noise[:, np.newaxis] == np.arange(4))
    s, (_, v, w, _, q, r) = 1j * omega, found[np.arange(6), noise]
    np.testing.assert_allclose(q / w, s / 21 / (1 + 4 * 2.5 / (pi * 21) * s), rtol=1e-9)
    np.testing.assert_allclose(r / v, -s / 21 / (1 + 3 * 2.5 / (pi * 21) * s), rtol=1e-9)

    response = AttitudeResponse(2.3, 0.55)
    natural = 2 * pi * 2.3
    drive = found[[3, 4, 5]] * 2 * 0.55 * natural
    drive += natural**2 * np.array([[-0.2], [0.25], [0.25]]) / 21 * found[[1, 2, 1]]
    expected = drive / (s**2 + 2 * 0.55 * natural * s + natural**2)
    np.testing.assert_allclose(transfer(response.to(gusts), omega), expected, rtol=1e-9, atol=1e-15)


def test_gusts_and_responses_have_limits() -> None:
    assert DrydenGusts(0.5, 100.0, 18.0, 2.0).sigmas_m_per_s[2] == pytest.approx(0.05)
    assert DrydenGusts(0.0, 0.5, 0.5, 0.5).sigmas_m_per_s == (0.0, 0.0, 0.0)
    for values, message in (
        ((-0.1, 100.0, 18.0, 2.0), "gusts need a wind of 0 m/s or more, not -0.1"),
        ((7.7, 0.0, 18.0, 2.0), "gusts need height_m above 0, not 0"),
        ((7.7, 100.0, -1.0, 2.0), "gusts need airspeed_m_per_s above 0, not -1"),
        ((7.7, 100.0, 18.0, np.nan), "gusts need span_m above 0, not nan"),
    ):
        with pytest.raises(ConfigError) as caught:
            DrydenGusts(*values)
        assert str(caught.value) == message
    assert (AttitudeResponse().natural_frequency_hz, AttitudeResponse().damping) == (1.5, 0.7)
    for values in ((0.0, 0.7), (1.5, 0.0)):
        with pytest.raises(ConfigError) as caught:
            AttitudeResponse(*values)
        assert str(caught.value) == (
            "an attitude response needs a natural frequency and a damping above 0,"
            f" not {values[0]:g} Hz and {values[1]:g}"
        )


def test_a_flight_above_a_point_has_the_attitude_asked_for() -> None:
    still = {"heading_rad": 0.7, "pitch_rad": 0.2, "roll_rad": -0.3, "rate_hz": 10.0}
    flight = SyntheticFlight("still", SITE, 1000.0, **still, gusts_20ft_m_per_s=20.0).flight()
    assert (flight.attitude.first_s, flight.attitude.last_s, flight.attitude.utc_s.size) == (1000, 1060, 601)
    expected = quaternion_from_euler(-0.3, 0.2, 0.7)
    np.testing.assert_allclose(turn_between(expected, flight.attitude.q_body_ned), 0, rtol=0, atol=1e-12)
    assert (flight.name, flight.position_source, flight.utc_source) == ("synthetic still", "synthetic still", "given")
    assert flight.attitude_source == "synthetic still, 10.0 Hz"
    assert flight.position.height_m.tolist() == [300.0] * 601
    spin = SyntheticFlight("spin", SITE, 1000.0, **still, duration_s=2.04).flight().attitude
    assert spin.utc_s.size == 21
    np.testing.assert_allclose(
        turn_between(quaternion_from_euler(-0.3, 0.2, 0.7 + pi / 18 * np.arange(21) / 10), spin.q_body_ned),
        0,
        rtol=0,
        atol=1e-9,
    )


def test_orbits_and_gusts_have_their_lengths_and_least_height() -> None:
    settings = {"radius_m": 200.0, "airspeed_m_per_s": 25.0, "turns": 1.5, "rate_hz": 20.0}
    held = SyntheticFlight("orbit", SITE, 0.0, guidance="attitude", wind=Wind(9.0, 2.0), **settings)
    assert held.length_s == round(1.5 * 2 * pi * 200 / 25 * 20) / 20
    path = SyntheticFlight(
        "waypoints",
        SITE,
        0.0,
        rate_hz=10.0,
        waypoints=(SITE, Site(SITE.latitude_rad + 5e-5, SITE.longitude_rad, 320.0)),
    )
    flight = path.flight()
    assert path.length_s == pytest.approx(flight.attitude.last_s, rel=0, abs=1e-9)
    # 319 m of the meridian at 18 m/s.
    assert path.length_s == pytest.approx(5e-5 * 6_356_300 / 18, abs=0.5)
    assert flight.position.height_m[-1] == pytest.approx(320.0, abs=8.0)
    assert flight.position.longitude_rad[-1] == pytest.approx(SITE.longitude_rad, abs=1e-9)
    low, least, higher = (
        SyntheticFlight(
            "hover", SITE, 0.0, duration_s=1.0, gusts_20ft_m_per_s=7.7, height_above_ground_m=height_m, seed=3
        ).flight()
        for height_m in (0.5, 3.0, 30.0)
    )
    np.testing.assert_array_equal(low.attitude.q_body_ned, least.attitude.q_body_ned)
    assert np.abs(low.attitude.q_body_ned - higher.attitude.q_body_ned).max() > 1e-6


def test_usual_settings_and_limits_of_a_flight() -> None:
    flight = SyntheticFlight("orbit", SITE, 5.0)
    usual = {
        "duration_s": None,
        "airspeed_m_per_s": 18.0,
        "radius_m": 150.0,
        "turns": 1.0,
        "clockwise": True,
        "guidance": "ground",
        "heading_rad": 0.0,
        "pitch_rad": 0.0,
        "roll_rad": 0.0,
        "climb_rad": 0.0,
        "route": "rhumb",
        "yaw_rate_rad_per_s": pi / 18,
        "waypoints": (),
        "wind": Wind(0.0, 0.0),
        "gusts_20ft_m_per_s": 0.0,
        "height_above_ground_m": 100.0,
        "span_m": 2.0,
        "response": AttitudeResponse(1.5, 0.7),
        "vibration": (),
        "rate_hz": 200.0,
        "seed": 0,
    }
    assert {field.name: getattr(flight, field.name) for field in fields(SyntheticFlight)[3:]} == usual
    for name in ("airspeed_m_per_s", "radius_m", "turns", "rate_hz", "height_above_ground_m", "span_m"):
        for value in (0.0, np.inf):
            with pytest.raises(ConfigError) as caught:
                SyntheticFlight("orbit", SITE, 5.0, **{name: value})
            assert str(caught.value) == f"a synthetic flight needs {name} above 0, not {value:g}"
        assert getattr(SyntheticFlight("orbit", SITE, 5.0, **{name: 0.5}), name) == 0.5
    for value in (0.0, np.inf):
        with pytest.raises(ConfigError, match=f"^a synthetic flight needs duration_s above 0, not {value:g}$"):
            SyntheticFlight("hover", SITE, 5.0, duration_s=value)
    assert SyntheticFlight("hover", SITE, 5.0, duration_s=50_000.0).length_s == 50_000
    with pytest.raises(ConfigError) as caught:
        SyntheticFlight("hover", SITE, 5.0, duration_s=50_001.0)
    assert str(caught.value) == (
        "50001 s at 200 Hz are more than 10,000,000 attitudes; fly shorter, or at a lower rate_hz"
    )


def test_a_spline_is_exact_for_a_turn_that_changes_its_rate_steadily() -> None:
    """About one axis, on uneven samples and on both sides of a gap, and linear over a single interval."""
    t_s = np.array([0.0, 0.7, 1.2, 2.0, 2.5, 4.5, 4.9, 5.8, 6.3, 9.0, 9.4, 12.0, 12.3, 12.9])
    axis = np.array([0.48, -0.6, 0.64])

    def attitude(s):
        return quaternion_from_turn((0.3 * s - 0.11 * s**2)[..., np.newaxis] * axis)

    broken = np.zeros(13, bool)
    broken[[4, 8, 10]] = True
    curve = RotationSpline.through(t_s, attitude(t_s), broken=broken)
    for first_s, last_s in ((0.0, 2.5), (4.5, 6.3), (12.0, 12.9)):
        s = np.linspace(first_s, last_s, 60)
        np.testing.assert_allclose(turn_between(attitude(s), curve.at(s)), 0, rtol=0, atol=1e-10)
    for k in (4, 8, 9, 10):
        mean = turn_between(attitude(t_s[k]), attitude(t_s[k + 1])) / (t_s[k + 1] - t_s[k])
        np.testing.assert_allclose(curve.coefficients[k], [mean, np.zeros(3), np.zeros(3)], rtol=0, atol=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("latitude_deg", "is_far"), [(89.896, True), (89.904, False)])
def test_a_path_ends_a_tenth_of_a_degree_before_a_pole(sign: int, latitude_deg: float, is_far: bool) -> None:
    local = LocalMap(Site(radians(sign * 89.8), 1.0))
    # The radius of curvature at a pole is 6399.6 km.
    away_m = sign * radians(latitude_deg - 89.8) * 6_399_600.0
    t_s = np.array([0.0, abs(away_m) / 250.0])
    course_rad = 0.0 if sign > 0 else pi
    if is_far:
        latitude_rad, longitude_rad = local.place(np.array([0.0, away_m]), np.array([0.0, 0.0]))
        assert latitude_rad[1] == pytest.approx(radians(sign * latitude_deg), abs=1e-6)
        assert longitude_rad.tolist() == [1.0, 1.0]
        path = straight(t_s, local, course_rad=course_rad, airspeed_m_per_s=250.0, wind=Wind())
        np.testing.assert_allclose(path.north_m, [0.0, away_m], rtol=1e-4)
        return
    with pytest.raises(ConfigError, match="the flight crosses a pole, where its local map ends; fly farther from it"):
        local.place(np.array([0.0, away_m]), np.array([0.0, 0.0]))
    with pytest.raises(ConfigError, match="the flight crosses a pole, where its local map ends; fly farther from it"):
        straight(t_s, local, course_rad=course_rad, airspeed_m_per_s=250.0, wind=Wind())


def test_a_long_leg_is_flown_to_its_end() -> None:
    # It takes 139 s, longer than the slack of two minutes.
    path = through_waypoints(0.5, [(0.0, 0.0, 0.0), (2500.0, 0.0, 0.0)], airspeed_m_per_s=18.0, wind=Wind())
    assert path.north_m[-2] < 2500 <= path.north_m[-1]
    np.testing.assert_allclose(path.north_m, 18 * path.t_s, rtol=1e-9)
