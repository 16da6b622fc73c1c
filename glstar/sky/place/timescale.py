"""Time scales (UTC seconds, Julian dates, leap seconds, sidereal time) and the Earth's orientation.

glstar counts time in `utc_s`: seconds of UTC since 1970-01-01, with 86400 s per day (a leap second has the same number
as the second after it).  Julian dates have two parts whose sum is the date, because the resolution of a single float64
at 2 400 000 days is only 40 microseconds.  UT1 - UTC and polar motion come from the IERS table in the optional package
astropy-iers-data, whose last values continue after its end.  Without the table, or before its first day, UT1 = UTC and
a fixed pole are assumed (errors of up to 13" and 0.5").
"""

import hashlib
import importlib.util
import re
import warnings
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from math import floor, radians
from pathlib import Path
from typing import Any

import erfa
import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError

# Times with a smaller difference, s, are equal: the resolution of a float64 for today's seconds since 1970 is 0.24 us.
CLOCK_GRAIN_S = 1e-6

UNIX_EPOCH_JD = 2440587.5
_J2000_JD = 2451545.0
_DAY_S = 86400.0
# Range of times that users may give, UTC seconds since 1970; the paper's polynomials are accurate in this range.
_FIRST_S = -5364662400.0  # 1800-01-01
_LAST_S = 7258118400.0  # 2200-01-01
# Limit of all times, s, slightly larger because a flight may start or end outside that range.
_FARTHEST_S = 7.26e9
_LEAP_SECOND = re.compile(r"(?P<before>.*[T ]\d\d:?\d\d:?)60(?P<after>([.,]\d+)?(Z|[+-]\d\d(:?\d\d)?)?)")
_TT_MINUS_TAI_S = 32.184
_JULIAN_CENTURY_DAYS = 36525.0

JulianDate = tuple[float, float]

_PACKAGE = "astropy_iers_data"
_DISTRIBUTION = "astropy-iers-data"
_TABLE = "finals2000A.all"
_UNIX_EPOCH_MJD = 40587.0
_ARCSEC_RAD = np.pi / 648000

# Columns of finals2000A.all, from 0: first the final values of Bulletin B, which exist up to a few months ago, then the
# rapid and predicted values of Bulletin A.
_MJD = slice(7, 15)
_X_POLE_ARCSEC = (slice(134, 144), slice(18, 27))
_Y_POLE_ARCSEC = (slice(144, 154), slice(37, 46))
_DUT1_S = (slice(154, 165), slice(58, 68))

GPS_EPOCH_S = 315964800.0  # 1980-01-06, unix seconds
WEEK_S = 604800.0
ROLLOVER_WEEKS = 1024  # of GPS receivers that count weeks with 10 bits
TAI_MINUS_GPS_S = 19.0


def julian_day(year: int, month: int, day: float) -> float:
    """Return the Julian day of a Gregorian date: days since noon of 4713 BC January 1, Julian calendar.

    `month`: January is 1; `day`: day of the month with its fraction.  Teague & Chahl, Algorithm 1, whose text says
    4716 BC; Meeus, Astronomical Algorithms, eq. (7.1).

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

    `text`: such as ``2024-03-10T11:00:00Z``; a time without an offset is UTC.  A leap second, 23:59:60, is the same
    time as the second after it.  Raises ConfigError if the text is not such a time.
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
    """Return what `parse_utc` does; raises ConfigError also if the time is outside the years 1800 to 2200."""
    utc_s = parse_utc(text)
    if not _FIRST_S <= utc_s < _LAST_S:
        raise ConfigError(f"{text!r} lies outside the years 1800 to 2200, for which glstar knows the sky")
    return utc_s


def format_utc(utc_s: float) -> str:
    """Return UTC seconds since 1970 as an ISO 8601 time, such as ``2024-03-10T11:00:00.000000Z``."""
    time = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(utc_s * 1e6))
    return time.strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def tai_minus_utc_s(utc_s: float) -> float:
    """Return TAI - UTC, s, from ERFA's table of leap seconds; after its end, the last value is used.

    `utc_s`: UTC seconds since 1970.  Raises ConfigError if the time is outside the years 1800 to 2200.
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
    """Return Terrestrial Time at UTC seconds since 1970: the Julian date of the midnight before, and the rest, days."""
    return _julian_date(utc_s, tai_minus_utc_s(utc_s) + _TT_MINUS_TAI_S)


def ut1_julian_date(utc_s: float, dut1_s: float = 0.0) -> JulianDate:
    """Return Universal Time UT1, which measures the rotation of the Earth, as `tt_julian_date` does.

    `dut1_s`: UT1 - UTC, s, as published by the IERS, between -0.9 and 0.9.  1 s is 15" of Earth rotation.
    """
    return _julian_date(utc_s, dut1_s)


def _julian_date(utc_s: float, delay_s: float) -> JulianDate:
    day = floor(utc_s / _DAY_S)
    return UNIX_EPOCH_JD + day, (utc_s - day * _DAY_S + delay_s) / _DAY_S


def centuries_since_j2000(julian_date: JulianDate) -> float:
    """Return Julian centuries since 2000 January 1, 12h: Teague & Chahl, eq. (20), whose text says midnight."""
    return ((julian_date[0] - _J2000_JD) + julian_date[1]) / _JULIAN_CENTURY_DAYS


def mean_sidereal_time_rad(ut1: JulianDate) -> float:
    """Return the mean sidereal time at Greenwich, 0 to 2 pi rad: Meeus, eq. (12.4).

    `ut1`: UT1 as a two-part Julian date.  Departs from eq. (21), whose coefficients have few digits, so that it drifts
    by 0.5" per year (15" in 2026), and which lacks the equation of the equinoxes (up to 17");
    `Astrometry.sidereal_time_rad` adds it.
    """
    days = (ut1[0] - _J2000_JD) + ut1[1]
    t = days / _JULIAN_CENTURY_DAYS
    # Whole days are dropped before the multiplication by 360, so that the fraction keeps its digits.
    turns_deg = 360.0 * ((ut1[0] - _J2000_JD) % 1.0 + ut1[1] % 1.0)
    degrees = 280.46061837 + turns_deg + 0.98564736629 * days + t * t * (0.000387933 - t / 38710000.0)
    return radians(degrees % 360.0)


@dataclass(frozen=True, slots=True)
class EarthOrientation:
    """Earth orientation parameters at one time."""

    dut1_s: float = 0.0  # UT1 - UTC
    x_pole_rad: float = 0.0  # celestial intermediate pole on the Earth, towards Greenwich
    y_pole_rad: float = 0.0  # celestial intermediate pole on the Earth, towards 90 deg west

    @property
    def polar_motion(self) -> Float:
        """Matrix from the frame of the intermediate pole to the terrestrial frame (ITRS), (3, 3) float64."""
        return np.asarray(erfa.pom00(self.x_pole_rad, self.y_pole_rad, 0.0), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Daily values of the IERS table, and their source."""

    utc_s: Float
    ut1_minus_tai_s: Float
    x_pole_rad: Float
    y_pole_rad: Float
    source: str
    sha256: str


def earth_orientation(utc_s: float) -> EarthOrientation | None:
    """Return the Earth orientation of the IERS table: between its days, and after its end the last values.

    None before its first day, and if no table is installed.
    """
    table = _table()
    if table is None or utc_s < table.utc_s[0]:
        return None
    # UT1 - TAI is interpolated, because it has no leap seconds.
    values = (table.ut1_minus_tai_s, table.x_pole_rad, table.y_pole_rad)
    ut1_minus_tai_s, x_pole_rad, y_pole_rad = (float(np.interp(utc_s, table.utc_s, value)) for value in values)
    return EarthOrientation(ut1_minus_tai_s + tai_minus_utc_s(utc_s), x_pole_rad, y_pole_rad)


def has_earth_orientation() -> bool:
    """Return whether an IERS table is installed."""
    return _table() is not None


def described_earth_orientation(utc_s: float) -> dict[str, Any]:
    """Return the manifest's entry about the Earth orientation at a time; empty if no table is installed."""
    table = _table()
    if table is None:
        return {}
    source = {"source": table.source, "sha256": table.sha256}
    if not table.utc_s[0] <= utc_s <= table.utc_s[-1]:
        source["covers"] = f"{format_utc(table.utc_s[0])[:10]} to {format_utc(table.utc_s[-1])[:10]}"
    earth = earth_orientation(utc_s)
    if earth is None:
        return {"earth_orientation": source | {"dut1_s": 0.0}}
    values = {
        "utc": format_utc(utc_s),
        "dut1_s": round(earth.dut1_s, 7),
        "x_pole_arcsec": round(earth.x_pole_rad / _ARCSEC_RAD, 6),
        "y_pole_arcsec": round(earth.y_pole_rad / _ARCSEC_RAD, 6),
    }
    return {"earth_orientation": source | values}


def earth_orientation_note(utc_s: float) -> str:
    """Return a remark on the UT1 of a time that the IERS table does not cover; empty if it does."""
    table = _table()
    if table is None:
        return (
            "UT1 = UTC assumed (astropy-iers-data is not installed): azimuths and altitudes may be 13 arcsec off;"
            " pip install astropy-iers-data"
        )
    if table.utc_s[0] <= utc_s <= table.utc_s[-1]:
        return ""
    earth = earth_orientation(utc_s)
    if earth is None:
        first = format_utc(table.utc_s[0])[:10]
        return (
            f"UT1 = UTC assumed ({table.source} begins on {first}): azimuths and altitudes may be 13 arcsec off, and"
            " more before UTC had whole leap seconds (1972)"
        )
    days = (utc_s - table.utc_s[-1]) / _DAY_S
    return (
        f"UT1 - UTC = {earth.dut1_s:+.4f} s continues the last value of {table.source}, which ends on"
        f" {format_utc(table.utc_s[-1])[:10]}, {days:.0f} days earlier: UT1 drifts by up to 17 arcsec a year; update"
        " astropy-iers-data"
    )


@lru_cache(maxsize=1)
def _table() -> _Table | None:
    """Return the table of the installed package; None if there is none."""
    spec = importlib.util.find_spec(_PACKAGE)
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(folder) / "data" / _TABLE
        if path.is_file():
            try:
                source = f"{_DISTRIBUTION} {version(_DISTRIBUTION)}, {_TABLE}"
            except PackageNotFoundError:
                source = f"{_DISTRIBUTION}, {_TABLE}"
            return _read(path.read_bytes(), source)
    return None


def _read(content: bytes, source: str) -> _Table:
    """Return the content of a table ``finals2000A.all``."""
    # The last days have no prediction yet: skip them.
    lines = [line for line in content.decode("ascii").splitlines() if line[_DUT1_S[1]].strip()]
    mjd = np.array([float(line[_MJD]) for line in lines])
    x_pole_arcsec, y_pole_arcsec, dut1_s = (
        np.array([float(line[final].strip() or line[rapid]) for line in lines])
        for final, rapid in (_X_POLE_ARCSEC, _Y_POLE_ARCSEC, _DUT1_S)
    )
    with warnings.catch_warnings():
        # "Dubious year": no leap second is announced for the years of the predictions.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        year, month, day, _ = erfa.jd2cal(2400000.5, mjd)
        leap_s = erfa.dat(year, month, day, 0.0)
    return _Table(
        utc_s=(mjd - _UNIX_EPOCH_MJD) * _DAY_S,
        ut1_minus_tai_s=dut1_s - leap_s,
        x_pole_rad=x_pole_arcsec * _ARCSEC_RAD,
        y_pole_rad=y_pole_arcsec * _ARCSEC_RAD,
        source=source,
        sha256=hashlib.sha256(content).hexdigest(),
    )


def leap_seconds(gps_s: float) -> float:
    """Return GPS time - UTC, s, at a GPS time that is counted from 1970 like unix seconds."""
    return tai_minus_utc_s(gps_s - (tai_minus_utc_s(gps_s) - TAI_MINUS_GPS_S)) - TAI_MINUS_GPS_S
