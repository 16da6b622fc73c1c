"""The table of log formats that glstar reads.

A new format is a reader, a `TelemetrySource` in a module of its own, and one entry of `LOG_FORMATS`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from glstar.telemetry.columnmap import ready_map
from glstar.telemetry.dataflash import (
    DataFlashDumpReader,
    DataFlashReader,
    is_dataflash,
    is_dataflash_dump,
)
from glstar.telemetry.mappedtable import MappedTableReader
from glstar.telemetry.mavlinkstream import is_mavlink_stream, stream_reader
from glstar.telemetry.mavlogdump import MavlogdumpReader, is_mavlogdump
from glstar.telemetry.otherfiles import other_file
from glstar.telemetry.rosbag import BagReader, is_bag
from glstar.telemetry.rows import csv_header
from glstar.telemetry.source import TelemetrySource
from glstar.telemetry.table import TableReader
from glstar.telemetry.tablefile import is_office_file, is_parquet, table_header
from glstar.telemetry.tlog import TelemetryLogReader, is_telemetry_log
from glstar.telemetry.ulog import ULOG_MAGIC, ULogReader
from glstar.telemetry.ulog2csv import Ulog2csvReader, is_ulog2csv

__all__ = ["LOG_FORMATS", "LOG_SUFFIXES", "READABLE", "LogFormat", "log_format"]


@dataclass(frozen=True, slots=True)
class LogFormat:
    """One log format.

    Attributes
    ----------
    name : str
        For messages: ``"PX4 ULog"``.
    suffixes : tuple of str
        Usual suffixes of its files; only for messages and for searching folders.
    recognises : callable
        Whether a file is of this format, from its first 4096 bytes.
    reader : callable
        Opens a file: ``reader(path, attitude=..., boot=...)``.
    has_systems : bool
        Whether a file may hold several vehicles; the reader then also takes ``sysid``.
    takes_columns : bool
        Whether the reader also takes ``columns``: topics and frames, as text.
    """

    name: str
    suffixes: tuple[str, ...]
    recognises: Callable[[bytes], bool]
    reader: Callable[..., TelemetrySource]
    has_systems: bool = False
    takes_columns: bool = False

    @property
    def is_table(self) -> bool:
        """Whether a column map can say what its columns mean."""
        return self.name in {"CSV tables", "Parquet tables", "Excel workbooks"}


# In the order of recognition: binary formats, then text formats, the most general last.
LOG_FORMATS: Final = (
    LogFormat("MAVLink telemetry logs", (".tlog",), is_telemetry_log, TelemetryLogReader, has_systems=True),
    LogFormat("ArduPilot DataFlash", (".BIN", ".log"), is_dataflash, DataFlashReader),
    LogFormat("PX4 ULog", (".ulg",), lambda head: head.startswith(ULOG_MAGIC), ULogReader),
    LogFormat("MAVLink streams", (".rlog",), is_mavlink_stream, stream_reader, has_systems=True),
    LogFormat("ROS bags", (".bag", ".mcap", ".db3"), is_bag, BagReader, takes_columns=True),
    LogFormat("Parquet tables", (".parquet",), is_parquet, MappedTableReader),
    LogFormat("Excel workbooks", (".xlsx",), is_office_file, MappedTableReader),
    LogFormat("CSV tables", (".csv",), lambda head: is_mavlogdump(csv_header(head)), MavlogdumpReader),
    LogFormat("CSV tables", (".csv",), lambda head: is_dataflash_dump(csv_header(head)), DataFlashDumpReader),
    LogFormat("CSV tables", (".csv",), lambda head: is_ulog2csv(csv_header(head)), Ulog2csvReader),
    LogFormat("CSV tables", (".csv",), lambda head: ready_map(table_header(head)) is not None, MappedTableReader),
    LogFormat("CSV tables", (".csv",), lambda head: other_file(head, "") is None, TableReader),
)

# Suffixes of flight logs, in lower case.
LOG_SUFFIXES: Final = tuple(dict.fromkeys(suffix.lower() for one in LOG_FORMATS for suffix in one.suffixes))


def _readable() -> str:
    names = list(dict.fromkeys(f"{one.name} ({', '.join(one.suffixes)})" for one in LOG_FORMATS))
    return f"glstar reads {', '.join(names[:-1])} and {names[-1]}"


# A sentence for messages.
READABLE: Final = _readable()


def log_format(head: bytes) -> LogFormat | None:
    """Return the format of a file.

    Parameters
    ----------
    head : bytes
        The first 4096 bytes of the file.

    Returns
    -------
    LogFormat or None
        None if glstar does not read the file.
    """
    return next((one for one in LOG_FORMATS if one.recognises(head)), None)
