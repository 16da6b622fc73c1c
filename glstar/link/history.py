"""The history of a link: the attitudes and positions of the last minutes, and their conversion to a flight.

`SimulatorState` is the true attitude and position that a simulator sends beside an autopilot's estimates:

====================  ===============================================================================================
message               holds
====================  ===============================================================================================
SIM_STATE             attitude, latitude, longitude and height, without a time
HIL_STATE_QUATERNION  the same; its time is that of the simulator and is not used
SIMSTATE              attitude, latitude and longitude, without a time; the height is that of GLOBAL_POSITION_INT
====================  ===============================================================================================

A state's time since boot follows from its arrival between two attitudes of the autopilot, which have a time.  It is the
time of the attitude before, plus the time between both arrivals, and at most the time of the attitude after.
"""

from collections import deque
from dataclasses import dataclass
from math import inf, radians
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.errors import TelemetryError
from glstar.flight import AttitudeTrack, Flight, PositionTrack, mean_rate_hz
from glstar.link.packets import MessageId, MessageRate
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.site import HEIGHTS_M
from glstar.telemetry.recording import DEFAULT_OPTIONS, FlightOptions
from glstar.telemetry.source import REBOOT, UNIT_TOLERANCE

# Largest numbers of attitudes and positions: ten minutes at 200 Hz and 20 Hz, 10 MB.
_MAX_ATTITUDES = 120_000
_MAX_POSITIONS = 12_000
# Largest number of previous boots.
_MAX_BOOTS = 8
# Initial capacity of a buffer, rows.
_INITIAL_ROWS = 4096


class RowBuffer:
    """A buffer with the latest rows of numbers.

    When space is needed, rows are dropped that exceed the largest number of rows, `most`, or whose first column differs
    from the latest row's by more than `span`.
    """

    def __init__(self, columns: int, most: int, span: float = np.inf) -> None:
        # Twice the capacity, so that the rows are rarely moved to the front.
        self._buffer = np.empty((min(_INITIAL_ROWS, 2 * most), columns))
        self._most = most
        self._span = span
        self._start = self._stop = 0

    def __len__(self) -> int:
        return self._stop - self._start

    def append(self, row: tuple[float, ...]) -> None:
        """Add a row, and drop the oldest if the buffer is full."""
        if self._stop == len(self._buffer):
            kept = self.latest(row[0] - self._span)
            if len(kept) > len(self._buffer) // 2:
                self._buffer = np.empty((min(2 * len(self._buffer), 2 * self._most), kept.shape[1]))
            self._start, self._stop = 0, len(kept)
            self._buffer[: self._stop] = kept
        self._buffer[self._stop] = row
        self._stop += 1
        self._start = max(self._start, self._stop - self._most)

    def replace_last(self, row: tuple[float, ...]) -> None:
        """Put a row in the place of the latest one."""
        self._buffer[self._stop - 1] = row

    def latest(self, first_column_from: float) -> Float:
        """Return a copy of the rows whose first column is not less than a number."""
        rows = self._buffer[self._start : self._stop]
        return rows[rows[:, 0] >= first_column_from].copy()

    def clear(self) -> None:
        """Remove all rows."""
        self._start = self._stop = 0


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an autopilot estimates over a flight."""

    attitude: AttitudeTrack
    position: PositionTrack | None  # None if it sends none
    attitude_source: str  # Message and rate of the attitude


@dataclass(frozen=True, slots=True)
class PastBoot:
    """The samples of a previous boot, by the UTC of that time."""

    attitudes: Float  # (n, 5) UTC seconds since 1970, and q_body_ned
    positions: Float  # (m, 4) UTC seconds since 1970, latitude and longitude, rad, and height, m

    def latest(self, first_utc_s: float) -> "PastBoot":
        """Return the attitudes from a time on, UTC seconds since 1970, and all positions."""
        return PastBoot(self.attitudes[self.attitudes[:, 0] >= first_utc_s], self.positions)


@dataclass(frozen=True, slots=True)
class HistorySnapshot:
    """A copy of a history, from which a flight is made while the history continues."""

    attitudes: Float  # (n, 5) time since boot, s, and q_body_ned, in the order of arrival
    positions: Float  # (m, 4) time since boot, s, latitude and longitude, rad, and height, m
    past: tuple[PastBoot, ...] = ()  # Previous boots, oldest first
    last_s: float = np.inf  # Largest duration of the flight up to the latest attitude, s

    def flight(
        self,
        utc_minus_boot_s: float,
        *,
        name: str,
        attitude_source: str,
        position_source: str,
        utc_source: str,
        options: FlightOptions = DEFAULT_OPTIONS,
    ) -> Flight | None:
        """Convert the samples to a flight; None if there are fewer than two attitudes, or no position.

        `options` are used without `utc_start`.
        """
        estimate = self.estimate(utc_minus_boot_s, attitude_source=attitude_source, options=options)
        site = options.site
        if estimate is None or (site is None and estimate.position is None):
            return None
        position = estimate.position if site is None else PositionTrack.fixed(site)
        assert position is not None
        return Flight(
            attitude=estimate.attitude,
            position=position,
            name=name,
            attitude_source=estimate.attitude_source,
            position_source=position_source,
            utc_source=utc_source,
            time_offset_s=options.time_offset_s,
        )

    def estimate(
        self, utc_minus_boot_s: float, *, attitude_source: str, options: FlightOptions = DEFAULT_OPTIONS
    ) -> Estimate | None:
        """Convert the samples to tracks over UTC; None if there are fewer than two attitudes.

        `options` are used without `utc_start`.
        """
        boots = self._boots(utc_minus_boot_s)
        attitudes, positions = (np.concatenate(rows) for rows in zip(*boots, strict=True))
        if not len(self.attitudes):
            return None
        try:
            attitude = AttitudeTrack.from_samples(
                attitudes[:, 0],
                attitudes[:, 1:],
                segment=np.repeat(np.arange(len(boots)), [len(rows) for rows, _ in boots]),
                break_reason=REBOOT,
                max_gap_s=options.max_gap_s,
                interpolation=options.interpolation,
            )
        except TelemetryError:
            return None
        position = PositionTrack.from_samples(*positions.T) if len(positions) else None
        return Estimate(attitude, position, f"{attitude_source}, {mean_rate_hz(attitude.utc_s):.1f} Hz")

    def _boots(self, utc_minus_boot_s: float) -> list[tuple[Float, Float]]:
        """Return attitudes and positions of each boot over UTC, oldest first."""
        shift = np.array([utc_minus_boot_s, 0.0, 0.0, 0.0, 0.0])
        boots = [(self.attitudes + shift, self.positions + shift[:4])]
        times_s = boots[0][0][:, 0]
        if not times_s.size:
            return boots
        first_utc_s, before_s = float(times_s.max()) - self.last_s, float(times_s.min())
        for past in reversed(self.past):
            kept = past.latest(first_utc_s)
            # The clock was set back since then: the previous boot overlaps and is dropped.
            if not len(kept.attitudes) or kept.attitudes[:, 0].max() >= before_s:
                break
            boots.insert(0, (kept.attitudes, kept.positions))
            before_s = float(kept.attitudes[:, 0].min())
        return boots


class History:
    """The last `keep_s` of one autopilot, over its reboots; less for attitudes at more than 200 Hz."""

    def __init__(self, keep_s: float = 600.0) -> None:
        self._keep_s = keep_s
        # Columns: time since boot, s; then the quaternion, or latitude and longitude, rad, and height, m.
        self._attitudes = RowBuffer(5, _MAX_ATTITUDES, keep_s)
        self._positions = RowBuffer(4, _MAX_POSITIONS, keep_s)
        self._latest_boot_s: float | None = None
        # Time since boot of the latest position that stays, s, and whether a later one follows it.
        self._kept_s = -inf
        self._has_later = False
        self._past: deque[PastBoot] = deque(maxlen=_MAX_BOOTS)

    def add_attitude(self, boot_s: float, q_body_ned: Float) -> None:
        """Add an attitude, (4,) q_body_ned, at a time since boot, s."""
        self._attitudes.append((boot_s, *q_body_ned))
        self._latest_boot_s = boot_s if self._latest_boot_s is None else max(boot_s, self._latest_boot_s)

    def add_position(
        self, boot_s: float, latitude_rad: float, longitude_rad: float, height_m: float, *, every_s: float = 0.0
    ) -> None:
        """Add a position at a time since boot, s.

        Of positions that follow each other sooner than `every_s` one is kept in this time, and the latest one, so that
        an exposure that has just ended has the position of its end.
        """
        add = self._positions.replace_last if self._has_later else self._positions.append
        add((boot_s, latitude_rad, longitude_rad, height_m))
        self._has_later = boot_s - self._kept_s < every_s
        if not self._has_later:
            self._kept_s = boot_s

    @property
    def latest_boot_s(self) -> float | None:
        """Time since boot of the latest attitude, s; None if there is none."""
        return self._latest_boot_s

    @property
    def has_position(self) -> bool:
        """Whether a position was received, in this boot or before."""
        return bool(len(self._positions)) or any(len(past.positions) for past in self._past)

    def begin_boot(self, utc_minus_boot_s: float | None) -> None:
        """Begin a new boot; samples from before the reboot are kept at their UTC.

        `utc_minus_boot_s`: UTC minus the time since the boot that has ended, s; None if unknown: its samples are then
        dropped.
        """
        if utc_minus_boot_s is not None and self._latest_boot_s is not None:
            first_utc_s = self._latest_boot_s + utc_minus_boot_s - self._keep_s
            shift = np.array([utc_minus_boot_s, 0.0, 0.0, 0.0, 0.0])
            ended = PastBoot(self._attitudes.latest(-np.inf) + shift, self._positions.latest(-np.inf) + shift[:4])
            kept = [past for past in (*self._past, ended) if (past.attitudes[:, 0] >= first_utc_s).any()]
            self._past = deque((past.latest(first_utc_s) for past in kept), maxlen=_MAX_BOOTS)
        self._attitudes.clear()
        self._latest_boot_s = None
        self._positions.clear()
        self._kept_s, self._has_later = -inf, False

    def snapshot(self, last_s: float = np.inf) -> HistorySnapshot:
        """Return a copy of the attitudes of at most the last `last_s`, and of all positions."""
        last_s = min(last_s, self._keep_s)
        from_s = -np.inf if self._latest_boot_s is None else self._latest_boot_s - last_s
        positions = self._positions.latest(-np.inf)
        return HistorySnapshot(self._attitudes.latest(from_s), positions, tuple(self._past), last_s)


# The best one first: of several, only the first is used.
SIMULATOR_MESSAGES = (MessageId.SIM_STATE, MessageId.HIL_STATE_QUATERNION, MessageId.SIMSTATE)
SIMULATOR_NAMES = " or ".join(", ".join(message.name for message in SIMULATOR_MESSAGES).rsplit(", ", 1))
# Another message is used if the better one has not been received for this time, s.
_TIMEOUT_S = 2.0
# Interval between positions of a simulator, s, of which every packet has one.
POSITION_INTERVAL_S = 0.2
# States that wait for the attitude after them: ten seconds at 100 Hz.
_MOST_PENDING = 1000
_DEGREES = 1e-7

_Position = tuple[float, float, float]


class SimulatorState:
    """The truth of the last `keep_s` of one simulated autopilot."""

    def __init__(self, keep_s: float, *, is_vehicle_time: bool = False) -> None:
        self.history = History(keep_s)
        self._is_vehicle_time = is_vehicle_time
        self._fraction = 1.0
        # Height of the autopilot's latest position, for SIMSTATE, m.
        self.height_m: float | None = None
        self._message: MessageId | None = None
        self._rate = MessageRate()
        # Arrival, s, attitude and position of the states since the latest attitude of the autopilot.
        self._pending: deque[tuple[float, Float, _Position | None]] = deque(maxlen=_MOST_PENDING)
        # Time since boot, s, and arrival, s, of the latest attitude of the autopilot.
        self._paired: tuple[float, float] | None = None

    @property
    def source(self) -> str | None:
        """The message that is used; None before the first one."""
        return None if self._message is None else self._message.name

    @property
    def position_source(self) -> str | None:
        """Where the position comes from."""
        if self._message != MessageId.SIMSTATE:
            return self.source
        return "SIMSTATE, height 0 m" if self.height_m is None else "SIMSTATE, height of GLOBAL_POSITION_INT"

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of the message over the last two seconds, Hz, at a time by `time.monotonic`, s."""
        return self._rate.hz(now_s)

    def receive(self, number: MessageId, message: Any, arrival_s: float) -> None:
        """Process one of `SIMULATOR_MESSAGES`, which arrived at a time by `time.monotonic`, s."""
        order = SIMULATOR_MESSAGES
        is_worse = self._message is not None and order.index(number) > order.index(self._message)
        if is_worse and arrival_s - self._rate.latest_s < _TIMEOUT_S:
            return
        if number != self._message:
            self._pending.clear()
        self._message = number
        self._rate.add(arrival_s)
        q_body_ned = _attitude(number, message)
        if abs(np.linalg.norm(q_body_ned) - 1) < UNIT_TOLERANCE:
            self._pending.append((arrival_s, q_body_ned, self._position(number, message)))

    def pair(self, boot_s: float, arrival_s: float) -> None:
        """Give the states since the previous attitude of the autopilot their time since boot.

        `boot_s`, `arrival_s`: time since boot of the autopilot's latest attitude, and its arrival by `time.monotonic`,
        s.
        """
        before = self._paired
        if before is not None and boot_s <= before[0]:
            return
        self._paired = boot_s, arrival_s
        pending, self._pending = self._pending, deque(maxlen=_MOST_PENDING)
        if before is None:
            return
        for state_s, q_body_ned, position in pending:
            passed_s = state_s - before[1]
            if self._is_vehicle_time:
                passed_s = (boot_s - before[0]) * self._fraction_of(passed_s, arrival_s - before[1])
            at_s = min(max(before[0] + passed_s, before[0]), boot_s)
            if before[1] < state_s == arrival_s:
                at_s = boot_s  # one read of the link: the two were sent together
            latest_s = self.history.latest_boot_s
            if latest_s is not None and at_s <= latest_s:
                continue
            self.history.add_attitude(at_s, q_body_ned)
            if position is not None:
                self.history.add_position(at_s, *position, every_s=POSITION_INTERVAL_S)

    def _fraction_of(self, passed_s: float, all_s: float) -> float:
        """Return where between two attitudes a state is by its arrival, 0 to 1.

        A clock of another rate has the same fractions.  Packets that are read together have no times of their own, but
        the latest fraction.
        """
        if all_s > 0:
            self._fraction = min(max(passed_s / all_s, 0.0), 1.0)
        return self._fraction

    def begin_boot(self, utc_minus_boot_s: float | None) -> None:
        """Begin a new boot, as `History.begin_boot`."""
        self.history.begin_boot(utc_minus_boot_s)
        self._pending.clear()
        self._paired = None

    def _position(self, number: int, message: Any) -> _Position | None:
        """Return latitude and longitude, rad, and height, m; None if they are not valid."""
        if number == MessageId.SIMSTATE:
            latitude_deg, longitude_deg = message.lat * _DEGREES, message.lng * _DEGREES
            height_m = 0.0 if self.height_m is None else self.height_m
        elif number == MessageId.HIL_STATE_QUATERNION:
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
    if number == MessageId.HIL_STATE_QUATERNION:
        return conjugate(np.array(message.attitude_quaternion, dtype=np.float64))
    if number == MessageId.SIM_STATE and any((message.q1, message.q2, message.q3, message.q4)):
        return conjugate(np.array([message.q1, message.q2, message.q3, message.q4]))
    return quaternion_from_euler(message.roll, message.pitch, message.yaw)


def _sim_state_degrees(message: Any) -> tuple[float, float]:
    """Return latitude and longitude, deg: the integers of newer senders, or floats in degrees or 1e-7 degrees."""
    if message.lat_int or message.lon_int:
        return message.lat_int * _DEGREES, message.lon_int * _DEGREES
    if abs(message.lat) > 90 or abs(message.lon) > 180:
        return message.lat * _DEGREES, message.lon * _DEGREES
    return message.lat, message.lon
