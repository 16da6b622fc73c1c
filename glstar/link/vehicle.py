"""A flight sent over a link as an autopilot would send it, for demonstrations and tests.

Messages and default rates:

=============================  =========================================================================
HEARTBEAT                      once a second: a fixed wing with a generic autopilot
SYSTEM_TIME                    twice a second, with the UTC of the flight
ATTITUDE_QUATERNION            at the requested rate, each evaluated at the millisecond of its timestamp
ATTITUDE                       ten times a second
GLOBAL_POSITION_INT            five times a second
GPS_RAW_INT                    once a second
GIMBAL_DEVICE_ATTITUDE_STATUS  ten times a second, if the flight has the attitude of a gimbal
=============================  =========================================================================

It accepts MAV_CMD_SET_MESSAGE_INTERVAL, MAV_CMD_GET_MESSAGE_INTERVAL, MAV_CMD_REQUEST_MESSAGE and REQUEST_DATA_STREAM,
has one parameter, its system number, and an empty mission.  In a gap of the flight it sends no attitude.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf
from threading import Event
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError, TelemetryError
from glstar.flight import AttitudeTrack, Flight, GimbalAttitude
from glstar.link.packets import Framer, MessageId, dialect
from glstar.link.transport import Transport
from glstar.rotation import conjugate, euler_from_quaternion

_GIMBAL_HZ = 10.0
_DEFAULT_HZ = {
    MessageId.HEARTBEAT: 1.0,
    MessageId.SYSTEM_TIME: 2.0,
    MessageId.ATTITUDE: 10.0,
    MessageId.GLOBAL_POSITION_INT: 5.0,
    MessageId.GPS_RAW_INT: 1.0,
}
# Messages in each of ArduPilot's data streams; the quaternion is in none.
_STREAMS = {
    2: (MessageId.GPS_RAW_INT,),
    6: (MessageId.GLOBAL_POSITION_INT,),
    10: (MessageId.ATTITUDE,),
    12: (MessageId.SYSTEM_TIME,),
}
_ALL_STREAMS = 0
_GET_MESSAGE_INTERVAL, _SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE = 510, 511, 512
_FASTEST_HZ = 1000.0
# Messages that are later than this are dropped, s: the link could not carry them.
_LATE_S = 0.2
_EARTH_RADIUS_M = 6371008.8


@dataclass(frozen=True, slots=True)
class PlayedFlight:
    """Statistics of a played flight."""

    duration_s: float  # Duration of the part that was played, s
    packets: int  # Number of packets sent
    dropped: int  # Number of packets that the link could not carry in time


class Vehicle:
    """Sends a flight in real time over an open transport, which is not closed.

    `start_s`: start, s from the first attitude of the flight.
    `speed`: seconds of flight per second; message rates are per second of flight.
    `rate_hz`: rate of the attitude until a ground station requests another one.
    `loop`: whether to begin again at the end, with the time since boot at 0 as after a reboot.
    `sysid`: MAVLink system of the vehicle.

    Raises ConfigError if start, speed or rate is invalid.
    """

    def __init__(
        self,
        flight: Flight,
        transport: Transport,
        *,
        start_s: float = 0.0,
        speed: float = 1.0,
        rate_hz: float = 50.0,
        loop: bool = False,
        sysid: int = 1,
    ) -> None:
        track = flight.aircraft_attitude
        length_s = track.last_s - track.first_s
        if not 0 <= start_s < length_s:
            raise ConfigError(f"--start {start_s:g} s lies outside the flight, whose attitude lasts {length_s:.3f} s")
        if not 0 < rate_hz <= _FASTEST_HZ:
            raise ConfigError(f"--rate {rate_hz:g} Hz cannot be sent; it must be above 0 and at most {_FASTEST_HZ:g}")
        if not 0 < speed <= 1000:
            raise ConfigError(f"--speed {speed:g} cannot be played; it must be above 0 and at most 1000")
        self._flight = flight
        self._transport = transport
        self._speed = speed
        self._loop = loop
        self._boot_utc_s = track.first_s + start_s
        self._duration_s = track.last_s - self._boot_utc_s
        self._rates = track.rates()
        self._gimbal = None if flight.gimbal is None else _platform(flight.gimbal)
        rates_hz = _DEFAULT_HZ | {MessageId.ATTITUDE_QUATERNION: rate_hz}
        if self._gimbal is not None:
            rates_hz[MessageId.GIMBAL_DEVICE_ATTITUDE_STATUS] = _GIMBAL_HZ
        self._default_s: dict[int, float] = {number: 1 / hz for number, hz in rates_hz.items()}
        self._interval_s = dict(self._default_s)
        # Time since boot at which each message is due, s.
        self._due_s: dict[int, float] = {}
        self._now_s = 0.0
        self._makers: dict[int, Callable[[int], Any]] = {
            MessageId.HEARTBEAT: self._heartbeat,
            MessageId.SYSTEM_TIME: self._system_time,
            MessageId.GPS_RAW_INT: self._gps,
            MessageId.ATTITUDE: self._euler,
            MessageId.ATTITUDE_QUATERNION: self._quaternion,
            MessageId.GLOBAL_POSITION_INT: self._position,
        }
        if self._gimbal is not None:
            self._makers[MessageId.GIMBAL_DEVICE_ATTITUDE_STATUS] = self._gimbal_status
        self._mavlink = dialect()
        self._link = self._mavlink.MAVLink(None, srcSystem=sysid, srcComponent=1)
        self._framer = Framer()
        self._sent = self._dropped = 0

    def run(self, stop: Event | None = None, *, on_second: Callable[[float], None] | None = None) -> PlayedFlight:
        """Play until the end of the flight, or until another thread sets `stop`.

        `on_second` is called about once a second with the seconds of flight played.  Raises LinkError if the link is
        lost.
        """
        stop = stop or Event()
        played_s = 0.0
        while True:
            played_s += self._play_once(stop, on_second)
            if stop.is_set() or not self._loop:
                return PlayedFlight(played_s, self._sent, self._dropped)

    def _play_once(self, stop: Event, on_second: Callable[[float], None] | None) -> float:
        began_s, reported_s = time.monotonic(), 0.0
        self._due_s = dict.fromkeys(self._interval_s, 0.0)
        while not stop.is_set():
            self._now_s = (time.monotonic() - began_s) * self._speed
            if self._now_s > self._duration_s:
                return self._duration_s
            self._send_due()
            if on_second is not None and self._now_s - reported_s >= self._speed:
                reported_s = self._now_s
                on_second(reported_s)
            next_s = min((self._due_s[number] for number in self._interval_s), default=inf)
            wait_s = began_s + next_s / self._speed - time.monotonic()
            self._process(self._transport.read(min(max(wait_s, 0.0), 0.1)))
        return self._now_s

    def _send_due(self) -> None:
        """Send the messages that are due, each with the time at which it was due."""
        now_s = self._now_s
        while True:
            number = min(self._interval_s, key=self._due_s.__getitem__, default=None)
            if number is None or self._due_s[number] > now_s:
                return
            due_s = self._due_s[number]
            step_s = self._interval_s[number]
            missed = int(max(now_s - due_s - _LATE_S * self._speed, 0.0) / step_s)
            if missed:
                self._dropped += missed
                due_s += missed * step_s
            self._due_s[number] = due_s + step_s
            self._send(self._makers[number](round(due_s * 1000)))

    def _send(self, message: Any) -> None:
        if message is not None:
            self._transport.write(message.pack(self._link))
            self._link.seq = (self._link.seq + 1) % 256
            self._sent += 1

    # --- sent messages ------------------------------------------------------------------------------------------------

    def _heartbeat(self, _: int) -> Any:
        mavlink = self._mavlink
        mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_GENERIC, mode, 0, mavlink.MAV_STATE_ACTIVE, 3
        )

    def _system_time(self, boot_ms: int) -> Any:
        return self._mavlink.MAVLink_system_time_message(round(self._utc_s(boot_ms) * 1e6), boot_ms)

    def _quaternion(self, boot_ms: int) -> Any:
        q = self._attitude(boot_ms)
        if q is None:
            return None
        # The quaternion of the message is from body to NED.
        return self._mavlink.MAVLink_attitude_quaternion_message(
            boot_ms, *conjugate(q).tolist(), *self._turn_rate(boot_ms)
        )

    def _euler(self, boot_ms: int) -> Any:
        q = self._attitude(boot_ms)
        if q is None:
            return None
        angles_rad = (float(angle) for angle in euler_from_quaternion(q))
        return self._mavlink.MAVLink_attitude_message(boot_ms, *angles_rad, *self._turn_rate(boot_ms))

    def _gimbal_status(self, boot_ms: int) -> Any:
        gimbal, platform, utc_s = self._flight.gimbal, self._gimbal, self._utc_s(boot_ms)
        assert gimbal is not None
        assert platform is not None
        if not platform.covers(utc_s):
            return None
        mavlink, is_earth = self._mavlink, gimbal.is_earth[np.searchsorted(gimbal.utc_s, utc_s, side="right") - 1]
        frame = "EARTH" if is_earth else "VEHICLE"
        flags = getattr(mavlink, f"GIMBAL_DEVICE_FLAGS_YAW_IN_{frame}_FRAME")
        # The quaternion of the message is from the platform to the frame of reference.
        q = conjugate(platform.at(utc_s)).tolist()
        return mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, boot_ms, flags, q, 0, 0, 0, 0)

    def _position(self, boot_ms: int) -> Any:
        site, (north, east, down) = self._position_and_velocity(boot_ms)
        q = self._attitude(boot_ms)
        heading_rad = 0.0 if q is None else float(euler_from_quaternion(q)[2])
        return self._mavlink.MAVLink_global_position_int_message(
            boot_ms,
            *site,
            site[2],
            round(north * 100),
            round(east * 100),
            round(down * 100),
            65535 if q is None else round(np.rad2deg(heading_rad) * 100) % 36000,
        )

    def _gps(self, boot_ms: int) -> Any:
        site, (north, east, _) = self._position_and_velocity(boot_ms)
        speed_m_per_s = hypot(north, east)
        course_deg = np.rad2deg(np.arctan2(east, north))
        # Dilution of precision and number of satellites are unknown.
        return self._mavlink.MAVLink_gps_raw_int_message(
            round(self._utc_s(boot_ms) * 1e6),
            self._mavlink.GPS_FIX_TYPE_3D_FIX,
            *site,
            65535,
            65535,
            round(speed_m_per_s * 100),
            round(course_deg * 100) % 36000,
            255,
        )

    def _utc_s(self, boot_ms: int) -> float:
        return self._boot_utc_s + boot_ms / 1000

    def _attitude(self, boot_ms: int) -> Float | None:
        """Return the attitude at a time since boot, NED to body; None in a gap of the flight."""
        track = self._flight.aircraft_attitude
        utc_s = min(self._utc_s(boot_ms), track.last_s)
        if track.gap_within(utc_s, utc_s) is not None:
            return None
        return track.at(utc_s)

    def _turn_rate(self, boot_ms: int) -> list[float]:
        utc_s, rate_rad_per_s = self._rates
        return [float(np.interp(self._utc_s(boot_ms), utc_s, axis)) for axis in rate_rad_per_s.T]

    def _position_and_velocity(self, boot_ms: int) -> tuple[tuple[int, int, int], tuple[float, float, float]]:
        """Return latitude and longitude (1e-7 deg) and height (mm), and the velocity, north, east, down, m/s."""
        utc_s, half_s = self._utc_s(boot_ms), 0.5
        site = self._flight.position.at(utc_s)
        before, after = (self._flight.position.at(utc_s + offset_s) for offset_s in (-half_s, half_s))
        turned_rad = (after.longitude_rad - before.longitude_rad + np.pi) % (2 * np.pi) - np.pi
        north = (after.latitude_rad - before.latitude_rad) * _EARTH_RADIUS_M
        east = turned_rad * np.cos(site.latitude_rad) * _EARTH_RADIUS_M
        down = before.height_m - after.height_m
        units = round(np.rad2deg(site.latitude_rad) * 1e7), round(np.rad2deg(site.longitude_rad) * 1e7)
        return (*units, round(site.height_m * 1e3)), (north, east, down)

    # --- received messages --------------------------------------------------------------------------------------------

    def _process(self, received: bytes) -> None:
        for packet in self._framer.feed(received):
            message = self._link.decode(bytearray(packet.content))
            if getattr(message, "target_system", 0) not in {0, self._link.srcSystem}:
                continue
            match message.get_type():
                case "COMMAND_LONG":
                    self._send(self._execute(message, packet.sender))
                case "REQUEST_DATA_STREAM":
                    self._set_streams(message)
                case "PARAM_REQUEST_LIST" | "PARAM_REQUEST_READ":
                    real32 = self._mavlink.MAV_PARAM_TYPE_REAL32
                    number = float(self._link.srcSystem)
                    self._send(self._mavlink.MAVLink_param_value_message(b"SYSID_THISMAV", number, real32, 1, 0))
                case "MISSION_REQUEST_LIST":
                    self._send(self._mavlink.MAVLink_mission_count_message(*packet.sender, 0, message.mission_type))

    def _execute(self, command: Any, sender: tuple[int, int]) -> Any:
        """Execute a command and return its acknowledgement."""
        result = self._mavlink.MAV_RESULT_ACCEPTED
        number = int(command.param1) if np.isfinite(command.param1) else -1
        if command.command not in {_GET_MESSAGE_INTERVAL, _SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE}:
            result = self._mavlink.MAV_RESULT_UNSUPPORTED
        elif number not in self._makers:
            result = self._mavlink.MAV_RESULT_DENIED
        elif command.command == _SET_MESSAGE_INTERVAL:
            self._set_interval(number, command.param2 * 1e-6)
        elif command.command == _GET_MESSAGE_INTERVAL:
            interval_us = round(self._interval_s[number] * 1e6) if number in self._interval_s else -1
            self._send(self._mavlink.MAVLink_message_interval_message(number, interval_us))
        else:
            self._send(self._makers[number](round(self._now_s * 1000)))
        return self._mavlink.MAVLink_command_ack_message(command.command, result, 0, 0, *sender)

    def _set_streams(self, request: Any) -> None:
        streams = _STREAMS if request.req_stream_id == _ALL_STREAMS else {request.req_stream_id: ()}
        for stream in streams:
            for number in _STREAMS.get(stream, ()):
                is_on = request.start_stop and request.req_message_rate
                self._set_interval(number, 1 / request.req_message_rate if is_on else -1.0)

    def _set_interval(self, number: int, interval_s: float) -> None:
        """Set the interval of a message, s: 0 is the default interval, a negative one stops it."""
        if not interval_s >= 0:
            self._interval_s.pop(number, None)
            return
        self._interval_s[number] = max(interval_s, 1 / _FASTEST_HZ) if interval_s else self._default_s[number]
        self._due_s[number] = self._now_s


def _platform(gimbal: GimbalAttitude) -> AttitudeTrack | None:
    """Return the platform's attitude against its frame of reference, with gaps where that changes; None without one."""
    changes = np.append(False, gimbal.is_earth[1:] != gimbal.is_earth[:-1])
    try:
        return AttitudeTrack.from_samples(gimbal.utc_s, gimbal.q_gimbal_reference, segment=np.cumsum(changes))
    except TelemetryError:
        return None
