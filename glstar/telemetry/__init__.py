"""Telemetry: the flight logs that pilots bring, and what glstar makes of them.

::

    with open_source(path) as source:       a log file, told by its content, not by its name
        flight = read_flight(source)        attitude and place over UTC

    flight = open_flight(path)              the two in one
"""

import os
import re
from os import PathLike
from pathlib import Path

from glstar.errors import LogFormatError
from glstar.flight import Flight, Interpolation
from glstar.sky.site import Site
from glstar.telemetry.dataflash import (
    DATAFLASH_MAGIC,
    DataFlashDumpReader,
    DataFlashReader,
    is_dataflash_dump,
    is_dataflash_text,
)
from glstar.telemetry.flightdescription import KEYS, PREFIX, SyntheticSource, is_flight_description, synthetic_flight
from glstar.telemetry.mavlogdump import MavlogdumpReader, is_mavlogdump
from glstar.telemetry.recordedlog import BootSummary, read_flight
from glstar.telemetry.recording import Recording
from glstar.telemetry.scripted import ScriptedFlight
from glstar.telemetry.source import (
    AttitudeSamples,
    ClockSamples,
    LogFacts,
    PositionSamples,
    RateSamples,
    Samples,
    TelemetrySource,
)
from glstar.telemetry.survey import Survey, survey
from glstar.telemetry.table import TableReader, as_table
from glstar.telemetry.tlog import TelemetryLogReader, is_telemetry_log
from glstar.telemetry.ulog import ULOG_MAGIC, ULogReader
from glstar.telemetry.ulog2csv import Ulog2csvReader, is_ulog2csv

__all__ = [
    "KEYS",
    "PREFIX",
    "AttitudeSamples",
    "BootSummary",
    "ClockSamples",
    "DataFlashDumpReader",
    "DataFlashReader",
    "LogFacts",
    "MavlogdumpReader",
    "PositionSamples",
    "RateSamples",
    "Recording",
    "Samples",
    "ScriptedFlight",
    "Survey",
    "SyntheticSource",
    "TableReader",
    "TelemetryLogReader",
    "TelemetrySource",
    "ULogReader",
    "Ulog2csvReader",
    "as_table",
    "is_flight_description",
    "open_flight",
    "open_source",
    "read_flight",
    "survey",
    "synthetic_flight",
]

_READS = "glstar reads ArduPilot DataFlash (.BIN, .log), MAVLink telemetry logs (.tlog), PX4 ULog (.ulg) and CSV"

# What people hand over instead, by the first bytes.
_OTHER_FILES = {
    b"\x89PNG\r\n\x1a\n": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"II*\x00": "a TIFF image",
    b"MM\x00*": "a TIFF image",
    b"GIF8": "a GIF image",
    b"SIMPLE  =": "a FITS image",
    b"%PDF-": "a PDF",
    b"MATLAB 5.0": "a MATLAB file",
    b"#ROSBAG": "a ROS bag",
    b"\x89MCAP": "an MCAP recording",
    b"BZh": "compressed with bzip2; unpack it first",
    b"7z\xbc\xaf": "a 7-Zip archive; unpack it first",
    b"\x28\xb5\x2f\xfd": "compressed with Zstandard; unpack it first",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "gzipped; unpack it first",
    b"SQLite format 3\x00": "an SQLite database",
    b"\x89HDF\r\n": "an HDF5 file",
    b"\x93NUMPY": "a NumPy array",
    b"PAR1": "an Apache Parquet table; save it as CSV",
    b"H Product:Blackbox": "a Betaflight or INAV blackbox log; its attitude has no compass and no UTC",
    b"RIFF": "a WebP image, or sound or video",
    b"ULogEnc": "an encrypted ULog; decrypt it first",
    b"\xff\xfe": "text in UTF-16; save it as UTF-8",
    b"\xfe\xff": "text in UTF-16; save it as UTF-8",
    b"<": "a web page or XML; was it saved from a browser?",
    b"{": "JSON",
}

# What is inside of archives and XML, by a mark in the first bytes.
_INSIDE = {
    b"PK\x03\x04": {
        b"[Content_Types].xml": "an Excel workbook or another Office file; save the sheet as CSV",
        b"doc.kml": "a track of Google Earth (KMZ); it has places but no attitude",
    },
    b"<": {
        b"<gpx": "a GPX track; it has places but no attitude",
        b"<kml": "a KML track; it has places but no attitude",
        b"<TrainingCenterDatabase": "a TCX track; it has places but no attitude",
    },
}

# 2024-03-10 20:30:34.26: ATT {TimeUS : 34265000, ...
_PRINTED = re.compile(rb"\d{4}-\d\d-\d\d [\d:.]+: \w+ \{")


def open_flight(
    path: str | PathLike[str],
    *,
    attitude: str = "auto",
    time_offset_s: float = 0.0,
    utc_start: float | None = None,
    site: Site | None = None,
    sysid: int | None = None,
    boot: int | None = None,
    max_gap_s: float | None = None,
    interpolation: Interpolation = "slerp",
) -> Flight:
    """Return the flight that a log file tells of.

    Parameters
    ----------
    path : path-like
        A DataFlash log, a telemetry log, a ULog or a CSV table; which of them, its content says.
    attitude : str
        Which of the log's attitudes: ``"auto"``, or a message by name (see `DataFlashReader`,
        `TelemetryLogReader`, `ULogReader`).
    sysid : int, optional
        Whose flight it is, in a log of several vehicles: a MAVLink system.
    boot : int, optional
        Which boot of the autopilot, from 1, in a log of several; by default all boots of one day, each by its own UTC.
    time_offset_s : float
        Camera clock minus log clock, s: positive where the camera's clock is ahead of the log's.  The flight keeps the
        log's UTC; see `Flight`.
    utc_start : float, optional
        UTC of the first attitude sample, seconds since 1970, for a log without UTC; it overrides the log's own.
    site : Site, optional
        The place, for a log without positions; it overrides the log's own.
    max_gap_s : float, optional
        The longest silence to interpolate across, s; see `AttitudeTrack.from_samples`.
    interpolation : {"slerp", "spline", "gyro"}
        How the attitude goes between its samples; see `AttitudeTrack`.

    Returns
    -------
    Flight

    Raises
    ------
    LogFormatError
        If the file cannot be read, is something else, or lacks attitude, UTC or place, or rates for ``"gyro"``.
    """
    with open_source(path, attitude=attitude, sysid=sysid, boot=boot) as source:
        return read_flight(
            source,
            time_offset_s=time_offset_s,
            utc_start=utc_start,
            site=site,
            max_gap_s=max_gap_s,
            interpolation=interpolation,
        )


def open_source(
    path: str | PathLike[str], *, attitude: str = "auto", sysid: int | None = None, boot: int | None = None
) -> TelemetrySource:
    """Open a log file with the reader for what it holds.

    Parameters
    ----------
    path : path-like
        The log.
    attitude : str
        Which of the log's attitudes: ``"auto"``, or a message by name (see `DataFlashReader`,
        `TelemetryLogReader`, `ULogReader`).
    sysid : int, optional
        Whose flight it is, in a log of several vehicles: a MAVLink system.
    boot : int, optional
        Which boot of the autopilot, from 1, in a log of several; by default all boots of one day, each by its own UTC.

    Returns
    -------
    TelemetrySource
        To be closed, or used in a ``with`` statement.

    Raises
    ------
    LogFormatError
        If the file cannot be read, or is something else.
    """
    name = os.fspath(path)
    if is_flight_description(name):
        return _described(name, attitude=attitude, sysid=sysid, boot=boot)
    try:
        head = _head(name)
        if is_telemetry_log(head):
            return TelemetryLogReader(name, attitude=attitude, sysid=sysid, boot=boot)
        if sysid is not None:
            raise LogFormatError(name, f"is no telemetry log of several vehicles; leave out sysid, which is {sysid}")
        if head.startswith(DATAFLASH_MAGIC) or is_dataflash_text(head):
            return DataFlashReader(name, attitude=attitude, boot=boot)
        if head.startswith(ULOG_MAGIC):
            return ULogReader(name, attitude=attitude, boot=boot)
        if (other := _something_else(head, name)) is not None:
            raise LogFormatError(name, other, offset=0)
        return _table(name, _header(head), attitude, boot)
    except OSError as error:
        raise LogFormatError(name, f"cannot be read: {error.strerror or error}") from error


def _described(name: str, *, attitude: str, sysid: int | None, boot: int | None) -> TelemetrySource:
    """Open a flight that is described in one line; it has one attitude, one vehicle and one boot."""
    given = {"attitude": attitude.lower() != "auto", "sysid": sysid is not None, "boot": boot not in {None, 1}}
    if superfluous := [option for option, is_given in given.items() if is_given]:
        raise LogFormatError(name, f"a synthetic flight has one attitude; leave out {superfluous[0]}")
    return SyntheticSource(name)


def _head(name: str) -> bytes:
    """Return the first bytes of a file that is one."""
    path = Path(name)
    if path.is_dir():
        raise LogFormatError(name, "is a directory; name the log inside it")
    if path.exists() and not path.is_file():
        raise LogFormatError(name, "is no file that can be read twice; save the log to disk first")
    with path.open("rb") as file:
        head = file.read(4096)
    if not head:
        raise LogFormatError(name, "is empty: 0 bytes", offset=0)
    return head


def _table(name: str, header: str, attitude: str, boot: int | None) -> TelemetrySource:
    """Open a file that is text: a table of glstar's own, or one of those that other programs write."""
    if is_mavlogdump(header):
        return MavlogdumpReader(name, attitude=attitude, boot=boot)
    if is_dataflash_dump(header):
        return DataFlashDumpReader(name, attitude=attitude, boot=boot)
    if is_ulog2csv(header):
        return Ulog2csvReader(name, attitude=attitude, boot=boot)
    if attitude.lower() != "auto":
        raise LogFormatError(name, f"a table has one attitude, not {attitude!r}; leave attitude at 'auto'")
    return TableReader(name, boot=boot)


def _header(head: bytes) -> str:
    """Return the first line of a file that is text, without the ``#`` with which some programs begin it."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().decode(errors="replace")
    return text.splitlines()[0].lstrip("# ") if text else ""


def _something_else(head: bytes, name: str) -> str | None:
    """Return what a file is that glstar does not read, as words; None where it may be a table."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for magic, what in _OTHER_FILES.items():
        if text.startswith(magic):
            inside = next((better for mark, better in _INSIDE.get(magic, {}).items() if mark in head), what)
            return f"this is {inside} ({_READS})"
    if _PRINTED.match(text):
        return "this is what mavlogdump.py prints; give the log itself, or its CSV (mavlogdump.py --format csv)"
    if b"\0" in head and "DJI" in Path(name).name:
        return f"this is no log that glstar knows; DJI encrypts its flight records ({_READS})"
    if b"\0" in head:
        return f"this is no log that glstar knows ({_READS})"
    return None
