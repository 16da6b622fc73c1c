"""What the packets of a link tell: which autopilot, its attitude, its place, its clock."""

from collections import deque
from collections.abc import Callable
from math import floor, inf, radians
from typing import Any, Final

import numpy as np

from glstar.link.clock import BootClock
from glstar.link.framing import Packet
from glstar.link.history import History
from glstar.link.messages import (
    ATTITUDE,
    ATTITUDE_QUATERNION,
    COMMAND_ACK,
    GPS,
    HEARTBEAT,
    HIL_STATE,
    POSITION,
    SYSTEM_TIME,
    dialect,
)
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.site import HEIGHTS_M
from glstar.telemetry.validation import UNIT_TOLERANCE, YEAR_2010_S
from glstar.telemetry.vehicles import autopilot, vehicle_kind

__all__ = ["Receiver"]

Sender = tuple[int, int]

# What a ground station, a gimbal or a companion computer says in its heartbeat.
_NO_AUTOPILOT: Final = 8
# An autopilot that tells no attitude for so long gives way to one that does, s.
_MUTE_S: Final = 5.0
_FIX_3D: Final = 3
# After a data gap of this length a sender's sequence numbers say nothing about losses, s.
_SILENT_S: Final = 2.0
# UTC that is set by more than this is reported, s: 7 px at 1 deg/s and f = 3871 px.
_UTC_STEP_S: Final = 0.1
# From one position of a simulator to the next, s.
_HIL_PLACES_S: Final = 0.2
# A rate is counted over so many seconds.
_WINDOW_S: Final = 2.0
# More senders than this are no fleet but damage.
_MOST_SENDERS: Final = 64
_NAMES: Final = {
    ATTITUDE: "ATTITUDE",
    ATTITUDE_QUATERNION: "ATTITUDE_QUATERNION",
    HIL_STATE: "HIL_STATE_QUATERNION",
}
# Messages with a position; of several that come the one named first counts.
_PLACES: Final = {POSITION: "GLOBAL_POSITION_INT", HIL_STATE: "HIL_STATE_QUATERNION", GPS: "GPS_RAW_INT"}


class Receiver:
    """Listens to one autopilot among all that speak on a link.

    Parameters
    ----------
    clock : BootClock
    tell : callable
        Called with what happened, in words.
    sysid : int, optional
        The MAVLink system to listen to; by default the first autopilot heard.
    keep_s : float
        How much of the flight is remembered, s.

    Attributes
    ----------
    clock : BootClock
    history : History
    packets, lost : int
        How many came, and how many of all senders did not, by their sequence numbers.
    chosen : (int, int) or None
        System and component of the autopilot.
    attitude_arrival_s : float or None
        When its newest attitude came, by the computer's steady clock.
    ack : int or None
        Its last answer to a request for an interval: a MAV_RESULT.
    """

    def __init__(
        self, clock: BootClock, tell: Callable[[str], None], *, sysid: int | None = None, keep_s: float = 600.0
    ) -> None:
        self.clock, self.history = clock, History(keep_s)
        self.packets = self.lost = 0
        self.chosen: Sender | None = None
        self.attitude_arrival_s: float | None = None
        self.ack: int | None = None
        self._tell, self._sysid = tell, sysid
        mavlink = dialect()
        self._decode: Callable[[bytearray], Any] = mavlink.MAVLink(None).decode
        self._refusal: type[Exception] = mavlink.MAVError
        self._vehicles: dict[Sender, str | None] = {}
        self._chosen_s = 0.0
        # Of each sender the newest sequence number with its arrival, and the last jump of the numbers with its own.
        self._sequences: dict[Sender, tuple[int, float]] = {}
        self._jumps: dict[Sender, tuple[int, float]] = {}
        self._arrivals: dict[int, deque[float]] = {
            number: deque(maxlen=2048) for number in (*_NAMES, POSITION, SYSTEM_TIME)
        }
        # Messages that had a position; and the UTC from which a simulator's own clock is counted.
        self._told_position: set[int] = set()
        self._hil_utc_s: float | None = None
        self._hil_place_s = -inf
        # How the newest attitude of each kind began: with its time since boot.
        self._stamped: dict[int, bytes] = {}
        self._aligned = False
        self._handlers: dict[int, Callable[[Any, float], None]] = {
            ATTITUDE: self._hear_euler,
            ATTITUDE_QUATERNION: self._hear_quaternion,
            POSITION: self._hear_position,
            GPS: self._hear_fix,
            HIL_STATE: self._hear_hil_state,
            COMMAND_ACK: self._hear_ack,
        }

    def receive(self, packet: Packet, arrival_s: float) -> None:
        """Take in a packet.

        Parameters
        ----------
        packet : Packet
        arrival_s : float
            When it came, by the computer's steady clock, s.
        """
        self.packets += 1
        self._count_lost(packet, arrival_s)
        number, sender = packet.number, packet.sender
        theirs = sender == self.chosen
        if number not in {HEARTBEAT, SYSTEM_TIME} and not (theirs and number in self._handlers):
            return
        if number in _NAMES and self._stamped.get(number) == packet.begins:
            # Of attitudes that are stamped alike the first counts: who floods the link costs next to nothing.
            self._arrivals[number].append(arrival_s)
            return
        try:
            message = self._decode(bytearray(packet.content))
        except self._refusal:
            return
        if number in _NAMES:
            self._stamped[number] = packet.begins
        if number == HEARTBEAT:
            self._hear_heartbeat(message, sender, arrival_s)
        elif number == SYSTEM_TIME:
            self._hear_time(message, arrival_s, theirs=theirs)
        else:
            self._handlers[number](message, arrival_s)

    @property
    def vehicle(self) -> str | None:
        """What the autopilot is, in words."""
        return self._vehicles.get(self.chosen) if self.chosen is not None else None

    @property
    def systems(self) -> tuple[int, ...]:
        """The numbers of all autopilots that were heard."""
        return tuple(sorted({system for system, _ in self._vehicles}))

    @property
    def attitude_source(self) -> str:
        """Which message tells the attitude now."""
        return _NAMES[self._preferred()]

    def rate_hz(self, number: int, now_s: float) -> float:
        """Return how often a message of the autopilot came in the last two seconds, Hz.

        Parameters
        ----------
        number : int
            Of the message.
        now_s : float
            By the computer's steady clock, s.

        Returns
        -------
        float
        """
        arrivals = self._arrivals[number]
        while arrivals and arrivals[0] < now_s - _WINDOW_S:
            arrivals.popleft()
        return len(arrivals) / _WINDOW_S

    def attitude_rate_hz(self, now_s: float) -> float:
        """Return how often the attitude came in the last two seconds, Hz."""
        return max(self.rate_hz(number, now_s) for number in _NAMES)

    # --- senders ------------------------------------------------------------------------------------------------------

    def _count_lost(self, packet: Packet, arrival_s: float) -> None:
        heard = self._sequences.get(packet.sender)
        if heard is not None:
            before, before_s = heard
            missing = (packet.sequence - before - 1) % 256
            # Half of the circle or more: it came late.  After a data gap the numbers may have wrapped, or restarted.
            if missing < 128 and arrival_s - before_s < _SILENT_S:
                self.lost += missing
                if missing:
                    self._jumps[packet.sender] = missing, arrival_s
        elif len(self._sequences) >= _MOST_SENDERS:
            return
        self._sequences[packet.sender] = packet.sequence, arrival_s

    def _forgive_jump(self, arrival_s: float) -> None:
        """Count no packets of a restarted sender as lost: its sequence numbers have restarted."""
        missing, jumped_s = self._jumps.pop(self.chosen, (0, 0.0)) if self.chosen is not None else (0, 0.0)
        if arrival_s - jumped_s < _SILENT_S:
            self.lost -= missing

    def _hear_heartbeat(self, message: Any, sender: Sender, arrival_s: float) -> None:
        if message.autopilot == _NO_AUTOPILOT:
            return
        if sender not in self._vehicles:
            if len(self._vehicles) >= _MOST_SENDERS:
                return
            self._vehicles[sender] = autopilot(message.autopilot, vehicle_kind([message.type]))
            self._tell(f"system {sender[0]}: {self._vehicles[sender] or 'an autopilot'}")
        if self._sysid is not None and sender[0] != self._sysid:
            return
        if self.chosen is None:
            self._choose(sender, arrival_s)
        elif sender != self.chosen and self._is_mute(arrival_s):
            self._tell(f"system {self.chosen[0]} tells no attitude; listening to system {sender[0]}")
            self._choose(sender, arrival_s)

    def _choose(self, sender: Sender, arrival_s: float) -> None:
        self.chosen, self._chosen_s = sender, arrival_s
        if len(self.systems) > 1:
            told = " and ".join(map(str, self.systems))
            self._tell(f"autopilots are systems {told}; listening to {sender[0]} (--sysid chooses another)")

    def _is_mute(self, arrival_s: float) -> bool:
        """Return whether the chosen autopilot never told its attitude, for long enough."""
        return self.attitude_arrival_s is None and arrival_s - self._chosen_s > _MUTE_S

    # --- messages -----------------------------------------------------------------------------------------------------

    def _boot_s(self, stamped_s: float, arrival_s: float) -> float | None:
        """Return a packet's time since boot, s; None where it is not the autopilot's that is listened to."""
        boot, two = self.clock.boot, self.clock.two
        boot_s = self.clock.hear(stamped_s, arrival_s)
        if self.clock.boot != boot:
            self._tell("the autopilot was restarted; its clock begins anew")
            self.history.begin_boot(self.clock.utc_minus_boot_before_s)
            self._aligned = False
            self._forgive_jump(arrival_s)
        if self.clock.two and not two and self.chosen is not None:
            self._tell(f"two autopilots call themselves system {self.chosen[0]}; listening to the first")
        return boot_s

    def _hear_time(self, message: Any, arrival_s: float, *, theirs: bool) -> None:
        utc_s = message.time_unix_usec * 1e-6
        if theirs:
            self._arrivals[SYSTEM_TIME].append(arrival_s)
            source, boot_s = self.clock.source, self._boot_s(message.time_boot_ms / 1000, arrival_s)
            before_s = self.clock.utc_minus_boot_s
            if boot_s is not None:
                self.clock.read_utc(boot_s, utc_s)
            after_s = self.clock.utc_minus_boot_s
            if source is None and self.clock.source is not None:
                self._tell("UTC from SYSTEM_TIME")
            elif before_s is not None and after_s is not None and abs(after_s - before_s) > _UTC_STEP_S:
                self._tell(f"UTC was set by {after_s - before_s:+.3f} s (SYSTEM_TIME); images follow the new one")
        else:
            self.clock.read_others_utc(utc_s, arrival_s)

    def _hear_quaternion(self, message: Any, arrival_s: float) -> None:
        told = np.array([message.q1, message.q2, message.q3, message.q4])
        # An estimator sends (1, 0, 0, 0) until it has found out where down and north are.
        self._aligned = self._aligned or bool((told != (1.0, 0.0, 0.0, 0.0)).any())
        if self._aligned:
            self._add_attitude(ATTITUDE_QUATERNION, message.time_boot_ms / 1000, conjugate(told), arrival_s)

    def _hear_euler(self, message: Any, arrival_s: float) -> None:
        q = quaternion_from_euler(message.roll, message.pitch, message.yaw)
        self._add_attitude(ATTITUDE, message.time_boot_ms / 1000, q, arrival_s)

    def _hear_hil_state(self, message: Any, arrival_s: float) -> None:
        stamped_s = message.time_usec * 1e-6
        if is_utc := stamped_s >= YEAR_2010_S:
            # Simulators stamp with the time since boot, or with UTC: then it is counted from where it began.
            known_s = self.clock.utc_minus_boot_s if self._hil_utc_s is None else self._hil_utc_s
            self._hil_utc_s = floor(stamped_s) if known_s is None else known_s
            stamped_s -= self._hil_utc_s
        self._add_attitude(HIL_STATE, stamped_s, conjugate(np.array(message.attitude_quaternion)), arrival_s)
        newest_s = self.history.newest_boot_s
        if self._preferred() != HIL_STATE or newest_s is None:
            return
        if is_utc:
            self.clock.read_utc(stamped_s, message.time_usec * 1e-6)
        # It comes with every attitude, and the buffer is for positions that come five times a second.
        if not self._hil_place_s <= newest_s < self._hil_place_s + _HIL_PLACES_S:
            self._hil_place_s = newest_s
            self._add_position(HIL_STATE, newest_s, message)

    def _add_attitude(self, number: int, stamped_s: float, q_body_ned: Any, arrival_s: float) -> None:
        self._arrivals[number].append(arrival_s)
        if number == HIL_STATE and self._preferred() != HIL_STATE:
            return  # another clock, perhaps
        boot_s = self._boot_s(stamped_s, arrival_s)
        if boot_s is None or number != self._preferred() or not abs(np.linalg.norm(q_body_ned) - 1) < UNIT_TOLERANCE:
            return
        self.history.add_attitude(boot_s, q_body_ned)
        self.attitude_arrival_s = arrival_s

    def _preferred(self) -> int:
        """Return whose attitude counts: the quaternion's, unless the angles come more than twice as often.

        A simulator's own attitude counts where there is no other.
        """
        newest_s = max((arrivals[-1] for arrivals in self._arrivals.values() if arrivals), default=0.0)
        angles_hz, quaternion_hz, hil_hz = (
            self.rate_hz(number, newest_s) for number in (ATTITUDE, ATTITUDE_QUATERNION, HIL_STATE)
        )
        if hil_hz and not angles_hz and not quaternion_hz:
            return HIL_STATE
        return ATTITUDE if angles_hz > 2 * quaternion_hz else ATTITUDE_QUATERNION

    def _hear_position(self, message: Any, arrival_s: float) -> None:
        self._arrivals[POSITION].append(arrival_s)
        self._told_position.add(POSITION)
        boot_s = self._boot_s(message.time_boot_ms / 1000, arrival_s)
        if boot_s is not None and (message.lat or message.lon):
            self._add_position(POSITION, boot_s, message)

    def _hear_fix(self, message: Any, _: float) -> None:
        # A place a second old is near enough, where nobody tells a newer one.
        newest_s = self.history.newest_boot_s
        if message.fix_type >= _FIX_3D and not self.tells_position and newest_s is not None:
            self._add_position(GPS, newest_s, message)

    @property
    def tells_position(self) -> bool:
        """Whether GLOBAL_POSITION_INT ever came."""
        return POSITION in self._told_position

    @property
    def position_source(self) -> str:
        """The message from which the position comes."""
        return next((name for number, name in _PLACES.items() if number in self._told_position), _PLACES[GPS])

    def _add_position(self, number: int, boot_s: float, message: Any) -> None:
        self._told_position.add(number)
        if abs(message.lat) <= 900_000_000 and abs(message.lon) <= 1_800_000_000:
            place = radians(message.lat / 1e7), radians(message.lon / 1e7), message.alt / 1e3
            if HEIGHTS_M[0] <= place[2] <= HEIGHTS_M[1]:
                self.history.add_position(boot_s, *place)

    def _hear_ack(self, message: Any, _: float) -> None:
        if message.command == dialect().MAV_CMD_SET_MESSAGE_INTERVAL:
            self.ack = message.result
