"""Damage logs at random and open them: the result is a flight or a LogFormatError.

::

    python -m tests.scripts.fuzz --mutants 20000 --seed 1

The logs are small, so that a mutant takes milliseconds: some are written here, some are cut from real logs if
``../shared/logs`` exists.  A mutant fails by any other exception or warning, by more than 5 s or by more than 1 GB; its
bytes are kept in ``fuzz-failures``.  The same seed makes the same mutants.

``--joined 2000`` also makes 2000 files of each format from pieces of several logs, and checks that every attitude and
every UTC that is read is that of one of the pieces.
"""

import argparse
import gzip
import io
import random
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from pymavlink.dialects.v20 import common

from glstar.errors import LogFormatError
from glstar.sky.place.site import Site
from glstar.system.resources import asset
from glstar.telemetry import open_flight, open_source
from tests.support import bags, joinedlogs, tlog, ulog
from tests.telemetry import test_mappedtable as mapped

try:
    import resource
except ImportError:  # not a Unix
    resource = None

LOGS = Path(__file__).parents[3] / "shared" / "logs"
SLOWEST_S = 5.0
MOST_BYTES = 1 << 30
HOME = Site(latitude_rad=-0.6, longitude_rad=2.4)


@dataclass(frozen=True)
class Seed:
    """A small valid log: its files, the first of which is opened, and a function that splits a file into records."""

    name: str
    files: dict[str, bytes]
    records: Callable[[bytes], list[bytes]]
    attitudes: tuple[str, ...] = ("auto",)
    # Offset of the numbers in a record, and a function that corrects the check sum of a changed record.
    body: int = 0
    mend: Callable[[bytes], bytes] = field(default=bytes)
    text: bool = False

    @property
    def main(self) -> str:
        return next(iter(self.files))


# --- the logs -------------------------------------------------------------------------------------------------------
def seeds() -> list[Seed]:
    """Return a small log of every format."""
    found = [_table(), _table(rates=True), _dataflash(), _tlog(), _ulog(), _mavlogdump(), _ulog2csv()]
    for extra in (_dataflash_text, _dataflash_dump, _tables_of_others, _bags, _packed):
        found += extra()
    for path in sorted(LOGS.glob("*")):
        data = path.read_bytes()
        if path.suffix == ".tlog":
            found.append(
                Seed(f"{path.name} cut", {"cut.tlog": data[:40_000]}, packets, ("auto", "ATTITUDE"), 8, summed)
            )
        elif path.suffix == ".ulg":
            found.append(
                Seed(f"{path.name} cut", {"cut.ulg": data[:90_000]}, messages, ("auto", "vehicle_attitude[0]"), 5)
            )
        elif path.suffix == ".BIN":
            found.append(
                Seed(f"{path.name} cut", {"cut.bin": data[:20_000] + data[-20_000:]}, heads, ("auto", "ATT"), 3)
            )
    return found


def _table(*, rates: bool = False) -> Seed:
    header = "utc,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg,height_m"
    header += ",roll_rate_deg_per_s,pitch_rate_deg_per_s,yaw_rate_deg_per_s" if rates else ""
    rows = [
        f"2024-03-10T11:00:{i / 10:06.3f}Z,{i % 40},-5,{(350 + i) % 360},-34.93,138.60,48"
        + (",10,0,1e1" if rates else "")
        for i in range(60)
    ]
    return Seed(f"table{' with rates' * rates}", {"flight.csv": "\n".join([header, *rows]).encode()}, lines, text=True)


def _dataflash() -> Seed:
    return Seed(
        "DataFlash", {"log.bin": asset("adelaide.BIN").read_bytes()[:30_000]}, heads, ("auto", "ATT", "XKQ1"), 3
    )


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


def _tlog() -> Seed:
    data = _tlog_packets().data()
    return Seed("telemetry log", {"log.tlog": data}, packets, ("auto", "ATTITUDE", "XKQ"), 8, summed)


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


def _ulog() -> Seed:
    data = _ulog_log().data(ulog.Log.message("I", b"\x10char[3] sys_namePX4"))
    return Seed("ULog", {"log.ulg": data}, messages, ("auto", "estimator_attitude[1]", "vehicle_attitude"), 5)


def _mavlogdump() -> Seed:
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
    return Seed("mavlogdump", {"dump.csv": "\n".join(rows).encode()}, lines, ("auto", "ATTITUDE"), text=True)


def _ulog2csv() -> Seed:
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
    return Seed("ulog2csv", named, lines, ("auto", "vehicle_attitude", "estimator_attitude"), text=True)


def _dataflash_text() -> list[Seed]:
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
    return [Seed("DataFlash as text", {"log.log": data}, lines, ("auto", "ATT", "XKQ"), text=True)]


def _dataflash_dump() -> list[Seed]:
    att = ["timestamp,TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF"]
    gps = ["timestamp,TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,U"]
    for i in range(50):
        t, at = 1710068400 + 0.02 * i, 30_000_000 + 20_000 * i
        att.append(f"{t:.8f},{at},0.0,{i * 0.1},0.0,-5.0,0.0,350.0,3")
        if i % 10 == 0:
            gps.append(f"{t:.8f},{at},0,3,{39618000 + 20 * i},2305,10,1.2,-34.93,138.60,48.0,1")
    named = {"log_ATT.csv": "\n".join(att).encode(), "log_GPS.csv": "\n".join(gps).encode()}
    return [Seed("mavlogdump of DataFlash", named, lines, ("auto", "ATT"), text=True)]


def _tables_of_others() -> list[Seed]:
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
        Seed("AirData", {"airdata.csv": table.head(60).to_csv(index=False).encode()}, lines, text=True),
        Seed("Parquet", {"flight.parquet": parquet.getvalue()}, chunks),
        Seed("Excel", {"flight.xlsx": excel.getvalue()}, chunks),
    ]


def _bags() -> list[Seed]:
    """Return bags of ROS 1 and ROS 2, each one file."""
    with tempfile.TemporaryDirectory() as name:
        bags.written(Path(name) / "flight.bag", "bag")
        found = [Seed("ROS 1 bag", {"flight.bag": (Path(name) / "flight.bag").read_bytes()}, chunks)]
        for kind in ("db3", "mcap"):
            written = next(bags.written(Path(name) / kind, kind).glob(f"*.{kind}"))
            found.append(Seed(f"ROS 2 {kind}", {f"flight.{kind}": written.read_bytes()}, chunks))
    return found


def _packed() -> list[Seed]:
    """Return a table in gzip and in a zip archive."""
    name, content = next(iter(_table().files.items()))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, content)
    return [
        Seed("gzip", {f"{name}.gz": gzip.compress(content, mtime=0)}, chunks),
        Seed("zip", {"flight.zip": archive.getvalue()}, chunks),
    ]


# --- records --------------------------------------------------------------------------------------------------------
def lines(data: bytes) -> list[bytes]:
    return data.splitlines(keepends=True)


def chunks(data: bytes) -> list[bytes]:
    """Return pieces of 64 bytes, of formats whose records need their library."""
    return [data[at : at + 64] for at in range(0, len(data), 64)]


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


def mutate(seed: Seed, others: list[Seed], chance: random.Random) -> dict[str, bytes]:
    """Return the files of a log, one of them with one to three kinds of damage."""
    files = dict(seed.files)
    name = chance.choice([seed.main, *files])
    data = files[name]
    for _ in range(chance.choice((1, 1, 2, 3))):
        data = chance.choice(DAMAGES)(seed, data, others, chance)
    files[name] = data
    return files


def cut(seed: Seed, data: bytes, others: list[Seed], chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] if chance.random() < 0.8 else data[at:]


def flip(seed: Seed, data: bytes, others: list[Seed], chance: random.Random) -> bytes:
    changed = bytearray(data)
    span = chance.choice((300, 4000, len(data)))
    for _ in range(chance.choice((1, 5, 50, 500)) if changed else 0):
        at = chance.randrange(min(span, len(changed)) or 1)
        changed[at] = chance.choice((0, 255, chance.randrange(256), changed[at] ^ 1 << chance.randrange(8)))
    return bytes(changed)


def shuffle(seed: Seed, data: bytes, others: list[Seed], chance: random.Random) -> bytes:
    """Repeat, remove, move or swap records."""
    records = seed.records(data)
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


def put_odd_numbers(seed: Seed, data: bytes, others: list[Seed], chance: random.Random) -> bytes:
    """Put NaN, infinities or absurd times into some records."""
    records = seed.records(data)
    for _ in range(chance.choice((1, 3, 20, len(records)))):
        at = chance.randrange(len(records) or 1) if records else 0
        if not records:
            break
        record = bytearray(records[at])
        if seed.text:
            cells = records[at].decode(errors="replace").rstrip("\n").split(",")
            cells[chance.randrange(len(cells))] = chance.choice(ODD_CELLS)
            records[at] = (",".join(cells) + "\n").encode()
            continue
        odd = chance.choice(ODD_NUMBERS)
        where = chance.choice((0, 4, 8, chance.randrange(len(record) or 1))) + seed.body
        where += chance.choice((0, 10)) if seed.mend is summed else 0
        record[where : where + len(odd)] = odd[: max(0, len(record) - where)]
        records[at] = seed.mend(bytes(record))
    return b"".join(records)


def splice(seed: Seed, data: bytes, others: list[Seed], chance: random.Random) -> bytes:
    """Put a part of another file into this one."""
    other = chance.choice(others)
    foreign = other.files[other.main]
    start = chance.randrange(len(foreign))
    part = foreign[start : start + chance.choice((10, 200, 5000))]
    at = chance.choice((0, len(data), chance.randrange(len(data) + 1)))
    return data[:at] + part + data[at:]


DAMAGES = (cut, flip, flip, shuffle, put_odd_numbers, put_odd_numbers, splice)


# --- trials ---------------------------------------------------------------------------------------------------------
class TooSlowError(Exception):
    """Opening a mutant exceeded the time limit."""


@contextmanager
def limits() -> Iterator[None]:
    """Limit a block to 5 s, on systems with interval timers."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def late(*_: object) -> None:
        raise TooSlowError(f"more than {SLOWEST_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, SLOWEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def limit_memory() -> None:
    """Limit this process to 1 GB more than its present memory, on Unix."""
    if resource is None:
        return
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, resource.RLIM_INFINITY))


def attempt(path: Path, seed: Seed, attitude: str, chance: random.Random) -> str:
    """Open a mutant as all commands do; return ``"a flight"`` or the start of the error message."""
    site = HOME if chance.random() < 0.5 else None
    utc_start = 1.7e9 if chance.random() < 0.5 else None
    with limits():
        try:
            with open_source(path, attitude=attitude) as source:
                source.facts()
                for name, samples in source.attitudes():
                    assert name
                    assert len(samples.clock_s) == len(samples.q_body_ned) == len(samples.segment)
        except LogFormatError as error:
            _is_one_line(error, path)
        try:
            flight = open_flight(path, attitude=attitude, site=site, utc_start=utc_start)
        except LogFormatError as error:
            _is_one_line(error, path)
            return str(error).split(": ", 1)[-1][:40]
        track = flight.attitude
        q = track.at([track.first_s, (track.first_s + track.last_s) / 2, track.last_s])
        np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, rtol=0, atol=1e-9)
        place = flight.position.at(track.first_s)
        assert abs(place.latitude_rad) <= np.pi / 2
        assert np.isfinite(place.height_m)
        assert np.isfinite(track.utc_s).all()
        if not seed.text and seed.name not in {"Parquet", "Excel"}:  # a table's times are the user's
            assert track.last_s - track.first_s < 61 * 86400
        return "a flight"


def _is_one_line(error: LogFormatError, path: Path) -> None:
    assert "\n" not in str(error), "a refusal of more than one line"
    assert str(path.parent) in str(error), "a refusal that does not name the file"


def run(
    mutants: int, seed: int, folder: Path, keep: Path | None
) -> tuple[Counter[str], dict[str, Counter[str]], float]:
    """Try mutants of every format in turn; return the failures, the other outcomes, and the longest time, s."""
    logs = seeds()
    failures: Counter[str] = Counter()
    outcomes: dict[str, Counter[str]] = {log.name: Counter() for log in logs}
    slowest_s = 0.0
    for number in range(mutants):
        chance = random.Random(f"{seed}/{number}")
        log = logs[number % len(logs)]
        # Every log is first opened unchanged, which must give a flight.
        unchanged = number < len(logs)
        files = dict(log.files) if unchanged else mutate(log, logs, chance)
        attitude = "auto" if unchanged else chance.choice(log.attitudes)
        for name, data in files.items():
            (folder / name).write_bytes(data)
        began_s = time.process_time()
        printed = io.StringIO()
        try:
            with warnings.catch_warnings(), redirect_stdout(printed), redirect_stderr(printed):
                warnings.simplefilter("error")
                outcomes[log.name][attempt(folder / log.main, log, attitude, chance)] += 1
            assert not printed.getvalue(), "something was printed"
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            failures[
                f"{log.name}: {type(error).__name__} {error} ({Path(where.filename).name}:{where.lineno})"[:200]
            ] += 1
            for name, data in files.items():
                if keep is not None:
                    keep.mkdir(exist_ok=True)
                    (keep / f"{seed}-{number}-{name}").write_bytes(data)
        slowest_s = max(slowest_s, time.process_time() - began_s)
        for name in files:
            (folder / name).unlink()
    return failures, outcomes, slowest_s


def run_joined(files: int, seed: int, folder: Path, keep: Path | None) -> tuple[Counter[str], dict[str, Counter[str]]]:
    """Try files made of pieces of several logs; return the failures and the other outcomes."""
    failures: Counter[str] = Counter()
    outcomes: dict[str, Counter[str]] = {name: Counter() for name in joinedlogs.WRITERS}
    for name, outcome in outcomes.items():
        for number in range(files):
            try:
                with warnings.catch_warnings(), limits():
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
    parser.add_argument("--mutants", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--joined", type=int, default=0, help="files of each format, made of pieces of several logs")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"), help="where failing mutants are kept")
    arguments = parser.parse_args()
    limit_memory()
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        failures, outcomes, slowest_s = run(arguments.mutants, arguments.seed, Path(folder), arguments.keep)
        failed, joined = run_joined(arguments.joined, arguments.seed, Path(folder), arguments.keep)
    failures += failed
    outcomes |= joined
    for name, outcome in outcomes.items():
        refusals = len(outcome.keys() - {"a flight"})
        print(f"{name}: {outcome.total()} mutants, {outcome['a flight']} flights, {refusals} kinds of refusal")
    print(f"{arguments.mutants} mutants in {time.monotonic() - began_s:.0f} s, the slowest {slowest_s:.2f} s")
    for failure, count in failures.most_common():
        print(f"FAILED {count} times: {failure}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
