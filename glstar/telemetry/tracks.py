"""Tracks of position and time without attitude: GPX, KML, KMZ, NMEA 0183 and IGC.

A track supplies the positions of a flight whose log has none, or better ones: ``--position track.gpx``.  Elements that
cannot be used, of a receiver without a fix or damaged, are passed over and counted.
"""

import re
import zipfile
from codecs import lookup
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache, reduce
from math import nan, remainder
from operator import xor
from pathlib import Path
from typing import NamedTuple, cast
from xml.etree import ElementTree as ET

import numpy as np

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError, reading
from glstar.flight import PositionTrack
from glstar.sky.place.timescale import ROLLOVER_WEEKS, WEEK_S, parse_utc
from glstar.system.userinput import Unpacking, limit_of, read_bytes, refuse_more
from glstar.telemetry.source import YEAR_2010_S, flyable, is_missing_height, two_places, valid_positions

# For messages.
TRACK_FORMATS = "GPX, KML, KMZ, NMEA or IGC"
_DAY_S = 86400.0
# A longer time without a fix is between two flights, s.
BETWEEN_FLIGHTS_S = 4 * 3600.0
# Receivers without a date report 1980 or 1970, s since 1970.
_YEAR_1990_S = 631152000.0
# XML: its beginning as bytes and as text, and the encoding that it declares.
_XML = re.compile(rb"^(\xef\xbb\xbf)?\s*<|^(\xff\xfe)?<\x00|^(\xfe\xff)?\x00<")
# The root after comments and declarations; possessive, so that damaged comments are not searched again and again.
_ROOT = re.compile(r"(?:<!--.*?-->|<[?!](?!--)|[^<]++)*+<(?:[\w.-]+:)?([A-Za-z]\w*)", re.S)
_ENCODING = re.compile(rb"""^[^>]{0,80}encoding=["']([\w.-]+)["']""")
# XML is parsed in pieces, so that deep nesting is found before the rest is parsed.
_PIECE_CHARACTERS = 1 << 16
# Of host names and of program texts, by their names in `lookup`: some need the square of the time.
_NO_ENCODINGS = {"idna", "punycode", "unicode-escape", "raw-unicode-escape", "undefined", "utf-7"}
_NMEA = re.compile(rb"\$[A-Z]{2}(RMC|GGA|ZDA),")
# Heights of KML that are above ground, or meaningless.
_ABOVE_GROUND = {"relativeToGround", "relativeToSeaFloor", "clampToGround", "clampToSeaFloor"}


class _Fix(NamedTuple):
    """A fix; without a height it is NaN."""

    utc_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float


# Reads the fixes of a text, and counts what it passes over, by reason.
_Parse = Callable[[str, Counter[str]], Iterator[_Fix]]


@dataclass(frozen=True, slots=True, eq=False)
class GivenTrack:
    """Positions that the user gives beside a log."""

    track: PositionTrack
    source: str  # File, format and number of fixes, for messages
    fix_utc_s: Float  # Times of its fixes, s since 1970
    notes: tuple[str, ...] = ()  # Remarks for the user on what was passed over


def read_track(path: str) -> GivenTrack:
    """Read a track, whose format its content determines.

    Raises LogFormatError if it cannot be read, or has no positions with times.
    """
    with reading(path, LogFormatError, "cannot be read as a track"):
        return _read_track(path)


def _read_track(path: str) -> GivenTrack:
    passed: Counter[str] = Counter()
    kind, parse, text = _format(path, read_bytes(path, int(limit_of("content_mib"))))
    fixes = np.array(list(parse(text, passed)), dtype=np.float64).reshape(-1, 4)
    # A receiver itself writes the dates of NMEA; those of other files may really be old.
    early = (
        (fixes[:, 0] >= _YEAR_1990_S) & (fixes[:, 0] < YEAR_2010_S) if kind == "NMEA" else np.zeros(len(fixes), bool)
    )
    fixes[early, 0] += ROLLOVER_WEEKS * WEEK_S
    fixes = _valid(fixes[np.argsort(fixes[:, 0], kind="stable")], passed)
    name = Path(path).name
    why = "; ".join(f"{count} {reason}" for reason, count in passed.items())
    if not fixes.size:
        raise LogFormatError(path, f"has no places with times in it ({kind}){'; passed over: ' if why else ''}{why}")
    notes = [f"of the track {name} were passed over: {why}"] if passed else []
    if early.any():
        kind = f"{kind} with dates {ROLLOVER_WEEKS} weeks later"
        rolled = f"the week of its receiver has rolled over, and {ROLLOVER_WEEKS} weeks are added"
        notes.append(f"the track {name} has dates before 2010: {rolled}")
    heights_m, missing = fixes[:, 3], np.isnan(fixes[:, 3])
    if missing.all():
        notes.append(f"the track {name} has no heights above sea level: 0 m is taken")
        heights_m = np.zeros(len(fixes))
    elif missing.any():
        heights_m = np.interp(fixes[:, 0], fixes[~missing, 0], heights_m[~missing])
    columns = [fixes[:, 0], np.deg2rad(fixes[:, 1]), np.deg2rad(fixes[:, 2]), heights_m]
    track = PositionTrack.from_samples(*_held_between_flights(np.stack(columns)))
    return GivenTrack(track, f"{name}, {kind}, {len(fixes)} fixes", fixes[:, 0], tuple(notes))


def _held_between_flights(columns: Float) -> Float:
    """Return (4, n) time and position with the nearest fix held, not interpolated, through the time between flights."""
    before = np.flatnonzero(np.diff(columns[0]) > BETWEEN_FLIGHTS_S)
    middle_s = (columns[0, before] + columns[0, before + 1]) / 2
    held, other = columns[:, before].copy(), columns[:, before + 1].copy()
    held[0], other[0] = middle_s - 1e-3, middle_s
    return np.insert(columns, np.repeat(before + 1, 2), np.stack([held, other], axis=-1).reshape(4, -1), axis=1)


def _valid(fixes: Float, passed: Counter[str]) -> Float:
    """Return the (n, 4) fixes that a receiver with a fix on an aircraft can have; others are counted."""
    dated = np.isfinite(fixes[:, 0]) & (fixes[:, 0] >= _YEAR_1990_S)
    passed["without a date"] += int(np.count_nonzero(~dated))
    fixes = fixes[dated]
    heights_m = np.nan_to_num(fixes[:, 3])
    # Longitudes may run from 0 to 360.
    longitude_deg = np.where((fixes[:, 2] > 180) & (fixes[:, 2] <= 360), fixes[:, 2] - 360, fixes[:, 2])
    real = valid_positions(fixes[:, 1], longitude_deg, heights_m)
    passed["at 0 N 0 E, beyond a pole or at an impossible height"] += int(np.count_nonzero(~real))
    fixes = fixes[real]
    missing = is_missing_height(fixes[:, 0], fixes[:, 3])
    passed["heights of 0 m that are none, between others"] += int(np.count_nonzero(missing))
    fixes[missing, 3] = nan
    heights_m = np.nan_to_num(fixes[:, 3])
    known = np.isfinite(fixes[:, 3])
    heights_m = np.interp(fixes[:, 0], fixes[known, 0], fixes[known, 3]) if known.any() else heights_m
    columns = (fixes[:, 0], np.deg2rad(fixes[:, 1]), np.deg2rad(fixes[:, 2]), heights_m)
    reachable = flyable(*columns)
    if where := two_places(reachable, *columns):
        raise ValueError(where)
    passed["too far from the others for an aircraft"] += int(np.count_nonzero(~reachable))
    for reason in [reason for reason, count in passed.items() if not count]:
        del passed[reason]
    return fixes[reachable]


def _format(path: str, content: bytes) -> tuple[str, _Parse, str]:
    """Return the name of a format, the function that yields its fixes, and the text."""
    is_zip = content.startswith(b"PK\x03\x04")
    content = _kmz(path) if is_zip else content
    text = _text(content)
    if _XML.match(content[:64]):
        root = _ROOT.match(text)
        kinds: dict[str, tuple[str, _Parse]] = {"gpx": ("GPX", _gpx), "kml": ("KMZ" if is_zip else "KML", _kml)}
        if root is not None and root[1] in kinds:
            return (*kinds[root[1]], text)
    head = content.lstrip(b"\xef\xbb\xbf \r\n\t")
    if re.match(rb"A[A-Z0-9]{3}", head) and re.search(rb"(?i)[\r\n](H[FOP]DTE|B\d{6})", content):
        return "IGC", _igc, text
    if _NMEA.search(content):
        return "NMEA", _nmea, text
    raise LogFormatError(path, f"is no track that glstar knows: {TRACK_FORMATS}")


def _text(content: bytes) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    if content.startswith((b"<\x00", b"\x00<")):
        return content.decode("utf-16-le" if content.startswith(b"<") else "utf-16-be", errors="replace")
    declared = _ENCODING.match(content[:200])
    encoding = declared[1].decode() if declared else "utf-8-sig"
    try:
        encoding = "utf-8-sig" if lookup(encoding).name in _NO_ENCODINGS else encoding
        return content.decode(encoding, errors="replace").lstrip("\ufeff")
    except LookupError:
        return content.decode("utf-8-sig", errors="replace")


def _kmz(path: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        refuse_more("members", len(archive.namelist()))
        names = [name for name in archive.namelist() if name.lower().endswith(".kml")]
        if not names:
            raise LogFormatError(path, "is a zip archive without a track")
        with archive.open(names[0]) as member:
            return Unpacking(Path(path).stat().st_size, "content_mib").read(member)


def _elements(text: str, passed: Counter[str]) -> Iterator[tuple[str, ET.Element]]:
    """Yield the elements of an XML document when they end, with their names without the namespace.

    The mode of heights of an element around it is copied into a gx:Track.  A document that ends early is read
    up to there, and counted.
    """
    if "<!ENTITY" in text:
        raise ValueError("it declares entities, which no track needs")
    parser: ET.XMLPullParser[ET.Element] = ET.XMLPullParser(["start", "end"])
    ended = 0
    around: list[ET.Element] = []
    text, deepest = text.lstrip(), limit_of("depth")
    try:
        for at in range(0, len(text) + 1, _PIECE_CHARACTERS):
            parser.feed(text[at : at + _PIECE_CHARACTERS])
            for event, element in cast(Iterator[tuple[str, ET.Element]], parser.read_events()):
                name = str(element.tag).rpartition("}")[2]
                if event == "start":
                    around.append(element)
                    if len(around) > deepest:
                        refuse_more("depth", len(around))
                    continue
                ended += 1
                around.pop()
                if name == "Track" and around:
                    element.extend([child for child in around[-1] if str(child.tag).endswith("altitudeMode")])
                yield name, element
        parser.close()
    except ET.ParseError as error:
        if not ended:
            raise
        passed[f"all after its damage or end ({error})"] += 1


def _texts(elements: Iterable[ET.Element]) -> list[tuple[str, str]]:
    """Return the names without the namespace and the texts of elements."""
    return [(str(element.tag).rpartition("}")[2], (element.text or "").strip()) for element in elements]


def _utc_s(text: str) -> float:
    """Return the UTC of an ISO 8601 date and time of day, of which 24:00:00 is the end of the day."""
    if ":" not in text:
        raise ValueError(f"{text!r} has no time of day")
    late_s = _DAY_S if re.search(r"T24:00(:00)?", text) else 0.0
    try:
        return parse_utc(text.replace("T24:", "T00:").replace("z", "Z")) + late_s
    except ConfigError as error:
        raise ValueError(str(error)) from error


def _height_m(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return nan


def _gpx(text: str, passed: Counter[str]) -> Iterator[_Fix]:
    for name, element in _elements(text, passed):
        if name != "trkpt":
            continue
        texts = dict(_texts(element))
        if texts.get("fix") == "none":
            passed["without a fix"] += 1
        elif "time" not in texts:
            passed["without a time"] += 1
        else:
            try:
                place_deg = float(element.attrib["lat"]), float(element.attrib["lon"])
                yield _Fix(_utc_s(texts["time"]), *place_deg, _height_m(texts.get("ele", "")))
            except (ValueError, KeyError):
                passed["without a readable place or time"] += 1
        element.clear()


def _kml(text: str, passed: Counter[str]) -> Iterator[_Fix]:
    for name, element in _elements(text, passed):
        if name == "Track":
            parts = _texts(element)
            times = [text for tag, text in parts if tag == "when"]
            positions = [text for tag, text in parts if tag == "coord"]
            if len(times) != len(positions):
                raise ValueError(f"a gx:Track has {len(times)} times and {len(positions)} places")
            above = _is_above_ground(element)
            yield from _kml_fixes(zip(times, (place.split() for place in positions), strict=True), above, passed)
        if name == "Placemark":
            children = {str(child.tag).rpartition("}")[2]: child for child in element}
            if "TimeStamp" in children and "Point" in children:
                when = dict(_texts(children["TimeStamp"])).get("when", "")
                place = dict(_texts(children["Point"])).get("coordinates", "")
                above = _is_above_ground(children["Point"])
                yield from _kml_fixes([(when, place.split(","))], above, passed)
        if name in {"Track", "Placemark"}:
            element.clear()


def _is_above_ground(geometry: ET.Element) -> bool:
    """Return whether the heights of a geometry are above ground, or meaningless."""
    # Its own mode comes first, before that of a gx:MultiTrack.
    return next((mode for tag, mode in _texts(geometry) if tag == "altitudeMode"), "absolute") in _ABOVE_GROUND


def _kml_fixes(fixes: Iterable[tuple[str, list[str]]], above: bool, passed: Counter[str]) -> Iterator[_Fix]:
    """Yield the fixes of times and places: longitude, latitude (deg) and perhaps height (m)."""
    for when, place in fixes:
        try:
            utc_s, (longitude_deg, latitude_deg, *height) = _utc_s(when), [float(part) for part in place]
        except ValueError:
            passed["without a readable place or time"] += 1
            continue
        if above and height:
            passed["heights above ground, which are none above sea level"] += 1
        yield _Fix(utc_s, latitude_deg, longitude_deg, height[0] if height and not above else nan)


_IGC_DATE = re.compile(r"H[FOP]DTE\s*(?:DATE)?[\s:]*(\d\d)[\s./-]*(\d\d)[\s./-]*(\d\d)", re.IGNORECASE)
_IGC_FIX = re.compile(r"B(\d\d)(\d\d)(\d\d)(\d\d)(\d{5})([NS])(\d{3})(\d{5})([EW])([AV])([-\d]\d{4})([-\d]\d{4})")


def _igc(text: str, passed: Counter[str]) -> Iterator[_Fix]:
    """Yield the B records of an IGC file; their times are UTC of the day in HFDTE, and go on after midnight."""
    day_s = before_s = nan
    fraction_at = slice(0, 0)
    with_height: list[_Fix] = []
    without: list[_Fix] = []
    for line in text.splitlines():
        if date := _IGC_DATE.match(line):
            day, month, year = date.groups()
            day_s, before_s = _utc_s(f"{_century(year)}{year}-{month}-{day}T00:00"), nan
        if line.startswith("I") and (tds := re.search(r"(\d\d)(\d\d)TDS", line)):
            fraction_at = slice(int(tds[1]) - 1, int(tds[2]))
        if not re.match(r"B\d", line):
            continue
        fix = _IGC_FIX.match(line)
        if fix is None:
            passed["unreadable B records"] += 1
            continue
        hours, minutes, seconds, north, north_min, side, east, east_min, east_side = fix.groups()[:9]
        fraction = line[fraction_at]
        clock_s = 3600 * int(hours) + 60 * int(minutes) + int(seconds)
        utc_s = day_s + clock_s + (float(f"0.{fraction}") if fraction.isdigit() else 0.0)
        if utc_s < before_s - _DAY_S / 2:
            day_s, utc_s = day_s + _DAY_S, utc_s + _DAY_S
        before_s = utc_s
        latitude_deg = (int(north) + int(north_min) / 60000) * (1 if side == "N" else -1)
        longitude_deg = (int(east) + int(east_min) / 60000) * (1 if east_side == "E" else -1)
        # V is a fix without GNSS height, or none: its height is by pressure.
        kind, height_m = (with_height, fix[12]) if fix[10] == "A" else (without, fix[11])
        kind.append(_Fix(utc_s, latitude_deg, longitude_deg, float(height_m)))
    if with_height and without:
        passed["without a 3D fix (V)"] += len(without)
    yield from with_height or without


def _century(year: str) -> str:
    """Return the century of a year of two digits: receivers without a date say 80."""
    return "19" if int(year) >= 80 else "20"


def _nmea(text: str, passed: Counter[str]) -> Iterator[_Fix]:
    """Yield the fixes of NMEA sentences: RMC and ZDA have the date of those beside them, GGA the height."""
    sentences = [sentence for line in text.splitlines() for sentence in _nmea_sentences(line)]
    checked = sum(has_sum for _, has_sum, _ in sentences)
    # Where sentences have checksums, one without is damaged.
    read = [fields for fields, has_sum, valid in sentences if (valid if has_sum else 2 * checked < len(sentences))]
    passed["sentences with a wrong checksum or without one"] += len(sentences) - len(read)
    dated = _nmea_dated(read, passed)
    places: dict[float, tuple[float, float]] = {}
    heights_m: dict[float, float] = {}
    invalid: set[float] = set()
    for utc_s, fields in dated:
        is_gga, key = fields[0][2:] == "GGA", round(utc_s, 3)
        state, mode = (fields[6], "") if is_gga else (fields[2], fields[12] if len(fields) > 12 else "")
        # Estimated by dead reckoning: quality 6, mode E.
        if state in ({"", "0", "6"} if is_gga else {"", "V"}) or mode in {"N", "E"}:
            invalid.add(key)
            continue
        try:
            latitude_deg, longitude_deg = (_nmea_angle(*fields[k : k + 2]) for k in ((2, 4) if is_gga else (3, 5)))
        except ValueError:
            passed["sentences without a readable place"] += 1
            continue
        if not is_gga or key not in places:
            places[key] = latitude_deg, longitude_deg
        if is_gga and fields[9]:
            heights_m[key] = _height_m(fields[9]) + (_height_m(fields[11]) if fields[11] else 0.0)
    passed["times without a fix"] += len(invalid)
    for key, place_deg in places.items():
        if key not in invalid:
            yield _Fix(key, *place_deg, heights_m.get(key, nan))


def _nmea_dated(sentences: list[list[str]], passed: Counter[str]) -> list[tuple[float, list[str]]]:
    """Return UTC, s since 1970, and fields of the sentences RMC and GGA.

    A sentence without a date has the date of its neighbour whose time of day is nearer.
    """
    undated: list[tuple[float, list[str]]] = []
    dated: list[tuple[float, list[str]]] = []
    latest_s: float | None = None
    for fields in sentences:
        if len(fields) < {"RMC": 10, "GGA": 12, "ZDA": 5}.get(fields[0][2:], 1 << 30):
            continue
        try:
            clock_s, midnight_s = _time_of_day_s(fields[1]), _nmea_date(fields)
        except ValueError:
            passed["sentences without a time"] += 1
            continue
        if midnight_s is None:
            undated.append((clock_s, fields))
            continue
        utc_s = midnight_s + clock_s
        beside_s = [utc_s] if latest_s is None else [latest_s, utc_s]
        dated += [(_nearest_utc_s(beside_s, other_s), other) for other_s, other in undated]
        undated, latest_s = [], utc_s
        if fields[0][2:] == "RMC":
            dated.append((utc_s, fields))
    if latest_s is None:
        passed["sentences without a date"] += len(undated)
        return []
    return dated + [(_nearest_utc_s([latest_s], other_s), other) for other_s, other in undated]


def _nearest_utc_s(beside_s: list[float], clock_s: float) -> float:
    """Return the UTC of a time of day, s, that is nearest to one of the times of sentences with dates beside it, s."""
    since_s, beside = min(
        ((remainder(clock_s - utc_s, _DAY_S), utc_s) for utc_s in beside_s), key=lambda one: abs(one[0])
    )
    return beside + since_s


def _nmea_date(fields: list[str]) -> float | None:
    """Return the midnight, s since 1970, of the date of a sentence RMC or ZDA; None without one."""
    if fields[0][2:] == "ZDA":
        day, month, year = fields[2:5]
    elif fields[0][2:] == "RMC" and fields[9]:
        day, month, year = fields[9][:2], fields[9][2:4], _century(fields[9][4:6]) + fields[9][4:6]
    else:
        return None
    return _midnight_s(f"{year}-{month:0>2}-{day:0>2}") if year else None


@lru_cache(maxsize=8)
def _midnight_s(date: str) -> float:
    """Return the midnight of an ISO 8601 date, s since 1970; a track has the same one in all sentences of a day."""
    return _utc_s(f"{date}T00:00")


def _time_of_day_s(text: str) -> float:
    """Return the seconds of hhmmss.ss."""
    if not re.fullmatch(r"\d{6}(\.\d*)?", text):
        raise ValueError(f"{text!r} is no time")
    return 3600 * int(text[:2]) + 60 * int(text[2:4]) + float(text[4:])


def _nmea_sentences(line: str) -> Iterator[tuple[list[str], bool, bool]]:
    """Yield the fields of the sentences of a line, whether they have a checksum, and whether it is right.

    A tag block or the time of a logger may come before a sentence.
    """
    for part in line.split("$")[1:]:
        body, star, checksum = part.partition("*")
        is_right = checksum[:2].upper() == f"{reduce(xor, body.encode(errors='replace'), 0):02X}"
        yield body.strip().split(","), bool(star), bool(star) and is_right


def _nmea_angle(text: str, side: str) -> float:
    """Return degrees of ddmm.mmmm or dddmm.mmmm."""
    parts = re.fullmatch(r"(\d{1,3})(\d\d(?:\.\d*)?)", text)
    if parts is None or side not in set("NESW"):
        raise ValueError(f"{text!r:.40} {side!r:.40} is no angle")
    return (int(parts[1]) + float(parts[2]) / 60) * (1 if side in "NE" else -1)
