"""Random tracks of each format with fixes of a receiver that has none among them, and the truth about them."""

import datetime as dt
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import aerofiles.igc
import gpxpy.gpx
import numpy as np
import pynmea2
import simplekml

from glstar.arrays import Float

START = dt.datetime(2024, 3, 10, 23, 59, 0, tzinfo=dt.UTC)
_LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT_M = -34.93, 179.99, 500.0
_EARTH_RADIUS_M = 6.371e6


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """A fix as a receiver states it."""

    utc_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float
    is_valid: bool = True

    @property
    def time(self) -> dt.datetime:
        return dt.datetime.fromtimestamp(self.utc_s, dt.UTC)


@dataclass(frozen=True, slots=True, eq=False)
class TrackCase:
    """A track, and how it was flown: with constant speed."""

    path: Path
    format: str
    decoys: tuple[str, ...]
    speed_north_m_per_s: float
    speed_east_m_per_s: float
    first_s: float  # UTC of the first and the last true fix, s since 1970
    last_s: float

    def error_m(self, utc_s: Float, latitude_rad: Float, longitude_rad: Float, height_m: Float) -> float:
        """Return the largest distance of positions from the truth, m."""
        latitude_deg, longitude_deg = _place_deg(utc_s, self.speed_north_m_per_s, self.speed_east_m_per_s)
        north_m = (latitude_rad - np.deg2rad(latitude_deg)) * _EARTH_RADIUS_M
        turn_rad = (longitude_rad - np.deg2rad(longitude_deg) + np.pi) % (2 * np.pi) - np.pi
        east_m = turn_rad * _EARTH_RADIUS_M * np.cos(latitude_rad)
        return float(np.sqrt(north_m**2 + east_m**2 + (height_m - _HEIGHT_M) ** 2).max())


def _place_deg(utc_s: Float, north_m_per_s: float, east_m_per_s: float) -> tuple[Float, Float]:
    past_s = utc_s - START.timestamp()
    latitude_deg = _LATITUDE_DEG + np.rad2deg(north_m_per_s * past_s / _EARTH_RADIUS_M)
    parallel_m = _EARTH_RADIUS_M * np.cos(np.deg2rad(_LATITUDE_DEG))
    longitude_deg = _LONGITUDE_DEG + np.rad2deg(east_m_per_s * past_s / parallel_m)
    return latitude_deg, (longitude_deg + 180) % 360 - 180


def _zero_before_lock(random: np.random.Generator, points: list[_Point]) -> list[_Point]:
    until = int(random.uniform(0.05, 0.4) * len(points))
    return [_Point(p.utc_s, 0.0, 0.0, 0.0, is_valid=k >= until) if k < until else p for k, p in enumerate(points)]


def _spikes(random: np.random.Generator, points: list[_Point]) -> list[_Point]:
    rows = set(random.integers(0, len(points), 3).tolist())
    metres_deg = random.choice([0.5, 3.0, 40.0, -1.0])
    return [
        _Point(p.utc_s, p.latitude_deg + metres_deg, p.longitude_deg, p.height_m) if k in rows else p
        for k, p in enumerate(points)
    ]


def _elsewhere(random: np.random.Generator, points: list[_Point]) -> list[_Point]:
    start = int(random.integers(0, len(points)))
    rows = range(start, start + int(random.uniform(0.05, 0.3) * len(points)))
    return [_Point(p.utc_s, 48.1, 11.6, 520.0) if k in rows else p for k, p in enumerate(points)]


def _impossible_heights(random: np.random.Generator, points: list[_Point]) -> list[_Point]:
    height_m = random.choice([-9999.0, 99999.0, 50000.0])
    rows = set(random.integers(0, len(points), 4).tolist())
    return [
        _Point(p.utc_s, p.latitude_deg, p.longitude_deg, height_m) if k in rows else p for k, p in enumerate(points)
    ]


def _other_days(random: np.random.Generator, points: list[_Point]) -> list[_Point]:
    days = random.choice([-1, 1, 2, 30])
    others = [_Point(p.utc_s + 86400 * days, p.latitude_deg, p.longitude_deg, 1900.0) for p in points]
    return others + points if days < 0 else points + others


def _pauses(random: np.random.Generator, points: list[_Point]) -> list[_Point]:
    start = int(random.uniform(0.2, 0.6) * len(points))
    return points[:start] + points[start + int(0.2 * len(points)) :]


DECOYS: dict[str, Callable[[np.random.Generator, list[_Point]], list[_Point]]] = {
    "pauses": _pauses,
    "zero before lock": _zero_before_lock,
    "spikes": _spikes,
    "elsewhere": _elsewhere,
    "impossible heights": _impossible_heights,
    "other days": _other_days,
}


def _gpx(path: Path, points: list[_Point]) -> None:
    track = gpxpy.gpx.GPX()
    track.tracks.append(gpxpy.gpx.GPXTrack())
    segment = gpxpy.gpx.GPXTrackSegment()
    track.tracks[0].segments.append(segment)
    for p in points:
        fix = gpxpy.gpx.GPXTrackPoint(p.latitude_deg, p.longitude_deg, p.height_m, p.time)
        fix.type_of_gpx_fix = "3d" if p.is_valid else "none"
        segment.points.append(fix)
    path.write_text(track.to_xml(), encoding="utf-8")


def _kml(path: Path, points: list[_Point]) -> None:
    document = simplekml.Kml()
    track = document.newgxtrack(altitudemode=simplekml.AltitudeMode.absolute)
    track.newwhen([f"{p.time:%Y-%m-%dT%H:%M:%S.%fZ}" for p in points])
    track.newgxcoord([(p.longitude_deg, p.latitude_deg, p.height_m) for p in points])
    document.save(str(path))


def angle(degrees: float, digits: int, sides: str) -> tuple[str, str]:
    """Return an angle as NMEA has it: ddmm.mmmmm and its side."""
    minutes = round(abs(degrees) * 60, 5)
    return f"{int(minutes // 60):0{digits}d}{minutes % 60:08.5f}", sides[int(degrees < 0)]


def nmea_sentences(points: list[_Point], dated_by: str = "RMC") -> list[str]:
    """Return the sentences of points: GGA, and RMC or ZDA."""
    lines = []
    for p in points:
        place = (*angle(p.latitude_deg, 2, "NS"), *angle(p.longitude_deg, 3, "EW"))
        stamp, quality = f"{p.time:%H%M%S}.{p.time.microsecond // 10000:02d}", "1" if p.is_valid else "0"
        data = (stamp, *place, quality, "12", "0.7", f"{p.height_m - 50:.2f}", "M", "50.0", "M", "", "")
        lines.append(str(pynmea2.GGA("GN", "GGA", data)))
        if dated_by == "RMC":
            state = "A" if p.is_valid else "V"
            data = (stamp, state, *place, "12.0", "90.0", f"{p.time:%d%m%y}", "", "", state if state == "A" else "N")
            lines.append(str(pynmea2.RMC("GN", "RMC", data)))
        else:
            lines.append(str(pynmea2.ZDA("GN", "ZDA", (stamp, *f"{p.time:%d %m %Y}".split(), "00", "00"))))
    return lines


def _nmea(path: Path, points: list[_Point]) -> None:
    path.write_text("\r\n".join(nmea_sentences(points)) + "\r\n", encoding="ascii")


def _nmea_zda(path: Path, points: list[_Point]) -> None:
    lines = [f"2024-03-10 11:00:00.5 {line.partition('*')[0]}" for line in nmea_sentences(points, "ZDA")]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _igc(path: Path, points: list[_Point]) -> None:
    with path.open("wb") as file:
        writer = aerofiles.igc.Writer(file)
        writer.write_headers({
            "manufacturer_code": "XCS", "logger_id": "TBX", "date": points[0].time.date(), "fix_accuracy": 50,
            "pilot": "Ada", "glider_type": "DG", "glider_id": "D-1", "firmware_version": "1", "hardware_version": "1",
            "logger_type": "x", "gps_receiver": "u-blox", "pressure_sensor": "x",
        })  # fmt: skip
        day = points[0].time.date()
        for p in points:
            if p.time.date() != day:
                day = p.time.date()
                file.write(f"HFDTE{day:%d%m%y}\r\n".encode())
            height_m = int(np.clip(p.height_m, -9999, 99999))
            place = {"latitude": p.latitude_deg, "longitude": p.longitude_deg}
            writer.write_fix(p.time.time(), **place, valid=p.is_valid, pressure_alt=height_m, gps_alt=height_m)


FORMATS: dict[str, Callable[[Path, list[_Point]], None]] = {
    "GPX": _gpx,
    "KML": _kml,
    "NMEA": _nmea,
    "NMEA with ZDA": _nmea_zda,
    "IGC": _igc,
}


def make_track(folder: Path, seed: int) -> TrackCase:
    """Write a track of a random format with random decoys."""
    random = np.random.default_rng(seed)
    kind = str(random.choice([*FORMATS]))
    step_s = float(random.choice([1.0, 2.0, 10.0] if kind == "IGC" else [0.2, 1.0, 5.0]))
    utc_s = START.timestamp() + step_s * np.arange(int(random.integers(40, 150)))
    north_m_per_s, east_m_per_s = random.uniform(-200, 200, 2)
    latitude_deg, longitude_deg = _place_deg(utc_s, north_m_per_s, east_m_per_s)
    points = [_Point(*fix, _HEIGHT_M) for fix in zip(utc_s.tolist(), latitude_deg, longitude_deg, strict=True)]
    decoys = [str(decoy) for decoy in random.choice([*DECOYS], int(random.integers(0, 3)), replace=False)]
    true = set(points)
    for decoy in sorted(decoys, key=[*DECOYS].index):
        points = DECOYS[decoy](random, points)
    kept_s = [point.utc_s for point in points if point in true]
    path = folder / f"track{seed}"
    FORMATS[kind](path, points)
    return TrackCase(path, kind, tuple(decoys), north_m_per_s, east_m_per_s, kept_s[0], kept_s[-1])
