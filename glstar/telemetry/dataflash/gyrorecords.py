"""Gyro rates of a DataFlash log."""

import numpy as np
from numpy.typing import NDArray

from glstar.telemetry.dataflash.records import Records, numbered, stamped
from glstar.telemetry.samplevalidation import valid_rates, valid_times
from glstar.telemetry.source import RateSamples

__all__ = ["turn_rates"]

Float = NDArray[np.float64]

# Raw samples are used if they cover this fraction of the flight; they may be logged for a part of it.
_NEARLY_ALL = 0.95


def turn_rates(log: Records) -> RateSamples | None:
    """Return the rates of one gyro: raw samples (GYR) if they cover the flight, else filtered ones (IMU).

    Both are in the axes of the autopilot's board, forward, right, down, as XKQ is.  Of several gyros the first one is
    used: they are on one board.

    Parameters
    ----------
    log : Records

    Returns
    -------
    RateSamples or None
        None if the log has no rates.
    """
    filtered, raw = _first(log, "IMU"), _first(log, "GYR")
    if raw is None or filtered is None:
        return filtered or raw
    whole_s, raw_s = np.ptp(filtered.clock_s), np.ptp(raw.clock_s)
    faster = raw.clock_s.size / max(raw_s, 1e-6) > filtered.clock_s.size / max(whole_s, 1e-6)
    return raw if faster and raw_s >= _NEARLY_ALL * whole_s else filtered


def _first(log: Records, name: str) -> RateSamples | None:
    """Return the rates of the first instance; older logs number the messages (IMU, IMU2; GYR1, GYR2) instead."""
    for spelling in (name, *(f"{name}{number}" for number in (1, 2, 3))):
        if (records := stamped(log, spelling, "GyrX", "GyrY", "GyrZ")) is None:
            continue
        clock_s, rates = records
        if name == "GYR":  # written in bursts, with the time of each sample
            if (sampled := log.columns(spelling, "SampleUS")) is None:
                continue
            clock_s = np.where(sampled[0] > 0, sampled[0] * 1e-6, clock_s)
        instance, rate_rad_per_s = numbered(log, spelling, "I"), np.stack(rates, axis=-1)
        valid = valid_rates(rate_rad_per_s)
        for one in np.unique(instance[valid]):
            mine = np.flatnonzero(valid & (instance == one))
            mine = mine[valid_times(clock_s[mine])]
            if mine.size > 1:
                return RateSamples(clock_s[mine], rate_rad_per_s[mine], f"{spelling} {one}")
    return None
