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
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Self

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.telemetry.dataflash.records import Records

__all__ = ["TextRecords", "is_dataflash_text"]

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

_DEFINITION = re.compile(rb"^FMT\s*,\s*\d+\s*,\s*\d+\s*,", re.MULTILINE)
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
        self._layouts: dict[str, _Layout] = {"FMT": _OF_DEFINITIONS}
        found: dict[str, list[Integer]] = defaultdict(list)
        self._line_count = self.end = 0
        for lines in _pieces(self._text):
            # A definition stands before what it defines, and a later one of a name counts.
            for name, layout in self._definitions(lines):
                if self._layouts.get(name) != layout:
                    self._layouts[name] = layout
                    found.pop(name, None)
            for name, layout in self._layouts.items():
                if (whole := lines.whole(name, layout)).size:
                    found[name].append(np.stack([lines.start[whole], lines.stop[whole]]))
                    self.end = max(self.end, self._line_count + int(lines.number[whole[-1]]))
            self._line_count += lines.count
        self._spans = {name: np.concatenate(parts, axis=1) for name, parts in found.items()}
        if not self._spans:
            self.close()
            raise LogFormatError(
                path, f"no whole record in {self._line_count} lines: the log is cut off or damaged", offset=0
            )

    @property
    def names(self) -> list[str]:
        """The messages of which there are records, sorted."""
        return sorted(self._spans)

    def __contains__(self, name: str) -> bool:
        return name in self._spans

    def count(self, name: str) -> int:
        """Return how many whole records of a message there are."""
        return int(self._spans[name].shape[1])

    def loss(self) -> str:
        """Return what part of the file is whole, in words to follow others; nothing where all is."""
        return "" if self.end == self._line_count else f" in {self.end} lines of {self._line_count}"

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message, none where the log does not have it."""
        return self._layouts[name].fields if name in self else ()

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
        layout = self._layouts[name]
        at = [layout.fields.index(field) for field in fields]
        return [place + 1 for place in at] if {layout.letters[place] for place in at} <= letters else None

    def _cells(self, name: str, at: list[int]) -> Iterator[tuple[bytes, ...]]:
        """Yield some cells of each line of a message."""
        pick = itemgetter(*at) if len(at) > 1 else lambda cells: (cells[at[0]],)
        splits, text = len(self.fields(name)), self._text
        for start, stop in zip(*self._spans[name].tolist(), strict=True):
            yield pick(text[start:stop].split(b",", splits))

    def _definitions(self, lines: "_Lines") -> Iterator[tuple[str, _Layout]]:
        for line in lines.whole("FMT", _OF_DEFINITIONS).tolist():
            cells = self._text[int(lines.start[line]) : int(lines.stop[line])].split(b",", 5)
            name, letters, fields = (cell.decode(errors="replace").strip(_PADDING) for cell in cells[3:])
            layout = _Layout(tuple(field.strip(_PADDING) for field in fields.split(",")), letters)
            sensible = len(layout.fields) == len(letters) == len(set(layout.fields)) and "" not in layout.fields
            if sensible and name.isalnum() and len(name.encode()) <= _NAME_BYTES and name != "FMT":
                yield name, layout


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Those lines of a piece of text that may be records: a short name and a comma, and what follows.

    Attributes
    ----------
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
        return cls(start + at, stop[may_be] + at, name, commas[may_be], may_be + 1, stop.size)

    def whole(self, name: str, layout: _Layout) -> Integer:
        """Return which of the lines are whole records of a message."""
        fields = len(layout.fields)
        enough = self.commas >= fields if layout.letters[-1] in _TEXTS else self.commas == fields
        return np.flatnonzero((self.name == _code(name)) & enough)


def _pieces(text: mmap.mmap) -> Iterator[_Lines]:
    """Yield the lines of a text, piece by piece; what follows the last line's end may be cut off inside of a number."""
    at = len(_BOM) if text[: len(_BOM)] == _BOM else 0
    while at < len(text):
        piece = text[at : at + _PIECE_BYTES]
        size = piece.rfind(b"\n") + 1
        if size:
            yield _Lines.of(np.frombuffer(piece, dtype=np.uint8)[:size], at)
            at += size
        else:  # a line as long as this is no record
            at = text.find(b"\n", at) + 1 or len(text)


def _code(name: str) -> int:
    """Return the name of a message as a number."""
    return int.from_bytes(name.encode(), "little")


def _number(cell: bytes) -> float:
    """Return what a cell holds, NaN where it is no number."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")
