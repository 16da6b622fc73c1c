"""Files with tables: text, Apache Parquet and Excel.

`read_table` reads any of them at once, with any separator.  `csv_rows` reads a CSV file row by row, and `Dump` the
columns of a CSV file that a program exported from a log.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from itertools import chain, islice
from math import isfinite, nan
from pathlib import Path
from typing import Any, Literal, TextIO

import numpy as np
from numpy.typing import NDArray

from glstar.arrays import Float
from glstar.errors import ConfigError, LogFormatError, reading
from glstar.sky.place.timescale import parse_utc
from glstar.system.userinput import read_whole, refuse_more, refuse_repeated
from glstar.telemetry.tables import Cells, ParquetColumns, excel_rows

_SEPARATORS = ",;\t|"
# Cells without a value.
_EMPTY = {"", "nan", "na", "n/a", "none", "null", "-"}
# Longest header, bytes: blackbox and DJI tables have hundreds of columns.
_HEADER_BYTES = 65536
# Largest number of lines with settings before a header.
_PREAMBLE_LINES = 5000
# First bytes of an Excel workbook, and names of its first members.
_ZIP = b"PK\x03\x04"
_OFFICE_MARKS = (b"[Content_Types].xml", b"docProps/", b"xl/")
_PARQUET = b"PAR1"
# Units of times of NumPy, s.
_TIME_UNITS_S = {"D": 86400.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# A number that can only have a decimal comma: 1,024 may as well be a thousand.
_DECIMAL_COMMA = re.compile(r"[+-]?(0,\d+|\d+,(\d{1,2}|\d{4,})|\d{4,},\d+)")
# Largest deviation of the norm of a quaternion from 1, for components with two decimals.
TABLE_UNIT_TOLERANCE = 0.02
# Number of rows that are held as text before they are converted: numbers need a tenth of the memory.
ROWS_AT_ONCE = 1000
# First characters of a number or a time.
_NUMERIC = "0123456789+-."
# An item of a column with lists.
_LIST_ITEM = re.compile(r"(.+)\[(\d+)\]")
# 1,5 in a table with another separator.
_ANY_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
# Date and time of day as DJI's programs write them: 10/16/2024 or 2024-10-16, and 2:23:51.84 PM.
_TWELVE_HOURS = re.compile(
    r"((?P<american>\d{1,2}/\d{1,2}/\d{4})|(?P<iso>\d{4}[-/]\d{2}[-/]\d{2})) +(?P<hour>\d{1,2}):"
    r"(?P<minutes>\d{2}:\d{2})(?P<fraction>([.,]\d+)?) *(?P<half>[AaPp])\.?[Mm]\.?"
)


class TableKind(StrEnum):
    """Kind of a file with a table, as it is named in messages."""

    CSV = "CSV"
    PARQUET = "Parquet"
    EXCEL = "Excel"


@dataclass(frozen=True, slots=True)
class TableFile:
    """The content of a table."""

    name: str  # The file, for messages
    kind: TableKind
    columns: Mapping[str, Cells]  # Cells by column: text of a CSV file, otherwise numbers, times or text
    lines: NDArray[np.int64]  # (n,) int64: line, or row, of each cell, from 1
    header: Sequence[str] = ()  # Names of all columns, of which several may have one

    def numbers(self, column: str) -> Float:
        """Return a column of (n,) numbers; NaN for cells without a value.

        A leading minus sign of `column` changes the sign of the numbers, unless a column has that name.  Raises
        LogFormatError if a cell is no number.
        """
        if column not in self.columns and column.startswith("-"):
            return -self.numbers(column[1:])
        cells = self.cells(column)
        if isinstance(cells, np.ndarray) and cells.dtype.kind == "M" and cells.size:
            raise self.error(0, column, f"{str(cells[0])[:40]!r} is not a number")
        try:
            numbers = np.array(list(map(float, cells)) if self.kind is TableKind.CSV else cells, dtype=np.float64)
        except (ValueError, TypeError, OverflowError):
            point = "," if self.kind is TableKind.CSV and _has_decimal_commas(cells) else "."
            numbers = np.array([self._number(column, row, cell, point) for row, cell in enumerate(cells)])
        numbers[~np.isfinite(numbers)] = np.nan
        return numbers

    def times(self, column: str, date: str | None = None) -> Float:
        """Return a column of (n,) UTC, seconds since 1970; NaN for cells without a value.

        Times are ISO 8601 (slashes may separate the date), with AM or PM (after an ISO date, or month/day/year), or
        times of Parquet and Excel.  `date` is the column with the date, if it is not in `column`.  Raises
        LogFormatError if a cell is no time.
        """
        days = self.cells(date) if date is not None else [""] * len(self.lines)
        cells = self.cells(column)
        if isinstance(cells, np.ndarray) and cells.dtype.kind == "M":
            unit_s = _TIME_UNITS_S[np.datetime_data(cells.dtype)[0]]
            return np.where(np.isnat(cells), nan, cells.astype(np.int64) * unit_s)
        rows = enumerate(zip(days, cells, strict=True))
        return np.array([self._time(column, row, day, cell) for row, (day, cell) in rows])

    def cells(self, column: str) -> Cells:
        """Return the cells of a column; raises LogFormatError if several columns have its name."""
        with reading(self.name, LogFormatError):
            refuse_repeated(self.header, {column})
        return self.columns[column]

    def _number(self, column: str, row: int, cell: Any, point: str) -> float:
        text = "" if cell is None else str(cell).strip()
        if text.lower() in _EMPTY:
            return np.nan
        try:
            return float(text.replace(point, "."))
        except (ValueError, OverflowError):
            hint = "; write decimals with a point" if "," in text else ""
            raise self.error(row, column, f"{text[:40]!r} is not a number{hint}") from None

    def _time(self, column: str, row: int, day: Any, cell: Any) -> float:
        if isinstance(cell, datetime):
            return (cell if cell.tzinfo else cell.replace(tzinfo=UTC)).timestamp()
        text = f"{'' if day is None else day} {'' if cell is None else cell}".strip()
        if text.lower() in _EMPTY or text.startswith("0000"):
            return np.nan
        try:
            return parse_utc(_on_24_hours(text).replace("/", "-").removesuffix(" UTC"))
        except ConfigError:
            expected = "an ISO 8601 time, such as 2024-03-10T11:00:00Z, or as 3/10/2024 11:00:00.5 AM"
            raise self.error(row, column, f"{text[:40]!r} is not {expected}") from None

    def error(self, row: int, column: str, message: str) -> LogFormatError:
        """Return an error about the cell of a column in a row, from 0."""
        line = int(self.lines[row])
        return LogFormatError(self.name, f"line {line}, column {column}: {message}", offset=line)


def refuse_other_attitudes(name: str, attitude: str) -> None:
    """Raise LogFormatError if an attitude of a table is requested by name: a table has one attitude."""
    if attitude.lower() != "auto":
        raise LogFormatError(name, f"a table has one attitude, not {attitude!r}; leave attitude at 'auto'")


def _has_decimal_commas(cells: Cells) -> bool:
    """Return whether a column has decimal commas: 0,5 and 1,25 say so; where all are as 1,024 it may be thousands."""
    texts = [str(cell).strip() for cell in cells]
    return not any("." in text for text in texts) and any(_DECIMAL_COMMA.fullmatch(text) for text in texts)


def _on_24_hours(text: str) -> str:
    """Return a time with AM or PM as ISO 8601; any other text as it is."""
    parts = _TWELVE_HOURS.fullmatch(text)
    if parts is None or not 1 <= int(parts["hour"]) <= 12:
        return text
    month, day, year = (int(number) for number in (parts["american"] or "0/0/0").split("/"))
    date = parts["iso"] or f"{year:04d}-{month:02d}-{day:02d}"
    hour = int(parts["hour"]) % 12 + 12 * (parts["half"].lower() == "p")
    return f"{date} {hour:02d}:{parts['minutes']}{parts['fraction'].replace(',', '.')}"


def is_parquet(head: bytes) -> bool:
    """Return whether a file is an Apache Parquet table, by its first bytes."""
    return head.startswith(_PARQUET)


def is_office_file(head: bytes) -> bool:
    """Return whether a file is an Excel workbook, or another Office file, by its first bytes, some thousands."""
    return head.startswith(_ZIP) and any(mark in head for mark in _OFFICE_MARKS)


def table_header(head: bytes) -> tuple[str, ...]:
    """Return the header of a text table, from the first bytes of its file; empty if they are not text."""
    if b"\0" in head:
        return ()
    lines = _past_preamble(_lines(head.decode("utf-8-sig", errors="replace")))
    first = next(iter(lines), (0, ""))[1]
    return tuple(_cells(first, _separator(first)))


def read_table(path: str, names: Sequence[str] = ()) -> TableFile:
    """Return the columns of a text table, a Parquet file, or the first sheet of an Excel workbook.

    `names`: of the columns, if a text table has no header.  Raises LogFormatError if the file cannot be read, or a row
    has another number of cells than the header.
    """
    with Path(path).open("rb") as file:
        head = file.read(4096)
    if is_parquet(head):
        return _read_parquet(path)
    if is_office_file(head):
        return _read_excel(path)
    return _read_text(path, names)


def _lines(text: str) -> list[tuple[int, str]]:
    """Return numbered lines with content, the header first: a comment is a header if the first row has numbers."""
    lines: list[tuple[int, str]] = []
    comment: tuple[int, str] | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if not stripped or stripped.lower().startswith("sep="):
            continue
        if stripped.startswith("#"):
            comment = (number, stripped.lstrip("# ")) if not lines else comment
            continue
        if not lines and comment is not None and _names_columns(comment[1], stripped):
            lines.append(comment)
        lines.append((number, stripped))
    return lines


def _past_preamble(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return lines without those before the header that have a name and a value each."""
    if not lines or len(_cells(lines[0][1], _separator(lines[0][1]))) != 2:
        return lines
    separator = _separator(lines[0][1])
    wide = (k for k, (_, line) in enumerate(lines[:_PREAMBLE_LINES]) if len(_cells(line, separator)) > 3)
    return lines[next(wide, 0) :]


def is_preamble(header: Sequence[str]) -> bool:
    """Return whether the first line of a table begins the settings that Blackbox Explorer writes before its header."""
    return tuple(header) == ("fieldname", "fieldvalue")


def numbers_without_header(line: str) -> int:
    """Return how many numbers a first line has, which then is no header; 0 if it has other cells."""
    cells = _cells(line, _separator(line))
    return len(cells) if all(_is_number(cell) for cell in cells) else 0


def _names_columns(comment: str, row: str) -> bool:
    """Return whether a comment has as many names as the row after it has cells, which begin with a number."""
    names, cells = _cells(comment, _separator(comment)), _cells(row, _separator(row))
    return len(names) == len(cells) > 1 and all(not _is_number(name) for name in names) and _is_number(cells[0])


def _is_number(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


def _separator(line: str) -> str:
    """Return the separator of a header: the most frequent one of , ; tab and |, otherwise white space."""
    best = max(_SEPARATORS, key=line.count)
    # X-Plane has commas in its names: _real,_time | pitch,__deg |
    best = "|" if line.count("|") > 2 else best
    return best if best in line else " "


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    return cells[:-1] if separator == "|" and cells and not cells[-1] else cells


def _read_text(path: str, names: Sequence[str]) -> TableFile:
    content = read_whole(path)
    refuse_more("rows", content.count(b"\n"))
    if b"\0" in content[:_HEADER_BYTES]:
        raise LogFormatError(path, "is no table: it is not text", offset=0)
    lines = _past_preamble(_lines(content.decode("utf-8-sig", errors="replace")))
    if not lines:
        raise LogFormatError(path, "has only blank lines and comments", offset=0)
    separator = _separator(lines[0][1])
    header = _cells(lines[0][1], separator)
    refuse_more("columns", len(header))
    if names and all(_is_number(cell) for cell in header if cell):
        header, rows = list(names), lines
    else:
        rows = lines[1:]
    # A repeated header begins an appended table.
    rows = [(number, line) for number, line in rows if line != lines[0][1] or header == list(names)]
    cells = _split(path, rows, separator, len(header))
    numbers = np.array([number for number, _ in rows[: len(cells)]], dtype=np.int64)
    columns: list[Cells] = list(zip(*cells, strict=True)) if cells else [()] * len(header)
    return TableFile(path, TableKind.CSV, dict(zip(header, columns, strict=True)), numbers, header)


def _split(path: str, rows: list[tuple[int, str]], separator: str, width: int) -> list[list[str]]:
    """Return the cells of rows; an incomplete last row is dropped."""
    if separator in " |":
        cells = [_cells(line, separator) for _, line in rows]
    else:
        reader = csv.reader(io.StringIO("\n".join(line for _, line in rows)), delimiter=separator)
        cells = [[cell.strip() for cell in row] for row in reader]
        if len(cells) != len(rows):
            raise LogFormatError(path, "a quoted field runs over the end of its line", offset=0)
    for row, fields in enumerate(cells):
        # Some programs end each row with a separator.
        while len(fields) > width and not fields[-1]:
            fields.pop()
        if len(fields) != width:
            if row == len(cells) - 1 and len(fields) < width:
                return cells[:row]
            line, count = rows[row][0], len(fields)
            raise LogFormatError(path, f"line {line}: {count} fields, where the header names {width}", offset=line)
    return cells


def _read_parquet(path: str) -> TableFile:
    try:
        from pyarrow import parquet  # noqa: PLC0415 - an extra, 170 MB
    except ImportError:
        raise LogFormatError(path, "is an Apache Parquet table, which needs pyarrow: pip install pyarrow") from None
    with reading(path, LogFormatError, "cannot be read as Parquet"):
        with Path(path).open("rb") as file:
            schema = parquet.read_schema(file)
        # Text that repeats is kept once, however many rows have it.
        texts = [field.name for field in schema if str(field.type) in {"string", "large_string"}]
        table = parquet.ParquetFile(path, read_dictionary=texts)
        rows, names = table.metadata.num_rows, table.schema_arrow.names
        refuse_more("rows", rows)
        refuse_more("columns", len(names))
        lines = np.arange(1, rows + 1)
    return TableFile(path, TableKind.PARQUET, ParquetColumns(path, table, rows), lines, names)


def _read_excel(path: str) -> TableFile:
    try:
        import openpyxl  # noqa: F401, PLC0415 - an extra, when a workbook is read
    except ImportError:
        raise LogFormatError(path, "is an Excel workbook, which needs openpyxl: pip install openpyxl") from None
    with reading(path, LogFormatError, "cannot be read as an Excel workbook"):
        rows = list(excel_rows(path))
    if not rows:
        raise LogFormatError(path, "its first sheet is empty", offset=0)
    header = ["" if cell is None else str(cell).strip() for cell in rows[0][1]]
    width = len(header)
    # A row ends with its last cell, and a note beside the table is no part of it.
    cells = [(row + (None,) * width)[:width] for _, row in islice(rows, 1, None)]
    columns: list[Cells] = list(zip(*cells, strict=True)) if cells else [()] * width
    numbers = np.array([number for number, _ in rows[1:]], dtype=np.int64)
    named = {name: column for name, column in zip(header, columns, strict=True) if name}
    return TableFile(path, TableKind.EXCEL, named, numbers, header)


def csv_rows(name: str, *, delimiter: str | None = None, quoted: bool = True) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of all rows of a table, the header first.

    Blank lines and comment lines, which begin with ``#``, are skipped.  If the first row has numbers, the comment line
    before it is the header, as `numpy.savetxt` writes it.  The default delimiter is the one of comma, semicolon and tab
    that is most frequent in the header; `quoted`: whether cells may be quoted.  Raises LogFormatError if the file is
    not text, or not a table.
    """
    line = count = lines = 0
    comment = ""

    def texts(file: TextIO) -> Iterator[str]:
        nonlocal line, lines, comment
        for number, text in enumerate(file, start=1):
            stripped = text.lstrip()
            if not stripped or stripped[0] == "#":
                comment = stripped.lstrip("# ") or comment if lines == 0 else ""
                continue
            if lines == 0 and stripped[0] in _NUMERIC and _is_savetxt_header(comment, stripped):
                line, lines = number - 1, lines + 1
                yield comment
            if quoted and lines > count:
                raise LogFormatError(name, f"line {line}: a quoted field runs over its end", offset=line)
            line, lines = number, lines + 1
            yield text

    quoting: Literal[0, 3] = csv.QUOTE_MINIMAL if quoted else csv.QUOTE_NONE
    try:
        with Path(name).open(encoding="utf-8-sig") as file:
            source = texts(file)
            header = next(source, "")
            separator = delimiter or max(",;\t", key=header.count)
            for cells in csv.reader(chain([header], source), delimiter=separator, quoting=quoting, strict=True):
                count += 1
                yield line, cells
    except csv.Error as error:
        raise LogFormatError(name, f"line {line}: {error}", offset=line) from error
    except UnicodeDecodeError as error:
        after = f" after line {line}" if line else ""
        raise LogFormatError(name, f"is no text{after}: it is not UTF-8", offset=line) from error


def _is_savetxt_header(comment: str, row: str) -> bool:
    """Return whether a comment has as many names, which begin with letters, as the row after it has cells."""
    between = max(",;\t", key=comment.count)
    names = [name.strip() for name in comment.split(between)]
    return len(names) > 1 and len(names) == len(row.split(between)) and all(name[:1].isalpha() for name in names)


class Dump:
    """Columns of a CSV file that a program exported from a log; see `dump_separator`.

    `wanted`: names of the columns to read, if they exist; by default all.  ``name[0]`` is the first item of the lists
    in a column; mavlogdump writes a list as ``[1.0, 0.0]``, without quotes.  `texts`: name of a column that is kept as
    text, without quotes: the last column may contain separators.  Rows with another number of cells than the header are
    dropped.

    Attributes are `header`, and `line`, (n,) line numbers.  `columns` are (n,) by name, NaN where a cell is empty or no
    finite number; `texts` are cells of the text column that are not empty.  `heads` are lines at which the header is
    repeated, where another table was appended.
    """

    def __init__(self, name: str, wanted: Iterable[str] | None = None, *, texts: str | None = None) -> None:
        between = dump_separator(name)
        remaining = csv_rows(name, delimiter=between, quoted=False)
        header = next(remaining, (0, []))[1]
        self.header = tuple(cell.strip() for cell in header)
        needed = dict.fromkeys(wanted or self.header)
        with reading(name, LogFormatError):
            refuse_repeated(self.header, needed)
        every = {column: self._index(column) for column in needed}
        indices = {column: index for column, index in every.items() if index is not None}
        text_at = self.header.index(texts) if texts in self.header else None
        lines: list[Float] = []
        parts: dict[str, list[Float]] = {column: [] for column in indices}
        cells_of_texts: list[str] = []
        heads: list[int] = []
        last = len(header) - 1
        if any(item is not None for _, item in indices.values()):
            remaining = ((line, _with_lists(cells, len(header), between)) for line, cells in remaining)
        if text_at == last:
            remaining = ((line, _with_text(cells, last, between)) for line, cells in remaining)
        while batch := list(islice(remaining, ROWS_AT_ONCE)):
            heads += [line for line, cells in batch if cells == header]
            complete = [(line, cells) for line, cells in batch if len(cells) == len(self.header) and cells != header]
            lines.append(np.array([line for line, _ in complete], dtype=np.float64))
            if between != "," and complete:
                _refuse_decimal_commas(name, self.header, *complete[0])
            for column, (index, item) in indices.items():
                parts[column].append(_numbers([_item(cells[index], item) for _, cells in complete]))
            if text_at is not None:
                cells_of_texts += [cells[text_at] for _, cells in complete if cells[text_at]]
        self.line = np.concatenate(lines) if lines else np.empty(0)
        self.columns = {column: np.concatenate(part) if part else np.empty(0) for column, part in parts.items()}
        self.texts = tuple(cells_of_texts)
        self.heads = tuple(heads)

    def _index(self, name: str) -> tuple[int, int | None] | None:
        """Return the index of a column, and of the item in its lists for ``name[0]``; None if there is none."""
        if name in self.header:
            return self.header.index(name), None
        match = _LIST_ITEM.fullmatch(name)
        return (self.header.index(match[1]), int(match[2])) if match and match[1] in self.header else None

    def only(self, which: NDArray[np.bool_]) -> "Dump":
        """Return the rows for which (n,) `which` is True; a text column with empty cells remains unchanged."""
        subset = copy(self)
        subset.line = self.line[which]
        subset.columns = {name: column[which] for name, column in self.columns.items()}
        if len(self.texts) == self.line.size:
            subset.texts = tuple(self.texts[row] for row in np.flatnonzero(which))
        return subset


def csv_header(head: bytes) -> str:
    """Return the first line of a text file without a leading ``#``, from its first bytes; empty if it is not text."""
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().decode(errors="replace")
    return text.splitlines()[0].lstrip("# ") if text and b"\0" not in head else ""


def dump_separator(name: str) -> str:
    """Return the separator of a `Dump`: the character after ``timestamp``, the name of its first column."""
    with Path(name).open(encoding="utf-8-sig", errors="replace") as file:
        first = next((text for text in file if text.strip()), "").lstrip().lstrip("# ")
    after = first.removeprefix("timestamp")[:1]
    return after if after.strip() or after == "\t" else ","


def _refuse_decimal_commas(name: str, header: tuple[str, ...], line: int, cells: list[str]) -> None:
    """Raise an error if a number has a decimal comma."""
    for column, cell in zip(header, cells, strict=True):
        if _ANY_DECIMAL_COMMA.fullmatch(cell.strip()):
            raise LogFormatError(
                name, f"line {line}, column {column}: {cell.strip()!r} has a decimal comma; write decimals with a point"
            )


def _with_text(cells: list[str], last: int, between: str) -> list[str]:
    """Return a row with the excess cells joined to the last one, a text with separators."""
    return [*cells[:last], between.join(cells[last:])] if len(cells) > last else cells


def _with_lists(cells: list[str], width: int, between: str) -> list[str]:
    """Return a row that is wider than the header with the cells of a list, from ``[`` to ``]``, joined."""
    while len(cells) > width:
        start = next((k for k, cell in enumerate(cells) if cell.startswith("[") and not cell.endswith("]")), None)
        stop = next((k for k, cell in enumerate(cells) if cell.endswith("]") and start is not None and k > start), None)
        if start is None or stop is None:
            break
        cells = [*cells[:start], between.join(cells[start : stop + 1]), *cells[stop + 1 :]]
    return cells


def _item(cell: str, item: int | None) -> str:
    """Return an item of a cell with a list, or the cell itself if the item is None; empty if the list is too short."""
    if item is None:
        return cell
    items = cell.strip("[] ").split(",")
    return items[item].strip() if item < len(items) else ""


def _numbers(cells: Sequence[str]) -> Float:
    try:
        numbers = np.array(list(map(float, cells)))
    except ValueError:
        numbers = np.array([_number(cell) for cell in cells])
    numbers[np.isinf(numbers)] = nan
    return numbers


def _number(cell: str) -> float:
    try:
        return float(cell) if cell else nan
    except ValueError:
        return nan
