"""Time to open large logs: ``poe bench logs``, or ``python -m tests.bench.logs``.

Makes logs of 50 MB by repeating real ones with shifted time, and prints for each the median and the best time from file
to flight (`open_flight`), the peak memory of a process that only opens it, and the time of the reference reader:

DataFlash           pymavlink's recv_match over the messages that glstar reads
DataFlash as text   the same over the text
ULog                pyulog's read of the whole log

Each run is a process of its own (`tests.bench.reading`).  The readers alternate, so that other load on the machine
affects both alike: the ratio of the times is comparable between machines.
"""

import argparse
import os
import platform
import statistics
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from pymavlink.DFReader import FORMAT_TO_STRUCT, DFReader_binary
from rich.console import Console
from rich.table import Table

from glstar import __version__
from tests.support.dataflash import as_text

LOGS = Path(__file__).parents[3] / "shared" / "logs"
PAUSE_US = 5000  # between one repetition and the next, as between two samples
ULOG_HEAD_BYTES = 16
ULOG_BYTES = {"8": 1, "16": 2, "32": 4, "64": 8}


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--logs", type=Path, default=LOGS, help="directory of the sample logs")
    arguments.add_argument("--megabytes", type=float, default=50.0)
    arguments.add_argument("--rounds", type=int, default=5)
    asked = arguments.parse_args()
    if not asked.logs.is_dir():
        sys.exit(f"no sample logs in {asked.logs}; name their directory: --logs DIR")

    size = round(asked.megabytes * 1e6)
    console = Console(width=140)
    console.print(f"glstar {__version__}, Python {platform.python_version()}, NumPy {np.__version__}")
    console.print(f"{platform.machine()}, {os.cpu_count()} processors")
    table = Table(title=f"a log of {asked.megabytes:g} MB: seconds, median (best)")
    for column in ("log", "samples", "ready", "peak MB", "reference", "peak MB", "times faster"):
        table.add_column(column, justify="right")
    with tempfile.TemporaryDirectory() as directory:
        for name, reference, log in _made(asked.logs, size, Path(directory)):
            table.add_row(name, *_row(log, reference, asked.rounds))
            log.unlink()
    console.print(table)


def _made(logs: Path, size: int, directory: Path) -> list[tuple[str, str, Path]]:
    """Write the logs; return the name, the reference reader and the path of each."""
    dataflash = repeated_dataflash(logs / "plane_SITL_adelaide_200Hz.BIN", size)
    binary, text, ulog = directory / "large.BIN", directory / "large.log", directory / "large.ulg"
    binary.write_bytes(dataflash)
    # Text is half as long again as the binary log; it is truncated to the same size.
    text.write_bytes(as_text(binary)[:size])
    ulog.write_bytes(repeated_ulog(logs / "copter_pyulog_sample.ulg", size))
    return [
        ("DataFlash", "pymavlink", binary),
        ("DataFlash as text", "pymavlink", text),
        ("ULog", "pyulog", ulog),
    ]


def _row(log: Path, reference: str, rounds: int) -> list[str]:
    ours, theirs = [], []
    for _ in range(rounds):
        ours.append(_measured("glstar", log))
        theirs.append(_measured(reference, log))
    return [
        f"{ours[0][2]:.0f}",
        _times([s for s, *_ in ours]),
        f"{max(mb for _, mb, _ in ours):.0f}",
        _times([s for s, *_ in theirs]),
        f"{max(mb for _, mb, _ in theirs):.0f}",
        f"{statistics.median(s for s, *_ in theirs) / statistics.median(s for s, *_ in ours):.1f}",
    ]


def _measured(reader: str, log: Path) -> tuple[float, float, float]:
    """Return the seconds, the peak memory in MB and the samples of a process that reads one log."""
    command = [sys.executable, "-m", "tests.bench.reading", reader, str(log)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    took_s, peak_mb, samples = map(float, printed)
    return took_s, peak_mb, samples


def _times(times_s: list[float]) -> str:
    return f"{statistics.median(times_s):.2f} ({min(times_s):.2f})"


# --- large logs -------------------------------------------------------------------------------------------------------
def repeated_dataflash(log: Path, size: int) -> bytes:
    """Return a DataFlash log of a minimum size that repeats a flight with shifted times."""
    raw = np.fromfile(log, dtype=np.uint8)
    with DFReader_binary(str(log)) as reader:
        stamps = _uint64_at(reader, "TimeUS")
        weeks = next(places for name, places in _fields(reader, "GMS") if name == "GPS")
    clock_us = raw[stamps].view("<u8").reshape(-1)
    span_us = int(np.ptp(clock_us)) + PAUSE_US
    week_ms = raw[weeks].view("<u4").reshape(-1)
    pieces = []
    for k in range(-(-size // raw.size)):
        later = raw.copy()
        later[stamps] = (clock_us + np.uint64(k * span_us)).view(np.uint8).reshape(-1, 8)
        later[weeks] = (week_ms + np.uint32(round(k * span_us / 1000))).view(np.uint8).reshape(-1, 4)
        pieces.append(later.tobytes())
    return b"".join(pieces)


def _fields(reader: DFReader_binary, field: str) -> list[tuple[str, np.ndarray]]:
    """Return the offsets of all bytes of a field, (records, bytes), for each message that has it."""
    found = []
    for name, kind in reader.name_to_id.items():
        form, heads = reader.formats[kind], np.array(reader.offsets[kind], dtype=np.int64)
        if field in form.columns and heads.size:
            at = form.columns.index(field)
            codes = [FORMAT_TO_STRUCT[letter][0] for letter in form.format]
            start, size = 3 + struct.calcsize("<" + "".join(codes[:at])), struct.calcsize("<" + codes[at])
            found.append((name, heads[:, np.newaxis] + start + np.arange(size)))
    return found


def _uint64_at(reader: DFReader_binary, field: str) -> np.ndarray:
    return np.concatenate([places for _, places in _fields(reader, field)])


def repeated_ulog(log: Path, size: int) -> bytes:
    """Return a ULog of a minimum size that repeats a flight with shifted times."""
    raw = log.read_bytes()
    head, data, stamps = [raw[:ULOG_HEAD_BYTES]], [], []
    formats: dict[str, dict[str, int]] = {}
    topics: dict[int, str] = {}
    at, data_bytes = ULOG_HEAD_BYTES, 0
    while at + 3 <= len(raw):
        body_bytes, kind = struct.unpack_from("<Hc", raw, at)
        message = raw[at : at + 3 + body_bytes]
        at += 3 + body_bytes
        if len(message) < 3 + body_bytes:
            break
        if kind == b"F":
            name, _, fields = message[3:].decode().partition(":")
            formats[name] = _ulog_offsets(fields)
        elif kind == b"A":
            topics[struct.unpack_from("<H", message, 4)[0]] = message[6:].decode()
        if kind != b"D":
            head.append(message)
            continue
        topic = struct.unpack_from("<H", message, 3)[0]
        stamps += [data_bytes + 5 + offset for offset in formats[topics[topic]].values()]
        data.append(message)
        data_bytes += len(message)

    flight = np.frombuffer(b"".join(data), dtype=np.uint8)
    places = np.array(stamps, dtype=np.int64)[:, np.newaxis] + np.arange(8)
    clock_us = flight[places].view("<u8").reshape(-1)
    stamped = clock_us > 0  # 0 means no timestamp
    span_us = int(np.ptp(clock_us[stamped])) + PAUSE_US
    pieces = [b"".join(head)]
    for k in range(-(-size // flight.size)):
        later = flight.copy()
        later[places[stamped]] = (clock_us[stamped] + np.uint64(k * span_us)).view(np.uint8).reshape(-1, 8)
        pieces.append(later.tobytes())
    return b"".join(pieces)


def _ulog_offsets(fields: str) -> dict[str, int]:
    """Return the offsets of the timestamps in a topic's records; fields after a nested type are ignored."""
    offsets, at = {}, 0
    for declared in filter(None, fields.split(";")):
        kind, name = declared.split(" ")
        base, _, count = kind.partition("[")
        if name in ("timestamp", "timestamp_sample"):
            offsets[name] = at
        width = {"float": 4, "double": 8, "bool": 1, "char": 1}.get(base)
        if width is None:
            digits = "".join(filter(str.isdigit, base.removesuffix("_t")))
            if digits not in ULOG_BYTES or "int" not in base:
                break
            width = ULOG_BYTES[digits]
        at += width * int(count.rstrip("]") or 1)
    return offsets


if __name__ == "__main__":
    main()
