"""UTC and position from the GPS records of a DataFlash log."""

import numpy as np
from numpy.typing import NDArray

from glstar.sky.timescale import tai_minus_utc_s
from glstar.telemetry.dataflash.records import Records, nearest, numbered, stamped
from glstar.telemetry.samplevalidation import (
    YEAR_2010_S,
    YEAR_2100_S,
    no_position_samples,
    position_samples,
    valid_times,
)
from glstar.telemetry.source import ClockSamples, PositionSamples

__all__ = ["GPS_EPOCH_S", "LOGGED_LATE_S", "WEEK_S", "gps_readings", "leap_seconds", "positions", "utc"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

GPS_EPOCH_S = 315964800.0  # 1980-01-06, unix seconds
WEEK_S = 604800.0
_TAI_MINUS_GPS_S = 19.0
_FIX_3D = 3

# Delay from a GPS sample to its record, s: 16 to 30 ms in the mean of logs with GPA, 21 ms by SYSTEM_TIME in the
# telemetry log of the Adelaide flight.
LOGGED_LATE_S = 0.020
# A GPA record belongs to the GPS record of the same receiver that was written within this time, s.
_SAME_SAMPLE_S = 0.05

# Names of week and millisecond, now and before 2015.
_WEEK_AND_MS = (("GWk", "GMS"), ("Week", "TimeMS"))
_UNSTAMPED = "its GPS records are not stamped with the time since boot (TimeUS or T)"


def positions(log: Records) -> PositionSamples:
    """Return the positions of a log; if there are none, an empty batch that says why.

    Parameters
    ----------
    log : Records

    Returns
    -------
    PositionSamples
    """
    names = ("Lat", "Lng", "Alt")
    if (records := stamped(log, "POS", *names)) is not None:
        clock_s, (latitude_deg, longitude_deg, height_m) = records
        if (known := position_samples(clock_s, latitude_deg, longitude_deg, height_m, "POS")).clock_s.size:
            return known
    if "GPS" not in log:
        return no_position_samples("it has neither POS nor GPS records")
    if (fixes := _fixes(log, *names)) is None:
        return no_position_samples(_UNSTAMPED)
    _, clock_s, (latitude_deg, longitude_deg, height_m) = fixes
    if (known := position_samples(clock_s, latitude_deg, longitude_deg, height_m, "GPS")).clock_s.size:
        return known
    return no_position_samples("its GPS never had a 3D fix")


def utc(log: Records) -> ClockSamples:
    """Return the UTC readings of the GPS of a log; if there are none, an empty batch that says why.

    Parameters
    ----------
    log : Records

    Returns
    -------
    ClockSamples
    """
    if "GPS" not in log:
        return _no_utc("it has no GPS records")
    fields = set(log.fields("GPS"))
    names = next((names for names in _WEEK_AND_MS if set(names) <= fields), None)
    if names is None:
        return _no_utc("its GPS records have no week and milliseconds (GWk, GMS)")
    if (fixes := _fixes(log, *names)) is None:
        return _no_utc(_UNSTAMPED)
    receiver, clock_s, (week, week_ms) = fixes
    fixed = week > 0
    if not fixed.any():
        return _no_utc("its GPS never had a 3D fix and a week")

    with np.errstate(over="ignore", invalid="ignore"):  # of damaged numbers
        gps_s = GPS_EPOCH_S + week * WEEK_S + week_ms * 1e-3
    plausible = fixed & (gps_s >= YEAR_2010_S) & (gps_s < YEAR_2100_S)
    if not plausible.any():
        odd = f"its GPS says week {np.median(week[fixed]):.0f}, {1980 + np.median(week[fixed]) / 52.18:.0f}"
        return _no_utc(f"{odd}: the receiver's week has rolled over")
    clock_s, gps_s = clock_s[plausible], gps_s[plausible]
    sampled_s = _sampled_s(log, receiver, clock_s)
    if np.isfinite(sampled_s).any():
        valid, how = np.isfinite(sampled_s), "GPS time at GPA.SMS"
        lag_s, is_measured = float(np.median((clock_s - sampled_s)[valid])), True
        clock_s, gps_s = sampled_s[valid], gps_s[valid]
    else:
        lag_s, is_measured = LOGGED_LATE_S, False
        clock_s, how = clock_s - LOGGED_LATE_S, "GPS time when logged (no GPA)"
    leap_s = leap_seconds(float(np.median(gps_s)))
    source = f"{how}, {gps_s.size} fixes, {leap_s:.0f} leap seconds"
    return ClockSamples(clock_s, gps_s - leap_s, source, lag_s=lag_s, lag_is_measured=is_measured)


def gps_readings(log: Records) -> tuple[Integer, Float, Float]:
    """Return file positions, times since boot and GPS times of the readings of the GPS in use.

    Parameters
    ----------
    log : Records

    Returns
    -------
    position : (n,) int64
    clock_s, gps_s : (n,) float64
        Time since boot, s; GPS time, counted like unix seconds from 1970.
    """
    for names in _WEEK_AND_MS:
        if (records := stamped(log, "GPS", "Status", *names)) is None:
            continue
        clock_s, (status, week, week_ms) = records
        with np.errstate(over="ignore", invalid="ignore"):  # of damaged numbers
            gps_s = GPS_EPOCH_S + week * WEEK_S + week_ms * 1e-3
            valid = (status >= _FIX_3D) & (week > 0) & (gps_s >= YEAR_2010_S) & (gps_s < YEAR_2100_S)
        receivers, in_use = numbered(log, "GPS", "I"), log.columns("GPS", "U")
        if in_use is not None and (valid & (in_use[0] == 1)).any():
            valid &= in_use[0] == 1
        elif valid.any():
            found, count = np.unique(receivers[valid], return_counts=True)
            valid &= receivers == found[count.argmax()]
        return log.position("GPS")[valid], clock_s[valid], gps_s[valid]
    return np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)


def _no_utc(reason: str) -> ClockSamples:
    return ClockSamples(np.empty(0), np.empty(0), reason)


def leap_seconds(gps_s: float) -> float:
    """Return GPS time - UTC at a GPS time, s.

    Parameters
    ----------
    gps_s : float
        GPS time, counted like unix seconds from 1970.

    Returns
    -------
    float
    """
    return tai_minus_utc_s(gps_s - (tai_minus_utc_s(gps_s) - _TAI_MINUS_GPS_S)) - _TAI_MINUS_GPS_S


def _fixes(log: Records, *names: str) -> tuple[int, Float, list[Float]] | None:
    """Return the number of the GPS receiver in use, and times and columns of its records with a 3D fix.

    None if a column is missing, or the records have no time since boot.
    """
    if (records := stamped(log, "GPS", "Status", *names)) is None:
        return None
    clock_s, (status, *columns) = records
    receivers, in_use = numbered(log, "GPS", "I"), log.columns("GPS", "U")
    fixed = status >= _FIX_3D
    if in_use is not None and (fixed & (in_use[0] == 1)).any():
        fixed &= in_use[0] == 1
    found, count = np.unique(receivers[fixed], return_counts=True)
    receiver = int(found[count.argmax()]) if found.size else 0
    fixed &= (receivers == receiver) & valid_times(clock_s)
    return receiver, clock_s[fixed], [column[fixed] for column in columns]


def _sampled_s(log: Records, receiver: int, clock_s: Float) -> Float:
    """Return the times of the samples of GPS records written at given times, s since boot; NaN without GPA."""
    sampled_s = np.full(clock_s.size, np.nan)
    if (accuracy := log.columns("GPA", "TimeUS", "SMS")) is None:
        return sampled_s
    valid = (accuracy[1] > 0) & (numbered(log, "GPA", "I") == receiver)
    written_s, sms_s = accuracy[0][valid] * 1e-6, accuracy[1][valid] * 1e-3
    if written_s.size:
        near = nearest(written_s, clock_s)
        together = np.abs(written_s[near] - clock_s) < _SAME_SAMPLE_S
        sampled_s[together] = sms_s[near][together]
    return sampled_s
