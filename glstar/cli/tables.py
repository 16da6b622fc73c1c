"""Tables on the terminal: they fit its width, or each row becomes a block of lines; no word and no number is cut."""

import sys
from textwrap import fill

from rich.console import Console
from rich.table import Table
from rich.text import Text

# A pipe has no width: most tables fit this one, characters.
PIPE_COLUMNS = 160


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
    if _width(table) > console.width:
        table.box, table.pad_edge, table.collapse_padding = None, False, True
        for column in table.columns:
            # The names of columns in files have underscores, between which a line breaks.
            column.header = _plain(column.header).replace("_", " ")
        if not _fit(table, console.width):
            if sys.stdout.isatty():
                _print_rows(table, console)
                return
            console = console_of_width(_width(table))  # a program that reads it finds a row on a line
    console.print(table)


def _width(table: Table) -> int:
    """Return the width of a table whose cells are not wrapped."""
    return Console(width=10_000, height=1).measure(table).maximum


def _fit(table: Table, width: int) -> bool:
    """Give the columns of a table widths with which it fits; return False if a word is too long for that."""
    natural = [_longest(_lines(column.header, *column.cells)) for column in table.columns]
    least = []
    for column in table.columns:
        cells = _lines(*column.cells)
        # The header may wrap where its cells may not.
        parts = cells if column.no_wrap else [word for cell in cells for word in cell.split()]
        least.append(_longest([*_plain(column.header).split(), *parts]))
        column.no_wrap = False
    wanted = [wide - narrow for wide, narrow in zip(natural, least, strict=True)]
    spare = width - (_width(table) - sum(natural)) - sum(least)
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
    return max(map(len, texts), default=1)


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)
