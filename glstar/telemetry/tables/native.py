"""Flights as CSV tables, with units in the column names.

==================================  =============================================================================
column                              meaning
==================================  =============================================================================
utc, or utc_s                       ISO 8601 (without an offset: UTC), or UTC seconds since 1970
roll_deg, pitch_deg, yaw_deg        aerospace Euler angles, yaw first, deg
or qw, qx, qy, qz                   q_body_ned, the quaternion that turns NED components into body ones
latitude_deg, longitude_deg         WGS84, east positive, deg
height_m                            optional, 0 by default
roll_rate_deg_per_s,                optional: gyro rates about the body axes forward, right and down, deg/s; not the
pitch_rate_deg_per_s,               rates of the Euler angles
yaw_rate_deg_per_s
==================================  =============================================================================

Columns may be in any order; other columns are ignored.  Cells are separated by commas, semicolons or tabs; ``#`` begins
a comment line.  Attitude or position may be empty in rows with only the other one.
"""

import os
import textwrap
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby, islice, pairwise, repeat
from math import inf, nan
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError
from glstar.flight import Flight
from glstar.rotation import quaternion_from_euler
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import nearest_word
from glstar.telemetry import source
from glstar.telemetry.tables.files import (
    ROWS_AT_ONCE,
    TABLE_UNIT_TOLERANCE,
    csv_rows,
    numbers_without_header,
    refuse_other_attitudes,
)
from glstar.telemetry.tables.tableclock import in_first_second, left_out_rows, valid_rows

_TIMES = ("utc", "utc_s")
_EULER = ("roll_deg", "pitch_deg", "yaw_deg")
_QUATERNION = ("qw", "qx", "qy", "qz")
_PLACE = ("latitude_deg", "longitude_deg")
_RATES = ("roll_rate_deg_per_s", "pitch_rate_deg_per_s", "yaw_rate_deg_per_s")
_COLUMNS = (*_TIMES, *_EULER, *_QUATERNION, *_PLACE, "height_m", *_RATES)

# A larger step back of the time, or forward by more than a day, begins another part, s.
_BACK_S = 1.0
_SAME_FLIGHT_S = 86400.0
# Largest number of parts; with more steps back the rows are simply not sorted.
_MAX_PARTS = 20
# A TUM trajectory has a time, a place and a quaternion.
_TUM_COLUMNS = 8
# UTC seconds outside these years are milliseconds, or seconds since boot.
_YEAR_1972_S = 63072000.0


def as_table(flight: Flight) -> str:
    """Return a flight as the content of a CSV file: UTC and quaternions exactly, and the position at every attitude."""
    utc_s, q_body_ned = flight.attitude.utc_s, flight.attitude.q_body_ned
    latitude_rad, longitude_rad, height_m = flight.position.coordinates(utc_s)
    columns = np.column_stack([utc_s, q_body_ned, np.rad2deg(latitude_rad), np.rad2deg(longitude_rad), height_m])
    names = ("utc_s", *_QUATERNION, *_PLACE, "height_m")
    return "\n".join([",".join(names), *(",".join(map(repr, row)) for row in columns.tolist())]) + "\n"


class TableReader(source.TelemetrySource):
    """A CSV file as a telemetry source; its clock is UTC.

    Tables may be joined, with or without a repeated header.  Parts that overlap with another part in time, or are more
    than a day away, are treated as separate boots.  `attitude` is ``"auto"``: a table has one attitude.  Raises
    LogFormatError if the file is no such table, with line and column.
    """

    one_clock = True

    def __init__(self, path: str | PathLike[str], *, attitude: str = "auto", boot: int | None = None) -> None:
        self.name = os.fspath(path)
        self._boot = boot
        self._dropped = 0
        refuse_other_attitudes(self.name, attitude)
        line, header = next(csv_rows(self.name), (0, []))
        if not header:
            raise LogFormatError(self.name, "has only blank lines and comments", offset=0)
        self._header = [name.strip().lower() for name in header]
        self._check_header(line)

    def samples(self) -> Iterator[source.Samples]:
        """Yield attitude, position, UTC and, if the table has them, rates, in batches of some thousands of rows.

        Raises LogFormatError if a row has too few or too many cells, or a cell is invalid.
        """
        chosen = {boot.number for boot in self.boots()}
        for part in self._parts:
            if part.boot in chosen:
                yield from (self._noted(replace(batch, boot=part.boot)) for batch in part.samples)

    def _noted(self, batch: source.Samples) -> source.Samples:
        """Return a batch with a remark on rows that were left out."""
        if not self._dropped or not isinstance(batch, source.AttitudeSamples):
            return batch
        return replace(batch, notes=(left_out_rows(self._dropped),))

    def boots(self) -> tuple[source.Boot, ...]:
        """Return the parts of the table as boots, or the requested one.

        Raises LogFormatError if the table cannot be read, or has no such boot.
        """
        numbers = {part.boot for part in self._parts} or {1}
        return source.chosen_boots(self.name, [source.Boot(number) for number in sorted(numbers)], self._boot)

    @cached_property
    def _parts(self) -> "list[_Part]":
        parts: list[_Part] = []
        remaining = islice(csv_rows(self.name), 1, None)
        while batch := list(islice(remaining, ROWS_AT_ONCE)):
            self._add(parts, batch, remaining)
        parts = [part for part in parts if part.samples] or parts[:1]
        # Unsorted rows are one part.
        numbers = _numbered(parts) if len(parts) <= _MAX_PARTS else [1] * len(parts)
        for part, number in zip(parts, numbers, strict=True):
            part.boot = number
        return parts

    def _add(self, parts: "list[_Part]", batch: list[tuple[int, list[str]]], more: Iterator[object]) -> None:
        """Add rows; another part begins if time steps back or the header is repeated."""
        for again, group in groupby(batch, key=lambda row: [cell.strip().lower() for cell in row[1]] == self._header):
            if again:
                parts.append(_Part())
                continue
            lines, cells = zip(*group, strict=True)
            last = lines[-1] == batch[-1][0]
            complete = self._complete_rows(lines, cells, more if last else repeat(None))
            by_column = zip(*cells[:complete], strict=True) if complete else repeat(())
            columns = dict(zip(self._header, by_column, strict=False))
            utc_s = _Columns(self.name, lines[:complete], columns).utc_s()
            valid = valid_rows(utc_s)
            if not parts:
                valid &= ~in_first_second(utc_s)
            if not valid.all():
                kept = np.flatnonzero(valid).tolist()
                columns = {name: tuple(column[row] for row in kept) for name, column in columns.items()}
                lines, utc_s = tuple(lines[row] for row in kept), utc_s[valid]
                self._dropped += complete - len(kept)
                complete = len(kept)
            before_s = parts[-1].last_s if parts else nan
            step_s = np.diff(utc_s, prepend=before_s)
            jumps = np.flatnonzero((step_s < -_BACK_S) | (step_s > _SAME_FLIGHT_S)).tolist()
            if not parts:
                parts.append(_Part())
            for start, stop in pairwise([0, *jumps, complete]):
                if start in jumps:
                    parts.append(_Part())
                if start < stop:
                    cells_of_part = {name: column[start:stop] for name, column in columns.items()}
                    samples = _Columns(self.name, lines[start:stop], cells_of_part).samples()
                    parts[-1].add(utc_s[start:stop], list(samples))

    def facts(self, boots: Collection[int] = ()) -> source.LogFacts:  # noqa: ARG002 - all boots have one format
        """Return the format."""
        return source.LogFacts("CSV table")

    def close(self) -> None:
        """Do nothing: the file is only open while it is read."""

    def _check_header(self, line: int) -> None:
        def invalid(message: str) -> LogFormatError:
            return LogFormatError(self.name, f"line {line}: {message}", offset=line)

        def require(*names: str) -> None:
            for name in names:
                if name not in self._header:
                    raise invalid(f"no column {name}{_similar(name, self._header)}")

        columns = [name for name in self._header if name in _COLUMNS]
        header = textwrap.shorten(", ".join(name or "(nameless)" for name in self._header), 100, placeholder=" ...")
        if not columns:
            hint = "; say with --columns what they mean (glstar manual logs)" if len(self._header) > 1 else ""
            if count := numbers_without_header(" ".join(self._header)):
                tum = ": --columns tum, if it is a TUM trajectory" if count == _TUM_COLUMNS else " with --columns"
                raise invalid(f"no header but {count} numbers; say what they mean{tum} (glstar manual logs)")
            usual = "its header would name utc or utc_s, ..."
            raise invalid(f"no table of a flight: {usual}; this line has {header}{hint}")
        if repeated := [name for name in columns if columns.count(name) > 1]:
            raise invalid(f"column {repeated[0]} appears twice")
        if not any(name in columns for name in _TIMES):
            raise invalid(f"no column utc (ISO 8601) or utc_s{_similar('utc', self._header)}; it has {header}")
        euler, quaternion = (sum(name in columns for name in form) for form in (_EULER, _QUATERNION))
        if euler == 3 and quaternion == 4:
            raise invalid("attitude twice, as roll_deg, pitch_deg, yaw_deg and as qw, qx, qy, qz; leave one out")
        if euler == quaternion == 0:
            raise invalid(f"no attitude: neither roll_deg, pitch_deg, yaw_deg nor qw, qx, qy, qz; it has {header}")
        require(*(_EULER if euler / 3 >= quaternion / 4 else _QUATERNION))
        if any(name in columns for name in _PLACE):
            require(*_PLACE)
        if any(name in columns for name in _RATES):
            require(*_RATES)

    def _complete_rows(self, lines: Sequence[int], cells: Sequence[list[str]], more: Iterator[object]) -> int:
        """Return the number of complete rows of a batch; the last row of the table may be truncated."""
        width = len(self._header)
        if set(map(len, cells)) == {width}:
            return len(cells)
        row, count = next((row, len(fields)) for row, fields in enumerate(cells) if len(fields) != width)
        if count < width and row == len(cells) - 1 and next(more, None) is None:
            return row
        message = f"line {lines[row]}: {count} fields, where the header names {width}"
        raise LogFormatError(self.name, message, offset=lines[row])


@dataclass(slots=True)
class _Part:
    """Rows without a step back of the time."""

    boot: int = 1
    first_s: float = inf
    last_s: float = -inf
    samples: list[source.Samples] = field(default_factory=list)

    def add(self, utc_s: Float, samples: list[source.Samples]) -> None:
        self.first_s = min(self.first_s, float(utc_s.min()))
        self.last_s = max(self.last_s, float(utc_s.max()))
        self.samples += samples


def _numbered(parts: "Sequence[_Part]") -> list[int]:
    """Return the boot number of each part; parts that overlap or are separated by days get different numbers."""
    boots: list[list[_Part]] = []
    numbers = []
    for part in parts:
        free = (
            number
            for number, boot in enumerate(boots)
            if not any(other.first_s <= part.last_s and part.first_s <= other.last_s for other in boot)
            and any(max(other.first_s - part.last_s, part.first_s - other.last_s) <= _SAME_FLIGHT_S for other in boot)
        )
        number = next(free, len(boots))
        if number == len(boots):
            boots.append([])
        boots[number].append(part)
        numbers.append(number + 1)
    return numbers


@dataclass(frozen=True, slots=True)
class _Columns:
    """Rows of a table by column, as text."""

    name: str
    lines: tuple[int, ...]
    cells: dict[str, tuple[str, ...]]

    def samples(self) -> Iterator[source.Samples]:
        utc_s, q = self.utc_s(), self._q_body_ned()
        valid = np.isfinite(q).all(axis=-1)
        yield source.AttitudeSamples(utc_s[valid], q[valid], np.zeros(np.count_nonzero(valid), dtype=np.int64), "table")
        yield self._positions_of(utc_s)
        yield source.ClockSamples(utc_s, utc_s, "table")
        if set(_RATES) <= set(self.cells):
            yield self._rates(utc_s)

    def utc_s(self) -> Float:
        name = next(name for name in _TIMES if name in self.cells)
        utc_s = self._read(name, parse_utc if name == "utc" else float)
        plausible = (utc_s >= _YEAR_1972_S) & (utc_s < source.YEAR_2100_S)
        self._reject(name, ~plausible, "is no UTC between 1972 and 2100, in seconds since 1970")
        return utc_s

    def _q_body_ned(self) -> Float:
        if set(_EULER) <= set(self.cells):
            euler_deg = [self._number(name) for name in _EULER]
            for name, angle in zip(_EULER, euler_deg, strict=True):
                self._reject(name, np.isinf(angle), "is no angle")
            return quaternion_from_euler(*map(np.deg2rad, euler_deg))
        q = np.stack([self._number(name) for name in _QUATERNION], axis=-1)
        odd = np.abs(source.quaternion_lengths(q) - 1) > TABLE_UNIT_TOLERANCE
        self._reject("qw", odd, "begins a quaternion that is not of unit length")
        return q

    def _positions_of(self, utc_s: Float) -> source.PositionSamples:
        if not set(_PLACE) <= set(self.cells):
            return source.no_position_samples("no columns latitude_deg, longitude_deg")
        latitude_deg, longitude_deg = (self._number(name) for name in _PLACE)
        self._reject("latitude_deg", np.abs(latitude_deg) > 90, "is beyond a pole")
        self._reject("longitude_deg", np.abs(longitude_deg) > 360, "is more than a turn")
        height_m = self._number("height_m") if "height_m" in self.cells else np.zeros(utc_s.size)
        valid = np.isfinite(latitude_deg) & np.isfinite(longitude_deg)
        valid &= ~source.is_zero_position(latitude_deg, longitude_deg)
        return source.PositionSamples(
            utc_s[valid],
            np.deg2rad(latitude_deg[valid]),
            np.deg2rad(longitude_deg[valid]),
            np.nan_to_num(height_m[valid], posinf=0.0, neginf=0.0),
            "table" if valid.any() else "latitude_deg and longitude_deg are empty, or 0 as without a GPS fix",
        )

    def _rates(self, utc_s: Float) -> source.RateSamples:
        rate = np.deg2rad(np.stack([self._number(name) for name in _RATES], axis=-1))
        valid = np.isfinite(rate).all(axis=-1)
        too_fast = valid & ~source.valid_rates(rate)
        self._reject(_RATES[0], too_fast, "begins a turn faster than any gyro measures, 5000 deg/s")
        return source.RateSamples(utc_s[valid], rate[valid], "table")

    def _number(self, name: str) -> Float:
        """Return a column of numbers; NaN for empty cells."""
        try:
            return np.array(list(map(float, self.cells[name])))
        except ValueError:
            return self._read(name, lambda text: float(text) if text.strip() else nan)

    def _read(self, name: str, read: Callable[[str], float]) -> Float:
        """Convert a column cell by cell."""
        numbers = np.empty(len(self.lines))
        for row, text in enumerate(self.cells[name]):
            try:
                numbers[row] = read(text)
            except (ValueError, ConfigError) as error:
                expected = "an ISO 8601 time, such as 2024-03-10T11:00:00Z" if name == "utc" else "a number"
                hint = "; write decimals with a point" if name != "utc" and "," in text else ""
                raise self._error(row, name, f"{text.strip()[:40]!r} is not {expected}{hint}") from error
        return numbers

    def _reject(self, name: str, bad: NDArray[np.bool_], why: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise self._error(row, name, f"{self.cells[name][row].strip()} {why}")

    def _error(self, row: int, name: str, message: str) -> LogFormatError:
        line = self.lines[row]
        return LogFormatError(self.name, f"line {line}, column {name}: {message}", offset=line)


def _similar(name: str, header: list[str]) -> str:
    """Return a question with a similar column name; empty if there is none."""
    unknown = [column for column in header if column not in _COLUMNS]
    near = nearest_word(name, unknown, cutoff=0.5)
    return "" if near is None else f" (is it named {near!r}?)"
