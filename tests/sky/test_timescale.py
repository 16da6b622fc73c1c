"""Time: Julian days, leap seconds, Terrestrial and Universal Time, sidereal time."""

from datetime import UTC, datetime, timedelta, timezone
from fractions import Fraction

import erfa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glstar.errors import ConfigError
from glstar.sky.place.timescale import (
    CLOCK_GRAIN_S,
    GPS_EPOCH_S,
    ROLLOVER_WEEKS,
    TAI_MINUS_GPS_S,
    UNIX_EPOCH_JD,
    WEEK_S,
    centuries_since_j2000,
    format_utc,
    julian_day,
    leap_seconds,
    mean_sidereal_time_rad,
    parse_known_utc,
    parse_utc,
    tai_minus_utc_s,
    tt_julian_date,
    ut1_julian_date,
)

ARCSEC = np.pi / 648000
SECOND_OF_TIME = np.pi / 43200
DAY_S = 86400.0
NANOSECOND_DAYS = 1e-9 / DAY_S
MICROSECOND_S = 1e-6

many = settings(deadline=None, max_examples=200)
moments = st.datetimes(datetime(1970, 1, 1), datetime(2099, 12, 31))  # noqa: DTZ001


def hours_rad(hours: int, minutes: int, seconds: float) -> float:
    """An angle in hours, minutes and seconds of time, rad."""
    return (hours * 3600 + minutes * 60 + seconds) * SECOND_OF_TIME


def difference_days(one: tuple[float, float], other: tuple[float, float]) -> float:
    """How much later one two-part Julian date is than another, without losing the digits of the second parts."""
    return (one[0] - other[0]) + (one[1] - other[1])


def erfa_utc(text: str) -> tuple[float, float]:
    """ERFA's own two-part UTC of an ISO 8601 time."""
    moment = datetime.fromisoformat(text)
    return erfa.dtf2d(
        "UTC",
        moment.year,
        moment.month,
        moment.day,
        moment.hour,
        moment.minute,
        moment.second + moment.microsecond / 1e6,
    )


def test_sputnik_was_launched_on_julian_day_2436116_31() -> None:
    # Meeus, example 7.a.
    assert julian_day(1957, 10, 4.81) == pytest.approx(2436116.31, abs=1e-9, rel=0)


@pytest.mark.parametrize(
    ("year", "month", "day", "expected"),
    [
        (2000, 1, 1.5, 2451545.0),
        (1999, 1, 1.0, 2451179.5),
        (1987, 1, 27.0, 2446822.5),
        (1987, 6, 19.5, 2446966.0),
        (1988, 1, 27.0, 2447187.5),
        (1988, 6, 19.5, 2447332.0),
        (1900, 1, 1.0, 2415020.5),
        (1600, 1, 1.0, 2305447.5),
        (1600, 12, 31.0, 2305812.5),
    ],
)
def test_julian_days_of_meeus_table(year: int, month: int, day: float, expected: float) -> None:
    # Meeus, chapter 7, the dates of its table that lie in the Gregorian calendar.
    assert julian_day(year, month, day) == expected


@many
@given(st.dates(datetime(1600, 1, 1).date(), datetime(2400, 12, 31).date()))  # noqa: DTZ001
def test_julian_days_agree_with_erfa(date: datetime) -> None:
    assert julian_day(date.year, date.month, date.day) == sum(erfa.cal2jd(date.year, date.month, date.day))


@many
@given(moments)
def test_the_julian_day_of_a_date_equals_that_of_its_utc_seconds(moment: datetime) -> None:
    days = (moment - datetime(moment.year, moment.month, moment.day)) / timedelta(days=1)  # noqa: DTZ001
    utc_s = parse_utc(moment.isoformat())

    assert sum(ut1_julian_date(utc_s)) == pytest.approx(
        julian_day(moment.year, moment.month, moment.day + days), abs=1e-8, rel=0
    )


def test_the_epoch_of_eq_20_is_noon() -> None:
    # The paper's text says "1 January 2000", which read as midnight is half a day off.
    assert centuries_since_j2000((2451545.0, 0.0)) == 0.0
    assert centuries_since_j2000(tt_julian_date(parse_utc("2000-01-01T11:58:55.816Z"))) == pytest.approx(
        0.0, abs=NANOSECOND_DAYS * 100
    )


def test_a_century_has_36525_days() -> None:
    assert centuries_since_j2000((2451545.0 + 36525.0, 0.0)) == 1.0
    assert centuries_since_j2000((2451545.0, 36525.0)) == 1.0


@pytest.mark.parametrize(
    ("text", "utc_s"),
    [
        ("1970-01-01T00:00:00Z", 0.0),
        ("2000-01-01T12:00:00Z", 946728000.0),
        ("2024-03-10T11:00:00Z", 1710068400.0),
        ("2024-03-10T11:00:00", 1710068400.0),
        ("2024-03-10 11:00:00", 1710068400.0),
        ("  2024-03-10T11:00:00Z\n", 1710068400.0),
        ("2024-03-10T11:00:00.25Z", 1710068400.25),
        ("2024-03-10T21:30:00+10:30", 1710068400.0),
        ("2024-03-10T06:00:00-05:00", 1710068400.0),
        ("2024-03-10", 1710028800.0),
        ("1969-12-31T23:59:59.5Z", -0.5),
    ],
)
def test_iso_times_are_utc_unless_they_have_an_offset(text: str, utc_s: float) -> None:
    assert parse_utc(text) == utc_s


@pytest.mark.parametrize(
    "text", ["", "now", "2024-13-10T11:00:00Z", "2024-03-32", "10.3.2024 11:00", "2024-03-10T25:00:00Z", "1710068400.0"]
)
def test_an_invalid_time_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="is no time; write ISO 8601, such as 2024-03-10T11:00:00Z"):
        parse_utc(text)


def test_a_time_is_written_to_the_microsecond() -> None:
    assert format_utc(1710068400.0) == "2024-03-10T11:00:00.000000Z"
    assert format_utc(1710068400.1234567) == "2024-03-10T11:00:00.123457Z"
    assert format_utc(-0.5) == "1969-12-31T23:59:59.500000Z"


def test_a_time_that_rounds_up_carries_over() -> None:
    assert format_utc(86399.9999999) == "1970-01-02T00:00:00.000000Z"


@many
@given(moments)
def test_a_time_to_the_microsecond_survives_reading_and_writing(moment: datetime) -> None:
    text = moment.strftime("%Y-%m-%dT%H:%M:%S.%fZ")

    assert format_utc(parse_utc(text)) == text


@many
@given(st.floats(0.0, 4.1e9))
def test_writing_and_reading_a_time_moves_it_by_less_than_a_microsecond(utc_s: float) -> None:
    assert abs(parse_utc(format_utc(utc_s)) - utc_s) < MICROSECOND_S


@many
@given(moments, st.integers(-14 * 60, 14 * 60))
def test_times_with_different_offsets_may_be_the_same_utc(moment: datetime, minutes: int) -> None:
    utc = moment.replace(tzinfo=UTC)
    local = utc.astimezone(timezone(timedelta(minutes=minutes)))

    assert parse_utc(local.isoformat()) == parse_utc(utc.isoformat())


@pytest.mark.parametrize(
    ("text", "leap_s"),
    [
        ("1972-01-01T00:00:00Z", 10.0),
        ("1999-01-01T00:00:00Z", 32.0),
        ("2008-12-31T12:00:00Z", 33.0),
        ("2013-11-15T10:00:00Z", 35.0),
        ("2016-12-31T00:00:00Z", 36.0),
        ("2016-12-31T23:59:59.999Z", 36.0),
        ("2017-01-01T00:00:00Z", 37.0),
        ("2024-03-10T11:00:00Z", 37.0),
    ],
)
def test_leap_seconds_are_those_of_the_day(text: str, leap_s: float) -> None:
    assert tai_minus_utc_s(parse_utc(text)) == leap_s


def test_after_the_end_of_the_table_its_last_value_is_used_without_a_warning() -> None:
    assert tai_minus_utc_s(parse_utc("2090-06-01")) == tai_minus_utc_s(parse_utc("2026-01-01"))


@pytest.mark.parametrize("utc_s", [float("nan"), float("inf"), float("-inf")])
def test_a_time_that_is_not_finite_has_no_leap_seconds(utc_s: float) -> None:
    with pytest.raises(ConfigError, match="is not a time"):
        tai_minus_utc_s(utc_s)


@pytest.mark.parametrize(
    "text",
    [
        "1987-04-10T00:00:00",
        "2000-01-01T12:00:00",
        "2013-11-15T10:11:12.125",
        "2016-12-31T23:59:59",  # in a day of 86401 s, in which ERFA scales UTC
        "2017-01-01T00:00:00",
        "2024-03-10T11:00:00.5",
    ],
)
def test_terrestrial_time_agrees_with_erfa(text: str) -> None:
    expected = erfa.taitt(*erfa.utctai(*erfa_utc(text)))

    assert abs(difference_days(tt_julian_date(parse_utc(text)), expected)) < NANOSECOND_DAYS


@pytest.mark.parametrize("text", ["2000-01-01T12:00:00", "2013-11-15T10:11:12.125", "2024-03-10T11:00:00.5"])
@pytest.mark.parametrize("dut1_s", [-0.9, 0.0, 0.3])
def test_universal_time_agrees_with_erfa(text: str, dut1_s: float) -> None:
    expected = erfa.utcut1(*erfa_utc(text), dut1_s)

    assert abs(difference_days(ut1_julian_date(parse_utc(text), dut1_s), expected)) < NANOSECOND_DAYS


def test_a_julian_date_has_two_parts_the_midnight_and_the_remainder() -> None:
    midnight, rest = ut1_julian_date(parse_utc("2024-03-10T18:00:00Z"))

    assert midnight == 2460379.5
    assert rest == 0.75


def test_mean_sidereal_time_at_midnight_is_that_of_meeus() -> None:
    # Meeus, example 12.a: 1987 April 10, 0h UT; printed to 1e-4 s of time.
    assert mean_sidereal_time_rad((2446895.5, 0.0)) == pytest.approx(
        hours_rad(13, 10, 46.3668), abs=1e-4 * SECOND_OF_TIME, rel=0
    )


def test_mean_sidereal_time_in_the_evening_is_that_of_meeus() -> None:
    # Meeus, example 12.b: 1987 April 10, 19h21m00s UT.
    ut1 = ut1_julian_date(parse_utc("1987-04-10T19:21:00Z"))

    assert mean_sidereal_time_rad(ut1) == pytest.approx(hours_rad(8, 34, 57.0896), abs=1e-4 * SECOND_OF_TIME, rel=0)


@many
@given(st.floats(0.0, 2.1e9), st.floats(-0.9, 0.9))
def test_mean_sidereal_time_agrees_with_erfa_where_eq_21_drifts_by_half_an_arcsecond_a_year(
    utc_s: float, dut1_s: float
) -> None:
    ut1 = ut1_julian_date(utc_s, dut1_s)
    difference_rad = (mean_sidereal_time_rad(ut1) - erfa.gmst82(*ut1) + np.pi) % (2 * np.pi) - np.pi

    assert abs(difference_rad) < 1e-3 * ARCSEC


@many
@given(st.floats(0.0, 4.1e9))
def test_sidereal_time_is_from_0_to_2_pi(utc_s: float) -> None:
    assert 0.0 <= mean_sidereal_time_rad(ut1_julian_date(utc_s)) < 2 * np.pi


def test_one_second_of_dut1_is_15_arcseconds_of_sidereal_time() -> None:
    utc_s = parse_utc("2024-03-10T11:00:00Z")
    turned = mean_sidereal_time_rad(ut1_julian_date(utc_s, 0.5)) - mean_sidereal_time_rad(ut1_julian_date(utc_s, -0.5))

    assert turned == pytest.approx(15.041 * ARCSEC, abs=1e-3 * ARCSEC, rel=0)


def test_times_are_known_from_1800_to_2199() -> None:
    # 62091 days from 1800-01-01 to 1970, and 84006 from there to 2200-01-01.
    assert parse_known_utc("1800-01-01T00:00:00Z") == -62091.0 * DAY_S
    assert parse_known_utc("2199-12-31T23:59:59Z") == 84006.0 * DAY_S - 1
    for text in ("1799-12-31T23:59:59.9Z", "2200-01-01T00:00:00Z"):
        with pytest.raises(ConfigError) as refused:
            parse_known_utc(text)
        assert str(refused.value) == f"{text!r} lies outside the years 1800 to 2200, for which glstar knows the sky"
    # Flights may begin and end a little outside.
    for utc_s in (7.2599e9, -7.2599e9):
        assert tai_minus_utc_s(utc_s) >= 0
    for utc_s in (7.26e9, -7.26e9, 7.3e9):
        with pytest.raises(ConfigError) as refused:
            tai_minus_utc_s(utc_s)
        assert str(refused.value) == (
            f"{utc_s} s since 1970 is not a time in the years 1800 to 2200, for which glstar knows the sky"
        )


def test_a_leap_second_is_the_last_second_of_a_day_of_utc() -> None:
    assert parse_utc("2016-12-31T23:59:60.25Z") == parse_utc("2017-01-01T00:00:00.25Z")
    assert parse_utc("2017-01-01T10:29:60+1030") == parse_utc("2017-01-01T00:00:00Z")
    for text in ("2016-12-31T23:58:60Z", "2016-12-31T22:59:60.5Z", "2016-12-31T23:59:60+01:00"):
        with pytest.raises(ConfigError) as refused:
            parse_utc(text)
        assert str(refused.value) == f"{text!r} is no time: a leap second is 23:59:60 of UTC"


def test_gps_time_began_in_1980_19_seconds_behind_tai() -> None:
    assert parse_utc("1980-01-06T00:00:00Z") == GPS_EPOCH_S
    assert (WEEK_S, ROLLOVER_WEEKS, TAI_MINUS_GPS_S) == (7 * DAY_S, 2**10, 19.0)
    # 17 s until the end of 2016, then 18 s: the leap second lies between the GPS times 17 s and 18 s after midnight.
    midnight_s = parse_utc("2017-01-01T00:00:00Z")
    assert [leap_seconds(midnight_s + after_s) for after_s in (-5.0, 16.5, 18.5, 3e5)] == [17.0, 17.0, 18.0, 18.0]


@pytest.mark.parametrize("ut1", [(2524593.5, 0.8125), (2451545.5, 0.3), (2415020.5, 0.9375), (2378496.5, -0.01)])
def test_mean_sidereal_time_is_meeus_polynomial_without_rounding(ut1: tuple[float, float]) -> None:
    days = Fraction(ut1[0]) + Fraction(ut1[1]) - 2451545
    t = days / 36525
    degrees = Fraction("280.46061837") + Fraction("360.98564736629") * days
    degrees += Fraction("0.000387933") * t**2 - t**3 / 38710000
    assert mean_sidereal_time_rad(ut1) == pytest.approx(float(np.deg2rad(float(degrees % 360))), rel=0, abs=2e-11)


def test_times_closer_than_a_microsecond_are_equal() -> None:
    assert CLOCK_GRAIN_S == 1e-6
    assert sum(erfa.cal2jd(1970, 1, 1)) == UNIX_EPOCH_JD
