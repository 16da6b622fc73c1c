"""The records of a DataFlash log as columns, one array a field.

A binary log is a sequence of records, each ``A3 95 type`` and a body whose layout is defined by a FMT record of the
same file.  NumPy locates the records, so that large logs are read fast.  pymavlink takes a quarter of a second to
import and is not used; the tests compare the letters of layouts, and every column of real logs, with it.
"""

import struct
from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float, Integer
from glstar.errors import LogFormatError
from glstar.telemetry.boots import within
from glstar.telemetry.source import Span

DATAFLASH_MAGIC = b"\xa3\x95\x80"


_HEAD1, _HEAD2, _FMT = DATAFLASH_MAGIC
_FMT_LAYOUT = struct.Struct("<BB4s16s64s")  # type, length, name, layout, columns
_HEAD_BYTES = 3
# The types of fields by their letters in a layout, as NumPy names them.
_TYPES = {
    **{letter: f"<{letter}" for letter in "bBhHiIfdqQ"},
    "g": "<e",
    "c": "<h",
    "C": "<H",
    "e": "<i",
    "E": "<I",
    "L": "<i",
    "M": "<b",
    "n": "S4",
    "N": "S16",
    "Z": "S64",
    "a": "S64",
}
# What whole numbers of scaled fields are divided by: correctly rounded, as a product with 1e-7 is not.
_DIVISORS = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
# The first record of a log file: the FMT record of FMT, 89 bytes long.
_LOG_HEAD = DATAFLASH_MAGIC + b"\x80\x59FMT\0"
# A log is searched in pieces of this size, to bound the memory.
_PIECE_BYTES = 1 << 24


class Records(Protocol):
    """The records of a DataFlash log, binary or text, as columns."""

    kind: str  # The kind of log, for messages
    end: int  # End of the last complete record: a byte, or a line, counted from the start
    unread_bytes: int  # Bytes of the file that belong to no record

    @property
    @abstractmethod
    def names(self) -> list[str]:
        """Names of the messages in the log, sorted."""

    @abstractmethod
    def __contains__(self, name: str) -> bool: ...

    @abstractmethod
    def count(self, name: str) -> int:
        """Return the number of complete records of a message."""

    @abstractmethod
    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message; empty if the log does not have it."""

    @abstractmethod
    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of all records of a message, scaled; None if a field is missing."""

    @abstractmethod
    def texts(self, name: str, field: str) -> list[str]:
        """Return a text field of all records of a message; empty if the log does not have it."""

    @abstractmethod
    def position(self, name: str) -> Integer:
        """Return the position of each record of a message in the file, increasing, comparable between messages."""

    @property
    @abstractmethod
    def heads(self) -> tuple[int, ...]:
        """The positions at which a log file begins: several in joined files."""

    @abstractmethod
    def alike(self, one: int, other: int) -> bool:
        """Return whether records at two positions have the same layouts."""

    @abstractmethod
    def only(self, spans: Sequence[Span]) -> "Records":
        """Return the records within some ranges of positions, as a log."""

    @abstractmethod
    def loss(self) -> str:
        """Return how much of the file could be read, to append to a message; empty if all of it."""

    @abstractmethod
    def close(self) -> None:
        """Close the file."""


def stamped(log: Records, name: str, *fields: str) -> tuple[Float, list[Float]] | None:
    """Return times since boot, s, and fields of the records of a message; None if a field or the time is missing."""
    # TimeMS in an old GPS record is the millisecond of the GPS week.
    for stamp, unit_s in (("TimeUS", 1e-6), ("T" if name.startswith("GPS") else "TimeMS", 1e-3)):
        if (columns := log.columns(name, stamp, *fields)) is not None:
            return columns[0] * unit_s, columns[1:]
    return None


def numbered(log: Records, name: str, field: str) -> Integer:
    """Return the lane or receiver of each record; older logs number the messages instead (XKQ2, GPS2)."""
    number = log.columns(name, field)
    if number is None:
        return np.zeros(log.count(name), dtype=np.int64)
    valid = np.isfinite(number[0]) & (np.abs(number[0]) < 256)  # other values are damage
    return np.where(valid, number[0], -1).astype(np.int64)


def nearest(times_s: Float, requested_s: Float) -> Integer:
    """Return the index of the nearest time for each requested time."""
    order = np.argsort(times_s, kind="stable")
    rising = times_s[order]
    after = np.searchsorted(rising, requested_s).clip(max=rising.size - 1)
    before = (after - 1).clip(min=0)
    return order[np.where(requested_s - rising[before] <= rising[after] - requested_s, before, after)]


class PartedRecords(Records):
    """The records of a file that has been read in parts, in each of which the layouts do not change.

    Each part has a `start`, and by name of the message its `layouts` and the records `found`.
    """

    _parts: list[Any]

    @property
    def names(self) -> list[str]:
        """Names of the messages in the log, sorted."""
        return sorted({name for part in self._parts for name in part.found})

    def __contains__(self, name: str) -> bool:
        return any(name in part.found for part in self._parts)

    def alike(self, one: int, other: int) -> bool:
        """Return whether the messages that occur at both positions have the same layouts."""
        first, second = (self._part_at(at).layouts for at in (one, other))
        return all(first[name] == second[name] for name in first.keys() & second.keys())

    def only(self, spans: Sequence[Span]) -> Self:
        """Return the records within some ranges of positions, as a log."""
        selected = copy(self)
        selected._parts = [part.only(spans) for part in self._parts]  # noqa: SLF001 - of its own class
        return selected

    def _part_at(self, position: int) -> Any:
        return self._parts[max(0, bisect_right(self._parts, position, key=lambda part: part.start) - 1)]

    def _layout(self, name: str) -> Any:
        """Return the first layout of a message."""
        return next(part.layouts[name] for part in self._parts if name in part.found)

    def _found(self, name: str) -> list[Any]:
        """Return the records of a message in its first layout, part by part."""
        layout = self._layout(name)
        return [part.found[name] for part in self._parts if name in part.found and part.layouts[name] == layout]


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A part of a binary file: layouts and positions of the records, by name."""

    start: int
    layouts: dict[str, "_Layout"]
    found: dict[str, Integer]

    def only(self, spans: Sequence[Span]) -> "_Part":
        found = {name: at[within(at, spans)] for name, at in self.found.items()}
        return _Part(self.start, self.layouts, {name: at for name, at in found.items() if at.size})


class BinaryRecords(PartedRecords):
    """The records of a binary DataFlash file.

    If the layout of a message changes within the file, only the records of its first layout are returned; `only`
    selects a part of the file.
    """

    kind = "ArduPilot DataFlash"

    def __init__(self, path: str) -> None:
        self._raw: NDArray[np.uint8] = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
        self._file_bytes = int(self._raw.size)
        heads = _heads(self._raw)
        starts, tables = self._definitions(heads[self._raw[heads + 2] == _FMT])
        self._parts = []
        self._latest: tuple[str, NDArray[np.void]] | None = None
        self.end = record_bytes = 0
        for start, stop, table in zip(starts, [*starts[1:], self._file_bytes], tables, strict=True):
            inside = heads[np.searchsorted(heads, start) : np.searchsorted(heads, stop)]
            kinds = self._raw[inside + 2]
            lengths = np.zeros(256, dtype=np.int64)
            for kind, layout in table.items():
                lengths[kind] = layout.length
            offsets, kinds = _complete(inside, kinds, lengths[kinds], stop)
            self.end = max(self.end, int(np.max(offsets + lengths[kinds], initial=0)))
            record_bytes += int(lengths[kinds].sum())
            # The last definition of a name is used, as in pymavlink.
            named = {layout.name: kind for kind, layout in table.items()}
            positions = {name: at for name, kind in named.items() if (at := offsets[kinds == kind]).size}
            self._parts.append(_Part(start, {name: table[named[name]] for name in named}, positions))
        self.unread_bytes = self._file_bytes - record_bytes
        if not any(part.found for part in self._parts):
            raise LogFormatError(
                path,
                f"no whole record in {self._file_bytes} bytes: the log is cut off or damaged; copy it again",
                offset=0,
            )

    def count(self, name: str) -> int:
        """Return the number of complete records of a message."""
        return int(self.position(name).size)

    def loss(self) -> str:
        """Return how much of the file could be read, to append to a message; empty if all of it."""
        return "" if self.end == self._file_bytes else f" in {self.end} whole bytes of {self._file_bytes}"

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message; empty if the log does not have it."""
        names: tuple[str, ...] | None = self._layout(name).dtype.names if name in self else None
        return names or ()

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of all records of a message, scaled; None if a field is missing."""
        if not set(fields) <= set(self.fields(name)) or name not in self:
            return None
        layout, records = self._layout(name), self._records(name)
        if any(records.dtype[field].kind not in "iuf" for field in fields):
            return None
        with np.errstate(invalid="ignore"):  # damaged floats may be signalling NaNs
            return [records[field].astype(np.float64) / layout.divisors.get(field, 1.0) for field in fields]

    def texts(self, name: str, field: str) -> list[str]:
        """Return a text field of all records of a message; empty if the log does not have it."""
        if field not in self.fields(name):
            return []
        column = self._records(name)[field]
        if column.dtype.kind != "S":
            return []
        return [text.split(b"\0")[0].decode(errors="replace") for text in column.tolist()]

    def position(self, name: str) -> Integer:
        """Return the offset of each record of a message, bytes."""
        if name not in self:
            return np.empty(0, dtype=np.int64)
        return np.concatenate(self._found(name))

    @property
    def heads(self) -> tuple[int, ...]:
        """The offsets at which a log file begins."""
        return tuple(part.start for part in self._parts if self._begins_log(part.start))

    def only(self, spans: Sequence[Span]) -> Self:
        """Return the records within some ranges of offsets, as a log."""
        selected = super().only(spans)
        selected._latest = None  # noqa: SLF001 - of its own class
        return selected

    def close(self) -> None:
        """Close the file."""
        self._raw, self._latest = np.empty(0, dtype=np.uint8), None

    def _begins_log(self, at: int) -> bool:
        """Return whether a log file begins at an offset."""
        return self._raw[at : at + len(_LOG_HEAD)].tobytes() == _LOG_HEAD

    def _records(self, name: str) -> NDArray[np.void]:
        # Columns of one message are read one after another: its records are copied out of the file once.
        if self._latest is None or self._latest[0] != name:
            layout = self._layout(name)
            bodies = np.lib.stride_tricks.sliding_window_view(self._raw, layout.length)[self.position(name)]
            self._latest = name, np.ascontiguousarray(bodies[:, _HEAD_BYTES:]).view(layout.dtype)[:, 0]
        return self._latest[1]

    def _definitions(self, heads: Integer) -> tuple[list[int], list[dict[int, "_Layout"]]]:
        """Return the offsets from which layouts are valid, and the layouts by message number.

        A definition also applies to records before it, unless it contradicts another one or a log file begins in
        between.
        """
        starts: list[int] = [0]
        tables: list[dict[int, _Layout]] = [{}]
        read = lru_cache(maxsize=None)(_Layout.of)  # a log of many flights repeats its definitions
        for head in heads.tolist():
            body = self._raw[head + _HEAD_BYTES : head + _HEAD_BYTES + _FMT_LAYOUT.size].tobytes()
            if len(body) < _FMT_LAYOUT.size or (layout := read(body)) is None:
                continue
            kind, table = body[0], tables[-1]
            if head > 0 and kind == _FMT and self._begins_log(head):
                starts.append(head)
                tables.append({kind: layout})
            elif table.get(kind, layout) != layout:
                starts.append(head)
                tables.append({**table, kind: layout})
            else:
                table[kind] = layout
        return starts, tables


def _heads(raw: NDArray[np.uint8]) -> Integer:
    """Return the offsets of the two bytes with which a record begins."""
    last = raw.size - 2  # and one more byte, the message number
    pieces = [
        np.flatnonzero(raw[start : min(start + _PIECE_BYTES, last)] == _HEAD1) + start
        for start in range(0, last, _PIECE_BYTES)
    ]
    heads = np.concatenate([np.empty(0, dtype=np.int64), *pieces])
    begins: NDArray[np.bool_] = raw[heads + 1] == _HEAD2
    return heads[begins]


def _complete(
    heads: Integer, kinds: NDArray[np.uint8], lengths: Integer, file_bytes: int
) -> tuple[Integer, NDArray[Any]]:
    """Return offsets and message numbers of the heads of complete records.

    The two bytes of a head also occur within records, and the file may be damaged anywhere.  A head is valid if another
    head, or the end of the file, follows right after its record, and if it is not within a valid record.  A record that
    nothing follows may be the first half of one record and the second half of another.
    """
    ends = heads + lengths
    # The last record may be followed by one or two bytes of a truncated one.
    linked = (lengths > 0) & (ends <= file_bytes) & (_among(ends, heads) | (ends >= file_bytes - 2))
    heads, kinds, ends = heads[linked], kinds[linked], ends[linked]

    record = np.ones(heads.size, dtype=bool)
    for index in np.flatnonzero(heads[1:] < ends[:-1]):
        if record[index]:
            record[index + 1 : np.searchsorted(heads, ends[index])] = False
    return heads[record], kinds[record]


def _among(values: Integer, rising: Integer) -> NDArray[np.bool_]:
    """Return which values occur in a sorted array."""
    among: NDArray[np.bool_] = np.append(rising, -1)[np.searchsorted(rising, values)] == values
    return among


@dataclass(frozen=True, slots=True)
class _Layout:
    """The layout of the records of one message, from its FMT record."""

    name: str
    length: int  # Bytes, with the head
    dtype: np.dtype[np.void]
    divisors: dict[str, float]  # Of fields that are scaled

    @classmethod
    def of(cls, body: bytes) -> "_Layout | None":
        """Return the layout of a FMT record; None if it is invalid."""
        _, length, *texts = _FMT_LAYOUT.unpack(body)
        try:
            name, letters, fields = (text.split(b"\0")[0].decode("ascii") for text in texts)
        except UnicodeDecodeError:
            return None
        columns = fields.split(",") if fields else []
        codes = [_TYPES[letter] for letter in letters if letter in _TYPES]
        if not len(codes) == len(letters) == len(columns) == len(set(columns)) or "" in columns:
            return None
        dtype = np.dtype(list(zip(columns, codes, strict=True)))
        if not name.isalnum() or dtype.itemsize + _HEAD_BYTES != length:
            return None
        divisors = {column: _DIVISORS[of] for column, of in zip(columns, letters, strict=True) if of in _DIVISORS}
        return cls(name, length, dtype, divisors)
