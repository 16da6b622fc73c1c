"""All that glstar sends on a link: heartbeats, requests for message rates, and, if the user enables it, position fixes.

A fix is sent by one of three messages:

======================  =============================================================================================
message                 has, besides latitude and longitude
======================  =============================================================================================
external_position       MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) in a COMMAND_INT: the time since the instant that
                        the fix is for, and its standard deviation
gps_input               GPS_INPUT (232): GPS time of that instant, and its standard deviation; height, velocity and
                        dilution are marked as to be ignored
global_position_sensor  GLOBAL_POSITION_SENSOR (296): UTC of the transmission, the time since that instant, and its
                        standard deviation
======================  =============================================================================================

The autopilot subtracts the delay from the time of arrival.  Heights are unknown.
"""

from collections import deque
from dataclasses import dataclass
from ipaddress import ip_address
from math import nan
from typing import Any, Literal

import numpy as np

from glstar.errors import ConfigError
from glstar.link.endpoint import Endpoint
from glstar.link.packets import EXTERNAL_POSITION_ESTIMATE, MessageId, dialect
from glstar.link.receiver import Receiver
from glstar.sky.place.timescale import GPS_EPOCH_S, TAI_MINUS_GPS_S, WEEK_S, tai_minus_utc_s

# System of ground stations, and component MAV_COMP_ID_ONBOARD_COMPUTER for programs beside them.
_SYSTEM, _COMPONENT = 255, 191
_HEARTBEAT_S = 1.0
# Interval between requests for missing messages, s; after this many rounds, the longer interval.
_REQUEST_TIMEOUT_S = 2.0
_ROUNDS = 8
_LONG_TIMEOUT_S = 30.0
# A request was granted if at least this fraction of the rate is received; autopilots may round rates down.
_GRANTED = 0.3
# The same if the autopilot has rejected requests: messages are then received for another reason.
_GRANTED_AFTER_REJECTION = 0.7
# Number of requests for the quaternion before the Euler angles are requested too, and then the data streams.
_TRIES = 2

_OTHERS_HZ = {MessageId.GLOBAL_POSITION_INT: 5.0, MessageId.SYSTEM_TIME: 2.0, MessageId.GPS_RAW_INT: 1.0}
# The attitude of a gimbal is requested at this fraction of the aircraft's rate: both fit a radio.
_GIMBAL_FRACTION = 0.5
# ArduPilot's data streams: EXTENDED_STATUS, POSITION, EXTRA1 with the attitude and a simulator's state, EXTRA3
# with the gimbal.
_STREAM_OF = {
    MessageId.GPS_RAW_INT: 2,
    MessageId.GLOBAL_POSITION_INT: 6,
    MessageId.ATTITUDE: 10,
    MessageId.SIM_STATE: 10,
    MessageId.SYSTEM_TIME: 12,
    MessageId.GIMBAL_DEVICE_ATTITUDE_STATUS: 12,
}


class Requests:
    """Requests messages from one autopilot until they are received.

    `rate_hz` is the requested rate of the attitude, Hz; with `wants_gimbal` that of a gimbal is requested as well.
    """

    def __init__(self, rate_hz: float, *, wants_gimbal: bool = False) -> None:
        self.rate_hz = rate_hz
        self.wants_gimbal = wants_gimbal
        self._mavlink = dialect()
        self._link = self._mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)
        self._heartbeat_s: float | None = None
        # The receiver and its autopilot's boot to which the requests belong.
        self._served: tuple[Receiver, int] | None = None
        self.restart()

    def restart(self) -> None:
        """Request all messages again, after the link was opened."""
        self._rounds = 0
        self._requested_s: float | None = None
        self._requested: set[int] = set()

    def due(self, receiver: Receiver, now_s: float) -> list[bytes]:
        """Return the packets to be sent now, by `time.monotonic`, s, to the autopilot of a receiver.

        All messages are requested again if the autopilot was restarted, or another one is listened to; the previous one
        gets its default rates.
        """
        packets: list[bytes] = []
        served = self._served
        self._served = (receiver, receiver.clock.boot)
        if served is not None and served != self._served:
            packets += [] if served[0] is receiver else self.default_rate_requests(served[0])
            self.restart()
        if self._heartbeat_s is None or now_s - self._heartbeat_s >= _HEARTBEAT_S:
            self._heartbeat_s = now_s
            packets.append(self._packed(self._heartbeat()))
        wait_s = _REQUEST_TIMEOUT_S if self._rounds < _ROUNDS else _LONG_TIMEOUT_S
        if receiver.chosen is not None and (self._requested_s is None or now_s - self._requested_s >= wait_s):
            self._requested_s = now_s
            packets += [self._packed(message) for message in self._missing_requests(receiver, now_s)]
        return packets

    def default_rate_requests(self, receiver: Receiver) -> list[bytes]:
        """Return the packets that restore the default rates of all requested messages."""
        if receiver.chosen is None:
            return []
        return [self._packed(self._interval(receiver.chosen, number, 0.0)) for number in sorted(self._requested)]

    def _missing_requests(self, receiver: Receiver, now_s: float) -> list[Any]:
        assert receiver.chosen is not None
        missing = {number: hz for number, hz in _OTHERS_HZ.items() if self._is_missing(receiver, number, hz, now_s)}
        rejected = receiver.ack not in {None, self._mavlink.MAV_RESULT_ACCEPTED}
        # A simulator's state is no estimate: the autopilot's attitude is requested as well.
        attitude_hz = max(
            receiver.rate_hz(number, now_s) for number in (MessageId.ATTITUDE, MessageId.ATTITUDE_QUATERNION)
        )
        if attitude_hz < (_GRANTED_AFTER_REJECTION if rejected else _GRANTED) * self.rate_hz:
            missing[MessageId.ATTITUDE_QUATERNION] = self.rate_hz
            if self._rounds >= _TRIES or rejected:
                missing[MessageId.ATTITUDE] = self.rate_hz
        if receiver.simulator is not None and receiver.simulator.rate_hz(now_s) < _GRANTED * self.rate_hz:
            missing[MessageId.SIM_STATE] = self.rate_hz
            if self._rounds >= _TRIES or rejected:
                missing |= {MessageId.HIL_STATE_QUATERNION: self.rate_hz, MessageId.SIMSTATE: self.rate_hz}
        gimbal_hz = _GIMBAL_FRACTION * self.rate_hz
        if self.wants_gimbal and receiver.gimbal.rate_hz(now_s) < _GRANTED * gimbal_hz:
            missing[MessageId.GIMBAL_DEVICE_ATTITUDE_STATUS] = gimbal_hz
            if self._rounds >= _TRIES or rejected:
                missing |= {MessageId.MOUNT_ORIENTATION: gimbal_hz, MessageId.MOUNT_STATUS: gimbal_hz}
        if not missing:
            self._rounds = 0
            return []
        self._rounds += 1
        self._requested |= missing.keys()
        requests = [self._interval(receiver.chosen, number, hz) for number, hz in missing.items()]
        if self._rounds > 2 * _TRIES or receiver.ack == self._mavlink.MAV_RESULT_UNSUPPORTED:
            requests += [
                self._stream(receiver.chosen, _STREAM_OF[number], hz)
                for number, hz in missing.items()
                if number in _STREAM_OF
            ]
        return requests

    def _is_missing(self, receiver: Receiver, number: int, hz: float, now_s: float) -> bool:
        if number == MessageId.GPS_RAW_INT:
            return self._rounds > 0 and not receiver.sends_position
        return receiver.rate_hz(number, now_s) < _GRANTED * hz

    def _interval(self, target: tuple[int, int], number: int, hz: float) -> Any:
        interval_us = 1e6 / hz if hz else 0.0
        command = self._mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        return self._mavlink.MAVLink_command_long_message(*target, command, 0, number, interval_us, 0, 0, 0, 0, 0)

    def _stream(self, target: tuple[int, int], stream: int, hz: float) -> Any:
        return self._mavlink.MAVLink_request_data_stream_message(*target, stream, max(round(hz), 1), 1)

    def _heartbeat(self) -> Any:
        mavlink = self._mavlink
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        )

    def _packed(self, message: Any) -> bytes:
        packed = bytes(message.pack(self._link))
        self._link.seq = (self._link.seq + 1) % 256
        return packed


# How a fix is sent.
InjectedMessage = Literal["external_position", "gps_input", "global_position_sensor"]

_FIX_3D = 3
# Number of satellites that is not known, as in GPS_RAW_INT.
_UNKNOWN = 255
# Value of a dilution that is not known.
_NO_DILUTION = 65535.0
# The sender's time wraps around, s: float32 has a resolution of 0.24 ms below it.
_WRAP_S = 3600.0


@dataclass(frozen=True, slots=True)
class PositionFix:
    """A position that a navigator found."""

    latitude_rad: float  # WGS84
    longitude_rad: float
    utc_s: float  # When the aircraft was there, UTC seconds since 1970
    sigma_m: float | None = None  # Standard deviation of each horizontal component, m; None if unknown


class Injector:
    """A queue of position fixes for the autopilot of a link; `sent` counts those that were sent.

    `host` repeats the host or serial port of the endpoint, if that is not this computer.  Raises ConfigError if the
    link leaves this computer and its host is not named, or another one is.
    """

    def __init__(
        self, endpoint: Endpoint, host: str | None = None, message: InjectedMessage = "external_position"
    ) -> None:
        other = endpoint.device if endpoint.kind == "serial" else endpoint.host
        if host is None and not (endpoint.kind != "serial" and _is_loopback(endpoint.host)):
            raise ConfigError(
                f"positions would be sent over {endpoint.text}, which leaves this computer; if the vehicle there may"
                f" follow them, say so with --inject-host {other}"
            )
        if host is not None and host != other:
            raise ConfigError(f"--inject-host {host} is not the host of {endpoint.text}, which is {other}")
        self.sent = 0
        self._make = {
            "external_position": self._external_position,
            "gps_input": self._gps_input,
            "global_position_sensor": self._global_position_sensor,
        }[message]
        self._fixes: deque[PositionFix] = deque()
        self._mavlink = dialect()
        self._link = self._mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)

    def add(self, fix: PositionFix) -> None:
        """Send a fix as soon as the autopilot and UTC are known; may be called from any thread."""
        self._fixes.append(fix)

    def due(self, receiver: Receiver, now_s: float) -> list[bytes]:
        """Return the packets to be sent now, by `time.monotonic`, s."""
        utc_minus_host_s = receiver.clock.utc_minus_host_s
        if receiver.chosen is None or utc_minus_host_s is None:
            return []
        packets = []
        while self._fixes:
            fix = self._fixes.popleft()
            message = self._make(fix, receiver.chosen, now_s, now_s + utc_minus_host_s)
            packets.append(bytes(message.pack(self._link)))
            self._link.seq = (self._link.seq + 1) % 256
        self.sent += len(packets)
        return packets

    def _external_position(self, fix: PositionFix, target: tuple[int, int], now_s: float, utc_s: float) -> Any:
        return self._mavlink.MAVLink_command_int_message(
            *target,
            self._mavlink.MAV_FRAME_GLOBAL,
            EXTERNAL_POSITION_ESTIMATE,
            0,
            0,
            now_s % _WRAP_S,
            max(utc_s - fix.utc_s, 0.0),
            nan if fix.sigma_m is None else fix.sigma_m,
            0.0,
            *_degrees_e7(fix),
            nan,
        )

    def _gps_input(self, fix: PositionFix, target: tuple[int, int], now_s: float, utc_s: float) -> Any:  # noqa: ARG002 - it has no target
        """Return the fix as of a GPS receiver, whose time is that of the instant of the fix."""
        mavlink = self._mavlink
        week, week_s = divmod(fix.utc_s + tai_minus_utc_s(fix.utc_s) - TAI_MINUS_GPS_S - GPS_EPOCH_S, WEEK_S)
        ignored = (
            mavlink.GPS_INPUT_IGNORE_FLAG_ALT
            | mavlink.GPS_INPUT_IGNORE_FLAG_HDOP
            | mavlink.GPS_INPUT_IGNORE_FLAG_VDOP
            | mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
            | mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT
            | mavlink.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY
            | mavlink.GPS_INPUT_IGNORE_FLAG_VERTICAL_ACCURACY
        )
        if fix.sigma_m is None:
            ignored |= mavlink.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY
        return mavlink.MAVLink_gps_input_message(
            round(fix.utc_s * 1e6),
            0,
            ignored,
            # Of the last half millisecond of a week no more than its end.
            min(round(week_s * 1e3), round(WEEK_S * 1e3) - 1),
            int(week),
            _FIX_3D,
            *_degrees_e7(fix),
            0.0,
            _NO_DILUTION,
            _NO_DILUTION,
            0.0,
            0.0,
            0.0,
            0.0,
            fix.sigma_m or 0.0,
            0.0,
            _UNKNOWN,
        )

    def _global_position_sensor(self, fix: PositionFix, target: tuple[int, int], now_s: float, utc_s: float) -> Any:  # noqa: ARG002 - it has UTC
        mavlink = self._mavlink
        return mavlink.MAVLink_global_position_sensor_message(
            *target,
            0,
            round(utc_s * 1e6),
            round(max(utc_s - fix.utc_s, 0.0) * 1e6),
            mavlink.GLOBAL_POSITION_SRC_UNKNOWN,
            0,
            *_degrees_e7(fix),
            nan,
            nan,
            nan if fix.sigma_m is None else fix.sigma_m,
            nan,
        )


def _degrees_e7(fix: PositionFix) -> tuple[int, int]:
    """Return latitude and longitude in 1e-7 deg."""
    latitude, longitude = (round(float(np.rad2deg(angle)) * 1e7) for angle in (fix.latitude_rad, fix.longitude_rad))
    return latitude, longitude


def _is_loopback(host: str) -> bool:
    """Return whether a host is this computer."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
