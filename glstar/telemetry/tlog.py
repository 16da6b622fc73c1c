"""MAVLink telemetry logs (``.tlog``): which vehicle, which attitude, which place, which UTC.

A ground station writes every packet that it hears behind a stamp of its own clock: eight bytes, microseconds since
1970.  pymavlink decodes the packets.  What glstar reads of them:

====================  ============================================  ================================================
message               fields                                        used for
====================  ============================================  ================================================
HEARTBEAT             autopilot                                     who is an autopilot, of all that speak
ATTITUDE_QUATERNION   time_boot_ms, q1..q4, body to NED             attitude
ATTITUDE              time_boot_ms, roll, pitch, yaw                attitude, where it is sent more often
GLOBAL_POSITION_INT   time_boot_ms, lat, lon, alt                   place
SYSTEM_TIME           time_boot_ms, time_unix_usec                  UTC
====================  ============================================  ================================================

The clock is the autopilot's time since boot.  The stamps are neither that nor UTC: a ground station's clock may be
wrong by seconds or years.  They serve to bring together what has no time since boot in common: an autopilot without UTC
and a ground station that tells it, or two boots of one autopilot.
"""

import mmap
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.rotation import conjugate, quaternion_from_euler
from glstar.telemetry.quiet import quiet
from glstar.telemetry.sound import UNIT_TOLERANCE, YEAR_2010_S, YEAR_2100_S, no_places, places, sound_times, spikes
from glstar.telemetry.source import AttitudeSamples, ClockSamples, PositionSamples, Samples, TelemetrySource
from glstar.timescale import format_utc

__all__ = ["TelemetryLogReader", "is_telemetry_log"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]
# Who sends: system and component.
Sender = tuple[int, int]

_QUATERNION, _EULER = "ATTITUDE_QUATERNION", "ATTITUDE"
# Of the messages that are read: number, name, fields.
_MESSAGES: Final = {
    0: ("HEARTBEAT", ("autopilot",)),
    2: ("SYSTEM_TIME", ("time_boot_ms", "time_unix_usec")),
    30: (_EULER, ("time_boot_ms", "roll", "pitch", "yaw")),
    31: (_QUATERNION, ("time_boot_ms", "q1", "q2", "q3", "q4")),
    33: ("GLOBAL_POSITION_INT", ("time_boot_ms", "lat", "lon", "alt")),
}
_TIMED = (_QUATERNION, _EULER, "GLOBAL_POSITION_INT", "SYSTEM_TIME")
# What a ground station, a gimbal or a companion computer says in its heartbeat.
_NO_AUTOPILOT = 8
_FIRST_AUTOPILOT = 1

# Packets overtake each other by less; a clock that goes back by more begins anew.
_REBOOT_S = 5.0
_BOOT_SPIKE_S = 1.0
# time_boot_ms has 32 bits: 49.7 days.
_WRAP_S = 2**32 / 1000


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

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", sysid: int | None = None) -> None:
        self.name = os.fspath(path)
        self._attitude, self._sysid = attitude, sysid
        self._packets = _Packets(self.name)

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places and the UTC of the whole log, a batch each.

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

    def close(self) -> None:
        """Do nothing: the file is open only while it is read."""

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

    def _attitudes(self, sender: Sender, systems: list[int], clock: "_Clock") -> AttitudeSamples:
        there = {name: rows for name in (_QUATERNION, _EULER) if (rows := self._packets.rows(name, sender)).size}
        wanted = self._attitude.strip().upper()
        if wanted == "AUTO":
            often = len(there.get(_EULER, ())) > 2 * len(there.get(_QUATERNION, ()))
            wanted = _EULER if often else _QUATERNION
        if wanted not in there:
            raise self._error(f"the log has no attitude {self._attitude!r}; it has {' and '.join(there)}")
        rows = there[wanted]
        clock_s, boot = clock.read(rows)
        with np.errstate(over="ignore", invalid="ignore"):
            told = rows[:, _FIELDS_FROM + 1 :]
            q = conjugate(told) if wanted == _QUATERNION else quaternion_from_euler(*told.T)
            sound = np.abs(np.linalg.norm(q, axis=-1) - 1) < UNIT_TOLERANCE  # False for NaN too
        sound &= sound_times(clock_s)
        # An estimator sends (1, 0, 0, 0) until it has found out where down and north are.
        aligned = (q != (1.0, 0.0, 0.0, 0.0)).any(axis=-1)
        sound[: np.argmax(aligned) if aligned.any() else None] &= wanted != _QUATERNION
        choice = f" of system {sender[0]} (of {_and(systems)}; sysid chooses)" if len(systems) > 1 else ""
        return AttitudeSamples(clock_s[sound], q[sound], boot[sound], f"{wanted}{choice}")

    def _error(self, message: str) -> LogFormatError:
        return LogFormatError(self.name, message, offset=self._packets.whole_bytes)


def _positions(packets: "_Packets", sender: Sender, clock: "_Clock") -> PositionSamples:
    rows = packets.rows("GLOBAL_POSITION_INT", sender)
    clock_s, _ = clock.read(rows)
    latitude, longitude, height_mm = rows[:, _FIELDS_FROM + 1 :].T
    known = places(clock_s, latitude / 1e7, longitude / 1e7, height_mm / 1e3, "GLOBAL_POSITION_INT")
    if known.clock_s.size:
        return known
    return no_places("its GLOBAL_POSITION_INT never knew the place" if len(rows) else "it has no GLOBAL_POSITION_INT")


def _utc(packets: "_Packets", sender: Sender, clock: "_Clock") -> ClockSamples:
    """Return the UTC of the autopilot itself, else of another component of its system, else of any other system."""
    times = packets.times(sender)
    if len(times):
        return ClockSamples(clock.read(times)[0], _utc_s(times), f"SYSTEM_TIME, {len(times)} readings")
    for other in sorted(packets.senders("SYSTEM_TIME"), key=lambda one: one[0] != sender[0]):
        if len(times := packets.times(other)):
            source = f"SYSTEM_TIME of system {other[0]}, component {other[1]}, on arrival, {len(times)} readings"
            return ClockSamples(clock.on_arrival(times), _utc_s(times), source)
    stamp_s = packets.first_stamp_s(sender)
    recorder = f"; the recorder's own clock said {format_utc(stamp_s)}" if YEAR_2010_S <= stamp_s < YEAR_2100_S else ""
    return ClockSamples(np.empty(0), np.empty(0), f"no SYSTEM_TIME after 2010{recorder}")


@dataclass(frozen=True, slots=True, eq=False)
class _Clock:
    """The clock of one autopilot, which goes on from its first boot through all others."""

    # Of every packet with a time since boot, in the order of the file.
    at: Float
    boot: Integer
    wraps: Integer
    # Of every boot, what is to be added to its time, s.
    later_s: Float
    # By the recorder's clock, when the first boot was, s.
    boot_stamp_s: float

    @classmethod
    def of(cls, packets: "_Packets", sender: Sender) -> "_Clock":
        """Return the clock of a sender with at least one packet that is timed."""
        heads = np.concatenate([packets.rows(name, sender)[:, : _FIELDS_FROM + 1] for name in _TIMED])
        heads = heads[np.argsort(heads[:, _AT], kind="stable")]
        kept = heads[~spikes(heads[:, _FIELDS_FROM] / 1e3, _BOOT_SPIKE_S)]
        heads = kept if len(kept) else heads
        boot_s, stamp_s = heads[:, _FIELDS_FROM] / 1e3, heads[:, _STAMP]
        wraps = np.concatenate([[0], np.cumsum(np.diff(boot_s) < -_WRAP_S / 2)])
        boot_s = boot_s + wraps * _WRAP_S
        boot = np.concatenate([[0], np.cumsum(np.diff(boot_s) < -_REBOOT_S)])

        clock = cls(heads[:, _AT], boot, wraps, np.zeros(boot[-1] + 1), 0.0)
        arrived_s = _medians(stamp_s - boot_s, boot)
        utc_s = arrived_s + 0.0
        if len(times := packets.times(sender)):
            read_s, of_boot = clock.read(times)
            found = np.unique(of_boot)
            utc_s[found] = _medians(_utc_s(times) - read_s, of_boot)
            # Where a boot knows no UTC, the recorder's clock and what it was found to be wrong by.
            wrong_s = np.median((utc_s - arrived_s)[found])
            silent = np.setdiff1d(np.arange(utc_s.size), found)
            utc_s[silent] += wrong_s
        return cls(heads[:, _AT], boot, wraps, utc_s - utc_s[0], float(arrived_s[0]))

    def read(self, rows: Float) -> tuple[Float, Integer]:
        """Return the clock of timed packets, s, and the number of the boot that each is of."""
        near = np.searchsorted(self.at, rows[:, _AT]).clip(max=self.at.size - 1)
        boot = self.boot[near]
        return rows[:, _FIELDS_FROM] / 1e3 + self.wraps[near] * _WRAP_S + self.later_s[boot], boot

    def on_arrival(self, rows: Float) -> Float:
        """Return the clock when packets of others arrived, s."""
        return rows[:, _STAMP] - self.boot_stamp_s


def _medians(values: Float, group: Integer) -> Float:
    """Return the median of each group of values; the numbers of the groups rise."""
    return np.array([np.median(part) for part in np.split(values, np.flatnonzero(np.diff(group)) + 1)])


def _utc_s(times: Float) -> Float:
    utc_s: Float = times[:, _FIELDS_FROM + 1] * 1e-6
    return utc_s


def _and(systems: list[int]) -> str:
    return " and ".join(map(str, systems))


# --- the packets of the file ------------------------------------------------------------------------------------------

_STAMP_BYTES = 8
_STAMPED = struct.Struct(">QB")  # microseconds since 1970, and the first byte of a packet
_V1, _V2 = 0xFE, 0xFD
_HEAD_V1, _HEAD_V2 = struct.Struct("<BBBBBB"), struct.Struct("<BBBBBBBHB")
_SUM_BYTES, _SIGNATURE_BYTES = 2, 13
_SIGNED = 0x01
_MAGIC = re.compile(rb"[\xfd\xfe]")
# So many packets in a row are no chance.
_ROW = 3
_YEAR_2000_US, _YEAR_2100_US = 946684800_000000, 4102444800_000000

# The columns of a packet: where it lies, the recorder's stamp, who sent it, and from here on the fields of its message.
_AT, _STAMP, _SYSTEM, _COMPONENT, _FIELDS_FROM = range(5)


def is_telemetry_log(head: bytes) -> bool:
    """Return whether a file that begins so is a telemetry log: a stamp of our days, and a packet.

    Parameters
    ----------
    head : bytes
        The first bytes of the file.

    Returns
    -------
    bool
    """
    if len(head) < _STAMPED.size:
        return False
    stamp_us, magic = _STAMPED.unpack_from(head)
    return magic in (_V1, _V2) and _YEAR_2000_US <= stamp_us < _YEAR_2100_US


class _Packets:
    """The packets of a telemetry log that matter, one array a message, a row a packet."""

    def __init__(self, path: str) -> None:
        rows: dict[str, list[tuple[float, ...]]] = {name: [] for name, _ in _MESSAGES.values()}
        self.count = self.whole_bytes = 0
        decode = _decoder()
        with Path(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            for at, stop in _packets(raw):
                self.count, self.whole_bytes = self.count + 1, stop
                number, sender = _head(raw, at)
                if number not in _MESSAGES:
                    continue
                name, fields = _MESSAGES[number]
                if (message := decode(raw[at + _STAMP_BYTES : stop])) is not None:
                    (stamp_us, _) = _STAMPED.unpack_from(raw, at)
                    told = (getattr(message, field) for field in fields)
                    rows[name].append((at, stamp_us * 1e-6, *sender, *told))
        self._rows = {
            name: np.array(rows[name], dtype=np.float64).reshape(-1, _FIELDS_FROM + len(fields))
            for name, fields in _MESSAGES.values()
        }

    def rows(self, name: str, sender: Sender) -> Float:
        """Return what one sender said in one message."""
        rows = self._rows[name]
        theirs: Float = rows[(rows[:, _SYSTEM] == sender[0]) & (rows[:, _COMPONENT] == sender[1])]
        return theirs

    def times(self, sender: Sender) -> Float:
        """Return the readings of UTC of one sender, without those that are none."""
        rows = self.rows("SYSTEM_TIME", sender)
        utc_s = _utc_s(rows)
        believable: Float = rows[(utc_s >= YEAR_2010_S) & (utc_s < YEAR_2100_S)]
        return believable

    def senders(self, *names: str) -> list[Sender]:
        """Return who sent one of these messages, in the order of their first."""
        rows = np.concatenate([self._rows[name][:, :_FIELDS_FROM] for name in names])
        rows = rows[np.argsort(rows[:, _AT], kind="stable")]
        return list(dict.fromkeys((int(row[_SYSTEM]), int(row[_COMPONENT])) for row in rows))

    def autopilots(self) -> set[Sender]:
        """Return who says in a heartbeat that it flies something."""
        rows = self._rows["HEARTBEAT"]
        flying = rows[rows[:, _FIELDS_FROM] != _NO_AUTOPILOT]
        return {(int(row[_SYSTEM]), int(row[_COMPONENT])) for row in flying}

    def first_stamp_s(self, sender: Sender) -> float:
        """Return the recorder's clock at a sender's first attitude, s since 1970."""
        rows = np.concatenate([self.rows(name, sender)[:, :_FIELDS_FROM] for name in (_QUATERNION, _EULER)])
        return float(rows[np.argmin(rows[:, _AT]), _STAMP])


def _packets(raw: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Yield where each packet begins, with its stamp, and ends; pymavlink has the last word on damaged ones."""
    at, end = 0, len(raw)
    while at < end:
        stop = _stop(raw, at)
        if stop is not None:
            yield at, stop
        # Either this packet is damaged, and a wrong length leads into nowhere, or the next one is.
        at = stop if stop is not None and (stop == end or _stop(raw, stop) is not None) else _resumed(raw, at + 1)


def _stop(raw: mmap.mmap, at: int) -> int | None:
    """Return where the packet ends whose stamp begins at an offset; None where none can begin."""
    start = at + _STAMP_BYTES
    if start + _HEAD_V1.size + _SUM_BYTES > len(raw):
        return None
    magic, length, flags = raw[start], raw[start + 1], raw[start + 2]
    if magic == _V1:
        stop = start + _HEAD_V1.size + length + _SUM_BYTES
    elif magic == _V2 and flags & ~_SIGNED == 0:
        stop = start + _HEAD_V2.size + length + _SUM_BYTES + (_SIGNATURE_BYTES if flags else 0)
    else:
        return None
    return stop if stop <= len(raw) else None


def _resumed(raw: mmap.mmap, start: int) -> int:
    """Return the first offset from which packets follow each other again; the end where they do not."""
    for magic in _MAGIC.finditer(raw, start + _STAMP_BYTES):
        at: int | None = magic.start() - _STAMP_BYTES
        for _ in range(_ROW):
            if at is None or at == len(raw):
                break
            at = _stop(raw, at)
        if at is not None:
            return magic.start() - _STAMP_BYTES
    return len(raw)


def _head(raw: mmap.mmap, at: int) -> tuple[int, Sender]:
    """Return the number of a packet's message, and who sent it."""
    start = at + _STAMP_BYTES
    if raw[start] == _V1:
        _, _, _, system, component, number = _HEAD_V1.unpack_from(raw, start)
    else:
        _, _, _, _, _, system, component, low, high = _HEAD_V2.unpack_from(raw, start)
        number = low | high << 16
    return number, (system, component)


def _decoder() -> Any:
    """Return pymavlink's reading of one packet, imported on first use: its message, None where the sum is wrong."""
    with quiet():
        # One dialect by its name: choosing one by mavutil loads all of them, and would open a device of that name.
        from pymavlink.dialects.v20 import common  # noqa: PLC0415

        link = common.MAVLink(None)

    def decode(packet: bytes) -> Any:
        try:
            return link.decode(bytearray(packet))
        except common.MAVError:
            return None

    return decode
