"""The records of a DataFlash log as text, a line each.

::

    FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
    FMT, 130, 45, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T
    GPS, 3, 130040903, 1769, 10, 0.00, -35.3547178, 149.1696673, 885.52, 870.45, 24.56, 321.44, 2.450000, 127615

The autopilot's console wrote such logs until about 2015; ground stations still convert binary logs to them.  Values are
in degrees and metres, not the integers of the binary log: fields of the types ``c``, ``C``, ``e``, ``E`` are already
divided by 100 and ``L`` by 1e7, as pymavlink also assumes.  (An error of the console cannot be detected: between 0 and
1 degree south or west it lost the sign.)  Floats have six decimals, an error of at most 0.4" in a quaternion.

A console may print banners and blank lines before the first record, a file may be truncated, lines may be damaged.  A
line is a record if a FMT line defines its name and its number of fields.
"""

import mmap
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.telemetry.boots import within
from glstar.telemetry.dataflash.records import PartedRecords
from glstar.telemetry.source import Span

_DEFINITION = re.compile(rb"^FMT\s*,\s*\d+\s*,\s*\d+\s*,", re.MULTILINE)
# The first line of a log: the FMT line of FMT.
_LOG_HEAD = re.compile(rb"(?:\xef\xbb\xbf)?FMT[ \t]*,[ \t]*128[ \t]*,[ \t]*89[ \t]*,[ \t]*FMT[ \t]*,")
_BOM = b"\xef\xbb\xbf"
_LINE_END, _COMMA = b"\n,"
_PADDING = " \t\r\0"
_NAME_BYTES = 4  # FMT gives a name four bytes
_NUMBERS, _TEXTS = frozenset("bBhHiIqQfdgcCeEL"), frozenset("nNZ")
_PIECE_BYTES = 1 << 22
# Larger numbers are damaged; their squares could overflow.
_LARGEST = 1e19


def is_dataflash_text(head: bytes) -> bool:
    """Return whether a file is a DataFlash log as text, by its first bytes, some thousands."""
    return _DEFINITION.search(head.removeprefix(_BOM)) is not None


@dataclass(frozen=True, slots=True)
class _Layout:
    """Names and type letters of the fields of a message."""

    fields: tuple[str, ...]
    letters: str


_OF_DEFINITIONS = _Layout(("Type", "Length", "Name", "Format", "Columns"), "BBnNZ")


class TextRecords(PartedRecords):
    """The records of a DataFlash log as text; raises LogFormatError if it holds no complete record."""

    kind = "ArduPilot DataFlash as text"

    def __init__(self, path: str) -> None:
        with Path(path).open("rb") as file:
            self._text = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._heads = tuple(head.start() for head in _LOG_HEAD.finditer(self._text) if head.start() > 0)
        self._line_count = self.end = 0
        parts = [_Part(0)]
        for lines in _pieces(self._text, self._heads):
            if lines.at in self._heads:
                parts.append(_Part(lines.at))
            # A FMT line precedes the lines that it defines.
            for at, name, layout in self._definitions(lines):
                if parts[-1].layouts.get(name, layout) != layout:
                    parts.append(_Part(at, parts[-1].layouts.copy()))
                parts[-1].layouts[name] = layout
            for number, part in enumerate(parts):
                stop = parts[number + 1].start if number + 1 < len(parts) else len(self._text)
                if stop > lines.at and (last := part.take(lines, stop)):
                    self.end = max(self.end, self._line_count + last)
            self._line_count += lines.count
        self._parts = [part for part in parts if part.found]
        self.unread_bytes = len(self._text) - sum(part.line_bytes for part in self._parts)
        if not self._parts:
            self.close()
            message = f"no whole record in {self._line_count} lines: the log is cut off or damaged; copy it again"
            raise LogFormatError(path, message, offset=0)

    def count(self, name: str) -> int:
        """Return the number of complete records of a message."""
        return int(self._spans(name).shape[1])

    def position(self, name: str) -> Integer:
        """Return the offset of the line of each record of a message, bytes."""
        starts: Integer = self._spans(name)[0]
        return starts

    @property
    def heads(self) -> tuple[int, ...]:
        """The offsets at which another log begins in the file, bytes."""
        return self._heads

    def loss(self) -> str:
        """Return how much of the file could be read, to append to a message; empty if all of it."""
        return "" if self.end == self._line_count else f" in {self.end} lines of {self._line_count}"

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message; empty if the log does not have it."""
        fields: tuple[str, ...] = self._layout(name).fields if name in self else ()
        return fields

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of all records of a message, scaled; None if a field is missing."""
        at = self._positions_of(name, fields, _NUMBERS)
        if at is None:
            return None
        numbers = array("d")
        for cells in self._cells(name, at):
            try:
                numbers.extend(tuple(map(float, cells)))
            except ValueError:
                numbers.extend(map(_number, cells))
        table = np.frombuffer(numbers, dtype=np.float64).reshape(-1, len(at)).T.copy()
        table[~(np.abs(table) < _LARGEST)] = np.nan
        return list(table)

    def texts(self, name: str, field: str) -> list[str]:
        """Return a text field of all records of a message; empty if the log does not have it."""
        at = self._positions_of(name, (field,), _TEXTS)
        if at is None:
            return []
        return [cells[0].decode(errors="replace").strip(_PADDING) for cells in self._cells(name, at)]

    def close(self) -> None:
        """Close the file."""
        self._text.close()

    def _positions_of(self, name: str, fields: tuple[str, ...], letters: frozenset[str]) -> list[int] | None:
        """Return the indices of the cells with some fields of a message; None if one is missing or of another type."""
        if not set(fields) <= set(self.fields(name)) or name not in self:
            return None
        layout: _Layout = self._layout(name)
        at = [layout.fields.index(field) for field in fields]
        return [index + 1 for index in at] if {layout.letters[index] for index in at} <= letters else None

    def _cells(self, name: str, at: list[int]) -> Iterator[tuple[bytes, ...]]:
        """Yield some cells of each line of a message."""
        pick = itemgetter(*at) if len(at) > 1 else lambda cells: (cells[at[0]],)
        splits, text = len(self.fields(name)), self._text
        for start, stop in zip(*self._spans(name).tolist(), strict=True):
            yield pick(text[start:stop].split(b",", splits))

    def _spans(self, name: str) -> Integer:
        """Return begin and end of the records of a message in its first layout, (2, n)."""
        if name not in self:
            return np.empty((2, 0), dtype=np.int64)
        return np.concatenate([spans for part in self._found(name) for spans in part], axis=1)

    def _definitions(self, lines: "_Lines") -> Iterator[tuple[int, str, _Layout]]:
        for line in lines.complete("FMT", _OF_DEFINITIONS).tolist():
            cells = self._text[int(lines.start[line]) : int(lines.stop[line])].split(b",", 5)
            name, letters, fields = (cell.decode(errors="replace").strip(_PADDING) for cell in cells[3:])
            layout = _Layout(tuple(field.strip(_PADDING) for field in fields.split(",")), letters)
            sensible = len(layout.fields) == len(letters) == len(set(layout.fields)) and "" not in layout.fields
            if sensible and name.isalnum() and len(name.encode()) <= _NAME_BYTES and name != "FMT":
                yield int(lines.start[line]), name, layout


@dataclass(slots=True, eq=False)
class _Part:
    """A part of a file in which the layouts do not change: layouts and records, by name."""

    start: int
    layouts: dict[str, _Layout] = field(default_factory=lambda: {"FMT": _OF_DEFINITIONS})
    found: dict[str, list[Integer]] = field(default_factory=dict)  # (2, n): begin and end of the records

    def take(self, lines: "_Lines", stop: int) -> int:
        """Add the lines before `stop` that are records of this part; return the number of the last one, or 0."""
        last = 0
        for name, layout in self.layouts.items():
            complete = lines.complete(name, layout)
            complete = complete[(lines.start[complete] >= self.start) & (lines.start[complete] < stop)]
            if complete.size:
                self.found.setdefault(name, []).append(np.stack([lines.start[complete], lines.stop[complete]]))
                last = max(last, int(lines.number[complete[-1]]))
        return last

    @property
    def line_bytes(self) -> int:
        """Length of all records, with the ends of their lines."""
        return sum(int((stop - start + 1).sum()) for parts in self.found.values() for start, stop in parts)

    def only(self, spans: Sequence[Span]) -> "_Part":
        found = {name: [part[:, within(part[0], spans)] for part in parts] for name, parts in self.found.items()}
        found = {name: parts for name, parts in found.items() if any(part.size for part in parts)}
        return _Part(self.start, self.layouts, found)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """The lines of a piece of text that may be records: they begin with a short name and a comma."""

    at: int  # Offset of the piece in the file
    start: Integer  # (n,) int64: offsets in the file, without the ends of lines
    stop: Integer
    name: Integer  # (n,) int64: their names, encoded by `_code`
    commas: Integer  # (n,) int64: number of commas
    number: Integer  # (n,) int64: their line numbers in the piece, from 1
    count: int  # Number of all lines in the piece

    @classmethod
    def of(cls, raw: NDArray[np.uint8], at: int) -> Self:
        """Return the lines of a piece at an offset of the file; the piece ends with the end of a line."""
        stop = np.flatnonzero(raw == _LINE_END)
        start = np.concatenate([[0], stop[:-1] + 1])
        comma = np.flatnonzero(raw == _COMMA)
        first = np.searchsorted(comma, start)
        commas = np.searchsorted(comma, stop) - first
        may_be = np.flatnonzero(commas)
        length = comma[first[may_be]] - start[may_be]
        may_be, length = (column[(length > 0) & (length <= _NAME_BYTES)] for column in (may_be, length))
        start = start[may_be]

        offsets = np.arange(_NAME_BYTES)
        letters = raw[(start[:, np.newaxis] + offsets).clip(max=raw.size - 1)].astype(np.int64)
        name = np.where(offsets < length[:, np.newaxis], letters, 0) @ (256**offsets)
        return cls(at, start + at, stop[may_be] + at, name, commas[may_be], may_be + 1, stop.size)

    def complete(self, name: str, layout: _Layout) -> Integer:
        """Return which of the lines are complete records of a message."""
        fields = len(layout.fields)
        enough = self.commas >= fields if layout.letters[-1] in _TEXTS else self.commas == fields
        return np.flatnonzero((self.name == _code(name)) & enough)


def _pieces(text: mmap.mmap, heads: Sequence[int]) -> Iterator[_Lines]:
    """Yield the lines of a text in pieces; no piece extends beyond the head of another log.

    The text after the last end of a line is dropped: it may be truncated within a number.
    """
    at = len(_BOM) if text[: len(_BOM)] == _BOM else 0
    bounds = [*(head for head in heads if head > at), len(text)]
    for bound in bounds:
        while at < bound:
            piece = text[at : min(at + _PIECE_BYTES, bound)]
            size = piece.rfind(b"\n") + 1
            if size:
                yield _Lines.of(np.frombuffer(piece, dtype=np.uint8)[:size], at)
                at += size
            else:  # a longer line is no record
                at = min(text.find(b"\n", at) + 1 or len(text), bound)


def _code(name: str) -> int:
    """Encode the name of a message as a number."""
    return int.from_bytes(name.encode(), "little")


def _number(cell: bytes) -> float:
    """Return the number in a cell; NaN if there is none."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")
