"""Which samples of a log are valid: limits from both sides, and sequences of positions that an aircraft can fly."""

from datetime import UTC, datetime

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.telemetry.source import (
    Boot,
    chosen_boots,
    flyable,
    is_missing_height,
    is_zero_position,
    no_clock_samples,
    no_position_samples,
    plausible_utc,
    position_samples,
    spikes,
    two_places,
    unit_quaternions,
    valid_positions,
    valid_rare_times,
    valid_rates,
    valid_times,
)

DAY_S = 86400.0
# Mean radius of the Earth, m.
RADIUS_M = 6.371e6


def test_a_spike_differs_from_the_median_of_its_neighbours_at_the_ends_too() -> None:
    np.testing.assert_array_equal(spikes(np.array([0.0, 9.0, 0.0]), 5.0), [False, True, False])
    np.testing.assert_array_equal(spikes(np.array([9.0, 0.0, 1.0, 2.0]), 5.0), [True, False, False, False])
    np.testing.assert_array_equal(spikes(np.array([0.0, 1.0, 2.0, -9.0]), 5.0), [False, False, False, True])
    np.testing.assert_array_equal(spikes(np.array([0.0, 5.0, 0.0]), 5.0), [False] * 3)
    np.testing.assert_array_equal(spikes(np.array([0.0, 99.0]), 5.0), [False] * 2)


@pytest.mark.parametrize(("interval_s", "limit_s"), [(0.1, 1.0), (0.3, 1.0), (2.0, 6.0)])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_time_is_a_spike_beyond_a_second_or_three_intervals(interval_s: float, limit_s: float, side: int) -> None:
    """Between its neighbours, the time is compared with the one on the side of the spike."""
    for factor, is_valid in ((0.97, True), (1.03, False)):
        clock_s = 100.0 + interval_s * np.arange(21)
        clock_s[10] += side * (interval_s + factor * limit_s)
        expected = np.full(21, True)
        expected[10] = is_valid
        np.testing.assert_array_equal(valid_times(clock_s), expected)


def test_times_farther_than_a_month_from_the_median_are_of_no_flight() -> None:
    clock_s = np.array([0.0, 0.0, 0.0, 29.9, -29.9, 30.1, -30.1, np.nan, np.inf, 28.0]) * DAY_S + 1.7e9
    expected = [True] * 5 + [False] * 4 + [True]
    np.testing.assert_array_equal(valid_rare_times(clock_s), expected)
    assert not valid_rare_times(np.full(3, np.nan)).any()


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "height_m", "is_valid"),
    [
        (90.0, 180.0, 0.0, True),
        (-90.0, -180.0, 0.0, True),
        (90.1, 10.0, 0.0, False),
        (-90.1, 10.0, 0.0, False),
        (10.0, 180.1, 0.0, False),
        (10.0, -180.1, 0.0, False),
        (10.0, 10.0, -1000.0, True),
        (10.0, 10.0, -1001.0, False),
        (10.0, 10.0, 100e3, True),
        (10.0, 10.0, 100001.0, False),
        (0.0, 0.0, 100.0, False),
        (np.nan, 10.0, 0.0, False),
        (10.0, np.nan, 0.0, False),
        (10.0, 10.0, np.nan, False),
    ],
)
def test_positions_are_on_the_earth_and_at_heights_of_flights(
    latitude_deg: float, longitude_deg: float, height_m: float, is_valid: bool
) -> None:
    columns = (np.array([value]) for value in (latitude_deg, longitude_deg, height_m))
    assert valid_positions(*columns).tolist() == [is_valid]


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "is_zero"),
    [(0.00097, -0.00097, True), (0.00103, 0.0, False), (0.0, -0.00103, False), (-0.00097, 0.00097, True)],
)
def test_a_position_within_a_thousandth_of_a_degree_of_zero_is_no_fix(
    latitude_deg: float, longitude_deg: float, is_zero: bool
) -> None:
    assert is_zero_position(np.array([latitude_deg]), np.array([longitude_deg])).tolist() == [is_zero]


def test_position_samples_are_the_valid_rows_in_radians() -> None:
    samples = position_samples(
        np.array([1.0, 2.0, 3.0, 4.0]), np.array([-35.0, 0.0, 95.0, 36.0]), np.array([138.0, 0.0, 1.0, -120.0]),
        np.array([5.0, 6.0, 7.0, 8.0]), "GPS",
    )  # fmt: skip
    assert (samples.clock_s.tolist(), samples.height_m.tolist(), samples.source) == ([1.0, 4.0], [5.0, 8.0], "GPS")
    np.testing.assert_allclose(samples.latitude_rad, [-35 * np.pi / 180, 36 * np.pi / 180], rtol=1e-12)
    np.testing.assert_allclose(samples.longitude_rad, [138 * np.pi / 180, -120 * np.pi / 180], rtol=1e-12)


def _flown(clock_s: Float, north_m: Float, latitude_rad: float = 0.0, height_m: float = 0.0) -> list[bool]:
    """Return which positions are kept, at distances along a meridian on a sphere."""
    return flyable(
        clock_s, latitude_rad + north_m / RADIUS_M, np.zeros(clock_s.size), np.full(clock_s.size, height_m)
    ).tolist()


@pytest.mark.parametrize(("pause_s", "limit_m"), [(1.0, 900.0), (3.0, 2300.0), (8.0, 5800.0)])
def test_positions_are_joined_up_to_200_m_and_700_m_per_s(pause_s: float, limit_m: float) -> None:
    clock_s = np.concatenate([np.arange(8.0), 7.0 + pause_s + np.arange(5.0)])
    is_there = np.arange(13) >= 8
    assert _flown(clock_s, np.where(is_there, 0.98 * limit_m, 0.0)) == [True] * 13
    assert _flown(clock_s, np.where(is_there, 1.02 * limit_m, 0.0)) == [True] * 8 + [False] * 5


def test_distances_grow_with_the_height_and_shrink_towards_the_poles() -> None:
    """At a height of 90 km they are 1.4 % longer; along the parallel of 60 deg half as long."""
    clock_s = np.arange(13.0)
    is_there = np.arange(13) >= 8
    assert _flown(clock_s, np.where(is_there, 893.0, 0.0)) == [True] * 13
    assert _flown(clock_s, np.where(is_there, 893.0, 0.0), height_m=90e3) == [True] * 8 + [False] * 5
    for start_rad, angle_m, is_kept in ((0.0, 1780.0, True), (1.0, 1780.0, True), (2.5, 1820.0, False)):
        longitude_rad = start_rad + np.where(is_there, angle_m / RADIUS_M, 0.0)
        kept = flyable(clock_s, np.full(13, np.pi / 3), longitude_rad, np.zeros(13))
        assert kept.tolist() == [True] * 8 + [is_kept] * 5
    for climb_m, is_kept in ((880.0, True), (920.0, False)):
        kept = flyable(clock_s, np.full(13, 0.5), np.zeros(13), np.where(is_there, climb_m, 0.0))
        assert kept.tolist() == [True] * 8 + [is_kept] * 5


@pytest.mark.parametrize(("pause_s", "is_parted"), [(9.6, False), (10.4, True)])
def test_after_a_pause_of_ten_intervals_the_flight_goes_on_from_an_earlier_place(
    pause_s: float, is_parted: bool
) -> None:
    """Positions 3 km away for 5 s cannot be reached before the pause, and can be left during it."""
    clock_s = np.concatenate([np.arange(25.0), 24.0 + pause_s + np.arange(20.0)])
    is_away = (np.arange(45) >= 20) & (np.arange(45) < 25)
    expected = ~is_away if is_parted else np.arange(45) >= 20
    assert _flown(clock_s, np.where(is_away, 3000.0, 0.0)) == expected.tolist()


def test_of_several_runs_that_may_be_gone_on_from_the_longest_is() -> None:
    """At 5 Hz: ten positions at one place, four and then six at others, out of reach; a long pause; the first place."""
    clock_s = np.concatenate([np.arange(20.0), 500.0 + np.arange(3.0)]) / 5
    north_m = np.repeat([0.0, 20e3, 40e3, 0.0], [10, 4, 6, 3])
    assert _flown(clock_s, north_m) == [True] * 10 + [False] * 10 + [True] * 3


def test_one_or_no_position_can_be_flown_and_of_two_that_cannot_the_first() -> None:
    assert _flown(np.arange(0.0), np.arange(0.0)) == []
    assert _flown(np.arange(1.0), np.zeros(1)) == [True]
    assert _flown(np.arange(2.0), np.array([0.0, 100e3])) == [True, False]
    assert _flown(np.arange(2.0), np.array([0.0, 100.0])) == [True, True]


@pytest.mark.parametrize(("count", "is_named"), [(78, False), (82, True)])
def test_another_place_with_four_fifths_as_many_positions_is_named(count: int, is_named: bool) -> None:
    kept = np.arange(100 + count) < 100
    latitude_rad = np.deg2rad(np.where(kept, -35.25, 48.5))
    longitude_rad = np.deg2rad(np.where(kept, 138.5, -11.75))
    said = two_places(kept, np.arange(kept.size, dtype=float), latitude_rad, longitude_rad, np.zeros(kept.size))
    places = f"100 at -35.25, 138.50 deg and {count} at 48.50, -11.75 deg"
    assert said == (f"its positions are of two places, {places}, and nothing says which is the flight" * is_named)


@pytest.mark.parametrize(
    ("clock_s", "height_m", "missing"),
    [
        ([0, 1, 2], [78, 0, 78], [False] * 3),  # 30 m and 50 m/s
        ([0, 1, 2], [82, 0, 82], [False, True, False]),
        ([0, 1, 2], [-82, 0, -82], [False, True, False]),
        ([0, 4, 5], [225, 0, 82], [False] * 3),
        ([0, 4, 5], [235, 0, 82], [False, True, False]),
        ([0, 1, 2], [300, 0, 20], [False] * 3),
        ([0, 1, 2], [20, 0, 300], [False] * 3),
        ([0, 1, 2, 3], [0, 0, 300, 310], [True, True, False, False]),
        ([0, 1, 2, 3], [310, 300, 0, 0], [False, False, True, True]),
        ([0, 1, 2], [0, 0, 0], [False] * 3),
        ([0, 1, 2, 3, 4], [300, 0, 300, 0, 0], [False, True, False, True, True]),
    ],
)
def test_a_height_of_zero_is_missing_if_no_aircraft_climbs_to_the_next(
    clock_s: list[float], height_m: list[float], missing: list[bool]
) -> None:
    assert is_missing_height(np.array(clock_s, float), np.array(height_m, float)).tolist() == missing


def test_quaternions_rates_and_dates_are_valid_within_their_limits() -> None:
    lengths = np.array([1.0, 1.0095, 0.9905, 1.0105, 0.9895, np.nan, 1e300])
    q = lengths[:, np.newaxis] * [0.5, -0.5, 0.5, 0.5]
    assert unit_quaternions(q).tolist() == [True] * 3 + [False] * 4

    rates_deg_per_s = np.array([[0, 0, 4900], [-4900, 0, 0], [0, 5100, 0], [0, 0, -5100], [0, np.nan, 0]])
    assert valid_rates(np.deg2rad(rates_deg_per_s)).tolist() == [True, True, False, False, False]

    first_s, end_s = (datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in (2010, 2100))
    times_s = np.array([first_s - 1, first_s, end_s - 1, end_s, np.nan])
    assert plausible_utc(times_s).tolist() == [False, True, True, False, False]


def test_a_boot_is_chosen_by_its_number() -> None:
    boots = (Boot(1), Boot(2), Boot(3))
    assert chosen_boots("log", boots, None) == boots
    assert chosen_boots("log", boots, 2) == (Boot(2),)


def test_batches_without_samples_are_empty() -> None:
    positions, clock = no_position_samples("no GPS"), no_clock_samples("no UTC")
    columns = (positions.clock_s, positions.latitude_rad, positions.longitude_rad, positions.height_m)
    assert [column.size for column in (*columns, clock.clock_s, clock.utc_s)] == [0] * 6
    assert (positions.source, clock.source) == ("no GPS", "no UTC")
