"""The boots of a DataFlash log, by its clocks and its GPS."""

import numpy as np
from numpy.typing import NDArray

from glstar.telemetry.boots import find_boots
from glstar.telemetry.dataflash.gps import gps_readings
from glstar.telemetry.dataflash.records import Records, stamped
from glstar.telemetry.source import Boot

__all__ = ["boots_of"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

# Messages by which reboots are detected: those that are logged at a steady rate.
_CLOCKED = (
    *("ATT", "AHR2", "SIM", "POS", "GPS"),
    *(f"{name}{number}" for name in ("XKQ", "NKQ", "IMU", "GYR") for number in ("", 1, 2, 3)),
)


def boots_of(log: Records, *, knows_utc: bool | None = None) -> tuple[Boot, ...]:
    """Return the boots of a log, in the order of the file.

    Parameters
    ----------
    log : Records
    knows_utc : bool, optional
        Whether the log has UTC; by default whether its GPS has.

    Returns
    -------
    tuple of Boot
    """
    series = [(log.position(name), records[0]) for name in _CLOCKED if (records := stamped(log, name)) is not None]
    return find_boots(series, gps_readings(log), log.heads, log.alike, knows_utc=knows_utc)
