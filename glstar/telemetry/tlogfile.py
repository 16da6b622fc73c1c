"""The packets of a telemetry log: one pass over the file, and each message decoded when it is asked for.

A ground station writes every packet that it hears behind a stamp of its own clock: eight bytes, microseconds since
1970.  pymavlink decodes the packets.
"""

import mmap
import re
import struct
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.telemetry.suppressedoutput import quiet
from glstar.telemetry.validation import YEAR_2010_S, YEAR_2100_S

__all__ = [
    "AT",
    "COMPONENT",
    "FIELDS_FROM",
    "MESSAGES",
    "STAMP",
    "SYSTEM",
    "LogPackets",
    "Packets",
    "Sender",
    "is_telemetry_log",
    "told_utc_s",
]

Float = NDArray[np.float64]
# Who sends: system and component.
Sender = tuple[int, int]

# Of the messages that are read: number, name, fields.
_IMU = ("time_boot_ms", "xgyro", "ygyro", "zgyro")
MESSAGES: Final = {
    0: ("HEARTBEAT", ("autopilot", "type")),
    2: ("SYSTEM_TIME", ("time_boot_ms", "time_unix_usec")),
    24: ("GPS_RAW_INT", ("fix_type", "lat", "lon", "alt")),
    26: ("SCALED_IMU", _IMU),
    27: ("RAW_IMU", ("time_usec", *_IMU[1:])),
    30: ("ATTITUDE", ("time_boot_ms", "roll", "pitch", "yaw")),
    31: ("ATTITUDE_QUATERNION", ("time_boot_ms", "q1", "q2", "q3", "q4")),
    33: ("GLOBAL_POSITION_INT", ("time_boot_ms", "lat", "lon", "alt")),
    105: ("HIGHRES_IMU", ("time_usec", *_IMU[1:])),
    116: ("SCALED_IMU2", _IMU),
    129: ("SCALED_IMU3", _IMU),
    148: ("AUTOPILOT_VERSION", ("flight_sw_version",)),
    253: ("STATUSTEXT", ()),
}
_NUMBERS: Final = {name: number for number, (name, _) in MESSAGES.items()}

# The columns of a packet: where it lies, the recorder's stamp, who sent it, and from here on the fields of its message.
AT, STAMP, SYSTEM, COMPONENT, FIELDS_FROM = range(5)
# What a ground station, a gimbal or a companion computer says in its heartbeat.
_NO_AUTOPILOT = 8


class Packets(Protocol):
    """The packets of a link that matter, one array a message, a row a packet.

    Attributes
    ----------
    count : int
        How many packets there are, of all kinds.
    whole_bytes : int
        How much of the file could be read.
    checked : bool
        Whether each packet has a checksum.
    """

    count: int
    whole_bytes: int
    checked: bool

    @abstractmethod
    def message(self, name: str) -> Float:
        """Return the packets of one message, in the order of the file.

        Parameters
        ----------
        name : str
            One of `MESSAGES`.

        Returns
        -------
        (n, `FIELDS_FROM` + fields) float64
        """

    @abstractmethod
    def texts(self, sender: Sender) -> list[str]:
        """Return what a sender said in words, in the order of the file."""

    def amount(self, name: str) -> int:
        """Return how many packets of a message there are, of all senders, damaged ones perhaps among them."""
        return len(self.message(name))

    def called(self, sender: Sender) -> str:
        """Return what to call a sender, in words."""
        return f"system {sender[0]}, component {sender[1]}"

    def lack(self, name: str) -> str:
        """Return that a message is not there, in words."""
        return f"it has no {name}"

    def rows(self, name: str, sender: Sender) -> Float:
        """Return what one sender said in one message."""
        rows = self.message(name)
        theirs: Float = rows[(rows[:, SYSTEM] == sender[0]) & (rows[:, COMPONENT] == sender[1])]
        return theirs

    def times(self, sender: Sender) -> Float:
        """Return the readings of UTC of one sender, without those that are none."""
        rows = self.rows("SYSTEM_TIME", sender)
        told_s = told_utc_s(rows)
        believable: Float = rows[(told_s >= YEAR_2010_S) & (told_s < YEAR_2100_S)]
        return believable

    def senders(self, *names: str) -> list[Sender]:
        """Return who sent one of these messages, in the order of their first."""
        rows = np.concatenate([self.message(name)[:, :FIELDS_FROM] for name in names])
        rows = rows[np.argsort(rows[:, AT], kind="stable")]
        return list(dict.fromkeys((int(row[SYSTEM]), int(row[COMPONENT])) for row in rows))

    def autopilots(self) -> set[Sender]:
        """Return who says in a heartbeat that it flies something."""
        rows = self.message("HEARTBEAT")
        flying = rows[rows[:, FIELDS_FROM] != _NO_AUTOPILOT]
        return {(int(row[SYSTEM]), int(row[COMPONENT])) for row in flying}

    def first_stamp_s(self, sender: Sender) -> float:
        """Return the recorder's clock at a sender's first attitude, s since 1970."""
        rows = np.concatenate(
            [self.rows(name, sender)[:, :FIELDS_FROM] for name in ("ATTITUDE_QUATERNION", "ATTITUDE")]
        )
        return float(rows[np.argmin(rows[:, AT]), STAMP])


def told_utc_s(times: Float) -> Float:
    """Return the UTC that rows of SYSTEM_TIME tell, s since 1970."""
    told_s: Float = times[:, FIELDS_FROM + 1] * 1e-6
    return told_s


# --- the packets of a file --------------------------------------------------------------------------------------------

_STAMP_BYTES = 8
_STAMPED = struct.Struct(">QB")  # microseconds since 1970, and the first byte of a packet
_V1, _V2 = 0xFE, 0xFD
_HEAD_V1, _HEAD_V2 = struct.Struct("<BBBBBB"), struct.Struct("<BBBBBBBHB")
_SUM_BYTES, _SIGNATURE_BYTES = 2, 13
_SIGNED = 0x01
_MAGIC = re.compile(rb"[\xfd\xfe]")
# So many packets in a row are no chance.
_ROW = 3
_YEAR_2000_US, _YEAR_2100_US, _HOUR_US = 946684800_000000, 4102444800_000000, 3600_000000


def is_telemetry_log(head: bytes) -> bool:
    """Return whether a file that begins so is a telemetry log: a stamp of our days, and a packet.

    Where the first stamp is damaged, some packets in a row later in the head will do.

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
    if magic in (_V1, _V2) and _YEAR_2000_US <= stamp_us < _YEAR_2100_US:
        return True
    return any(_begins_row(head, magic.start() - _STAMP_BYTES) for magic in _MAGIC.finditer(head, _STAMP_BYTES))


def _begins_row(head: bytes, at: int) -> bool:
    """Return whether packets follow each other from an offset on, stamped within an hour of each other."""
    first_us: int | None = None
    for _ in range(_ROW):
        stop = _stop(head, at)
        if stop is None:
            return False
        stamp_us, _ = _STAMPED.unpack_from(head, at)
        first_us = stamp_us if first_us is None else first_us
        if not _YEAR_2000_US <= stamp_us < _YEAR_2100_US or abs(stamp_us - first_us) > _HOUR_US:
            return False
        at = stop
    return True


class LogPackets(Packets):
    """The packets of a telemetry log.

    Parameters
    ----------
    path : str
        The log.
    """

    checked = True

    def __init__(self, path: str) -> None:
        self._path = path
        self._found: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self._decoded: dict[str, Float] = {}
        self.count = self.whole_bytes = 0
        with Path(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            for at, stop in _packets(raw):
                self.count, self.whole_bytes = self.count + 1, stop
                number = _number(raw, at)
                if number in MESSAGES:
                    self._found[number].append((at, stop))

    def message(self, name: str) -> Float:
        """Return the packets of one message, in the order of the file; those whose sum is wrong are left out."""
        if name not in self._decoded:
            fields = MESSAGES[_NUMBERS[name]][1]
            rows = [
                (at, stamp_us * 1e-6, *_sender(message), *(getattr(message, field) for field in fields))
                for at, stamp_us, message in self._messages(name)
            ]
            self._decoded[name] = np.array(rows, dtype=np.float64).reshape(-1, FIELDS_FROM + len(fields))
        return self._decoded[name]

    def amount(self, name: str) -> int:
        """Return how many packets of a message there are, none of them decoded."""
        return len(self._found.get(_NUMBERS[name], ()))

    def texts(self, sender: Sender) -> list[str]:
        """Return what a sender said in words, in the order of the file."""
        return [message.text for *_, message in self._messages("STATUSTEXT") if _sender(message) == sender]

    def _messages(self, name: str) -> Iterator[tuple[int, int, Any]]:
        """Yield where each packet of a message begins, its stamp, and what pymavlink reads in it."""
        found = self._found.get(_NUMBERS[name])
        if not found:
            return
        decode = _decoder()
        with Path(self._path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            for at, stop in found:
                if (message := decode(raw[at + _STAMP_BYTES : stop])) is not None:
                    yield at, _STAMPED.unpack_from(raw, at)[0], message


def _sender(message: Any) -> Sender:
    return message.get_srcSystem(), message.get_srcComponent()


def _packets(raw: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Yield where each packet begins, with its stamp, and ends; pymavlink has the last word on damaged ones."""
    at, end = 0, len(raw)
    while at < end:
        stop = _stop(raw, at)
        if stop is not None:
            yield at, stop
        # Either this packet is damaged, and a wrong length leads into nowhere, or the next one is.
        at = stop if stop is not None and (stop == end or _stop(raw, stop) is not None) else _resumed(raw, at + 1)


def _stop(raw: mmap.mmap | bytes, at: int) -> int | None:
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


def _number(raw: mmap.mmap, at: int) -> int:
    """Return the number of a packet's message."""
    start = at + _STAMP_BYTES
    if raw[start] == _V1:
        number: int = _HEAD_V1.unpack_from(raw, start)[5]
    else:
        *_, low, high = _HEAD_V2.unpack_from(raw, start)
        number = low | high << 16
    return number


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
