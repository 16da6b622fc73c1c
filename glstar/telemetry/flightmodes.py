"""Names of flight modes by their numbers in ArduPilot and PX4."""

from collections.abc import Mapping
from typing import Final

__all__ = ["ardupilot_mode", "px4_mode", "px4_navigation_state"]

# ArduPlane/mode.h, ArduCopter/mode.h, Rover/mode.h and ArduSub/mode.h of ArduPilot 4.6.
_PLANE: Final = {
    **dict(enumerate(("MANUAL", "CIRCLE", "STABILIZE", "TRAINING", "ACRO", "FBWA", "FBWB", "CRUISE", "AUTOTUNE"))),
    **dict(enumerate(("AUTO", "RTL", "LOITER", "TAKEOFF", "AVOID_ADSB", "GUIDED", "INITIALISING"), 10)),
    **dict(enumerate(("QSTABILIZE", "QHOVER", "QLOITER", "QLAND", "QRTL", "QAUTOTUNE", "QACRO", "THERMAL"), 17)),
    **dict(enumerate(("LOITERALTQLAND", "AUTOLAND"), 25)),
}
_COPTER: Final = {
    **dict(enumerate(("STABILIZE", "ACRO", "ALT_HOLD", "AUTO", "GUIDED", "LOITER", "RTL", "CIRCLE", "POSITION"))),
    **dict(enumerate(("LAND", "OF_LOITER", "DRIFT"), 9)),
    **dict(enumerate(("SPORT", "FLIP", "AUTOTUNE", "POSHOLD", "BRAKE", "THROW", "AVOID_ADSB", "GUIDED_NOGPS"), 13)),
    **dict(
        enumerate(("SMART_RTL", "FLOWHOLD", "FOLLOW", "ZIGZAG", "SYSTEMID", "AUTOROTATE", "AUTO_RTL", "TURTLE"), 21)
    ),
    29: "RATE_ACRO",
}
_ROVER: Final = {
    **dict(
        enumerate(("MANUAL", "ACRO", "LEARNING", "STEERING", "HOLD", "LOITER", "FOLLOW", "SIMPLE", "DOCK", "CIRCLE"))
    ),
    **dict(enumerate(("AUTO", "RTL", "SMART_RTL"), 10)),
    15: "GUIDED",
    16: "INITIALISING",
}
_SUB: Final = {
    **dict(enumerate(("STABILIZE", "ACRO", "ALT_HOLD", "AUTO", "GUIDED"))),
    7: "CIRCLE",
    9: "SURFACE",
    16: "POSHOLD",
    19: "MANUAL",
}
_ARDUPILOT: Final[Mapping[str, Mapping[int, str]]] = {
    "ArduPlane": _PLANE,
    "ArduCopter": _COPTER,
    "Rover": _ROVER,
    "ArduRover": _ROVER,
    "ArduSub": _SUB,
}
# vehicle_status.nav_state of PX4: msg/VehicleStatus.msg.
_NAVIGATION: Final = {
    **dict(enumerate(("Manual", "Altitude", "Position", "Mission", "Hold", "Return"))),
    10: "Acro",
    12: "Descend",
    13: "Termination",
    14: "Offboard",
    15: "Stabilized",
    **dict(enumerate(("Takeoff", "Land", "Follow", "Precision land", "Orbit", "VTOL takeoff"), 17)),
}
# Main mode of PX4's custom_mode, and the sub-modes of AUTO: px4_custom_mode.h.
_PX4_AUTO: Final = 4
_PX4_MAIN: Final = dict(
    enumerate(("Manual", "Altitude", "Position", "Auto", "Acro", "Offboard", "Stabilized", "Rattitude", "Simple"), 1)
)
_PX4_SUB: Final = dict(
    enumerate(("Ready", "Takeoff", "Hold", "Mission", "Return", "Land", "Reserved", "Follow", "Precision land"), 1)
)


def ardupilot_mode(vehicle: str | None, number: int) -> str:
    """Return the name of a mode of ArduPilot.

    Parameters
    ----------
    vehicle : str or None
        The firmware: ``"ArduPlane"``.
    number : int

    Returns
    -------
    str
        ``"LOITER"``; ``"mode 42"`` if it has no name.
    """
    return _ARDUPILOT.get((vehicle or "").split(" ")[0], {}).get(number, f"mode {number}")


def px4_mode(custom_mode: int) -> str:
    """Return the name of a mode of PX4 by the field custom_mode of a heartbeat.

    Parameters
    ----------
    custom_mode : int
        The main mode in bits 16 to 23, the sub-mode in bits 24 to 31.

    Returns
    -------
    str
    """
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    if main == _PX4_AUTO and sub in _PX4_SUB:
        return _PX4_SUB[sub]
    return _PX4_MAIN.get(main, f"mode {main}")


def px4_navigation_state(number: int) -> str:
    """Return the name of a navigation state of PX4.

    Parameters
    ----------
    number : int
        ``nav_state`` of the topic vehicle_status.

    Returns
    -------
    str
    """
    return _NAVIGATION.get(number, f"mode {number}")
