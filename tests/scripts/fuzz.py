"""Damage files of every kind at random and read them: the result is a value or one line of glstar.

::

    python -m tests.scripts.fuzz --count 20000
    python -m tests.scripts.fuzz --kind Parquet --kind maps --count 500 --seed 7

The files are small, so that a mutant takes milliseconds: most are written by the tests' own writers, some are cut from
real logs if ``../shared/logs`` exists.  `--count` mutants are made of each family, such as logs, tracks or images.  A
mutant fails by any other exception or warning, by more than 0.5 s of processor time or by more than 300 MB of memory;
its bytes are kept in ``fuzz-failures``.  Child processes read them: one that crashes or hangs is replaced.  The seed is
drawn for each run and printed; the same seed makes the same mutants.

``--joined 2000`` also makes 2000 files of each format of logs from pieces of several, and checks that every attitude
and every UTC that is read is that of one of the pieces.
"""

import argparse
import io
import multiprocessing
import os
import random
import re
import secrets
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import takewhile
from math import inf
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import typer.testing
from pymavlink.dialects.v20 import common

from glstar.errors import LogFormatError
from glstar.sky.place.site import Site
from glstar.system.resources import asset
from glstar.telemetry import open_flight, open_source
from tests.support import bags, joinedlogs, tlog, ulog
from tests.support.fuzzkinds import READ, Kind, chunks, gzipped, kinds, lines, packed, refusal, workbook, zipped
from tests.telemetry import test_mappedtable as mapped

LOGS = Path(__file__).parents[3] / "shared" / "logs"
# Processor time and memory of a mutant, and the wall time after which its process is replaced.
SLOWEST_S, MOST_BYTES, HANGING_S = 0.5, 300 << 20, 120.0
# Limits of the manual, lowered: what is within them takes little memory.
LIMITS = {"MEGAPIXELS": "6", "CONTENT_MIB": "32", "UNPACKED_GIB": "0.03125", "ROWS": "200000", "CELLS": "300000"}
HOME = Site(latitude_rad=-0.6, longitude_rad=2.4)


def Log(name: str, files: dict[str, bytes], records: Callable[[bytes], list[bytes]], *more: Any, **fields: Any) -> Kind:
    """Return a kind of logs; `more`: names of attitudes, body, mend."""
    fields |= dict(zip(("attitudes", "body", "mend"), more, strict=False))
    return Kind("logs", name, files, records, **fields)


# --- the logs -------------------------------------------------------------------------------------------------------
def seeds() -> list[Kind]:
    """Return a small log of every format."""
    found = [_table(), _table(rates=True), _dataflash(), _tlog(), _ulog(), _mavlogdump(), _ulog2csv()]
    for extra in (_dataflash_text, _dataflash_dump, _tables_of_others, _bags, _packed):
        found += extra()
    for path in sorted(LOGS.glob("*")):
        data = path.read_bytes()
        if path.suffix == ".tlog":
            found.append(Log(f"{path.name} cut", {"cut.tlog": data[:40_000]}, packets, ("auto", "ATTITUDE"), 8, summed))
        elif path.suffix == ".ulg":
            found.append(
                Log(f"{path.name} cut", {"cut.ulg": data[:90_000]}, messages, ("auto", "vehicle_attitude[0]"), 5)
            )
        elif path.suffix == ".BIN":
            found.append(
                Log(f"{path.name} cut", {"cut.bin": data[:20_000] + data[-20_000:]}, heads, ("auto", "ATT"), 3)
            )
    return found


def _table(*, rates: bool = False) -> Kind:
    header = "utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
    header += ",roll_rate_deg_per_s,pitch_rate_deg_per_s,yaw_rate_deg_per_s" if rates else ""
    rows = [
        f"2024-03-10T11:00:{i / 10:06.3f}Z,{i % 40},-5,{(350 + i) % 360},-34.93,138.60,48"
        + (",10,0,1e1" if rates else "")
        for i in range(60)
    ]
    return Log(f"table{' with rates' * rates}", {"flight.csv": "\n".join([header, *rows]).encode()}, lines, text=True)


def _dataflash() -> Kind:
    return Log("DataFlash", {"log.bin": asset("adelaide.BIN").read_bytes()[:30_000]}, heads, ("auto", "ATT", "XKQ1"), 3)


def _tlog_packets() -> tlog.Log:
    log = tlog.Log()
    log.heartbeat()
    log.heartbeat(sender=(255, 190), autopilot=8)
    log.add(common.MAVLink_statustext_message(6, b"ArduPlane V4.5.1 (1a2b3c4d)"), tlog.BOOT_S)
    for i, t in enumerate(tlog.times(1.0)):
        log.attitude(t, 10.0 * (t - tlog.BOOT_S))
        log.quaternion(t, 10.0 * (t - tlog.BOOT_S))
        imu = (0, 0, -1000, 0, 0, 175, 0, 0, 0)
        log.add(common.MAVLink_raw_imu_message(round(t * 1e6), *imu), t)
        if i % 10 == 0:
            log.place(t)
            log.time(t)
            gps = (3, -349300000, 1386000000, 48000, 100, 100, 0, 0, 9)
            log.add(common.MAVLink_gps_raw_int_message(round(t * 1e6), *gps), t)
    return log


def _tlog() -> Kind:
    data = _tlog_packets().data()
    return Log("telemetry log", {"log.tlog": data}, packets, ("auto", "ATTITUDE", "XKQ"), 8, summed)


def _ulog_log() -> ulog.Log:
    log = ulog.Log()
    for t in ulog.times(1.0):
        log.attitude(t, 10.0 * (t - ulog.BOOT_S), quat_reset_counter=("uint8_t", 1))
        log.attitude(t, 90.0, name="estimator_attitude", instance=1)
        log.add("vehicle_angular_velocity", t, xyz=("float", [0.0, 0.0, 0.17]))
    for t in ulog.times(1.0, rate_hz=10):
        log.gps(t)
        log.add("vehicle_status", t, system_type=("uint8_t", 2))
    return log


def _ulog() -> Kind:
    data = _ulog_log().data(ulog.Log.message("I", b"\x10char[3] sys_namePX4"))
    return Log("ULog", {"log.ulg": data}, messages, ("auto", "estimator_attitude[1]", "vehicle_attitude"), 5)


def _mavlogdump() -> Kind:
    """Return the table that mavlogdump writes of the telemetry log."""
    log = _tlog_packets()
    fields = {
        "ATTITUDE": ("time_boot_ms", "roll", "pitch", "yaw"),
        "GLOBAL_POSITION_INT": ("time_boot_ms", "lat", "lon", "alt"),
        "SYSTEM_TIME": ("time_unix_usec", "time_boot_ms"),
        "HEARTBEAT": ("type", "autopilot"),
        "STATUSTEXT": ("severity", "text"),
    }
    columns = [f"{name}.{one}" for name, names in fields.items() for one in names]
    link, rows = common.MAVLink(None), [",".join(["timestamp", *columns])]
    for packet in log.packets:
        message = link.decode(bytearray(packet[8:]))
        values = {f"{message.get_type()}.{one}": str(value) for one, value in message.to_dict().items()}
        if message.get_type() in fields:
            stamp = f"{struct.unpack('>Q', packet[:8])[0] * 1e-6:.8f}"
            rows.append(",".join([stamp, *(values.get(column, "") for column in columns)]))
    return Log("mavlogdump", {"dump.csv": "\n".join(rows).encode()}, lines, ("auto", "ATTITUDE"), text=True)


def _ulog2csv() -> Kind:
    attitude = ["timestamp,q[0],q[1],q[2],q[3],quat_reset_counter"]
    attitude += [f"{30_000_000 + 20_000 * i},1.0,0.0,0.0,{i * 1e-4},2" for i in range(40)]
    gps = ["timestamp,time_utc_usec,lat,lon,alt,fix_type,timestamp_time_relative"]
    gps += [
        f"{30_000_000 + 200_000 * i},{1710068400_000000 + 200_000 * i},-349300000,1386000000,48000,3,0"
        for i in range(8)
    ]
    rates = ["timestamp,timestamp_sample,xyz[0],xyz[1],xyz[2]"]
    rates += [f"{30_000_000 + 5_000 * i},{30_000_000 + 5_000 * i},0.0,nan,0.17" for i in range(80)]
    status = ["timestamp,system_type", "30000000,2"]
    files = {"vehicle_attitude": attitude, "vehicle_gps_position": gps, "vehicle_angular_velocity": rates}
    files |= {"vehicle_status": status}
    named = {f"log_{name}_0.csv": "\n".join(rows).encode() for name, rows in files.items()}
    return Log("ulog2csv", named, lines, ("auto", "vehicle_attitude", "estimator_attitude"), text=True)


def _dataflash_text() -> list[Kind]:
    """Return a DataFlash log as text, as Mission Planner writes it."""
    columns = {
        "FMT": ("BBnNZ", "Type,Length,Name,Format,Columns"),
        "ATT": ("QccccCC", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw"),
        "GPS": ("QBIHLLe", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt"),
        "IMU": ("Qfff", "TimeUS,GyrX,GyrY,GyrZ"),
        "MSG": ("QZ", "TimeUS,Message"),
    }
    rows = [f"FMT, {128 + i}, 40, {name}, {code}, {names}" for i, (name, (code, names)) in enumerate(columns.items())]
    rows.append("MSG, 30000000, ArduPlane V4.5.1 (1a2b3c4d)")
    for i in range(50):
        at = 30_000_000 + 20_000 * i
        rows += [f"ATT, {at}, 0, {i * 0.1:.2f}, 0, -5.00, 0, 350.00", f"IMU, {at}, 0.1, 0.0, -0.01"]
        if i % 10 == 0:
            rows.append(f"GPS, {at}, 3, {39600000 + 20 * i}, 2305, -34.93, 138.60, 48.0")
    data = "\n".join(rows).encode()
    return [Log("DataFlash as text", {"log.log": data}, lines, ("auto", "ATT", "XKQ"), text=True)]


def _dataflash_dump() -> list[Kind]:
    att = ["timestamp,TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF"]
    gps = ["timestamp,TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,U"]
    for i in range(50):
        t, at = 1710068400 + 0.02 * i, 30_000_000 + 20_000 * i
        att.append(f"{t:.8f},{at},0.0,{i * 0.1},0.0,-5.0,0.0,350.0,3")
        if i % 10 == 0:
            gps.append(f"{t:.8f},{at},0,3,{39618000 + 20 * i},2305,10,1.2,-34.93,138.60,48.0,1")
    named = {"log_ATT.csv": "\n".join(att).encode(), "log_GPS.csv": "\n".join(gps).encode()}
    return [Log("mavlogdump of DataFlash", named, lines, ("auto", "ATT"), text=True)]


def _tables_of_others() -> list[Kind]:
    """Return tables that are read by a map of columns: AirData's CSV, Parquet and Excel."""
    table = mapped.euler_table(roll=" roll(degrees)", pitch=" pitch(degrees)", yaw=" compass_heading(degrees)")
    table["altitude_above_seaLevel(feet)"] = table.pop("height") / 0.3048
    table.insert(0, "datetime(utc)", mapped.utc_texts(" ", 3))
    table.insert(0, "time(millisecond)", np.round(mapped.TIMES_S * 1e3).astype(int))
    own = pd.DataFrame({"utc_s": mapped.START_S + mapped.TIMES_S}).join(
        mapped.euler_table(roll="roll_deg", pitch="pitch_deg", yaw="yaw_deg").rename(
            columns={"latitude": "latitude_deg", "longitude": "longitude_deg", "height": "height_m"}
        )
    )
    parquet, excel = io.BytesIO(), io.BytesIO()
    own.to_parquet(parquet)
    own.head(60).to_excel(excel, index=False)
    return [
        Log("AirData", {"airdata.csv": table.head(60).to_csv(index=False).encode()}, lines, text=True),
        Log("Parquet", {"flight.parquet": parquet.getvalue()}, chunks),
        Log("Excel", {"flight.xlsx": excel.getvalue()}, chunks, **workbook(excel.getvalue())),
    ]


def _bags() -> list[Kind]:
    """Return bags of ROS 1 and ROS 2, each one file."""
    with tempfile.TemporaryDirectory() as name:
        bags.written(Path(name) / "flight.bag", "bag")
        found = [Log("ROS 1 bag", {"flight.bag": (Path(name) / "flight.bag").read_bytes()}, chunks)]
        for kind in ("db3", "mcap"):
            written = next(bags.written(Path(name) / kind, kind).glob(f"*.{kind}"))
            found.append(Log(f"ROS 2 {kind}", {f"flight.{kind}": written.read_bytes()}, chunks))
    return found


def _packed() -> list[Kind]:
    """Return a table in gzip, and in zip archives of each compression."""
    table = _table()
    methods = {"zip": zipfile.ZIP_DEFLATED, "zip by bzip2": zipfile.ZIP_BZIP2, "zip by LZMA": zipfile.ZIP_LZMA}
    found = [packed(table, "gzip", f"{table.main}.gz", gzipped, text=False)]
    for name, method in methods.items():
        found.append(packed(table, name, "flight.zip", partial(zipped, name="flight.csv", method=method), text=False))
    return found


# --- records --------------------------------------------------------------------------------------------------------
def heads(data: bytes) -> list[bytes]:
    """Return the records of a DataFlash log, split at the header bytes."""
    first, *rest = data.split(b"\xa3\x95")
    return [first, *(b"\xa3\x95" + part for part in rest)]


def packets(data: bytes) -> list[bytes]:
    """Return the packets of a telemetry log with their stamps, up to the first that is damaged."""
    found, at = [], 0
    while at + 20 < len(data) and data[at + 8] in b"\xfd\xfe":
        size = 8 + data[at + 9] + (12 if data[at + 8] == 0xFD else 8)
        found.append(data[at : at + size])
        at += size
    return [*found, data[at:]]


def messages(data: bytes) -> list[bytes]:
    """Return the head and the messages of a ULog."""
    found, at = [data[:16]], 16
    while at + 3 <= len(data):
        size = 3 + struct.unpack_from("<H", data, at)[0]
        found.append(data[at : at + size])
        at += size
    return found


def summed(packet: bytes) -> bytes:
    """Return a packet with a correct check sum, so that it is accepted."""
    head = 10 if packet[8:9] == b"\xfd" else 6
    if len(packet) < 8 + head + 2 or packet[8] not in b"\xfd\xfe":
        return packet
    number = int.from_bytes(packet[15:18], "little") if head == 10 else packet[13]
    if number not in common.mavlink_map:
        return packet
    crc = common.x25crc(packet[9 : 8 + head + packet[9]])
    crc.accumulate(struct.pack("B", common.mavlink_map[number].crc_extra))
    at = 8 + head + packet[9]
    return packet[:at] + struct.pack("<H", crc.crc) + packet[at + 2 :]


# --- damage ---------------------------------------------------------------------------------------------------------
ODD_NUMBERS = [
    *(struct.pack("<f", x) for x in (float("nan"), float("inf"), float("-inf"), 1e38, -0.0)),
    *(struct.pack("<d", x) for x in (float("nan"), float("inf"), float("-inf"), 1e308, 5e-324)),
    *(x.to_bytes(8, "little") for x in (0, 1, 1 << 63, (1 << 64) - 1, 1 << 40, 1_710_068_400_000_000)),
    *(x.to_bytes(4, "little") for x in (0, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)),
]
ODD_CELLS = ("nan", "inf", "-inf", "1e400", "-1", "0", "1e308", "1e18", "18446744073709551616", "1710068400000000")
ODD_CELLS += ("x", "", "é", "''", '"', "0x10", "1_000", "2024-03-10T11:00:00Z", "9999-12-31", "timestamp")


def mutate(kind: Kind, others: list[Kind], chance: random.Random) -> dict[str, bytes]:
    """Return the files of a kind, one of them with one to three kinds of damage, or what is packed in it."""
    files = dict(kind.files)
    name = chance.choice([kind.main, kind.main, *files])
    is_inner = kind.pack is not None and chance.random() < 0.6
    data = kind.inner if is_inner else files[name]
    for _ in range(chance.choice((1, 1, 2, 3))):
        damages = (*DAMAGES, *TEXT_DAMAGES) if kind.text or is_inner else DAMAGES
        data = chance.choice(damages)(kind, data, others, chance)
    if is_inner and kind.pack is not None:
        name, data = kind.main, kind.pack(data)
    files[name] = data
    return files


def cut(_kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] if chance.random() < 0.8 else data[at:]


def flip(_kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    changed = bytearray(data)
    span = chance.choice((300, 4000, len(data)))
    for _ in range(chance.choice((1, 5, 50, 500)) if changed else 0):
        at = chance.randrange(min(span, len(changed)) or 1)
        changed[at] = chance.choice((0, 255, chance.randrange(256), changed[at] ^ 1 << chance.randrange(8)))
    return bytes(changed)


def shuffle(kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    """Repeat, remove, move or swap records."""
    records = kind.records(data)
    start = chance.randrange(len(records) or 1)
    some = records[start : start + chance.choice((1, 3, 30))]
    change = chance.randrange(4)
    if change == 0:
        records[start:start] = some * chance.choice((1, 2, 20))
    elif change == 1:
        del records[start : start + len(some)]
    elif change == 2:
        del records[start : start + len(some)]
        to = chance.randrange(len(records) + 1)
        records[to:to] = some
    else:
        tail = records[1:]
        chance.shuffle(tail)
        records = records[:1] + tail
    return b"".join(records)


def put_odd_numbers(kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    """Put NaN, infinities or absurd numbers into some records."""
    records = kind.records(data)
    for _ in range(chance.choice((1, 3, 20, len(records)))):
        at = chance.randrange(len(records) or 1) if records else 0
        if not records:
            break
        record = bytearray(records[at])
        if kind.text:
            cells = records[at].decode(errors="replace").rstrip("\n").split(",")
            cells[chance.randrange(len(cells))] = chance.choice(ODD_CELLS)
            records[at] = (",".join(cells) + "\n").encode()
            continue
        odd = chance.choice(ODD_NUMBERS)
        where = chance.choice((0, 4, 8, chance.randrange(len(record) or 1))) + kind.body
        where += chance.choice((0, 10)) if kind.mend is summed else 0
        record[where : where + len(odd)] = odd[: max(0, len(record) - where)]
        records[at] = kind.mend(bytes(record))
    return b"".join(records)


def splice(_kind: Kind, data: bytes, others: list[Kind], chance: random.Random) -> bytes:
    """Put a part of another file into this one."""
    other = chance.choice(others)
    foreign = other.files[other.main]
    start = chance.randrange(len(foreign) or 1)
    part = foreign[start : start + chance.choice((10, 200, 5000))]
    at = chance.choice((0, len(data), chance.randrange(len(data) + 1)))
    return data[:at] + part + data[at:]


_WORD = re.compile(rb"[-+.\w]+")


def swap_words(_kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    """Swap two words of a text, or put one in place of another."""
    words = list(_WORD.finditer(data))
    if len(words) < 2:
        return data
    one, two = sorted(chance.sample(words, 2), key=lambda word: word.start())
    first = two[0] if chance.random() < 0.7 else one[0]
    return data[: one.start()] + first + data[one.end() : two.start()] + one[0] + data[two.end() :]


def put_odd_words(_kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    """Put extreme numbers or other values in place of some words of a text, such as a value of JSON."""
    words = [word.span() for word in _WORD.finditer(data)]
    chosen = chance.sample(words, min(chance.choice((1, 2, 9)), len(words)))
    for begin, end in sorted(chosen, reverse=True):
        data = data[:begin] + chance.choice(ODD_WORDS) + data[end:]
    return data


def nest(_kind: Kind, data: bytes, _others: list[Kind], chance: random.Random) -> bytes:
    """Put brackets or elements inside each other."""
    opened = chance.choice((b"[", b'{"a":', b"<a>", b"<Placemark>", b"(", b"- ", b'"'))
    at = chance.choice((0, len(data), chance.randrange(len(data) + 1)))
    return data[:at] + opened * chance.choice((1, 3, 70, 3000)) + data[at:]


_ODD_TEXTS = (*ODD_CELLS, "null", "true", "[]", "{}", "[[1, 2], 3]", "{a: 1}", "0500", "1:20", "1e999", "-0", "~")
_ODD_BYTES = (b"9" * 400, b"\xff\xfe", b"\r", b"\0", b"&a", b"*a", b"<<", b"!!python/none", b"<!ENTITY a 'b'>")
ODD_WORDS = (*(text.encode() for text in _ODD_TEXTS), *_ODD_BYTES)
DAMAGES = (cut, flip, flip, shuffle, put_odd_numbers, put_odd_numbers, splice)
TEXT_DAMAGES = (swap_words, swap_words, put_odd_words, put_odd_words, put_odd_words, nest)


# --- trials ---------------------------------------------------------------------------------------------------------
def attempt(path: Path, kind: Kind, attitude: str, chance: random.Random) -> str:
    """Open a damaged log as all commands do; return `READ` or the start of the error message."""
    site = HOME if chance.random() < 0.5 else None
    utc_start = 1.7e9 if chance.random() < 0.5 else None
    try:
        with open_source(path, attitude=attitude) as source:
            source.facts()
            for name, samples in source.attitudes():
                assert name
                assert len(samples.clock_s) == len(samples.q_body_ned) == len(samples.segment)
    except LogFormatError as error:
        refusal(error, path)
    try:
        flight = open_flight(path, attitude=attitude, site=site, utc_start=utc_start)
    except LogFormatError as error:
        return refusal(error, path)
    track = flight.attitude
    q = track.at([track.first_s, (track.first_s + track.last_s) / 2, track.last_s])
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, rtol=0, atol=1e-9)
    place = flight.position.at(track.first_s)
    assert abs(place.latitude_rad) <= np.pi / 2
    assert np.isfinite(place.height_m)
    assert np.isfinite(track.utc_s).all()
    is_table = kind.text or kind.pack is not None or kind.name in {"Parquet", "Excel"}  # its times are the user's
    if not is_table:
        assert track.last_s - track.first_s < 61 * 86400
    return READ


@dataclass
class Trial:
    """What came of one mutant."""

    number: int
    kind: str
    outcome: str = ""  # `READ`, or the start of the message
    failure: str = ""
    seconds: float = 0.0
    memory_bytes: int = 0
    files: dict[str, bytes] = field(default_factory=dict)  # Of a failure


def mutant(kind: Kind, others: list[Kind], number: int, seed: int) -> tuple[dict[str, bytes], str, random.Random]:
    """Return the files of a mutant, its attitude, and the random numbers of its trial; number 0 is not damaged."""
    chance = random.Random(f"{seed}/{kind.name}/{number}")
    files = dict(kind.files) if number == 0 else mutate(kind, others, chance)
    return files, "auto" if number == 0 else chance.choice(kind.attitudes), chance


def tried(kind: Kind, others: list[Kind], number: int, seed: int, folder: Path) -> Trial:
    """Read a mutant; a slow one is read again, because other programs may have held it up."""
    files, attitude, chance = mutant(kind, others, number, seed)
    state = chance.getstate()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    trial = Trial(number, kind.name)
    for _ in range(2):
        chance.setstate(state)
        began_bytes, began_s = reset_peak(), time.process_time()
        printed = io.StringIO()
        try:
            with warnings.catch_warnings(), redirect_stdout(printed), redirect_stderr(printed):
                warnings.simplefilter("error")
                path = folder / kind.main
                trial.outcome = kind.read(path, chance) if kind.read else attempt(path, kind, attitude, chance)
            assert not printed.getvalue(), "something was printed"
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            text = " ".join(str(error).split())[:120]
            trial.failure = f"{type(error).__name__} {text} ({Path(where.filename).name}:{where.lineno})"
        trial.seconds, trial.memory_bytes = time.process_time() - began_s, peak_bytes() - began_bytes
        if trial.failure or trial.seconds <= SLOWEST_S or number == 0:
            break
    if number == 0 and not trial.failure and trial.outcome != READ and not kind.name.endswith(" cut"):
        trial.failure = f"undamaged, it is refused: {trial.outcome}"
    if not trial.failure and number:
        if trial.seconds > SLOWEST_S:
            trial.failure = f"more than {SLOWEST_S} s"
        elif trial.memory_bytes > MOST_BYTES:
            trial.failure = f"more than {MOST_BYTES >> 20} MB"
    trial.files = files if trial.failure else {}
    for name in files:
        (folder / name).unlink(missing_ok=True)
    return trial


_STATUS, _PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_bytes() -> int:
    """Return the largest memory of this process since `reset_peak`; 0 where it is unknown."""
    found = re.search(r"VmHWM:\s+(\d+)", _STATUS.read_text()) if _STATUS.exists() else None
    return int(found[1]) << 10 if found else 0


def reset_peak() -> int:
    """Forget the largest memory of this process, on Linux, and return the present one."""
    with suppress(OSError):
        _PEAK.write_text("5")
    return peak_bytes()


def work(connection: Connection, every: list[Kind], seed: int) -> None:
    """Read mutants until there are no more tasks: a process of the pool."""
    os.environ.update({f"GLSTAR_MAX_{name}": value for name, value in LIMITS.items()})
    os.environ["GLSTAR_DEVELOPMENT"] = "1"
    # A process builds the program of all commands once, not for each mutant: half of the time of a score.
    typer.testing._get_command = cache(typer.testing._get_command)
    # Libraries print remarks on damaged images.
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    warmed: set[int] = set()
    with tempfile.TemporaryDirectory() as name:
        while (task := connection.recv()) is not None:
            index, number = task
            if index not in warmed:
                warmed.add(index)
                tried(every[index], every, 0, seed, Path(name))
            connection.send(tried(every[index], every, number, seed, Path(name)))


class Pool:
    """Processes that read mutants; one that crashes or hangs fails its mutant and is replaced."""

    def __init__(self, every: list[Kind], seed: int, workers: int) -> None:
        self._every, self._seed = every, seed
        self._context = multiprocessing.get_context("spawn")
        self._workers: dict[Connection, tuple[Any, tuple[int, int], float]] = {}
        self._count = workers

    def run(self, tasks: Iterator[tuple[int, int]]) -> Iterator[Trial]:
        """Yield what comes of pairs of a kind's index and a mutant's number."""
        for task in tasks:
            while len(self._workers) >= self._count and all(given for _, given, _ in self._workers.values()):
                yield from self._results()
            self._give(task)
        while any(task for _, task, _ in self._workers.values()):
            yield from self._results()

    def _give(self, task: tuple[int, int]) -> None:
        free = next((at for at, (_, given, _) in self._workers.items() if not given), None)
        if free is None:
            free, theirs = self._context.Pipe()
            process = self._context.Process(target=work, args=(theirs, self._every, self._seed), daemon=True)
            process.start()
            theirs.close()
        else:
            process = self._workers[free][0]
        free.send(task)
        self._workers[free] = process, task, time.monotonic()

    def _results(self) -> Iterator[Trial]:
        """Yield the results of the next second, if there are any."""
        busy = [at for at, (_, task, _) in self._workers.items() if task]
        ready = wait(busy, timeout=1.0)
        for connection in busy:
            process, task, since_s = self._workers[connection]
            if connection in ready:
                try:
                    trial = connection.recv()
                except (EOFError, ConnectionError):
                    yield self._lost(connection, f"the process died with {process.exitcode}")
                else:
                    self._workers[connection] = process, (), since_s
                    yield trial
            elif time.monotonic() - since_s > HANGING_S + 60 * (task[1] == 0):
                process.kill()
                yield self._lost(connection, f"more than {HANGING_S} s of wall time")

    def _lost(self, connection: Connection, failure: str) -> Trial:
        _, (index, number), _ = self._workers.pop(connection)
        kind = self._every[index]
        return Trial(number, kind.name, "", failure, HANGING_S, 0, mutant(kind, self._every, number, self._seed)[0])

    def close(self) -> None:
        for connection, (process, *_) in self._workers.items():
            with suppress(OSError):
                connection.send(None)
            process.join(5)
            process.kill()


@dataclass
class Report:
    """What came of all mutants of one kind."""

    kind: Kind
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0
    most_bytes: int = 0

    def add(self, trial: Trial) -> None:
        if trial.failure:
            self.failures[trial.failure] += 1
        else:
            self.outcomes[trial.outcome] += 1
        if trial.number:
            self.slowest_s = max(self.slowest_s, trial.seconds)
            self.most_bytes = max(self.most_bytes, trial.memory_bytes)

    def __str__(self) -> str:
        count = self.outcomes.total() + self.failures.total()
        refused = count - self.outcomes[READ] - self.failures.total()
        return (
            f"{self.kind.family}: {self.kind.name}: {count} mutants, {self.outcomes[READ]} read, {refused} refused with"
            f" {len(self.outcomes.keys() - {READ})} messages, {self.failures.total()} failed; at most"
            f" {self.slowest_s:.2f} s, {self.most_bytes >> 20} MB"
        )


def run(
    every: list[Kind], count: int, seed: int, workers: int, keep: Path | None = None, *, seconds: float = inf
) -> list[Report]:
    """Read `count` mutants of each family, divided among its kinds, for some time; the first of each is not damaged."""
    stop_s = time.monotonic() + seconds
    reports = {kind.name: Report(kind) for kind in every}
    assert len(reports) == len(every), "two kinds of one name"
    families = Counter(kind.family for kind in every)
    shares = [max(2, -(-count // families[kind.family])) for kind in every]
    tasks = ((index, number) for number in range(max(shares)) for index in range(len(every)) if number < shares[index])
    pool = Pool(every, seed, workers)
    try:
        for trial in pool.run(takewhile(lambda _: time.monotonic() < stop_s, tasks)):
            reports[trial.kind].add(trial)
            if trial.failure and keep is not None and reports[trial.kind].failures[trial.failure] <= 3:
                for name, data in trial.files.items():
                    folder = keep / f"{trial.kind}-{seed}-{trial.number}".replace(" ", "_").replace("/", "_")
                    folder.mkdir(parents=True, exist_ok=True)
                    (folder / name).write_bytes(data)
                print(f"FAILED: {trial.kind} {trial.number}: {trial.failure}", flush=True)
    finally:
        pool.close()
    return list(reports.values())


def run_joined(files: int, seed: int, folder: Path, keep: Path | None) -> tuple[Counter[str], dict[str, Counter[str]]]:
    """Try files made of pieces of several logs; return the failures and the other outcomes."""
    failures: Counter[str] = Counter()
    outcomes: dict[str, Counter[str]] = {name: Counter() for name in joinedlogs.WRITERS}
    for name, outcome in outcomes.items():
        for number in range(files):
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    outcome[joinedlogs.trial(folder, name, number, seed)] += 1
            except Exception as error:
                failures[f"{name}: {type(error).__name__} {error}"[:200]] += 1
                if keep is not None:
                    keep.mkdir(exist_ok=True)
                    (keep / f"{seed}-{number}-{name}").write_bytes((folder / name).read_bytes())
    return failures, outcomes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20_000, help="mutants of each family")
    parser.add_argument("--kind", action="append", help="a kind or a family; repeatable; by default all")
    parser.add_argument("--seed", type=int, help="by default a drawn one, which is printed")
    parser.add_argument("--seconds", type=float, default=inf, help="stop after this time, and report")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--joined", type=int, default=0, help="files of each format, made of pieces of several logs")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="where failing mutants are kept")
    arguments = parser.parse_args()
    seed = secrets.randbelow(1 << 31) if arguments.seed is None else arguments.seed
    every = [*seeds(), *kinds()]
    if arguments.kind:
        every = [kind for kind in every if {kind.name, kind.family} & {*arguments.kind}]
    print(f"seed {seed}; {len(every)} kinds", flush=True)
    began_s = time.monotonic()
    reports = run(every, arguments.count, seed, arguments.workers, arguments.keep, seconds=arguments.seconds)
    with tempfile.TemporaryDirectory() as folder:
        failures, joined = run_joined(arguments.joined, seed, Path(folder), arguments.keep)
    for report in reports:
        print(report)
        for failure, count in report.failures.most_common():
            print(f"FAILED {count} times: {report.kind.name}: {failure}")
    for name, outcome in joined.items():
        if outcome:
            print(f"joined {name}: {outcome.total()} files, {outcome['a flight']} flights")
    for failure, count in failures.most_common():
        print(f"FAILED {count} times: joined {failure}")
    print(f"{time.monotonic() - began_s:.0f} s")
    return 1 if failures or any(report.failures for report in reports) else 0


if __name__ == "__main__":
    sys.exit(main())
