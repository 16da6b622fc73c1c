"""All that glstar sends on a link: heartbeats, requests for message rates, and, if the user enables it, position fixes.

A fix is sent by one of three messages:

======================  =============================================================================================
message                 has, besides latitude and longitude
======================  =============================================================================================
external_position       MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) in a COMMAND_INT: the time since the instant that
                        the fix is for, and its standard deviation
gps_input               GPS_INPUT (232): GPS time of the transmission, where the aircraft has flown until then with
                        the velocity that the autopilot estimates, that velocity, and the standard deviation of the
                        position; height and dilution are marked as to be ignored
global_position_sensor  GLOBAL_POSITION_SENSOR (296): UTC of the transmission, where the aircraft has flown until
                        then (without a velocity: the time since the instant), and the standard deviation
======================  =============================================================================================

The autopilot subtracts the delay from the time of arrival.  Heights are unknown.  ArduPilot ignores GPS_INPUT unless
GPS1_TYPE or GPS2_TYPE is 14, and treats a message without a velocity as one of 0 m/s, whatever its flags say.  It takes
the least age of such messages for the link's delay, so that a constant delay of the solver would stay in the position.
Of two receivers with a fix it uses the one with more satellites; its EKF demands six.  PX4 takes
GLOBAL_POSITION_SENSOR alone of the two, for the place of its arrival, if EKF2_AGP0_ID is the number of the sensor.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot, inf, isfinite, nan, pi
from typing import Any, Literal

import numpy as np

from glstar.errors import ConfigError
from glstar.link.endpoint import Endpoint
from glstar.link.history import SIMULATOR_MESSAGES
from glstar.link.packets import EXTERNAL_POSITION_ESTIMATE, GIMBAL_IDS, GPS_TYPES, RATES_HZ, MessageId, Packer, dialect
from glstar.link.receiver import Receiver
from glstar.sky.place.site import Site, north_east_of, surface_offset_km
from glstar.sky.place.timescale import GPS_EPOCH_S, TAI_MINUS_GPS_S, WEEK_S, format_utc, tai_minus_utc_s
from glstar.telemetry.mavlink.packets import Sender

_HEARTBEAT_S = 1.0
# Interval between requests for missing messages, s; after this many rounds, the longer interval.
_REQUEST_TIMEOUT_S = 2.0
_ROUNDS = 8
_LONG_TIMEOUT_S = 30.0
# A request was granted if at least this fraction of the rate is received; autopilots may round rates down.
_GRANTED = 0.3
# The same if the autopilot has rejected requests: messages are then received for another reason.
_GRANTED_AFTER_REJECTION = 0.7
# Lowest rate that is requested of a message that was denied, Hz.  ArduPilot of 2026 denies more than 80 % of
# SCHED_LOOP_RATE, which is at least 50 Hz, and a message that it does not know; older ones round the rate down.
_LOWEST_HZ = 25.0
# Number of requests for the quaternion before the Euler angles are requested too, and then the data streams.
_TRIES = 2

_OTHERS_HZ = {MessageId.GLOBAL_POSITION_INT: 5.0, MessageId.SYSTEM_TIME: 2.0, MessageId.GPS_RAW_INT: 1.0}
# The attitude of a gimbal is requested at this fraction of the aircraft's rate: both fit a radio.
_GIMBAL_FRACTION = 0.5
# ArduPilot's data streams: EXTENDED_STATUS, POSITION, EXTRA1 with the attitude and a simulator's state, EXTRA3
# with the gimbal.
_STREAM_OF: dict[int, int] = {
    MessageId.GPS_RAW_INT: 2,
    MessageId.GLOBAL_POSITION_INT: 6,
    MessageId.ATTITUDE: 10,
    MessageId.SIM_STATE: 10,
    MessageId.SYSTEM_TIME: 12,
    MessageId.GIMBAL_DEVICE_ATTITUDE_STATUS: 12,
}


class Requests:
    """Requests messages from one autopilot until they are received.

    `rate_hz` is the requested rate of the attitude, Hz; with `wants_gimbal` the attitude of a gimbal is requested as
    well.
    """

    def __init__(self, rate_hz: float, *, wants_gimbal: bool = False) -> None:
        self.rate_hz = rate_hz
        self.wants_gimbal = wants_gimbal
        self._mavlink = dialect()
        self._packed = Packer()
        self._heartbeat_s: float | None = None
        # The receiver and its autopilot's boot to which the requests belong.
        self._served: tuple[Receiver, int] | None = None
        self.restart()

    def restart(self) -> None:
        """Request all messages again, after the link was opened."""
        self._rounds = 0
        self._requested_s: float | None = None
        self._requested: set[int] = set()
        # Messages of the latest round, lower rates by message, Hz, and messages that the autopilot denies at any rate.
        self._asked: list[int] = []
        self._lower_hz: dict[int, float] = {}
        self._refused: set[int] = set()

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
        if len(receiver.acks) == len(self._asked) and self._may_be_lower(self._denied(receiver.acks)):
            wait_s = 0.0
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
        rejected = receiver.ack not in {None, self._mavlink.MAV_RESULT_ACCEPTED}
        denied = self._denied(receiver.acks)
        receiver.acks.clear()
        missing: dict[int, float] = {}
        # A lower rate of a message is requested before the messages that can replace it.
        for with_others in (False, True) if denied else (rejected or self._rounds >= _TRIES,):
            missing = self._missing(receiver, now_s, rejected=rejected, with_others=with_others)
            if lower_hz := self._lowered(missing, denied):
                return self._intervals(receiver.chosen, lower_hz)
        if not missing:
            self._rounds, self._asked = 0, []
            return []
        self._rounds += 1
        self._requested |= missing.keys()
        requests = self._intervals(receiver.chosen, missing)
        if self._rounds > 2 * _TRIES or receiver.ack == self._mavlink.MAV_RESULT_UNSUPPORTED:
            requests += [
                self._stream(receiver.chosen, _STREAM_OF[number], hz)
                for number, hz in missing.items()
                if number in _STREAM_OF
            ]
        return requests

    def _missing(self, receiver: Receiver, now_s: float, *, rejected: bool, with_others: bool) -> dict[int, float]:
        """Return the messages that are not received, or too rarely, and their rates, Hz.

        `rejected`: whether the autopilot has rejected requests; `with_others`: whether messages that can replace them
        are among them.
        """
        missing: dict[int, float] = {
            number: hz for number, hz in _OTHERS_HZ.items() if self._is_missing(receiver, number, hz, now_s)
        }
        attitudes = MessageId.ATTITUDE_QUATERNION, MessageId.ATTITUDE
        # A simulator's state is no estimate: the autopilot's attitude is requested as well.
        attitude_hz = max(receiver.rate_hz(number, now_s) for number in attitudes)
        kinds: list[tuple[tuple[int, ...], float, float, float]] = [
            (attitudes, self.rate_hz, attitude_hz, _GRANTED_AFTER_REJECTION if rejected else _GRANTED)
        ]
        if receiver.simulator is not None:
            kinds.append((SIMULATOR_MESSAGES, self.rate_hz, receiver.simulator.rate_hz(now_s), _GRANTED))
        if self.wants_gimbal:
            kinds.append((GIMBAL_IDS, _GIMBAL_FRACTION * self.rate_hz, receiver.gimbal.rate_hz(now_s), _GRANTED))
        for numbers, rate_hz, received_hz, granted in kinds:
            wanted = {int(number): self._lower_hz.get(number, rate_hz) for number in numbers}
            if received_hz < granted * wanted[numbers[0]]:
                missing |= wanted if with_others else {numbers[0]: wanted[numbers[0]]}
        return missing

    def _denied(self, acks: Sequence[int]) -> set[int]:
        """Return the messages of the latest round that were denied; all if it is not known which.

        An autopilot answers in the order of the requests.
        """
        if len(acks) == len(self._asked):
            answered = zip(self._asked, acks, strict=True)
            return {number for number, ack in answered if ack == self._mavlink.MAV_RESULT_DENIED}
        return set(self._asked) if self._mavlink.MAV_RESULT_DENIED in acks else set()

    def _may_be_lower(self, denied: set[int]) -> set[int]:
        """Return the messages that may be granted at a lower rate."""
        return denied - _OTHERS_HZ.keys() - self._refused

    def _lowered(self, missing: Mapping[int, float], denied: set[int]) -> dict[int, float]:
        """Return the next lower rates of denied messages, Hz, without those that were denied at the lowest."""
        lowered: dict[int, float] = {}
        for number in sorted(self._may_be_lower(denied).intersection(missing)):
            rate_hz = next((rate_hz for rate_hz in RATES_HZ if _LOWEST_HZ <= rate_hz < missing[number]), None)
            if rate_hz is None:
                self._refused.add(number)
                self._lower_hz.pop(number, None)
            else:
                lowered[number] = self._lower_hz[number] = rate_hz
        return lowered

    def _is_missing(self, receiver: Receiver, number: int, hz: float, now_s: float) -> bool:
        if number == MessageId.GPS_RAW_INT:
            return self._rounds > 0 and not receiver.sends_position
        return receiver.rate_hz(number, now_s) < _GRANTED * hz

    def _intervals(self, target: tuple[int, int], rates_hz: Mapping[int, float]) -> list[Any]:
        self._asked = list(rates_hz)
        return [self._interval(target, number, hz) for number, hz in rates_hz.items()]

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


# How a fix is sent.
InjectedMessage = Literal["external_position", "gps_input", "global_position_sensor"]

_FIX_3D = 3
# Number of satellites of GPS_INPUT: enough for the EKFs of ArduPilot and PX4, and fewer than a real receiver's.
_SATELLITES = 6
# Value of a dilution that is not known.
_NO_DILUTION = 65535.0
# ArduPilot applies an older position as if it were of this age, s.
_OLDEST_S = 5.0
# ArduPilot's EKF takes a larger standard deviation in GPS_INPUT for this one, m, and one that is not stated for 0.5 m.
_LARGEST_GPS_SIGMA_M = 100.0
# Largest standard deviation of a position, m: half of the Earth's circumference.
_LARGEST_SIGMA_M = 2.1e7
# Speed that an aircraft may have, km/s.
_SPEED_KM_PER_S = 0.1
# Number of positions out of reach in a row, each within reach of the previous one, of which the last is accepted.
_AGREEING = 3
# Value of one of `GPS_TYPES` that takes GPS_INPUT.
_GPS_OF_MAVLINK = 14
# Number of the sensor of GLOBAL_POSITION_SENSOR: PX4 knows it by EKF2_AGP0_ID, where 0 is none.
_SENSOR_ID = 1
# Interval between requests for it, s, and their number.
_PARAMETER_S, _PARAMETER_TRIES = 1.0, 4
# A refusal for the same reason as the one before is said again after this time, s.
_AGAIN_S = 60.0
# Standard deviation of the velocity that the autopilot estimates and is sent back, m/s.
_SPEED_ACCURACY_M_PER_S = 3.0


@dataclass(frozen=True, slots=True)
class PositionFix:
    """A position that a navigator found."""

    latitude_rad: float  # WGS84
    longitude_rad: float
    utc_s: float  # When the aircraft was there, UTC seconds since 1970
    sigma_m: float | None = None  # Standard deviation of each horizontal component, m; None if unknown

    @property
    def is_on_earth(self) -> bool:
        """Whether all numbers are finite and within their limits."""
        sigma_m = self.sigma_m or 0.0
        return (
            abs(self.latitude_rad) <= pi / 2
            and abs(self.longitude_rad) <= pi
            and isfinite(self.utc_s)
            and 0 <= sigma_m <= _LARGEST_SIGMA_M
        )


class Injector:
    """A queue of position fixes for the autopilot of a link; `sent` and `refused` count them.

    `host` repeats the host or serial port of the endpoint, if that is not this computer.  A fix is refused if it is too
    old for the autopilot, or farther than `max_km` from where the aircraft can have flown since the previous one;
    `messages` says why.  Raises ConfigError if the link leaves this computer and its host is not named, or another one
    is.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        host: str | None = None,
        message: InjectedMessage = "external_position",
        *,
        max_km: float = 200.0,
    ) -> None:
        other = endpoint.device if endpoint.kind == "serial" else endpoint.host
        if host is None and not endpoint.is_on_this_computer:
            raise ConfigError(
                f"positions would be sent over {endpoint.text}, which leaves this computer; if the vehicle there may"
                f" follow them, say so with --inject-host {other}"
            )
        if host is not None and host != other:
            raise ConfigError(f"--inject-host {host} is not the host of {endpoint.text}, which is {other}")
        self.sent = self.refused = 0
        # What the user should know; taken from the left by the link.
        self.messages: deque[str] = deque()
        self._make = {
            "external_position": self._external_position,
            "gps_input": self._gps_input,
            "global_position_sensor": self._global_position_sensor,
        }[message]
        self._is_gps_input, self._is_reset = message == "gps_input", message == "external_position"
        self._is_sensor = message == "global_position_sensor"
        self._max_km = max_km
        self._fixes: deque[PositionFix] = deque()
        self._sent_last: PositionFix | None = None
        # Latest fix out of reach, and the number of those in a row that agree with it.
        self._doubted: tuple[PositionFix, int] | None = None
        # When the first fix was sent, by `time.monotonic` or, in a boot, by the vehicle's clock, s: zero of the times
        # of transmission, which never wrap.  And the time since then of the latest fix.
        self._first: tuple[int, float] | None = None
        self._passed_s = 0.0
        # To whom requests for the parameter were sent, how often, and when last, by `time.monotonic`, s.
        self._asked: tuple[Sender | None, int, float] = (None, 0, -inf)
        # Why a fix was refused, when that was said, s, and how many were refused since.
        self._reported: tuple[str, float, int] = ("", -inf, 0)
        # The boot in which the user was warned.
        self._warned_boot: int | None = None
        self._mavlink = dialect()
        self._packed = Packer()

    def add(self, fix: PositionFix) -> None:
        """Send a fix as soon as the autopilot and UTC are known; may be called from any thread."""
        self._fixes.append(fix)

    def due(self, receiver: Receiver, now_s: float) -> list[bytes]:
        """Return the packets to be sent now, by `time.monotonic`, s."""
        utc_s, boot_s = receiver.clock.now(now_s)
        if receiver.chosen is None or utc_s is None:
            return []
        # A simulator that is sped up or paused expects times by its own clock.
        boot, clock_s = (receiver.clock.boot, boot_s) if receiver.clock.is_vehicle_time else (0, now_s)
        if self._is_gps_input and _gps_id(receiver) is None:
            questions = self._questions(receiver, now_s)
            if questions is not None:
                return questions
        packets = []
        while self._fixes:
            fix = self._fixes.popleft()
            why = self._refusal(fix, receiver, now_s, utc_s)
            if why is not None:
                self.refused += 1
                self._report(fix, why, now_s)
                continue
            if self._first is None or self._first[0] != boot:
                self._first = boot, clock_s
            self._passed_s = clock_s - self._first[1]
            self._warn(receiver, now_s)
            packets.append(self._packed(self._make(fix, receiver, now_s, utc_s)))
            self._sent_last, self._doubted = fix, None
            self._reported = "", -inf, self._reported[2]
        self.sent += len(packets)
        return packets

    def _report(self, fix: PositionFix, why: str, now_s: float) -> None:
        """Say that a fix is not sent; for the same reason as the one before only once a minute, with their number."""
        reason, last_s, others = self._reported
        if why == reason and now_s - last_s < _AGAIN_S:
            self._reported = reason, last_s, others + 1
            return
        at = format_utc(fix.utc_s)[11:21] if isfinite(fix.utc_s) else fix.utc_s
        since = f" ({others} others neither since the last line)" if others else ""
        self.messages.append(f"the position of {at} is not sent: {why}{since}")
        self._reported = why, now_s, 0

    def _questions(self, receiver: Receiver, now_s: float) -> list[bytes] | None:
        """Return what asks an autopilot for `GPS_TYPES`, if it is time.

        None once it has answered, or has not answered often enough.
        """
        target = receiver.chosen
        assert target is not None
        asked, times, last_s = self._asked
        times = times if asked == target else 0
        if times > _PARAMETER_TRIES:
            return None
        if times and now_s - last_s < _PARAMETER_S:
            return []
        if times and receiver.parameters:
            return None
        self._asked = target, times + 1, now_s
        if times == _PARAMETER_TRIES:
            self.messages.append(f"the autopilot does not state {next(iter(GPS_TYPES))}: it may ignore the positions")
            return None
        request = self._mavlink.MAVLink_param_request_read_message
        return [self._packed(request(*target, name.encode(), -1)) for name in GPS_TYPES]

    def _warn(self, receiver: Receiver, now_s: float) -> None:
        """Report, once a boot, that the autopilot may do with a position what the user does not expect."""
        boot = receiver.clock.boot
        if self._warned_boot == boot:
            return
        takes = next((name for name, value in receiver.parameters.items() if value == _GPS_OF_MAVLINK), "")
        text = None
        if self._is_gps_input and receiver.changed.get(takes) == boot:
            text = f"{takes} was changed: the autopilot may ignore the positions until it is restarted"
        elif self._is_reset and (receiver.vehicle or "").startswith("PX4") and receiver.has_fix(now_s):
            text = "PX4 resets its position to each one, although its GNSS receiver has a fix: its estimate may fail"
        if text is not None:
            self._warned_boot = boot
            self.messages.append(text)

    def _refusal(self, fix: PositionFix, receiver: Receiver, now_s: float, utc_s: float) -> str | None:
        """Return why a fix must not be sent; None if it may."""
        if not fix.is_on_earth:
            return "it is no place on Earth"
        age_s = utc_s - fix.utc_s
        if age_s > _OLDEST_S:
            return f"it is {age_s:.1f} s old, and an autopilot takes older ones than {_OLDEST_S:g} s for newer"
        if self._is_sensor and fix.sigma_m is None:
            return "its accuracy is not stated, and PX4 takes that for 1 m; the answer needs an error ellipse"
        refusal = _gps_input_refusal(fix, receiver, now_s) if self._is_gps_input else None
        return refusal or self._too_far(fix)

    def _too_far(self, fix: PositionFix) -> str | None:
        if self._sent_last is None or self._can_follow(self._sent_last, fix):
            return None
        last, agreeing = self._doubted or (None, 0)
        agreeing = agreeing + 1 if last is not None and self._can_follow(last, fix) else 1
        if agreeing >= _AGREEING:
            self.messages.append(f"{_AGREEING} positions in a row agree with each other: accepted")
            return None
        self._doubted = fix, agreeing
        distance_km = _distance_km(self._sent_last, fix)
        return (
            f"it is {distance_km:.0f} km from the previous one, {abs(fix.utc_s - self._sent_last.utc_s):.0f} s before;"
            f" --inject-max-km allows {self._max_km:g} km more than the flight"
        )

    def _can_follow(self, before: PositionFix, fix: PositionFix) -> bool:
        flown_km = _SPEED_KM_PER_S * abs(fix.utc_s - before.utc_s)
        return _distance_km(before, fix) <= self._max_km + flown_km

    def _external_position(self, fix: PositionFix, receiver: Receiver, now_s: float, utc_s: float) -> Any:  # noqa: ARG002 - see _passed_s
        assert receiver.chosen is not None
        return self._mavlink.MAVLink_command_int_message(
            *receiver.chosen,
            self._mavlink.MAV_FRAME_GLOBAL,
            EXTERNAL_POSITION_ESTIMATE,
            0,
            0,
            self._passed_s,
            max(utc_s - fix.utc_s, 0.0),
            nan if fix.sigma_m is None else fix.sigma_m,
            0.0,
            *_degrees_e7(fix),
            nan,
        )

    def _gps_input(self, fix: PositionFix, receiver: Receiver, now_s: float, utc_s: float) -> Any:
        """Return the fix as of a GPS receiver that measures where the aircraft is now."""
        mavlink = self._mavlink
        velocity = receiver.velocity(now_s)
        assert velocity is not None
        assert fix.sigma_m is not None
        fix = _as_of(utc_s, fix, velocity)
        week, week_s = divmod(fix.utc_s + tai_minus_utc_s(fix.utc_s) - TAI_MINUS_GPS_S - GPS_EPOCH_S, WEEK_S)
        ignored = (
            mavlink.GPS_INPUT_IGNORE_FLAG_ALT
            | mavlink.GPS_INPUT_IGNORE_FLAG_HDOP
            | mavlink.GPS_INPUT_IGNORE_FLAG_VDOP
            | mavlink.GPS_INPUT_IGNORE_FLAG_VERTICAL_ACCURACY
        )
        return mavlink.MAVLink_gps_input_message(
            round(fix.utc_s * 1e6),
            _gps_id(receiver) or 0,
            ignored,
            # Of the last half millisecond of a week no more than its end.
            min(round(week_s * 1e3), round(WEEK_S * 1e3) - 1),
            int(week),
            _FIX_3D,
            *_degrees_e7(fix),
            0.0,
            _NO_DILUTION,
            _NO_DILUTION,
            *velocity,
            _SPEED_ACCURACY_M_PER_S,
            fix.sigma_m,
            0.0,
            _SATELLITES,
        )

    def _global_position_sensor(self, fix: PositionFix, receiver: Receiver, now_s: float, utc_s: float) -> Any:
        """Return the fix as of now, for PX4 ignores the processing time; without a velocity, as of its instant."""
        mavlink = self._mavlink
        assert receiver.chosen is not None
        velocity = receiver.velocity(now_s)
        if velocity is not None:
            fix = _as_of(utc_s, fix, velocity)
        return mavlink.MAVLink_global_position_sensor_message(
            *receiver.chosen,
            _SENSOR_ID,
            round(utc_s * 1e6),
            round(max(utc_s - fix.utc_s, 0.0) * 1e6),
            mavlink.GLOBAL_POSITION_SRC_UNKNOWN,
            0,
            *_degrees_e7(fix),
            nan,
            nan,
            fix.sigma_m,
            nan,
        )


def _gps_id(receiver: Receiver) -> int | None:
    """Return the `gps_id` of the receiver that takes GPS_INPUT; None if the autopilot has not stated one."""
    stated = receiver.parameters.items()
    return next((GPS_TYPES[name] for name, value in stated if value == _GPS_OF_MAVLINK), None)


def _gps_input_refusal(fix: PositionFix, receiver: Receiver, now_s: float) -> str | None:
    """Return why a fix must not be sent as GPS_INPUT; None if it may."""
    if receiver.parameters and _gps_id(receiver) is None:
        stated = " and ".join(f"{name} is {value:g}" for name, value in receiver.parameters.items())
        which = "it" if len(receiver.parameters) == 1 else "one"
        return f"{stated}; set {which} to {_GPS_OF_MAVLINK} (MAVLink) and restart the autopilot"
    if fix.sigma_m is None or fix.sigma_m > _LARGEST_GPS_SIGMA_M:
        accuracy = "not stated" if fix.sigma_m is None else f"{fix.sigma_m / 1e3:.3g} km"
        return (
            f"its accuracy is {accuracy}, and ArduPilot takes one of GPS_INPUT for {_LARGEST_GPS_SIGMA_M:g} m or less;"
            " --inject-as external_position keeps it"
        )
    if receiver.velocity(now_s) is None:
        return "GPS_INPUT needs the velocity of GLOBAL_POSITION_INT, which does not arrive"
    return None


def _as_of(utc_s: float, fix: PositionFix, velocity_m_per_s: tuple[float, float, float]) -> PositionFix:
    """Return where the aircraft is at a later UTC."""
    age_s = max(utc_s - fix.utc_s, 0.0)
    north_m, east_m = velocity_m_per_s[0] * age_s, velocity_m_per_s[1] * age_s
    place = north_east_of(Site(fix.latitude_rad, fix.longitude_rad), north_m, east_m)
    return PositionFix(*place, utc_s, fix.sigma_m)


def _degrees_e7(fix: PositionFix) -> tuple[int, int]:
    """Return latitude and longitude in 1e-7 deg."""
    latitude, longitude = (round(float(np.rad2deg(angle)) * 1e7) for angle in (fix.latitude_rad, fix.longitude_rad))
    return latitude, longitude


def _distance_km(one: PositionFix, other: PositionFix) -> float:
    return hypot(*surface_offset_km(Site(one.latitude_rad, one.longitude_rad), other.latitude_rad, other.longitude_rad))
