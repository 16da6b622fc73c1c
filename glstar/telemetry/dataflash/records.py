"""The records of a DataFlash log as columns, one array a field.

A binary log is a row of records, each ``A3 95 type`` and a body whose layout a FMT record of the same file has told.
pymavlink knows what the letters of a layout mean (`DFFormat`), and that is all that is asked of it: where the records
lie, NumPy finds out itself, and so nothing here hangs on pymavlink's inner tables or needs its slow path as a fallback.
The tests hold every column that glstar reads to pymavlink's own reader, on real logs.
"""

import io
import re
import struct
from abc import abstractmethod
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError
from glstar.telemetry.quiet import quiet

__all__ = ["DATAFLASH_MAGIC", "BinaryRecords", "Records", "nearest", "numbered", "stamped"]

DATAFLASH_MAGIC = b"\xa3\x95\x80"

Float = NDArray[np.float64]
Integer = NDArray[np.int64]

_HEAD1, _HEAD2, _FMT = DATAFLASH_MAGIC
_FMT_LAYOUT = struct.Struct("<BB4s16s64s")  # type, length, name, layout, columns
_HEAD_BYTES = 3
# A log is searched piece by piece: memory stays small, however long it is.
_PIECE_BYTES = 1 << 24


class Records(Protocol):
    """The records of a DataFlash log, binary or text, as columns.

    Attributes
    ----------
    kind : str
        What kind of log it is, in words.
    end : int
        Where the last whole record ends: a byte, or a line, counted from the start.
    """

    kind: str
    end: int

    @property
    @abstractmethod
    def names(self) -> list[str]:
        """The messages of which there are records, sorted."""

    @abstractmethod
    def __contains__(self, name: str) -> bool: ...

    @abstractmethod
    def count(self, name: str) -> int:
        """Return how many whole records of a message there are."""

    @abstractmethod
    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message, none where the log does not have it."""

    @abstractmethod
    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of every record of a message, scaled; None where the log does not have them all."""

    @abstractmethod
    def texts(self, name: str, field: str) -> list[str]:
        """Return a text field of every record of a message; nothing where the log does not have it."""

    @abstractmethod
    def loss(self) -> str:
        """Return what part of the file is whole, in words to follow others; nothing where all is."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the file."""


def stamped(log: Records, name: str, *fields: str) -> tuple[Float, list[Float]] | None:
    """Return when the records of a message were written, s since boot, and fields of them.

    None where the log does not have them all, or they bear no time since boot.
    """
    # The TimeMS of an old GPS record is the millisecond of the GPS week.
    for stamp, unit_s in (("TimeUS", 1e-6), ("T" if name.startswith("GPS") else "TimeMS", 1e-3)):
        if (columns := log.columns(name, stamp, *fields)) is not None:
            return columns[0] * unit_s, columns[1:]
    return None


def numbered(log: Records, name: str, field: str) -> Integer:
    """Return which lane or receiver each record is of; older logs number the messages instead (XKQ2, GPS2)."""
    number = log.columns(name, field)
    if number is None:
        return np.zeros(log.count(name), dtype=np.int64)
    known = np.isfinite(number[0]) & (np.abs(number[0]) < 256)  # what is no byte is damaged
    return np.where(known, number[0], -1).astype(np.int64)


def nearest(times_s: Float, asked_s: Float) -> Integer:
    """Return the index of the time nearest to each one asked for."""
    order = np.argsort(times_s, kind="stable")
    rising = times_s[order]
    after = np.searchsorted(rising, asked_s).clip(max=rising.size - 1)
    before = (after - 1).clip(min=0)
    return order[np.where(asked_s - rising[before] <= rising[after] - asked_s, before, after)]


class BinaryRecords(Records):
    """The records of a binary DataFlash file."""

    kind = "ArduPilot DataFlash"

    def __init__(self, path: str) -> None:
        self._raw: NDArray[np.uint8] = np.asarray(np.memmap(path, dtype=np.uint8, mode="r"))
        self._file_bytes = int(self._raw.size)
        heads = _heads(self._raw)
        kinds = self._raw[heads + 2]
        self._formats = self._definitions(heads[kinds == _FMT])
        lengths = np.zeros(256, dtype=np.int64)
        for kind, layout in self._formats.items():
            lengths[kind] = layout.length
        offsets, kinds = _whole(heads, kinds, lengths[kinds], self._file_bytes)
        self.end = int(np.max(offsets + lengths[kinds], initial=0))
        # Later definitions of a name count, as in pymavlink.
        named = {layout.name: kind for kind, layout in self._formats.items()}
        self._offsets = {name: at for name, kind in named.items() if (at := offsets[kinds == kind]).size}
        self._kinds = {name: named[name] for name in self._offsets}
        if not self._offsets:
            raise LogFormatError(
                path, f"no whole record in {self._file_bytes} bytes: the log is cut off or damaged", offset=0
            )

    @property
    def names(self) -> list[str]:
        """The messages of which there are records, sorted."""
        return sorted(self._offsets)

    def __contains__(self, name: str) -> bool:
        return name in self._offsets

    def count(self, name: str) -> int:
        """Return how many whole records of a message there are."""
        return int(self._offsets[name].size)

    def loss(self) -> str:
        """Return what part of the file is whole, in words to follow others; nothing where all is."""
        return "" if self.end == self._file_bytes else f" in {self.end} whole bytes of {self._file_bytes}"

    def fields(self, name: str) -> tuple[str, ...]:
        """Return the field names of a message, none where the log does not have it."""
        return self._formats[self._kinds[name]].dtype.names or () if name in self else ()

    def columns(self, name: str, *fields: str) -> list[Float] | None:
        """Return fields of every record of a message, scaled; None where the log does not have them all."""
        if not set(fields) <= set(self.fields(name)) or name not in self:
            return None
        layout, records = self._formats[self._kinds[name]], self._records(name)
        if any(records.dtype[field].kind not in "iuf" for field in fields):
            return None
        with np.errstate(invalid="ignore"):  # damaged floats may be signalling NaNs
            return [records[field].astype(np.float64) / layout.divisors.get(field, 1.0) for field in fields]

    def texts(self, name: str, field: str) -> list[str]:
        """Return a text field of every record of a message; nothing where the log does not have it."""
        if field not in self.fields(name):
            return []
        column = self._records(name)[field]
        if column.dtype.kind != "S":
            return []
        return [text.split(b"\0")[0].decode(errors="replace") for text in column.tolist()]

    def _records(self, name: str) -> NDArray[np.void]:
        layout = self._formats[self._kinds[name]]
        bodies = np.lib.stride_tricks.sliding_window_view(self._raw, layout.length)[self._offsets[name]]
        return np.ascontiguousarray(bodies[:, _HEAD_BYTES:]).view(layout.dtype)[:, 0]

    def close(self) -> None:
        """Let go of the file."""
        self._raw = np.empty(0, dtype=np.uint8)

    def _definitions(self, heads: Integer) -> dict[int, "_Layout"]:
        formats: dict[int, _Layout] = {}
        read = lru_cache(maxsize=None)(_Layout.of)  # a log of many flights repeats its definitions
        for head in heads:
            body = self._raw[head + _HEAD_BYTES : head + _HEAD_BYTES + _FMT_LAYOUT.size].tobytes()
            if len(body) == _FMT_LAYOUT.size and (layout := read(body)) is not None:
                formats[body[0]] = layout
        return formats


def _heads(raw: NDArray[np.uint8]) -> Integer:
    """Return where the two bytes with which a record begins stand."""
    last = raw.size - 2  # and one more byte, which says of what message it is
    pieces = [
        np.flatnonzero(raw[start : min(start + _PIECE_BYTES, last)] == _HEAD1) + start
        for start in range(0, last, _PIECE_BYTES)
    ]
    heads = np.concatenate([np.empty(0, dtype=np.int64), *pieces])
    begins: NDArray[np.bool_] = raw[heads + 1] == _HEAD2
    return heads[begins]


def _whole(heads: Integer, kinds: NDArray[np.uint8], lengths: Integer, file_bytes: int) -> tuple[Integer, NDArray[Any]]:
    """Return the offsets and kinds of the heads that begin a whole record.

    The head's two bytes also turn up inside of records, and the file may be damaged anywhere.  So a head counts where
    a record can be: another one ends just before it, or begins just after it.  From there records follow each other,
    and what begins inside of one is none.
    """
    ends = heads + lengths
    known = (lengths > 0) & (ends <= file_bytes)
    # Of what follows the last record a byte or two may be all there is.
    linked = known & (_among(ends, heads) | (ends > file_bytes - 2) | _among(heads, np.sort(ends[known])))
    heads, kinds, ends = heads[linked], kinds[linked], ends[linked]

    record = np.ones(heads.size, dtype=bool)
    for index in np.flatnonzero(heads[1:] < ends[:-1]):
        if record[index]:
            record[index + 1 : np.searchsorted(heads, ends[index])] = False
    return heads[record], kinds[record]


def _among(values: Integer, rising: Integer) -> NDArray[np.bool_]:
    """Return which values occur in a rising array."""
    found: NDArray[np.bool_] = np.append(rising, -1)[np.searchsorted(rising, values)] == values
    return found


@dataclass(frozen=True, slots=True)
class _Layout:
    """How the records of one message lie in the file, as their FMT record tells."""

    name: str
    length: int
    dtype: np.dtype[np.void]
    divisors: dict[str, float]

    @classmethod
    def of(cls, body: bytes) -> "_Layout | None":
        """Return the layout of a FMT record, None where it makes no sense."""
        kind, length, *texts = _FMT_LAYOUT.unpack(body)
        read = _dataflash_format()
        try:
            name, letters, fields = (text.split(b"\0")[0].decode("ascii") for text in texts)
            form = read(kind, name, length, letters, fields)
        except Exception:  # pymavlink raises no less: a damaged definition, and what it defines is unknown
            return None
        # struct says 16s and B where NumPy says S16 and <B.
        codes = [f"S{size}" if size else f"<{code}" for size, code in re.findall(r"(\d*)(\w)", form.msg_struct[1:])]
        if len(codes) != len(form.columns) or len(set(form.columns)) != len(codes) or "" in form.columns:
            return None
        dtype = np.dtype(list(zip(form.columns, codes, strict=True)))
        if not name.isalnum() or dtype.itemsize + _HEAD_BYTES != length:
            return None
        # Divided by 1e7, not multiplied by 1e-7: the nearest float64 to what was meant, as in pymavlink.
        divisors = {c: float(round(1 / m)) for c, m in zip(form.columns, form.msg_mults, strict=True) if m}
        return cls(name, length, dtype, divisors)


@lru_cache(maxsize=1)
def _dataflash_format() -> Callable[..., Any]:
    """Return pymavlink's reading of FMT records, imported on first use."""
    with quiet():
        from pymavlink.DFReader import DFFormat  # noqa: PLC0415

    def silent(*fields: Any) -> Any:
        # It prints what it does not understand.
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            return DFFormat(*fields)

    return silent
