"""Names of vehicles, autopilots, firmware versions and flight modes by their numbers; the attitude of a gimbal.

Roll and pitch of a gimbal are the platform's against the horizon.  Its yaw is against north or against the
heading of the aircraft: the flags of GIMBAL_DEVICE_ATTITUDE_STATUS say which, in older senders by their yaw lock;
MOUNT_ORIENTATION, MOUNT_STATUS and mount_orientation have the latter.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from glstar.arrays import Float
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.telemetry.mavlink.clock import VehicleClock
from glstar.telemetry.mavlink.packets import COMPONENT, FIELDS_FROM, SYSTEM, Packets, Sender
from glstar.telemetry.source import GimbalSamples, unit_quaternions, valid_times

GIMBAL_STATUS = "GIMBAL_DEVICE_ATTITUDE_STATUS"
# The best one first: of several, only the first is used.
GIMBAL_MESSAGES = (GIMBAL_STATUS, "MOUNT_ORIENTATION", "MOUNT_STATUS")
# Bits of GIMBAL_DEVICE_FLAGS.
_YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 16, 32, 64

# Autopilots, by MAV_AUTOPILOT.
ARDUPILOT, PX4 = 3, 12
_AUTOPILOTS = {
    ARDUPILOT: "ArduPilot",
    PX4: "PX4",
    4: "OpenPilot",
    13: "SMACCMPilot",
    14: "AutoQuad",
    20: "ReflexPilot",
}

# Kinds of aircraft, by MAV_TYPE.
_KINDS = {
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
_ARDUPILOT_FIRMWARE = {
    "fixed wing": "ArduPlane",
    "VTOL": "ArduPlane",
    "antenna tracker": "AntennaTracker",
    "airship": "Blimp",
    "rover": "Rover",
    "boat": "Rover",
    "submarine": "ArduSub",
    **dict.fromkeys(("quadrotor", "hexarotor", "octorotor", "tricopter", "dodecarotor", "decarotor"), "ArduCopter"),
    **dict.fromkeys(("coaxial helicopter", "helicopter"), "ArduCopter"),
}
# Release stage by the last byte of a version.
_STAGES = {0: "dev", 64: "alpha", 128: "beta", 192: "rc"}


def vehicle_kind(mav_type: ArrayLike | None) -> str | None:
    """Return the kind of vehicle that is the most frequent in (n,) values of MAV_TYPE; None if none has a name."""
    types = np.asarray([] if mav_type is None else mav_type, dtype=np.float64)
    kinds, count = np.unique(types[np.isin(types, list(_KINDS))], return_counts=True)
    return _KINDS[int(kinds[count.argmax()])] if kinds.size else None


def autopilot(number: int, kind: str | None) -> str | None:
    """Return the name of an autopilot, by MAV_AUTOPILOT, and its vehicle: ``"ArduPlane"``, ``"PX4 quadrotor"``."""
    if number == ARDUPILOT and kind in _ARDUPILOT_FIRMWARE:
        return _ARDUPILOT_FIRMWARE[kind]
    return " ".join(filter(None, (_AUTOPILOTS.get(number), kind))) or None


def version(number: int) -> str:
    """Return a firmware version of PX4 or ArduPilot: ``"v1.11.2"``, ``"v1.14.0-beta"``; empty for 0.

    The bytes of the number are major, minor, patch and stage, from the highest.
    """
    major, minor, patch, stage = number.to_bytes(8, "big")[-4:]
    if not number:
        return ""
    suffix = f"-{_STAGES[stage]}" if stage in _STAGES else ""
    return f"v{major}.{minor}.{patch}{suffix}"


# ArduPlane/mode.h, ArduCopter/mode.h, Rover/mode.h and ArduSub/mode.h of ArduPilot 4.6.
_PLANE = {
    **dict(enumerate(("MANUAL", "CIRCLE", "STABILIZE", "TRAINING", "ACRO", "FBWA", "FBWB", "CRUISE", "AUTOTUNE"))),
    **dict(enumerate(("AUTO", "RTL", "LOITER", "TAKEOFF", "AVOID_ADSB", "GUIDED", "INITIALISING"), 10)),
    **dict(enumerate(("QSTABILIZE", "QHOVER", "QLOITER", "QLAND", "QRTL", "QAUTOTUNE", "QACRO", "THERMAL"), 17)),
    **dict(enumerate(("LOITERALTQLAND", "AUTOLAND"), 25)),
}
_COPTER = {
    **dict(enumerate(("STABILIZE", "ACRO", "ALT_HOLD", "AUTO", "GUIDED", "LOITER", "RTL", "CIRCLE", "POSITION"))),
    **dict(enumerate(("LAND", "OF_LOITER", "DRIFT"), 9)),
    **dict(enumerate(("SPORT", "FLIP", "AUTOTUNE", "POSHOLD", "BRAKE", "THROW", "AVOID_ADSB", "GUIDED_NOGPS"), 13)),
    **dict(enumerate(("SMART_RTL", "FLOWHOLD", "FOLLOW", "ZIGZAG", "SYSTEMID", "AUTOROTATE", "AUTO_RTL"), 21)),
    28: "TURTLE",
    29: "RATE_ACRO",
}
_ROVER = {
    **dict(enumerate(("MANUAL", "ACRO", "LEARNING", "STEERING", "HOLD", "LOITER", "FOLLOW"))),
    **dict(enumerate(("SIMPLE", "DOCK", "CIRCLE"), 7)),
    **dict(enumerate(("AUTO", "RTL", "SMART_RTL"), 10)),
    15: "GUIDED",
    16: "INITIALISING",
}
_SUB = {
    **dict(enumerate(("STABILIZE", "ACRO", "ALT_HOLD", "AUTO", "GUIDED"))),
    7: "CIRCLE",
    9: "SURFACE",
    16: "POSHOLD",
    19: "MANUAL",
}
_ARDUPILOT: Mapping[str, Mapping[int, str]] = {
    "ArduPlane": _PLANE,
    "ArduCopter": _COPTER,
    "Rover": _ROVER,
    "ArduRover": _ROVER,
    "ArduSub": _SUB,
}
# vehicle_status.nav_state of PX4: msg/VehicleStatus.msg.
_NAVIGATION = {
    **dict(enumerate(("Manual", "Altitude", "Position", "Mission", "Hold", "Return"))),
    10: "Acro",
    12: "Descend",
    13: "Termination",
    14: "Offboard",
    15: "Stabilized",
    **dict(enumerate(("Takeoff", "Land", "Follow", "Precision land", "Orbit", "VTOL takeoff"), 17)),
}
# Main mode of PX4's custom_mode, and the sub-modes of AUTO: px4_custom_mode.h.
_PX4_AUTO = 4
_PX4_MAIN = dict(
    enumerate(("Manual", "Altitude", "Position", "Auto", "Acro", "Offboard", "Stabilized", "Rattitude", "Simple"), 1)
)
_PX4_SUB = dict(
    enumerate(("Ready", "Takeoff", "Hold", "Mission", "Return", "Land", "Reserved", "Follow", "Precision land"), 1)
)


def ardupilot_mode(vehicle: str | None, number: int) -> str:
    """Return the name of a mode of a firmware such as ``"ArduPlane"``: ``"LOITER"``; ``"mode 42"`` without a name."""
    return _ARDUPILOT.get((vehicle or "").split(" ")[0], {}).get(number, f"mode {number}")


def px4_mode(custom_mode: int) -> str:
    """Return the name of a mode of PX4, by its main mode (bits 16 to 23) and sub-mode (bits 24 to 31)."""
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    if main == _PX4_AUTO and sub in _PX4_SUB:
        return _PX4_SUB[sub]
    return _PX4_MAIN.get(main, f"mode {main}")


def px4_navigation_state(number: int) -> str:
    """Return the name of a navigation state of PX4, ``nav_state`` of the topic vehicle_status."""
    return _NAVIGATION.get(number, f"mode {number}")


def yaw_is_earth(flags: Float) -> NDArray[np.bool_]:
    """Return whether the yaw of a gimbal is against north, by (n,) GIMBAL_DEVICE_FLAGS.

    YAW_IN_EARTH_FRAME or YAW_IN_VEHICLE_FRAME say so; with neither of them, YAW_LOCK does.
    """
    bits = flags.astype(np.int64)
    locked = (bits & _YAW_LOCK > 0) & (bits & _YAW_IN_VEHICLE_FRAME == 0)
    return np.asarray((bits & _YAW_IN_EARTH_FRAME > 0) | locked)


def gimbal_of_packets(packets: Packets, sender: Sender, clock: VehicleClock, boot: int) -> Iterator[GimbalSamples]:
    """Yield the attitude of the gimbal of an autopilot in a boot, from the first message that has one.

    The gimbal has a time since boot of its own unless the autopilot itself sends its attitude.
    """
    if packets.timestamps_are_utc(sender):
        return
    for name in GIMBAL_MESSAGES:
        rows = packets.message(name)
        rows = rows[rows[:, SYSTEM] == sender[0]] if len(rows) else rows
        rows = rows[clock.boot_of(rows) == boot] if len(rows) else rows
        if not len(rows):
            continue
        component = sender[1] if np.any(rows[:, COMPONENT] == sender[1]) else rows[0, COMPONENT]
        rows = rows[rows[:, COMPONENT] == component]
        values = rows[:, FIELDS_FROM:] if name == "MOUNT_STATUS" else rows[:, FIELDS_FROM + 1 :]
        if name == "MOUNT_STATUS":
            clock_s = clock.on_arrival(rows)
        elif component == sender[1]:
            clock_s = clock.read(rows)[0]
        else:
            clock_s = _on_own_clock(rows, clock)
        samples = gimbal_samples(name, clock_s, values)
        if samples.clock_s.size > 1:
            yield replace(samples, boot=boot)
            return


def _on_own_clock(rows: Float, clock: VehicleClock) -> Float:
    """Return the autopilot's clock at packets of a gimbal with a clock of its own, s.

    Packets arrive late and never early: the earliest arrival relates the two clocks.
    """
    own_s = rows[:, FIELDS_FROM] / 1e3
    clock_s: Float = own_s + np.min(clock.on_arrival(rows) - own_s)
    return clock_s


def gimbal_samples(name: str, clock_s: Float, values: Float) -> GimbalSamples:
    """Return the valid attitudes in the fields, (n, k) values, of one of `GIMBAL_MESSAGES`.

    GIMBAL_DEVICE_ATTITUDE_STATUS: the flags, and the quaternion from the platform to the frame of reference;
    MOUNT_ORIENTATION: roll, pitch and yaw, deg; MOUNT_STATUS: pitch, roll and yaw, 0.01 deg.
    """
    return status_samples(clock_s, values, name) if name == GIMBAL_STATUS else angle_samples(clock_s, values, name)


def status_samples(clock_s: Float, values: Float, name: str) -> GimbalSamples:
    """Return the valid samples of a gimbal's attitude from (n, 5) flags and quaternions."""
    q = conjugate(values[:, 1:5])
    valid = unit_quaternions(q) & valid_times(clock_s)
    return GimbalSamples(clock_s[valid], q[valid], yaw_is_earth(values[valid, 0]), name)


def angle_samples(clock_s: Float, values: Float, name: str) -> GimbalSamples:
    """Return the valid samples from (n, 3) roll, pitch and yaw, deg, or from the fields of MOUNT_STATUS."""
    valid = np.isfinite(values).all(axis=-1) & valid_times(clock_s)
    if name == "MOUNT_STATUS":
        pitch, roll, yaw = np.deg2rad(values[valid].T / 100)
    else:
        roll, pitch, yaw = np.deg2rad(values[valid].T)
    q = quaternion_from_euler(roll, pitch, yaw)
    return GimbalSamples(clock_s[valid], q, np.zeros(len(q), dtype=np.bool_), name)
