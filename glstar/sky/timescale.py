"""Time scales: UTC seconds, Julian dates, leap seconds, sidereal time.

glstar counts time in `utc_s`: seconds of UTC since 1970-01-01, with 86400 s per day (a leap second has the same number
as the second after it).  Julian dates have two parts whose sum is the date, because the resolution of a single float64
at 2 400 000 days is only 40 microseconds.
"""

import re
import warnings
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from math import floor, radians
from typing import Final

import erfa

from glstar.errors import ConfigError

__all__ = [
    "CLOCK_GRAIN_S",
    "centuries_since_j2000",
    "format_utc",
    "julian_day",
    "mean_sidereal_time_rad",
    "parse_known_utc",
    "parse_utc",
    "tai_minus_utc_s",
    "tt_julian_date",
    "ut1_julian_date",
]

# Times with a smaller difference, s, are equal: the resolution of a float64 for today's seconds since 1970 is 0.24 us.
CLOCK_GRAIN_S: Final = 1e-6

UNIX_EPOCH_JD = 2440587.5
_J2000_JD = 2451545.0
_DAY_S = 86400.0
# Range of times that users may give, UTC seconds since 1970; the paper's polynomials are accurate in this range.
_FIRST_S = -5364662400.0  # 1800-01-01
_LAST_S = 7258118400.0  # 2200-01-01
# Limit of all times, s, slightly larger because a flight may start or end outside that range.
_FARTHEST_S = 7.26e9
_LEAP_SECOND: Final = re.compile(r"(?P<before>.*[T ]\d\d:?\d\d:?)60(?P<after>([.,]\d+)?(Z|[+-]\d\d(:?\d\d)?)?)")
_TT_MINUS_TAI_S = 32.184
_JULIAN_CENTURY_DAYS = 36525.0

JulianDate = tuple[float, float]


def julian_day(year: int, month: int, day: float) -> float:
    """Return the Julian day of a Gregorian date.

    Parameters
    ----------
    year, month : int
        Gregorian calendar; January is 1.
    day : float
        Day of the month with its fraction.

    Returns
    -------
    float
        Days since noon of 4713 BC January 1 (Julian calendar); the paper's text says 4716 BC.

    Notes
    -----
    Teague & Chahl, Algorithm 1; Meeus, Astronomical Algorithms, eq. (7.1).

    Examples
    --------
    >>> julian_day(1957, 10, 4.81)
    2436116.31
    """
    if month <= 2:
        year, month = year - 1, month + 12
    century = year // 100
    gregorian = 2 - century + century // 4
    return floor(365.25 * (year + 4716)) + floor(30.6001 * (month + 1)) + day + gregorian - 1524.5


def parse_utc(text: str) -> float:
    """Return the UTC seconds since 1970 of an ISO 8601 time.

    Parameters
    ----------
    text : str
        Such as ``2024-03-10T11:00:00Z``; a time without an offset is UTC.  A leap second, 23:59:60, is the same time
        as the second after it.

    Returns
    -------
    float
        UTC seconds since 1970.

    Raises
    ------
    ConfigError
        If the text is not such a time.
    """
    stripped = text.strip()
    leap = _LEAP_SECOND.fullmatch(stripped)
    try:
        time = datetime.fromisoformat(f"{leap['before']}59{leap['after']}" if leap else stripped)
    except ValueError as error:
        raise ConfigError(f"{text!r} is no time; write ISO 8601, such as 2024-03-10T11:00:00Z") from error
    if time.tzinfo is None:
        time = time.replace(tzinfo=UTC)
    elapsed = time - datetime(1970, 1, 1, tzinfo=UTC)
    utc_s = elapsed.days * _DAY_S + elapsed.seconds + elapsed.microseconds * 1e-6
    if leap:
        if utc_s % _DAY_S < _DAY_S - 1:
            raise ConfigError(f"{text!r} is no time: a leap second is 23:59:60 of UTC")
        utc_s += 1
    return utc_s


def parse_known_utc(text: str) -> float:
    """Return the UTC seconds since 1970 of an ISO 8601 time in the years 1800 to 2200.

    Parameters
    ----------
    text : str
        As for `parse_utc`.

    Returns
    -------
    float
        UTC seconds since 1970.

    Raises
    ------
    ConfigError
        If the text is not such a time, or is outside the years 1800 to 2200.
    """
    utc_s = parse_utc(text)
    if not _FIRST_S <= utc_s < _LAST_S:
        raise ConfigError(f"{text!r} lies outside the years 1800 to 2200, for which glstar knows the sky")
    return utc_s


def format_utc(utc_s: float) -> str:
    """Return an ISO 8601 time, to the microsecond.

    Parameters
    ----------
    utc_s : float
        UTC seconds since 1970.

    Returns
    -------
    str
        Such as ``2024-03-10T11:00:00.000000Z``.
    """
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(utc_s * 1e6))
    return time.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def tai_minus_utc_s(utc_s: float) -> float:
    """Return TAI - UTC, s, from ERFA's table of leap seconds.

    Parameters
    ----------
    utc_s : float
        UTC seconds since 1970; 1972 or later.  After the end of the table, its last value is used.

    Returns
    -------
    float

    Raises
    ------
    ConfigError
        If the time is outside the years 1800 to 2200.
    """
    if not abs(utc_s) < _FARTHEST_S:
        raise ConfigError(
            f"{utc_s} s since 1970 is not a time in the years 1800 to 2200, for which glstar knows the sky"
        )
    return _leap_seconds(floor(utc_s / _DAY_S))


@lru_cache(maxsize=64)
def _leap_seconds(day: int) -> float:
    date = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(days=day)
    with warnings.catch_warnings():
        # "Dubious year": leap seconds of future years are not announced yet, so the last value of the table is used.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        return float(erfa.dat(date.year, date.month, date.day, 0.0))


def tt_julian_date(utc_s: float) -> JulianDate:
    """Return Terrestrial Time as a two-part Julian date.

    Parameters
    ----------
    utc_s : float
        UTC seconds since 1970.

    Returns
    -------
    (float, float)
        Days: the Julian date of the midnight before, and the remainder.
    """
    return _julian_date(utc_s, tai_minus_utc_s(utc_s) + _TT_MINUS_TAI_S)


def ut1_julian_date(utc_s: float, dut1_s: float = 0.0) -> JulianDate:
    """Return Universal Time UT1, which measures the rotation of the Earth, as a two-part Julian date.

    Parameters
    ----------
    utc_s : float
        UTC seconds since 1970.
    dut1_s : float
        UT1 - UTC, s, as published by the IERS; between -0.9 and 0.9.  1 s is 15" of Earth rotation.

    Returns
    -------
    (float, float)
        Days: the Julian date of the midnight before, and the remainder.
    """
    return _julian_date(utc_s, dut1_s)


def _julian_date(utc_s: float, delay_s: float) -> JulianDate:
    day = floor(utc_s / _DAY_S)
    return UNIX_EPOCH_JD + day, (utc_s - day * _DAY_S + delay_s) / _DAY_S


def centuries_since_j2000(julian_date: JulianDate) -> float:
    """Return Julian centuries since 2000 January 1, 12h.

    Parameters
    ----------
    julian_date : (float, float)
        A two-part Julian date.

    Returns
    -------
    float

    Notes
    -----
    Teague & Chahl, eq. (20).  The epoch is noon, not midnight as in the paper's text.
    """
    return ((julian_date[0] - _J2000_JD) + julian_date[1]) / _JULIAN_CENTURY_DAYS


def mean_sidereal_time_rad(ut1: JulianDate) -> float:
    """Return the mean sidereal time at Greenwich.

    Parameters
    ----------
    ut1 : (float, float)
        Universal Time UT1, a two-part Julian date.

    Returns
    -------
    float
        rad, 0 to 2 pi.

    Notes
    -----
    Meeus, eq. (12.4).  Departs from eq. (21), whose coefficients have few digits, so that it drifts by 0.5" per year
    (15" in 2026), and which lacks the equation of the equinoxes (up to 17"); `Astrometry.sidereal_time_rad` adds it.
    """
    days = (ut1[0] - _J2000_JD) + ut1[1]
    t = days / _JULIAN_CENTURY_DAYS
    # Whole days are dropped before the multiplication by 360, so that the fraction keeps its digits.
    turns_deg = 360.0 * ((ut1[0] - _J2000_JD) % 1.0 + ut1[1] % 1.0)
    degrees = 280.46061837 + turns_deg + 0.98564736629 * days + t * t * (0.000387933 - t / 38710000.0)
    return radians(degrees % 360.0)
