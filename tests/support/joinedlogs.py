"""Files made of pieces of several logs: joined, cut in the middle, interleaved; and checks of their flights.

Every boot has a roll of its own, and its yaw is the time since it began: an attitude therefore identifies its boot and
its UTC.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from glstar.errors import LogFormatError
from glstar.flight import Flight
from glstar.rotation import euler_from_quaternion
from glstar.telemetry import open_flight
from tests.support import tlog, ulog
from tests.support.dataflash import ELEVEN_MS, ELEVEN_S, WEEK, Log, TextLog

RATE_HZ = 10.0
# Rate of yaw, deg/s: a boot is shorter than the 180 s of half a turn.
TURN_DEG_PER_S = 1.0
# Boots whose UTC minus clock agrees within this, s, count as one: no autopilot restarts within half a second.
UTC_TOLERANCE_S = 0.5
# Where only the recorder's clock separates them, a second.
RECORDER_TOLERANCE_S = 1.1


@dataclass(frozen=True)
class Flown:
    """A boot: its number, when its clock and UTC began, and for how long; without a fix it has no UTC."""

    number: int
    start_s: float
    utc_s: float
    duration_s: float
    has_fix: bool = True

    @property
    def times_s(self) -> list[float]:
        return [i / RATE_HZ for i in range(round(self.duration_s * RATE_HZ) + 1)]

    @property
    def roll_deg(self) -> float:
        return 8.0 * self.number

    def yaw_deg(self, t_s: float) -> float:
        return 2.0 + TURN_DEG_PER_S * t_s


def dataflash(boot: Flown, kind: type[Log] = Log) -> bytes:
    log = kind()
    if kind is Log:
        log.data += b"\xa3\x95\x80\x80\x59FMT\0BBnNZ".ljust(25, b"\0") + b"Type,Length,Name,Format,Columns".ljust(
            64, b"\0"
        )
    else:
        log.data += b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n"
    log.msg(boot.start_s, "ArduPlane V4.5.1 (1a2b3c4d)")
    for n, t in enumerate(boot.times_s):
        log.att(boot.start_s + t, roll_deg=boot.roll_deg, yaw_deg=boot.yaw_deg(t))
        log.imu(boot.start_s + t, 0.0, 0.0, np.deg2rad(TURN_DEG_PER_S))
        if n % 2 == 0:
            log.pos(boot.start_s + t)
            ms = ELEVEN_MS + round((boot.utc_s - ELEVEN_S + t) * 1000)
            values = (3 if boot.has_fix else 1, ms % 604_800_000, WEEK + ms // 604_800_000)
            written_us = round((boot.start_s + t + 0.02) * 1e6)
            log.add(
                "GPS", "QBIHLLf", "TimeUS,Status,GMS,GWk,Lat,Lng,Alt", written_us, *values, -349300000, 1386000000, 48.0
            )
    return log.data


def text(boot: Flown) -> bytes:
    return dataflash(boot, TextLog)


def telemetry(boot: Flown) -> bytes:
    log = tlog.Log()
    log.stamp_s = boot.utc_s - boot.start_s + 3.0  # the ground station's clock is ahead
    for n, t in enumerate(boot.times_s):
        at_s = boot.start_s + t
        roll_rad, yaw_rad = np.deg2rad([boot.roll_deg, boot.yaw_deg(t)])
        message = tlog.common.MAVLink_attitude_message(tlog.ms(at_s), roll_rad, 0.0, yaw_rad, 0.0, 0.0, 0.0)
        log.add(message, at_s)
        if n % 5 == 0:
            log.place(at_s)
            if boot.has_fix:
                log.time(at_s, utc_s=boot.utc_s + t)
    return log.data()


def px4(boot: Flown) -> bytes:
    log = ulog.Log()
    for n, t in enumerate(boot.times_s):
        q = ulog.quaternion_from_euler(*np.deg2rad([boot.roll_deg, 0.0, boot.yaw_deg(t)]))
        log.add("vehicle_attitude", boot.start_s + t, q=("float", ulog.conjugate(q)))
        if n % 2 == 0:
            fix = {"fix": 3, "utc_s": boot.utc_s + t} if boot.has_fix else {"fix": 0, "utc_s": 0.0}
            log.gps(boot.start_s + t, **fix)
    return log.data()


def table(boot: Flown) -> bytes:
    rows = ["utc_s,roll_deg,pitch_deg,yaw_deg,latitude_deg,longitude_deg"]
    rows += [f"{boot.utc_s + t:.3f},{boot.roll_deg},0,{boot.yaw_deg(t):.4f},-34.93,138.6" for t in boot.times_s]
    return ("\n".join(rows) + "\n").encode()


def mavlogdump(boot: Flown) -> bytes:
    names = ["ATTITUDE.time_boot_ms", "ATTITUDE.roll", "ATTITUDE.pitch", "ATTITUDE.yaw"]
    names += ["SYSTEM_TIME.time_unix_usec", "SYSTEM_TIME.time_boot_ms"]
    names += [f"GLOBAL_POSITION_INT.{name}" for name in ("time_boot_ms", "lat", "lon", "alt")]
    rows = [",".join(["timestamp", *names])]
    for n, t in enumerate(boot.times_s):
        boot_ms, stamp = round((boot.start_s + t) * 1000), f"{boot.utc_s + t + 3.0:.8f}"
        roll_rad, yaw_rad = np.deg2rad([boot.roll_deg, boot.yaw_deg(t)])
        rows.append(f"{stamp},{boot_ms},{roll_rad},0.0,{yaw_rad},,,,,,")
        if n % 5 == 0:
            if boot.has_fix:
                rows.append(f"{stamp},,,,,{round((boot.utc_s + t) * 1e6)},{boot_ms},,,,")
            rows.append(f"{stamp},,,,,,,{boot_ms},-349300000,1386000000,48000")
    return ("\n".join(rows) + "\n").encode()


_PLACED = {"joined.csv", "joined.tlog", "joined_dump.csv"}

WRITERS: dict[str, Callable[[Flown], bytes]] = {
    "joined.BIN": dataflash,
    "joined.log": text,
    "joined.tlog": telemetry,
    "joined.ulg": px4,
    "joined.csv": table,
    "joined_dump.csv": mavlogdump,
}


# How pieces are put together; in the last two a piece may lack the beginning of its file.
LAYOUTS = ("one after the other", "in any order, the same one twice", "cut off at the end", "pieces", "interleaved")


def boots(chance: random.Random, layout: str) -> list[Flown]:
    """Return some boots: hours to years between them, simultaneous, or one after the other; some without a fix."""
    found: list[Flown] = []
    for number in range(1, chance.choice((2, 2, 3, 4)) + 1):
        duration_s = chance.uniform(4.0, 60.0)
        start_s, utc_s = chance.uniform(1.0, 2000.0), ELEVEN_S + chance.uniform(0.0, 8000.0)
        has_fix = chance.random() < 0.85
        if found:
            last = found[-1]
            break_s = chance.choice((5.0, 40.0, 3600.0, 26 * 86400.0, 3e8, -1000.0))
            utc_s = last.utc_s + last.duration_s + break_s * chance.uniform(1.0, 1.2)
            follows_s = last.start_s + last.duration_s
            beside_s = (start_s, last.start_s, follows_s + chance.uniform(0.0, 8.0), follows_s + 1 / RATE_HZ)
            start_s = chance.choice(beside_s)
        if layout in LAYOUTS[3:]:
            # Without a file header, a piece whose clock continues that of another one cannot be recognised if it
            # has no UTC, or if it is shorter than 10 s and continues without a break (a receiver's error).
            start_s = 100.0 * number + chance.uniform(0.0, 20.0) + chance.choice((0.0, 2000.0))
        found.append(Flown(number, start_s, utc_s, duration_s, has_fix))
    return found


def join(name: str, flown: list[Flown], layout: str, chance: random.Random) -> bytes:
    """Return a file made of pieces of the logs of some boots."""
    logs = [WRITERS[name](boot) for boot in flown]
    if layout == LAYOUTS[0]:
        return b"".join(logs)
    if layout == LAYOUTS[1]:
        return b"".join(chance.choices(logs, k=chance.choice((2, 3))))

    def at(log: bytes, offset: int) -> int:
        # Halves of two rows of numbers may be a row again: a table is cut between its rows.
        return log.rfind(b"\n", 0, offset) + 1 if name == "joined.csv" else offset

    if layout == LAYOUTS[2]:
        return b"".join(log[: at(log, chance.randrange(len(log) // 2, len(log) + 1))] for log in logs)
    if layout == LAYOUTS[3]:
        pieces = []
        for log in logs:
            start, stop = sorted(chance.choices(range(len(log) + 1), k=2))
            pieces.append(log[at(log, start) if chance.random() < 0.5 else 0 : at(log, stop)])
        return b"".join(pieces)
    count = chance.choice((2, 3))
    cuts = [[at(log, len(log) * part // count) for part in range(count + 1)] for log in logs]
    return b"".join(
        log[cut[part] : cut[part + 1]] for part in range(count) for log, cut in zip(logs, cuts, strict=True)
    )


def check(flight: Flight, flown: list[Flown], name: str) -> None:
    """Check that every attitude of a flight belongs to a boot and has the UTC of that boot.

    Raises
    ------
    AssertionError
    """
    roll_rad, _, yaw_rad = euler_from_quaternion(flight.attitude.q_body_ned)
    roll_deg, yaw_deg = np.rad2deg(roll_rad), np.rad2deg(yaw_rad)
    number = np.rint(roll_deg / 8.0).astype(int)
    assert np.abs(roll_deg - 8.0 * number).max() < 0.02, "an attitude that no piece has"
    by_number = {boot.number: boot for boot in flown}
    assert set(number.tolist()) <= by_number.keys(), "an attitude that no piece has"
    for one in np.unique(number).tolist():
        boot = by_number[one]
        mine = number == one
        t_s = (yaw_deg[mine] - 2.0) / TURN_DEG_PER_S
        assert t_s.min() > -0.1, "an attitude that no piece has"
        assert t_s.max() < boot.duration_s + 0.1, "an attitude that no piece has"
        # A telemetry log places a boot without UTC by the recorder's clock; a table's clock is UTC.
        assert boot.has_fix or name in _PLACED, f"boot {one} has no UTC, and was given one"
        wrong_s = flight.attitude.utc_s[mine] - (boot.utc_s + t_s)
        most_s = UTC_TOLERANCE_S if boot.has_fix else RECORDER_TOLERANCE_S
        assert np.abs(wrong_s).max() < most_s, f"UTC of boot {one} is wrong by {np.abs(wrong_s).max():.3f} s"
    between = np.flatnonzero(np.diff(number))
    for k in between.tolist():
        ends = flight.attitude.utc_s[k], flight.attitude.utc_s[k + 1]
        assert flight.attitude.gap_within(*ends) is not None, "two boots are interpolated into one"


def trial(folder: Path, name: str, number: int, seed: int) -> str:
    """Read one joined file; return "a flight" or the message of the refusal.

    Raises
    ------
    AssertionError
        If a flight has an attitude or a UTC that none of the pieces has.
    """
    path, flown = write(folder, name, number, seed)
    try:
        flight = open_flight(path)
    except LogFormatError as error:
        if "\n" in str(error):
            raise AssertionError("a refusal of more than one line") from error
        return str(error).split(": ", 1)[-1][:40]
    check(flight, flown, name)
    return "a flight"


def write(folder: Path, name: str, number: int, seed: int) -> tuple[Path, list[Flown]]:
    """Write one joined file; return it, and the boots whose pieces it has."""
    chance = random.Random(f"{seed}/{name}/{number}")
    layout = chance.choice(LAYOUTS)
    flown = boots(chance, layout)
    path = folder / name
    path.write_bytes(join(name, flown, layout, chance))
    return path, flown
