"""The packets of a telemetry log, found in one pass over the file; messages are decoded on first use.

A ground station writes every received packet after an arrival time by its own clock: eight bytes, microseconds since
1970.  pymavlink decodes the packets.
"""

import mmap
import re
import struct
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from glstar.arrays import Float
from glstar.telemetry.source import YEAR_2010_S, plausible_utc, suppressed_output

# System and component of a sender.
Sender = tuple[int, int]

# The messages that are read, by number: name and fields.
_IMU = ("time_boot_ms", "xgyro", "ygyro", "zgyro")
MESSAGES = {
    0: ("HEARTBEAT", ("autopilot", "type")),
    2: ("SYSTEM_TIME", ("time_boot_ms", "time_unix_usec")),
    24: ("GPS_RAW_INT", ("fix_type", "lat", "lon", "alt")),
    26: ("SCALED_IMU", _IMU),
    27: ("RAW_IMU", ("time_usec", *_IMU[1:])),
    30: ("ATTITUDE", ("time_boot_ms", "roll", "pitch", "yaw")),
    31: ("ATTITUDE_QUATERNION", ("time_boot_ms", "q1", "q2", "q3", "q4")),
    33: ("GLOBAL_POSITION_INT", ("time_boot_ms", "lat", "lon", "alt")),
    105: ("HIGHRES_IMU", ("time_usec", *_IMU[1:])),
    112: ("CAMERA_TRIGGER", ("time_usec", "seq")),
    115: (
        "HIL_STATE_QUATERNION",
        ("time_usec", *(f"attitude_quaternion[{k}]" for k in range(4)), "lat", "lon", "alt"),
    ),
    116: ("SCALED_IMU2", _IMU),
    129: ("SCALED_IMU3", _IMU),
    148: ("AUTOPILOT_VERSION", ("flight_sw_version",)),
    158: ("MOUNT_STATUS", ("pointing_a", "pointing_b", "pointing_c")),
    180: ("CAMERA_FEEDBACK", ("time_usec", "img_idx", "cam_idx")),
    253: ("STATUSTEXT", ()),
    263: ("CAMERA_IMAGE_CAPTURED", ("time_utc", "image_index", "camera_id", "time_boot_ms", "capture_result")),
    265: ("MOUNT_ORIENTATION", ("time_boot_ms", "roll", "pitch", "yaw")),
    285: ("GIMBAL_DEVICE_ATTITUDE_STATUS", ("time_boot_ms", "flags", *(f"q[{k}]" for k in range(4)))),
}
_NUMBERS = {name: number for number, (name, _) in MESSAGES.items()}

# Messages that are needed more than once, and are decoded once.
_KEPT = {"HEARTBEAT", "STATUSTEXT"}
# Messages that only ArduPilot's dialect has.
_OF_ARDUPILOT = {"CAMERA_FEEDBACK", "MOUNT_STATUS"}
# Messages with attitude.  The last one is a simulator's own state, used if a system sends neither of the others.
QUATERNION = "ATTITUDE_QUATERNION"
EULER = "ATTITUDE"
HIL_STATE = "HIL_STATE_QUATERNION"

# The columns of a packet: position in the file, arrival time, sender, and the fields of the message from the last on.
AT, STAMP, SYSTEM, COMPONENT, FIELDS_FROM = range(5)
# MAV_AUTOPILOT_INVALID: the heartbeat of a ground station, a gimbal or a companion computer.
NO_AUTOPILOT = 8


class Packets(Protocol):
    """The packets of a log by message: one array a message, one row a packet."""

    count: int  # Number of packets of all messages
    whole_bytes: int  # End of the last complete packet in the file
    unread_bytes: int  # Bytes of the file that belong to no packet
    checked: bool  # Whether each packet has a checksum

    @abstractmethod
    def message(self, name: str) -> Float:
        """Return the packets of one of `MESSAGES`, (n, `FIELDS_FROM` + fields), in the order of the file.

        Timestamps of HIL_STATE_QUATERNION are converted to ms, as in the other messages with attitude.
        """

    @abstractmethod
    def texts(self, sender: Sender) -> list[str]:
        """Return the status texts of a sender, in the order of the file."""

    def status_texts(self, sender: Sender) -> tuple[Float, list[str]]:  # noqa: ARG002 - of a log without texts
        """Return when status texts of a sender arrived, (n, `FIELDS_FROM`), and the texts."""
        return np.empty((0, FIELDS_FROM)), []

    def custom_modes(self, sender: Sender) -> Float:  # noqa: ARG002 - of a log without modes
        """Return when heartbeats of a sender arrived, with custom_mode, (n, `FIELDS_FROM` + 1)."""
        return np.empty((0, FIELDS_FROM + 1))

    def amount(self, name: str) -> int:
        """Return the number of packets of a message, of all senders, perhaps with damaged ones."""
        return len(self.message(name))

    def called(self, sender: Sender) -> str:
        """Return the name of a sender, for messages."""
        return f"system {sender[0]}, component {sender[1]}"

    def lack(self, name: str) -> str:
        """Return that a message is missing, for messages."""
        return f"it has no {name}"

    def rows(self, name: str, sender: Sender) -> Float:
        """Return the packets of one message from one sender."""
        rows = self.message(name)
        from_sender: Float = rows[(rows[:, SYSTEM] == sender[0]) & (rows[:, COMPONENT] == sender[1])]
        return from_sender

    def times(self, sender: Sender) -> Float:
        """Return the SYSTEM_TIME packets of one sender with a valid UTC."""
        rows = self.rows("SYSTEM_TIME", sender)
        valid: Float = rows[plausible_utc(system_time_utc_s(rows))]
        return valid

    def senders(self, *names: str) -> list[Sender]:
        """Return the senders of any of some messages, in the order of their first packet."""
        rows = np.concatenate([self.message(name)[:, :FIELDS_FROM] for name in names])
        rows = rows[np.argsort(rows[:, AT], kind="stable")]
        return list(dict.fromkeys((int(row[SYSTEM]), int(row[COMPONENT])) for row in rows))

    def autopilots(self) -> set[Sender]:
        """Return the senders whose heartbeats say that they are autopilots."""
        rows = self.message("HEARTBEAT")
        return {(int(row[SYSTEM]), int(row[COMPONENT])) for row in rows[rows[:, FIELDS_FROM] != NO_AUTOPILOT]}

    def attitude_messages(self, sender: Sender) -> tuple[str, ...]:
        """Return the messages with the attitude of a sender: those of its estimator, else a simulator's state."""
        estimated = tuple(name for name in (QUATERNION, EULER) if len(self.rows(name, sender)))
        return estimated or ((HIL_STATE,) if len(self.rows(HIL_STATE, sender)) else ())

    def timestamps_are_utc(self, sender: Sender) -> bool:
        """Return whether the attitude of a sender is timed by UTC: some simulators do so in HIL_STATE_QUATERNION."""
        if self.attitude_messages(sender) != (HIL_STATE,):
            return False
        return bool(np.median(self.rows(HIL_STATE, sender)[:, FIELDS_FROM]) / 1e3 >= YEAR_2010_S)

    def first_stamp_s(self, sender: Sender) -> float:
        """Return the arrival time of the first attitude of a sender, s since 1970."""
        rows = np.concatenate([self.rows(name, sender)[:, :FIELDS_FROM] for name in self.attitude_messages(sender)])
        return float(rows[np.argmin(rows[:, AT]), STAMP])


def system_time_utc_s(times: Float) -> Float:
    """Return the UTC of SYSTEM_TIME packets, s since 1970."""
    utc_s: Float = times[:, FIELDS_FROM + 1] * 1e-6
    return utc_s


def has_boot_ms(name: str) -> bool:
    """Return whether a message has its time since boot in ms; otherwise it is in us, of 64 or 32 bits."""
    return MESSAGES[_NUMBERS[name]][1][0] == "time_boot_ms"


def with_ms(name: str, rows: Float) -> Float:
    """Return packets with the timestamps of HIL_STATE_QUATERNION converted from us to ms, in place."""
    if name == HIL_STATE:
        rows[:, FIELDS_FROM] *= 1e-3
    return rows


# --- the packets of a file --------------------------------------------------------------------------------------------

_STAMP_BYTES = 8
_STAMPED = struct.Struct(">QB")  # microseconds since 1970, and the first byte of a packet
_V1, _V2 = 0xFE, 0xFD
_HEAD_V1, _HEAD_V2 = struct.Struct("<BBBBBB"), struct.Struct("<BBBBBBBHB")
_SUM_BYTES, _SIGNATURE_BYTES = 2, 13
_SIGNED = 0x01
_MAGIC = re.compile(rb"[\xfd\xfe]")
# Number of consecutive packets that are not there by chance.
_ROW = 3
_YEAR_2000_US, _YEAR_2100_US, _HOUR_US = 946684800_000000, 4102444800_000000, 3600_000000


def is_telemetry_log(head: bytes) -> bool:
    """Return whether a file is a telemetry log: it begins with an arrival time of this century and a packet.

    If the first one is damaged, three consecutive packets in the first bytes suffice.
    """
    if len(head) < _STAMPED.size:
        return False
    stamp_us, magic = _STAMPED.unpack_from(head)
    if magic in (_V1, _V2) and _YEAR_2000_US <= stamp_us < _YEAR_2100_US:
        return True
    return any(_begins_row(head, magic.start() - _STAMP_BYTES) for magic in _MAGIC.finditer(head, _STAMP_BYTES))


def _begins_row(head: bytes, at: int) -> bool:
    """Return whether a sequence of packets begins at an offset, with arrival times within an hour."""
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
    """The packets of a telemetry log."""

    checked = True

    def __init__(self, path: str) -> None:
        self._path = path
        self._extents: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self._decoded: dict[str, Float] = {}
        self._kept: dict[str, list[tuple[int, int, Any]]] = {}
        self.count = self.whole_bytes = packet_bytes = 0
        with Path(path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            for at, stop in _packets(raw):
                self.count += 1
                self.whole_bytes = stop
                packet_bytes += stop - at
                number = _number(raw, at)
                if number in MESSAGES:
                    self._extents[number].append((at, stop))
            self.unread_bytes = len(raw) - packet_bytes

    def message(self, name: str) -> Float:
        """Return the packets of one message with a correct checksum, in the order of the file."""
        if name not in self._decoded:
            fields = MESSAGES[_NUMBERS[name]][1]
            rows = [
                (at, stamp_us * 1e-6, *_sender(message), *(_value(message, field) for field in fields))
                for at, stamp_us, message in self._messages(name)
            ]
            table = np.array(rows, dtype=np.float64).reshape(-1, FIELDS_FROM + len(fields))
            self._decoded[name] = with_ms(name, table)
        return self._decoded[name]

    def amount(self, name: str) -> int:
        """Return the number of packets of a message, without decoding them."""
        return len(self._extents.get(_NUMBERS[name], ()))

    def texts(self, sender: Sender) -> list[str]:
        """Return the status texts of a sender, in the order of the file."""
        return [message.text for *_, message in self._messages("STATUSTEXT") if _sender(message) == sender]

    def status_texts(self, sender: Sender) -> tuple[Float, list[str]]:
        """Return when status texts of a sender arrived, (n, `FIELDS_FROM`), and the texts."""
        packets = list(self._sent("STATUSTEXT", "text", sender))
        rows = np.array([head for *head, _ in packets], dtype=np.float64).reshape(-1, FIELDS_FROM)
        return rows, [text for *_, text in packets]

    def custom_modes(self, sender: Sender) -> Float:
        """Return when heartbeats of a sender arrived, with custom_mode, (n, `FIELDS_FROM` + 1)."""
        rows = list(self._sent("HEARTBEAT", "custom_mode", sender))
        return np.array(rows, dtype=np.float64).reshape(-1, FIELDS_FROM + 1)

    def _sent(self, name: str, field: str, sender: Sender) -> Iterator[tuple[Any, ...]]:
        """Yield position, arrival time, system, component and one field of each packet of a sender."""
        for at, stamp_us, message in self._messages(name):
            if _sender(message) == sender:
                yield at, stamp_us * 1e-6, *sender, getattr(message, field)

    def _messages(self, name: str) -> Iterable[tuple[int, int, Any]]:
        """Return file position, arrival time and decoded message of each packet of a message."""
        if name not in _KEPT:
            return self._decode(name)
        if name not in self._kept:
            self._kept[name] = list(self._decode(name))
        return self._kept[name]

    def _decode(self, name: str) -> Iterator[tuple[int, int, Any]]:
        extents = self._extents.get(_NUMBERS[name])
        if not extents:
            return
        decode = _decoder("ardupilotmega") if name in _OF_ARDUPILOT else _decoder()
        with Path(self._path).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
            for at, stop in extents:
                if (message := decode(raw[at + _STAMP_BYTES : stop])) is not None:
                    yield at, _STAMPED.unpack_from(raw, at)[0], message


def _value(message: Any, field: str) -> float:
    """Return a field of a message, or an item of a field that is an array: ``name[0]``."""
    name, _, item = field.partition("[")
    value = getattr(message, name)
    return float(value[int(item[:-1])] if item else value)


def _sender(message: Any) -> Sender:
    return message.get_srcSystem(), message.get_srcComponent()


def _packets(raw: mmap.mmap) -> Iterator[tuple[int, int]]:
    """Yield start and end of each packet with its arrival time; pymavlink later rejects damaged ones."""
    at, end = 0, len(raw)
    while at < end:
        stop = _stop(raw, at)
        if stop is not None:
            yield at, stop
        # If no packet follows, this one or the next one is damaged: search from the next byte on.
        at = stop if stop is not None and (stop == end or _stop(raw, stop) is not None) else _resumed(raw, at + 1)


def _stop(raw: mmap.mmap | bytes, at: int) -> int | None:
    """Return the end of the packet whose timestamp begins at an offset; None if there is no packet."""
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
    """Return the next offset at which a sequence of packets begins; the end if there is none."""
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
    """Return the message number of a packet."""
    start = at + _STAMP_BYTES
    if raw[start] == _V1:
        number: int = _HEAD_V1.unpack_from(raw, start)[5]
    else:
        *_, low, high = _HEAD_V2.unpack_from(raw, start)
        number = low | high << 16
    return number


def _decoder(dialect: str = "common") -> Any:
    """Return a function that decodes a packet with pymavlink; it returns None if the checksum is wrong."""
    with suppressed_output():
        # One dialect by name: mavutil would load all of them.
        mavlink = import_module(f"pymavlink.dialects.v20.{dialect}")
        link = mavlink.MAVLink(None)

    def decode(packet: bytes) -> Any:
        try:
            return link.decode(bytearray(packet))
        except mavlink.MAVError:
            return None

    return decode
