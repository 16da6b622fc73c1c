"""ULog files, written for tests."""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np

from glstar.rotation import conjugate, quaternion_from_euler
from glstar.sky.place.timescale import parse_utc

LOGS = Path(__file__).parents[3] / "shared" / "logs"
PLANE = LOGS / "plane_Proto_FLT09.reenc.ulg"
VTOL = LOGS / "vtol_ground_pyulog_sample_log_small.ulg"
ELEVEN_S = parse_utc("2024-03-10T11:00:00Z")
BOOT_S = 30.0


class Log:
    """A ULog file, written message by message; the first sample of an instance of a topic adds its definitions."""

    CODES: ClassVar = {
        "uint64_t": "Q",
        "uint32_t": "I",
        "uint8_t": "B",
        "int8_t": "b",
        "int32_t": "i",
        "float": "f",
        "double": "d",
        "bool": "?",
    }

    def __init__(self) -> None:
        self.head = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
        self.formats: dict[str, bytes] = {}
        self.numbers: dict[tuple[str, int], int] = {}
        self.samples: list[bytes] = []

    @staticmethod
    def message(kind: str, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), ord(kind)) + body

    def add(self, name: str, t_s: float, instance: int = 0, **fields: tuple[str, object]) -> "Log":
        """Write a sample; fields are name = (type, value or values)."""
        layout, code, values = "uint64_t timestamp;", "<Q", [round(t_s * 1e6)]
        for field, (kind, value) in fields.items():
            many = list(value) if np.ndim(value) else [value]  # type: ignore[call-overload]
            layout += f"{kind}[{len(many)}] {field};" if np.ndim(value) else f"{kind} {field};"
            code += self.CODES[kind] * len(many)
            values += many
        self.formats.setdefault(name, self.message("F", f"{name}:{layout}".encode()))
        number = self.numbers.setdefault((name, instance), len(self.numbers))
        self.samples.append(self.message("D", struct.pack("<H", number) + struct.pack(code, *values)))
        return self

    def about(self, name: str, kind: str, value: int) -> None:
        """Write information about the log."""
        key = f"{kind} {name}".encode()
        self.head += self.message("I", bytes([len(key)]) + key + struct.pack(f"<{self.CODES[kind]}", value))

    def attitude(
        self, t_s: float, yaw_deg: float = 0.0, name: str = "vehicle_attitude", instance: int = 0, **more: object
    ) -> None:
        q_ned_body = conjugate(quaternion_from_euler(0.0, 0.0, np.deg2rad(yaw_deg)))
        # As newer versions of PX4 log it: the time of the sample, 5 ms before its publication.
        sampled = {"timestamp_sample": ("uint64_t", round(t_s * 1e6))} if more.pop("sampled", False) else {}
        late_s = 0.005 if sampled else 0.0
        self.add(name, t_s + late_s, instance, **sampled, q=("float", q_ned_body), **more)  # type: ignore[arg-type]

    def gps(
        self,
        t_s: float,
        *,
        fix: int = 3,
        utc_s: float | None = None,
        new: bool = True,
        age_s: float = 0.0,
        logged_age_s: float | None = None,
        instance: int = 0,
    ) -> None:
        """Write a fix; boot time 30 s is 11:00 UTC."""
        utc_us = round(1e6 * (ELEVEN_S + t_s - BOOT_S - age_s if utc_s is None else utc_s))
        place: dict[str, tuple[str, object]] = {
            "latitude_deg": ("double", -34.93),
            "longitude_deg": ("double", 138.60),
            "altitude_msl_m": ("double", 48.0),
        }
        if not new:
            place = {"lat": ("int32_t", -349300000), "lon": ("int32_t", 1386000000), "alt": ("int32_t", 48000)}
        self.add(
            "sensor_gps" if new else "vehicle_gps_position",
            t_s,
            instance,
            time_utc_usec=("uint64_t", max(utc_us, 0)),
            **place,
            timestamp_time_relative=("int32_t", round(-1e6 * (age_s if logged_age_s is None else logged_age_s))),
            fix_type=("uint8_t", fix),
        )

    def trigger(
        self, t_s: float, number: int, *, feedback: bool = False, utc_s: float | None = None, instance: int = 0
    ) -> None:
        """Write a trigger of a camera, or its answer."""
        utc_us = round(1e6 * (ELEVEN_S + t_s - BOOT_S if utc_s is None else utc_s))
        fields = {"timestamp_utc": ("uint64_t", utc_us), "seq": ("uint32_t", number), "feedback": ("bool", feedback)}
        self.add("camera_trigger", t_s, instance, **fields)  # type: ignore[arg-type]

    def capture(
        self, t_s: float, number: int, *, result: int = 1, utc_s: float | None = None, instance: int = 0
    ) -> None:
        """Write a capture of a camera: result 1 for success, 0 for failure, -1 if the camera does not say."""
        utc_us = round(1e6 * (ELEVEN_S + t_s - BOOT_S if utc_s is None else utc_s))
        fields = {"timestamp_utc": ("uint64_t", utc_us), "seq": ("uint32_t", number), "result": ("int8_t", result)}
        self.add("camera_capture", t_s, instance, **fields)  # type: ignore[arg-type]

    def data(self, *between: bytes) -> bytes:
        subscriptions = [
            self.message("A", struct.pack("<BH", instance, number) + name.encode())
            for (name, instance), number in self.numbers.items()
        ]
        return b"".join((self.head, *self.formats.values(), *subscriptions, *between, *self.samples))

    def save(self, path: Path) -> Path:
        path.write_bytes(self.data())
        return path


def times(duration_s: float = 2.0, rate_hz: float = 50.0) -> Iterator[float]:
    return (BOOT_S + i / rate_hz for i in range(int(duration_s * rate_hz) + 1))
