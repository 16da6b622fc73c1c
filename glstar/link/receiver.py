"""Attitude, position and time of one autopilot, from the packets of a link."""

from collections.abc import Callable
from functools import partial
from math import floor, inf, radians
from typing import Any

import numpy as np

from glstar.link.clock import BootClock
from glstar.link.gimbal import LinkGimbal
from glstar.link.history import POSITION_INTERVAL_S, SIMULATOR_MESSAGES, History, SimulatorState
from glstar.link.packets import (
    EXTERNAL_POSITION_ESTIMATE,
    GIMBAL_IDS,
    GPS_TYPES,
    MessageId,
    MessageRate,
    Packet,
    dialect,
)
from glstar.link.status import LatestAttitude
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.site import HEIGHTS_M
from glstar.telemetry.mavlink.packets import NO_AUTOPILOT, Sender
from glstar.telemetry.mavlink.vehicles import autopilot, vehicle_kind
from glstar.telemetry.source import UNIT_TOLERANCE, YEAR_2010_S

# Another autopilot is chosen if the first one sends no attitude for this time, s.
_ATTITUDE_TIMEOUT_S = 5.0
_FIX_3D = 3
# An older estimate of the velocity is not used, s.
_VELOCITY_TIMEOUT_S = 2.0
# Age of a fix of its GNSS receiver, s.
_FIX_TIMEOUT_S = 2.0
# After a longer pause of a sender its sequence numbers do not show losses, s.
_SEQUENCE_TIMEOUT_S = 2.0
# A larger change of UTC is reported, s: 7 px at 1 deg/s and f = 3871 px.
_UTC_STEP_S = 0.1
# Largest number of senders; more are damaged packets.
_MAX_SENDERS = 64
# Messages with an attitude, and with a position, the preferred one first.
_ATTITUDES = (MessageId.ATTITUDE, MessageId.ATTITUDE_QUATERNION, MessageId.HIL_STATE_QUATERNION)
_POSITIONS = (MessageId.GLOBAL_POSITION_INT, MessageId.HIL_STATE_QUATERNION, MessageId.GPS_RAW_INT)


class Receiver:
    """Processes the packets of one autopilot among all senders on a link.

    `report` is called with the message of each event.  `sysid` is the MAVLink system of the autopilot; by default that
    of the first one.  `with_simulator`: whether a simulator's own state is kept beside the autopilot's estimates.
    """

    def __init__(
        self,
        clock: BootClock,
        report: Callable[[str], None],
        *,
        sysid: int | None = None,
        keep_s: float = 600.0,
        with_simulator: bool = False,
    ) -> None:
        self.clock = clock
        # What the autopilot estimates, a simulator's own state, and the attitude of its gimbal.
        self.history = History(keep_s)
        self.simulator = SimulatorState(keep_s, is_vehicle_time=clock.is_vehicle_time) if with_simulator else None
        self.gimbal = LinkGimbal(clock, keep_s)
        # Number of packets received, of those of the autopilot among them, and of its packets that were lost.
        self.packets = self.counted = self.lost = 0
        # The autopilot; None before its first heartbeat.
        self.chosen: Sender | None = None
        # Arrival of its latest attitude by `time.monotonic`, s.
        self.attitude_arrival_s: float | None = None
        # Its last reply to a request for a message interval, a MAV_RESULT, and all those since the latest requests.
        self.ack: int | None = None
        self.acks: list[int] = []
        self._position_ack: int | None = None
        # Those of `GPS_TYPES` that the autopilot stated, and the boots in which they were changed.
        self.parameters: dict[str, float] = {}
        self.changed: dict[str, int] = {}
        # Its height above home, m.
        self.above_home_m = 0.0
        # Its estimated velocity, north, east and down, m/s, and the arrival by `time.monotonic`, s.
        self._velocity = (0.0, 0.0, 0.0)
        self._velocity_s = self._fix_s = -inf
        self._report = report
        self._sysid = sysid
        mavlink = dialect()
        self._decode: Callable[[bytearray], Any] = mavlink.MAVLink(None).decode
        self._decode_error: type[Exception] = mavlink.MAVError
        self._vehicles: dict[Sender, str | None] = {}
        self._chosen_s = 0.0
        # Latest sequence number of the autopilot and its arrival, and last jump of the numbers and its arrival.
        self._sequence: tuple[int, float] | None = None
        self._jump = 0, -inf
        counted = (*_ATTITUDES, MessageId.GLOBAL_POSITION_INT, MessageId.SYSTEM_TIME)
        self._rates: dict[int, MessageRate] = {number: MessageRate() for number in counted}
        # Messages that contained a position, and the UTC at which the clock of a simulator begins.
        self._position_messages: set[int] = set()
        self._hil_utc_s: float | None = None
        # First bytes of the latest attitude of each message: its time since boot.
        self._latest_stamp: dict[int, bytes] = {}
        self._aligned = False
        self._handlers: dict[int, Callable[[Any, float], None]] = {
            MessageId.ATTITUDE: self._on_euler,
            MessageId.ATTITUDE_QUATERNION: self._on_quaternion,
            MessageId.GLOBAL_POSITION_INT: self._on_position,
            MessageId.GPS_RAW_INT: self._on_fix,
            MessageId.HIL_STATE_QUATERNION: self._on_hil_state,
            MessageId.COMMAND_ACK: self._on_ack,
            MessageId.PARAM_VALUE: self._on_parameter,
        }
        if self.simulator is not None:
            self._handlers |= {number: partial(self.simulator.receive, number) for number in SIMULATOR_MESSAGES}

    def receive(self, packet: Packet, arrival_s: float) -> None:
        """Process a packet that arrived at a time by `time.monotonic`, s."""
        self.packets += 1
        self._count_lost(packet, arrival_s)
        number = packet.number
        is_chosen = packet.sender == self.chosen
        if number in GIMBAL_IDS:
            self._on_gimbal(packet, arrival_s)
            return
        if number not in {MessageId.HEARTBEAT, MessageId.SYSTEM_TIME} and not (is_chosen and number in self._handlers):
            return
        is_estimate = number in _ATTITUDES and not (
            number == MessageId.HIL_STATE_QUATERNION and self.simulator is not None
        )
        if is_estimate and self._latest_stamp.get(number) == packet.begins:
            # Of attitudes with the same time only the first is decoded, so that a flood costs little.
            self._rates[number].add(arrival_s)
            return
        try:
            message = self._decode(bytearray(packet.content))
        except self._decode_error:
            return
        if is_estimate:
            self._latest_stamp[number] = packet.begins
        if number == MessageId.HEARTBEAT:
            self._on_heartbeat(message, packet.sender, arrival_s)
            if self._sequence is None:  # it has just been chosen
                self._count_lost(packet, arrival_s)
        elif number == MessageId.SYSTEM_TIME:
            self._on_time(message, arrival_s, is_chosen=is_chosen)
        else:
            self._handlers[number](message, arrival_s)

    def continue_from(self, other: "Receiver", now_s: float) -> None:
        """Continue to count packets and vehicles where the receiver of another autopilot ended."""
        self.packets, self.counted, self.lost = other.packets, other.counted, other.lost
        self._vehicles = other._vehicles  # noqa: SLF001 - of the same class
        for sender in self._vehicles:
            if sender[0] == self._sysid and self.chosen is None:
                self._choose(sender, now_s)

    @property
    def vehicle(self) -> str | None:
        """Name of the autopilot and its vehicle; None if unknown."""
        return self._vehicles.get(self.chosen) if self.chosen is not None else None

    @property
    def sky_history(self) -> History:
        """The history that the sky is drawn from: the simulator's own state if it is kept, else the estimates."""
        return self.history if self.simulator is None else self.simulator.history

    def latest(self, *, of_gimbal: bool) -> LatestAttitude | None:
        """Return the times of the latest attitude of the sky, or of the gimbal; None if there is none, or no UTC."""
        if of_gimbal:
            return self.clock.dated(self.gimbal.latest_boot_s, self.gimbal.arrival_s)
        return self.clock.dated(self.sky_history.latest_boot_s, self.attitude_arrival_s)

    @property
    def systems(self) -> tuple[int, ...]:
        """MAVLink systems of all autopilots on the link."""
        return tuple(sorted({system for system, _ in self._vehicles}))

    @property
    def attitude_source(self) -> str:
        """The message from which attitude is currently read."""
        return self._preferred().name

    def rate_hz(self, number: int, now_s: float) -> float:
        """Return the rate of a message of the autopilot over the last two seconds, Hz; `now_s`: by `time.monotonic`."""
        return self._rates[number].hz(now_s)

    def attitude_rate_hz(self, now_s: float) -> float:
        """Return the rate of the attitude over the last two seconds, Hz."""
        return max(self.rate_hz(number, now_s) for number in _ATTITUDES)

    # --- senders ------------------------------------------------------------------------------------------------------

    def _count_lost(self, packet: Packet, arrival_s: float) -> None:
        """Count the missing packets of the autopilot by their sequence numbers.

        Those of other senders do not show losses: a router forwards some of them only.
        """
        if packet.sender != self.chosen:
            return
        self.counted += 1
        if self._sequence is not None:
            before, before_s = self._sequence
            missing = (packet.sequence - before - 1) % 256
            # A larger step is a late packet.  After a pause the numbers may have wrapped around or restarted.
            if missing < 128 and arrival_s - before_s < _SEQUENCE_TIMEOUT_S:
                self.lost += missing
                if missing:
                    self._jump = missing, arrival_s
        self._sequence = packet.sequence, arrival_s

    def _discard_jump(self, arrival_s: float) -> None:
        """Subtract the losses counted at a reboot: the sequence numbers have restarted."""
        missing, jumped_s = self._jump
        self._jump = 0, -inf
        if arrival_s - jumped_s < _SEQUENCE_TIMEOUT_S:
            self.lost -= missing

    def _on_heartbeat(self, message: Any, sender: Sender, arrival_s: float) -> None:
        if message.autopilot == NO_AUTOPILOT:
            return
        if sender not in self._vehicles:
            if len(self._vehicles) >= _MAX_SENDERS:
                return
            self._vehicles[sender] = autopilot(message.autopilot, vehicle_kind([message.type]))
            self._report(f"system {sender[0]}: {self._vehicles[sender] or 'an autopilot'}")
        if self._sysid is not None and sender[0] != self._sysid:
            return
        if self.chosen is None:
            self._choose(sender, arrival_s)
        elif sender != self.chosen and self._attitude_has_timed_out(arrival_s):
            self._report(f"system {self.chosen[0]} sends no attitude; listening to system {sender[0]}")
            self._choose(sender, arrival_s)

    def _choose(self, sender: Sender, arrival_s: float) -> None:
        self.chosen = sender
        self._sequence = None
        self.parameters, self.changed = {}, {}
        self._velocity_s = self._fix_s = -inf
        self._chosen_s = arrival_s
        if len(self.systems) > 1:
            systems = " and ".join(map(str, self.systems))
            self._report(f"autopilots are systems {systems}; listening to {sender[0]} (--sysid chooses another)")

    def _attitude_has_timed_out(self, arrival_s: float) -> bool:
        """Return whether the chosen autopilot has never sent its attitude, although there was time for it."""
        return self.attitude_arrival_s is None and arrival_s - self._chosen_s > _ATTITUDE_TIMEOUT_S

    # --- messages -----------------------------------------------------------------------------------------------------

    def _boot_s(self, stamped_s: float, arrival_s: float) -> float | None:
        """Return the time since boot of a packet, s; None if it is from another clock."""
        boot, had_two_clocks = self.clock.boot, self.clock.has_two_clocks
        boot_s = self.clock.add_packet(stamped_s, arrival_s)
        if self.clock.boot != boot:
            restarted = (
                "the simulator was set to another time" if self.clock.is_vehicle_time else "the autopilot was restarted"
            )
            self._report(f"{restarted}; its clock begins again")
            self.history.begin_boot(self.clock.utc_minus_boot_before_s)
            if self.simulator is not None:
                self.simulator.begin_boot(self.clock.utc_minus_boot_before_s)
            self.gimbal.begin_boot(self.clock.utc_minus_boot_before_s)
            self._aligned = False
            self._discard_jump(arrival_s)
        if self.clock.has_two_clocks and not had_two_clocks and self.chosen is not None:
            self._report(f"two autopilots are system {self.chosen[0]}; listening to the first")
        return boot_s

    def _on_time(self, message: Any, arrival_s: float, *, is_chosen: bool) -> None:
        utc_s = message.time_unix_usec * 1e-6
        if is_chosen:
            self._rates[MessageId.SYSTEM_TIME].add(arrival_s)
            source, boot_s = self.clock.source, self._boot_s(message.time_boot_ms / 1000, arrival_s)
            before_s = self.clock.utc_minus_boot_s
            if boot_s is not None:
                self.clock.read_utc(boot_s, utc_s)
            after_s = self.clock.utc_minus_boot_s
            if source is None and self.clock.source is not None:
                self._report("UTC from SYSTEM_TIME")
            elif before_s is not None and after_s is not None and abs(after_s - before_s) > _UTC_STEP_S:
                self._report(f"UTC was set by {after_s - before_s:+.3f} s (SYSTEM_TIME); images follow the new one")
        else:
            self.clock.read_others_utc(utc_s, arrival_s)

    def _on_quaternion(self, message: Any, arrival_s: float) -> None:
        q_ned_body = np.array([message.q1, message.q2, message.q3, message.q4])
        # An estimator sends (1, 0, 0, 0) until it is aligned.
        self._aligned = self._aligned or bool((q_ned_body != (1.0, 0.0, 0.0, 0.0)).any())
        if self._aligned:
            self._add_attitude(
                MessageId.ATTITUDE_QUATERNION, message.time_boot_ms / 1000, conjugate(q_ned_body), arrival_s
            )

    def _on_euler(self, message: Any, arrival_s: float) -> None:
        q = quaternion_from_euler(message.roll, message.pitch, message.yaw)
        self._add_attitude(MessageId.ATTITUDE, message.time_boot_ms / 1000, q, arrival_s)

    def _on_hil_state(self, message: Any, arrival_s: float) -> None:
        if not message.time_usec:
            return  # of PX4's simulator, which states no time
        stamped_s = message.time_usec * 1e-6
        if is_utc := stamped_s >= YEAR_2010_S:
            # Some simulators send UTC instead of the time since boot: it is counted from the first packet.
            start_s = self.clock.utc_minus_boot_s if self._hil_utc_s is None else self._hil_utc_s
            self._hil_utc_s = floor(stamped_s) if start_s is None else start_s
            stamped_s -= self._hil_utc_s
        self._add_attitude(
            MessageId.HIL_STATE_QUATERNION, stamped_s, conjugate(np.array(message.attitude_quaternion)), arrival_s
        )
        latest_s = self.history.latest_boot_s
        if self._preferred() != MessageId.HIL_STATE_QUATERNION or latest_s is None:
            return
        if is_utc:
            self.clock.read_utc(stamped_s, message.time_usec * 1e-6)
        self._add_position(MessageId.HIL_STATE_QUATERNION, latest_s, message, every_s=POSITION_INTERVAL_S)

    def _add_attitude(self, number: int, stamped_s: float, q_body_ned: Any, arrival_s: float) -> None:
        self._rates[number].add(arrival_s)
        if number == MessageId.HIL_STATE_QUATERNION and self._preferred() != MessageId.HIL_STATE_QUATERNION:
            return  # its clock may be another one
        boot_s = self._boot_s(stamped_s, arrival_s)
        if boot_s is None or number != self._preferred() or not abs(np.linalg.norm(q_body_ned) - 1) < UNIT_TOLERANCE:
            return
        self.history.add_attitude(boot_s, q_body_ned)
        self.attitude_arrival_s = arrival_s
        if self.simulator is not None:
            self.simulator.pair(boot_s, arrival_s)
        self.gimbal.pair(self.sky_history.latest_boot_s, arrival_s)

    def _on_gimbal(self, packet: Packet, arrival_s: float) -> None:
        """Process the attitude of a gimbal, which a component of the autopilot's system sends."""
        if self.chosen is None or packet.sender[0] != self.chosen[0]:
            return
        try:
            message = self._decode(bytearray(packet.content))
        except self._decode_error:
            return
        boot_s = None
        if packet.sender == self.chosen and packet.number != MessageId.MOUNT_STATUS:
            boot_s = self._boot_s(message.time_boot_ms / 1000, arrival_s)
            if boot_s is None:
                return
        component, autopilot = packet.sender[1], self.chosen[1]
        number = MessageId(packet.number)
        self.gimbal.receive(number, message, arrival_s, component=component, autopilot=autopilot, boot_s=boot_s)

    def _preferred(self) -> MessageId:
        """Return the message from which attitude is read.

        ATTITUDE_QUATERNION, or ATTITUDE if it is more than twice as frequent; a simulator's own state if there is
        neither.
        """
        latest_s = max(rate.latest_s for rate in self._rates.values())
        angles_hz, quaternion_hz, hil_hz = (
            self.rate_hz(number, latest_s)
            for number in (MessageId.ATTITUDE, MessageId.ATTITUDE_QUATERNION, MessageId.HIL_STATE_QUATERNION)
        )
        if hil_hz and not angles_hz and not quaternion_hz:
            return MessageId.HIL_STATE_QUATERNION
        return MessageId.ATTITUDE if angles_hz > 2 * quaternion_hz else MessageId.ATTITUDE_QUATERNION

    def velocity(self, now_s: float) -> tuple[float, float, float] | None:
        """Return the velocity that the autopilot estimates, north, east, down, m/s; None without a recent one."""
        return self._velocity if now_s - self._velocity_s <= _VELOCITY_TIMEOUT_S else None

    def _on_parameter(self, message: Any, _: float) -> None:
        name = message.param_id
        if name in GPS_TYPES:
            if self.parameters.get(name, message.param_value) != message.param_value:
                self.changed[name] = self.clock.boot
            self.parameters[name] = message.param_value

    def _on_position(self, message: Any, arrival_s: float) -> None:
        self._rates[MessageId.GLOBAL_POSITION_INT].add(arrival_s)
        self.above_home_m = message.relative_alt / 1000
        self._velocity, self._velocity_s = (message.vx / 100, message.vy / 100, message.vz / 100), arrival_s
        self._position_messages.add(MessageId.GLOBAL_POSITION_INT)
        boot_s = self._boot_s(message.time_boot_ms / 1000, arrival_s)
        if boot_s is not None and (message.lat or message.lon):
            self._add_position(MessageId.GLOBAL_POSITION_INT, boot_s, message)

    def has_fix(self, now_s: float) -> bool:
        """Return whether its GNSS receiver had a 3D fix recently, by `time.monotonic`, s."""
        return now_s - self._fix_s <= _FIX_TIMEOUT_S

    def _on_fix(self, message: Any, arrival_s: float) -> None:
        self._fix_s = arrival_s if message.fix_type >= _FIX_3D else -inf
        # A position that is a second old suffices if there is no other.
        latest_s = self.history.latest_boot_s
        if message.fix_type >= _FIX_3D and not self.sends_position and latest_s is not None:
            self._add_position(MessageId.GPS_RAW_INT, latest_s, message)

    @property
    def sends_position(self) -> bool:
        """Whether GLOBAL_POSITION_INT was ever received."""
        return MessageId.GLOBAL_POSITION_INT in self._position_messages

    @property
    def position_source(self) -> str:
        """The message from which the position comes."""
        return next((message.name for message in _POSITIONS if message in self._position_messages), "GPS_RAW_INT")

    def _add_position(self, number: int, boot_s: float, message: Any, *, every_s: float = 0.0) -> None:
        self._position_messages.add(number)
        if abs(message.lat) <= 900_000_000 and abs(message.lon) <= 1_800_000_000:
            height_m = message.alt / 1e3
            if HEIGHTS_M[0] <= height_m <= HEIGHTS_M[1]:
                latitude_rad, longitude_rad = radians(message.lat / 1e7), radians(message.lon / 1e7)
                self.history.add_position(boot_s, latitude_rad, longitude_rad, height_m, every_s=every_s)
                if self.simulator is not None:
                    self.simulator.height_m = height_m

    def _on_ack(self, message: Any, _: float) -> None:
        if message.command == dialect().MAV_CMD_SET_MESSAGE_INTERVAL:
            self.ack = message.result
            self.acks.append(message.result)
        elif message.command == EXTERNAL_POSITION_ESTIMATE and message.result != self._position_ack:
            self._position_ack = message.result
            mavlink = dialect()
            name = mavlink.enums["MAV_RESULT"].get(message.result)
            if message.result == mavlink.MAV_RESULT_ACCEPTED:
                self._report("the autopilot accepts the positions")
            elif message.result == mavlink.MAV_RESULT_FAILED:
                self._report(
                    "the autopilot uses no position now: MAV_RESULT_FAILED is its usual answer while GNSS is in use, or"
                    " before its first position"
                )
            else:
                self._report(f"the autopilot rejects the positions: {message.result if name is None else name.name}")
