"""The records of a DataFlash log as text, a line each.

::

    FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
    FMT, 130, 45, GPS, BIHBcLLeeEefI, Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T
    GPS, 3, 130040903, 1769, 10, 0.00, -35.3547178, 149.1696673, 885.52, 870.45, 24.56, 321.44, 2.450000, 127615

The autopilot's own console wrote such logs until 2015 or so, and ground stations write them out of binary logs to this
day.  All write degrees and metres, not the integers of the binary log: the console's printer divides what is ``c``,
``C``, ``e``, ``E`` by a hundred and ``L`` by ten million, and so do they; pymavlink too takes the numbers as they
stand.  (One flaw of that printer cannot be seen: between 0 and 1 degree south or west it lost the sign.)  Floats have
six decimals: a quaternion so rounded is off by 0.4 arcseconds at most.

Consoles also print banners and blank lines before the first record; a file may be cut off, and lines damaged.  Of all
that a line counts whose name a FMT line has told, and which has as many fields as that line says.
"""

import mmap
import re
from array import array
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.telemetry.boots import within
from glstar.telemetry.dataflash.records import Records
from glstar.telemetry.source import Span

__all__ = ["TextRecords", "is_dataflash_text"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

_DEFINITION = re.compile(rb"^FMT\s*,\s*\d+\s*,\s*\d+\s*,", re.MULTILINE)
# The first line of a log: the definition of definitions.
_LOG_HEAD = re.compile(rb"(?:\xef\xbb\xbf)?FMT[ \t]*,[ \t]*128[ \t]*,[ \t]*89[ \t]*,[ \t]*FMT[ \t]*,")
_BOM = b"\xef\xbb\xbf"
_LINE_END, _COMMA = b"\n,"
_PADDING = " \t\r\0"
_NAME_BYTES = 4  # FMT gives a name four bytes
_NUMBERS, _TEXTS = frozenset("bBhHiIqQfdgcCeEL"), frozenset("nNZ")
_PIECE_BYTES = 1 << 22
# No number of a flight is larger; what is, is damaged, and its square no longer a number.
_LARGEST = 1e19


def is_dataflash_text(head: bytes) -> bool:
    """Return whether a file that begins so is a DataFlash log as text.

    Parameters
    ----------
    head : bytes
        The first bytes of the file, some thousands.

    Returns
    -------
    bool
    """
    return _DEFINITION.search(head.removeprefix(_BOM)) is not None


@dataclass(frozen=True, slots=True)
class _Layout:
    """What the fields of a message are called, and the letters that say what they hold."""

    fields: tuple[str, ...]
    letters: str


_OF_DEFINITIONS = _Layout(("Type", "Length", "Name", "Format", "Columns"), "BBnNZ")


class TextRecords(Records):
    """The records of a DataFlash log as text.

    Parameters
    ----------
    path : str
        The log.

    Raises
    ------
    LogFormatError
        If it holds no whole record.
    """

    kind = "ArduPilot DataFlash as text"

    def __init__(self, path: str) -> None:
        with open(path, "rb") as file:  # noqa: PTH123
            self._text = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._heads = tuple(head.start() for head in _LOG_HEAD.finditer(self._text) if head.start() > 0)
        self._line_count = self.end = 0
        parts = [_Part(0)]
        for lines in _pieces(self._text, self._heads):
            if lines.at in self._heads:
                parts.append(_Part(lines.at))
            # A definition stands before what it defines.
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
        if not self._parts:
            self.close()
            raise LogFormatError(
                path, f"no whole record in {self._line_count} lines: the log is cut off or damaged", offset=0
            )

    @property
    def names(self) -> list[str]:
        """The messages of which there are records, sorted."""
        return sorted({name for part in self._parts for name in part.found})

    def __contains__(self, name: str) -> bool:
        return any(name in part.found for part in self._parts)

    def count(self, name: str) -> int:
        """Return how many whole records of a message there are."""
        return int(self._spans(name).shape[1])

    def position(self, name: str) -> Integer:
        """Return where the line of each record of a message begins, bytes from the start."""
        begins: Integer = self._spans(name)[0]
        return begins

    @property
    def heads(self) -> tuple[int, ...]:
        """Where another log begins in the file, bytes from the start."""
        return self._heads

    def alike(self, one: int, other: int) -> bool:
        """Return whether the records at two places have the same layouts, so far as both have them."""
        first, second = (self._part_at(at).layouts for at in (one, other))
        return all(first[name] == second[name] for name in first.keys() & second.keys())

    def only(self, spans: Sequence[Span]) -> "TextRecords":
        """Return the records in some parts of the file, as a log."""
        some = copy(self)
        some._parts = [part.only(spans) for part in self._parts]  # noqa: SLF001 - of its own class
        return some

    def loss(self) -> str:
        """Return what part of the file is whole, in words to follow others; nothing where all is."""
        return "" if self.end == self._line_count else f" in {self.end} lines of {self._line_count}"

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message, none where the log does not have it."""
        return self._layout(name).fields if name in self else ()

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of every record of a message, scaled; None where the log does not have them all."""
        at = self._places(name, fields, _NUMBERS)
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
        """Return a text field of every record of a message; nothing where the log does not have it."""
        at = self._places(name, (field,), _TEXTS)
        if at is None:
            return []
        return [cells[0].decode(errors="replace").strip(_PADDING) for cells in self._cells(name, at)]

    def close(self) -> None:
        """Let go of the file."""
        self._text.close()

    def _places(self, name: str, fields: tuple[str, ...], letters: frozenset[str]) -> list[int] | None:
        """Return which cells of a message's lines hold some fields; None where it lacks one, or one holds else."""
        if not set(fields) <= set(self.fields(name)) or name not in self:
            return None
        layout = self._layout(name)
        at = [layout.fields.index(field) for field in fields]
        return [place + 1 for place in at] if {layout.letters[place] for place in at} <= letters else None

    def _cells(self, name: str, at: list[int]) -> Iterator[tuple[bytes, ...]]:
        """Yield some cells of each line of a message."""
        pick = itemgetter(*at) if len(at) > 1 else lambda cells: (cells[at[0]],)
        splits, text = len(self.fields(name)), self._text
        for start, stop in zip(*self._spans(name).tolist(), strict=True):
            yield pick(text[start:stop].split(b",", splits))

    def _part_at(self, offset: int) -> "_Part":
        return next((part for part in reversed(self._parts) if part.start <= offset), self._parts[0])

    def _layout(self, name: str) -> _Layout:
        return next(part.layouts[name] for part in self._parts if name in part.found)

    def _spans(self, name: str) -> Integer:
        """Return where the records of a message begin and end, of the first layout that it has, (2, n)."""
        if name not in self:
            return np.empty((2, 0), dtype=np.int64)
        layout = self._layout(name)
        same = [part for part in self._parts if name in part.found and part.layouts[name] == layout]
        return np.concatenate([spans for part in same for spans in part.found[name]], axis=1)

    def _definitions(self, lines: "_Lines") -> Iterator[tuple[int, str, _Layout]]:
        for line in lines.whole("FMT", _OF_DEFINITIONS).tolist():
            cells = self._text[int(lines.start[line]) : int(lines.stop[line])].split(b",", 5)
            name, letters, fields = (cell.decode(errors="replace").strip(_PADDING) for cell in cells[3:])
            layout = _Layout(tuple(field.strip(_PADDING) for field in fields.split(",")), letters)
            sensible = len(layout.fields) == len(letters) == len(set(layout.fields)) and "" not in layout.fields
            if sensible and name.isalnum() and len(name.encode()) <= _NAME_BYTES and name != "FMT":
                yield int(lines.start[line]), name, layout


@dataclass(slots=True, eq=False)
class _Part:
    """A part of a file whose records have one layout each: the layouts, and where the records begin and end."""

    start: int
    layouts: dict[str, _Layout] = field(default_factory=lambda: {"FMT": _OF_DEFINITIONS})
    found: dict[str, list[Integer]] = field(default_factory=dict)

    def take(self, lines: "_Lines", stop: int) -> int:
        """Take in what of some lines is of this part, which ends at some byte; return the last line's number, or 0."""
        last = 0
        for name, layout in self.layouts.items():
            whole = lines.whole(name, layout)
            whole = whole[(lines.start[whole] >= self.start) & (lines.start[whole] < stop)]
            if whole.size:
                self.found.setdefault(name, []).append(np.stack([lines.start[whole], lines.stop[whole]]))
                last = max(last, int(lines.number[whole[-1]]))
        return last

    def only(self, spans: Sequence[Span]) -> "_Part":
        found = {name: [one[:, within(one[0], spans)] for one in parts] for name, parts in self.found.items()}
        return _Part(self.start, self.layouts, {k: v for k, v in found.items() if any(one.size for one in v)})


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Those lines of a piece of text that may be records: a short name and a comma, and what follows.

    Attributes
    ----------
    at : int
        Where the piece begins in the file.
    start, stop : (n,) int64
        Where they lie in the file, without their ends.
    name : (n,) int64
        Their names, as `_code` has it.
    commas : (n,) int64
        How many they have.
    number : (n,) int64
        Which lines of the piece they are, from 1 on.
    count : int
        How many lines the piece has in all.
    """

    at: int
    start: Integer
    stop: Integer
    name: Integer
    commas: Integer
    number: Integer
    count: int

    @classmethod
    def of(cls, raw: NDArray[np.uint8], at: int) -> Self:
        """Return the lines of a piece that ends with a line's end, and begins at some byte of the file."""
        stop = np.flatnonzero(raw == _LINE_END)
        start = np.concatenate([[0], stop[:-1] + 1])
        comma = np.flatnonzero(raw == _COMMA)
        first = np.searchsorted(comma, start)
        commas = np.searchsorted(comma, stop) - first
        may_be = np.flatnonzero(commas)
        length = comma[first[may_be]] - start[may_be]
        may_be, length = (column[(length > 0) & (length <= _NAME_BYTES)] for column in (may_be, length))
        start = start[may_be]

        places = np.arange(_NAME_BYTES)
        letters = raw[(start[:, np.newaxis] + places).clip(max=raw.size - 1)].astype(np.int64)
        name = np.where(places < length[:, np.newaxis], letters, 0) @ (256**places)
        return cls(at, start + at, stop[may_be] + at, name, commas[may_be], may_be + 1, stop.size)

    def whole(self, name: str, layout: _Layout) -> Integer:
        """Return which of the lines are whole records of a message."""
        fields = len(layout.fields)
        enough = self.commas >= fields if layout.letters[-1] in _TEXTS else self.commas == fields
        return np.flatnonzero((self.name == _code(name)) & enough)


def _pieces(text: mmap.mmap, heads: Sequence[int]) -> Iterator[_Lines]:
    """Yield the lines of a text, piece by piece; no piece goes on beyond the head of another log.

    What follows the last line's end may be cut off inside of a number.
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
            else:  # a line as long as this is no record
                at = min(text.find(b"\n", at) + 1 or len(text), bound)


def _code(name: str) -> int:
    """Return the name of a message as a number."""
    return int.from_bytes(name.encode(), "little")


def _number(cell: bytes) -> float:
    """Return what a cell holds, NaN where it is no number."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")
