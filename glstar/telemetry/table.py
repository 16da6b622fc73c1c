"""Flights as tables: CSV files with a header, units in the column names.

==================================  =============================================================================
column                              meaning
==================================  =============================================================================
utc, or utc_s                       ISO 8601 (without an offset: UTC), or UTC seconds since 1970
roll_deg, pitch_deg, yaw_deg        aerospace Euler angles, yaw first, deg
or qw, qx, qy, qz                   q_body_ned, the quaternion that turns NED components into body ones
latitude_deg, longitude_deg         WGS84, east positive, deg
height_m                            may be left out: 0
==================================  =============================================================================

In any order, other columns are passed over; separated by commas, semicolons or tabs; ``#`` begins a comment line.  A
row may leave attitude or place empty where only the other was measured.
"""

import csv
import os
import textwrap
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from math import nan
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from glstar.errors import ConfigError, LogFormatError
from glstar.rotation import quaternion_from_euler
from glstar.telemetry.source import AttitudeSamples, ClockSamples, PositionSamples, Samples, TelemetrySource
from glstar.timescale import parse_utc

__all__ = ["TableReader"]

Float = NDArray[np.float64]

_TIMES = ("utc", "utc_s")
_EULER = ("roll_deg", "pitch_deg", "yaw_deg")
_QUATERNION = ("qw", "qx", "qy", "qz")
_PLACE = ("latitude_deg", "longitude_deg")
_COLUMNS = (*_TIMES, *_EULER, *_QUATERNION, *_PLACE, "height_m")

# UTC seconds outside of these years are milliseconds, or seconds since boot.
_YEAR_1972_S, _YEAR_2100_S = 63072000.0, 4102444800.0
# Rounded to two decimals a quaternion is still as near to unit length as this.
_UNIT_TOLERANCE = 0.02


class TableReader(TelemetrySource):
    """A CSV file as a telemetry source; its clock is UTC.

    Parameters
    ----------
    path : path-like
        The table.

    Raises
    ------
    LogFormatError
        If the file is no such table; it names the line and the column.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.name = os.fspath(path)
        self._lines, rows = _rows(self.name)
        header = [name.strip().lower() for name in rows[0]]
        self._check_header(header)
        cells = list(zip(*self._whole_rows(rows), strict=True)) or [() for _ in header]
        self._cells = {name: column for name, column in zip(header, cells, strict=True) if name in _COLUMNS}

    def samples(self) -> Iterator[Samples]:
        """Yield the attitude, the places and the UTC of the whole table, a batch each.

        Raises
        ------
        LogFormatError
            If a cell is no number, or cannot be meant.
        """
        utc_s = self._utc_s()
        q = self._q_body_ned()
        told = np.isfinite(q).all(axis=-1)
        yield AttitudeSamples(utc_s[told], q[told], np.zeros(np.count_nonzero(told), dtype=np.int64), "table")
        yield self._places(utc_s)
        yield ClockSamples(utc_s[:1], utc_s[:1], "table")

    def close(self) -> None:
        """Do nothing: the file was read at once."""

    def _check_header(self, header: list[str]) -> None:
        known = [name for name in header if name in _COLUMNS]
        found = textwrap.shorten(", ".join(name or "(nameless)" for name in header), 100, placeholder=" ...")
        if not known:
            raise self._error(
                0, f"no table of a flight: a header names utc or utc_s, roll_deg or qw, ...; this line has {found}"
            )
        if repeated := [name for name in known if known.count(name) > 1]:
            raise self._error(0, f"column {repeated[0]} appears twice")
        if not any(name in known for name in _TIMES):
            raise self._error(0, f"no column utc (ISO 8601) or utc_s{_meant('utc', header)}; it has {found}")
        euler, quaternion = ([name for name in form if name in known] for form in (_EULER, _QUATERNION))
        if len(euler) == len(_EULER) and len(quaternion) == len(_QUATERNION):
            raise self._error(0, "attitude twice, as roll_deg, pitch_deg, yaw_deg and as qw, qx, qy, qz; leave one out")
        if not euler and not quaternion:
            raise self._error(
                0, f"no attitude: neither roll_deg, pitch_deg, yaw_deg nor qw, qx, qy, qz; it has {found}"
            )
        for name in _EULER if len(euler) / 3 >= len(quaternion) / 4 else _QUATERNION:
            self._require(name, header)
        if any(name in known for name in _PLACE):
            for name in _PLACE:
                self._require(name, header)

    def _require(self, name: str, header: list[str]) -> None:
        if name not in header:
            raise self._error(0, f"no column {name}{_meant(name, header)}")

    def _whole_rows(self, rows: list[list[str]]) -> list[list[str]]:
        """Return the rows below the header, without a last one that was cut off as it was written."""
        width = len(rows[0])
        for row, cells in enumerate(rows[1:], start=1):
            if len(cells) != width:
                if row == len(rows) - 1 and len(cells) < width:
                    return rows[1:-1]
                raise self._error(row, f"{len(cells)} fields, where the header names {width}")
        return rows[1:]

    def _utc_s(self) -> Float:
        name = next(name for name in _TIMES if name in self._cells)
        utc_s = self._read(name, parse_utc if name == "utc" else float)
        self._refuse(
            name, ~((utc_s >= _YEAR_1972_S) & (utc_s < _YEAR_2100_S)), "is no UTC between 1972 and 2100, in seconds"
        )
        return utc_s

    def _q_body_ned(self) -> Float:
        if set(_EULER) <= set(self._cells):
            return quaternion_from_euler(*(np.deg2rad(self._number(name)) for name in _EULER))
        q = np.stack([self._number(name) for name in _QUATERNION], axis=-1)
        odd = np.abs(np.linalg.norm(q, axis=-1) - 1) > _UNIT_TOLERANCE
        self._refuse("qw", odd, "begins a quaternion that is not of unit length")
        return q

    def _places(self, utc_s: Float) -> PositionSamples:
        if not set(_PLACE) <= set(self._cells):
            nothing = np.empty(0)
            return PositionSamples(nothing, nothing, nothing, nothing, "no columns latitude_deg, longitude_deg")
        latitude_deg, longitude_deg = (self._number(name) for name in _PLACE)
        self._refuse("latitude_deg", np.abs(latitude_deg) > 90, "lies beyond a pole")
        self._refuse("longitude_deg", np.abs(longitude_deg) > 360, "is more than a turn")
        height_m = self._number("height_m") if "height_m" in self._cells else np.zeros(utc_s.size)
        told = np.isfinite(latitude_deg) & np.isfinite(longitude_deg)
        return PositionSamples(
            utc_s[told],
            np.deg2rad(latitude_deg[told]),
            np.deg2rad(longitude_deg[told]),
            np.nan_to_num(height_m[told], posinf=0.0, neginf=0.0),
            "table" if told.any() else "latitude_deg and longitude_deg are empty",
        )

    def _number(self, name: str) -> Float:
        """Return a column of numbers, NaN where a cell is empty."""
        try:
            return np.array(list(map(float, self._cells[name])))
        except ValueError:
            return self._read(name, lambda text: float(text) if text.strip() else nan)

    def _read(self, name: str, read: Callable[[str], float]) -> Float:
        """Return a column read cell by cell."""
        try:
            return np.array(list(map(read, self._cells[name])), dtype=np.float64)
        except (ValueError, ConfigError):
            for row, text in enumerate(self._cells[name], start=1):
                try:
                    read(text)
                except (ValueError, ConfigError) as error:
                    wanted = "an ISO 8601 time, such as 2024-03-10T11:00:00Z" if name == "utc" else "a number"
                    hint = "; write decimals with a point" if name != "utc" and "," in text else ""
                    raise self._error(row, f"{text.strip()!r} is not {wanted}{hint}", column=name) from error
            raise

    def _refuse(self, name: str, bad: NDArray[np.bool_], why: str) -> None:
        if bad.any():
            row = int(np.argmax(bad)) + 1
            raise self._error(row, f"{self._cells[name][row - 1].strip()} {why}", column=name)

    def _error(self, row: int, message: str, *, column: str | None = None) -> LogFormatError:
        line = self._lines[row]
        where = f"line {line}" if column is None else f"line {line}, column {column}"
        return LogFormatError(self.name, f"{where}: {message}", offset=line)


def _rows(path: str) -> tuple[list[int], list[list[str]]]:
    """Return the rows of a CSV file, header first, and the number of the line that each one stands on."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogFormatError(path, f"is no text: byte {error.start} is not UTF-8", offset=error.start) from error
    numbered = [
        (number, line)
        for number, line in enumerate(text.split("\n"), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise LogFormatError(path, "holds nothing but blank lines and comments", offset=0)
    lines = [number for number, _ in numbered]
    delimiter = max(",;\t", key=numbered[0][1].count)
    reader = csv.reader((line for _, line in numbered), delimiter=delimiter, strict=True)
    rows: list[list[str]] = []
    try:
        for row in reader:
            rows.append(row)
            if reader.line_num > len(rows):
                raise csv.Error("a quoted field runs over the end of the line")
    except csv.Error as error:
        line = lines[min(len(rows), len(lines) - 1)]
        raise LogFormatError(path, f"line {line}: {error}", offset=line) from error
    return lines, rows


def _meant(name: str, header: list[str]) -> str:
    """Return a question after the column that was perhaps meant."""
    unknown = [column for column in header if column not in _COLUMNS]
    near = get_close_matches(name, unknown, n=1, cutoff=0.5)
    return f" (did you mean it by {near[0]!r}?)" if near else ""
