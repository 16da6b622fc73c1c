"""Attitude and position of an aircraft over UTC."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glstar.errors import ConfigError, TelemetryError, TrackRangeError
from glstar.flight import AttitudeTrack, Flight, Gap, PositionTrack
from glstar.rotation import conjugate, multiply, quaternion_from_euler, slerp
from glstar.sky.place.site import Site

ARCSEC = np.pi / 648000
DEG = np.pi / 180
EIGHT_DEG_PER_S = 8 * DEG  # the turn of Teague & Chahl, figure 6
NAN = float("nan")

many = settings(deadline=None, max_examples=100)


def yawing(rate_rad_per_s: float, t: np.ndarray) -> np.ndarray:
    """Return the attitude of a level aircraft in a steady turn."""
    return quaternion_from_euler(0.0, 0.0, rate_rad_per_s * np.asarray(t))


def ends(gaps: tuple[Gap, ...]) -> np.ndarray:
    """Return start and stop of all gaps, (k, 2)."""
    return np.array([(gap.start_utc_s, gap.stop_utc_s) for gap in gaps]).reshape(-1, 2)


def between_rad(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angle between two attitudes, for any signs of their quaternions, rad."""
    difference = multiply(one, conjugate(other))
    return 2 * np.arctan2(np.linalg.norm(difference[..., 1:], axis=-1), np.abs(difference[..., 0]))


@pytest.fixture
def turn() -> AttitudeTrack:
    """One second of a steady turn at 30 Hz."""
    samples = np.linspace(0.0, 1.0, 31)
    return AttitudeTrack(samples, yawing(EIGHT_DEG_PER_S, samples))


@many
@given(st.floats(0.0, 1.0))
def test_a_steady_turn_stays_steady_between_samples(utc_s: float) -> None:
    samples = np.linspace(0.0, 1.0, 31)
    track = AttitudeTrack(samples, yawing(EIGHT_DEG_PER_S, samples))

    assert between_rad(track.at([utc_s]), yawing(EIGHT_DEG_PER_S, [utc_s])).max() < 1e-6 * ARCSEC


def test_the_track_passes_through_the_logged_samples(turn: AttitudeTrack) -> None:
    assert between_rad(turn.at(turn.utc_s), turn.q_body_ned).max() < 1e-7 * ARCSEC


def test_a_sign_flip_in_the_log_is_no_rotation(turn: AttitudeTrack) -> None:
    signs = (-1.0) ** np.arange(31)[:, np.newaxis]
    flipped = AttitudeTrack(turn.utc_s, signs * turn.q_body_ned)
    times = [0.21, 0.35, 0.52]

    assert between_rad(flipped.at(times), turn.at(times)).max() < 1e-6 * ARCSEC


def test_one_time_gives_one_attitude(turn: AttitudeTrack) -> None:
    assert turn.at(0.5).shape == (4,)
    assert turn.at([0.5]).shape == (1, 4)


def test_the_track_ends_where_the_log_ends(turn: AttitudeTrack) -> None:
    with pytest.raises(TrackRangeError, match=r"lasts 1\.000 s and cannot .* 0\.250 s after it ends") as caught:
        turn.at([0.5, 1.25, 7.0])

    assert (caught.value.asked_s, caught.value.first_s, caught.value.last_s) == (1.25, 0.0, 1.0)


def test_the_track_begins_where_the_log_begins(turn: AttitudeTrack) -> None:
    with pytest.raises(TrackRangeError, match=r"0\.125 s before it starts; move the exposure inside the log") as caught:
        turn.at([-0.125, 0.5])

    assert caught.value.asked_s == -0.125


def test_both_ends_of_a_track_belong_to_it(turn: AttitudeTrack) -> None:
    assert turn.at([turn.first_s, turn.last_s]).shape == (2, 4)
    microsecond = 1e-6  # rounding of UTC seconds in float64
    assert turn.at([turn.first_s - 0.5 * microsecond, turn.last_s + 0.5 * microsecond]).shape == (2, 4)
    for outside in (turn.first_s - 2 * microsecond, turn.last_s + 2 * microsecond):
        with pytest.raises(TrackRangeError):
            turn.at([outside])


def test_nan_is_not_a_time_of_the_track(turn: AttitudeTrack) -> None:
    with pytest.raises(TrackRangeError):
        turn.at([0.5, NAN])


def test_a_track_knows_its_ends_and_its_rate(turn: AttitudeTrack) -> None:
    assert (turn.first_s, turn.last_s) == (0.0, 1.0)
    assert turn.rate_hz == pytest.approx(30.0)


def test_a_track_cannot_be_changed(turn: AttitudeTrack) -> None:
    for array in (turn.utc_s, turn.q_body_ned):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


@pytest.mark.parametrize("times", [[0.0, 1.0, 1.0], [0.0, 2.0, 1.0], [0.0, NAN, 1.0]])
def test_times_that_do_not_increase_are_refused(times: list[float]) -> None:
    with pytest.raises(TelemetryError, match="the times of an attitude track must increase"):
        AttitudeTrack(np.array(times), yawing(0.1, np.arange(3.0)))


def test_two_attitudes_are_a_track_that_turns_at_their_rate() -> None:
    track = AttitudeTrack(np.arange(2.0), yawing(0.1, np.arange(2.0)))

    np.testing.assert_allclose(track.at([0.0, 0.25, 1.0]), yawing(0.1, np.array([0.0, 0.25, 1.0])), rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [0, 1])
def test_one_attitude_is_no_track(n: int) -> None:
    with pytest.raises(TelemetryError, match=f"two samples or more, not {n}"):
        AttitudeTrack(np.arange(float(n)), yawing(0.1, np.arange(float(n))))


def test_times_and_quaternions_must_have_equal_length() -> None:
    with pytest.raises(TelemetryError, match=r"not \(3,\) with \(2, 4\)"):
        AttitudeTrack(np.arange(3.0), yawing(0.1, np.arange(2.0)))


def test_samples_are_sorted(turn: AttitudeTrack) -> None:
    order = np.random.default_rng(0).permutation(31)
    track = AttitudeTrack.from_samples(turn.utc_s[order], turn.q_body_ned[order])

    np.testing.assert_array_equal(track.utc_s, turn.utc_s)
    np.testing.assert_allclose(track.q_body_ned, turn.q_body_ned, rtol=0, atol=1e-15)


def test_the_first_of_samples_with_equal_times_is_used() -> None:
    q = yawing(1.0, np.array([0.0, 0.1, 0.2, 0.3]))
    track = AttitudeTrack.from_samples([5.0, 6.0, 6.0, 5.0], q)

    np.testing.assert_array_equal(track.utc_s, [5.0, 6.0])
    np.testing.assert_allclose(track.q_body_ned, q[:2], rtol=0, atol=1e-15)


def test_invalid_quaternions_are_dropped() -> None:
    q = yawing(1.0, np.linspace(0.0, 0.5, 6))
    q[1] = NAN
    q[2] = 0.0
    q[3, 2] = np.inf
    track = AttitudeTrack.from_samples([0.0, 1.0, 2.0, 3.0, NAN, 5.0], q)

    np.testing.assert_array_equal(track.utc_s, [0.0, 5.0])


def test_rounded_quaternions_are_normalised() -> None:
    samples = np.linspace(0.0, 1.0, 11)
    track = AttitudeTrack.from_samples(samples, np.round(yawing(1.0, samples), 3) * np.linspace(0.5, 2.0, 11)[:, None])

    np.testing.assert_allclose(np.linalg.norm(track.q_body_ned, axis=-1), 1.0, rtol=0, atol=1e-15)
    assert between_rad(track.q_body_ned, yawing(1.0, samples)).max() < 0.002


def test_a_single_valid_sample_is_refused() -> None:
    with pytest.raises(TelemetryError, match="two samples or more, not 1"):
        AttitudeTrack.from_samples([1.0, 1.0, NAN], yawing(1.0, np.zeros(3)))


def test_a_gap_of_three_intervals_and_a_tenth_of_a_second_is_a_gap() -> None:
    at_200_hz = np.concatenate([np.arange(0, 1, 0.005), np.arange(1.09, 2, 0.005), np.arange(2.3, 3, 0.005)])
    track = AttitudeTrack.from_samples(at_200_hz, yawing(0.1, at_200_hz))

    np.testing.assert_allclose(ends(track.gaps), [[1.995, 2.3]], rtol=0, atol=1e-9)
    assert track.gaps[0].reason == "a data gap"

    at_10_hz = np.array([0.0, 0.1, 0.2, 0.3, 0.55, 0.65, 0.75, 1.1])
    track = AttitudeTrack.from_samples(at_10_hz, yawing(0.1, at_10_hz))

    np.testing.assert_allclose(ends(track.gaps), [[0.75, 1.1]], rtol=0, atol=1e-9)


def test_the_longest_interpolated_gap_can_be_set() -> None:
    samples = np.array([0.0, 0.1, 0.2, 0.6, 0.7])
    q = yawing(0.1, samples)

    assert AttitudeTrack.from_samples(samples, q, max_gap_s=0.5).gaps == ()
    np.testing.assert_allclose(
        ends(AttitudeTrack.from_samples(samples, q, max_gap_s=0.3).gaps), [[0.2, 0.6]], rtol=0, atol=1e-9
    )


def test_segments_remain_separate_for_any_longest_gap() -> None:
    samples = np.array([0.0, 0.1, 0.2, 0.6, 0.7])
    segment = [0, 0, 1, 1, 1]
    track = AttitudeTrack.from_samples(
        samples, yawing(0.1, samples), segment=segment, break_reason="a switch of the EKF lane", max_gap_s=10.0
    )

    assert track.gaps == (Gap(0.1, 0.2, "a switch of the EKF lane"),)


def test_the_longest_gap_within_an_interval_is_found() -> None:
    samples = np.array([0.0, 1.0, 2.0, 3.0])
    short, long = Gap(0.5, 1.0, "short"), Gap(2.0, 3.0, "long")
    track = AttitudeTrack(samples, yawing(0.1, samples), (short, long))

    assert track.gap_within(0.0, 0.5) is None
    assert track.gap_within(1.0, 2.0) is None
    assert track.gap_within(0.9, 1.5) == short
    assert track.gap_within(0.0, 3.0) == long
    assert track.gap_within(2.4, 2.6) == long
    assert long.duration_s == 1.0
    covered = [time for time in (-0.1, 0.0, 0.4, 0.7, 1.0, 1.9, 2.5, 3.0, 3.1) if track.covers(time)]
    assert covered == [0.0, 0.4, 1.0, 1.9, 3.0]


def test_a_continuous_track_has_no_gaps(turn: AttitudeTrack) -> None:
    assert turn.gaps == ()
    assert turn.gap_within(0.0, 1.0) is None


def places(utc_s: list[float], longitude_deg: list[float]) -> PositionTrack:
    """A track along a parallel, climbing."""
    n = len(utc_s)
    return PositionTrack.from_samples(
        utc_s, np.full(n, -34.93 * DEG), np.array(longitude_deg) * DEG, np.arange(n) * 100.0
    )


def test_positions_between_samples_are_interpolated() -> None:
    site = places([0.0, 10.0], [138.0, 139.0]).at(2.5)

    assert site.latitude_rad == pytest.approx(-34.93 * DEG)
    assert site.longitude_rad == pytest.approx(138.25 * DEG)
    assert site.height_m == pytest.approx(25.0)


@pytest.mark.parametrize(("west_deg", "east_deg"), [(179.0, -179.0), (179.0, 181.0), (-181.0, -179.0)])
def test_a_flight_across_the_date_line_does_not_fly_round_the_world(west_deg: float, east_deg: float) -> None:
    track = places([0.0, 10.0], [west_deg, east_deg])

    assert track.at(2.5).longitude_rad == pytest.approx(179.5 * DEG)
    assert abs(track.at(5.0).longitude_rad) == pytest.approx(180.0 * DEG)
    assert track.at(7.5).longitude_rad == pytest.approx(-179.5 * DEG)


def test_outside_the_track_the_nearest_position_is_used() -> None:
    track = places([0.0, 10.0], [138.0, 139.0])

    assert track.at(-1e6).longitude_rad == pytest.approx(138.0 * DEG)
    assert track.at(1e6).longitude_rad == pytest.approx(139.0 * DEG)
    assert track.at(1e6).height_m == 100.0


def test_an_observer_at_rest_has_one_position() -> None:
    site = Site(-34.93 * DEG, 138.60 * DEG, 48.0)
    track = PositionTrack.fixed(site)

    for utc_s in (-1e9, 0.0, 1710068400.0):
        there = track.at(utc_s)
        assert there.latitude_rad == site.latitude_rad
        assert there.longitude_rad == pytest.approx(site.longitude_rad, abs=1e-15)
        assert there.height_m == site.height_m


def test_coordinates_of_many_times_are_those_of_each() -> None:
    track = places([0.0, 10.0, 20.0], [178.0, -179.0, -178.0])
    times = np.array([-5.0, 0.0, 4.0, 10.0, 19.0, 30.0])

    each = [track.at(t) for t in times]
    latitude_rad, longitude_rad, height_m = track.coordinates(times)
    np.testing.assert_array_equal(latitude_rad, [site.latitude_rad for site in each])
    np.testing.assert_array_equal(longitude_rad, [site.longitude_rad for site in each])
    np.testing.assert_array_equal(height_m, [site.height_m for site in each])


def test_positions_are_sorted_and_the_first_of_repeated_ones_is_used() -> None:
    track = places([20.0, 0.0, 10.0, 0.0, NAN], [3.0, 1.0, 2.0, 9.0, 4.0])

    np.testing.assert_array_equal(track.utc_s, [0.0, 10.0, 20.0])
    np.testing.assert_allclose(track.longitude_rad, np.array([1.0, 2.0, 3.0]) * DEG, rtol=0, atol=1e-12)


def test_positions_that_are_not_finite_are_dropped() -> None:
    track = PositionTrack.from_samples([0, 1, 2, 3], [NAN, 0.1, 0.2, 0.3], [0, np.inf, 1, 2], [0, 0, 0, NAN])

    np.testing.assert_array_equal(track.utc_s, [2.0])


def test_each_column_of_a_position_track_is_in_consecutive_memory():
    track = PositionTrack.from_samples([2, 0, 1], [0.2, 0.0, 0.1], [1.2, 1.0, 1.1], [30, 10, 20])
    for column in (track.utc_s, track.latitude_rad, track.longitude_rad, track.height_m):
        assert column.flags.c_contiguous


def test_a_track_without_positions_is_refused() -> None:
    with pytest.raises(TelemetryError, match="four columns of one length"):
        PositionTrack.from_samples([NAN], [0.0], [0.0], [0.0])


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(TelemetryError, match="four columns of one length"):
        PositionTrack(np.arange(2.0), np.zeros(2), np.zeros(3), np.zeros(2))


def test_times_of_positions_must_increase() -> None:
    with pytest.raises(TelemetryError, match="the times of a position track must increase"):
        PositionTrack(np.array([1.0, 1.0]), np.zeros(2), np.zeros(2), np.zeros(2))


def test_positions_without_a_time_are_dropped() -> None:
    with pytest.raises(ConfigError, match="finite"):
        places([0.0, 10.0], [138.0, 139.0]).at(NAN)


def test_a_flight_names_its_sources(turn: AttitudeTrack) -> None:
    flight = Flight(turn, PositionTrack.fixed(Site(0.0, 0.0)), utc_source="GPS")

    assert (flight.name, flight.attitude_source, flight.utc_source) == ("flight", "given", "GPS")


def test_a_reset_of_the_estimator_is_a_gap_and_no_rotation() -> None:
    t = np.arange(0.0, 1.0, 0.02)
    q = quaternion_from_euler(0 * t, 0 * t, np.where(t > 0.5, np.deg2rad(-60), np.deg2rad(100) * t))
    track = AttitudeTrack.from_samples(t, q)
    np.testing.assert_allclose(ends(track.gaps), [[0.5, 0.52]], rtol=0, atol=1e-9)
    assert track.gaps[0].reason == "a jump"


def test_samples_with_nearly_equal_timestamps_are_no_reset() -> None:
    t = np.array([0.0, 0.02, 0.020001, 0.04])
    track = AttitudeTrack.from_samples(t, quaternion_from_euler(0 * t, 0 * t, np.deg2rad([0.0, 0.1, 0.11, 0.2])))
    assert len(track.gaps) == 0


# --- between the samples ----------------------------------------------------------------------------------------------


def rolling(t: np.ndarray) -> np.ndarray:
    return quaternion_from_euler(0.5 * np.sin(2 * np.asarray(t)), 0.0, 0.0)


def roll_rates(t: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(2 * t), 0 * t, 0 * t], axis=-1)


def test_a_track_interpolates_by_its_method() -> None:
    t, fast, times = np.arange(0, 5, 0.2), np.arange(-0.1, 5, 0.005), np.linspace(0.5, 4.5, 401)
    error_arcsec = {
        method: between_rad(
            AttitudeTrack.from_samples(t, rolling(t), interpolation=method, rates=(fast, roll_rates(fast))).at(times),
            rolling(times),
        ).max()
        / ARCSEC
        for method in ("slerp", "spline", "gyro")
    }

    assert error_arcsec["slerp"] > 1000
    assert error_arcsec["spline"] < 100
    assert error_arcsec["gyro"] < 1


def test_a_gyro_aided_track_has_a_sample_at_every_gyro_reading() -> None:
    t, fast = np.arange(0, 5, 0.2), np.arange(-0.1, 5, 0.005)

    track = AttitudeTrack.from_samples(t, rolling(t), interpolation="gyro", rates=(fast, roll_rates(fast)))

    assert track.rate_hz == pytest.approx(200, rel=0.01)
    assert (track.first_s, track.last_s) == (t[0], t[-1])


@pytest.mark.parametrize("method", ["spline", "gyro"])
def test_no_method_smooths_across_a_gap(method: str) -> None:
    fast = np.arange(-0.1, 6.1, 0.005)
    t = np.concatenate([np.arange(0, 2, 0.02), np.arange(4, 6, 0.02)])
    rates = (fast, roll_rates(fast))

    track = AttitudeTrack.from_samples(t, rolling(t), interpolation=method, rates=rates)

    assert [gap.reason for gap in track.gaps] == ["a data gap"]
    even = slerp(rolling(1.98), rolling(4.0), np.linspace(0, 1, 11))
    assert between_rad(track.at(np.linspace(1.98, 4.0, 11)), even).max() < 1e-3 * ARCSEC


def test_gyro_without_rates_is_refused_with_advice() -> None:
    with pytest.raises(TelemetryError, match='needs the rates of gyros, and there are none; take "spline"'):
        AttitudeTrack.from_samples(np.arange(3.0), rolling(np.arange(3.0)), interpolation="gyro")


def test_an_unannounced_reset_is_a_gap() -> None:
    t = np.arange(0, 5, 0.02)
    q = rolling(t)
    q[100:] = multiply(q[100:], quaternion_from_euler(0.0, 0.0, 3 * DEG))

    (gap,) = AttitudeTrack.from_samples(t, q).gaps

    assert gap.reason == "a jump"
    assert gap.start_utc_s == pytest.approx(1.98, abs=1e-9)
