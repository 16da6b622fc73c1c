"""The clock of an autopilot in a telemetry log: its boots, and UTC for each of them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer, Mask
from glstar.telemetry.boots import find_boots, running_median, within
from glstar.telemetry.mavlink.packets import (
    AT,
    EULER,
    FIELDS_FROM,
    HIL_STATE,
    QUATERNION,
    STAMP,
    Packets,
    Sender,
    system_time_utc_s,
)
from glstar.telemetry.source import Boot, spikes

# Messages with the time since boot, besides HIL_STATE_QUATERNION.
_TIMED = (QUATERNION, EULER, "GLOBAL_POSITION_INT", "SYSTEM_TIME")
# A larger step back of the time since boot is a reboot, s; packets overtake each other by less.
_REBOOT_S = 5.0
# A single time that differs by more from its neighbours is damaged, s.
_BOOT_SPIKE_S = 1.0
# A larger step of UTC minus the time since boot is a change of its source, s, and one of this many times the usual
# difference of two readings.
_SAME_UTC_S, _TIMES_USUAL = 0.1, 5.0
# Two readings of UTC are of one boot if the recorder's clock minus the time since boot, or UTC minus that time, agrees
# within these times, s, and if the second one is no later than this, s.
_SAME_ARRIVAL_S, _SAME_BOOT_S, _LONGEST_PAUSE_S = 1.0, 0.5, 3600.0
# Fewer consecutive readings of UTC that differ from the others are errors; the last ones of a boot need one less.
_FEWEST_READINGS = 3
# Boots recorded within this time have the same error of the recorder's clock, s; joined recordings have longer pauses.
_SAME_RECORDING_S = 3600.0
_CORRECTED = (
    "{} of {} readings of SYSTEM_TIME are left out: the autopilot then corrected its UTC by {:+.1f} s without a reboot,"
    " as when its GPS replaces the clock of a ground station"
)
NO_UTC = "no SYSTEM_TIME during this boot, and no other boot was recorded within an hour of it"
# time_boot_ms has 32 bits: 49.7 days.  Some autopilots count the microseconds of an IMU with 32 bits: 71.6 minutes.
_WRAP_S = 2**32 / 1000
_WRAP_OF_US_MS = 2**32 / 1000


@dataclass(frozen=True, slots=True, eq=False)
class VehicleClock:
    """The clock of one autopilot, continued from its first boot through all others."""

    boots: tuple[Boot, ...]
    # For each packet with a time since boot, in the order of the file: its position in the file, the time, the number
    # of its boot (0: none) and how often the time has wrapped around.
    at: Float
    boot_s: Float
    boot: Integer
    wraps: Integer
    # For each boot by its number, the start of its clock relative to that of the first boot, s; index 0 is no boot.
    later_s: Float
    # For each of these packets, its arrival time, and the recorder's clock minus the time since boot near it, s.
    stamp_s: Float
    arrived_s: Float
    # For each boot, whether its UTC is known; True for all if it is unknown for all.
    is_known: NDArray[np.bool_]
    # For each boot, where its UTC comes from if not from the autopilot in that boot; else empty.
    utc_sources: tuple[str, ...]
    # The packets with the UTC of the autopilot, without those before it was corrected.
    readings: Float
    notes: tuple[str, ...] = ()  # Remarks for the user on readings that are left out

    @classmethod
    def of(cls, packets: Packets, sender: Sender) -> "VehicleClock":
        """Return the clock of a sender with attitude."""
        names = (HIL_STATE,) if packets.timestamps_are_utc(sender) else (*_TIMED, *packets.attitude_messages(sender))
        heads = np.concatenate([packets.rows(name, sender)[:, : FIELDS_FROM + 1] for name in dict.fromkeys(names)])
        heads = heads[np.argsort(heads[:, AT], kind="stable")]
        valid = heads[~spikes(heads[:, FIELDS_FROM] / 1e3, _BOOT_SPIKE_S)]
        heads = valid if len(valid) else heads
        boot_s, stamp_s = heads[:, FIELDS_FROM] / 1e3, heads[:, STAMP]
        wraps = np.concatenate([[0], np.cumsum(np.diff(boot_s) < -_WRAP_S / 2)])
        boot_s = boot_s + wraps * _WRAP_S
        at = heads[:, AT].astype(np.int64)

        times, is_own, notes = _corrected(clock_readings(packets, sender))
        near = np.searchsorted(heads[:, AT], times[:, AT]).clip(max=len(heads) - 1)
        read_s = times[:, FIELDS_FROM] / 1e3 + wraps[near] * _WRAP_S
        readings = times[:, AT].astype(np.int64), read_s, system_time_utc_s(times)
        boots = find_boots(
            [(at, boot_s)], readings, arrivals=(at, boot_s, stamp_s), back_s=_REBOOT_S, checked=packets.checked
        )
        numbers = range(1, len(boots) + 1)
        number_of = np.zeros(at.size, dtype=np.int64)
        of_boot = np.zeros(len(times), dtype=np.int64)
        for boot in boots:
            number_of[within(at, boot.spans)] = boot.number
            of_boot[within(readings[0], boot.spans)] = boot.number

        arrived_s = np.array([np.median((stamp_s - boot_s)[number_of == number]) for number in numbers])
        utc_s = np.full(len(boots), np.nan)
        with_readings = np.unique(of_boot[of_boot > 0])
        utc_s[with_readings - 1] = [np.median((readings[2] - read_s)[of_boot == number]) for number in with_readings]
        sources = [""] * len(boots)
        if len(boots) > 1 and np.isnan(utc_s).any():
            _add_utc_on_arrival(utc_s, arrived_s, sources, boots, packets, sender)
        is_known = np.isfinite(utc_s)
        if is_known.any() and not is_known.all():
            spans = [(stamp_s[number_of == number].min(), stamp_s[number_of == number].max()) for number in numbers]
            _add_utc_by_recorder(utc_s, arrived_s, sources, spans)
            unknown = np.isnan(utc_s)
            boots = tuple(replace(boot, doubt=NO_UTC) if unknown[boot.number - 1] else boot for boot in boots)
        is_known = np.isfinite(utc_s) if is_known.any() else np.ones_like(is_known)
        # If no boot has UTC, the recorder's clock relates them.
        utc_s = np.where(np.isfinite(utc_s), utc_s, arrived_s)
        later_s = np.concatenate([[0.0], utc_s - utc_s[0]])
        return cls(
            boots=boots,
            at=heads[:, AT],
            boot_s=boot_s,
            boot=number_of,
            wraps=wraps,
            later_s=later_s,
            stamp_s=stamp_s,
            arrived_s=_arrived_near_s(stamp_s - boot_s, arrived_s, number_of),
            is_known=is_known,
            utc_sources=tuple(sources),
            readings=times[is_own],
            notes=notes,
        )

    def read(self, rows: Float) -> tuple[Float, Integer]:
        """Return the clock of packets with a time since boot, s, and the number of the boot of each; 0 for none."""
        near = np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)
        boot = self.boot[near]
        return rows[:, FIELDS_FROM] / 1e3 + self.wraps[near] * _WRAP_S + self.later_s[boot], boot

    def of_boot(self, rows: Float, boot: int) -> tuple[Float, Float]:
        """Return the packets with a time since boot that are of one boot, and their clock, s."""
        clock_s, number = self.read(rows)
        return rows[number == boot], clock_s[number == boot]

    def boot_of(self, rows: Float) -> Integer:
        """Return the number of the boot of each packet; 0 for none."""
        number: Integer = self.boot[np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)]
        return number

    def read_us(self, rows: Float) -> Float:
        """Return the clock of packets with microseconds since boot, perhaps only their low 32 bits, s."""
        near = np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)
        boot_ms = self.boot_s[near] * 1e3
        stamp_ms = rows[:, FIELDS_FROM] / 1e3
        with np.errstate(invalid="ignore"):
            stamp_ms = stamp_ms + np.round((boot_ms - stamp_ms) / _WRAP_OF_US_MS) * _WRAP_OF_US_MS
        clock_s: Float = stamp_ms / 1e3 + self.later_s[self.boot[near]]
        return clock_s

    def on_arrival(self, rows: Float) -> Float:
        """Return the clock at the arrival of packets of other senders, s."""
        after = np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)
        before = (after - 1).clip(min=0)
        # Of the packets before and after, the one that arrived at nearly the same time by the recorder's clock.
        is_before = np.abs(rows[:, STAMP] - self.stamp_s[before]) < np.abs(rows[:, STAMP] - self.stamp_s[after])
        near = np.where(is_before & (self.boot[before] == self.boot[after]), before, after)
        arrived: Float = rows[:, STAMP] - self.arrived_s[near] + self.later_s[np.maximum(self.boot[near], 1)]
        return arrived


def _arrived_near_s(arrived_s: Float, of_boot_s: Float, boot: Integer) -> Float:
    """Return the recorder's clock minus the time since boot near each packet, (n,) s.

    It is the median of the packet's boot, `of_boot_s`, unless the recorder's clock was set during that boot.
    """
    usual_s = of_boot_s[np.maximum(boot, 1) - 1]
    local_s = running_median(arrived_s)
    return np.where(np.abs(local_s - usual_s) > _SAME_ARRIVAL_S, local_s, usual_s)


def _add_utc_on_arrival(
    utc_s: Float, arrived_s: Float, sources: list[str], boots: tuple[Boot, ...], packets: Packets, sender: Sender
) -> None:
    """Fill in UTC minus time since boot, (n,) s, of boots in which only other senders know UTC; NaN is unknown."""
    for other in other_clocks(packets, sender):
        times = packets.times(other)
        late_s = system_time_utc_s(times) - times[:, STAMP]
        for boot in boots:
            inside = within(times[:, AT].astype(np.int64), boot.spans)
            if np.isnan(utc_s[boot.number - 1]) and inside.any():
                utc_s[boot.number - 1] = np.median(late_s[inside]) + arrived_s[boot.number - 1]
                sources[boot.number - 1] = readings_source(int(np.count_nonzero(inside)), packets.called(other))


def _add_utc_by_recorder(utc_s: Float, arrived_s: Float, sources: list[str], spans: list[tuple[float, float]]) -> None:
    """Fill in UTC minus time since boot, (n,) s, of boots recorded within an hour of a boot whose UTC is known.

    The recorder's clock has the same error in both, unless the file was joined from several recordings.
    """
    with_utc = np.flatnonzero(np.isfinite(utc_s))
    for boot in np.flatnonzero(np.isnan(utc_s)):
        first_s, last_s = spans[boot]
        gaps_s = [max(spans[k][0] - last_s, first_s - spans[k][1]) for k in with_utc]
        near = int(np.argmin(gaps_s))
        if 0 <= gaps_s[near] <= _SAME_RECORDING_S:
            utc_s[boot] = arrived_s[boot] + utc_s[with_utc[near]] - arrived_s[with_utc[near]]
            sources[boot] = f"the recorder's clock and the UTC of boot {with_utc[near] + 1}"


def _corrected(times: Float) -> tuple[Float, Mask, tuple[str, ...]]:
    """Return the readings of UTC, those before a correction corrected, and which are as they were sent, (n,) bool.

    The last item is a remark for each correction.

    An autopilot may take the UTC of a ground station, or of a clock with a battery, until its GPS knows it; a GPS is
    never replaced by these.  ArduPilot and PX4 then correct their clock once, so that the last level is the best one.
    """
    boot_s, utc_s = times[:, FIELDS_FROM] / 1e3, system_time_utc_s(times)
    step_s = np.diff(boot_s)
    # Two readings are of one boot if the recorder's clock continues between them, or UTC does.
    continues = np.abs(np.diff(times[:, STAMP]) - step_s) < _SAME_ARRIVAL_S
    continues |= np.abs(np.diff(utc_s) - step_s) < _SAME_BOOT_S
    continues &= (step_s >= 0) & (step_s <= _LONGEST_PAUSE_S)
    times, used, notes = times.copy(), np.ones(len(times), dtype=bool), []
    for rows in np.split(np.arange(len(times)), np.flatnonzero(~continues) + 1):
        off_s = (utc_s - boot_s)[rows]
        steps_s = np.abs(np.diff(off_s))
        same_s = max(_SAME_UTC_S, _TIMES_USUAL * float(np.median(steps_s))) if steps_s.size else _SAME_UTC_S
        *runs, last = np.split(off_s, np.flatnonzero(steps_s > same_s) + 1)
        runs = [run for run in runs if run.size >= _FEWEST_READINGS]
        levels = [float(np.median(run)) for run in (*runs, *([last] if last.size > 1 else []))]
        if levels and max(levels) - min(levels) > same_s:
            used[rows] = np.abs(off_s - levels[-1]) <= same_s
            early = rows[~used[rows]]
            times[early, FIELDS_FROM + 1] = (boot_s[early] + levels[-1]) * 1e6
            notes.append(_CORRECTED.format(early.size, rows.size, levels[-1] - levels[0]))
        if levels and last.size == 1 and abs(off_s[-1] - levels[-1]) > same_s:
            differs = f"the last reading of SYSTEM_TIME is {off_s[-1] - levels[-1]:+.1f} s from the others"
            notes.append(f"{differs}, which are used")
    return times, used, tuple(notes)


def readings_source(count: int, sender: str = "") -> str:
    """Return the UTC source for a number of readings of SYSTEM_TIME, of another sender if one is named."""
    return f"SYSTEM_TIME of {sender}, on arrival, {count} readings" if sender else f"SYSTEM_TIME, {count} readings"


def other_clocks(packets: Packets, sender: Sender) -> list[Sender]:
    """Return the other senders of UTC, the senders of the autopilot's system first."""
    others = [other for other in packets.senders("SYSTEM_TIME") if other != sender]
    return sorted(others, key=lambda other: other[0] != sender[0])


def clock_readings(packets: Packets, sender: Sender) -> Float:
    """Return the readings of UTC of a sender: SYSTEM_TIME, or its attitude if that is timed by UTC."""
    if not packets.timestamps_are_utc(sender):
        return packets.times(sender)
    rows = packets.rows(HIL_STATE, sender)
    return np.column_stack([rows[:, : FIELDS_FROM + 1], rows[:, FIELDS_FROM] * 1e3])
