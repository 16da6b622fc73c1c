"""Integrated rates of gyros between and beside their readings, and platforms of gimbals, against finer integration."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from glstar.errors import TelemetryError
from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.flight.flight import GimbalAttitude
from glstar.flight.gimbal import Gimbal, lagged
from glstar.flight.gyroaided import GyroAlignment, GyroTrack, gyro_aided
from glstar.rotation import multiply, quaternion_from_euler, quaternion_from_turn, turn_between
from glstar.sky.place.site import Site
from tests.flight.test_interpolation import between_rad, manoeuvre, measured


def integrated(start_s: float, stop_s: float, rate, steps: int = 2000) -> np.ndarray:
    """Return the attitude relative to that at the start, by small turns at the rate in their middle."""
    q, step_s = np.array([1.0, 0, 0, 0]), (stop_s - start_s) / steps
    for k in range(steps):
        q = multiply(quaternion_from_turn(rate(start_s + (k + 0.5) * step_s) * step_s), q)
    return q


def test_rates_about_one_axis_are_integrated_as_a_parabola_where_steps_are_even() -> None:
    t_s = np.array([2.0, 2.1, 2.25, 2.35, 2.6, 2.7, 3.0, 3.1, 3.17, 3.32])
    axis = np.array([0.6, 0.0, 0.8])

    def rate(s):
        return 1.5 - 4.0 * (s - 2.4) + 9.0 * (s - 2.4) ** 2

    def whole(s):
        return 1.5 * s - 2.0 * (s - 2.4) ** 2 + 3.0 * (s - 2.4) ** 3

    gyro = GyroTrack.from_rates(t_s, rate(t_s)[:, np.newaxis] * axis)
    h = np.diff(t_s)
    # A trapezium has the error h^3 / 12 of the curvature, 18: half of it by each end.  Steps that differ by a factor of
    # two or more have no curvature there, and neither have the first and the last reading.
    even = [False, True, True, False, False, False, False, True, False, False]
    known = np.array([even[k] + even[k + 1] for k in range(9)]) / 2
    expected = np.diff(whole(t_s)) + (1 - known) * h**3 / 12 * 18
    np.testing.assert_allclose(gyro.turn_rad, expected[:, np.newaxis] * axis, rtol=0, atol=1e-12)
    turned = quaternion_from_turn(np.concatenate([[0], np.cumsum(expected)])[:, np.newaxis] * axis)
    np.testing.assert_allclose(gyro.q_body_start, turned, rtol=0, atol=1e-12)
    assert not gyro.is_gap.any()
    paused = np.array([0.0, 0.1, 0.2, 0.3, 0.59, 0.69, 1.0, 1.1])
    assert GyroTrack.from_rates(paused, np.zeros((8, 3))).is_gap.tolist() == [False] * 5 + [True, False]


def test_a_rate_that_changes_its_axis_is_corrected_for_coning() -> None:
    t_s, rates = np.array([5.0, 5.05]), np.array([[2.0, -1.0, 0.5], [-1.0, 2.0, 1.5]])
    gyro = GyroTrack.from_rates(t_s, rates)

    def rate(s: float) -> np.ndarray:
        return rates[0] + (rates[1] - rates[0]) * (s - 5.0) / 0.05

    for s, most_rad in ((5.015, 2e-5), (5.035, 2e-5), (5.05, 2e-5)):
        (found,) = gyro.at(np.array([s]))
        assert between_rad(found, integrated(5.0, s, rate)) < most_rad
    # Beside the readings their ends count.
    np.testing.assert_allclose(gyro.at(np.array([4.0, 7.0])), gyro.q_body_start, rtol=0, atol=1e-12)
    np.testing.assert_allclose(gyro.rates_at(np.array([5.02, 9.0])), [rate(5.02), rates[1]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("ends_s", "is_covered"),
    [
        ((0.55, 0.65), True),
        ((0.5, 0.8), True),
        ((0.45, 0.6), False),  # in the pause before the second reading
        ((0.0, 0.5), False),
        ((-0.1, 0.0), False),
        ((0.7, 0.9), True),
        ((0.7, 1.0), False),  # in the pause before the last ones
        ((0.9, 1.9), False),
        ((1.9, 2.0), True),
        ((1.95, 2.05), False),
    ],
)
def test_an_interval_is_covered_by_readings_without_a_pause(ends_s: tuple[float, float], is_covered: bool) -> None:
    t_s = np.array([0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 1.9, 2.0])
    gyro = GyroTrack.from_rates(t_s, np.zeros((8, 3)))
    assert gyro.is_gap.tolist() == [True, False, False, False, False, True, False]
    assert gyro.covers(np.array(ends_s)).tolist() == [is_covered]


def test_readings_near_a_sample_are_left_out_and_the_drift_of_each_interval_is_its_own() -> None:
    t_s, step_s = np.arange(0, 0.45, 0.1), 0.02
    rate_s = np.concatenate([[-0.037], np.arange(-0.017, 0.46, step_s)])
    q = manoeuvre(t_s)
    # The first sample is turned against the others, by 0.01 rad.
    q[0] = multiply(quaternion_from_turn([0.006, -0.008, 0.0]), q[0])
    aided = gyro_aided(t_s, q, rate_s, measured(rate_s))

    # A quarter of the interval of the gyros is 5 ms.
    far = [s for s in rate_s if 0 < s < 0.4 and np.abs(t_s - s).min() > 0.005]
    assert min(far) < 0.1
    assert max(far) > 0.3
    np.testing.assert_array_equal(aided.t_s, np.sort(np.concatenate([t_s, far])))
    gyro = GyroTrack.from_rates(rate_s, measured(rate_s))
    residual = gyro.residuals(t_s, q)
    assert np.linalg.norm(residual[0]) == pytest.approx(0.01, rel=0.05)
    assert np.linalg.norm(residual[1:], axis=1).max() < 1e-4
    for low, high in ((0.0, 0.1), (0.2, 0.3)):
        for s in [s for s in far if low < s < high]:
            # A part of the residual turn that is proportional to the time is added to the turn of the gyros.
            k = round(low / 0.1)
            expected = multiply(gyro.at(np.array([s]))[0], np.array([1.0, 0, 0, 0]))
            since = multiply(expected, gyro.at(np.array([low]))[0] * [1, -1, -1, -1])
            plain = multiply(since, q[k])
            left = turn_between(plain, aided.at(s))
            np.testing.assert_allclose(left, residual[k] * (s - low) / 0.1, rtol=0, atol=3e-4)
            # So is the rate, by a tenth of a second.
            after, before = aided.at(s + 1e-4), aided.at(s - 1e-4)
            found = turn_between(before, after) / 2e-4
            np.testing.assert_allclose(found, measured(np.array([s]))[0] + residual[k] / 0.1, rtol=0, atol=6e-3)


def test_a_lag_is_that_of_a_value_that_is_linear_between_uneven_samples() -> None:
    t_s = np.array([1.0, 1.3, 1.4, 2.0, 2.1, 2.6])
    value = np.array([3.0, 5.0, 4.0, -2.0, 7.0, 6.5])
    first = np.array([True, False, False, False, True, False])
    found = lagged(t_s, value, first, 0.45)

    def until(start: int, stop: int) -> np.ndarray:
        solved = solve_ivp(
            lambda s, y: (np.interp(s, t_s, value) - y) / 0.45,
            (t_s[start], t_s[stop]),
            [value[start]],
            t_eval=t_s[start : stop + 1],
            rtol=1e-9,
            atol=1e-9,
            max_step=0.01,
        )
        return solved.y[0]

    np.testing.assert_allclose(found, [*until(0, 3), *until(4, 5)], rtol=0, atol=1e-6)
    assert lagged(t_s, value, first, 0.0) is value
    assert lagged(t_s, value, first, -1.0) is value


@pytest.mark.parametrize(("given", "expected"), [("slerp", "slerp"), ("spline", "spline"), ("gyro", "spline")])
def test_a_platform_is_interpolated_as_the_aircraft_without_its_gyros(given: str, expected: str) -> None:
    t_s = np.arange(0, 1, 0.1)
    rates = (t_s, np.zeros((10, 3))) if given == "gyro" else None
    own = AttitudeTrack.from_samples(t_s, manoeuvre(t_s), interpolation=given, rates=rates)
    carried = Gimbal("level").carried(Flight(own, PositionTrack.fixed(Site(-0.6, 2.4))))
    assert carried.attitude.interpolation == expected


def recorded(times_s: list[float], own: AttitudeTrack, is_earth: list[bool]) -> Flight:
    q = manoeuvre(np.array(times_s) + 50)
    gimbal = GimbalAttitude(np.array(times_s), q, np.array(is_earth), "MOUNT")
    return Flight(own, PositionTrack.fixed(Site(-0.6, 2.4)), "log.bin", gimbal=gimbal)


def test_a_recorded_platform_is_known_within_the_attitude_of_the_aircraft() -> None:
    t_s = np.array([10.0, 10.5, 11.0, 12.0, 13.0, 14.0])
    q = quaternion_from_euler(0.1 * t_s, -0.05 * t_s, 0.4 * t_s)
    own = AttitudeTrack(t_s, q, (Gap(11.0, 12.0, "a data gap"),))
    times_s = [9.9, 10.0, 10.5, 11.0, 11.5, 12.0, 13.0, 14.0, 14.1]
    is_earth = [False, True, False, False, False, True, False, True, False]

    carried = Gimbal("log").carried(recorded(times_s, own, is_earth))

    found = carried.attitude
    assert found.utc_s.tolist() == t_s.tolist()
    assert found.gaps == (Gap(11.0, 12.0, "a gap in the aircraft's attitude"),)
    assert (found.interpolation, carried.own_attitude) == ("slerp", own)
    for s, level in zip(t_s, (False, True, True, False, True, False), strict=True):
        heading = 0.4 * s if level else 0.0
        expected = multiply(manoeuvre(np.array([s + 50]))[0], quaternion_from_euler(0.0, 0.0, heading))
        assert between_rad(found.at([s])[0], expected) < 1e-9
    two = Gimbal("log").carried(recorded([10.1, 10.3, 14.2], own, [True] * 3))
    assert two.attitude.utc_s.tolist() == [10.1, 10.3]
    with pytest.raises(TelemetryError) as caught:
        Gimbal("log").carried(recorded([10.1, 11.3, 14.2], own, [True] * 3))
    assert str(caught.value) == (
        "log.bin: fewer than two samples of MOUNT lie within the attitude of the aircraft;"
        ' take [mount] gimbal = "level" or "none"'
    )
    smooth = AttitudeTrack(t_s, q, (), "spline")
    assert Gimbal("log").carried(recorded(times_s, smooth, is_earth)).attitude.interpolation == "spline"


def chunks(t_s: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the mean rates over half seconds of attitudes at 10 Hz, (k, 3)."""
    turns = np.array([turn_between(q[k], q[k + 1]) for k in range(len(q) - 1)])
    return np.array([turns[k : k + 5].sum(axis=0) / 0.1 / len(turns[k : k + 5]) for k in range(0, len(turns), 5)])


ATTITUDE_S, GYRO_S = np.arange(0, 8.05, 0.1), np.arange(-0.1, 8.3, 0.005)


def test_gyros_with_other_axes_are_rotated_to_those_of_the_attitude() -> None:
    C_body_gyro = Rotation.from_rotvec([0.1, -0.3, 0.2]).as_matrix()
    q, body = manoeuvre(ATTITUDE_S), measured(GYRO_S)
    found = GyroAlignment.of(ATTITUDE_S, q, GYRO_S, body @ C_body_gyro)

    np.testing.assert_allclose(found.C_body_gyro, C_body_gyro, rtol=0, atol=3e-3)
    assert found.angle_deg == pytest.approx(np.rad2deg(np.sqrt(0.14)), abs=0.2)
    mean = chunks(ATTITUDE_S, q)
    difference = mean - mean @ C_body_gyro
    assert found.residual_deg_per_s == pytest.approx(np.rad2deg(np.sqrt((difference**2).sum(axis=1).mean())), rel=0.01)
    # A smaller rotation than the noise of rates is none, and so is one that is not determined, about the only axis.
    small = GyroAlignment.of(ATTITUDE_S, q, GYRO_S, body @ Rotation.from_rotvec([0.001, -0.002, 0.001]).as_matrix())
    np.testing.assert_array_equal(small.C_body_gyro, np.eye(3))
    assert (small.angle_deg, small.residual_deg_per_s) == (0.0, pytest.approx(0.05, abs=0.05))
    about_one = quaternion_from_turn(np.sin(2 * ATTITUDE_S)[:, np.newaxis] * [0.5, 0.0, 0.0])
    rates = 2 * np.cos(2 * GYRO_S)[:, np.newaxis] * [0.5, 0.0, 0.0]
    assert GyroAlignment.of(ATTITUDE_S, about_one, GYRO_S, rates).angle_deg == 0.0
    turned = GyroAlignment.of(ATTITUDE_S, about_one, GYRO_S, rates @ Rotation.from_rotvec([0, 0, 1.0]).as_matrix())
    assert (turned.C_body_gyro, turned.angle_deg) == (None, 0.0)


@pytest.mark.parametrize(("bias_deg_per_s", "agrees"), [(0.96, True), (1.04, False)])
def test_a_constant_difference_of_gyros_is_a_bias_up_to_a_limit(bias_deg_per_s: float, agrees: bool) -> None:
    bias = np.deg2rad(bias_deg_per_s) * np.array([0.6, 0.0, -0.8])
    found = GyroAlignment.of(ATTITUDE_S, manoeuvre(ATTITUDE_S), GYRO_S, measured(GYRO_S) + bias)
    assert (found.C_body_gyro is not None) == agrees
    assert found.residual_deg_per_s == pytest.approx(bias_deg_per_s, rel=0.02)


@pytest.mark.parametrize(("part", "agrees"), [(0.95, True), (1.05, False)])
def test_gyros_of_another_scale_agree_up_to_a_fifth_of_the_rate(part: float, agrees: bool) -> None:
    q = manoeuvre(ATTITUDE_S)
    mean = chunks(ATTITUDE_S, q)
    allowed = np.deg2rad(0.2) + 0.2 * np.sqrt((mean**2).sum(axis=1).mean())
    scatter = np.sqrt(((mean - mean.mean(axis=0)) ** 2).sum(axis=1).mean())
    rates = measured(GYRO_S) - part * allowed / scatter * (measured(GYRO_S) - mean.mean(axis=0))
    assert (GyroAlignment.of(ATTITUDE_S, q, GYRO_S, rates).C_body_gyro is not None) == agrees


def test_attitudes_and_gyros_are_compared_over_the_time_that_they_share() -> None:
    q, rates = manoeuvre(ATTITUDE_S), measured(GYRO_S)
    assert GyroAlignment.of(ATTITUDE_S + 100, q, GYRO_S, rates) is None
    assert GyroAlignment.of(ATTITUDE_S, q, GYRO_S[:1], rates[:1]) is None
    assert GyroAlignment.of(ATTITUDE_S[:1], q[:1], GYRO_S, rates) is None
    two = GyroAlignment.of(ATTITUDE_S[:2], q[:2], GYRO_S, rates)
    assert (two.angle_deg, two.residual_deg_per_s) == (0.0, pytest.approx(0, abs=0.02))
    # Repeated times count once; over a pause of the attitude nothing is compared.
    kept = np.delete(np.arange(ATTITUDE_S.size), np.s_[20:29])
    which = np.sort(np.concatenate([kept, kept[3:6]]))
    other = q.copy()
    other[29:] = multiply(other[29:], quaternion_from_turn([1.0, 0.0, 0.5]))
    paused = GyroAlignment.of(ATTITUDE_S[which], other[which], GYRO_S, rates)
    np.testing.assert_array_equal(paused.C_body_gyro, np.eye(3))
    assert paused.residual_deg_per_s < 0.05


@pytest.mark.parametrize(("part", "is_rotated"), [(0.104, True), (0.096, False)])
def test_a_rotation_of_gyros_needs_turns_about_a_second_axis(part: float, is_rotated: bool) -> None:
    """Two oscillations about two axes, of which one has the given part of the other."""
    body = np.stack([np.cos(np.pi / 2 * GYRO_S), part * np.sin(np.pi / 2 * GYRO_S), 0 * GYRO_S], axis=-1)
    # Attitudes by integration, at every twentieth reading from time 0 on.
    q = GyroTrack.from_rates(GYRO_S, body).q_body_start[20::20]
    t_s = GYRO_S[20::20]
    mean = chunks(t_s[:81], q[:81])
    ratio = np.linalg.svd(mean, compute_uv=False)
    assert ratio[1] / ratio[0] == pytest.approx(part, rel=0.03)
    C = Rotation.from_rotvec([0.0, 0.0, 0.6]).as_matrix()
    found = GyroAlignment.of(t_s[:81], q[:81], GYRO_S, body @ C)
    assert (found.angle_deg > 30) == is_rotated
