"""The fit of a table's clock to its UTC, function by function, against brute force and hand-made cells."""

from itertools import combinations
from statistics import median
from types import SimpleNamespace

import numpy as np
import pytest

from glstar.arrays import Float
from glstar.errors import LogFormatError
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry.source import EVERYWHERE, Boot
from glstar.telemetry.tables import tableclock
from glstar.telemetry.tables.tableclock import (
    ClockFit,
    clock_boots,
    described_cuts,
    early_remarks,
    fitted_clock,
    left_out_rows,
    most_agree,
    rows_of,
    scale_fault,
)

nan = np.nan
UTC_S = parse_utc("2024-03-10T11:00:00Z")
GPS_S = UTC_S - 315964800 + 18  # since 1980
WEEK, WEEK_S = 2305, 604800
CLOCK_S = 7.0 + 0.1 * np.arange(600)


# --- parts of the fit -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(6))
def test_most_intervals_overlap_where_brute_force_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.integers(-20, 20, 25).astype(float)
    high = low + rng.integers(0, 8, 25)
    counts = {at: int(np.sum((low <= at) & (at <= high))) for at in low}

    at, count = tableclock._most_common(low, high)
    assert count == max(counts.values())
    assert at == min(start for start, of in counts.items() if of == count)


@pytest.mark.parametrize("seed", range(4))
def test_the_median_slope_is_that_of_all_distant_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(3, 50, 41), rng.uniform(-2, 9, 41)
    wide = np.ptp(x) / 4
    slopes = [(y[j] - y[i]) / (x[j] - x[i]) for i, j in combinations(range(41), 2) if abs(x[j] - x[i]) >= wide]

    assert tableclock._median_slope(x, y) == pytest.approx(median(slopes), abs=1e-12)
    many = np.linspace(5, 60, 901)
    assert tableclock._median_slope(many, 4 - 0.25 * many) == pytest.approx(-0.25, abs=1e-12)
    assert tableclock._median_slope(np.array([3.0]), np.array([4.0])) == 0.0


def test_cells_that_keep_their_value_for_long_stand_still() -> None:
    clock_s = np.array([1.0, 2.0, 4.0, 4.5, 7.5, 8.0, 10.0, 13.0])
    utc_s = np.array([5.0, 5.0, 5.0, 6.0, 6.0, 7.0, 7.0, 7.0])

    assert tableclock._moving(clock_s, utc_s, 2.0).tolist() == [1, 1, 0, 1, 0, 1, 1, 0]
    assert tableclock._moving(-clock_s, utc_s, 3.0).tolist() == [1, 1, 1, 1, 1, 1, 1, 0]


@pytest.mark.parametrize(
    ("utc_s", "hold_s"),
    [
        ([5.0, 5.0, 6.0, 6.0, 6.0, 7.0, 7.0, 7.0], 1.5),  # truncated seconds: no less than a second
        ([5.25, 5.25, 6.0, 6.0, 6.25, 7.25, 7.25, 7.25], 0.75),  # changes at 1.0, 2.0, 2.5 s
        ([5.25, nan, 6.3, 6.3, nan, 7.2, 7.2, 8.1], 1.25),  # at 1.0, 2.5 and 3.5 s
        ([5.25, 5.25, 5.25, 5.25, 5.25, 6.3, 6.3, 6.3], 0.0),
        ([5.0, 5.0, 5.0, 5.0, 5.0, 6.0, 6.0, 6.0], 1.0),
        ([5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0], 1.0),
    ],
)
def test_how_long_utc_is_usually_repeated(utc_s: list[float], hold_s: float) -> None:
    clock_s = 0.5 * np.arange(8)

    assert tableclock._usual_hold_s(clock_s, np.array(utc_s)) == pytest.approx(hold_s, abs=1e-9)
    assert tableclock._usual_hold_s(-clock_s, np.array(utc_s)) == pytest.approx(hold_s, abs=1e-9)


@pytest.mark.parametrize(("whole", "are_whole"), [(26, False), (27, True)])
def test_most_of_52_readings_have_whole_seconds(whole: int, are_whole: bool) -> None:
    utc_s = UTC_S + np.arange(52) + np.where(np.arange(52) < whole, 0.0, 0.25)
    assert tableclock.has_whole_seconds(utc_s) is are_whole


def readings(clock_s: list[float], utc_s: list[float], cells: list[int]) -> tuple[list[float], ...]:
    found = tableclock._readings(np.array(clock_s), np.array(utc_s), np.array(cells))
    columns = (found.rows, found.clock_s, found.before_s, found.utc_s)
    return *(np.round(column, 9).tolist() for column in columns), found.are_held


def test_a_value_is_read_where_it_occurs_first() -> None:
    clock_s = [1.0, 1.2, 1.5, 1.6, 2.0, 2.1, 2.5]
    held = [100.0, 100.0, 101.0, 101.0, 101.0, 102.0, 102.0]

    assert readings(clock_s, held, list(range(7))) == ([2, 5], [1.5, 2.1], [1.2, 2.0], [101.0, 102.0], True)
    assert readings(clock_s, held, [3, 4, 5, 6]) == ([5], [2.1], [2.0], [102.0], True)
    # A row without UTC may have held the same value as the row after it.
    gaps = [100.25, nan, 101.25, 101.25, nan, 102.25, 102.25]
    assert readings(clock_s, gaps, [0, 2, 3, 5, 6]) == ([2, 5], [1.5, 2.1], [1.0, 1.6], [101.25, 102.25], True)
    single = [100.25, nan, 101.25, nan, nan, 102.25, nan]
    assert readings(clock_s, single, [0, 2, 5]) == (
        [0, 2, 5],
        [1.0, 1.5, 2.1],
        [0.75, 1.2, 2.0],
        [100.25, 101.25, 102.25],
        False,
    )
    # Whole seconds are early even if none is repeated.
    whole = [100.0, nan, 101.0, nan, nan, 102.0, nan]
    assert readings(clock_s, whole, [0, 2, 5])[4] is True


def test_the_row_before_a_step_back_of_the_clock_says_nothing() -> None:
    clock_s = [5.0, 5.5, 6.0, 1.0, 1.5, nan, 2.0]
    utc_s = [100.25, 101.25, 102.25, 103.25, 104.25, 105.25, 106.25]

    assert readings(clock_s, utc_s, [0, 1, 2, 3, 4, 6]) == (
        [0, 1, 2, 3, 4, 6],
        [5.0, 5.5, 6.0, 1.0, 1.5, 2.0],
        [4.5, 5.0, 5.5, 0.5, 1.0, 1.5],
        [100.25, 101.25, 102.25, 103.25, 104.25, 106.25],
        False,
    )


@pytest.mark.parametrize(("repeated", "are_held"), [(2, False), (3, True)])
def test_values_are_held_if_a_tenth_are_repeated(repeated: int, are_held: bool) -> None:
    """Of 21 or 22 cells, 19 hold a value first."""
    utc_s = 100.25 + np.concatenate([np.arange(18.0), np.repeat(18.0, 1 + repeated)])

    assert readings(list(0.5 * np.arange(utc_s.size)), list(utc_s), list(range(utc_s.size)))[4] is are_held


def of_offsets(offset_s: Float, clock_s: Float, *, before: float = 0.1, are_held: bool = False) -> tableclock._Readings:
    return tableclock._Readings(np.arange(clock_s.size), clock_s, clock_s - before, clock_s + offset_s, are_held)


def test_readings_near_most_of_the_others_are_used() -> None:
    """Within half a second, or an interval of rows, of the middle of most of them."""
    offset_s = np.array([50.0, 50.2, 50.4, 50.9, 49.3, 51.05, 52.0, 47.0])
    near = tableclock._near(of_offsets(offset_s, 3.0 + np.arange(8)), 0.1)
    assert near.tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    wide = tableclock._near(of_offsets(offset_s, 3.0 + np.arange(8)), 0.7)
    assert wide.tolist() == [1, 1, 1, 1, 0, 1, 0, 0]


@pytest.mark.parametrize("rate", [0.0, 4e-3, -2e-3, 9.7e-3, 0.0103, -0.0103])
def test_a_drift_is_the_slope_of_the_offset(rate: float) -> None:
    clock_s = 3.0 + np.arange(40)
    found = tableclock._refined_rate(of_offsets(50 + rate * clock_s, clock_s))
    assert found == pytest.approx(rate if abs(rate) < 0.01 else 0.0, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(("drift_s", "is_drift"), [(0.00192, False), (0.00208, True), (-0.00208, True)])
def test_a_drift_of_two_milliseconds_is_one(drift_s: float, is_drift: bool) -> None:
    clock_s = 3.0 + np.arange(41)
    found = tableclock._refined_rate(of_offsets(50 + drift_s / 40 * clock_s, clock_s))
    assert found == pytest.approx(drift_s / 40 if is_drift else 0.0, rel=1e-6)


@pytest.mark.parametrize(("size", "is_drift"), [(2, False), (3, True)])
def test_a_drift_needs_three_readings(size: int, is_drift: bool) -> None:
    clock_s = 3.0 + 10 * np.arange(size)
    found = tableclock._refined_rate(of_offsets(50 + 0.005 * clock_s, clock_s))
    assert found == pytest.approx(0.005 if is_drift else 0.0, rel=1e-9)
    assert tableclock._refined_rate(of_offsets(np.array([1.0, 2.0, 3.0]), np.array([5.0, 5.0, 5.0]))) == 0.0


def test_a_drift_within_the_scatter_or_the_rows_is_none() -> None:
    clock_s = 3.0 + np.arange(400)
    scatter_s = 0.1 * np.sin(1e4 * clock_s)
    assert tableclock._refined_rate(of_offsets(50 + 1e-4 * clock_s + scatter_s, clock_s)) == 0.0
    found = tableclock._refined_rate(of_offsets(50 + 3e-3 * clock_s + scatter_s, clock_s))
    assert found == pytest.approx(3e-3, rel=0.02)
    # UTC that is held changes anywhere between two rows at 0.05 s: a drift of 0.04 s is within, one of 0.08 s is not.
    for rate, found in ((1e-4, 0.0), (2e-4, 2e-4)):
        held = of_offsets(50 + rate * clock_s, clock_s, before=0.05, are_held=True)
        assert tableclock._refined_rate(held) == pytest.approx(found, abs=1e-9)


# --- the whole fit --------------------------------------------------------------------------------------------------
def test_a_clock_with_exact_utc() -> None:
    utc_s = CLOCK_S + 4000.25
    utc_s[::3] = nan
    utc_s[[31, 70]] += [1.3, -8.5]
    fit = fitted_clock(CLOCK_S, utc_s)

    assert (fit.rate, fit.reason, fit.cells) == (0.0, "", 400)
    assert fit.utc_minus_clock_s == pytest.approx(4000.25, abs=1e-9)
    rows = [row for row in range(600) if row % 3 and row not in (31, 70)]
    assert fit.rows.tolist() == rows
    np.testing.assert_array_equal(fit.utc_s, utc_s[rows])
    assert fit.cut.tolist() == [31, 70]
    assert fit.largest_s == pytest.approx(8.5, abs=1e-9)
    assert fit.reference_s == pytest.approx(float(np.median(CLOCK_S[rows])), abs=1e-9)
    np.testing.assert_array_equal(fit.at_rate_of_utc(CLOCK_S), CLOCK_S)


@pytest.mark.parametrize("off_s", [0.48, 0.52, -0.48, -0.52])
def test_cells_that_disagree_by_half_a_second_are_cut(off_s: float) -> None:
    utc_s = CLOCK_S + 4000.25
    utc_s[31] += off_s
    fit = fitted_clock(CLOCK_S, utc_s)

    # A value is held for the interval of the rows: a cell may be behind by this time too.
    limit_s = 0.5 if off_s > 0 else 0.6
    assert fit.cut.tolist() == ([31] if abs(off_s) > limit_s else [])


@pytest.mark.parametrize("rate", [2e-3, -5e-3])
def test_a_clock_that_drifts_against_exact_utc(rate: float) -> None:
    utc_s = 4000.25 + CLOCK_S * (1 + rate)
    fit = fitted_clock(CLOCK_S, utc_s)

    assert fit.rate == pytest.approx(rate, rel=1e-6)
    np.testing.assert_allclose(fit.at_rate_of_utc(CLOCK_S) + fit.utc_minus_clock_s, utc_s, rtol=0, atol=1e-6)
    assert fit.cut.tolist() == []
    assert fit.largest_s == 0.0
    far = np.flatnonzero(np.arange(600) % 7 == 3)
    utc_s[far] += 30.0
    fit = fitted_clock(CLOCK_S, utc_s)
    assert fit.cut.tolist() == far.tolist()
    assert fit.largest_s == pytest.approx(30.0, abs=1e-4)


@pytest.mark.parametrize("rate", [6e-3, -6e-3, 9.7e-3])
@pytest.mark.parametrize("origin_s", [7.0, -90_000.0])
def test_a_clock_that_drifts_by_many_seconds(rate: float, origin_s: float) -> None:
    """By 12 s or more in 2000 s; a fifth of the cells is wrong by minutes."""
    clock_s = origin_s + 0.5 * np.arange(4001)
    utc_s = 4000.25 + clock_s * (1 + rate)
    odd = np.arange(4001) % 5 == 3
    utc_s[odd] += 300 + 100 * np.sin(np.flatnonzero(odd))
    fit = fitted_clock(clock_s, utc_s)

    assert fit.rate == pytest.approx(rate, rel=1e-6)
    assert fit.cut.tolist() == np.flatnonzero(odd).tolist()
    at_utc_s = fit.at_rate_of_utc(clock_s) + fit.utc_minus_clock_s
    np.testing.assert_allclose(at_utc_s[~odd], utc_s[~odd], rtol=0, atol=1e-5)


@pytest.mark.parametrize("rate", [4e-4, -4e-4])
def test_a_clock_that_drifts_against_truncated_seconds(rate: float) -> None:
    true_s = 0.1 * np.arange(20_000)
    clock_s = 40 + true_s * (1 + rate)
    fit = fitted_clock(clock_s, np.floor(true_s + 1e-6) + 4000)

    assert fit.rate == pytest.approx(1 / (1 + rate) - 1, abs=2e-5)
    off_s = fit.at_rate_of_utc(clock_s) + fit.utc_minus_clock_s - true_s - 4000
    assert np.abs(off_s).max() < 0.11
    assert fit.cut.size == 0


@pytest.mark.parametrize("phase_s", [0.0, 0.33, 0.95])
def test_truncated_seconds_begin_in_the_row_where_they_change(phase_s: float) -> None:
    true_s = CLOCK_S + phase_s
    fit = fitted_clock(CLOCK_S, np.floor(true_s + 1e-9) + 4000)

    # A second begins within a row: UTC minus the clock is known up to 0.1 s, and the earliest one is taken.
    first_s = CLOCK_S[np.flatnonzero(np.diff(np.floor(true_s + 1e-9)))[0] + 1]
    assert fit.utc_minus_clock_s == pytest.approx(4000 + np.floor(first_s + phase_s + 1e-9) - first_s, abs=1e-9)
    assert (fit.rate, fit.cut.tolist(), fit.cells) == (0.0, [], 600)


@pytest.mark.parametrize(
    ("utc_s", "reason"),
    [
        (np.full(600, nan), "its time counts from its own start, and it has no column with UTC"),
        (np.full(600, 4000.25), "its UTC stands still"),
        (
            np.where(np.arange(600) % 100 < 50, CLOCK_S, CLOCK_S + 300),
            "its UTC has two different times, and most cells agree with neither",
        ),
        (4000.25 + CLOCK_S * 1000, "in a second of its clock, its UTC goes on by 1000 s; check time_unit"),
        (4000.25 + CLOCK_S * 2, "in a second of its clock, its UTC goes on by 2 s; check time_unit"),
        (4000.25 - CLOCK_S, "in a second of its clock, its UTC goes on by -1 s; check time_unit"),
    ],
)
def test_a_clock_without_a_fit_has_a_reason(utc_s: Float, reason: str) -> None:
    fit = fitted_clock(CLOCK_S, utc_s)

    assert fit.reason == reason
    assert (fit.rate, fit.reference_s, fit.largest_s) == (0.0, 0.0, 0.0)
    assert np.isnan(fit.utc_minus_clock_s)
    assert fit.cells == np.count_nonzero(np.isfinite(utc_s))
    assert (fit.rows.size, fit.utc_s.size, fit.cut.size) == (0, 0, 0)


@pytest.mark.parametrize(
    ("unit", "reason"), [(0.0, "its UTC stands still most of the time"), (0.0101, ""), (0.0099, None)]
)
def test_why_few_cells_agree(unit: float, reason: str | None) -> None:
    for slope in (1 - unit, 1 + unit) if unit else (0.0,):
        said = tableclock._disagreement(CLOCK_S, 4000 + slope * CLOCK_S, 17)
        if reason == "":
            assert said == f"in a second of its clock, its UTC goes on by {slope:.4g} s; check time_unit"
        else:
            assert said == (reason or "of its 600 cells of UTC no more than 17 agree with its clock")


@pytest.mark.parametrize(
    ("clock_s", "reason"), [([3.0, 4.2], "its UTC stands still"), ([3.0, 4.0], ""), ([3.0, 4.05], "")]
)
def test_utc_stands_still_for_more_than_a_second_and_a_row(clock_s: list[float], reason: str) -> None:
    assert tableclock._no_utc(np.array(clock_s), np.array([9.0, 9.0]), 0.1) == reason
    assert tableclock._no_utc(np.array(clock_s), np.array([9.0, 9.5]), 0.1) == ""


def fit_of(cells: int, cut: int, reason: str = "") -> ClockFit:
    nothing = np.empty(0, dtype=np.int64)
    return ClockFit(0.0, 0.0, 0.0, cells, nothing, np.empty(0), 5 + np.arange(cut), 12.34, reason)


def test_a_quarter_of_all_cells_agree() -> None:
    assert most_agree([fit_of(100, 75)])
    assert not most_agree([fit_of(100, 76)])
    assert most_agree([fit_of(100, 40), fit_of(140, 0, "none")])
    assert not most_agree([fit_of(100, 40), fit_of(144, 0, "none")])


def test_cut_cells_are_described_with_their_first_line() -> None:
    lines = 100 + 3 * np.arange(40)

    one = (
        "1 of its 30 cells of UTC disagrees with its clock by up to 12.3 s (the first one in line 115) and is not used"
    )
    assert described_cuts(fit_of(30, 1), lines) == one
    two = (
        "2 of its 30 cells of UTC disagree with its clock by up to 12.3 s (the first one in line 115) and are not used"
    )
    assert described_cuts(fit_of(30, 2), lines) == two
    assert left_out_rows(1) == "1 row has an impossible time and is left out"
    assert left_out_rows(2) == "2 rows have an impossible time and are left out"


# --- boots ----------------------------------------------------------------------------------------------------------
NO_UTC = np.full(600, nan)


def stepped(at: int, by_s: float, step_s: float = 0.1) -> Float:
    clock_s = 7.0 + step_s * np.arange(600)
    clock_s[at:] += by_s
    return clock_s


def spans(clock_s: Float, utc_s: Float = NO_UTC) -> list[tuple[tuple[int, int], ...]]:
    return [boot.spans for boot in clock_boots(clock_s, utc_s)]


WHOLE = [((0, EVERYWHERE),)]
PARTED = [((0, 250),), ((250, EVERYWHERE),)]


@pytest.mark.parametrize(
    ("step_s", "by_s", "expected"),
    [
        (0.05, -0.146, WHOLE),  # the clock goes back by 0.096 s
        (0.05, -0.154, [((0, 250), (250, EVERYWHERE))]),  # 0.104 s: two parts, of one boot because they overlap
        (0.05, -40.0, PARTED),
        (0.2, -0.49, WHOLE),
        (1.96, -500.0, PARTED),
        (2.04, -500.0, WHOLE),
    ],
)
def test_a_step_back_of_the_clock_begins_a_boot(step_s: float, by_s: float, expected: list) -> None:
    assert spans(stepped(250, by_s, step_s)) == expected


@pytest.mark.parametrize(("steps", "boots"), [(20, 21), (21, 1)])
def test_rows_with_many_steps_back_are_not_sorted(steps: int, boots: int) -> None:
    part = 600 // (steps + 1)
    clock_s = 0.1 * (np.arange(part * (steps + 1)) % part)
    assert len(clock_boots(clock_s, np.full(clock_s.size, nan))) == boots


@pytest.mark.parametrize("by_s", [1.3, -1.3, 30.0])
def test_a_step_of_utc_against_the_clock_begins_a_boot(by_s: float) -> None:
    utc_s = CLOCK_S + UTC_S + np.where(np.arange(600) >= 250, by_s, 0.0)
    assert spans(CLOCK_S, utc_s) == PARTED
    assert spans(CLOCK_S, CLOCK_S + UTC_S) == WHOLE


def test_a_boot_is_a_range_of_rows() -> None:
    assert rows_of(Boot(2, ((1, 3), (5, EVERYWHERE))), 7).tolist() == [0, 1, 1, 0, 0, 1, 1]
    assert clock_boots(np.array([1.0, 2.0]), np.array([nan, nan])) == (Boot(1),)
    assert clock_boots(np.empty(0), np.empty(0)) == (Boot(1),)


# --- the scale of a time --------------------------------------------------------------------------------------------
def table(**columns: list[float]) -> SimpleNamespace:
    def numbers(name: str) -> Float:
        if not columns[name]:
            raise LogFormatError("x.csv", "no numbers")
        return np.array(columns[name])

    return SimpleNamespace(columns=list(columns), numbers=numbers)


TEN_S = np.arange(10.0)


def fault(of: SimpleNamespace, time_s: Float, epoch: str = "auto", name: str = "t") -> str:
    return scale_fault(of, name, time_s, epoch, None, np.empty(0))


@pytest.mark.parametrize("name", ["week", "GPS_Week", "gnss wn", "GWk", "wk", "GPSWeekNo", "WeekNumber", "gpsweeknum"])
def test_a_gps_week_beside_a_time_says_from_when_it_counts(name: str) -> None:
    week = table(t=[1.0], **{name: [0.0, WEEK, WEEK + 1, WEEK, 0.0]})
    within = "t counts seconds since 1970 by this map, but within one week, beside a GPS week"
    assert fault(week, 39618 + TEN_S) == f"{within}; give time_epoch=week,gps_week=COLUMN"
    since_1980 = "t counts seconds since 1970 by this map, but its GPS week counts them from 1980; give time_epoch=gps"
    assert fault(week, GPS_S + TEN_S) == fault(week, GPS_S + TEN_S, "unix") == since_1980
    assert fault(week, GPS_S + TEN_S, "gps") == fault(week, GPS_S + TEN_S, "week") == ""
    assert fault(week, UTC_S + TEN_S) == ""
    assert fault(week, WEEK_S + 5 + TEN_S) == ""
    assert fault(week, -20 + TEN_S) == ""
    assert fault(week, np.full(3, nan)) == f"{within}; give time_epoch=week,gps_week=COLUMN"


def test_other_columns_are_no_gps_week() -> None:
    for name in ("weekday", "now", "wnx", "a_week_b"):
        assert fault(table(t=[1.0], **{name: [WEEK]}), GPS_S + TEN_S) == ""
    assert fault(table(t=[1.0], week=[]), GPS_S + TEN_S) == ""
    assert fault(table(t=[1.0], week=[0.0, -1.0]), GPS_S + TEN_S) == ""
    # A week of 10 bits: 2305 is 257 after two rollovers.
    assert "counts them from 1980" in fault(table(t=[1.0], week=[257.0]), GPS_S + TEN_S)
    assert fault(table(t=[1.0], week=[259.9]), GPS_S + TEN_S) == ""  # three weeks off


@pytest.mark.parametrize("name", ["gps_time", "GNSS time", "iTOW", "tow_s", "time_of_week"])
def test_gps_time_by_its_name_needs_an_epoch(name: str) -> None:
    head = f"{name} is GPS time by its name, and nothing says from when it counts: "
    both = "time_epoch=gps makes it 2024-03-10 and time_epoch=unix makes it 2014-03-06"
    assert fault(table(), GPS_S + TEN_S, name=name) == head + both
    assert fault(table(), 5e8 + TEN_S, name=name) == f"{head}give time_epoch"
    assert fault(table(), 1e9 + TEN_S, name=name) == f"{head}time_epoch=gps makes it 2011-09-14"
    assert fault(table(), GPS_S + TEN_S, "unix", name=name) == fault(table(), GPS_S + TEN_S, "gps", name=name) == ""
    assert fault(table(), np.full(3, nan), name=name) == ""
    assert fault(table(), GPS_S + TEN_S, name="tower") == fault(table(), GPS_S + TEN_S, name="time") == ""


@pytest.mark.parametrize(
    ("ahead_s", "message"),
    [
        (4.9, ""),
        (-4.9, ""),
        (5.1, "t is 5.1 s ahead of u; name one of both"),
        (-5.1, "t is 5.1 s behind u; name one of both"),
        (12.9, "t is 12.9 s ahead of u; name one of both"),
        (13.1, "t is 13.1 s ahead of u: it counts GPS time; name one of both"),
        (22.9, "t is 22.9 s ahead of u: it counts GPS time; name one of both"),
        (23.1, "t is 23.1 s ahead of u; name one of both"),
        (
            18 - 315964800,
            "t is 315964782.0 s behind u: it counts GPS time since 1980 (time_epoch=gps); name one of both",
        ),
    ],
)
def test_another_column_with_utc_contradicts_a_time(ahead_s: float, message: str) -> None:
    utc_s = UTC_S + TEN_S
    utc_s[4] = nan
    for epoch in ("auto", "gps"):
        assert scale_fault(table(), "t", UTC_S + TEN_S + ahead_s, epoch, "u", utc_s) == message
    for same in ("t", None):
        assert scale_fault(table(), "t", UTC_S + TEN_S + ahead_s, "auto", same, utc_s) == ""
    assert scale_fault(table(), "t", np.full(10, nan), "auto", "u", utc_s) == ""


@pytest.mark.parametrize(("spread_s", "is_found"), [(6.2, True), (6.3, False)])
def test_times_that_contradict_another_by_different_amounts_say_nothing(spread_s: float, is_found: bool) -> None:
    """The central 80 % of eleven differences that spread evenly."""
    ahead_s = np.linspace(30, 30 + spread_s, 11)
    message = scale_fault(table(), "t", UTC_S + np.arange(11) + ahead_s, "auto", "u", UTC_S + np.arange(11.0))
    assert bool(message) is is_found


def test_times_before_2017_may_count_from_1980() -> None:
    year_2017_s = parse_utc("2017-01-01T00:00:00Z")
    head = "its times are taken as seconds since 1970"
    assert early_remarks(year_2017_s - np.array([1.0, 2.0, nan, 5e8]), "auto") == [
        f"{head}, 2016-12-31; time_epoch=gps, since 1980, makes them 2027-01-05"
    ]
    assert early_remarks(np.array([year_2017_s]), "auto") == []
    assert early_remarks(np.array([year_2017_s - 1]), "unix") == []
    assert early_remarks(np.array([nan, 3.0]), "auto") == []
