"""Streams of MAVLink packets without arrival times: Mission Planner's ``.rlog``, or what a serial port received.

Such a file is a telemetry log without the arrival times.  They are made of the autopilot's time since boot, which is
what glstar uses anyway; arrival times only relate the packets of several senders, and the boots of one autopilot.
"""

import re
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from glstar.errors import LogFormatError
from glstar.telemetry.samplevalidation import YEAR_2010_S
from glstar.telemetry.suppressedoutput import suppressed_output
from glstar.telemetry.temporarylog import UnpackedSource
from glstar.telemetry.tlog import TelemetryLogReader

__all__ = ["is_mavlink_stream", "stream_reader"]

_MAGIC = re.compile(rb"[\xfd\xfe]")
_V2 = 0xFD
_SIGNED = 0x01
# Bytes of a packet besides its payload, by version, and those of a signature.
_V1_BYTES, _V2_BYTES, _SIGNATURE_BYTES = 8, 12, 13
# Number of consecutive packets that are not there by chance.
_ROW: Final = 5
# Start of the made arrival times until UTC is known.
_START_S: Final = YEAR_2010_S + 86400.0
_AUTOPILOT: Final = 1


def is_mavlink_stream(head: bytes) -> bool:
    """Return whether a file holds consecutive MAVLink packets without arrival times.

    Parameters
    ----------
    head : bytes
        The first bytes of the file, some thousands.

    Returns
    -------
    bool
    """
    for magic in _MAGIC.finditer(head[:1024]):
        at: int | None = magic.start()
        for _ in range(_ROW):
            at = None if at is None else _stop(head, at)
        if at is not None:
            return True
    return False


def stream_reader(
    path: str, *, attitude: str = "auto", sysid: int | None = None, boot: int | None = None
) -> UnpackedSource:
    """Open a stream as a telemetry log.

    Parameters
    ----------
    path : str
        The file.
    attitude, sysid, boot
        As for `TelemetryLogReader`.

    Returns
    -------
    UnpackedSource

    Raises
    ------
    LogFormatError
        If it holds no packet with attitude.
    """
    return UnpackedSource(
        path, _with_arrival_times, lambda log: TelemetryLogReader(log, attitude=attitude, sysid=sysid, boot=boot)
    )


def _with_arrival_times(name: str) -> tuple["tempfile.TemporaryDirectory[str]", Path]:
    """Write the packets of a stream as a telemetry log into a temporary directory."""
    content = Path(name).read_bytes()
    folder = tempfile.TemporaryDirectory(prefix="glstar-", ignore_cleanup_errors=True)
    path = Path(folder.name) / f"{Path(name).stem}.tlog"
    clock_s, boot_s, count = _START_S, None, 0
    with path.open("wb") as file:
        for packet, message in _packets(content):
            count += 1
            time_ms = getattr(message, "time_boot_ms", None)
            if time_ms is not None and message.get_srcComponent() == _AUTOPILOT:
                # A step back is a reboot, or a packet that overtook another.
                clock_s += 0.0 if boot_s is None else max(time_ms / 1e3 - boot_s, 0.0)
                boot_s = time_ms / 1e3
            file.write(struct.pack(">Q", round(clock_s * 1e6)) + packet)
    if not count:
        folder.cleanup()
        raise LogFormatError(name, "holds no valid MAVLink packet")
    return folder, path


def _packets(content: bytes) -> Iterator[tuple[bytes, Any]]:
    """Yield the packets with correct checksums, and their messages."""
    with suppressed_output():
        from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415

        link = ardupilotmega.MAVLink(None)
    at = 0
    while (magic := _MAGIC.search(content, at)) is not None:
        at = magic.start()
        stop = _stop(content, at)
        if stop is not None:
            packet = content[at:stop]
            try:
                yield packet, link.decode(bytearray(packet))
            except (ardupilotmega.MAVError, struct.error):
                stop = None
        at = at + 1 if stop is None else stop


def _stop(content: bytes, at: int) -> int | None:
    """Return the end of the packet that begins at an offset; None if there is no packet."""
    if at + _V1_BYTES > len(content) or content[at] not in b"\xfd\xfe":
        return None
    is_v2, flags = content[at] == _V2, content[at + 2]
    if is_v2 and flags & ~_SIGNED:
        return None
    signature = _SIGNATURE_BYTES if is_v2 and flags & _SIGNED else 0
    stop = at + content[at + 1] + (_V2_BYTES if is_v2 else _V1_BYTES) + signature
    return stop if stop <= len(content) else None
