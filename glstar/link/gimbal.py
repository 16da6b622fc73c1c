"""The attitude of the gimbal on an aircraft, from its messages on a link.

=============================  =====================================================================================
message                        time since boot of the autopilot
=============================  =====================================================================================
GIMBAL_DEVICE_ATTITUDE_STATUS  that of the message if the autopilot sends it; a gimbal has a clock of its own; the
packets with the smallest delay relate it to the autopilot's clock MOUNT_ORIENTATION              the same MOUNT_STATUS
that of its arrival, without the smallest delay of the link
=============================  =====================================================================================

The frames of reference and units are those of `glstar.telemetry.mavlink.vehicles`.
"""

from collections import deque
from math import inf
from typing import Any

import numpy as np

from glstar.arrays import Float
from glstar.link.clock import BootClock
from glstar.link.history import RowBuffer
from glstar.link.packets import GIMBAL_IDS, MessageId, MessageRate
from glstar.telemetry.mavlink.vehicles import gimbal_samples
from glstar.telemetry.source import GimbalSamples

# A worse message, or another gimbal, is used if the better one has not been received for this time, s.
_TIMEOUT_S = 2.0
# Largest numbers of attitudes: ten minutes at 50 Hz; and of those that wait for the aircraft's, ten seconds at 100 Hz.
_MOST, _MOST_PENDING = 30_000, 1000
_MAX_BOOTS = 8

# Of a message: its index in `GIMBAL_IDS`, whether it is not from the autopilot itself, and its component.
_Rank = tuple[int, bool, int]


class LinkGimbal:
    """The attitudes of the gimbal of the autopilot with a clock; they are kept for `keep_s`."""

    def __init__(self, clock: BootClock, keep_s: float) -> None:
        # Time since boot of the latest attitude that is not later than the aircraft's, s.
        self.latest_boot_s: float | None = None
        # When that attitude and the aircraft's were both known, by `time.monotonic`, s.
        self.arrival_s: float | None = None
        self._clock = clock
        self._keep_s = keep_s
        self._gimbal_clock = BootClock()
        self._used: _Rank | None = None
        # MAVLink's number of it: its component, or 1 to 6 of a gimbal for which the autopilot speaks; 0 if unknown.
        self.device = 0
        self._rate = MessageRate()
        # Columns: time since boot, s; the quaternion; whether the frame of reference is NED.
        self._rows = RowBuffer(6, _MOST, keep_s)
        self._pending: deque[tuple[float, ...]] = deque(maxlen=_MOST_PENDING)
        # The rows of previous boots, over UTC.
        self._past: deque[Float] = deque(maxlen=_MAX_BOOTS)

    @property
    def source(self) -> str | None:
        """The message that is used; None before the first one."""
        return None if self._used is None else GIMBAL_IDS[self._used[0]].name

    def rate_hz(self, now_s: float) -> float:
        """Return the rate of the message over the last two seconds, Hz, at a time by `time.monotonic`, s."""
        return self._rate.hz(now_s)

    def is_silent(self, now_s: float) -> bool:
        """Return whether there is no attitude of the last two seconds, at a time by `time.monotonic`, s."""
        return self.arrival_s is None or now_s - self.arrival_s > _TIMEOUT_S

    def receive(
        self, number: MessageId, message: Any, arrival_s: float, *, component: int, autopilot: int, boot_s: float | None
    ) -> None:
        """Process one of `GIMBAL_IDS`, which arrived at a time by `time.monotonic`, s.

        `component` sent it, `autopilot` is the component of the autopilot; `boot_s`: its time since boot of the
        autopilot, s; None if it has none.
        """
        rank = GIMBAL_IDS.index(number), component != autopilot, component
        is_worse = self._used is not None and rank > self._used
        if is_worse and arrival_s - self._rate.latest_s < _TIMEOUT_S:
            return
        if rank != self._used:
            self._used = rank
            self._gimbal_clock = BootClock()
            self._pending.clear()
        of_autopilot = getattr(message, "gimbal_device_id", 0) if component == autopilot else 0
        self.device = of_autopilot or component
        boot_s = self._boot_s(number, message, arrival_s) if boot_s is None else boot_s
        if boot_s is None:
            return
        self._rate.add(arrival_s)
        samples = gimbal_samples(number.name, np.array([boot_s]), _values(number, message))
        if samples.clock_s.size:
            self._pending.append((boot_s, *samples.q_gimbal_reference[0].tolist(), float(samples.is_earth[0])))

    def pair(self, aircraft_s: float | None, arrival_s: float) -> None:
        """Add the attitudes that are not later than the aircraft's: with a later one, no exposure can end.

        `aircraft_s`, `arrival_s`: time since boot of the aircraft's latest attitude, and its arrival by
        `time.monotonic`, s.
        """
        if aircraft_s is None:
            return
        pending, self._pending = self._pending, deque(maxlen=_MOST_PENDING)
        for row in pending:
            if row[0] > aircraft_s:
                self._pending.append(row)
            elif self.latest_boot_s is None or row[0] > self.latest_boot_s:
                self._rows.append(row)
                self.latest_boot_s, self.arrival_s = row[0], arrival_s

    def begin_boot(self, utc_minus_boot_s: float | None) -> None:
        """Begin a new boot of the autopilot; earlier attitudes are kept at their UTC, as by `History.begin_boot`."""
        rows = self._rows.latest(-inf)
        if utc_minus_boot_s is not None and len(rows):
            rows[:, 0] += utc_minus_boot_s
            kept = (past[past[:, 0] >= rows[-1, 0] - self._keep_s] for past in (*self._past, rows))
            self._past = deque((past for past in kept if len(past)), maxlen=_MAX_BOOTS)
        self._rows.clear()
        self._pending.clear()
        self.latest_boot_s = None

    def samples(self, utc_minus_boot_s: float, last_s: float = inf) -> GimbalSamples | None:
        """Return a copy of the attitudes over UTC, of at most the last `last_s`; None before the first of this boot."""
        if self.latest_boot_s is None or self.source is None:
            return None
        from_s = self.latest_boot_s - min(last_s, self._keep_s)
        boots = [self._rows.latest(from_s)]
        boots[0][:, 0] += utc_minus_boot_s
        for past in reversed(self._past):
            kept = past[past[:, 0] >= from_s + utc_minus_boot_s]
            # The clock was set back since then: the previous boot overlaps and is dropped.
            if not len(kept) or kept[-1, 0] >= boots[0][0, 0]:
                break
            boots.insert(0, kept)
        rows = np.concatenate(boots)
        return GimbalSamples(rows[:, 0], rows[:, 1:5], rows[:, 5] > 0, self.source)

    def _boot_s(self, number: MessageId, message: Any, arrival_s: float) -> float | None:
        """Return the time since boot of the autopilot at a message of another clock, s; None while it is unknown."""
        delayed_s = self._clock.host_minus_boot_s
        if delayed_s is None:
            return None
        if number == MessageId.MOUNT_STATUS:
            return arrival_s - delayed_s
        own_s = self._gimbal_clock.add_packet(message.time_boot_ms / 1000, arrival_s)
        own_delayed_s = self._gimbal_clock.host_minus_boot_s
        return None if own_s is None or own_delayed_s is None else own_s + own_delayed_s - delayed_s


def _values(number: MessageId, message: Any) -> Float:
    """Return the fields of a message as one row of `gimbal_samples`."""
    if number == MessageId.GIMBAL_DEVICE_ATTITUDE_STATUS:
        return np.array([[message.flags, *message.q]], dtype=np.float64)
    if number == MessageId.MOUNT_ORIENTATION:
        return np.array([[message.roll, message.pitch, message.yaw]])
    return np.array([[message.pointing_a, message.pointing_b, message.pointing_c]], dtype=np.float64)
