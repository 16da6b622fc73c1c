"""The attitude of a gimbal from every log that has one, against SciPy's rotations."""

import struct
from math import nan
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from glstar.config import Config
from glstar.errors import TelemetryError
from glstar.telemetry import open_flight
from tests.support.dataflash import Log
from tests.telemetry.test_triggers import BOOT_S, ELEVEN_S, ULogWriter

# The aircraft turns with 20 deg of bank; the platform is pitched up and turned to the side of the heading.
ROLL_DEG, PITCH_DEG, RATE_DEG_PER_S = 20.0, 3.0, 12.0
PLATFORM_ROLL_DEG, PLATFORM_PITCH_DEG = 1.5, 35.0
STEP_S = 0.02
YAW_LOCK, VEHICLE, EARTH = 16, 32, 64
KINDS = {
    "status, earth": EARTH,
    "status, vehicle": VEHICLE,
    "status, locked": YAW_LOCK,
    "status, follows": 0,
    "status, locked in the vehicle's frame": YAW_LOCK | VEHICLE,
}


def heading_deg(t_s: float) -> float:
    return 170 + RATE_DEG_PER_S * t_s


def yaw_b_deg(t_s: float) -> float:
    """Return the yaw of the platform against the heading."""
    return -25 + 4 * t_s


def body_to_reference(t_s: float, *, earth: bool) -> list[float]:
    """Return the platform's quaternion (w, x, y, z) as MAVLink has it, by SciPy."""
    yaw_deg = yaw_b_deg(t_s) + heading_deg(t_s) * earth
    q = Rotation.from_euler("ZYX", [yaw_deg, PLATFORM_PITCH_DEG, PLATFORM_ROLL_DEG], degrees=True).as_quat()
    return [float(q[k]) for k in (3, 0, 1, 2)]


def telemetry(path: Path, kind: str, *, component: int = 1, clock_ms: int = 0) -> Path:
    links = {number: mavlink.MAVLink(None, 1, number) for number in {1, component}}
    packets = []

    def add(message: mavlink.MAVLink_message, t_s: float, number: int = 1) -> None:
        stamp_us = round((ELEVEN_S + 0.4 + t_s) * 1e6)
        packets.append(struct.pack(">Q", stamp_us) + bytes(message.pack(links[number])))

    for k in range(201):
        t_s = k * STEP_S
        ms = round((BOOT_S + t_s) * 1e3)
        angles = np.deg2rad([ROLL_DEG, PITCH_DEG, (heading_deg(t_s) + 180) % 360 - 180])
        add(mavlink.MAVLink_attitude_message(ms, *angles, 0.0, 0.0, 0.0), t_s)
        if k % 25 == 0:
            add(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3), t_s)
            add(mavlink.MAVLink_system_time_message(round((ELEVEN_S + t_s) * 1e6), ms), t_s)
            add(mavlink.MAVLink_global_position_int_message(ms, -349300000, 1386000000, 48000, 0, 0, 0, 0, 0), t_s)
        if kind == "orientation":
            add(
                mavlink.MAVLink_mount_orientation_message(ms, PLATFORM_ROLL_DEG, PLATFORM_PITCH_DEG, yaw_b_deg(t_s)),
                t_s,
            )
        elif kind == "mount status":
            centi = [round(100 * angle) for angle in (PLATFORM_PITCH_DEG, PLATFORM_ROLL_DEG, yaw_b_deg(t_s))]
            add(mavlink.MAVLink_mount_status_message(255, 190, *centi), t_s)
        elif kind in KINDS:
            flags = KINDS[kind]
            earth = flags in {EARTH, YAW_LOCK}
            q = body_to_reference(t_s, earth=earth)
            status = mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, ms + clock_ms, flags, q, 0, 0, 0, 0)
            # A packet is late now and then.
            add(status, t_s + 0.004 * (k % 3), component)
    path.write_bytes(b"".join(packets))
    return path


def dataflash(path: Path, kind: str) -> Path:
    log = Log()
    for k in range(201):
        t_s = k * STEP_S
        log.att(BOOT_S + t_s, roll_deg=ROLL_DEG, pitch_deg=PITCH_DEG, yaw_deg=heading_deg(t_s) % 360)
        if k % 10 == 0:
            log.gps(BOOT_S + t_s)
            log.gpa(BOOT_S + t_s)
            log.pos(BOOT_S + t_s)
        yaw_e = nan if kind == "MNT, body" else (heading_deg(t_s) + yaw_b_deg(t_s)) % 360
        angles = (0.0, PLATFORM_ROLL_DEG, 0.0, PLATFORM_PITCH_DEG, 0.0, yaw_b_deg(t_s), 0.0, yaw_e)
        fields = "TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawB,YawB,DesYawE,YawE"
        for instance in (1, 0):  # the first gimbal carries the camera
            shifted = (0.0, angles[1] + 40 * instance, *angles[2:])
            log.add("MNT", "QBffffffff", fields, round((BOOT_S + t_s) * 1e6), instance, *shifted)
    return log.save(path)


def ulog(path: Path, kind: str) -> Path:
    log = ULogWriter()
    for k in range(201):
        t_s = k * STEP_S
        t_us = round((BOOT_S + t_s) * 1e6)
        body = Rotation.from_euler("ZYX", [heading_deg(t_s), PITCH_DEG, ROLL_DEG], degrees=True).as_quat()
        fields = "uint64_t timestamp;float[4] q;uint8_t quat_reset_counter;"
        log.add("vehicle_attitude", fields, "QffffB", t_us, *(float(body[j]) for j in (3, 0, 1, 2)), 0)
        if k % 25 == 0:
            utc_us = round((ELEVEN_S + t_s) * 1e6)
            fields = "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;uint8_t fix_type;"
            log.add("vehicle_gps_position", fields, "QQiiiB", t_us, utc_us, -349300000, 1386000000, 48000, 3)
        if kind == "PX4, status":
            fields = "uint64_t timestamp;float[4] q;uint16_t device_flags;"
            q = body_to_reference(t_s, earth=False)
            log.add("gimbal_device_attitude_status", fields, "QffffH", t_us, *q, VEHICLE)
        else:
            fields = "uint64_t timestamp;float[3] attitude_euler_angle;"
            angles = np.deg2rad([PLATFORM_ROLL_DEG, PLATFORM_PITCH_DEG, yaw_b_deg(t_s)])
            log.add("mount_orientation", fields, "Qfff", t_us, *angles)
    path.write_bytes(log.head + log.definitions + log.samples)
    return path


def the_log(folder: Path, kind: str) -> Path:
    if kind.startswith("MNT"):
        return dataflash(folder / "flight.BIN", kind)
    return ulog(folder / "flight.ulg", kind) if kind.startswith("PX4") else telemetry(folder / "flight.tlog", kind)


def error_deg(flight_q: np.ndarray, utc_s: np.ndarray) -> float:
    """Return the largest angle between platforms (w, x, y, z; NED to platform) and those of SciPy."""
    t_s = utc_s - ELEVEN_S
    angles = [[heading_deg(t) + yaw_b_deg(t), PLATFORM_PITCH_DEG, PLATFORM_ROLL_DEG] for t in t_s]
    expected = Rotation.from_euler("ZYX", angles, degrees=True).inv()
    found = Rotation.from_quat(flight_q[:, [1, 2, 3, 0]])
    return float(np.rad2deg((found * expected.inv()).magnitude().max()))


@pytest.mark.parametrize(
    "kind", [*KINDS, "orientation", "mount status", "MNT", "MNT, body", "PX4, status", "PX4, angles"]
)
def test_a_recorded_gimbal_carries_the_camera(tmp_path: Path, kind: str) -> None:
    path = the_log(tmp_path, kind)
    flight = Config().override(**{"mount.gimbal": "log"}).open_flight(path)
    own = open_flight(path)
    assert own.gimbal is not None
    utc_s = flight.attitude.first_s + np.linspace(0.1, 3.5, 29)
    # MOUNT_STATUS has hundredths of a degree, on arrival; DataFlash logs hold UTC to some ms, 16 deg/s.
    tolerance_deg = {"mount status": 0.02, "MNT": 0.03, "MNT, body": 0.03}.get(kind, 1e-3)
    shift_s = 0.0 if not kind.startswith("MNT") else own.attitude.first_s - ELEVEN_S
    assert abs(shift_s) < 0.05
    assert error_deg(flight.attitude.at(utc_s), utc_s - shift_s) < tolerance_deg
    np.testing.assert_allclose(flight.aircraft_attitude.at(utc_s), own.attitude.at(utc_s), rtol=0, atol=1e-12)


def test_a_gimbal_with_its_own_clock_is_timed_by_its_earliest_arrival(tmp_path: Path) -> None:
    path = telemetry(tmp_path / "flight.tlog", "status, earth", component=154, clock_ms=500_000)
    flight = Config().override(**{"mount.gimbal": "log"}).open_flight(path)
    utc_s = flight.attitude.first_s + np.linspace(0.1, 3.5, 29)
    assert error_deg(flight.attitude.at(utc_s), utc_s) < 0.02  # 1 ms at 16 deg/s


def test_a_log_without_a_gimbal_says_so_in_one_line(tmp_path: Path) -> None:
    path = telemetry(tmp_path / "flight.tlog", "none")
    with pytest.raises(TelemetryError, match=r"flight\.tlog has no attitude of a gimbal: no GIMBAL_DEVICE") as refused:
        Config().override(**{"mount.gimbal": "log"}).open_flight(path)
    assert "\n" not in str(refused.value)
