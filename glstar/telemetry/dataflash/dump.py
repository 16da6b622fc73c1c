"""The CSV that pymavlink's ``mavlogdump.py --format csv`` writes of a DataFlash log: one file for each message.

::

    mavlogdump.py --format csv --types ATT flight.BIN > flight_ATT.csv

The first column, ``timestamp``, is UTC as pymavlink derives it from the first GPS fix and 18 leap seconds; the others
are the fields of the message.  The name of the file, or else its fields, identify the message.  Other messages, in
particular those with position and UTC, are read from files in the same directory that have the same name but for the
message: ``flight_GPS.csv``.
"""

import os
import re
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path

import numpy as np

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.sky.place.timescale import leap_seconds
from glstar.telemetry import source
from glstar.telemetry.boots import within
from glstar.telemetry.dataflash.attitude import preferred_messages
from glstar.telemetry.dataflash.reader import LOGGED_LATE_S, DataFlashReader, boots_of
from glstar.telemetry.dataflash.records import Records, stamped
from glstar.telemetry.tables.files import Dump

_HEADER = re.compile(r"timestamp(?P<separator>[^\w.])Time(US|MS)((?P=separator)|\s*$)")
# Messages that are read from other files in the directory.
_SOUGHT = ("ATT", "XKQ", "NKQ", "XKF4", "NKF4", "POS", "GPS", "GPA", "IMU", "GYR", "EV", "MSG", "VER", "AHR2", "SIM")
_NAMED = re.compile(rf"(?<![A-Za-z0-9])(?:{'|'.join(_SOUGHT)})(?![A-Za-z0-9])", re.IGNORECASE)
# Messages by their fields, for files whose name does not contain the message; the first match is used.
_BY_FIELDS = (
    ("XKQ", {"C", "Q1", "Q2", "Q3", "Q4"}),
    ("AHR2", {"Roll", "Pitch", "Yaw", "Lat", "Lng"}),
    ("ATT", {"Roll", "Pitch", "Yaw"}),
    ("GPS", {"GWk", "GMS"}),
    ("GPS", {"Week", "T"}),
    ("POS", {"Lat", "Lng", "Alt"}),
    ("IMU", {"GyrX", "GyrY", "GyrZ"}),
)
_TEXT = {"MSG": "Message", "VER": "FWS"}
_ATTITUDES = {"XKQ", "NKQ", "ATT", "AHR2", "SIM"}
# Output of mavlogdump, also in the file, if a log does not have a message.
_NOT_FOUND = "Specified type"
# Messages whose clocks show the number of boots in the log.
_CLOCKED = ("ATT", "XKQ", "NKQ", "POS", "GPS", "IMU", "GYR", "AHR2", "SIM")
# The position of a row is its microseconds since boot, plus this for each table before it in the file.
_TABLE_STEP = 1 << 50
# A larger step back of the time is another table, us.
_BACK_US = 1e6
# GPS time minus UTC as pymavlink assumes it in every year, s.
_PYMAVLINK_LEAP_S = 18.0


def is_dataflash_dump(header: str) -> bool:
    """Return whether a table was exported by mavlogdump from a DataFlash log, by its first line."""
    return _HEADER.match(header) is not None


class DataFlashDumpReader(DataFlashReader):
    """The CSV of a DataFlash log as a telemetry source; its clock is the autopilot's time since boot.

    `path` is one of its tables; `attitude`, as of `DataFlashReader`, is by default the message of that table if it is
    an attitude.  Raises LogFormatError if the file is not text.
    """

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", boot: int | None = None) -> None:
        self.name = os.fspath(path)
        self._boot = boot
        self._log = self._tables = _Tables(self.name)
        own = self._tables.own
        self._attitude = own if attitude.strip().lower() == "auto" and own in _ATTITUDES else attitude

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC and, if the log has them, gyro rates of each boot, a batch each.

        Raises LogFormatError if there is no attitude, not the requested one, or no such boot.
        """
        for batch in super().samples():
            if isinstance(batch, source.AttitudeSamples):
                yield replace(batch, notes=(*batch.notes, *self._notes))
            else:
                yield batch

    @cached_property
    def _notes(self) -> tuple[str, ...]:
        """Remarks on tables that are not used."""
        names = self._tables.names
        own, best = self._tables.own, next((name for name in preferred_messages(self._tables) if name in names), None)
        notes = list(self._tables.left_out)
        if self._attitude == own and best not in (None, own):
            better = self._tables.called(str(best))
            notes.append(
                f"{own} is taken, because its table was named; {better} beside it has {best} (--attitude {best})"
            )
        return tuple(notes)

    @cached_property
    def _found_boots(self) -> tuple[source.Boot, ...]:
        return boots_of(self._tables, knows_utc=True)

    def _beside_attitude(self, log: Records) -> Iterator[source.Samples]:
        """Yield all other samples of one boot, with UTC of mavlogdump's timestamps if there is no other."""
        for batch in super()._beside_attitude(log):
            if isinstance(batch, source.ClockSamples) and not batch.clock_s.size:
                yield self._stamps(log)
            elif isinstance(batch, source.PositionSamples) and not batch.clock_s.size and "GPS" not in self._tables:
                beside = f"neither {self._tables.called('POS')} nor {self._tables.called('GPS')} lies beside it"
                yield source.no_position_samples(f"{beside}{self._tables.how_to_name}")
            else:
                yield batch

    def _stamps(self, log: Records) -> source.ClockSamples:
        """Return UTC by mavlogdump's timestamps; in a log of several boots they are by the clock of one boot."""
        without_gps = f"no {self._tables.called('GPS')} beside it"
        if len(self._found_boots) > 1 and not self._tables.heads:
            return source.no_clock_samples(f"{without_gps}, and timestamps hold for one boot only")
        stamps = stamped(log, self._tables.own, "timestamp")
        clock_s, utc_s = (stamps[0], stamps[1][0]) if stamps else (np.empty(0), np.empty(0))
        valid = np.isfinite(clock_s) & source.plausible_utc(utc_s)
        clock_s, utc_s = clock_s[valid], utc_s[valid]
        if not utc_s.size:
            return source.no_clock_samples(f"{without_gps}, and its timestamps are no UTC")
        leap_s = leap_seconds(float(np.median(utc_s)) + _PYMAVLINK_LEAP_S)
        better = f"may be wrong by seconds; {self._tables.called('GPS')} beside it would be accurate"
        message = f"timestamps of mavlogdump, by the first GPS fix ({better}), {leap_s:.0f} leap seconds"
        return source.ClockSamples(clock_s - LOGGED_LATE_S, utc_s + _PYMAVLINK_LEAP_S - leap_s, message)


class _Tables(Records):
    """The messages of a log, one file each."""

    kind = "CSV of ArduPilot DataFlash, by mavlogdump"

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self._named = next(reversed(list(_NAMED.finditer(self._path.stem))), None)
        named = self._named[0].upper() if self._named else ""
        own = Dump(path, texts=_TEXT.get(named))
        self.own = named or _by_fields(own.header)
        self._read: dict[str, Dump | None] = {self.own: own}
        # Remarks on tables in the directory that are left out.
        self.left_out: list[str] = []
        self.end = int(own.line[-1]) if own.line.size else 1
        self.unread_bytes = 0

    @property
    def names(self) -> list[str]:
        """Names of the messages with a table, sorted."""
        return sorted(name for name in {self.own, *_SOUGHT} if name in self)

    def __contains__(self, name: str) -> bool:
        table = self._table(name)
        return table is not None and table.line.size > 0

    def count(self, name: str) -> int:
        """Return the number of rows of a message."""
        table = self._table(name)
        return 0 if table is None else table.line.size

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the column names of a message; empty if there is no table of it."""
        table = self._table(name)
        return table.header if table is not None and table.line.size else ()

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return columns of a message; None if one is missing."""
        table = self._table(name)
        if table is None or not set(fields) <= set(table.columns) or not table.line.size:
            return None
        return [table.columns[field] for field in fields]

    def texts(self, name: str, field: str) -> list[str]:
        """Return a text column; empty if there is none."""
        table = self._table(name)
        return list(table.texts) if table is not None and field == _TEXT.get(name) else []

    def position(self, name: str) -> Integer:
        """Return the position of each row of a message: `_TABLE_STEP` times the number of its table, plus its time, us.

        It is -1 for rows without a valid time.
        """
        table, clock_us = self._table(name), self._clock_us(name)
        if table is None or clock_us is None:
            return np.empty(0, dtype=np.int64) if table is None else np.full(table.line.size, -1)
        valid = np.abs(clock_us) < _TABLE_STEP / 2  # False for NaN too
        return np.where(valid, self._nth(name) * _TABLE_STEP + np.where(valid, clock_us, 0.0), -1.0).astype(np.int64)

    @property
    def heads(self) -> tuple[int, ...]:
        """The positions at which another table begins in joined files.

        Raises LogFormatError if the files of the messages contain different numbers of tables.
        """
        numbers = {name: int(self._nth(name).max(initial=0)) for name in _CLOCKED if self.count(name) > 1}
        if len(set(numbers.values())) > 1:
            listed = ", ".join(f"{self.called(name)} {number + 1}" for name, number in sorted(numbers.items()))
            message = f"its tables are of different numbers of boots ({listed}); give the .BIN itself"
            raise LogFormatError(self._path, message, offset=self.end)
        tables = [table for name in _CLOCKED if (table := self._table(name)) is not None and table.line.size]
        repeated = any(table.heads for table in tables)
        count = max(numbers.values(), default=0)
        return tuple(number * int(_TABLE_STEP) for number in range(1, count + 1)) if repeated else ()

    def alike(self, one: int, other: int) -> bool:  # noqa: ARG002 - a table has one header
        """Return that all rows have the same columns."""
        return True

    def only(self, spans: Sequence[source.Span]) -> "_Tables":
        """Return the rows within some ranges of positions, as tables."""
        part = copy(self)
        part._read = {  # noqa: SLF001 - of its own class
            name: None if (table := self._table(name)) is None else table.only(within(self.position(name), spans))
            for name in {self.own, *_SOUGHT}
        }
        return part

    def _clock_us(self, name: str) -> Float | None:
        stamps = stamped(self, name)
        return None if stamps is None else stamps[0] * 1e6

    def _nth(self, name: str) -> Integer:
        """Return the number of the table of each row of a message in joined files, from 0."""
        table, clock_us = self._table(name), self._clock_us(name)
        if table is None:
            return np.empty(0, dtype=np.int64)
        after_head = np.searchsorted(np.array(table.heads), table.line)
        if clock_us is None:
            return after_head
        kept = np.flatnonzero(np.isfinite(clock_us))
        kept = kept[~source.spikes(clock_us[kept], _BACK_US)]
        back = np.zeros(table.line.size, dtype=np.int64)
        back[kept[1:]] = (np.diff(clock_us[kept]) < -_BACK_US) & (np.diff(after_head[kept]) == 0)
        return after_head + np.cumsum(back)

    def loss(self) -> str:
        """Return an empty message: a truncated table cannot be distinguished from a complete one."""
        return ""

    def close(self) -> None:
        """Do nothing: files are only open while they are read."""

    def called(self, name: str) -> str:
        """Return the name of the file of another message."""
        if self._named is None:
            return f"LOG_{name}.csv"
        stem = self._path.stem
        lower = name.lower() if self._named[0].islower() else name
        return f"{stem[: self._named.start()]}{lower}{stem[self._named.end() :]}{self._path.suffix}"

    @property
    def how_to_name(self) -> str:
        """Advice on how to name the file, so that the others are found; empty if it is named so."""
        return "" if self._named is not None else f"; name this table LOG_{self.own}.csv, so that they are found"

    def _table(self, name: str) -> Dump | None:
        if name not in self._read:
            self._read[name] = None
            file = self._path.parent / self.called(name)
            if self._named is not None and name in _SOUGHT and file.is_file():
                try:
                    self._read[name] = self._beside(file, _TEXT.get(name))
                except OSError as error:
                    self.left_out.append(f"{file.name} beside it is left out: {error.strerror or error}")
                except LogFormatError as error:
                    self.left_out.append(f"{file.name} beside it is left out: {error.reason}")
        return self._read[name]

    def _beside(self, file: Path, texts: str | None) -> Dump | None:
        """Return a table in the directory; None if mavlogdump found no records for it."""
        table = Dump(str(file), texts=texts)
        with file.open(encoding="utf-8-sig") as lines:
            first = next((line for line in lines if line.strip()), "")
        if not first or first.startswith(_NOT_FOUND):
            return None
        if not is_dataflash_dump(first):
            raise LogFormatError(file, "is no table of mavlogdump: it does not begin with timestamp,TimeUS")
        return table


def _by_fields(header: tuple[str, ...]) -> str:
    """Return the name of the message with some fields."""
    return next((name for name, fields in _BY_FIELDS if fields <= set(header)), "message")
