"""The true attitude and position that a simulator sends beside an autopilot's estimates.

====================  ===============================================================================================
message               holds
====================  ===============================================================================================
SIM_STATE             attitude, latitude, longitude and height, without a time
HIL_STATE_QUATERNION  the same; its time is that of the simulator and is not used
SIMSTATE              attitude, latitude and longitude, without a time; the height is that of GLOBAL_POSITION_INT
====================  ===============================================================================================

Their time since boot is that of their arrival between two attitudes of the autopilot, which have a time: the time of
the attitude before, plus the time between the two arrivals, and at most the time of the attitude after.
"""

from collections import deque
from math import inf, radians
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.link.history import History
from glstar.link.messages import HIL_STATE, SIM_STATE, SIMSTATE
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.site import HEIGHTS_M
from glstar.telemetry.samplevalidation import UNIT_TOLERANCE

__all__ = ["SIMULATOR_MESSAGES", "SIMULATOR_NAMES", "SimulatorState"]

Float = NDArray[np.float64]

# The best one first: of several, only the first is used.
SIMULATOR_MESSAGES: Final = {SIM_STATE: "SIM_STATE", HIL_STATE: "HIL_STATE_QUATERNION", SIMSTATE: "SIMSTATE"}
SIMULATOR_NAMES: Final = " or ".join(", ".join(SIMULATOR_MESSAGES.values()).rsplit(", ", 1))
# Another message is used if the better one has not been received for this time, s.
_TIMEOUT_S: Final = 2.0
# Window in which the rate is counted, s.
_WINDOW_S: Final = 2.0
# Interval between positions, s.
_POSITION_INTERVAL_S: Final = 0.2
# States that wait for the attitude after them: ten seconds at 100 Hz.
_MOST_PENDING: Final = 1000
_DEGREES: Final = 1e-7

_Position = tuple[float, float, float]


class SimulatorState:
    """The truth of one simulated autopilot.

    Parameters
    ----------
    keep_s : float
        Duration of the history, s.

    Attributes
    ----------
    history : History
    height_m : float or None
        Height of the autopilot's latest position, for SIMSTATE, m.
    """

    def __init__(self, keep_s: float) -> None:
        self.history = History(keep_s)
        self.height_m: float | None = None
        self._number: int | None = None
        self._arrivals: deque[float] = deque(maxlen=2048)
        # Arrival, s, attitude and position of the states since the latest attitude of the autopilot.
        self._pending: deque[tuple[float, Float, _Position | None]] = deque(maxlen=_MOST_PENDING)
        # Time since boot, s, and arrival, s, of the latest attitude of the autopilot.
        self._paired: tuple[float, float] | None = None
        self._position_s = -inf

    @property
    def source(self) -> str | None:
        """The message that is used; None before the first one."""
        return None if self._number is None else SIMULATOR_MESSAGES[self._number]

    @property
    def position_source(self) -> str | None:
        """Where the position comes from."""
        if self._number != SIMSTATE:
            return self.source
        return "SIMSTATE, height 0 m" if self.height_m is None else "SIMSTATE, height of GLOBAL_POSITION_INT"

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of the message over the last two seconds, Hz.

        Parameters
        ----------
        now_s : float
            Time by `time.monotonic`, s.
        """
        while self._arrivals and self._arrivals[0] < now_s - _WINDOW_S:
            self._arrivals.popleft()
        return len(self._arrivals) / _WINDOW_S

    def receive(self, number: int, message: Any, arrival_s: float) -> None:
        """Process a message of the simulator.

        Parameters
        ----------
        number : int
            One of `SIMULATOR_MESSAGES`.
        message : pymavlink message
        arrival_s : float
            Arrival by `time.monotonic`, s.
        """
        order = list(SIMULATOR_MESSAGES)
        is_worse = self._number is not None and order.index(number) > order.index(self._number)
        if is_worse and self._arrivals and arrival_s - self._arrivals[-1] < _TIMEOUT_S:
            return
        if number != self._number:
            self._pending.clear()
        self._number = number
        self._arrivals.append(arrival_s)
        q_body_ned = _attitude(number, message)
        if abs(np.linalg.norm(q_body_ned) - 1) < UNIT_TOLERANCE:
            self._pending.append((arrival_s, q_body_ned, self._position(number, message)))

    def pair(self, boot_s: float, arrival_s: float) -> None:
        """Give the states since the previous attitude of the autopilot their time since boot.

        Parameters
        ----------
        boot_s : float
            Time since boot of the autopilot's latest attitude, s.
        arrival_s : float
            Its arrival by `time.monotonic`, s.
        """
        before = self._paired
        if before is not None and boot_s <= before[0]:
            return
        self._paired = boot_s, arrival_s
        pending, self._pending = self._pending, deque(maxlen=_MOST_PENDING)
        if before is None:
            return
        for state_s, q_body_ned, position in pending:
            at_s = min(max(before[0] + state_s - before[1], before[0]), boot_s)
            if before[1] < state_s == arrival_s:
                at_s = boot_s  # one read of the link: the two were sent together
            latest_s = self.history.latest_boot_s
            if latest_s is not None and at_s <= latest_s:
                continue
            self.history.add_attitude(at_s, q_body_ned)
            if position is not None and at_s - self._position_s >= _POSITION_INTERVAL_S:
                self._position_s = at_s
                self.history.add_position(at_s, *position)

    def begin_boot(self, utc_minus_boot_s: float | None) -> None:
        """Begin a new boot, as `History.begin_boot`.

        Parameters
        ----------
        utc_minus_boot_s : float or None
            UTC minus the time since the boot that has ended, s.
        """
        self.history.begin_boot(utc_minus_boot_s)
        self._pending.clear()
        self._paired, self._position_s = None, -inf

    def _position(self, number: int, message: Any) -> _Position | None:
        """Return latitude and longitude, rad, and height, m; None if they are not valid."""
        if number == SIMSTATE:
            latitude_deg, longitude_deg = message.lat * _DEGREES, message.lng * _DEGREES
            height_m = 0.0 if self.height_m is None else self.height_m
        elif number == HIL_STATE:
            latitude_deg, longitude_deg, height_m = message.lat * _DEGREES, message.lon * _DEGREES, message.alt / 1e3
        else:
            (latitude_deg, longitude_deg), height_m = _sim_state_degrees(message), message.alt
        if not (latitude_deg or longitude_deg) or not (abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180):
            return None
        if not HEIGHTS_M[0] <= height_m <= HEIGHTS_M[1]:
            return None
        return radians(latitude_deg), radians(longitude_deg), height_m


def _attitude(number: int, message: Any) -> Float:
    """Return q_body_ned; the quaternions of the messages are from body to NED."""
    if number == HIL_STATE:
        return conjugate(np.array(message.attitude_quaternion, dtype=np.float64))
    if number == SIM_STATE and any((message.q1, message.q2, message.q3, message.q4)):
        return conjugate(np.array([message.q1, message.q2, message.q3, message.q4]))
    return quaternion_from_euler(message.roll, message.pitch, message.yaw)


def _sim_state_degrees(message: Any) -> tuple[float, float]:
    """Return latitude and longitude, deg: the integers of newer senders, or floats in degrees or 1e-7 degrees."""
    if message.lat_int or message.lon_int:
        return message.lat_int * _DEGREES, message.lon_int * _DEGREES
    if abs(message.lat) > 90 or abs(message.lon) > 180:
        return message.lat * _DEGREES, message.lon * _DEGREES
    return message.lat, message.lon
