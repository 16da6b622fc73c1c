"""MAVLink telemetry logs (``.tlog``): which vehicle, which attitude, which place, which UTC.

What glstar reads of them:

====================  ============================================  ================================================
message               fields                                        used for
====================  ============================================  ================================================
HEARTBEAT             autopilot, type                               who is an autopilot, of all that speak
ATTITUDE_QUATERNION   time_boot_ms, q1..q4, body to NED             attitude
ATTITUDE              time_boot_ms, roll, pitch, yaw                attitude, where it is sent more often
GLOBAL_POSITION_INT   time_boot_ms, lat, lon, alt                   place
GPS_RAW_INT           fix_type, lat, lon, alt                       place, where the other knows none
SYSTEM_TIME           time_boot_ms, time_unix_usec                  UTC
HIGHRES_IMU           time_usec, xgyro, ygyro, zgyro (rad/s)        rates, of the one sent most often, where it
SCALED_IMU, 2, 3      time_boot_ms, xgyro, ygyro, zgyro (mrad/s)    is sent as often as the attitude
RAW_IMU               the same with time_usec, of ArduPilot         the same; of others its gyros have no unit
AUTOPILOT_VERSION     flight_sw_version                             the firmware
STATUSTEXT            text                                          the firmware, of ArduPilot
====================  ============================================  ================================================

The clock is the autopilot's time since boot.  A ground station's stamps are neither that nor UTC: its clock may be
wrong by seconds or years.  They serve to bring together what has no time since boot in common: an autopilot without UTC
and a ground station that tells it, or two boots of one autopilot.
"""

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from os import PathLike
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.timescale import format_utc
from glstar.telemetry.boots import find_boots, within
from glstar.telemetry.source import (
    REBOOT,
    AttitudeSamples,
    Boot,
    ClockSamples,
    LogFacts,
    PositionSamples,
    RateSamples,
    Samples,
    TelemetrySource,
    chosen_boots,
)
from glstar.telemetry.tlogfile import AT, FIELDS_FROM, STAMP, LogPackets, Packets, Sender, is_telemetry_log, told_utc_s
from glstar.telemetry.validation import (
    UNIT_TOLERANCE,
    YEAR_2010_S,
    YEAR_2100_S,
    no_places,
    places,
    sound_rates,
    sound_times,
    spikes,
)
from glstar.telemetry.vehicles import ARDUPILOT, autopilot, vehicle_kind, version

__all__ = ["TelemetryLogReader", "is_telemetry_log"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]
_QUATERNION, _EULER = "ATTITUDE_QUATERNION", "ATTITUDE"
_TIMED = (_QUATERNION, _EULER, "GLOBAL_POSITION_INT", "SYSTEM_TIME")
# Messages with rates: their unit, rad/s.  Where they come equally often the earlier one counts.
_GYROS: Final = {"HIGHRES_IMU": 1.0, "SCALED_IMU": 1e-3, "RAW_IMU": 1e-3, "SCALED_IMU2": 1e-3, "SCALED_IMU3": 1e-3}
# What an autopilot says of itself when it starts: "ArduSub V4.1.1 BETA5 (66c674c1)".
_BANNER = re.compile(r"([A-Z]\w+) V(\d+\.\d+\S*.*)", re.ASCII)
_FIRST_AUTOPILOT = 1

# Packets overtake each other by less; a clock that goes back by more begins anew.
_REBOOT_S = 5.0
_BOOT_SPIKE_S = 1.0
# Boots recorded no further apart than this are of one recording, by one clock; joined recordings rarely are, s.
_SAME_RECORDING_S = 3600.0
_NO_UTC = "no SYSTEM_TIME during this boot, and no other boot was recorded within an hour of it"
# A shorter loss of samples is not reported.
_REPORTED_S = 1.0
_FIX_3D = 3
# time_boot_ms has 32 bits: 49.7 days.  Some autopilots count the microseconds of an IMU with as many: 71.6 minutes.
_WRAP_S = 2**32 / 1000
_WRAP_OF_US_MS = 2**32 / 1000


class TelemetryLogReader(TelemetrySource):
    """A telemetry log as a telemetry source; its clock is the autopilot's time since its first boot.

    Damage is passed over: of a log that is cut off, or has bad bytes in it, every whole packet counts.

    Parameters
    ----------
    path : path-like
        The log.
    attitude : str
        ``"auto"``: ATTITUDE_QUATERNION, or ATTITUDE where it comes more than twice as often.  Or one of them by name.
    sysid : int, optional
        The MAVLink system whose flight it is; by default the first autopilot that tells its attitude.
    boot : int, optional
        Which boot of the autopilot, from 1, of a log that holds several; by default all of them.

    Raises
    ------
    LogFormatError
        If the file holds no whole packet that matters.
    """

    format = "MAVLink telemetry log"
    one_clock = True

    def __init__(
        self,
        path: str | PathLike[str],
        *,
        attitude: str = "auto",
        sysid: int | None = None,
        boot: int | None = None,
    ) -> None:
        self.name = os.fspath(path)
        self._attitude, self._sysid, self._boot = attitude, sysid, boot
        self._packets = self._open()
        self._read_clock: tuple[Sender, _Clock] | None = None

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places and the rates of each boot, a batch each, and the UTC of all.

        Nothing is decoded before it is asked for: who takes three batches of a single boot does not wait for the gyros.

        Raises
        ------
        LogFormatError
            If the log has no attitude, or not the one that was asked for, or no such boot.
        """
        sender, others = self._vehicle()
        clock = self._clock(sender)
        boots = self.boots()
        self._require_attitude(sender)
        for boot in boots:
            yield self._attitudes(sender, others, clock, boot.number)
            yield _positions(self._packets, sender, clock, boot.number)
            if boot is boots[0]:
                utc = _utc(self._packets, sender, clock)
                if self._boot is not None and not clock.is_known[boot.number - 1]:
                    utc = ClockSamples(np.empty(0), np.empty(0), _NO_UTC)
                yield replace(utc, boot=boot.number)
        for boot in boots:
            yield from _rates(self._packets, sender, clock, boot.number)

    def boots(self) -> tuple[Boot, ...]:
        """Return the boots of the autopilot in the log, or the one that was asked for.

        Raises
        ------
        LogFormatError
            If the log has no attitude, or no such boot.
        """
        return chosen_boots(self.name, self._clock(self._vehicle()[0]).boots, self._boot)

    def facts(self, boots: Collection[int] = ()) -> LogFacts:  # noqa: ARG002
        """Return what the aircraft says of itself.

        Parameters
        ----------
        boots : collection of int
            Of which boots, by number; by default of all.

        Returns
        -------
        LogFacts

        Raises
        ------
        LogFormatError
            If the log has no attitude.
        """
        sender, systems = self._vehicle()
        vehicle = _vehicle_of(self._packets, sender)
        choice = f", system {sender[0]} of {_and(systems)}" if len(systems) > 1 else ""
        return LogFacts(
            self.format, f"{vehicle or 'vehicle'}{choice}" if vehicle or choice else None, self._firmware(sender)
        )

    def attitudes(self) -> Iterator[tuple[str, AttitudeSamples]]:
        """Yield every attitude that the aircraft tells, each after its name, boot by boot."""
        sender, systems = self._vehicle()
        clock = self._clock(sender)
        for boot in self.boots():
            for name in self._told(sender, clock, boot.number):
                yield name, self._attitude_of(name, sender, systems, clock, boot.number)

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""

    def _open(self) -> Packets:
        return LogPackets(self.name)

    def _clock(self, sender: Sender) -> "_Clock":
        if self._read_clock is None or self._read_clock[0] != sender:
            self._read_clock = sender, _Clock.of(self._packets, sender)
        return self._read_clock[1]

    def _firmware(self, sender: Sender) -> str | None:
        texts = self._packets.texts(sender)
        if banners := [found for text in texts if (found := _BANNER.fullmatch("".join(filter(str.isprintable, text))))]:
            return banners[-1][0]
        numbers = self._packets.rows("AUTOPILOT_VERSION", sender)[:, FIELDS_FROM]
        numbers = numbers[numbers > 0]
        if not numbers.size:
            return None
        told = (_vehicle_of(self._packets, sender) or "").split(" ")[0]
        return " ".join(filter(None, (told, version(int(numbers[-1])))))

    def _vehicle(self) -> tuple[Sender, list[int]]:
        """Return whose flight it is, and the systems of all that could have been meant."""
        packets = self._packets
        tell = packets.senders(_QUATERNION, _EULER)
        autopilots = [sender for sender in tell if sender in packets.autopilots()]
        # Without a heartbeat, of a log cut out of another, whoever tells an attitude is believed.
        candidates = autopilots or tell
        systems = list(dict.fromkeys(system for system, _ in candidates))
        if not candidates:
            raise self._error(f"the log has no attitude: no {_QUATERNION} or {_EULER} in {packets.count} packets")
        if self._sysid is not None:
            candidates = [sender for sender in candidates if sender[0] == self._sysid]
            if not candidates:
                told = f"system {_and(systems)}"
                raise self._error(f"the log has no attitude of system {self._sysid} (sysid); it has that of {told}")
        system = candidates[0][0]
        components = [component for number, component in candidates if number == system]
        return (system, _FIRST_AUTOPILOT if _FIRST_AUTOPILOT in components else components[0]), systems

    def _told(self, sender: Sender, clock: "_Clock", boot: int) -> list[str]:
        """Return the messages in which a sender tells its attitude in a boot, the one to prefer first."""
        rows = {name: self._packets.rows(name, sender) for name in (_QUATERNION, _EULER)}
        count = {name: np.count_nonzero(clock.read(some)[1] == boot) for name, some in rows.items()}
        # Rounded to float32 both are as good; but where one is rare, the other one tells more.
        order = (_EULER, _QUATERNION) if count[_EULER] > 2 * count[_QUATERNION] else (_QUATERNION, _EULER)
        return [name for name in order if count[name]]

    def _require_attitude(self, sender: Sender) -> None:
        """Raise an error where the attitude that was asked for is not there."""
        there = [name for name in (_QUATERNION, _EULER) if len(self._packets.rows(name, sender))]
        if self._attitude.strip().upper() not in ("AUTO", *there):
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {' and '.join(sorted(there))}")

    def _attitudes(self, sender: Sender, systems: list[int], clock: "_Clock", boot: int) -> AttitudeSamples:
        there, wanted = self._told(sender, clock, boot), self._attitude.strip().upper()
        name = wanted if wanted != "AUTO" else there[0] if there else _QUATERNION
        return self._attitude_of(name, sender, systems, clock, boot)

    def _attitude_of(
        self, name: str, sender: Sender, systems: list[int], clock: "_Clock", boot: int
    ) -> AttitudeSamples:
        rows, clock_s = clock.of_boot(self._packets.rows(name, sender), boot)
        with np.errstate(over="ignore", invalid="ignore"):
            told = rows[:, FIELDS_FROM + 1 :]
            q = conjugate(told) if name == _QUATERNION else quaternion_from_euler(*told.T)
            sound = np.abs(np.linalg.norm(q, axis=-1) - 1) < UNIT_TOLERANCE  # False for NaN too
        sound &= sound_times(clock_s)
        # An estimator sends (1, 0, 0, 0) until it has found out where down and north are.
        aligned = (q != (1.0, 0.0, 0.0, 0.0)).any(axis=-1)
        notes: tuple[str, ...] = ()
        if name == _QUATERNION:
            before = slice(None, int(np.argmax(aligned)) if aligned.any() else None)
            notes = self._left_out(clock_s, before, sender, clock, boot)
            sound[before] = False
        choice = f" of system {sender[0]} (of {_and(systems)}; sysid chooses)" if len(systems) > 1 else ""
        segment = np.zeros(np.count_nonzero(sound), dtype=np.int64)
        return AttitudeSamples(clock_s[sound], q[sound], segment, f"{name}{choice}", REBOOT, boot, notes)

    def _left_out(self, clock_s: Float, before: slice, sender: Sender, clock: "_Clock", boot: int) -> tuple[str, ...]:
        """Return that the attitude before its estimator was aligned is left out, and what covers more."""
        left_out_s = float(np.ptp(clock_s[before])) if clock_s[before].size else 0.0
        if left_out_s < _REPORTED_S:
            return ()
        euler_s = clock.of_boot(self._packets.rows(_EULER, sender), boot)[1]
        better = f"; --attitude {_EULER} covers {np.ptp(euler_s):.1f} s" if euler_s.size else ""
        remain_s = np.ptp(clock_s) - left_out_s
        return (
            f"the first {left_out_s:.1f} s of {_QUATERNION} are left out, before its estimator was aligned:"
            f" {remain_s:.1f} s remain{better}",
        )

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._packets.whole_bytes)


def _positions(packets: Packets, sender: Sender, clock: "_Clock", boot: int) -> PositionSamples:
    return replace(_known_places(packets, sender, clock, boot), boot=boot)


def _known_places(packets: Packets, sender: Sender, clock: "_Clock", boot: int) -> PositionSamples:
    rows, clock_s = clock.of_boot(packets.rows("GLOBAL_POSITION_INT", sender), boot)
    latitude, longitude, height_mm = rows[:, FIELDS_FROM + 1 :].T
    known = places(clock_s, latitude / 1e7, longitude / 1e7, height_mm / 1e3, "GLOBAL_POSITION_INT")
    if known.clock_s.size:
        return known
    # By the recorder's clock, for whether its own is UTC or the time since boot differs: a second late is near enough.
    fixes = packets.rows("GPS_RAW_INT", sender)
    fixes = fixes[clock.boot_of(fixes) == boot]
    fixed = fixes[fixes[:, FIELDS_FROM] >= _FIX_3D]
    latitude, longitude, height_mm = fixed[:, FIELDS_FROM + 1 :].T
    known = places(clock.on_arrival(fixed), latitude / 1e7, longitude / 1e7, height_mm / 1e3, "GPS_RAW_INT")
    if known.clock_s.size:
        return known
    never = [name for name, there in (("GLOBAL_POSITION_INT", len(rows)), ("GPS_RAW_INT", len(fixes))) if there]
    return no_places(
        f"its {' and '.join(never)} never knew the place" if never else packets.lack("GLOBAL_POSITION_INT")
    )


def _utc(packets: Packets, sender: Sender, clock: "_Clock") -> ClockSamples:
    """Return the UTC of the autopilot itself, else of another component of its system, else of any other system."""
    times = packets.times(sender)
    if len(times):
        clock_s, boot = clock.read(times)
        return ClockSamples(clock_s[boot > 0], told_utc_s(times)[boot > 0], f"SYSTEM_TIME, {len(times)} readings")
    for other in _tellers_of_time(packets, sender):
        if len(times := packets.times(other)):
            source = f"SYSTEM_TIME of {packets.called(other)}, on arrival, {len(times)} readings"
            return ClockSamples(clock.on_arrival(times), told_utc_s(times), source)
    lack = "no SYSTEM_TIME after 2010" if packets.senders("SYSTEM_TIME") else packets.lack("SYSTEM_TIME")
    stamp_s = packets.first_stamp_s(sender)
    recorder = f"; the recorder's own clock said {format_utc(stamp_s)}" if YEAR_2010_S <= stamp_s < YEAR_2100_S else ""
    return ClockSamples(np.empty(0), np.empty(0), f"{lack}{recorder}")


def _rates(packets: Packets, sender: Sender, clock: "_Clock", boot: int) -> Iterator[RateSamples]:
    """Yield the rates that come most often; nothing where the attitude comes more often than they do."""
    least = max(2, *(len(packets.rows(name, sender)) for name in (_QUATERNION, _EULER)))
    names = [name for name in _GYROS if name != "RAW_IMU" or _is_ardupilot(packets, sender)]
    # Packets are counted before they are decoded: of three gyros the two slow ones need not be.
    often = [name for name in sorted(names, key=packets.amount, reverse=True) if packets.amount(name) >= least]
    name = next((name for name in often if len(packets.rows(name, sender)) >= least), None)
    if name is None:
        return
    rows = packets.rows(name, sender)
    rows = rows[clock.boot_of(rows) == boot]
    with np.errstate(invalid="ignore", over="ignore"):
        rate = rows[:, FIELDS_FROM + 1 :] * _GYROS[name]
    clock_s = clock.read(rows)[0] if name.startswith("SCALED") else clock.read_us(rows)
    sound = sound_times(clock_s) & sound_rates(rate)
    if np.count_nonzero(sound) > 1:
        yield RateSamples(clock_s[sound], rate[sound], name, boot)


def _is_ardupilot(packets: Packets, sender: Sender) -> bool:
    return bool(np.any(packets.rows("HEARTBEAT", sender)[:, FIELDS_FROM] == ARDUPILOT))


def _vehicle_of(packets: Packets, sender: Sender) -> str | None:
    """Return the name of an autopilot and of what it flies; None without a heartbeat."""
    beats = packets.rows("HEARTBEAT", sender)
    if not len(beats):
        return None
    return autopilot(int(np.median(beats[:, FIELDS_FROM])), vehicle_kind(beats[:, FIELDS_FROM + 1]))


@dataclass(frozen=True, slots=True, eq=False)
class _Clock:
    """The clock of one autopilot, which goes on from its first boot through all others."""

    boots: tuple[Boot, ...]
    # Of every packet with a time since boot, in the order of the file; a boot of 0 is of none.
    at: Float
    boot_s: Float
    boot: Integer
    wraps: Integer
    # Of every boot by its number, what is to be added to its time, s; the first entry is of none.
    later_s: Float
    # Of every boot, the recorder's clock minus the time since boot, s.
    arrived_s: Float
    # Of every boot, whether its UTC is known, or that of none is.
    is_known: NDArray[np.bool_]

    @classmethod
    def of(cls, packets: Packets, sender: Sender) -> "_Clock":
        """Return the clock of a sender with at least one packet that is timed."""
        heads = np.concatenate([packets.rows(name, sender)[:, : FIELDS_FROM + 1] for name in _TIMED])
        heads = heads[np.argsort(heads[:, AT], kind="stable")]
        kept = heads[~spikes(heads[:, FIELDS_FROM] / 1e3, _BOOT_SPIKE_S)]
        heads = kept if len(kept) else heads
        boot_s, stamp_s = heads[:, FIELDS_FROM] / 1e3, heads[:, STAMP]
        wraps = np.concatenate([[0], np.cumsum(np.diff(boot_s) < -_WRAP_S / 2)])
        boot_s = boot_s + wraps * _WRAP_S
        at = heads[:, AT].astype(np.int64)

        times = packets.times(sender)
        near = np.searchsorted(heads[:, AT], times[:, AT]).clip(max=len(heads) - 1)
        read_s = times[:, FIELDS_FROM] / 1e3 + wraps[near] * _WRAP_S
        readings = times[:, AT].astype(np.int64), read_s, told_utc_s(times)
        boots = find_boots(
            [(at, boot_s)], readings, arrivals=(at, boot_s, stamp_s), back_s=_REBOOT_S, checked=packets.checked
        )
        numbers = range(1, len(boots) + 1)
        boot = np.zeros(at.size, dtype=np.int64)
        of_boot = np.zeros(len(times), dtype=np.int64)
        for one in boots:
            boot[within(at, one.spans)] = one.number
            of_boot[within(readings[0], one.spans)] = one.number

        arrived_s = np.array([np.median((stamp_s - boot_s)[boot == number]) for number in numbers])
        utc_s = np.full(len(boots), np.nan)
        found = np.unique(of_boot[of_boot > 0]) - 1
        utc_s[found] = [np.median((readings[2] - read_s)[of_boot == number + 1]) for number in found]
        if len(boots) > 1 and np.isnan(utc_s).any():
            _add_utc_on_arrival(utc_s, arrived_s, boots, packets, sender)
        is_known = np.isfinite(utc_s)
        if is_known.any() and not is_known.all():
            spans = [(stamp_s[boot == number].min(), stamp_s[boot == number].max()) for number in numbers]
            _add_utc_by_recorder(utc_s, arrived_s, spans)
            unknown = np.isnan(utc_s)
            boots = tuple(replace(one, doubt=_NO_UTC) if unknown[one.number - 1] else one for one in boots)
        is_known = np.isfinite(utc_s) if is_known.any() else np.ones_like(is_known)
        # Boots without UTC, of which none has any, are put together by the recorder's clock.
        utc_s = np.where(np.isfinite(utc_s), utc_s, arrived_s)
        later_s = np.concatenate([[0.0], utc_s - utc_s[0]])
        return cls(boots, heads[:, AT], boot_s, boot, wraps, later_s, arrived_s, is_known)

    def read(self, rows: Float) -> tuple[Float, Integer]:
        """Return the clock of timed packets, s, and the number of the boot that each is of; 0 for none."""
        near = np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)
        boot = self.boot[near]
        return rows[:, FIELDS_FROM] / 1e3 + self.wraps[near] * _WRAP_S + self.later_s[boot], boot

    def of_boot(self, rows: Float, boot: int) -> tuple[Float, Float]:
        """Return those timed packets that are of one boot, and their clock, s."""
        clock_s, number = self.read(rows)
        return rows[number == boot], clock_s[number == boot]

    def boot_of(self, rows: Float) -> Integer:
        """Return the number of the boot that each packet is of; 0 for none."""
        number: Integer = self.boot[np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)]
        return number

    def read_us(self, rows: Float) -> Float:
        """Return the clock of packets that count microseconds since boot, of which they may tell the low 32 bits, s."""
        near = np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)
        boot_ms = self.boot_s[near] * 1e3
        told_ms = rows[:, FIELDS_FROM] / 1e3
        with np.errstate(invalid="ignore"):
            told_ms = told_ms + np.round((boot_ms - told_ms) / _WRAP_OF_US_MS) * _WRAP_OF_US_MS
        clock_s: Float = told_ms / 1e3 + self.later_s[self.boot[near]]
        return clock_s

    def on_arrival(self, rows: Float) -> Float:
        """Return the clock when packets of others arrived, s."""
        boot = np.maximum(self.boot_of(rows), 1)
        arrived: Float = rows[:, STAMP] - self.arrived_s[boot - 1] + self.later_s[boot]
        return arrived


def _add_utc_on_arrival(
    utc_s: Float, arrived_s: Float, boots: tuple[Boot, ...], packets: Packets, sender: Sender
) -> None:
    """Add UTC minus time since boot, (n,) s, of boots in which others than the autopilot told UTC; NaN is unknown."""
    for other in _tellers_of_time(packets, sender):
        times = packets.times(other)
        late_s = told_utc_s(times) - times[:, STAMP]
        for boot in boots:
            inside = within(times[:, AT].astype(np.int64), boot.spans)
            if np.isnan(utc_s[boot.number - 1]) and inside.any():
                utc_s[boot.number - 1] = np.median(late_s[inside]) + arrived_s[boot.number - 1]


def _add_utc_by_recorder(utc_s: Float, arrived_s: Float, spans: list[tuple[float, float]]) -> None:
    """Add UTC minus time since boot, (n,) s, of boots that were recorded soon before or after one whose UTC is known.

    The recorder's clock is wrong by as much in both, unless the file was joined of recordings.
    """
    known = np.flatnonzero(np.isfinite(utc_s))
    for boot in np.flatnonzero(np.isnan(utc_s)):
        first_s, last_s = spans[boot]
        apart_s = [max(spans[k][0] - last_s, first_s - spans[k][1]) for k in known]
        near = int(np.argmin(apart_s))
        if 0 <= apart_s[near] <= _SAME_RECORDING_S:
            utc_s[boot] = arrived_s[boot] + utc_s[known[near]] - arrived_s[known[near]]


def _tellers_of_time(packets: Packets, sender: Sender) -> list[Sender]:
    """Return who else tells UTC, other components of the autopilot's system first."""
    others = [other for other in packets.senders("SYSTEM_TIME") if other != sender]
    return sorted(others, key=lambda other: other[0] != sender[0])


def _and(systems: list[int]) -> str:
    return " and ".join(map(str, systems))
