"""The CSV files that pyulog's ``ulog2csv`` writes of a ULog: one file for each instance of a topic.

``flight.ulg`` becomes ``flight_vehicle_attitude_0.csv``, ``flight_vehicle_gps_position_0.csv`` and so on.  The column
``timestamp`` is the time since boot in microseconds, the others are the fields of the topic.  Any of the files may be
opened: the others are found by their names in the same directory.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.telemetry.boots import find_boots
from glstar.telemetry.rows import Dump, separator
from glstar.telemetry.source import AttitudeSamples, Boot, Samples, Span
from glstar.telemetry.ulog import CLOCKED, RECEIVERS, ULogReader, clock_readings
from glstar.telemetry.ulogfile import Topics

__all__ = ["Ulog2csvReader", "is_ulog2csv"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

_TOPICS = (
    r"(?:vehicle|estimator|external_ins)_attitude(?:_groundtruth)?|vehicle_global_position|vehicle_gps_position"
    r"|sensor_gps|vehicle_angular_velocity|sensor_combined|sensor_gyro|vehicle_status"
)
_FILE = re.compile(rf"(?P<log>.*)_(?P<topic>{_TOPICS})_(?P<instance>\d{{1,3}})\.csv", re.DOTALL | re.IGNORECASE)
# Fields of the topics that are read, which tables of other origin do not have.
_TYPICAL_FIELDS: Final = {
    "q[0]",
    "time_utc_usec",
    "xyz[0]",
    "gyro_rad[0]",
    "gyro_rad_s[0]",
    "system_type",
    "terrain_alt",
}
_FIELD = re.compile(r"[A-Za-z_][\w.\[\]]*")
_QUATERNION = "q[0]"
_UNNAMED = "vehicle_attitude"


def is_ulog2csv(header: str) -> bool:
    """Return whether a table was exported by ulog2csv.

    Parameters
    ----------
    header : str
        First line of the table.

    Returns
    -------
    bool
    """
    first, mark, rest = header.strip().partition("timestamp")
    if first or not mark or not rest:
        return False
    fields = rest[1:].split(rest[0])
    return all(map(_FIELD.fullmatch, fields)) and not _TYPICAL_FIELDS.isdisjoint(fields)


class Ulog2csvReader(ULogReader):
    """The files of ulog2csv as a telemetry source; its clock is the autopilot's time since boot.

    Parameters
    ----------
    path : path-like
        One of the files.
    attitude : str
        ``"auto"``: the attitude in the opened file, else vehicle_attitude in the directory.  Or a topic by name; see
        `ULogReader`.

    Raises
    ------
    LogFormatError
        If the file cannot be read.
    """

    format = "CSV of PX4 ULog, by ulog2csv"

    def _open(self) -> list[Topics]:
        topics = _Files(self.name)
        if self._attitude.strip().lower() == "auto" and topics.own_quaternion:
            self._topic, self._instance = topics.own
        return [topics]

    def samples(self) -> Iterator[Samples]:
        """Yield attitude, position, UTC and gyro rates of the log, a batch each.

        Raises
        ------
        LogFormatError
            If the log has no attitude, or not the requested one.
        """
        for batch in super().samples():
            yield replace(batch, notes=self._notes) if isinstance(batch, AttitudeSamples) else batch

    @property
    def _notes(self) -> tuple[str, ...]:
        """Remarks on files in the directory that are left out."""
        [topics] = self._logs
        if not isinstance(topics, _Files):
            return ()
        for name in topics.names:
            topics.count(name)
        return tuple(topics.left_out)

    @cached_property
    def _found_boots(self) -> tuple[Boot, ...]:
        # The order of rows in different files is unknown: each file is examined separately.
        [topics] = self._logs
        position, clock_s, utc_s = clock_readings(self._logs)
        nothing = position[:0], clock_s[:0], utc_s[:0]
        source = next((name for name in RECEIVERS if topics.count(name)), None) if position.size else None
        for name in CLOCKED:
            for stamps in topics.stamps(name):
                boots = find_boots([stamps], (position, clock_s, utc_s) if name == source else nothing)
                if len(boots) > 1:
                    message = (
                        f"the time since boot of {name} restarts: {len(boots)} boots; give the .ulg files themselves"
                    )
                    raise LogFormatError(self.name, message)
        return (Boot(1),)


class _Files(Topics):
    """The topics of a log, one file each."""

    whole_bytes = unread_bytes = 0

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self.about: Mapping[str, str | int] = {}
        named = _FILE.fullmatch(self._path.name)
        self._log = named["log"] if named else None
        self.own = (named["topic"].lower(), int(named["instance"])) if named else (_UNNAMED, 0)
        self._read: dict[str, list[tuple[int, dict[str, Float]]]] = {}
        # Remarks on files in the directory that are left out.
        self.left_out: list[str] = []
        self._files: dict[tuple[str, int], Path] = {self.own: self._path}
        for beside in self._path.parent.iterdir() if named else ():
            other = _FILE.fullmatch(beside.name)
            if other and other["log"] == self._log:
                self._files.setdefault((other["topic"].lower(), int(other["instance"])), beside)
        self.own_quaternion = _QUATERNION in _fields(self._path)

    @property
    def names(self) -> list[str]:
        """The names of all topics with a file, sorted."""
        return sorted({topic for topic, _ in self._files})

    def count(self, name: str) -> int:
        """Return the number of samples of a topic."""
        return sum(columns["timestamp"].size for _, columns in self[name])

    def __getitem__(self, name: str) -> list[tuple[int, dict[str, Float]]]:
        """Return the instances of a topic, sorted by number."""
        if name not in self._read:
            instances = sorted(instance for topic, instance in self._files if topic == name)
            dumps = [(instance, self._columns(self._files[name, instance])) for instance in instances]
            self._read[name] = [(instance, columns) for instance, columns in dumps if "timestamp" in columns]
        return self._read[name]

    def with_quaternion(self) -> list[str]:
        """Return the names of all topics with a quaternion."""
        return sorted({topic for (topic, _), file in self._files.items() if _QUATERNION in _fields(file)})

    def extent(self) -> str:
        """Return an empty message: a truncated table cannot be distinguished from a complete one."""
        return ""

    def lack(self, *names: str) -> str:
        """Return which files are missing, for messages."""
        if self._log is None:
            return f"the name of the file should be LOG_{_UNNAMED}_0.csv, as ulog2csv wrote it, to find those beside it"
        files = [f"{self._log}_{name}_0.csv" for name in names]
        return f"neither {' nor '.join(files)} lies beside it" if len(files) > 1 else f"no {files[0]} lies beside it"

    def stamps(self, name: str) -> list[tuple[Integer, Float]]:
        """Return row numbers and times, s since boot, of each instance of a topic."""
        return [(np.arange(columns["timestamp"].size), columns["timestamp"] * 1e-6) for _, columns in self[name]]

    def only(self, spans: Sequence[Span]) -> Topics:
        """Return all topics: files of several boots are rejected."""
        del spans
        return self

    def _columns(self, file: Path) -> dict[str, Float]:
        """Return the columns of a file; none if it is another file in the directory and cannot be read."""
        try:
            return Dump(str(file)).columns
        except OSError as error:
            reason = error.strerror or str(error)
        except LogFormatError as error:
            reason = error.reason
        if file == self._path:
            raise LogFormatError(file, f"cannot be read: {reason}")
        self.left_out.append(f"{file.name} beside it is left out: {reason}")
        return {}


def _fields(file: Path) -> list[str]:
    """Return the names of the columns of a file; none if it is not text."""
    try:
        with file.open(encoding="utf-8-sig") as text:
            header = text.readline(1 << 16).strip()
    except (OSError, UnicodeDecodeError):
        return []
    return header.split(separator(str(file)))
