"""The CSV that pymavlink's ``mavlogdump.py --format csv`` writes of a DataFlash log: one message in each file.

::

    mavlogdump.py --format csv --types ATT flight.BIN > flight_ATT.csv

The first column, ``timestamp``, is UTC as pymavlink makes it of the first GPS fix and 18 leap seconds, the others are
the fields of the message; which message it is, the name of the file tells, else the fields.  What other messages tell,
place and UTC above all, is read of the files beside it with their names in the same place: ``flight_GPS.csv``.
"""

import os
import re
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.telemetry.dataflash.gps import LOGGED_LATE_S, leap_seconds
from glstar.telemetry.dataflash.reader import DataFlashReader
from glstar.telemetry.dataflash.records import Records, stamped
from glstar.telemetry.rows import Dump
from glstar.telemetry.sound import YEAR_2010_S, YEAR_2100_S, no_places
from glstar.telemetry.source import ClockSamples, PositionSamples, Samples

__all__ = ["DataFlashDumpReader", "is_dataflash_dump"]

Float = NDArray[np.float64]

_HEADER = re.compile(r"timestamp(?P<separator>[^\w.])Time(US|MS)((?P=separator)|\s*$)")
# The messages that are looked for, beside those whose name a file bears.
_SOUGHT = ("ATT", "XKQ", "NKQ", "XKF4", "NKF4", "POS", "GPS", "GPA", "IMU", "GYR", "EV", "MSG", "VER", "AHR2", "SIM")
_NAMED = re.compile(rf"(?<![A-Za-z0-9])(?:{'|'.join(_SOUGHT)})(?![A-Za-z0-9])", re.IGNORECASE)
# What tells a message by its fields, where the name of the file does not: the first that fits.
_BY_FIELDS: Final = (
    ("XKQ", {"C", "Q1", "Q2", "Q3", "Q4"}),
    ("AHR2", {"Roll", "Pitch", "Yaw", "Lat", "Lng"}),
    ("ATT", {"Roll", "Pitch", "Yaw"}),
    ("GPS", {"GWk", "GMS"}),
    ("GPS", {"Week", "T"}),
    ("POS", {"Lat", "Lng", "Alt"}),
    ("IMU", {"GyrX", "GyrY", "GyrZ"}),
)
_TEXT: Final = {"MSG": "Message", "VER": "FWS"}
_ATTITUDES = {"XKQ", "NKQ", "ATT", "AHR2", "SIM"}
# What pymavlink takes UTC to lag behind GPS time, in every year.
_PYMAVLINK_LEAP_S = 18.0


def is_dataflash_dump(header: str) -> bool:
    """Return whether a table with this header is mavlogdump's of a DataFlash log.

    Parameters
    ----------
    header : str
        The first line.

    Returns
    -------
    bool
    """
    return _HEADER.match(header) is not None


class DataFlashDumpReader(DataFlashReader):
    """A DataFlash log that became CSV as a telemetry source; its clock is the autopilot's time since boot.

    Parameters
    ----------
    path : path-like
        One of its tables.
    attitude : str
        ``"auto"``: the message that the table is of, where that is an attitude, else as of a DataFlash log.

    Raises
    ------
    LogFormatError
        If the file is no text.
    """

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto") -> None:
        self.name = os.fspath(path)
        self._tables = _Tables(self.name)
        self._log = self._tables
        own = self._tables.own
        self._attitude = own if attitude.strip().lower() == "auto" and own in _ATTITUDES else attitude

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places, the UTC and, where it has gyros, the turn rates, a batch each.

        Raises
        ------
        LogFormatError
            If there is no attitude, or not the one that was asked for.
        """
        for batch in super().samples():
            if isinstance(batch, ClockSamples) and not batch.clock_s.size:
                yield self._stamps()
            elif isinstance(batch, PositionSamples) and not batch.clock_s.size and "GPS" not in self._tables:
                yield no_places(f"neither {self._tables.called('POS')} nor {self._tables.called('GPS')} lies beside it")
            else:
                yield batch

    def _stamps(self) -> ClockSamples:
        """Return UTC as mavlogdump stamped the table."""
        stamps = stamped(self._tables, self._tables.own, "timestamp")
        clock_s, utc_s = (stamps[0], stamps[1][0]) if stamps else (np.empty(0), np.empty(0))
        told = np.isfinite(clock_s) & (utc_s >= YEAR_2010_S) & (utc_s < YEAR_2100_S)
        clock_s, utc_s = clock_s[told], utc_s[told]
        if not utc_s.size:
            return ClockSamples(
                clock_s, utc_s, f"no {self._tables.called('GPS')} beside it, and its timestamps are no UTC"
            )
        leap_s = leap_seconds(float(np.median(utc_s)) + _PYMAVLINK_LEAP_S)
        better = f"seconds off at worst: {self._tables.called('GPS')} beside it would tell better"
        source = f"timestamps of mavlogdump, by the first GPS fix ({better}), {leap_s:.0f} leap seconds"
        return ClockSamples(clock_s - LOGGED_LATE_S, utc_s + _PYMAVLINK_LEAP_S - leap_s, source)


class _Tables(Records):
    """The messages of a log, a file each."""

    kind = "CSV of ArduPilot DataFlash, by mavlogdump"

    def __init__(self, path: str) -> None:
        own = Dump(path)
        self._path = Path(path)
        self._named = next(reversed(list(_NAMED.finditer(self._path.stem))), None)
        self.own = self._named[0].upper() if self._named else _by_fields(own.header)
        self._read: dict[str, Dump | None] = {self.own: own}
        self.end = int(own.line[-1]) if own.line.size else 1

    @property
    def names(self) -> list[str]:
        """The messages of which there is a table, sorted."""
        return sorted(name for name in {self.own, *_SOUGHT} if name in self)

    def __contains__(self, name: str) -> bool:
        table = self._table(name)
        return table is not None and table.line.size > 0

    def count(self, name: str) -> int:
        """Return how many rows there are of a message."""
        table = self._table(name)
        return 0 if table is None else table.line.size

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the columns of a message, none where there is no table of it."""
        table = self._table(name)
        return table.header if table is not None and table.line.size else ()

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return columns of a message; None where there are not all of them."""
        table = self._table(name)
        if table is None or not set(fields) <= set(table.columns) or not table.line.size:
            return None
        return [table.columns[field] for field in fields]

    def texts(self, name: str, field: str) -> list[str]:
        """Return a column of text; nothing where there is none."""
        table = self._table(name)
        return list(table.texts) if table is not None and field == _TEXT.get(name) else []

    def loss(self) -> str:
        """Return nothing: a table that was cut off cannot be told from one that is whole."""
        return ""

    def close(self) -> None:
        """Do nothing: a file is open only while it is read."""

    def called(self, name: str) -> str:
        """Return the name of the file in which another message would be."""
        if self._named is None:
            return f"LOG_{name}.csv (as of a file named LOG_{self.own}.csv)"
        stem = self._path.stem
        lower = name.lower() if self._named[0].islower() else name
        return f"{stem[: self._named.start()]}{lower}{stem[self._named.end() :]}{self._path.suffix}"

    def _table(self, name: str) -> Dump | None:
        if name not in self._read:
            self._read[name] = None
            if (
                self._named is not None
                and name in _SOUGHT
                and (file := self._path.parent / self.called(name)).is_file()
            ):
                try:
                    self._read[name] = Dump(str(file), texts=_TEXT.get(name))
                except OSError as error:
                    raise LogFormatError(file, f"cannot be read: {error.strerror or error}") from error
        return self._read[name]


def _by_fields(header: tuple[str, ...]) -> str:
    """Return the name of a message with these fields."""
    return next((name for name, fields in _BY_FIELDS if fields <= set(header)), "message")
