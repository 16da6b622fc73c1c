"""Tables on the terminal: they fit its width, or each row becomes a block of lines; no word and no number is cut."""

import re
import sys
from copy import copy
from itertools import zip_longest
from textwrap import fill

from rich.cells import cell_len
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

# A pipe has no width: most tables fit this one, characters.
PIPE_COLUMNS = 160
# From this number of rows on, glstar writes them itself.
_MANY_ROWS = 50
# Fills the cells of an example row; no text has it, because it has no meaning in Unicode.
_FILL = "\ue000"


def console_of_width(pipe_columns: int = PIPE_COLUMNS) -> Console:
    """Return a console as wide as the terminal, or of a width where the standard output is none."""
    return Console(width=None if sys.stdout.isatty() else pipe_columns, highlight=False, markup=False)


def print_table(table: Table, *, pipe_columns: int = PIPE_COLUMNS) -> None:
    """Print a table within the width of the terminal.

    A table that is too wide loses its box and wraps its cells between words.  If words are too long for that, a
    terminal gets its rows one after the other.  The parameter `pipe_columns` is the width where the standard output is
    no terminal.
    """
    console = console_of_width(pipe_columns)
    widths = _natural_widths(table)
    if _width(table, widths) > console.width:
        table.box, table.pad_edge, table.collapse_padding = None, False, True
        for column in table.columns:
            # The names of columns in files have underscores, between which a line breaks.
            column.header = _plain(column.header).replace("_", " ")
        widths = _natural_widths(table)
        if _fit(table, console.width, widths):
            widths = [column.width or 0 for column in table.columns]
        else:
            if sys.stdout.isatty():
                _print_rows(table, console)
                return
            console = console_of_width(_width(table, widths))  # a program that reads it finds a row on a line
    if table.row_count < _MANY_ROWS or any(isinstance(cell, Text) for column in table.columns for cell in column.cells):
        console.print(table)
    else:
        _print_many(table, console, widths)


def _print_many(table: Table, console: Console, widths: list[int]) -> None:
    """Print a table of many rows: rich takes a millisecond for each, and lays out one as an example."""
    with console.capture() as captured:
        console.print(_of_one_row(table, widths))
    lines = captured.get().splitlines()
    [example] = (number for number, line in enumerate(lines) if _FILL in line)
    between = re.split(f"{_FILL}+", lines[example])
    rows = []
    for cells in zip(*(column.cells for column in table.columns), strict=True):
        wrapped = [_wrapped(str(cell), width, console) for cell, width in zip(cells, widths, strict=True)]
        for parts in zip_longest(*wrapped, fillvalue=""):
            texts = map(_justified, table.columns, parts, widths)
            rows.append(between[0] + "".join(text + after for text, after in zip(texts, between[1:], strict=True)))
    console.file.write("\n".join([*lines[:example], *rows, *lines[example + 1 :], ""]))


def _wrapped(text: str, width: int, console: Console) -> list[str]:
    if cell_len(text) <= width and "\n" not in text:
        return [text]
    return [str(line) for line in Text(text).wrap(console, width)]


def _justified(column: Column, text: str, width: int) -> str:
    """Return a text of a cell, filled with spaces to the width of its column."""
    text = text.rstrip()
    room = " " * (width - cell_len(text))
    return room + text if column.justify == "right" else text + room


def _of_one_row(table: Table, widths: list[int]) -> Table:
    """Return a table like another, with columns of some widths and one row that fills them."""
    one = copy(table)
    one.columns, one.rows = [column.copy() for column in table.columns], []
    for column, width in zip(one.columns, widths, strict=True):
        column.width = width
    one.add_row(*(_FILL * width for width in widths))
    return one


def _natural_widths(table: Table) -> list[int]:
    """Return the widths of columns whose cells are not wrapped."""
    shown = table.show_header
    return [_longest(_lines(*([column.header] if shown else []), *column.cells)) for column in table.columns]


def _width(table: Table, widths: list[int]) -> int:
    """Return the width of a table whose columns have some widths."""
    return Console(width=10_000, height=1).measure(_of_one_row(table, widths)).maximum


def _fit(table: Table, width: int, natural: list[int]) -> bool:
    """Give the columns of a table widths with which it fits; return False if a word is too long for that.

    `natural`: the widths of the columns without wrapped cells.
    """
    least = []
    for column in table.columns:
        cells = _lines(*column.cells)
        # The header may wrap where its cells may not.
        parts = cells if column.no_wrap else [word for cell in cells for word in cell.split()]
        least.append(_longest([*_plain(column.header).split(), *parts]))
        column.no_wrap = False
    wanted = [wide - narrow for wide, narrow in zip(natural, least, strict=True)]
    spare = width - (_width(table, natural) - sum(natural)) - sum(least)
    if spare < 0:
        return False
    share = min(1.0, spare / max(sum(wanted), 1))
    for column, narrow, more in zip(table.columns, least, wanted, strict=True):
        column.width = narrow + int(share * more)
    return True


def _print_rows(table: Table, console: Console) -> None:
    """Print a table as blocks: the first cell of each row, and below it the others with their headers."""
    if table.title:
        console.print(_plain(table.title))
    for first, *rest in zip(*(map(_plain, column.cells) for column in table.columns), strict=True):
        console.print(first, soft_wrap=True)
        headers = [_plain(column.header) for column in table.columns[1:]]
        pairs = [f"{header} {cell}".strip() for header, cell in zip(headers, rest, strict=True) if cell]
        indent = "  "
        text = fill(", ".join(pairs), console.width, initial_indent=indent, subsequent_indent=indent,
                    break_long_words=False, break_on_hyphens=False)  # fmt: skip
        console.print(text, soft_wrap=True)
    if table.caption:
        console.print(_plain(table.caption))


def _lines(*cells: object) -> list[str]:
    return [line for cell in cells for line in _plain(cell).splitlines()]


def _longest(texts: list[str]) -> int:
    return max(map(cell_len, texts), default=1)


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)
