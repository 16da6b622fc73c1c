"""Level platforms of gimbals, against closed forms and SciPy."""

from math import inf

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.flight.gimbal import Gimbal
from glstar.sky.place.site import Site

T_S = np.arange(0.0, 20.0, 0.02)


def angles_deg(t_s: np.ndarray) -> np.ndarray:
    """Return heading, pitch and roll of the aircraft, (n, 3)."""
    return np.stack([160 + 6 * t_s, 5 * np.sin(0.7 * t_s), 30 * np.sin(0.4 * t_s)], axis=-1)


def flight(t_s: np.ndarray = T_S, gaps: tuple[Gap, ...] = ()) -> Flight:
    q = Rotation.from_euler("ZYX", angles_deg(t_s), degrees=True).inv().as_quat()[:, [3, 0, 1, 2]]
    return Flight(AttitudeTrack(t_s, q, gaps), PositionTrack.fixed(Site(-0.6, 2.4, 100.0)))


def platform_deg(carried: Flight) -> np.ndarray:
    """Return heading, pitch and roll of the platform at the samples, by SciPy, (n, 3)."""
    return Rotation.from_quat(carried.attitude.q_body_ned[:, [1, 2, 3, 0]]).inv().as_euler("ZYX", degrees=True)


def test_a_level_platform_keeps_the_heading_alone() -> None:
    found = platform_deg(Gimbal("level").carried(flight()))
    np.testing.assert_allclose(found[:, 1:], 0, rtol=0, atol=1e-9)
    turned = (found[:, 0] - angles_deg(T_S)[:, 0] + 180) % 360 - 180
    np.testing.assert_allclose(turned, 0, rtol=0, atol=1e-9)


def test_beyond_its_limits_a_platform_keeps_the_rest_of_the_roll() -> None:
    found = platform_deg(Gimbal("level", np.deg2rad(20.0), np.deg2rad(2.0)).carried(flight()))
    _, pitch, roll = angles_deg(T_S).T
    np.testing.assert_allclose(found[:, 2], np.sign(roll) * np.maximum(np.abs(roll) - 20, 0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[:, 1], np.sign(pitch) * np.maximum(np.abs(pitch) - 2, 0), rtol=0, atol=1e-9)


def test_joints_and_heading_lag_as_the_differential_equation_says() -> None:
    found = platform_deg(Gimbal("level", inf, inf, 0.3, 2.0).carried(flight()))

    def lag(axis: int, lag_s: float) -> np.ndarray:
        def slope(t: float, y: np.ndarray) -> np.ndarray:
            return (angles_deg(np.array([t]))[:, axis] - y) / lag_s

        return solve_ivp(slope, (0, T_S[-1]), angles_deg(T_S[:1])[:, axis], t_eval=T_S, rtol=1e-10, atol=1e-10).y[0]

    _, pitch, roll = angles_deg(T_S).T
    # The angles are curved within the 20 ms between samples: 30 deg * 0.4^2 * 0.02^2 / 8 s^2.
    np.testing.assert_allclose(found[:, 2], roll - lag(2, 0.3), rtol=0, atol=3e-4)
    np.testing.assert_allclose(found[:, 1], pitch - lag(1, 0.3), rtol=0, atol=3e-4)
    turned = (found[:, 0] - lag(0, 2.0) + 180) % 360 - 180
    np.testing.assert_allclose(turned, 0, rtol=0, atol=1e-6)
    # After seconds the heading follows a steady turn with the rate times the lag.
    assert abs((angles_deg(T_S)[-1, 0] - found[-1, 0]) % 360 - 6 * 2.0) < 1e-2


def test_a_lag_begins_again_after_a_gap() -> None:
    t_s = np.concatenate([T_S[T_S < 5], T_S[T_S > 9]])
    gap = Gap(float(t_s[t_s < 5][-1]), float(t_s[t_s > 9][0]), "a data gap")
    found = platform_deg(Gimbal("level", heading_lag_s=5.0).carried(flight(t_s, (gap,))))
    first = int(np.searchsorted(t_s, 9.0))
    assert (found[first, 0] - angles_deg(t_s)[first, 0]) % 360 == pytest.approx(0, abs=1e-9)


def test_a_flight_is_carried_once_whatever_carried_it_before() -> None:
    bare, level = flight(), Gimbal("level")
    once = level.carried(bare)
    twice = level.carried(once)
    assert np.array_equal(once.attitude.q_body_ned, twice.attitude.q_body_ned)
    assert once.aircraft_attitude is bare.attitude
    assert twice.aircraft_attitude is bare.attitude
    assert Gimbal().carried(bare) is bare
    assert Gimbal().carried(once).attitude is bare.attitude
