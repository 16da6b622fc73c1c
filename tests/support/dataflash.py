"""DataFlash logs written for tests, binary and as text, and real ones written again as text."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
from pymavlink.DFReader import DFReader_binary

from glstar.rotation import conjugate, multiply, quaternion_from_euler
from glstar.sky.place.site import Site
from glstar.sky.place.timescale import parse_utc
from glstar.telemetry.dataflash.records import BinaryRecords

HOME = Site(latitude_rad=np.deg2rad(-34.93), longitude_rad=np.deg2rad(138.60), height_m=48.0)
# GPS week 2305 begins on 2024-03-10; 11:00:00 UTC is 18 s later by GPS time.
WEEK, ELEVEN_MS = 2305, (11 * 3600 + 18) * 1000
ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
BOOT_S = 30.0


def angle_deg(q1: np.ndarray, q2: np.ndarray) -> np.ndarray:
    turn = multiply(q1, conjugate(q2))
    return np.rad2deg(2 * np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), np.abs(turn[..., 0])))


def times(duration_s: float = 2.0, rate_hz: float = 25.0) -> Iterator[float]:
    return (BOOT_S + i / rate_hz for i in range(int(duration_s * rate_hz) + 1))


class Log:
    """A DataFlash file, written record by record; the first record of a name is preceded by its definition."""

    CODES: ClassVar = {
        "B": "B",
        "Q": "Q",
        "H": "H",
        "I": "I",
        "f": "f",
        "c": "h",
        "C": "H",
        "L": "i",
        "e": "i",
        "E": "I",
        "N": "16s",
        "Z": "64s",
    }

    def __init__(self) -> None:
        self.data = b""
        self.kinds: dict[str, int] = {}

    def add(self, name: str, letters: str, fields: str, *values: float | str) -> "Log":
        body = struct.Struct("<" + "".join(self.CODES[letter] for letter in letters))
        if name not in self.kinds:
            self.kinds[name] = 1 + len(self.kinds)
            layout = (self.kinds[name], body.size + 3, name.encode(), letters.encode(), fields.encode())
            self.data += b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *layout)
        self.data += bytes([0xA3, 0x95, self.kinds[name]]) + body.pack(
            *(value.encode() if isinstance(value, str) else value for value in values)
        )
        return self

    def att(
        self, t_s: float, roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0, aekf: int = 3
    ) -> None:
        angles = (round(100 * angle) for angle in (roll_deg, pitch_deg, yaw_deg))
        self.add("ATT", "QccCB", "TimeUS,Roll,Pitch,Yaw,AEKF", round(t_s * 1e6), *angles, aekf)

    def xkq(self, t_s: float, lane: int, yaw_deg: float, name: str = "XKQ") -> None:
        q_ned_body = conjugate(quaternion_from_euler(0.0, 0.0, np.deg2rad(yaw_deg)))
        self.add(name, "QBffff", "TimeUS,C,Q1,Q2,Q3,Q4", round(t_s * 1e6), lane, *q_ned_body)

    def xkf4(self, t_s: float, primary: int) -> None:
        self.add("XKF4", "QBB", "TimeUS,C,PI", round(t_s * 1e6), 0, primary)

    def pos(self, t_s: float, latitude_deg: float = -34.93, longitude_deg: float = 138.60) -> None:
        place = (round(latitude_deg * 1e7), round(longitude_deg * 1e7), 48.0)
        self.add("POS", "QLLf", "TimeUS,Lat,Lng,Alt", round(t_s * 1e6), *place)

    def gps(
        self,
        t_s: float,
        *,
        lag_s: float = 0.020,
        status: int = 3,
        week: int = WEEK,
        receiver: int = 0,
        in_use: int = 1,
        latitude_deg: float = -34.93,
    ) -> None:
        """Write the sample of boot time `t_s`, `lag_s` after it was taken; boot time 30 s is 11:00 UTC."""
        ms = ELEVEN_MS + round((t_s - BOOT_S) * 1000)
        written_us, place = round((t_s + lag_s) * 1e6), (round(latitude_deg * 1e7), 1386000000, 48.0)
        self.add(
            "GPS",
            "QBBIHLLfB",
            "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,U",
            written_us,
            receiver,
            status,
            ms,
            week,
            *place,
            in_use,
        )

    def gpa(self, t_s: float, *, lag_s: float = 0.0, receiver: int = 0) -> None:
        self.add("GPA", "QBI", "TimeUS,I,SMS", round((t_s + lag_s) * 1e6), receiver, round(t_s * 1000))

    def camera(self, name: str, t_s: float, camera: int, image: int) -> None:
        """Write that a camera was triggered (TRIG), or that it answered (CAM)."""
        self.add(name, "QBH", "TimeUS,I,Img", round(t_s * 1e6), camera, image)

    def ev(self, t_s: float, event: int) -> None:
        self.add("EV", "QB", "TimeUS,Id", round(t_s * 1e6), event)

    def msg(self, t_s: float, text: str) -> None:
        self.add("MSG", "QZ", "TimeUS,Message", round(t_s * 1e6), text)

    def imu(self, t_s: float, *rate_rad_per_s: float, instance: int = 0) -> None:
        self.add("IMU", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", round(t_s * 1e6), instance, *rate_rad_per_s)

    def gyr(self, t_s: float, *rate_rad_per_s: float, lag_s: float = 0.01, instance: int = 0) -> None:
        stamps = round((t_s + lag_s) * 1e6), instance, round(t_s * 1e6)
        self.add("GYR", "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ", *stamps, *rate_rad_per_s)

    def save(self, path: Path) -> Path:
        path.write_bytes(self.data)
        return path


class TextLog(Log):
    """A DataFlash log as text, with numbers as the autopilot's console prints them."""

    def add(self, name: str, letters: str, fields: str, *values: float | str) -> "TextLog":
        if name not in self.kinds:
            self.kinds[name] = 1 + len(self.kinds)
            size = 3 + struct.calcsize("<" + "".join(self.CODES[letter] for letter in letters))
            self.data += f"FMT, {self.kinds[name]}, {size}, {name}, {letters}, {fields}\n".encode()
        printed = (console(letter, value, raw=True) for letter, value in zip(letters, values, strict=True))
        self.data += ", ".join([name, *printed]).encode() + b"\n"
        return self


def console(letter: str, value: float | str | bytes, *, raw: bool = False) -> str:
    """Return a value as the autopilot's console prints it; raw values are those of the binary log."""
    if letter in "nNZ":
        return value.split(b"\0")[0].decode() if isinstance(value, bytes) else value
    if letter in "cCeE":
        return f"{value * 0.01 if raw else value:.2f}"
    if letter == "L":
        return f"{value * 1e-7 if raw else value:.7f}"
    return f"{value:f}" if letter in "fdg" else str(value)


def as_text(log: Path) -> bytes:
    """Return a binary log as text, every record a line, as pymavlink reads it."""
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    with DFReader_binary(str(log)) as reader:
        while (message := reader.recv_msg()) is not None:
            cells = [getattr(message, field) for field in message.fmt.columns]
            if message.get_type() == "FMT" and message.Name == "FMT":
                continue
            printed = (console(letter, cell) for letter, cell in zip(message.fmt.format, cells, strict=True))
            lines.append(", ".join([message.get_type(), *printed]))
    return "\r\n".join([*lines, ""]).encode()


def beginning(log: Path, folder: Path, size: int = 1_000_000) -> Path:
    """Return the first complete records of a log as a log of its own, for slow tests of every record."""
    path = folder / f"beginning_{log.name}"
    path.write_bytes(log.read_bytes()[:size])
    whole = BinaryRecords(str(path)).end
    path.write_bytes(log.read_bytes()[:whole])
    return path


def dataflash(path: Path, *, gps: bool = False, pos: bool = False) -> Path:
    """Write a flight of 8 s that turns."""
    log = Log()
    for t in times(8.0):
        log.att(t, yaw_deg=4.0 * (t - 30.0))
        if gps:
            log.gps(t)
        if pos:
            log.pos(t)
    return log.save(path)


def with_head(data: bytes) -> bytes:
    """Return a log that begins with the FMT record of FMT, as every log file does."""
    if data.startswith(b"FMT"):
        return b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n" + data
    return (
        b"\xa3\x95\x80"
        + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
        + data
    )
