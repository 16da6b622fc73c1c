"""Telemetry: flight logs, and their conversion to flights.

::

    flight = open_flight(path)              attitude and position over UTC

    with open_source(path) as source:       the same in two steps: open a log with the reader for its format,
        flight = read_flight(source)        read it and convert it

====================  ==================================================================================================
module                holds
====================  ==================================================================================================
``source``            `TelemetrySource`, the interface of readers; their samples, and removal of damaged ones
``boots``             detection of reboots within a log
``tables``            ``files`` (text, Parquet, Excel), ``native``, ``mapped`` (by a `ColumnMap`), ``tableclock``
``mavlink``           MAVLink logs: ``packets``, ``clock``, ``vehicles`` (names, gimbal), ``tlog``, ``mavlogdump``
``dataflash``         ArduPilot DataFlash logs, binary, text and CSV
``ulog``              PX4 ULog and the CSV of ulog2csv; ``ulogfile``: their topics
``bags``              ROS 1 and ROS 2 bags, MCAP: ``storage``, and ``topics``: what each measures
``tracks``            positions without attitude: GPX, KML, KMZ, NMEA, IGC
``formats``           `LOG_FORMATS`, the table of log formats: a new format is a reader and one entry; gzip and zip
``recording``         `Recording`, the samples of one boot, and `FlightOptions`
``recordedlog``       `RecordedLog`, all boots of a log, and their conversion to one flight
``survey``            the report of ``glstar info``
``synthetic``         flights without a log: ``fly:...`` in one line, and `ScriptedFlight`
====================  ==================================================================================================
"""

import os
import re
from collections.abc import Callable
from functools import partial
from os import PathLike
from pathlib import Path

from glstar.errors import LogFormatError, reading
from glstar.flight import Flight, Interpolation
from glstar.sky.place.site import Site
from glstar.system.resources import DEMO, flight_path
from glstar.system.userinput import no_such_file, refuse_more
from glstar.telemetry import formats, synthetic
from glstar.telemetry.bags import is_bag_directory
from glstar.telemetry.dataflash import DataFlashReader
from glstar.telemetry.formats import LOG_FORMATS, LOG_SUFFIXES, LogFormat
from glstar.telemetry.mavlink.tlog import TelemetryLogReader
from glstar.telemetry.recordedlog import read_flight
from glstar.telemetry.recording import FlightOptions, Recording
from glstar.telemetry.source import (
    AttitudeSamples,
    ClockSamples,
    EventSamples,
    GimbalSamples,
    LogFacts,
    PositionSamples,
    RateSamples,
    Samples,
    TelemetrySource,
    TriggerSamples,
    UnpackedSource,
    archive_and_member,
)
from glstar.telemetry.survey import Survey, TriggerSurvey, survey
from glstar.telemetry.synthetic import KEYS, PREFIX, ScriptedFlight, is_flight_description, synthetic_flight
from glstar.telemetry.tables.mapped import MappedTableReader, column_map, is_map_file, ready_maps
from glstar.telemetry.tables.native import as_table
from glstar.telemetry.tracks import read_track
from glstar.telemetry.ulog import ULogReader

__all__ = [
    "KEYS",
    "LOG_FORMATS",
    "LOG_SUFFIXES",
    "PREFIX",
    "AttitudeSamples",
    "ClockSamples",
    "DataFlashReader",
    "EventSamples",
    "FlightOptions",
    "GimbalSamples",
    "LogFacts",
    "LogFormat",
    "PositionSamples",
    "RateSamples",
    "Recording",
    "Samples",
    "ScriptedFlight",
    "Survey",
    "TelemetryLogReader",
    "TelemetrySource",
    "TriggerSamples",
    "TriggerSurvey",
    "ULogReader",
    "as_table",
    "column_map",
    "is_bag_directory",
    "is_flight_description",
    "is_map_file",
    "open_flight",
    "open_source",
    "read_flight",
    "read_track",
    "ready_maps",
    "survey",
    "synthetic_flight",
]


# First bytes of a file by which its format is recognised: some dozens of packets or lines.
_HEAD_BYTES = 4096
# The beginning of a link, which is easily given in place of a log.
_LINK = re.compile(r"(tcp|tcpin|udp|udpin|udpout|serial):|(/dev/tty|COM\d)[^/]*,\d+$", re.IGNORECASE)


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
    columns: str | None = None,
    position: str | None = None,
    vehicle: str | None = None,
) -> Flight:
    """Open a flight log and return its flight.

    Parameters
    ----------
    path : path-like
        A flight log, also gzipped or in a zip archive, or a table; its content determines the format.  Of an archive
        with several logs, ``FILE.zip::member`` is one.
    attitude : str
        Which attitude of the log: a message or topic by name, or ``"auto"`` for the best one; see `DataFlashReader`,
        `TelemetryLogReader`, `ULogReader` and `BagReader`.
    sysid : int, optional
        MAVLink system of the vehicle, in a telemetry log of several.
    boot : int, optional
        Number of the boot, from 1, in a log of several; by default all boots of one day, each by its own UTC.
    time_offset_s : float
        Camera clock minus log clock, s: positive if the camera's clock is ahead.  The flight keeps the UTC of the log;
        see `Flight`.
    utc_start : float, optional
        UTC of the first attitude sample, seconds since 1970; it replaces the UTC of the log.
    site : Site, optional
        Position of the flight; it replaces the positions of the log.
    max_gap_s : float, optional
        Longest data gap to interpolate across, s; see `AttitudeTrack.from_samples`.
    interpolation : {"slerp", "spline", "gyro"}
        How attitude is interpolated between samples; see `AttitudeTrack`.
    columns : str, optional
        What the columns of a table mean; see `column_map`.
    position : str, optional
        A GPX, KML, KMZ, NMEA or IGC file with the positions of the flight; they replace the log's.
    vehicle : str, optional
        The vehicle, in a log of several: its name space in a ROS bag, or its MAVLink system, as `sysid`.

    Returns
    -------
    Flight

    Raises
    ------
    LogFormatError
        If the file cannot be read, is no flight log, lacks attitude, UTC or position, or lacks rates for ``"gyro"``.
    """
    track = None if position is None else read_track(position)
    options = FlightOptions(time_offset_s, utc_start, site, max_gap_s, interpolation, track)
    with open_source(path, attitude=attitude, sysid=sysid, boot=boot, columns=columns, vehicle=vehicle) as source:
        return read_flight(source, options)


def open_source(
    path: str | PathLike[str],
    *,
    attitude: str = "auto",
    sysid: int | None = None,
    boot: int | None = None,
    columns: str | None = None,
    vehicle: str | None = None,
) -> TelemetrySource:
    """Open a flight log with the reader for its format.

    Parameters
    ----------
    path, attitude, sysid, boot, columns, vehicle
        See `open_flight`.

    Returns
    -------
    TelemetrySource
        To be closed, or used in a ``with`` statement.

    Raises
    ------
    LogFormatError
        If the file cannot be read, or is no flight log.
    ConfigError
        If `columns` is no column map.
    """
    name = os.fspath(path)
    if name == DEMO:
        name = os.fspath(flight_path(name))
    if is_flight_description(name):
        return _described(name, attitude=attitude, sysid=sysid, boot=boot, vehicle=vehicle)
    if _LINK.match(name) and not Path(name).exists():
        raise LogFormatError(name, f"is a link, not a file; glstar live {name} shows what it sends")

    def opened_as(path: str, kind: LogFormat) -> TelemetrySource:
        return _reader(path, kind, sysid, vehicle, columns)(path, attitude=attitude, boot=boot)

    with reading(name, LogFormatError):
        return _opened(name, opened_as, 0)


def _opened(name: str, opened_as: Callable[[str, LogFormat], TelemetrySource], archives: int) -> TelemetrySource:
    """Open a file in its format; `archives`: the number of those that it is in."""
    refuse_more("archives", archives)
    if is_bag_directory(name):
        return opened_as(name, next(entry for entry in LOG_FORMATS if entry.has_name_spaces))
    archive, member = archive_and_member(name)
    head = _head(archive)
    if member and not (formats.is_packed(head) and head.startswith(b"PK")):
        raise LogFormatError(name, "only a zip archive has members")
    if formats.is_packed(head):
        return UnpackedSource(name, formats.unpack, lambda inside: _opened(inside, opened_as, archives + 1))
    recognised = formats.log_format(head)
    if recognised is None:
        raise LogFormatError(name, f"this is {formats.other_file(head, name)} ({formats.READABLE})", offset=0)
    return opened_as(name, recognised)


def _reader(
    name: str, kind: LogFormat, sysid: int | None, vehicle: str | None, columns: str | None
) -> Callable[..., TelemetrySource]:
    """Return the reader of a file with the options that only some formats have."""
    if kind.has_systems and vehicle is not None:
        if not vehicle.isdecimal() or sysid not in {None, int(vehicle)}:
            raise LogFormatError(name, f"vehicle must be the MAVLink system of one, such as 1, not {vehicle!r}")
        sysid = int(vehicle)
    if sysid is not None and not kind.has_systems:
        raise LogFormatError(name, f"is no telemetry log of several vehicles; leave out sysid, which is {sysid}")
    if vehicle is not None and not (kind.has_systems or kind.has_name_spaces):
        raise LogFormatError(name, f"is no log of several vehicles; leave out vehicle, which is {vehicle!r}")
    if kind.has_name_spaces:
        return partial(kind.reader, columns=columns, vehicle=vehicle)
    if columns is None:
        return partial(kind.reader, sysid=sysid) if kind.has_systems else kind.reader
    if not kind.is_table:
        raise LogFormatError(name, f"is no table but of the format {kind.name}; leave out columns (--columns)")
    return partial(MappedTableReader, columns=column_map(columns))


def _described(
    name: str, *, attitude: str, sysid: int | None, boot: int | None, vehicle: str | None
) -> TelemetrySource:
    """Open a flight that is described in one line; it has one attitude, one vehicle and one boot."""
    requested = {"attitude": attitude.lower() != "auto", "sysid": sysid is not None, "boot": boot not in {None, 1}}
    requested["vehicle"] = vehicle is not None
    if superfluous := [option for option, is_requested in requested.items() if is_requested]:
        raise LogFormatError(name, f"a synthetic flight has one attitude; leave out {superfluous[0]}")
    return synthetic.SyntheticSource(name)


def _head(name: str) -> bytes:
    """Return the first bytes of a regular file."""
    path = Path(name)
    if path.is_dir():
        raise LogFormatError(name, "is a directory; name the log inside it")
    if path.exists() and not path.is_file():
        raise LogFormatError(name, "is no file that can be read twice; save the log to disk first")
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise LogFormatError(name, f"{no_such_file(name)}; demo is the bundled flight") from None
    if not head:
        raise LogFormatError(name, "is empty: 0 bytes", offset=0)
    return head
