"""The messages that glstar sends on a link of its own accord: heartbeats and requests for message rates."""

from typing import Any, Final

from glstar.link.messages import (
    ATTITUDE,
    ATTITUDE_QUATERNION,
    GIMBAL_DEVICE_STATUS,
    GPS,
    HIL_STATE,
    MOUNT_ORIENTATION,
    MOUNT_STATUS,
    POSITION,
    SIM_STATE,
    SIMSTATE,
    SYSTEM_TIME,
    dialect,
)
from glstar.link.receiver import Receiver

__all__ = ["Requests"]

# System of ground stations, and component MAV_COMP_ID_ONBOARD_COMPUTER for programs beside them.
_SYSTEM, _COMPONENT = 255, 191
_HEARTBEAT_S: Final = 1.0
# Interval between requests for missing messages, s; after this many rounds, the longer interval.
_REQUEST_TIMEOUT_S: Final = 2.0
_ROUNDS: Final = 8
_LONG_TIMEOUT_S: Final = 30.0
# A request was granted if at least this fraction of the rate is received; autopilots may round rates down.
_GRANTED: Final = 0.3
# The same if the autopilot has rejected requests: messages are then received for another reason.
_GRANTED_AFTER_REJECTION: Final = 0.7
# Number of requests for the quaternion before the Euler angles are requested too, and then the data streams.
_TRIES: Final = 2

_OTHERS_HZ: Final = {POSITION: 5.0, SYSTEM_TIME: 2.0, GPS: 1.0}
# The attitude of a gimbal is requested at this fraction of the aircraft's rate: both fit a radio.
_GIMBAL_FRACTION: Final = 0.5
# ArduPilot's data streams: EXTENDED_STATUS, POSITION, EXTRA1 with the attitude and a simulator's state, EXTRA3
# with the gimbal.
_STREAM_OF: Final = {GPS: 2, POSITION: 6, ATTITUDE: 10, SIM_STATE: 10, SYSTEM_TIME: 12, GIMBAL_DEVICE_STATUS: 12}


class Requests:
    """Requests messages from one autopilot until they are received.

    Parameters
    ----------
    rate_hz : float
        Requested rate of the attitude, Hz.
    wants_gimbal : bool
        Whether the attitude of a gimbal is requested as well.
    """

    def __init__(self, rate_hz: float, *, wants_gimbal: bool = False) -> None:
        self.rate_hz, self.wants_gimbal = rate_hz, wants_gimbal
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
        """Return the packets to be sent now.

        All messages are requested again if the autopilot was restarted, or another one is listened to; the one before
        gets its default rates.

        Parameters
        ----------
        receiver : Receiver
            Knows the autopilot and the rates of its messages.
        now_s : float
            Time by `time.monotonic`, s.

        Returns
        -------
        list of bytes
        """
        packets: list[bytes] = []
        served, self._served = self._served, (receiver, receiver.clock.boot)
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
        attitude_hz = max(receiver.rate_hz(number, now_s) for number in (ATTITUDE, ATTITUDE_QUATERNION))
        if attitude_hz < (_GRANTED_AFTER_REJECTION if rejected else _GRANTED) * self.rate_hz:
            missing[ATTITUDE_QUATERNION] = self.rate_hz
            if self._rounds >= _TRIES or rejected:
                missing[ATTITUDE] = self.rate_hz
        if receiver.simulator is not None and receiver.simulator.rate_hz(now_s) < _GRANTED * self.rate_hz:
            missing[SIM_STATE] = self.rate_hz
            if self._rounds >= _TRIES or rejected:
                missing |= {HIL_STATE: self.rate_hz, SIMSTATE: self.rate_hz}
        gimbal_hz = _GIMBAL_FRACTION * self.rate_hz
        if self.wants_gimbal and receiver.gimbal.rate_hz(now_s) < _GRANTED * gimbal_hz:
            missing[GIMBAL_DEVICE_STATUS] = gimbal_hz
            if self._rounds >= _TRIES or rejected:
                missing |= {MOUNT_ORIENTATION: gimbal_hz, MOUNT_STATUS: gimbal_hz}
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
        if number == GPS:
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
