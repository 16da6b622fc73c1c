"""Tracks of position and time without attitude: GPX, KML, KMZ, NMEA 0183 and IGC.

A track supplies the positions of a flight whose log has none, or better ones: ``--position track.gpx``.
"""

import re
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from glstar.errors import ConfigError, LogFormatError
from glstar.flight import PositionTrack
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import read_bytes

# For messages.
TRACK_FORMATS = "GPX, KML, KMZ, NMEA or IGC"
# Larger files are refused as mistakes: a day of 10 Hz NMEA has 200 MB.
_LARGEST_BYTES = 512 << 20
_DAY_S = 86400.0
# UTC, latitude and longitude (deg), height (m).
_Fix = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class GivenTrack:
    """Positions that the user gives beside a log."""

    track: PositionTrack
    source: str  # File, format and number of fixes, for messages


def read_track(path: str) -> GivenTrack:
    """Read a track, whose format its content determines.

    Raises LogFormatError if it cannot be read, or has no positions with times.
    """
    try:
        content = read_bytes(path, _LARGEST_BYTES)
        kind, parse = _format(path, content)
        fixes = np.array(sorted(parse(_text(content))), dtype=np.float64).reshape(-1, 4)
    except (ValueError, KeyError, IndexError, ET.ParseError, zipfile.BadZipFile) as error:
        if isinstance(error, LogFormatError):
            raise
        raise LogFormatError(path, f"cannot be read as a track: {error}") from error
    valid = np.isfinite(fixes).all(axis=1) & (np.abs(fixes[:, 1]) <= 90) & (np.abs(fixes[:, 2]) <= 360)
    fixes = fixes[valid]
    if not fixes.size:
        raise LogFormatError(path, f"has no places with times in it ({kind})")
    track = PositionTrack.from_samples(fixes[:, 0], np.deg2rad(fixes[:, 1]), np.deg2rad(fixes[:, 2]), fixes[:, 3])
    return GivenTrack(track, f"{Path(path).name}, {kind}, {len(fixes)} fixes")


def _format(path: str, content: bytes) -> tuple[str, Callable[[str], Iterator[_Fix]]]:
    """Return the name of a format, and the function that yields its fixes."""
    head = content[:4096].lstrip(b"\xef\xbb\xbf \r\n\t")
    if head.startswith(b"PK\x03\x04"):
        return "KMZ", lambda _: _kml(_text(_kmz(path)))
    if b"<gpx" in head:
        return "GPX", _gpx
    if b"<kml" in head:
        return "KML", _kml
    if re.match(rb"A[A-Z0-9]{3}", head) and re.search(rb"^(HFDTE|B\d{6})", content, re.M):
        return "IGC", _igc
    if re.search(rb"^\$[A-Z]{2}(RMC|GGA|ZDA)", content, re.M):
        return "NMEA", _nmea
    raise LogFormatError(path, f"is no track that glstar knows: {TRACK_FORMATS}")


def _text(content: bytes) -> str:
    return content.decode("utf-8-sig", errors="replace")


def _kmz(path: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
        if not names:
            raise LogFormatError(path, "is a zip archive without a track")
        return archive.read(names[0])


def _elements(text: str) -> Iterator[tuple[str, ET.Element]]:
    """Yield the elements of an XML document with their names without the namespace."""
    if "<!ENTITY" in text:
        raise ValueError("it declares entities, which no track needs")
    for element in ET.fromstring(text).iter():  # noqa: S314 - without entities
        yield str(element.tag).rpartition("}")[2], element


def _texts(elements: Iterable[ET.Element]) -> list[tuple[str, str]]:
    """Return the names without the namespace and the texts of elements."""
    return [(str(element.tag).rpartition("}")[2], (element.text or "").strip()) for element in elements]


def _utc_s(text: str) -> float:
    try:
        return parse_utc(text)
    except ConfigError as error:
        raise ValueError(str(error)) from error


def _gpx(text: str) -> Iterator[_Fix]:
    for name, element in _elements(text):
        if name == "trkpt":
            texts = dict(_texts(element))
            if "time" in texts:
                height_m = float(texts.get("ele") or 0)
                yield _utc_s(texts["time"]), float(element.attrib["lat"]), float(element.attrib["lon"]), height_m


def _kml(text: str) -> Iterator[_Fix]:
    for name, element in _elements(text):
        if name == "Track":
            parts = _texts(element)
            times = [text for tag, text in parts if tag == "when"]
            positions = [text for tag, text in parts if tag == "coord"]
            for when, position in zip(times, positions, strict=True):
                yield (_utc_s(when), *_kml_position(position.split()))
        if name == "Placemark":
            texts = dict(_texts(element.iter()))
            if texts.get("when") and texts.get("coordinates") and "Point" in texts:
                yield (_utc_s(texts["when"]), *_kml_position(texts["coordinates"].split(",")))


def _kml_position(parts: list[str]) -> tuple[float, float, float]:
    """Return latitude and longitude, deg, and height, m; 0 without one."""
    longitude, latitude, *height = map(float, parts)
    return latitude, longitude, height[0] if height else 0.0


def _igc(text: str) -> Iterator[_Fix]:
    """Yield the B records of an IGC file; their times are UTC of the day in HFDTE, and go on after midnight."""
    day_s = before_s = float("nan")
    for line in text.splitlines():
        if date := re.match(r"HFDTE(?:DATE:)?\s*(\d\d)(\d\d)(\d\d)", line):
            day, month, year = date.groups()
            day_s, before_s = _utc_s(f"20{year}-{month}-{day}"), float("nan")
        fix = re.match(
            r"B(\d\d)(\d\d)(\d\d)(\d\d)(\d{5})([NS])(\d{3})(\d{5})([EW])([AV])([-\d]\d{4})([-\d]\d{4})", line
        )
        if fix is None:
            continue
        hours, minutes, seconds, north, north_min, side, east, east_min, east_side = fix.groups()[:9]
        utc_s = day_s + 3600 * int(hours) + 60 * int(minutes) + int(seconds)
        if utc_s < before_s - _DAY_S / 2:
            day_s, utc_s = day_s + _DAY_S, utc_s + _DAY_S
        before_s = utc_s
        latitude_deg = (int(north) + int(north_min) / 60000) * (1 if side == "N" else -1)
        longitude_deg = (int(east) + int(east_min) / 60000) * (1 if east_side == "E" else -1)
        # V is a fix without GNSS height: the height by pressure remains.
        yield utc_s, latitude_deg, longitude_deg, float(fix[12] if fix[10] == "A" else fix[11])


def _nmea(text: str) -> Iterator[_Fix]:
    """Yield the fixes of NMEA sentences: RMC has date, time and position, GGA the height at the same time of day."""
    heights_m: dict[str, float] = {}
    positions: list[tuple[str, float, float, float]] = []
    for line in text.splitlines():
        fields = _nmea_fields(line)
        if fields and fields[0][2:] == "GGA" and fields[6] not in {"", "0"} and fields[9]:
            heights_m[fields[1]] = float(fields[9]) + float(fields[11] or 0)
        if fields and fields[0][2:] == "RMC" and fields[2] == "A":
            time, date = fields[1], fields[9]
            utc_s = _utc_s(f"20{date[4:6]}-{date[2:4]}-{date[:2]}T{time[:2]}:{time[2:4]}:{time[4:6]}")
            utc_s += float(f"0{time[6:]}")
            positions.append((time, utc_s, _nmea_angle(fields[3], fields[4]), _nmea_angle(fields[5], fields[6])))
    for time, utc_s, latitude_deg, longitude_deg in positions:
        yield utc_s, latitude_deg, longitude_deg, heights_m.get(time, 0.0)


def _nmea_fields(line: str) -> list[str]:
    """Return the fields of a sentence; none if its checksum is wrong or missing."""
    start, star = line.find("$"), line.rfind("*")
    if start < 0 or star < start:
        return []
    body = line[start + 1 : star]
    if line[star + 1 : star + 3].upper() != f"{reduce(xor, body.encode(), 0):02X}":
        return []
    return body.split(",")


def _nmea_angle(text: str, side: str) -> float:
    """Return degrees of ddmm.mmmm or dddmm.mmmm."""
    minutes_at = text.index(".") - 2
    return (int(text[:minutes_at]) + float(text[minutes_at:]) / 60) * (1 if side in "NE" else -1)
