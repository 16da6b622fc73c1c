"""Names of vehicle types and autopilots by their MAVLink numbers, and of firmware versions."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["ARDUPILOT", "PX4", "autopilot", "vehicle_kind", "version"]

# Autopilots, by MAV_AUTOPILOT.
ARDUPILOT, PX4 = 3, 12
_AUTOPILOTS: Final = {
    ARDUPILOT: "ArduPilot",
    PX4: "PX4",
    4: "OpenPilot",
    13: "SMACCMPilot",
    14: "AutoQuad",
    20: "ReflexPilot",
}

# Kinds of aircraft, by MAV_TYPE.
_KINDS: Final = {
    1: "fixed wing",
    2: "quadrotor",
    3: "coaxial helicopter",
    4: "helicopter",
    5: "antenna tracker",
    7: "airship",
    8: "balloon",
    9: "rocket",
    10: "rover",
    11: "boat",
    12: "submarine",
    13: "hexarotor",
    14: "octorotor",
    15: "tricopter",
    16: "flapping wing",
    17: "kite",
    19: "VTOL",
    20: "VTOL",
    21: "VTOL",
    22: "VTOL",
    23: "VTOL",
    24: "VTOL",
    25: "VTOL",
    28: "parafoil",
    29: "dodecarotor",
    35: "decarotor",
}
# ArduPilot firmware by kind of vehicle.
_ARDUPILOT_FIRMWARE: Final = {
    "fixed wing": "ArduPlane",
    "VTOL": "ArduPlane",
    "antenna tracker": "AntennaTracker",
    "airship": "Blimp",
    "rover": "Rover",
    "boat": "Rover",
    "submarine": "ArduSub",
    **dict.fromkeys(
        (
            "quadrotor",
            "coaxial helicopter",
            "helicopter",
            "hexarotor",
            "octorotor",
            "tricopter",
            "dodecarotor",
            "decarotor",
        ),
        "ArduCopter",
    ),
}
# Release stage by the last byte of a version.
_STAGES: Final = {0: "dev", 64: "alpha", 128: "beta", 192: "rc"}


def vehicle_kind(mav_type: ArrayLike | None) -> str | None:
    """Return the kind of vehicle in a log.

    Parameters
    ----------
    mav_type : (n,) array_like, optional
        All values of MAV_TYPE in the log.

    Returns
    -------
    str or None
        The most frequent kind; None if it has no name.
    """
    types = np.asarray([] if mav_type is None else mav_type, dtype=np.float64)
    kinds, count = np.unique(types[np.isin(types, list(_KINDS))], return_counts=True)
    return _KINDS[int(kinds[count.argmax()])] if kinds.size else None


def autopilot(number: int, kind: str | None) -> str | None:
    """Return the name of an autopilot and its vehicle.

    Parameters
    ----------
    number : int
        MAV_AUTOPILOT.
    kind : str, optional
        See `vehicle_kind`.

    Returns
    -------
    str or None
        ``"ArduPlane"``, ``"PX4 quadrotor"``.
    """
    if number == ARDUPILOT and kind in _ARDUPILOT_FIRMWARE:
        return _ARDUPILOT_FIRMWARE[kind]
    return " ".join(filter(None, (_AUTOPILOTS.get(number), kind))) or None


def version(number: int) -> str:
    """Return a firmware version of PX4 or ArduPilot as text.

    Parameters
    ----------
    number : int
        Major, minor, patch and stage, a byte each from the highest.

    Returns
    -------
    str
        ``"v1.11.2"``, ``"v1.14.0-beta"``; empty for 0.
    """
    major, minor, patch, stage = number.to_bytes(8, "big")[-4:]
    if not number:
        return ""
    suffix = f"-{_STAGES[stage]}" if stage in _STAGES else ""
    return f"v{major}.{minor}.{patch}{suffix}"
