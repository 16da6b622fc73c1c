"""Names of vehicles, versions and modes by MAVLink's and PX4's own tables, and the frames of a gimbal's yaw."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega
from scipy.spatial.transform import Rotation

from glstar.telemetry.mavlink import vehicles
from glstar.telemetry.mavlink.vehicles import (
    ARDUPILOT,
    PX4,
    angle_samples,
    ardupilot_mode,
    autopilot,
    gimbal_samples,
    px4_mode,
    px4_navigation_state,
    status_samples,
    vehicle_kind,
    version,
    yaw_is_earth,
)

# MAV_TYPE by the names of kinds, where MAVLink has other ones.
OTHER_NAMES = {
    "coaxial helicopter": "COAXIAL",
    "balloon": "FREE_BALLOON",
    "rover": "GROUND_ROVER",
    "boat": "SURFACE_BOAT",
}
# The names of these depend on the version of MAVLink.
VTOL = range(19, 26)


def test_kinds_of_vehicles_are_those_of_mavlink() -> None:
    named = {number: kind for number in range(60) if (kind := vehicle_kind([number])) is not None}
    by_mavlink = {
        getattr(ardupilotmega, f"MAV_TYPE_{OTHER_NAMES.get(kind, kind.upper().replace(' ', '_'))}"): kind
        for kind in set(named.values()) - {"VTOL"}
    }
    assert named == by_mavlink | dict.fromkeys(VTOL, "VTOL")
    assert len(by_mavlink) == 19


def test_the_most_frequent_kind_of_vehicle_is_named() -> None:
    assert vehicle_kind([0, 6, 6, 6, 10, 12, 12, 27]) == "submarine"
    assert vehicle_kind([0.0, 6.0]) is None
    assert vehicle_kind([]) is None
    assert vehicle_kind(None) is None


@pytest.mark.parametrize(
    ("number", "kind", "name"),
    [
        (ardupilotmega.MAV_AUTOPILOT_ARDUPILOTMEGA, "fixed wing", "ArduPlane"),
        (ARDUPILOT, "VTOL", "ArduPlane"),
        (ARDUPILOT, "helicopter", "ArduCopter"),
        (ARDUPILOT, "dodecarotor", "ArduCopter"),
        (ARDUPILOT, "kite", "ArduPilot kite"),
        (ARDUPILOT, None, "ArduPilot"),
        (ardupilotmega.MAV_AUTOPILOT_PX4, "fixed wing", "PX4 fixed wing"),
        (PX4, None, "PX4"),
        (ardupilotmega.MAV_AUTOPILOT_OPENPILOT, "boat", "OpenPilot boat"),
        (ardupilotmega.MAV_AUTOPILOT_SMACCMPILOT, None, "SMACCMPilot"),
        (ardupilotmega.MAV_AUTOPILOT_AUTOQUAD, None, "AutoQuad"),
        (ardupilotmega.MAV_AUTOPILOT_REFLEX, None, "ReflexPilot"),
        (ardupilotmega.MAV_AUTOPILOT_SLUGS, "rover", "rover"),
        (ardupilotmega.MAV_AUTOPILOT_SLUGS, None, None),
    ],
)
def test_an_autopilot_is_named_with_its_vehicle(number: int, kind: str | None, name: str | None) -> None:
    assert autopilot(number, kind) == name


@pytest.mark.parametrize(
    ("number", "name"),
    [
        (0x010B02FF, "v1.11.2"),
        (0x010E0080, "v1.14.0-beta"),
        (0x04050A00, "v4.5.10-dev"),
        (0x04050640, "v4.5.6-alpha"),
        (0x040506C0, "v4.5.6-rc"),
        (0xAB_0102_03FF, "v1.2.3"),
        (1, "v0.0.0"),
        (0, ""),
    ],
)
def test_a_version_is_four_bytes(number: int, name: str) -> None:
    assert version(number) == name


# msg/VehicleStatus.msg: NAVIGATION_STATE_...
STATES = {
    "Manual": 0,
    "Altitude": 1,
    "Position": 2,
    "Mission": 3,
    "Hold": 4,  # AUTO_LOITER
    "Return": 5,
    "Acro": 10,
    "Descend": 12,
    "Termination": 13,
    "Offboard": 14,
    "Stabilized": 15,
    "Takeoff": 17,
    "Land": 18,
    "Follow": 19,
    "Precision land": 20,
    "Orbit": 21,
    "VTOL takeoff": 22,
}
# src/modules/commander/px4_custom_mode.h: the main modes, and the sub-modes of AUTO.
MAIN = ("Manual", "Altitude", "Position", "Auto", "Acro", "Offboard", "Stabilized", "Rattitude", "Simple")
SUB = ("Ready", "Takeoff", "Hold", "Mission", "Return", "Land", "Reserved", "Follow", "Precision land")


def test_the_modes_of_px4_are_those_of_its_headers() -> None:
    assert {px4_navigation_state(number): number for number in range(23)} == STATES | {
        f"mode {number}": number for number in (6, 7, 8, 9, 11, 16)
    }
    assert [px4_mode(main << 16) for main in range(11)] == ["mode 0", *MAIN, "mode 10"]
    assert [px4_mode((sub << 24) + (4 << 16) + 77) for sub in range(11)] == ["Auto", *SUB, "Auto"]
    assert px4_mode(3 << 24 | 5 << 16) == "Acro"
    assert px4_mode(0x7_03_04_0000) == "Hold"


@pytest.mark.parametrize(
    ("vehicle", "modes"),
    [
        ("ArduPlane", {0: "MANUAL", 8: "AUTOTUNE", 9: "mode 9", 16: "INITIALISING", 24: "THERMAL", 26: "AUTOLAND"}),
        ("ArduCopter", {8: "POSITION", 10: "OF_LOITER", 12: "mode 12", 20: "GUIDED_NOGPS", 27: "AUTO_RTL"}),
        ("ArduCopter quadrotor", {28: "TURTLE", 29: "RATE_ACRO", 30: "mode 30"}),
        ("Rover", {2: "LEARNING", 6: "FOLLOW", 9: "CIRCLE", 12: "SMART_RTL", 13: "mode 13", 15: "GUIDED"}),
        ("ArduRover", {16: "INITIALISING", 17: "mode 17"}),
        ("ArduSub", {4: "GUIDED", 5: "mode 5", 7: "CIRCLE", 9: "SURFACE", 16: "POSHOLD", 19: "MANUAL"}),
        ("Blimp", {1: "mode 1"}),
        (None, {1: "mode 1"}),
    ],
)
def test_the_modes_of_ardupilot(vehicle: str | None, modes: dict[int, str]) -> None:
    assert {number: ardupilot_mode(vehicle, number) for number in modes} == modes


def test_the_yaw_of_a_gimbal_is_against_north_by_its_flags() -> None:
    """YAW_LOCK is 16, YAW_IN_VEHICLE_FRAME 32, YAW_IN_EARTH_FRAME 64; others say nothing."""
    flags = np.array([0, 16, 32, 64, 16 + 32, 16 + 64, 32 + 64, 112, 1 + 2 + 8 + 128, 16 + 15, 64 + 15], dtype=float)

    expected = [False, True, False, True, False, True, True, True, False, True, True]
    assert yaw_is_earth(flags).tolist() == expected


def quaternion(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    """Return the rotation from the frame of reference to the platform, by SciPy, (w, x, y, z)."""
    q = Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).inv().as_quat()
    return np.array([q[3], q[0], q[1], q[2]])


def same(q: np.ndarray, other: list[np.ndarray]) -> bool:
    return q.shape == (len(other), 4) and np.allclose(np.abs(np.sum(q * other, axis=-1)), 1.0, rtol=0, atol=1e-12)


CLOCK_S = np.array([3.0, 3.1, 3.2, 3.3])
LATE_S = np.array([3.0, 3.1, 900.0, 3.3, 3.4, 3.5, 3.6])
ANGLES_DEG = [(11.0, -23.0, 37.0), (-13.0, 29.0, -41.0)]


def test_angles_of_a_gimbal_are_in_degrees_or_hundredths() -> None:
    (a, b), bad = ANGLES_DEG, (np.nan, 1.0, 2.0)
    orientation = gimbal_samples("MOUNT_ORIENTATION", CLOCK_S, np.array([a, bad, b, (1.0, 2.0, np.inf)]))
    hundredths = np.array([(a[1], a[0], a[2]), bad, (b[1], b[0], b[2]), bad]) * 100
    status = gimbal_samples("MOUNT_STATUS", CLOCK_S, hundredths)

    for samples, name in ((orientation, "MOUNT_ORIENTATION"), (status, "MOUNT_STATUS")):
        assert samples.clock_s.tolist() == [3.0, 3.2]
        assert same(samples.q_gimbal_reference, [quaternion(*a), quaternion(*b)])
        assert samples.is_earth.tolist() == [False, False]
        assert samples.source == name
    late = angle_samples(LATE_S, np.array([a] * 7), "mount_orientation")
    assert late.clock_s.tolist() == [3.0, 3.1, 3.3, 3.4, 3.5, 3.6]


def test_the_status_of_a_gimbal_is_a_quaternion_with_flags() -> None:
    a, b = (quaternion(*angles) for angles in ANGLES_DEG)
    back = np.array([1.0, -1.0, -1.0, -1.0])
    rows = np.array([[64, *(a * back)], [0, *(1.1 * a)], [32, *(b * back)], [16, *(b * back)]])
    samples = gimbal_samples(vehicles.GIMBAL_STATUS, CLOCK_S, rows)

    assert samples.clock_s.tolist() == [3.0, 3.2, 3.3]
    assert same(samples.q_gimbal_reference, [a, b, b])
    assert samples.is_earth.tolist() == [True, False, True]
    assert samples.source == "GIMBAL_DEVICE_ATTITUDE_STATUS"
    later = status_samples(LATE_S, rows[[0] * 7], "x")
    assert (later.clock_s.tolist(), later.source) == ([3.0, 3.1, 3.3, 3.4, 3.5, 3.6], "x")
