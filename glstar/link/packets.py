"""The MAVLink messages of a link, packets in a stream of bytes, and their recording to a telemetry log.

pymavlink decodes the contents of packets.  Its stream parser is not used: after a false start of a packet it drops as
many bytes as the false packet claims, with the valid packets in them.  Here every possible start of a packet is tried.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from enum import IntEnum
from math import inf
from pathlib import Path
from threading import Event, Lock, Thread
from types import TracebackType
from typing import Any, NamedTuple, Self

from glstar.errors import LinkError
from glstar.link.endpoint import Endpoint
from glstar.system.files import flush_directory, flush_handle
from glstar.telemetry.mavlink.vehicles import GIMBAL_MESSAGES
from glstar.telemetry.source import suppressed_output


class MessageId(IntEnum):
    """Numbers of the MAVLink messages of a link."""

    HEARTBEAT = 0
    SYSTEM_TIME = 2
    PARAM_VALUE = 22
    GPS_RAW_INT = 24
    ATTITUDE = 30
    ATTITUDE_QUATERNION = 31
    GLOBAL_POSITION_INT = 33
    COMMAND_ACK = 77
    SIM_STATE = 108  # Attitude and position of a simulator, without a time; SIMSTATE is the same of ArduPilot
    HIL_STATE_QUATERNION = 115  # Attitude and position of a simulator
    MOUNT_STATUS = 158
    SIMSTATE = 164
    MOUNT_ORIENTATION = 265
    GIMBAL_DEVICE_ATTITUDE_STATUS = 285


# Messages with the attitude of a gimbal, the best one first.
GIMBAL_IDS = tuple(MessageId[name] for name in GIMBAL_MESSAGES)
GIMBAL_NAMES = " or ".join(", ".join(GIMBAL_MESSAGES).rsplit(", ", 1))
# MAV_CMD_EXTERNAL_POSITION_ESTIMATE.
EXTERNAL_POSITION_ESTIMATE = 43003
# ArduPilot's parameters for the kinds of its GNSS receivers, before 4.6 too, and the `gps_id` of each in GPS_INPUT.
GPS_TYPES = {"GPS1_TYPE": 0, "GPS_TYPE": 0, "GPS2_TYPE": 1, "GPS_TYPE2": 1}

# Window in which rates are counted, s.
_RATE_WINDOW_S = 2.0
# Size of a packet with attitude, bytes, and the rate of all other requested messages, bytes/s.
_ATTITUDE_BYTES = 56
_OTHERS_BYTES_PER_S = 270.0
# Usable fraction of the baud rate: a radio also carries other messages, and the opposite direction.
_USABLE_FRACTION = 0.55
# Rates of attitude that are requested.
RATES_HZ = (100.0, 50.0, 40.0, 25.0, 20.0, 10.0, 5.0, 4.0, 2.0, 1.0)


class MessageRate:
    """Rate of a message over the last two seconds; its times are by `time.monotonic`, s."""

    def __init__(self) -> None:
        self._arrivals_s: deque[float] = deque(maxlen=2048)

    def add(self, arrival_s: float) -> None:
        """Count a message."""
        self._arrivals_s.append(arrival_s)

    @property
    def latest_s(self) -> float:
        """Latest arrival; minus infinity without one."""
        return self._arrivals_s[-1] if self._arrivals_s else -inf

    def hz(self, now_s: float) -> float:
        """Return the rate, Hz."""
        while self._arrivals_s and self._arrivals_s[0] < now_s - _RATE_WINDOW_S:
            self._arrivals_s.popleft()
        return len(self._arrivals_s) / _RATE_WINDOW_S


def carried_rate_hz(endpoint: Endpoint) -> float:
    """Return the highest rate of attitude that a link can carry, Hz: 50 at 57600 baud, 100 without a serial radio."""
    capacity = endpoint.bytes_per_s
    if capacity is None:
        return RATES_HZ[0]
    fits_hz = (_USABLE_FRACTION * capacity - _OTHERS_BYTES_PER_S) / _ATTITUDE_BYTES
    return next((rate_hz for rate_hz in RATES_HZ if rate_hz <= fits_hz), RATES_HZ[-1])


def dialect() -> Any:
    """Return pymavlink's module of all dialects, imported on first use."""
    with suppressed_output():
        from pymavlink.dialects.v20 import all as every  # noqa: PLC0415 - when a link is opened
    return every


# System of ground stations, and component MAV_COMP_ID_ONBOARD_COMPUTER for programs beside them.
_SYSTEM, _COMPONENT = 255, 191


class Packer:
    """Packs messages of a system and component, by default a ground station's, each with the next sequence number."""

    def __init__(self, system: int = _SYSTEM, component: int = _COMPONENT) -> None:
        self._link = dialect().MAVLink(None, srcSystem=system, srcComponent=component)

    def __call__(self, message: Any) -> bytes:
        """Return a message as a packet."""
        packed = bytes(message.pack(self._link))
        self._link.seq = (self._link.seq + 1) % 256
        return packed


_V1, _V2 = 0xFE, 0xFD
_HEAD_V1, _HEAD_V2, _SUM, _SIGNATURE = 6, 10, 2, 13
_SIGNED = 1


class Packet(NamedTuple):
    """One packet."""

    number: int  # Message number
    system: int  # The sender
    component: int
    sequence: int  # Running number of the packets of its sender, 0 to 255
    content: bytes  # The complete packet

    @property
    def sender(self) -> tuple[int, int]:
        """System and component."""
        return self.system, self.component

    @property
    def begins(self) -> bytes:
        """The first four bytes of the payload: in most messages the time since boot."""
        head = _HEAD_V2 if self.content[0] == _V2 else _HEAD_V1
        return self.content[head : head + 4]

    @property
    def signed(self) -> bool:
        """Whether it has a signature."""
        return self.content[0] == _V2 and bool(self.content[2] & _SIGNED)


class Framer:
    """Extracts complete packets with correct checksums from received bytes.

    At most one incomplete packet is buffered.  `bad_bytes`: number of bytes that belong to no packet.
    """

    def __init__(self) -> None:
        from pymavlink.generator.mavcrc import x25crc  # noqa: PLC0415 - when a link is opened

        self._extra = {number: int(message.crc_extra) for number, message in dialect().mavlink_map.items()}
        self._sum: Any = x25crc
        self._buffered = b""
        # Whether the buffered bytes begin at the end of a packet.
        self._follows_packet = True
        self.bad_bytes = 0

    def feed(self, received: bytes) -> Iterator[Packet]:
        """Yield the packets that are complete with the next bytes of the stream."""
        stream, at = self._buffered + received, 0
        while at < len(stream):
            start = _next_magic(stream, at)
            self._follows_packet = self._follows_packet and start == at
            self.bad_bytes += start - at
            at = start
            stop = _stop(stream, at)
            if stop is None or stop > len(stream):
                break
            packet = self._packet(stream[at:stop], followed=stop == len(stream) or stream[stop] in {_V1, _V2})
            self._follows_packet = packet is not None
            if packet is None:
                self.bad_bytes += 1
                at += 1
            else:
                at = stop
                yield packet
        self._buffered = stream[at:]

    def flush(self) -> Iterator[Packet]:
        """Yield the packets after a false start of a packet; to be called if no bytes arrive for a while.

        An incomplete packet remains buffered until another one is found after it.
        """
        at = 1
        while (at := _next_magic(self._buffered, at)) < len(self._buffered):
            stop = _stop(self._buffered, at)
            is_whole = stop is not None and stop <= len(self._buffered)
            packet = self._packet(self._buffered[at:stop], followed=False) if is_whole else None
            if packet is None:
                at += 1
                continue
            self.bad_bytes += at
            self._buffered = self._buffered[stop:]
            at = 0
            yield packet

    def _packet(self, content: bytes, *, followed: bool) -> Packet | None:
        """Return the packet in some bytes; None if they are no packet."""
        if content[0] == _V2:
            if content[2] & ~_SIGNED:
                return None
            number = int.from_bytes(content[7:10], "little")
            sequence, system, component = content[4:7]
            end = len(content) - (_SIGNATURE if content[2] & _SIGNED else 0) - _SUM
        else:
            sequence, system, component, number = content[2:6]
            end = len(content) - _SUM
        checksum = int.from_bytes(content[end : end + _SUM], "little")
        extra = _matching_extra(self._sum(content[1:end]).crc, checksum)
        if extra is None:
            return None
        if number not in self._extra:
            # A message of an unknown dialect: its first packet determines its CRC_EXTRA.  One false packet in 256 would
            # pass, so that it must also be between two packets.
            if not (self._follows_packet and followed):
                return None
            self._extra[number] = extra
        elif self._extra[number] != extra:
            return None
        return Packet(number, system, component, sequence, content)


def _next_magic(stream: bytes, start: int) -> int:
    """Return the offset at which the next packet may begin; the end if there is none."""
    return min((at for at in (stream.find(_V2, start), stream.find(_V1, start)) if at >= 0), default=len(stream))


def _stop(stream: bytes, at: int) -> int | None:
    """Return the end of a packet that begins at an offset; None if its head is incomplete."""
    if len(stream) < at + 3:
        return None
    if stream[at] == _V1:
        return at + _HEAD_V1 + stream[at + 1] + _SUM
    return at + _HEAD_V2 + stream[at + 1] + _SUM + (_SIGNATURE if stream[at + 2] & _SIGNED else 0)


def _matching_extra(crc: int, checksum: int) -> int | None:
    """Return the CRC_EXTRA byte that, appended to a packet with a given CRC, gives its checksum; None if none does.

    CRC_EXTRA depends on the fields of the message.
    """
    mixed = _MIXED.get(checksum ^ crc >> 8)
    return None if mixed is None else mixed ^ crc & 0xFF


def _mixture(byte: int) -> int:
    """Return the change of CRC-16/MCRF4XX by a byte that is already combined with the low byte of the CRC."""
    byte ^= byte << 4 & 0xFF
    return byte << 8 ^ byte << 3 ^ byte >> 4


_MIXED = {_mixture(byte): byte for byte in range(256)}


# Interval between flushes to the disk, s: a power failure loses the packets of this time.
_FLUSH_EVERY_S = 1.0


class Recorder:
    """Writes packets to a ``.tlog``, each after its arrival time by the computer's clock.

    Each write is one system call with complete packets: if the process is killed, the log ends with a complete packet.
    A separate thread flushes the file to the disk while packets are received.  `bytes` is the size of the file.  Raises
    LinkError if the file exists, or cannot be created.
    """

    def __init__(self, path: Path, *, flush_every_s: float = _FLUSH_EVERY_S) -> None:
        self.path = path
        self.bytes = 0
        self._stamp_us = 0
        try:
            self._handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        except FileExistsError:
            raise LinkError(str(path), "is there already; record to another file") from None
        except OSError as error:
            raise LinkError(str(path), f"cannot be written ({error.strerror})") from error
        self._open = True
        self._closing = Event()
        self._flusher = Thread(target=self._flush_regularly, args=(flush_every_s,), name="glstar-record", daemon=True)
        self._flusher.start()

    def write(self, packets: Iterable[Packet]) -> None:
        """Write packets that have just arrived; raises LinkError, and writes nothing more, as on a full disk."""
        # If the clock is set back, arrival times stay the same instead of decreasing.
        self._stamp_us = max(time.time_ns() // 1000, self._stamp_us)
        stamp = self._stamp_us.to_bytes(8, "big")
        content = b"".join(stamp + packet.content for packet in packets)
        if not content or not self._open:
            return
        try:
            written = os.write(self._handle, content)
            if written < len(content):
                os.ftruncate(self._handle, self.bytes)
                raise OSError(None, "the disk is full")  # noqa: TRY301 - the same message as for other errors
        except OSError as error:
            self.close()
            raise LinkError(str(self.path), f"recording has stopped: {error.strerror}") from error
        self.bytes += written

    def close(self) -> None:
        """Flush and close the file, and remove it if it is empty; may be called twice."""
        if self._open:
            self._open = False
            self._closing.set()
            self._flusher.join()
            with suppress(OSError):  # a disk that is full or gone has been reported
                flush_handle(self._handle)
            os.close(self._handle)
            if not self.bytes:
                self.path.unlink(missing_ok=True)

    def _flush_regularly(self, every_s: float) -> None:
        """Flush the directory once, and the file whenever it has grown."""
        with suppress(OSError):  # the next write reports a disk that is gone
            flush_directory(self.path.parent)
        flushed_bytes = 0
        while not self._closing.wait(every_s):
            received_bytes = self.bytes
            if received_bytes > flushed_bytes:
                with suppress(OSError):
                    flush_handle(self._handle)
                flushed_bytes = received_bytes

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class LinkRecording:
    """The recording of a link, which can begin and end while the link is open; for any thread.

    `recorder` takes the packets at first; `report` is called with the message of each event.
    """

    def __init__(self, recorder: Recorder | None, report: Callable[[str], None]) -> None:
        self._recorder = recorder
        self._report = report
        self._records = recorder is not None
        # Guards the recorder: no packet is written to a file that is being closed.
        self._lock = Lock()

    @property
    def path(self) -> Path | None:
        """The file that is being written; None if there is none."""
        return self._recorder.path if self._recorder is not None and self._records else None

    @property
    def bytes(self) -> int:
        """Size of the latest recording, bytes; 0 if there is none."""
        return 0 if self._recorder is None else self._recorder.bytes

    def begin(self, path: Path) -> None:
        """Record to a new file from now on; a recording before that ends.

        Raises LinkError if the file exists, or cannot be created; a recording before that goes on.
        """
        recorder = Recorder(path)
        self.end()
        with self._lock:
            self._recorder = recorder
            self._records = True
        self._report(f"recording to {path}")

    def end(self) -> None:
        """Close the file, which is complete then; without a recording nothing happens."""
        with self._lock:
            recorder, recorded, self._records = self._recorder, self._records, False
            if recorder is not None and recorded:
                recorder.close()
        if recorder is not None and recorded:
            self._report(f"recorded {recorder.bytes} bytes: {recorder.path}")

    def write(self, packets: Iterable[Packet]) -> None:
        """Record packets that have just arrived; a file that cannot be written is reported, and ends."""
        try:
            with self._lock:
                if self._recorder is not None and self._records:
                    self._recorder.write(packets)
        except LinkError as error:
            self._records = False
            self._report(str(error))
