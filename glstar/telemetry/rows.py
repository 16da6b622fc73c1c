"""The rows of a text file, for every reader of tables."""

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

__all__ = ["ROWS_AT_ONCE", "Dump", "rows", "separator"]

Float = NDArray[np.float64]

# So many rows are text at one time: as numbers they need a tenth of the memory, and few rows stay in the cache.
ROWS_AT_ONCE = 1000
# With what a cell with a number or a time begins.
_OF_NUMBERS = "0123456789+-."
# 1,5 in a table whose cells are separated by something else.
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")


def rows(name: str, *, delimiter: str | None = None, quoted: bool = True) -> Iterator[tuple[int, list[str]]]:
    """Yield every row of a table, header first, with the number of its line.

    Blank lines, and those that begin with ``#``, are passed over; but where the first other line has numbers, the line
    before it is the header, as numpy.savetxt writes it.

    Parameters
    ----------
    name : str
        The file.
    delimiter : str, optional
        What separates cells; by default comma, semicolon or tab, whichever the header has most.
    quoted : bool
        Whether cells may be quoted.

    Raises
    ------
    LogFormatError
        If the file is no text, or not a table.
    """
    line = count = lines = 0
    remark = ""

    def texts(file: TextIO) -> Iterator[str]:
        nonlocal line, lines, remark
        for number, text in enumerate(file, start=1):
            stripped = text.lstrip()
            if not stripped or stripped[0] == "#":
                remark = stripped.lstrip("# ") or remark if lines == 0 else ""
                continue
            if lines == 0 and stripped[0] in _OF_NUMBERS and _header_of(remark, stripped):
                line, lines = number - 1, lines + 1
                yield remark
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


def _header_of(remark: str, row: str) -> bool:
    """Return whether a remark is the header of a row: as many names as the row has cells."""
    between = max(",;\t", key=remark.count)
    names = [name.strip() for name in remark.split(between)]
    return len(names) > 1 and len(names) == len(row.split(between)) and all(name[:1].isalpha() for name in names)


class Dump:
    """A table that a program wrote out of a log, as columns of numbers.

    Damage is passed over: a row of another width than the header's is left out, a cell that is no finite number is NaN.

    Parameters
    ----------
    name : str
        The file; its first column is called ``timestamp``, and what follows that word separates the cells.
    wanted : iterable of str, optional
        The columns to read, of those that there are; by default all.
    texts : str, optional
        A column that is kept as text instead.  Programs quote no text: where it is the last column, separators are its.

    Attributes
    ----------
    header : tuple of str
    line : (n,) float64
        Where each row stands.
    columns : dict of str to (n,) float64
        NaN where a cell is empty or no finite number.
    texts : tuple of str
        What is not empty of the column of text.
    heads : tuple of int
        The lines at which the header is repeated: there another table begins.
    """

    def __init__(self, name: str, wanted: Iterable[str] | None = None, *, texts: str | None = None) -> None:
        between = separator(name)
        told = rows(name, delimiter=between, quoted=False)
        header = next(told, (0, []))[1]
        self.header = tuple(cell.strip() for cell in header)
        names = [one for one in dict.fromkeys(wanted or self.header) if one in self.header]
        places = [self.header.index(one) for one in names]
        text_at = self.header.index(texts) if texts in self.header else None
        lines: list[Float] = []
        parts: list[list[Float]] = [[] for _ in names]
        said: list[str] = []
        heads: list[int] = []
        last = len(header) - 1
        if text_at == last:
            told = ((line, _with_text(cells, last, between)) for line, cells in told)
        while batch := list(islice(told, ROWS_AT_ONCE)):
            heads += [line for line, cells in batch if cells == header]
            whole = [(line, cells) for line, cells in batch if len(cells) == len(self.header) and cells != header]
            lines.append(np.array([line for line, _ in whole], dtype=np.float64))
            if between != "," and whole:
                _refuse_decimal_commas(name, self.header, *whole[0])
            for part, place in zip(parts, places, strict=True):
                part.append(_numbers([cells[place] for _, cells in whole]))
            if text_at is not None:
                said += [cells[text_at] for _, cells in whole if cells[text_at]]
        self.line = np.concatenate(lines) if lines else np.empty(0)
        self.columns = {
            one: np.concatenate(part) if part else np.empty(0) for one, part in zip(names, parts, strict=True)
        }
        self.texts, self.heads = tuple(said), tuple(heads)

    def only(self, which: NDArray[np.bool_]) -> "Dump":
        """Return some of the rows, as a table; a column of text that is empty in places stays whole.

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


def separator(name: str) -> str:
    """Return what separates the cells of a dump: what follows the name of its first column.

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
    """Raise an error for a number that has a comma where it should have a point."""
    for column, cell in zip(header, cells, strict=True):
        if _DECIMAL_COMMA.fullmatch(cell.strip()):
            raise LogFormatError(
                name, f"line {line}, column {column}: {cell.strip()!r} has a decimal comma; write decimals with a point"
            )


def _with_text(cells: list[str], last: int, between: str) -> list[str]:
    """Return a row whose last cell has the separators that are its text's."""
    return [*cells[:last], between.join(cells[last:])] if len(cells) > last else cells


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
