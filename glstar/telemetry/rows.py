"""Rows and columns of CSV files, for all readers of tables."""

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from itertools import chain, islice
from math import nan
from pathlib import Path
from typing import Literal, TextIO

import numpy as np
from numpy.typing import NDArray

from glstar.errors import LogFormatError

__all__ = ["ROWS_AT_ONCE", "Dump", "csv_header", "rows", "separator"]

Float = NDArray[np.float64]

# Number of rows that are held as text before they are converted: numbers need a tenth of the memory.
ROWS_AT_ONCE = 1000
# First characters of a number or a time.
_NUMERIC = "0123456789+-."
# An item of a column with lists.
_LIST_ITEM = re.compile(r"(.+)\[(\d+)\]")
# 1,5 in a table with another separator.
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


def rows(name: str, *, delimiter: str | None = None, quoted: bool = True) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of all rows of a table, the header first.

    Blank lines and comment lines, which begin with ``#``, are skipped.  If the first row has numbers, the comment line
    before it is the header, as `numpy.savetxt` writes it.

    Parameters
    ----------
    name : str
        The file.
    delimiter : str, optional
        Separator of cells; by default the one of comma, semicolon and tab that is most frequent in the header.
    quoted : bool
        Whether cells may be quoted.

    Raises
    ------
    LogFormatError
        If the file is not text, or not a table.
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
            if lines == 0 and stripped[0] in _NUMERIC and _header_of(comment, stripped):
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


def _header_of(comment: str, row: str) -> bool:
    """Return whether a comment is the header of a row: it has as many names as the row has cells."""
    between = max(",;\t", key=comment.count)
    names = [name.strip() for name in comment.split(between)]
    return len(names) > 1 and len(names) == len(row.split(between)) and all(name[:1].isalpha() for name in names)


class Dump:
    """Columns of a CSV file that a program exported from a log.

    Rows with another number of cells than the header are dropped.

    Parameters
    ----------
    name : str
        The file.  Its first column is ``timestamp``; the character after that word is the separator.
    wanted : iterable of str, optional
        Names of the columns to read, if they exist; by default all.  ``name[0]`` is the first item of the lists in a
        column; mavlogdump writes a list as ``[1.0, 0.0]``, without quotes.
    texts : str, optional
        Name of a column that is kept as text.  Text is not quoted: if it is the last column, it may contain separators.

    Attributes
    ----------
    header : tuple of str
    line : (n,) float64
        Line number of each row.
    columns : dict of str to (n,) float64
        NaN where a cell is empty or no finite number.
    texts : tuple of str
        Cells of the text column that are not empty.
    heads : tuple of int
        Lines at which the header is repeated, where another table was appended.
    """

    def __init__(self, name: str, wanted: Iterable[str] | None = None, *, texts: str | None = None) -> None:
        between = separator(name)
        remaining = rows(name, delimiter=between, quoted=False)
        header = next(remaining, (0, []))[1]
        self.header = tuple(cell.strip() for cell in header)
        sought = {one: self._index(one) for one in dict.fromkeys(wanted or self.header)}
        indices = {one: index for one, index in sought.items() if index is not None}
        text_at = self.header.index(texts) if texts in self.header else None
        lines: list[Float] = []
        parts: dict[str, list[Float]] = {one: [] for one in indices}
        found: list[str] = []
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
            for one, (index, item) in indices.items():
                parts[one].append(_numbers([_item(cells[index], item) for _, cells in complete]))
            if text_at is not None:
                found += [cells[text_at] for _, cells in complete if cells[text_at]]
        self.line = np.concatenate(lines) if lines else np.empty(0)
        self.columns = {one: np.concatenate(part) if part else np.empty(0) for one, part in parts.items()}
        self.texts, self.heads = tuple(found), tuple(heads)

    def _index(self, name: str) -> tuple[int, int | None] | None:
        """Return the index of a column, and that of the item in its lists for ``name[0]``; None if there is none."""
        if name in self.header:
            return self.header.index(name), None
        found = _LIST_ITEM.fullmatch(name)
        return (self.header.index(found[1]), int(found[2])) if found and found[1] in self.header else None

    def only(self, which: NDArray[np.bool_]) -> "Dump":
        """Return a subset of the rows; a text column with empty cells remains unchanged.

        Parameters
        ----------
        which : (n,) bool

        Returns
        -------
        Dump
        """
        some = copy(self)
        some.line = self.line[which]
        some.columns = {name: column[which] for name, column in self.columns.items()}
        if len(self.texts) == self.line.size:
            some.texts = tuple(self.texts[row] for row in np.flatnonzero(which))
        return some


def csv_header(head: bytes) -> str:
    """Return the first line of a text file, without a leading ``#``.

    Parameters
    ----------
    head : bytes
        The first bytes of the file, some thousands.

    Returns
    -------
    str
        Empty if the bytes are not text.
    """
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().decode(errors="replace")
    return text.splitlines()[0].lstrip("# ") if text and b"\0" not in head else ""


def separator(name: str) -> str:
    """Return the separator of a `Dump`: the character after the name of its first column.

    Parameters
    ----------
    name : str
        The file.

    Returns
    -------
    str
    """
    with Path(name).open(encoding="utf-8-sig", errors="replace") as file:
        first = next((text for text in file if text.strip()), "").lstrip().lstrip("# ")
    after = first.removeprefix("timestamp")[:1]
    return after if after.strip() or after == "\t" else ","


def _refuse_decimal_commas(name: str, header: tuple[str, ...], line: int, cells: list[str]) -> None:
    """Raise an error if a number has a decimal comma."""
    for column, cell in zip(header, cells, strict=True):
        if _DECIMAL_COMMA.fullmatch(cell.strip()):
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
