"""Conversion of an autopilot's time since boot to UTC.

SYSTEM_TIME contains both; the median difference of recent packets is used, which does not depend on delays of the link.
If the autopilot does not know UTC, the computer's clock is used: the packet with the smallest delay determines the
difference between the two clocks.
"""

from collections import deque
from math import inf
from statistics import median

from glstar.link.status import LatestAttitude
from glstar.telemetry.source import YEAR_2010_S, YEAR_2100_S

# UTC source if UTC is not from the link.
COMPUTER_CLOCK = "the computer's clock"

# Number of readings in the median: half a minute, in which the clock of an autopilot drifts by a millisecond.
_READINGS = 31
# The autopilot has set its clock if this many latest readings agree within this time, s, but differ from the median.
_NEW_READINGS = 5
_AGREEMENT_S = 0.05
# A simulator has set its UTC if that steps by more between two readings, s, and then agrees; PX4 states the computer's
# UTC, which moves away from the time since boot of a simulation of another speed.
_SET_S = 0.5

# The smallest delay is taken over this many windows of this length, s: long enough for a packet without delay.
_WINDOWS = 6
_WINDOW_S = 10.0

# A time since boot that steps back by more, or advances by more than the time between arrivals plus this, belongs to
# another boot or another vehicle with the same system number, s; packets overtake each other by less.
_REBOOT_S = 5.0
# It is a reboot if the previous clock has not been received for this time, s.
_REBOOT_TIMEOUT_S = 0.5
# There are two vehicles if both clocks are received for this time, s.
_TWO_CLOCKS_S = 2.0
# A simulator has stepped back by more than packets overtake each other, or ahead by more than a gap in its data, s.
_REWIND_S, _JUMP_S = 0.5, 60.0
# time_boot_ms has 32 bits: 49.7 days.
_WRAP_S = 2**32 / 1000


class BootClock:
    """The clock of one autopilot, from boot to boot.

    `utc_minus_host_s`, UTC minus `time.monotonic`, s, is used if the autopilot has no UTC; `host_source` names it in
    messages.  `start_utc_s`, UTC of the first packet with a time since boot, seconds since 1970, replaces the UTC of
    the autopilot.  `is_vehicle_time`: whether only the vehicle's own clock counts, as of a simulator that is
    faster than the computer's, paused, or set back; see `_has_jumped`.  UTC then counts from the first SYSTEM_TIME of
    a boot.
    """

    def __init__(
        self,
        *,
        is_vehicle_time: bool = False,
        utc_minus_host_s: float | None = None,
        host_source: str = COMPUTER_CLOCK,
        start_utc_s: float | None = None,
    ) -> None:
        self._utc_minus_host_s = utc_minus_host_s
        self._host_source = host_source
        self._start_utc_s = start_utc_s
        self._overrides = start_utc_s is not None
        self.is_vehicle_time = is_vehicle_time
        # Time since boot of a packet that is not from the time before, s.
        self._jumped_s: float | None = None
        # Number of the boot, from 0.
        self.boot = 0
        # UTC minus the time since the previous boot, s, at the end of that boot; None if unknown.
        self.utc_minus_boot_before_s: float | None = None
        # Whether times of two clocks are received, as from two autopilots with one system number; the first is used.
        self.has_two_clocks = False
        self._wraps = 0
        self._latest_s: float | None = None
        self._arrival_s = 0.0
        # Arrival of the first packet of another clock.
        self._other_clock_s: float | None = None
        # UTC minus time since boot, by SYSTEM_TIME of the autopilot.
        self._read_s: deque[float] = deque(maxlen=_READINGS)
        # If only the vehicle's clock counts: the latest reading, and those since a step away from the others.
        self._last_read_s = -inf
        self._set_s: list[float] = []
        # Start of each window, and smallest difference of arrival and time since boot in it.
        self._smallest_delay_s: deque[tuple[float, float]] = deque(maxlen=_WINDOWS)
        # UTC minus time since boot, if it is not from the link and only the vehicle's clock counts.
        self._utc_minus_boot_s: float | None = None
        # UTC minus the computer's clock, by SYSTEM_TIME of other systems.
        self._others_s: deque[float] = deque(maxlen=_READINGS)

    def use_computer_clock(self, utc_minus_host_s: float) -> None:
        """Use the computer's clock, UTC minus `time.monotonic`, s, if the autopilot has no UTC."""
        if not self._overrides:
            self._utc_minus_host_s = utc_minus_host_s
            self._host_source = COMPUTER_CLOCK

    def add_packet(self, boot_s: float, arrival_s: float) -> float | None:
        """Add the time since boot and the arrival by `time.monotonic` of a packet, s.

        Returns the time since boot, continued beyond 49.7 days; None if it is from another clock while the previous one
        is still received.
        """
        unwrapped_s = boot_s + self._wraps * _WRAP_S
        if self.is_vehicle_time:
            if self._latest_s is not None and not self._has_jumped(boot_s):
                return None
        elif self._latest_s is not None:
            elapsed_s = arrival_s - self._arrival_s
            if unwrapped_s + _WRAP_S < self._latest_s + elapsed_s + _REBOOT_S:
                self._wraps += 1
                unwrapped_s += _WRAP_S
            if not -_REBOOT_S <= unwrapped_s - self._latest_s <= elapsed_s + _REBOOT_S:
                if elapsed_s < _REBOOT_TIMEOUT_S:
                    self._other_clock_s = arrival_s if self._other_clock_s is None else self._other_clock_s
                    self.has_two_clocks |= arrival_s - self._other_clock_s > _TWO_CLOCKS_S
                    return None
                self._begin_boot()
                unwrapped_s = boot_s
        self._arrival_s = arrival_s
        if self.is_vehicle_time:
            self._smallest_delay_s.clear()  # the computer's clock has another rate: the latest packet alone counts
        self._latest_s = unwrapped_s if self._latest_s is None else max(unwrapped_s, self._latest_s)
        if self._start_utc_s is not None:
            self._utc_minus_host_s = self._start_utc_s - arrival_s
            self._start_utc_s = None
        self._add_delay(arrival_s - unwrapped_s, arrival_s)
        if self.is_vehicle_time and self._utc_minus_boot_s is None and self._utc_minus_host_s is not None:
            self._utc_minus_boot_s = arrival_s - unwrapped_s + self._utc_minus_host_s
        return unwrapped_s

    def _has_jumped(self, boot_s: float) -> bool:
        """Begin another boot at the second of two packets that agree on another time; return whether a packet counts.

        A packet that was delayed for long is alone with its time.
        """
        assert self._latest_s is not None
        if -_REWIND_S <= boot_s - self._latest_s <= _JUMP_S:
            self._jumped_s = None
            return True
        before_s, self._jumped_s = self._jumped_s, boot_s
        if before_s is None or not -_REWIND_S <= boot_s - before_s <= _JUMP_S:
            return False
        self._jumped_s = None
        self._begin_boot()
        return True

    def now(self, host_s: float) -> tuple[float | None, float]:
        """Return UTC, s since 1970, and the time since boot, s, at a time by `time.monotonic`, s.

        UTC is None if it is unknown.  The time of a vehicle stands still between its packets if only its clock counts.
        """
        host_s = min(host_s, self._arrival_s) if self.is_vehicle_time else host_s
        boot_s = 0.0 if self.host_minus_boot_s is None else max(host_s - self.host_minus_boot_s, 0.0)
        utc_minus_host_s = self.utc_minus_host_s
        return None if utc_minus_host_s is None else host_s + utc_minus_host_s, boot_s

    def read_utc(self, boot_s: float, utc_s: float) -> None:
        """Add a reading of UTC, seconds since 1970, at a time since boot without wraps, s.

        Invalid readings, such as 0 before a GPS fix, are ignored.
        """
        if not YEAR_2010_S <= utc_s < YEAR_2100_S:
            return
        if self.is_vehicle_time:
            self._read_first_utc(utc_s - boot_s)
            return
        self._read_s.append(utc_s - boot_s)
        latest = list(self._read_s)[-_NEW_READINGS:]
        if abs(median(latest) - median(self._read_s)) > _AGREEMENT_S and max(latest) - min(latest) < _AGREEMENT_S:
            self._read_s = deque(latest, maxlen=_READINGS)

    def _read_first_utc(self, utc_minus_boot_s: float) -> None:
        """Add a reading of UTC minus time since boot, s, whose first values count until UTC is set."""
        is_step = abs(utc_minus_boot_s - self._last_read_s) > _SET_S
        self._last_read_s = utc_minus_boot_s
        if not self._read_s or abs(utc_minus_boot_s - median(self._read_s)) < _AGREEMENT_S:
            if len(self._read_s) < _READINGS:
                self._read_s.append(utc_minus_boot_s)
            self._set_s = []
        elif is_step:
            self._set_s = [utc_minus_boot_s]
        elif self._set_s and abs(utc_minus_boot_s - self._set_s[0]) < _AGREEMENT_S:
            self._set_s.append(utc_minus_boot_s)
        else:
            self._set_s = []
        if len(self._set_s) == _NEW_READINGS:
            self._read_s = deque(self._set_s, maxlen=_READINGS)
            self._set_s = []

    def read_others_utc(self, utc_s: float, arrival_s: float) -> None:
        """Add a reading of UTC of another system on the link, which arrived at a time by `time.monotonic`, s."""
        if YEAR_2010_S <= utc_s < YEAR_2100_S:
            self._others_s.append(utc_s - arrival_s)

    @property
    def host_minus_boot_s(self) -> float | None:
        """`time.monotonic` minus the time since boot, s, without the delays of the link."""
        return min((delay_s for _, delay_s in self._smallest_delay_s), default=None)

    def dated(self, boot_s: float | None, arrival_s: float | None) -> LatestAttitude | None:
        """Return the times of the latest attitude, by its time since boot and its arrival by `time.monotonic`, s.

        None if there is no attitude, or no UTC.
        """
        utc_minus_boot_s, utc_minus_host_s = self.utc_minus_boot_s, self.utc_minus_host_s
        if boot_s is None or arrival_s is None or utc_minus_boot_s is None or utc_minus_host_s is None:
            return None
        return LatestAttitude(boot_s + utc_minus_boot_s, arrival_s, utc_minus_boot_s, self.boot, utc_minus_host_s)

    @property
    def utc_minus_host_s(self) -> float | None:
        """UTC minus `time.monotonic`, s, without the delays of the link; None if unknown."""
        utc_minus_boot_s, host_minus_boot_s = self.utc_minus_boot_s, self.host_minus_boot_s
        return None if utc_minus_boot_s is None or host_minus_boot_s is None else utc_minus_boot_s - host_minus_boot_s

    @property
    def utc_minus_boot_s(self) -> float | None:
        """UTC minus the time since boot, s; None if unknown."""
        return self._utc[0]

    @property
    def source(self) -> str | None:
        """Where UTC comes from, for messages; None if it is unknown."""
        return self._utc[1]

    @property
    def _utc(self) -> tuple[float | None, str | None]:
        """UTC minus the time since boot, s, and its source, by the best means."""
        if self._read_s and not self._overrides:
            return median(self._read_s), f"SYSTEM_TIME, {len(self._read_s)} readings"
        host_s = self.host_minus_boot_s
        if host_s is None:
            return None, None
        if self._utc_minus_boot_s is not None:
            return self._utc_minus_boot_s, self._host_source
        if self._utc_minus_host_s is not None:
            return host_s + self._utc_minus_host_s, self._host_source
        if self._others_s:
            return host_s + median(self._others_s), f"SYSTEM_TIME of another system, {len(self._others_s)} readings"
        return None, None

    def _begin_boot(self) -> None:
        """Begin another boot; until the autopilot sends UTC again, UTC is continued by the computer's clock."""
        utc_minus_boot_s, host_s = self.utc_minus_boot_s, self.host_minus_boot_s
        self.utc_minus_boot_before_s = utc_minus_boot_s
        # A simulator states its UTC again; the computer's clock does not continue it.
        if not (self.is_vehicle_time or utc_minus_boot_s is None or host_s is None or self._overrides):
            self._utc_minus_host_s = utc_minus_boot_s - host_s
            self._host_source = "the UTC before the reboot and the computer's clock"
        self.boot += 1
        self._wraps = 0
        self._latest_s = None
        self.has_two_clocks = False
        self._other_clock_s = None
        self._read_s.clear()
        self._set_s = []
        self._smallest_delay_s.clear()

    def _add_delay(self, delay_s: float, arrival_s: float) -> None:
        if not self._smallest_delay_s or arrival_s - self._smallest_delay_s[-1][0] > _WINDOW_S:
            self._smallest_delay_s.append((arrival_s, delay_s))
        elif delay_s < self._smallest_delay_s[-1][1]:
            self._smallest_delay_s[-1] = self._smallest_delay_s[-1][0], delay_s
