"""A scripted autopilot in a simulator: SIM_STATE and an ATTITUDE that drifts from it, sent with pymavlink over UDP."""

import json
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from glstar.link.packets import dialect
from glstar.rotation import quaternion_from_euler
from tests.support.jitter import JitterCorrection

MAVLINK: Final = dialect()
UTC_S: Final = 1_710_068_400.0
BOOT_S: Final = 100.0
YAW_RATE_RAD_PER_S: Final = np.deg2rad(5.0)
# The estimate is this far from the truth at boot, and drifts away from it.
BIAS_RAD: Final = np.deg2rad(1.0)
DRIFT_RAD_PER_S: Final = np.deg2rad(0.02)
TRUE_DEG: Final = (-34.93, 138.60, 300.0)
ESTIMATED_DEG: Final = (-34.80, 138.70, 310.0)
_HZ: Final = 50
_GPS_OF_MAVLINK: Final = 14
# Messages that it sends at the rate that is requested, and at a rate of its own.
_BY_REQUEST: Final = tuple(
    getattr(MAVLINK, f"MAVLINK_MSG_ID_{name}") for name in ("SIM_STATE", "SIMSTATE", "ATTITUDE", "ATTITUDE_QUATERNION")
)
_BY_ITSELF: Final = MAVLINK.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, MAVLINK.MAVLINK_MSG_ID_SYSTEM_TIME


def true_yaw_rad(utc_s: float) -> float:
    """Return the true yaw at a UTC; roll and pitch are 0.1 and 0.2 rad."""
    return 0.3 + YAW_RATE_RAD_PER_S * (utc_s - UTC_S)


def estimated_yaw_rad(utc_s: float) -> float:
    """Return the yaw that the autopilot estimates."""
    return true_yaw_rad(utc_s) + BIAS_RAD + DRIFT_RAD_PER_S * (utc_s - UTC_S)


class SimulatedAutopilot:
    """Sends 50 times a second to a UDP port of this computer, and keeps what it receives.

    ``received`` holds the messages, and ``applied`` the UTC, latitude and longitude, deg, of each position as it is
    used.  `truth`: the message of the simulator's own state; `uptime_s`: time since boot at first; `uses_gnss`: whether
    positions are refused for that; `parameters`: what it states on request, others get no answer; `is_uneven`: whether
    the intervals are 20 and 40 ms in turn, as of ArduPilot's scheduler; `has_station`: whether it forwards the
    heartbeats of a ground station, whose other packets are for itself; `speed`: of its clock against the computer's,
    which then goes by steps of 20 ms alone; at the steps in `pauses` it stands still for a time, s, and at those in
    `rewinds` it goes back by some steps, once; `loop_hz`: rate of its loop, with which it sends attitudes and SIM_STATE
    by request alone, and denies a message that it does not know and more than 80 % of that rate, as ArduPlane 4.7.0-dev
    (GCS_MAVLINK::set_message_interval in GCS_Common.cpp; its loop has 50 Hz); `has_computers_utc`: whether SYSTEM_TIME
    has the computer's UTC whatever the speed, as of PX4 1.17.0-alpha1 (SYSTEM_TIME.hpp reads CLOCK_REALTIME), which
    leaves the time of HIL_STATE_QUATERNION 0.
    """

    def __init__(
        self,
        port: int,
        truth: str | None = "SIM_STATE",
        *,
        uptime_s: float = BOOT_S,
        uses_gnss: bool = False,
        parameters: Mapping[str, float] = MappingProxyType({"GPS1_TYPE": 14.0}),
        is_uneven: bool = False,
        has_station: bool = False,
        speed: float | None = None,
        pauses: Mapping[int, float] = MappingProxyType({}),
        rewinds: Mapping[int, int] = MappingProxyType({}),
        loop_hz: float | None = None,
        has_computers_utc: bool = False,
    ) -> None:
        self.received: list[Any] = []
        self.applied: list[tuple[float, float, float]] = []
        self._truth, self._address = truth, ("127.0.0.1", port)
        self._uptime_s, self._uses_gnss, self._parameters = uptime_s, uses_gnss, dict(parameters)
        self._is_uneven, self._has_station = is_uneven, has_station
        self._clock, self._began_s = JitterCorrection(), 0.0
        self._speed, self._pauses, self._rewinds = speed, dict(pauses), dict(rewinds)
        self._has_computers_utc = has_computers_utc
        self._loop_hz, self._granted_hz = loop_hz, dict.fromkeys(_BY_REQUEST, 0.0)
        self._link = MAVLINK.MAVLink(None, srcSystem=1, srcComponent=1)
        self._link.robust_parsing = True
        self._station = MAVLINK.MAVLink(None, srcSystem=255, srcComponent=190)

    def run(self, stop: threading.Event) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
            here.setblocking(False)
            self._began_s, step = time.monotonic(), 0
            if self._speed is not None:
                self._run_by_steps(here, stop, self._speed)
                return
            while not stop.is_set():
                for message in self.messages(step, time.monotonic() - self._began_s):
                    here.sendto(message.pack(self._link), self._address)
                    self._link.seq = (self._link.seq + 1) % 256
                if self._has_station and step % _HZ == 0:
                    heartbeat = MAVLINK.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
                    here.sendto(heartbeat.pack(self._station), self._address)
                    self._station.seq = (self._station.seq + 7) % 256
                self._receive(here)
                step += 1
                # The same mean rate of 50 / 1.5 Hz if uneven.
                due_s = (1.5 * step - 0.5 * (step % 2)) / _HZ if self._is_uneven else step / _HZ
                time.sleep(max(self._began_s + due_s - time.monotonic(), 0.0))

    def _run_by_steps(self, here: socket.socket, stop: threading.Event, speed: float) -> None:
        step, due_s = 0, time.monotonic()
        while not stop.is_set():
            due_s += self._pauses.pop(step, 0.0) + 1 / (_HZ * speed)
            step -= self._rewinds.pop(step, 0)
            for message in self.messages(step, step / _HZ):
                here.sendto(message.pack(self._link), self._address)
                self._link.seq = (self._link.seq + 1) % 256
            self._receive(here)
            step += 1
            time.sleep(max(due_s - time.monotonic(), 0.0))

    def messages(self, step: int, elapsed_s: float) -> Iterator[Any]:
        boot_ms = round((self._uptime_s + elapsed_s) * 1000) % 2**32
        utc_s = UTC_S + round(elapsed_s * 1000) / 1000
        if step % _HZ == 0:
            yield MAVLINK.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)
        if step % 10 == 0:
            stated_s = UTC_S + time.monotonic() - self._began_s if self._has_computers_utc else utc_s
            yield MAVLINK.MAVLink_system_time_message(round(stated_s * 1e6), boot_ms)
            latitude, longitude, height_m = ESTIMATED_DEG
            degrees = round(latitude * 1e7), round(longitude * 1e7)
            yield MAVLINK.MAVLink_global_position_int_message(boot_ms, *degrees, round(height_m * 1e3), 0, 0, 0, 0, 0)
        state, rates = self._state(true_yaw_rad(utc_s)), (0, 0, YAW_RATE_RAD_PER_S)
        attitude = MAVLINK.MAVLink_attitude_message(boot_ms, 0.1, 0.2, estimated_yaw_rad(utc_s), *rates)
        if self._loop_hz is None:
            yield from (*state, attitude)
            return
        quaternion = body_to_ned(0.1, 0.2, estimated_yaw_rad(utc_s))
        for message in (*state, attitude, MAVLINK.MAVLink_attitude_quaternion_message(boot_ms, *quaternion, *rates)):
            hz = self._granted_hz[message.get_msgId()]
            if (step + 1) * hz // _HZ > step * hz // _HZ:
                yield message

    def _state(self, yaw_rad: float) -> Iterator[Any]:
        latitude, longitude, height_m = TRUE_DEG
        degrees = round(latitude * 1e7), round(longitude * 1e7)
        q = body_to_ned(0.1, 0.2, yaw_rad)
        match self._truth:
            case "SIM_STATE":
                angles, none = (0.1, 0.2, yaw_rad), (0.0,) * 6
                place = (latitude, longitude, height_m, 0, 0, 0, 0, 0)
                yield MAVLINK.MAVLink_sim_state_message(*q, *angles, *none, *place, *degrees)
            case "SIMSTATE":
                yield MAVLINK.MAVLink_simstate_message(0.1, 0.2, yaw_rad, *(0.0,) * 6, *degrees)
            case "HIL_STATE_QUATERNION":
                place = (*degrees, round(height_m * 1e3))
                yield MAVLINK.MAVLink_hil_state_quaternion_message(0, q, 0, 0, 0, *place, *(0,) * 8)

    def _receive(self, here: socket.socket) -> None:
        while True:
            try:
                received = here.recv(4096)
            except (BlockingIOError, ConnectionError):
                return
            for message in self._link.parse_buffer(received) or []:
                self.received.append(message)
                for reply in self._replies(message):
                    here.sendto(reply.pack(self._link), self._address)
                    self._link.seq = (self._link.seq + 1) % 256

    def _replies(self, message: Any) -> Iterator[Any]:
        """Yield what ArduPilot answers."""
        kind = message.get_type()
        if kind == "COMMAND_INT":
            if not self._uses_gnss:
                self._apply(message)
            result = MAVLINK.MAV_RESULT_FAILED if self._uses_gnss else MAVLINK.MAV_RESULT_ACCEPTED
            yield MAVLINK.MAVLink_command_ack_message(message.command, result)
        elif kind == "COMMAND_LONG" and self._loop_hz is not None:
            yield MAVLINK.MAVLink_command_ack_message(message.command, self._interval(message, self._loop_hz))
        elif kind == "COMMAND_LONG":
            yield MAVLINK.MAVLink_command_ack_message(message.command, MAVLINK.MAV_RESULT_ACCEPTED)
        elif kind == "GLOBAL_POSITION_SENSOR" or (
            kind == "GPS_INPUT" and self._parameters.get("GPS1_TYPE") == _GPS_OF_MAVLINK
        ):
            self._apply(message)
        elif kind == "PARAM_REQUEST_READ" and message.param_id in self._parameters:
            name, value = message.param_id, self._parameters[message.param_id]
            yield MAVLINK.MAVLink_param_value_message(name.encode(), value, MAVLINK.MAV_PARAM_TYPE_INT8, 900, 55)

    def _interval(self, command: Any, loop_hz: float) -> int:
        """Send a message at another rate, and return the result; an interval of 0 is the default, none here."""
        number, hz = int(command.param1), 1e6 / command.param2 if command.param2 else 0.0
        if number not in {*_BY_REQUEST, *_BY_ITSELF} or hz > 0.8 * loop_hz:
            return int(MAVLINK.MAV_RESULT_DENIED)
        if number in _BY_REQUEST:
            self._granted_hz[number] = hz
        return int(MAVLINK.MAV_RESULT_ACCEPTED)

    def _apply(self, fix: Any) -> None:
        """Use a position at the instant that the correction of jitter gives."""
        utc_s = self._clock.applied_s(fix, UTC_S + time.monotonic() - self._began_s)
        degrees = (fix.x, fix.y) if fix.get_type() == "COMMAND_INT" else (fix.lat, fix.lon)
        self.applied.append((utc_s, degrees[0] / 1e7, degrees[1] / 1e7))


def body_to_ned(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return MAVLink's quaternion (w, x, y, z) of Euler angles, rad, with pymavlink's own conversion."""
    from pymavlink.quaternion import QuaternionBase  # noqa: PLC0415 - only these tests

    w, x, y, z = (float(part) for part in QuaternionBase([roll, pitch, yaw]).q)
    return w, x, y, z


@contextmanager
def simulated(port: int, truth: str | None = "SIM_STATE", **options: Any) -> Iterator[SimulatedAutopilot]:
    """Run the autopilot in a thread."""
    autopilot, stop = SimulatedAutopilot(port, truth, **options), threading.Event()
    thread = threading.Thread(target=autopilot.run, args=(stop,), name="autopilot")
    thread.start()
    try:
        yield autopilot
    finally:
        stop.set()
        thread.join()


SMALL = """
[camera]
width_px = 64
height_px = 48
fx_px = 60.0
fy_px = 60.0
[navigator]
gps = "known"
"""


def angle_rad(yaw_rad: float, q_body_ned: list[float]) -> float:
    """Return the angle between an attitude of the script and another one."""
    cosine = abs(float(quaternion_from_euler(0.1, 0.2, yaw_rad) @ np.array(q_body_ned)))
    return float(2 * np.arccos(min(cosine, 1.0)))


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]
