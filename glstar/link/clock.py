"""Which UTC an autopilot's time since boot is.

SYSTEM_TIME tells both at once: the median of what it says lately is the difference, whatever the link delays.  Where
the autopilot does not know UTC, the computer's clock has to serve: the packet that came soonest after it was stamped
tells how the two clocks stand, for a link delays packets but never hastens them.
"""

from collections import deque
from statistics import median
from typing import Final

from glstar.telemetry.validation import YEAR_2010_S, YEAR_2100_S

__all__ = ["COMPUTERS", "BootClock"]

# Where UTC comes from, in words, if it is not from the link.
COMPUTERS: Final = "the computer's clock"

# The median of so many readings: half a minute of them, in which the quartz of an autopilot drifts by a millisecond.
_READINGS: Final = 31
# So many in a row that agree with each other and not with the rest: the autopilot has set its clock.
_SET_ANEW: Final = 5
_AGREE_S: Final = 0.05

# The soonest packet counts of so many stretches of so many seconds: long enough for one that was not delayed.
_STRETCHES: Final = 6
_STRETCH_S: Final = 10.0

# Packets overtake each other by less; a stamp that lies further back, or further ahead than time has passed, is of
# another boot, or of somebody else who uses the same number.
_REBOOT_S: Final = 5.0
# Once the clock of before has been silent for so long it was a reboot, s.
_SILENT_S: Final = 0.5
# Where both go on beside each other for so long they are two, s.
_TWO_S: Final = 2.0
# time_boot_ms has 32 bits: 49.7 days.
_WRAP_S: Final = 2**32 / 1000


class BootClock:
    """The clock of one autopilot, from boot to boot.

    Parameters
    ----------
    utc_minus_host_s : float, optional
        What to add to the computer's steady clock for UTC, s, where the autopilot has none.
    given : str
        Where that comes from, in words.
    start_utc_s : float, optional
        UTC of the first packet that is stamped, seconds since 1970; it counts even where the autopilot knows UTC.

    Attributes
    ----------
    boot : int
        Counts the boots that were seen.
    utc_minus_boot_before_s : float or None
        UTC minus the time since the boot before this one, s, as it was when that ended; None where it was not known.
    two : bool
        Whether stamps of two clocks come, as from two autopilots of one number; the first heard counts.
    """

    def __init__(
        self,
        *,
        utc_minus_host_s: float | None = None,
        given: str = COMPUTERS,
        start_utc_s: float | None = None,
    ) -> None:
        self._utc_minus_host_s, self._given, self._start_utc_s = utc_minus_host_s, given, start_utc_s
        self._overrides = start_utc_s is not None
        self.boot = 0
        self.utc_minus_boot_before_s: float | None = None
        self.two = False
        self._wraps = 0
        self._latest_s: float | None = None
        self._heard_s = 0.0
        # Since when stamps of another clock come.
        self._strange_s: float | None = None
        # UTC minus time since boot, as read.
        self._read_s: deque[float] = deque(maxlen=_READINGS)
        # Arrival minus time since boot, the least of each stretch, with when the stretch began.
        self._soonest_s: deque[tuple[float, float]] = deque(maxlen=_STRETCHES)
        # UTC minus the computer's clock, as other systems on the link told it.
        self._others_s: deque[float] = deque(maxlen=_READINGS)

    def take_computers(self, utc_minus_host_s: float) -> None:
        """Take the computer's clock for UTC, where the autopilot tells none.

        Parameters
        ----------
        utc_minus_host_s : float
            What to add to the computer's steady clock for UTC, s.
        """
        if not self._overrides:
            self._utc_minus_host_s, self._given = utc_minus_host_s, COMPUTERS

    def hear(self, boot_s: float, arrival_s: float) -> float | None:
        """Take note of a packet stamped with the time since boot.

        Parameters
        ----------
        boot_s : float
            The stamp, s.
        arrival_s : float
            When it came by the computer's steady clock, s.

        Returns
        -------
        float or None
            The stamp without wraps: it goes on after 49.7 days.  None where it is another clock's, while the one of
            before goes on.
        """
        unwrapped_s = boot_s + self._wraps * _WRAP_S
        if self._latest_s is not None:
            silent_s = arrival_s - self._heard_s
            if unwrapped_s + _WRAP_S < self._latest_s + silent_s + _REBOOT_S:
                self._wraps += 1
                unwrapped_s += _WRAP_S
            if not -_REBOOT_S <= unwrapped_s - self._latest_s <= silent_s + _REBOOT_S:
                if silent_s < _SILENT_S:
                    self._strange_s = arrival_s if self._strange_s is None else self._strange_s
                    self.two = self.two or arrival_s - self._strange_s > _TWO_S
                    return None
                self._begin_anew()
                unwrapped_s = boot_s
        self._heard_s = arrival_s
        self._latest_s = unwrapped_s if self._latest_s is None else max(unwrapped_s, self._latest_s)
        if self._start_utc_s is not None:
            self._utc_minus_host_s, self._start_utc_s = self._start_utc_s - arrival_s, None
        self._note_arrival(arrival_s - unwrapped_s, arrival_s)
        return unwrapped_s

    def read_utc(self, boot_s: float, utc_s: float) -> None:
        """Take note of a reading of UTC of the autopilot itself; what is no UTC is passed over.

        Parameters
        ----------
        boot_s : float
            Time since boot without wraps, s.
        utc_s : float
            UTC seconds since 1970; 0 before a fix.
        """
        if not YEAR_2010_S <= utc_s < YEAR_2100_S:
            return
        self._read_s.append(utc_s - boot_s)
        latest = list(self._read_s)[-_SET_ANEW:]
        if abs(median(latest) - median(self._read_s)) > _AGREE_S and max(latest) - min(latest) < _AGREE_S:
            self._read_s = deque(latest, maxlen=_READINGS)

    def read_others_utc(self, utc_s: float, arrival_s: float) -> None:
        """Take note of a reading of UTC of another system on the link, such as a ground station.

        Parameters
        ----------
        utc_s : float
            UTC seconds since 1970.
        arrival_s : float
            When it came by the computer's steady clock, s.
        """
        if YEAR_2010_S <= utc_s < YEAR_2100_S:
            self._others_s.append(utc_s - arrival_s)

    @property
    def host_minus_boot_s(self) -> float | None:
        """The computer's steady clock minus the time since boot, s, without the link's delays."""
        return min((soonest_s for _, soonest_s in self._soonest_s), default=None)

    @property
    def utc_minus_boot_s(self) -> float | None:
        """UTC minus the time since boot, s; None where nobody knows."""
        return self._found[0]

    @property
    def source(self) -> str | None:
        """Where UTC comes from, in words; None where nobody knows it."""
        return self._found[1]

    @property
    def _found(self) -> tuple[float | None, str | None]:
        if self._read_s and not self._overrides:
            return median(self._read_s), f"SYSTEM_TIME, {len(self._read_s)} readings"
        host_s = self.host_minus_boot_s
        if host_s is None:
            return None, None
        if self._utc_minus_host_s is not None:
            return host_s + self._utc_minus_host_s, self._given
        if self._others_s:
            return host_s + median(self._others_s), f"SYSTEM_TIME of another system, {len(self._others_s)} readings"
        return None, None

    def _begin_anew(self) -> None:
        """Start over after a reboot; UTC goes on by the computer's clock until the autopilot tells it again."""
        utc_minus_boot_s, host_s = self.utc_minus_boot_s, self.host_minus_boot_s
        self.utc_minus_boot_before_s = utc_minus_boot_s
        if utc_minus_boot_s is not None and host_s is not None and not self._overrides:
            self._utc_minus_host_s = utc_minus_boot_s - host_s
            self._given = "the UTC before the reboot and the computer's clock"
        self.boot += 1
        self._wraps, self._latest_s = 0, None
        self.two, self._strange_s = False, None
        self._read_s.clear()
        self._soonest_s.clear()

    def _note_arrival(self, late_s: float, arrival_s: float) -> None:
        if not self._soonest_s or arrival_s - self._soonest_s[-1][0] > _STRETCH_S:
            self._soonest_s.append((arrival_s, late_s))
        elif late_s < self._soonest_s[-1][1]:
            self._soonest_s[-1] = self._soonest_s[-1][0], late_s
