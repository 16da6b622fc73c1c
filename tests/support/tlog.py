"""Telemetry logs of MAVLink packets, written for tests."""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega, common

from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.timescale import parse_utc

LOGS = Path(__file__).parents[3] / "shared" / "logs"
ADELAIDE = LOGS / "plane_SITL_adelaide_100Hz.tlog"
ROV = LOGS / "rov_ardusub_small.tlog"
ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
BOOT_S = 30.0
# The recorder's clock is wrong by two years, and packets arrive half a second late.
RECORDED_S = parse_utc("2026-01-01T00:00:00Z") + 0.5


class Log:
    """A telemetry log, written packet by packet; boot time 30 s is 11:00 UTC."""

    def __init__(self) -> None:
        self.packets: list[bytes] = []
        self.links: dict[tuple[int, int], common.MAVLink] = {}
        # Arrival time minus the time since boot, s.
        self.stamp_s = RECORDED_S - BOOT_S

    def add(
        self, message: common.MAVLink_message, t_s: float, sender: tuple[int, int] = (1, 1), v1: bool = False
    ) -> None:
        link = self.links.setdefault(sender, common.MAVLink(None, *sender))
        packet = message.pack(link, force_mavlink1=v1)
        link.seq = (link.seq + 1) % 256
        self.packets.append(struct.pack(">Q", round((t_s + self.stamp_s) * 1e6)) + bytes(packet))

    def heartbeat(self, t_s: float = BOOT_S, sender: tuple[int, int] = (1, 1), autopilot: int = 3) -> None:
        self.add(common.MAVLink_heartbeat_message(1, autopilot, 0, 0, 4, 3), t_s, sender)

    def attitude(self, t_s: float, yaw_deg: float = 0.0, sender: tuple[int, int] = (1, 1), v1: bool = False) -> None:
        yaw_rad = np.deg2rad(yaw_deg)
        self.add(common.MAVLink_attitude_message(ms(t_s), 0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0), t_s, sender, v1)

    def quaternion(self, t_s: float, yaw_deg: float = 0.0) -> None:
        q_ned_body = conjugate(quaternion_from_euler(0.0, 0.0, np.deg2rad(yaw_deg)))
        self.add(common.MAVLink_attitude_quaternion_message(ms(t_s), *q_ned_body, 0.0, 0.0, 0.0), t_s)

    def imu(self, t_s: float, rate_rad_per_s: list[float], name: str = "raw", boot_us: int | None = None) -> None:
        mrad_per_s = [round(rate * 1e3) for rate in rate_rad_per_s]
        stamp = ms(t_s) if name.startswith("scaled") else round(t_s * 1e6) if boot_us is None else boot_us
        reported = (0, 0, -1000, *mrad_per_s, 0, 0, 0)
        if name == "highres":
            reported = (0.0, 0.0, -9.8, *rate_rad_per_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 63)
        self.add(getattr(common, f"MAVLink_{name}_imu_message")(stamp, *reported), t_s)

    def hil_state(self, stamp_s: float, yaw_deg: float, t_s: float, sender: tuple[int, int] = (1, 1)) -> None:
        """Add a simulator's state with a timestamp, time since boot or UTC, that arrives at a time since boot."""
        body_to_ned = conjugate(quaternion_from_euler(0.0, 0.0, np.deg2rad(yaw_deg))).tolist()
        position = (-349300000, 1386000000, 300_000)
        message = common.MAVLink_hil_state_quaternion_message(
            round(stamp_s * 1e6), body_to_ned, 0, 0, 0, *position, 0, 0, 0, 0, 0, 0, 0, 0
        )
        self.add(message, t_s, sender)

    def place(self, t_s: float, latitude_deg: float = -34.93, longitude_deg: float = 138.60) -> None:
        place = (round(latitude_deg * 1e7), round(longitude_deg * 1e7), 48000)
        self.add(common.MAVLink_global_position_int_message(ms(t_s), *place, 0, 0, 0, 0, 0), t_s)

    def time(
        self, t_s: float, sender: tuple[int, int] = (1, 1), utc_s: float | None = None, boot_ms: int | None = None
    ) -> None:
        utc_us = round(1e6 * (ELEVEN_S + t_s - BOOT_S if utc_s is None else utc_s))
        boot_ms = ms(t_s) if boot_ms is None else boot_ms
        self.add(common.MAVLink_system_time_message(utc_us, boot_ms), t_s, sender)

    def feedback(self, t_s: float, time_s: float, image: int, camera: int = 0) -> None:
        """Add the answer of a camera that arrives at a time since boot, with a time of its own."""
        place = (-349300000, 1386000000, 48.0, 48.0, 0.0, 0.0, 0.0, 0.0)
        stamp = (round(time_s * 1e6), 0, camera, image)
        self.add(ardupilotmega.MAVLink_camera_feedback_message(*stamp, *place, 0), t_s)

    def captured(
        self, t_s: float, utc_s: float, boot_s: float, image: int, camera: int, is_good: bool, sender: tuple[int, int]
    ) -> None:
        """Add that an image was captured; the message arrives at a time since boot."""
        stamp = (ms(boot_s), round(utc_s * 1e6), camera)
        place = (-349300000, 1386000000, 48000, 48000, [1.0, 0.0, 0.0, 0.0])
        self.add(common.MAVLink_camera_image_captured_message(*stamp, *place, image, int(is_good), b""), t_s, sender)

    def data(self) -> bytes:
        return b"".join(self.packets)

    def save(self, path: Path) -> Path:
        path.write_bytes(self.data())
        return path


def ms(t_s: float) -> int:
    """Return a time since boot as packets report it, in 32 bits."""
    return round(t_s * 1000) % 2**32


def times(duration_s: float = 2.0, rate_hz: float = 50.0, start_s: float = BOOT_S) -> Iterator[float]:
    return (start_s + i / rate_hz for i in range(int(duration_s * rate_hz) + 1))


@pytest.fixture
def turn() -> Log:
    """A log of a turn at 10 deg/s, with place and UTC."""
    log = Log()
    log.heartbeat()
    for t in times():
        log.attitude(t, 10.0 * (t - BOOT_S))
    for t in times(rate_hz=5):
        log.place(t)
        log.time(t)
    return log


# --- a simulator's own state ----------------------------------------------------------------------------------------
def simulated(*, timed_by_utc: bool) -> Log:
    """A log of a turn at 10 deg/s with HIL_STATE_QUATERNION, and SYSTEM_TIME unless that is timed by UTC."""
    log = Log()
    log.heartbeat()
    for t in times():
        log.hil_state(ELEVEN_S + t - BOOT_S if timed_by_utc else t, 10.0 * (t - BOOT_S), t)
    for t in times(rate_hz=5) if not timed_by_utc else ():
        log.time(t)
    return log
