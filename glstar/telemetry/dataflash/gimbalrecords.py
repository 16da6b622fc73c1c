"""The attitude of a gimbal in the MNT records of a DataFlash log."""

from typing import Final

import numpy as np

from glstar.rotation import quaternion_from_euler
from glstar.telemetry.dataflash.records import Records, numbered, stamped
from glstar.telemetry.samplevalidation import valid_times
from glstar.telemetry.source import GimbalSamples

__all__ = ["gimbal_of_records"]

# Roll and pitch against the horizon, deg; the yaw against the aircraft's heading and against north, deg.
_ANGLES: Final = ("Roll", "Pitch", "YawB", "YawE")


def gimbal_of_records(log: Records) -> GimbalSamples | None:
    """Return the attitude of the first gimbal; None if the log has none.

    Parameters
    ----------
    log : Records

    Returns
    -------
    GimbalSamples or None
    """
    if "MNT" not in log:
        return None
    if (known := stamped(log, "MNT", *_ANGLES)) is None:
        return None
    clock_s, (roll_deg, pitch_deg, yaw_deg, yaw_earth_deg) = known
    # The yaw against north does not depend on the aircraft's heading; it is NaN where the gimbal does not know it.
    is_earth = np.isfinite(yaw_earth_deg)
    angles_deg = np.stack([roll_deg, pitch_deg, np.where(is_earth, yaw_earth_deg, yaw_deg)])
    number = numbered(log, "MNT", "I")
    valid = np.isfinite(angles_deg).all(axis=0) & valid_times(clock_s)
    if not valid.any():
        return None
    valid &= number == number[valid].min()
    if np.count_nonzero(valid) < 2:
        return None
    q = quaternion_from_euler(*np.deg2rad(angles_deg[:, valid]))
    return GimbalSamples(clock_s[valid], q, is_earth[valid], "MNT")
