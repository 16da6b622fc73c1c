"""Times of real images, from a table, an export's truth, EXIF or the file name.

The sources, in order of preference:

1. a table beside the images, ``images.csv`` or ``times.csv``, that maps files to times;
2. ``truth.jsonl`` of a directory that glstar exported;
3. EXIF whose zone is known: by ``OffsetTimeOriginal``, or by the GPS time beside it;
4. the file name.  EXIF without a zone is taken as UTC, unless the name has another second.

Each time carries a label of its source, its unit (EXIF without sub-seconds has whole seconds), and whether the source
states a zone.
"""

import csv
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from math import degrees, isfinite, remainder
from pathlib import Path
from typing import Any

from glstar.camera.exposure import Exposure
from glstar.camera.photofile import read_exif, zone_of
from glstar.errors import ConfigError, ImagesError, reading
from glstar.render.truth.frame import SCHEMAS_READ
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import lines_of, read_json, read_text, refuse_repeated

TABLES = ("images.csv", "times.csv")
TRUTH = "truth.jsonl"
# In the names of the files that an export writes beside its images: noiseless images and masks.
BESIDE = re.compile(r"\.(light|trails|saturated|cloud|flare|ground)\.")

# A line of some 60 bytes for each of a million images.
_LARGEST_BYTES = 64 * 2**20
# Numbers outside of these years are not UTC, but times since boot or image counters.
_YEAR_1990_S = 631152000.0
_YEAR_2100_S = 4102444800.0

# A date and a time of day, with or without their separators; three digits after an underscore are milliseconds, as
# phones and recorders write them, any other number there is a counter.
_DATE_IN_NAME = re.compile(
    r"(?<!\d)(?P<date>(?:19|20)\d\d([-_.]?)[01]\d\2[0-3]\d)"
    r"[T_ -]?(?P<time>[0-2]\d([-_.:]?)[0-5]\d\4[0-6]\d)"
    r"(?:[.,](?P<decimals>\d{1,9})|[_-]?(?P<milliseconds>\d{3}))?(?!\d)"
    r"(?P<zone>Z|[+-]\d\d:\d\d|\+\d{4}(?!\d))?"
)
# Seconds, milliseconds, microseconds or nanoseconds since 1970; ROS bags and the EuRoC sets name images by the last.
_COUNT_IN_NAME = re.compile(r"(?<![\d.])(\d{19}|\d{16}|\d{13}|\d{9,10}(?:\.\d{1,9})?)(?!\d)")
_COUNTS_PER_S = {19: 1e9, 16: 1e6, 13: 1e3}

# Decimals of a time of day, or of a number.
_DECIMALS = re.compile(r"\d[.,](\d+)")

# Images whose times have a unit from this one on are searched for within it, s.
LEAST_SEARCHED_S = 0.02
# Whole quarters of an hour from -12 to 14 h.
_ZONES_S = [900.0 * quarters for quarters in range(-48, 57)]


class TimeReference(StrEnum):
    """The instant of the exposure that the time of a real image refers to."""

    START = "start"
    MIDDLE = "middle"
    END = "end"


_FRACTION_BEFORE = {TimeReference.START: 0.0, TimeReference.MIDDLE: 0.5, TimeReference.END: 1.0}


@dataclass(frozen=True, slots=True)
class ImageTime:
    """The time of an image, with its source."""

    utc_s: float  # UTC seconds since 1970, by the camera's clock
    source: str  # A label of the source: ``"images.csv"``, ``"EXIF, zone +09:30"``, ``"name"``
    exposure_s: float | None = None  # Exposure time, s; None if the source does not state it
    # Whether the time is known to be the start of the exposure; otherwise the user chooses a `TimeReference`.
    is_start: bool = False
    # The unit of the time, s: it is cut off or rounded to whole seconds if this is 1; 0 if it is exact.
    grain_s: float = 0.0
    # Whether the source states no zone, so that a camera set to local time is wrong by its zone.
    is_zoneless: bool = False

    def fraction_before(self, reference: TimeReference) -> float:
        """Return the fraction of the exposure that lies before this time, 0 to 1.

        `reference`: the instant that the time refers to, if the source does not state it.  With a rolling shutter it is
        a fraction of the time from the first opening to the last closing.
        """
        return 0.0 if self.is_start else _FRACTION_BEFORE[reference]


def exposure_of(
    time: ImageTime,
    wanted: Exposure,
    *,
    reference: TimeReference = TimeReference.START,
    ahead_s: float = 0.0,
    own_length: bool = True,
) -> Exposure:
    """Return the exposure to simulate for a real image.

    `wanted`: the configured exposure: its rate, and its duration if the image's own is unknown or not used; a stacked
    image has the configured durations, because its own duration may hold for each short exposure, or for all;
    `reference`: the instant that the image's time refers to, if the source does not state it; `ahead_s`: by how much
    the camera's clock is ahead of the log's, s; `own_length`: whether to use the image's own exposure time.  The
    exposure may lie outside of the flight.
    """
    own_s = time.exposure_s if wanted.frames == 1 else None
    duration_s = own_s if own_length and own_s is not None else wanted.duration_s
    # The time refers to the real exposure; if its duration is unknown, the configured one is used.
    real = replace(wanted, duration_s=duration_s if own_s is None else own_s)
    start_utc_s = time.utc_s - ahead_s - time.fraction_before(reference) * real.span_s
    return replace(wanted, start_utc_s=start_utc_s, duration_s=duration_s)


def time_of(path: Path) -> ImageTime | None:
    """Return the time of an image from its EXIF or its name; None if neither has one."""
    exif = read_exif(path)
    named = _time_in_name(path.name)
    named_s = None if named is None else named.utc_s
    if exif.utc_s is not None and exif.zone is not None:
        return ImageTime(exif.utc_s, f"EXIF, {exif.zone}", exif.exposure_s, grain_s=exif.grain_s)
    # EXIF and name with the same second come from one clock: the one with a fraction of a second is more precise.
    same_clock = exif.utc_s is not None and named_s is not None and abs(exif.utc_s - named_s) < 1
    if exif.utc_s is not None and (named_s is None or (same_clock and exif.utc_s % 1 > 0)):
        label = "EXIF without a zone, taken as UTC"
        return ImageTime(exif.utc_s, label, exif.exposure_s, grain_s=exif.grain_s, is_zoneless=True)
    if named is not None:
        return replace(named, exposure_s=exif.exposure_s)
    return None


def with_common_grains(times: Sequence[ImageTime]) -> list[ImageTime]:
    """Return times with the finest unit that any time of the same source has.

    Programs leave out decimals that are 0, so a single time seems coarser than it is.
    """
    finest = dict[str, float]()
    for time in times:
        finest[time.source] = min(time.grain_s, finest.get(time.source, time.grain_s))
    return [replace(time, grain_s=finest[time.source]) for time in times]


def zone_hint(zone_s: float) -> str:
    """Return what a user does about times without a zone; `zone_s`: the zone that the camera may show, s."""
    hours, minutes = divmod(round(abs(zone_s) / 60), 60)
    zone = f"{'-' if zone_s < 0 else '+'}{hours:02}:{minutes:02}"
    return f"if the camera shows local time, such as that of {zone}, add --time-offset {zone_s:g}"


def local_zone_s(longitude_rad: float) -> float:
    """Return the zone of a longitude of any turn, whole hours, s."""
    return 3600.0 * round(remainder(degrees(longitude_rad), 360.0) / 15)


def time_notes(times: Sequence[ImageTime], zone_s: float) -> tuple[str, ...]:
    """Return remarks on times in whole seconds, and on those without a zone; `zone_s`: that of the flight, s."""
    notes = []
    coarse_s = [time.grain_s for time in times if time.grain_s >= LEAST_SEARCHED_S]
    if coarse_s:
        notes.append(
            f"the times of {len(coarse_s)} of {len(times)} images are in steps of {max(coarse_s):g} s, so each was"
            " compared at the time within its step that fits its trails best"
        )
    zoneless = sum(time.is_zoneless for time in times)
    if zoneless:
        notes.append(
            f"the times of {zoneless} of {len(times)} images have no zone and were taken as UTC; {zone_hint(zone_s)}"
        )
    return tuple(notes)


def zone_note(time: ImageTime, start_utc_s: float, within_s: tuple[float, float], zone_s: float) -> str:
    """Return a remark on the zone that brings an exposure into a flight; empty if the time has a zone, or none does.

    `start_utc_s`: the start of the exposure, UTC seconds since 1970; `within_s`: the first and the last possible start
    in the flight; `zone_s`: the likely zone, s.
    """
    first_s, last_s = within_s
    fitting_s = [each_s for each_s in _ZONES_S if first_s <= start_utc_s - each_s <= last_s]
    if not time.is_zoneless or not fitting_s:
        return ""
    hint = zone_hint(min(fitting_s, key=lambda each_s: abs(each_s - zone_s)))
    return f"; its time has no zone and was taken as UTC: {hint}, with which it lies in the flight"


def utc_from_name(name: str) -> float | None:
    """Return the time in a file name, UTC seconds since 1970; None if it has none.

    A name without a zone is UTC.  Names are such as ``2019-07-29T204726_Alt40.tiff``, ``IMG_20190729_204726_123.jpg``,
    ``2019-07-29T20:47:26.5Z.png``, ``1564433246.5.png``, ``1564433246500.png``.
    """
    named = _time_in_name(name)
    return None if named is None else named.utc_s


def _time_in_name(name: str) -> ImageTime | None:
    for found in _DATE_IN_NAME.finditer(name):
        with suppress(ValueError):
            decimals = found["decimals"] or found["milliseconds"] or ""
            grain_s = 10.0 ** -len(decimals)
            return ImageTime(_utc_of_date(found), "name", grain_s=grain_s, is_zoneless=found["zone"] is None)
    for found in _COUNT_IN_NAME.finditer(name):
        digits = found[1]
        counts_per_s = 1.0 if "." in digits else _COUNTS_PER_S.get(len(digits), 1.0)
        utc_s = float(digits) / counts_per_s
        if _YEAR_1990_S <= utc_s < _YEAR_2100_S:
            return ImageTime(utc_s, "name", grain_s=_decimal_grain_s(digits) / counts_per_s)
    return None


def _utc_of_date(found: re.Match[str]) -> float:
    digits = re.sub(r"\D", "", found["date"] + found["time"])
    whole_s = datetime.strptime(digits, "%Y%m%d%H%M%S").replace(tzinfo=zone_of(found["zone"] or "Z"))
    fraction = found["decimals"] or found["milliseconds"]
    return whole_s.timestamp() + (float(f"0.{fraction}") if fraction else 0.0)


def read_table(path: Path) -> tuple[dict[str, ImageTime], list[str]]:
    """Return the times of files in a table.

    `path`: CSV with the columns ``file`` and ``utc`` (ISO 8601; without an offset UTC) or ``utc_s`` (seconds since
    1970), and optionally ``exposure_s``; separated by commas, semicolons or tabs; ``#`` begins a comment line.  Returns
    `times`: file name to `ImageTime`; `problems`: a line for each invalid row.  Raises ImagesError if it cannot be
    read, or lacks these columns.
    """
    with reading(path, ImagesError, "cannot be read as a table"):
        return _read_table(path)


def _read_table(path: Path) -> tuple[dict[str, ImageTime], list[str]]:
    lines = [line for line in read_text(path, _LARGEST_BYTES).splitlines() if line.strip()[:1] not in ("", "#")]
    delimiter = max(",;\t", key=(lines or [""])[0].count)
    rows = csv.DictReader(lines, delimiter=delimiter)
    rows.fieldnames = [name.strip().lower() for name in rows.fieldnames or ()]
    refuse_repeated(rows.fieldnames, {"file", "utc", "utc_s", "exposure_s"})
    column = next((name for name in ("utc", "utc_s") if name in rows.fieldnames), None)
    if "file" not in rows.fieldnames or column is None:
        found = ", ".join(rows.fieldnames)[:100] or "nothing"
        raise ImagesError(path, f"its first line must name the columns file and utc (or utc_s); it has {found}")
    return _table_times(path.name, rows, column)


def _table_times(table: str, rows: Any, column: str) -> tuple[dict[str, ImageTime], list[str]]:
    times: dict[str, ImageTime] = {}
    problems: list[str] = []
    read: Callable[[str], float] = parse_utc if column == "utc" else float
    for row in rows:
        file = (row["file"] or "").strip()
        text = (row[column] or "").strip()
        try:
            utc_s = read(text)
        except (ConfigError, ValueError):
            utc_s = -1.0
        if not (_YEAR_1990_S <= utc_s < _YEAR_2100_S):
            problems.append(
                f"{table}: {file or 'a row without a file'}: {text[:40]!r} is not a {column} of 1990 to 2100"
            )
            continue
        exposure_s, grain_s = _table_exposure_s(row.get("exposure_s")), _decimal_grain_s(text)
        times[file] = ImageTime(utc_s, table, exposure_s, grain_s=grain_s)
    return times, problems


def _decimal_grain_s(text: str) -> float:
    """Return the unit of the last digit of a number or a time of day, s: 1 without decimals."""
    found = _DECIMALS.search(text)
    return 10.0 ** -len(found[1]) if found else 1.0


def _table_exposure_s(text: str | None) -> float | None:
    with suppress(ValueError):
        exposure_s = float(text or "")
        return exposure_s if isfinite(exposure_s) and exposure_s > 0 else None
    return None


def truth_files(folder: Path) -> list[Path]:
    """Return the files with the truth of an export: one; none without it; its parts, with a warning, if unfinished."""
    if (folder / TRUTH).is_file():
        return [folder / TRUTH]
    parts = sorted(folder.glob(f"{TRUTH}*.partial"))
    if parts:
        warnings.warn(f"{folder}: the export was not finished; the frames that it has are read", stacklevel=1)
    return parts


def read_truth(path: Path) -> dict[str, ImageTime]:
    """Return the times of the frames of a glstar export, by file name, from its ``truth.jsonl``.

    A time is the start of the exposure by the camera's clock, and its length.  Damaged lines are skipped.  Raises
    OSError if the file cannot be read.
    """
    times: dict[str, ImageTime] = {}
    for line in json_lines(path):
        with suppress(KeyError, TypeError, ValueError, ConfigError):
            if line["schema"] in SCHEMAS_READ:
                # Exports of glstar 0.1.0 have no camera clock.
                start_s = parse_utc(line.get("camera_utc_start", line["utc_start"]))
                duration_s = float(line["duration_s"])
                times[line["file"]] = ImageTime(start_s, path.name, duration_s, is_start=True)
    return times


def json_lines(path: Path) -> Iterator[Any]:
    """Yield the values of the lines of a file of JSON; damaged lines are skipped.

    Raises OSError if it cannot be read, and ValueError if a line is too long.
    """
    with path.open("rb") as lines:
        for line in lines_of(lines):
            with suppress(ValueError):
                yield read_json(line)
