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
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.telemetry.sound import (
    UNIT_TOLERANCE,
    YEAR_2010_S,
    YEAR_2100_S,
    no_places,
    places,
    sound_rates,
    sound_times,
    spikes,
)
from glstar.telemetry.source import (
    AttitudeSamples,
    ClockSamples,
    LogFacts,
    PositionSamples,
    RateSamples,
    Samples,
    TelemetrySource,
)
from glstar.telemetry.tlogfile import AT, FIELDS_FROM, STAMP, LogPackets, Packets, Sender, is_telemetry_log, told_utc_s
from glstar.telemetry.vehicles import ARDUPILOT, autopilot, vehicle_kind, version
from glstar.timescale import format_utc

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
_REBOOT = "a reboot of the autopilot"
_BOOT_SPIKE_S = 1.0
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

    Raises
    ------
    LogFormatError
        If the file holds no whole packet that matters.
    """

    format = "MAVLink telemetry log"

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", sysid: int | None = None) -> None:
        self.name = os.fspath(path)
        self._attitude, self._sysid = attitude, sysid
        self._packets = self._open()

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places, the UTC and the rates of the whole log, a batch each; the rates last.

        Nothing is decoded before it is asked for: who takes three batches and no more does not wait for the gyros.

        Raises
        ------
        LogFormatError
            If the log has no attitude, or not the one that was asked for.
        """
        sender, others = self._vehicle()
        clock = _Clock.of(self._packets, sender)
        yield self._attitudes(sender, others, clock)
        yield _positions(self._packets, sender, clock)
        yield _utc(self._packets, sender, clock)
        yield from _rates(self._packets, sender, clock)

    def facts(self) -> LogFacts:
        """Return what the aircraft says of itself.

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
        """Yield every attitude that the aircraft tells, each after its name."""
        sender, systems = self._vehicle()
        clock = _Clock.of(self._packets, sender)
        for name in self._told(sender):
            yield name, self._attitude_of(name, sender, systems, clock)

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""

    def _open(self) -> Packets:
        return LogPackets(self.name)

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

    def _told(self, sender: Sender) -> list[str]:
        """Return the messages in which a sender tells its attitude, the one to prefer first."""
        count = {name: len(self._packets.rows(name, sender)) for name in (_QUATERNION, _EULER)}
        # Rounded to float32 both are as good; but where one is rare, the other one tells more.
        order = (_EULER, _QUATERNION) if count[_EULER] > 2 * count[_QUATERNION] else (_QUATERNION, _EULER)
        return [name for name in order if count[name]]

    def _attitudes(self, sender: Sender, systems: list[int], clock: "_Clock") -> AttitudeSamples:
        there, wanted = self._told(sender), self._attitude.strip().upper()
        if wanted not in ("AUTO", *there):
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {' and '.join(sorted(there))}")
        return self._attitude_of(there[0] if wanted == "AUTO" else wanted, sender, systems, clock)

    def _attitude_of(self, name: str, sender: Sender, systems: list[int], clock: "_Clock") -> AttitudeSamples:
        rows = self._packets.rows(name, sender)
        clock_s, boot = clock.read(rows)
        with np.errstate(over="ignore", invalid="ignore"):
            told = rows[:, FIELDS_FROM + 1 :]
            q = conjugate(told) if name == _QUATERNION else quaternion_from_euler(*told.T)
            sound = np.abs(np.linalg.norm(q, axis=-1) - 1) < UNIT_TOLERANCE  # False for NaN too
        sound &= sound_times(clock_s)
        # An estimator sends (1, 0, 0, 0) until it has found out where down and north are.
        aligned = (q != (1.0, 0.0, 0.0, 0.0)).any(axis=-1)
        sound[: np.argmax(aligned) if aligned.any() else None] &= name != _QUATERNION
        choice = f" of system {sender[0]} (of {_and(systems)}; sysid chooses)" if len(systems) > 1 else ""
        return AttitudeSamples(clock_s[sound], q[sound], boot[sound], f"{name}{choice}", _REBOOT)

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._packets.whole_bytes)


def _positions(packets: Packets, sender: Sender, clock: "_Clock") -> PositionSamples:
    rows = packets.rows("GLOBAL_POSITION_INT", sender)
    clock_s, _ = clock.read(rows)
    latitude, longitude, height_mm = rows[:, FIELDS_FROM + 1 :].T
    known = places(clock_s, latitude / 1e7, longitude / 1e7, height_mm / 1e3, "GLOBAL_POSITION_INT")
    if known.clock_s.size:
        return known
    # By the recorder's clock, for whether its own is UTC or the time since boot differs: a second late is near enough.
    fixes = packets.rows("GPS_RAW_INT", sender)
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
        return ClockSamples(clock.read(times)[0], told_utc_s(times), f"SYSTEM_TIME, {len(times)} readings")
    for other in sorted(packets.senders("SYSTEM_TIME"), key=lambda one: one[0] != sender[0]):
        if len(times := packets.times(other)):
            source = f"SYSTEM_TIME of {packets.called(other)}, on arrival, {len(times)} readings"
            return ClockSamples(clock.on_arrival(times), told_utc_s(times), source)
    lack = "no SYSTEM_TIME after 2010" if packets.senders("SYSTEM_TIME") else packets.lack("SYSTEM_TIME")
    stamp_s = packets.first_stamp_s(sender)
    recorder = f"; the recorder's own clock said {format_utc(stamp_s)}" if YEAR_2010_S <= stamp_s < YEAR_2100_S else ""
    return ClockSamples(np.empty(0), np.empty(0), f"{lack}{recorder}")


def _rates(packets: Packets, sender: Sender, clock: "_Clock") -> Iterator[RateSamples]:
    """Yield the rates that come most often; nothing where the attitude comes more often than they do."""
    least = max(2, *(len(packets.rows(name, sender)) for name in (_QUATERNION, _EULER)))
    names = [name for name in _GYROS if name != "RAW_IMU" or _is_ardupilot(packets, sender)]
    # Packets are counted before they are decoded: of three gyros the two slow ones need not be.
    often = [name for name in sorted(names, key=packets.amount, reverse=True) if packets.amount(name) >= least]
    name = next((name for name in often if len(packets.rows(name, sender)) >= least), None)
    if name is None:
        return
    rows = packets.rows(name, sender)
    with np.errstate(invalid="ignore", over="ignore"):
        rate = rows[:, FIELDS_FROM + 1 :] * _GYROS[name]
    clock_s = clock.read(rows)[0] if name.startswith("SCALED") else clock.read_us(rows)
    sound = sound_times(clock_s) & sound_rates(rate)
    if np.count_nonzero(sound) > 1:
        yield RateSamples(clock_s[sound], rate[sound], name)


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

    # Of every packet with a time since boot, in the order of the file.
    at: Float
    boot_s: Float
    boot: Integer
    wraps: Integer
    # Of every boot, what is to be added to its time, s.
    later_s: Float
    # By the recorder's clock, when the first boot was, s.
    boot_stamp_s: float

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
        boot = np.concatenate([[0], np.cumsum(np.diff(boot_s) < -_REBOOT_S)])

        clock = cls(heads[:, AT], boot_s, boot, wraps, np.zeros(boot[-1] + 1), 0.0)
        arrived_s = _medians(stamp_s - boot_s, boot)
        utc_s = arrived_s + 0.0
        if len(times := packets.times(sender)):
            read_s, of_boot = clock.read(times)
            found = np.unique(of_boot)
            utc_s[found] = _medians(told_utc_s(times) - read_s, of_boot)
            # Where a boot knows no UTC, the recorder's clock and what it was found to be wrong by.
            wrong_s = np.median((utc_s - arrived_s)[found])
            silent = np.setdiff1d(np.arange(utc_s.size), found)
            utc_s[silent] += wrong_s
        return cls(heads[:, AT], boot_s, boot, wraps, utc_s - utc_s[0], float(arrived_s[0]))

    def read(self, rows: Float) -> tuple[Float, Integer]:
        """Return the clock of timed packets, s, and the number of the boot that each is of."""
        near = np.searchsorted(self.at, rows[:, AT]).clip(max=self.at.size - 1)
        boot = self.boot[near]
        return rows[:, FIELDS_FROM] / 1e3 + self.wraps[near] * _WRAP_S + self.later_s[boot], boot

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
        return rows[:, STAMP] - self.boot_stamp_s


def _medians(values: Float, group: Integer) -> Float:
    """Return the median of each group of values; the numbers of the groups rise."""
    return np.array([np.median(part) for part in np.split(values, np.flatnonzero(np.diff(group)) + 1)])


def _and(systems: list[int]) -> str:
    return " and ".join(map(str, systems))
