"""What glstar says on a link: heartbeats, and requests for the messages that it needs.  Nothing else, ever."""

from typing import Any, Final

from glstar.link.messages import ATTITUDE, ATTITUDE_QUATERNION, GPS, POSITION, SYSTEM_TIME, dialect
from glstar.link.receiver import Receiver

__all__ = ["Requests"]

# How ground stations number themselves; MAVLink keeps the component for programs beside them.
_SYSTEM, _COMPONENT = 255, 191
_HEARTBEAT_S: Final = 1.0
# How long to wait for what was asked for before asking again, s; after so many times, seldom.
_PATIENCE_S: Final = 2.0
_ROUNDS: Final = 8
_SELDOM_S: Final = 30.0
# An autopilot may round a rate down; below this share it was not granted.
_GRANTED: Final = 0.3
# Where the request was refused, what comes is not an answer to it, and less is borne.
_GRANTED_ELSEHOW: Final = 0.7
# So often is the quaternion asked for before the angles are, and the angles before the streams.
_TRIES: Final = 2

_OTHERS_HZ: Final = {POSITION: 5.0, SYSTEM_TIME: 2.0, GPS: 1.0}
# ArduPilot's streams: EXTENDED_STATUS, POSITION, EXTRA1 with the attitude, EXTRA3.
_STREAM_OF: Final = {GPS: 2, POSITION: 6, ATTITUDE: 10, SYSTEM_TIME: 12}


class Requests:
    """Asks one autopilot for what glstar needs until it comes.

    Parameters
    ----------
    rate_hz : float
        How often the attitude is wanted, Hz.
    """

    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self._mavlink = dialect()
        self._link = self._mavlink.MAVLink(None, srcSystem=_SYSTEM, srcComponent=_COMPONENT)
        self._heartbeat_s: float | None = None
        self.begin_anew()

    def begin_anew(self) -> None:
        """Ask for everything again: the link was opened, or the autopilot restarted."""
        self._rounds = 0
        self._asked_s: float | None = None
        self._asked: set[int] = set()

    def due(self, receiver: Receiver, now_s: float) -> list[bytes]:
        """Return the packets to be sent now.

        Parameters
        ----------
        receiver : Receiver
            Knows who the autopilot is and what comes from it.
        now_s : float
            By the computer's steady clock, s.

        Returns
        -------
        list of bytes
        """
        packets: list[bytes] = []
        if self._heartbeat_s is None or now_s - self._heartbeat_s >= _HEARTBEAT_S:
            self._heartbeat_s = now_s
            packets.append(self._packed(self._heartbeat()))
        wait_s = _PATIENCE_S if self._rounds < _ROUNDS else _SELDOM_S
        if receiver.chosen is not None and (self._asked_s is None or now_s - self._asked_s >= wait_s):
            self._asked_s = now_s
            packets += [self._packed(message) for message in self._wanted(receiver, now_s)]
        return packets

    def farewell(self, receiver: Receiver) -> list[bytes]:
        """Return the packets that give back the usual rates."""
        if receiver.chosen is None:
            return []
        return [self._packed(self._interval(receiver.chosen, number, 0.0)) for number in sorted(self._asked)]

    def _wanted(self, receiver: Receiver, now_s: float) -> list[Any]:
        assert receiver.chosen is not None
        lacking = {number: hz for number, hz in _OTHERS_HZ.items() if self._lacks(receiver, number, hz, now_s)}
        refused = receiver.ack not in {None, self._mavlink.MAV_RESULT_ACCEPTED}
        # A simulator's own attitude is no estimate: the autopilot's is requested beside it.
        attitude_hz = max(receiver.rate_hz(number, now_s) for number in (ATTITUDE, ATTITUDE_QUATERNION))
        if attitude_hz < (_GRANTED_ELSEHOW if refused else _GRANTED) * self.rate_hz:
            lacking[ATTITUDE_QUATERNION] = self.rate_hz
            if self._rounds >= _TRIES or refused:
                lacking[ATTITUDE] = self.rate_hz
        if not lacking:
            self._rounds = 0
            return []
        self._rounds += 1
        self._asked |= lacking.keys()
        asked = [self._interval(receiver.chosen, number, hz) for number, hz in lacking.items()]
        if self._rounds > 2 * _TRIES or receiver.ack == self._mavlink.MAV_RESULT_UNSUPPORTED:
            asked += [
                self._stream(receiver.chosen, _STREAM_OF[number], hz)
                for number, hz in lacking.items()
                if number in _STREAM_OF
            ]
        return asked

    def _lacks(self, receiver: Receiver, number: int, hz: float, now_s: float) -> bool:
        if number == GPS:
            return self._rounds > 0 and not receiver.tells_position
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
