"""Attitude between samples: the spline, the gyros, and resets of the estimator."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.spatial.transform import RotationSpline as ScipysSpline

from glstar.flight import AttitudeTrack
from glstar.flight.attitude import estimator_resets
from glstar.flight.gyroaided import GyroTrack, gyro_aided, gyro_lag_s
from glstar.flight.spline import RotationSpline
from glstar.rotation import (
    conjugate,
    multiply,
    quaternion_from_euler,
    quaternion_from_turn,
    slerp,
    turn_between,
    turn_from_quaternion,
)
from glstar.system.resources import asset
from glstar.telemetry import open_flight

ARCSEC = np.pi / 648000
DEG = np.pi / 180
MS = 1e-3
F_PX = 3871.0

many = settings(deadline=None, max_examples=40)


def between_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angle between two attitudes, rad."""
    return np.linalg.norm(turn_from_quaternion(multiply(one, conjugate(other))), axis=-1)


def manoeuvre(t: np.ndarray, vibration_deg: float = 0.0) -> np.ndarray:
    """Return attitudes of smooth rolls, pitches and turns up to 45 deg/s, with vibration at 15 Hz."""
    t = np.asarray(t)
    smooth = quaternion_from_euler(0.6 * np.sin(1.3 * t), 0.15 * np.sin(0.7 * t + 1), 0.3 * t)
    phase = 2 * np.pi * 15 * t
    shaken = vibration_deg * DEG * np.stack([np.sin(phase), np.sin(phase + 2), np.sin(phase + 4) / 2], axis=-1)
    return multiply(quaternion_from_turn(shaken), smooth)


def measured(t: np.ndarray, vibration_deg: float = 0.0) -> np.ndarray:
    """Return the body rates of the manoeuvre, rad/s: central differences over 20 us."""
    after, before = (manoeuvre(t + e, vibration_deg) for e in (1e-5, -1e-5))
    return turn_from_quaternion(multiply(after, conjugate(before))) / 2e-5


def slerped(t: np.ndarray, q: np.ndarray, at: np.ndarray) -> np.ndarray:
    after = np.searchsorted(t, at).clip(min=1)
    return slerp(q[after - 1], q[after], (at - t[after - 1]) / (t[after] - t[after - 1]))


def tumbling(seed: int, n: int, *, largest_deg: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    """Return samples of a tumbling aircraft at random intervals of 50 to 150 ms; the signs are arbitrary."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.05, 0.15, n))
    q = [np.array([1.0, 0.0, 0.0, 0.0])]
    for turn in rng.uniform(-1, 1, (n - 1, 3)) * largest_deg * DEG / np.sqrt(3):
        q.append(multiply(quaternion_from_turn(turn), q[-1]))
    return t, np.array(q) * rng.choice([-1.0, 1.0], (n, 1))


# --- the spline -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_the_spline_agrees_with_scipy_away_from_its_ends(seed: int) -> None:
    t, q = tumbling(seed, 81)
    theirs = ScipysSpline(t, Rotation.from_quat(np.roll(conjugate(q), -1, axis=-1)))
    at = np.linspace(t[25], t[55], 1001)

    expected = conjugate(np.roll(theirs(at).as_quat(), 1, axis=-1))

    assert between_rad(RotationSpline.through(t, q).at(at), expected).max() < 1e-6 * ARCSEC


@many
@given(st.integers(0, 10_000), st.integers(2, 30))
def test_the_spline_passes_through_the_samples(seed: int, n: int) -> None:
    t, q = tumbling(seed, n, largest_deg=80)

    assert between_rad(RotationSpline.through(t, q).at(t), q).max() < 1e-6 * ARCSEC


@many
@given(st.integers(0, 10_000))
def test_sign_flips_do_not_change_the_spline(seed: int) -> None:
    t, q = tumbling(seed, 20)
    at = np.linspace(t[0], t[-1], 200)
    signs = (-1.0) ** np.arange(20)[:, np.newaxis]

    assert (
        between_rad(RotationSpline.through(t, signs * q).at(at), RotationSpline.through(t, q).at(at)).max()
        < ARCSEC / 1e6
    )


@many
@given(st.integers(0, 10_000))
def test_the_spline_does_not_depend_on_north_or_on_the_mount_of_the_autopilot(seed: int) -> None:
    t, q = tumbling(seed, 20)
    at = np.linspace(t[0], t[-1], 200)
    mounted, north = (quaternion_from_turn(v) for v in np.random.default_rng(seed).normal(size=(2, 3)))

    turned = RotationSpline.through(t, multiply(multiply(mounted, q), north)).at(at)

    assert (
        between_rad(turned, multiply(multiply(mounted, RotationSpline.through(t, q).at(at)), north)).max()
        < ARCSEC / 1e6
    )


@many
@given(st.integers(0, 10_000), st.integers(-(10**9), 2 * 10**9))
def test_the_spline_does_not_depend_on_the_date(seed: int, shift_s: int) -> None:
    t, q = tumbling(seed, 20)
    at = np.linspace(t[0], t[-1], 200)
    t, at = np.round(t * 2**16) / 2**16, np.round(at * 2**16) / 2**16  # binary fractions, which a shift keeps

    shifted = RotationSpline.through(t + shift_s, q).at(at + shift_s)

    assert between_rad(shifted, RotationSpline.through(t, q).at(at)).max() < 1e-6 * ARCSEC


def test_a_steady_turn_is_exact_at_any_times() -> None:
    t = np.array([0.0, 0.03, 0.05, 0.4, 0.41, 0.9, 1.0])
    at = np.linspace(0, 1, 301)

    def q(s):
        return quaternion_from_turn(np.array([1.0, -2.0, 0.5]) * np.asarray(s)[:, np.newaxis])

    assert between_rad(RotationSpline.through(t, q(t)).at(at), q(at)).max() < 1e-6 * ARCSEC


def test_rate_and_angular_acceleration_do_not_jump_at_the_samples() -> None:
    t, q = tumbling(3, 30)
    curve = RotationSpline.through(t, q)
    e = 1e-4

    def rate(s):
        return turn_from_quaternion(multiply(curve.at(s + e / 2), conjugate(curve.at(s - e / 2)))) / e

    inner = t[1:-1]
    before, after = rate(inner - e), rate(inner + e)
    slope_before = (rate(inner - e) - rate(inner - 2 * e)) / e
    slope_after = (rate(inner + 2 * e) - rate(inner + e)) / e

    scale = np.linalg.norm(slope_before, axis=-1).max()
    np.testing.assert_allclose(
        after - before, e * (slope_before + slope_after), rtol=0, atol=1e-3 * np.abs(before).max()
    )
    np.testing.assert_allclose(slope_after, slope_before, rtol=0, atol=0.02 * scale)


def test_two_samples_are_joined_as_by_slerp() -> None:
    t, q = tumbling(1, 2)
    at = np.linspace(t[0], t[1], 11)

    assert between_rad(RotationSpline.through(t, q).at(at), slerped(t, q, at)).max() < 1e-6 * ARCSEC


def test_a_gap_has_a_constant_rate_and_independent_sides() -> None:
    t, q = tumbling(4, 40)
    broken = np.zeros(39, dtype=bool)
    broken[17] = True
    whole = RotationSpline.through(t, q, broken=broken)
    first, second = RotationSpline.through(t[:18], q[:18]), RotationSpline.through(t[18:], q[18:])
    for part, at in (
        (first.at, np.linspace(t[0], t[17], 100)),
        (second.at, np.linspace(t[18], t[-1], 100)),
        (lambda at: slerped(t, q, at), np.linspace(t[17], t[18], 100)),
    ):
        assert between_rad(whole.at(at), part(at)).max() < 1e-6 * ARCSEC


def test_joined_curves_have_a_constant_rate_between_them() -> None:
    t, q = tumbling(4, 40)
    parts = [RotationSpline.through(t[part], q[part]) for part in (slice(18), slice(18, 30), slice(30, 40))]
    joined = RotationSpline.joined(parts)

    for part in parts:
        at = np.linspace(part.t_s[0], part.t_s[-1], 50)[:-1]
        assert between_rad(joined.at(at), part.at(at)).max() < 1e-6 * ARCSEC
    for before in (17, 29):
        at = np.linspace(t[before], t[before + 1], 50)
        assert between_rad(joined.at(at), slerped(t, q, at)).max() < 1e-6 * ARCSEC


def test_a_spline_at_10_hz_is_four_times_better_than_slerp_on_the_bundled_flight() -> None:
    truth = open_flight(asset("adelaide.BIN")).attitude
    few = slice(None, None, round(truth.rate_hz / 10))
    t, q = truth.utc_s[few], truth.q_body_ned[few]
    inside = truth.utc_s <= t[-1]

    def rms_px(interpolation):
        thinned = AttitudeTrack.from_samples(t, q, interpolation=interpolation, max_gap_s=1.0)
        error_rad = between_rad(thinned.at(truth.utc_s[inside]), truth.q_body_ned[inside])
        return F_PX * np.sqrt(np.mean(error_rad**2))

    assert rms_px("spline") < rms_px("slerp") / 4


# --- the gyros --------------------------------------------------------------------------------------------------------


def test_a_steady_turn_is_integrated_exactly() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(1, 9, 500)) * MS
    rate = np.array([1.0, -2.0, 0.5])

    gyro = GyroTrack.from_rates(t, np.broadcast_to(rate, (500, 3)))

    assert between_rad(gyro.q_body_start, quaternion_from_turn(rate * (t - t[0])[:, np.newaxis])).max() < ARCSEC / 1e6


def test_coning_for_ten_seconds_drifts_by_less_than_a_tenth_of_an_arcsecond() -> None:
    half_angle, about_per_s = 1 * DEG, 2 * np.pi * 5  # 1 deg at 5 Hz, which drifts by 1.7 deg/s uncompensated
    t = np.arange(0, 10, 1 / 400)

    def q(s):
        along = np.stack([np.cos(about_per_s * s), np.sin(about_per_s * s), np.zeros_like(s)], axis=-1)
        return quaternion_from_turn(half_angle * along)

    sine, versine = np.sin(half_angle), 2 * np.sin(half_angle / 2) ** 2
    rate = about_per_s * np.stack(
        [-sine * np.sin(about_per_s * t), sine * np.cos(about_per_s * t), -versine * np.ones_like(t)], axis=-1
    )
    turned = multiply(q(t), conjugate(q(t[:1])))

    assert between_rad(GyroTrack.from_rates(t, rate).q_body_start, turned).max() < 20 * ARCSEC


@pytest.mark.parametrize("gyro_hz", [200, 400])
def test_gyros_resolve_vibration_between_attitudes_at_10_hz(gyro_hz: int) -> None:
    rng = np.random.default_rng(5)
    t, rate_t = np.arange(0, 20, 0.1), np.arange(0, 20, 1 / gyro_hz) + 0.7 * MS
    noise, bias = rng.normal(0, 0.1 * DEG, (rate_t.size, 3)), np.array([0.5, -0.3, 0.2]) * DEG
    at = np.arange(0.2, 19.7, 0.0023)
    truth, q = manoeuvre(at, 0.2), manoeuvre(t, 0.2)

    aided = gyro_aided(t, q, rate_t, measured(rate_t, 0.2) + noise + bias).at(at)

    def rms_px(found):
        return F_PX * np.sqrt(np.mean(between_rad(found, truth) ** 2))

    assert rms_px(slerped(t, q, at)) > 10
    assert rms_px(RotationSpline.through(t, q).at(at)) > 10
    assert rms_px(aided) < 0.15


def test_gyro_samples_leave_the_logged_attitudes_unchanged() -> None:
    t, rate_t = np.arange(0, 5, 0.1), np.arange(0, 5, 0.005)

    aided = gyro_aided(t, manoeuvre(t), rate_t, measured(rate_t))
    dense_t, dense_q = aided.t_s, aided.q_body_ned

    at = np.searchsorted(dense_t, t)
    np.testing.assert_array_equal(dense_t[at], t)
    np.testing.assert_array_equal(dense_q[at], manoeuvre(t))
    assert np.diff(dense_t).min() > 1 * MS


@many
@given(st.floats(-30, 30))
def test_the_lag_of_gyros_is_found_to_a_tenth_of_a_millisecond(lag_ms: float) -> None:
    t, rate_t = np.arange(0, 20, 0.1), np.arange(-0.2, 20.2, 0.005)

    found_s = gyro_lag_s(t, manoeuvre(t), rate_t + lag_ms * MS, measured(rate_t))

    assert found_s == pytest.approx(lag_ms * MS, abs=0.1 * MS)


@pytest.mark.parametrize("lag_ms", [-9.8, 9.8])
def test_the_lag_of_gyros_is_removed_before_integration(lag_ms: float) -> None:
    t, rate_t = np.arange(0, 20, 0.1), np.arange(-0.2, 20.2, 0.005)
    at = np.arange(0.2, 19.7, 0.0023)

    def worst_px(late_s: float) -> float:
        aided = gyro_aided(t, manoeuvre(t, 0.2), rate_t + late_s, measured(rate_t, 0.2)).at(at)
        return F_PX * between_rad(aided, manoeuvre(at, 0.2)).max()

    assert worst_px(lag_ms * MS) < 1.5 * worst_px(0.0) + 0.05


def test_an_aircraft_at_rest_determines_no_lag() -> None:
    rng = np.random.default_rng(0)
    t, rate_t = np.arange(0, 5, 0.1), np.arange(0, 5, 0.005)
    q = quaternion_from_turn(rng.normal(0, 0.01 * DEG, (t.size, 3)))

    assert gyro_lag_s(t, q, rate_t, rng.normal(0, 0.1 * DEG, (rate_t.size, 3))) == 0.0


def test_no_samples_are_added_in_gaps_of_gyros_or_attitude() -> None:
    t, rate_t = np.arange(0, 5, 0.1), np.arange(0, 5, 0.005)
    heard = (rate_t < 2.03) | (rate_t > 2.47)
    broken = np.zeros(t.size - 1, dtype=bool)
    broken[30] = True

    dense_t = gyro_aided(t, manoeuvre(t), rate_t[heard], measured(rate_t[heard]), broken=broken).t_s

    assert np.count_nonzero((dense_t > 2.001) & (dense_t < 2.499)) == 4  # the attitudes at 2.1, 2.2, 2.3, 2.4 s
    assert np.count_nonzero((dense_t > 3.001) & (dense_t < 3.099)) == 0


def test_damaged_gyro_readings_are_dropped() -> None:
    t, rate_t = np.arange(0, 5, 0.1), np.arange(0, 5, 0.005)
    at = np.arange(0.2, 4.7, 0.0023)
    rate, when = measured(rate_t), rate_t.copy()
    rate[100] = np.nan
    rate[200, 1] = np.inf
    rate[300] = 1e9
    rate[400, 2] += 500 * DEG
    when[500] = np.nan

    damaged = gyro_aided(t, manoeuvre(t), when, rate).at(at)

    assert F_PX * between_rad(damaged, manoeuvre(at)).max() < 0.1


@pytest.mark.parametrize("count", [0, 1])
def test_without_gyro_readings_no_samples_are_added(count: int) -> None:
    t = np.arange(0, 1, 0.1)

    dense_t = gyro_aided(t, manoeuvre(t), np.zeros(count), np.zeros((count, 3))).t_s

    np.testing.assert_array_equal(dense_t, t)


# --- resets of the estimator ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [50, 200])
def test_a_reset_of_3_deg_differs_from_its_neighbours(rate_hz: int) -> None:
    t = np.arange(0, 5, 1 / rate_hz)
    q = manoeuvre(t)
    q[100:] = multiply(q[100:], quaternion_from_turn([0, 0, 3 * DEG]))

    np.testing.assert_array_equal(np.flatnonzero(estimator_resets(t, q)), [99])


@pytest.mark.parametrize("rate_hz", [10, 50, 200])
def test_a_reset_of_3_deg_is_not_measured_by_gyros(rate_hz: int) -> None:
    t, rate_t = np.arange(0, 20, 1 / rate_hz), np.arange(-0.1, 20.1, 1 / 400)
    q = manoeuvre(t)
    q[100:] = multiply(q[100:], quaternion_from_turn([0, 0, 3 * DEG]))

    np.testing.assert_array_equal(np.flatnonzero(estimator_resets(t, q, rate_t, measured(rate_t))), [99])


def test_a_sudden_manoeuvre_measured_by_gyros_is_no_reset() -> None:
    t, rate_t = np.arange(0, 5, 0.02), np.arange(0, 5, 0.0025)
    tau_s = 0.006  # 20 deg at up to 830 deg/s
    angle = 10 * DEG * (1 + np.tanh((t - 2.51) / (2 * tau_s)))
    steep = 5 * DEG / tau_s * (1 - np.tanh((rate_t - 2.51) / (2 * tau_s)) ** 2)
    q = quaternion_from_turn(np.stack([angle, 0 * t, 0 * t], axis=-1))
    rate = np.stack([steep, 0 * rate_t, 0 * rate_t], axis=-1)

    assert estimator_resets(t, q).any()
    assert not estimator_resets(t, q, rate_t, rate).any()


@pytest.mark.parametrize("n", [2, 3])
def test_two_samples_have_no_neighbours_to_compare(n: int) -> None:
    t = np.arange(n) * 0.02

    assert estimator_resets(t, quaternion_from_turn(np.outer(np.arange(n) ** 2, [1.0, 0, 0]))).shape == (n - 1,)


LOGS = Path(__file__).resolve().parents[3] / "shared" / "logs"


@pytest.mark.skipif(not LOGS.is_dir(), reason="needs ../shared/logs")
@pytest.mark.parametrize("thinned", [1, 2, 4])
def test_manoeuvres_of_a_flying_wing_at_200_deg_per_s_are_no_resets(thinned: int) -> None:
    track = open_flight(LOGS / "plane_skywalkerX8_TestLog2.reenc.BIN").attitude

    assert not estimator_resets(track.utc_s[::thinned], track.q_body_ned[::thinned]).any()


@pytest.mark.parametrize("gaps", [[0], [5], [0, 5], [0, 1], [4, 5], [2, 3], [0, 1, 2, 3, 4, 5]])
def test_gaps_at_the_ends_have_a_constant_rate(gaps: list[int]) -> None:
    t = np.array([0.0, 0.1, 0.25, 0.3, 0.45, 0.6, 0.7])
    q = manoeuvre(t)
    broken = np.isin(np.arange(6), gaps)
    curve = RotationSpline.through(t, q, broken=broken)
    for k in range(6):
        begin, middle, end = curve.at(t[k]), curve.at((t[k] + t[k + 1]) / 2), curve.at(t[k + 1] - 1e-12)
        bend_rad = np.linalg.norm(turn_between(begin, middle) - turn_between(middle, end))
        if broken[k]:
            assert bend_rad < 1e-9
        np.testing.assert_allclose(turn_between(end, q[k + 1]), 0, rtol=0, atol=1e-9)
    inner = ~broken
    for first in np.flatnonzero(inner):
        # What lies before a gap does not change what lies behind it.
        last = first + int(np.argmin(np.append(inner[first:], False)))
        if first == 0 or broken[first - 1]:
            alone = RotationSpline.through(t[first : last + 1], q[first : last + 1])
            at = np.linspace(t[first], t[last] - 1e-9, 9)
            np.testing.assert_allclose(turn_between(alone.at(at), curve.at(at)), 0, rtol=0, atol=1e-9)
