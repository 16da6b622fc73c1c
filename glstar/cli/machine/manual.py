"""``glstar manual``: the pages of the manual, in the terminal."""

import re
import sys
from collections.abc import Iterator
from typing import Annotated

import typer
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table

from glstar.cli.tables import print_table
from glstar.errors import ConfigError
from glstar.system.resources import MANUAL_KINDS, manual_pages
from glstar.system.userinput import nearest_word

# The widest text column in a terminal, in characters; longer lines are hard to read.
_MAX_COLUMNS = 120
# Lines of a page with a word that are printed, and their width in characters: they fit a terminal of 80 columns.
_LINES, _WIDTH = 3, 66


def _topics(incomplete: str) -> list[str]:
    """Return the pages whose names begin with a word, for the completion of the shell."""
    return [topic for topic in manual_pages() if topic.startswith(incomplete)]


def manual(
    topic: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TOPIC|WORDS]",
            help="The page to print, or words to find in the lines of all pages; without them, the list of pages.",
            autocompletion=_topics,
        ),
    ] = None,
) -> None:
    """Print a page of the manual, or the lines of all pages that have some words.

    The page is formatted for a terminal. Piped into a file or another program it is plain Markdown.

    Example: glstar manual tutorial, or glstar manual yolo
    """
    words = " ".join(topic or ()).lower().split()
    if not words:
        _print_topics()
        return
    page = manual_pages().get("-".join(words).removesuffix(".md"))
    if page is None:
        _print_lines(words)
        return
    text = page.read_text(encoding="utf-8")
    if is_terminal():
        console = Console()
        console.print(Markdown(text), width=min(console.width, _MAX_COLUMNS))
    else:
        typer.echo(text, nl=False)


def is_terminal() -> bool:
    """Return whether the standard output is a terminal."""
    return sys.stdout.isatty()


def summary(page_text: str) -> str:
    """Return the first sentence of a page, as one line.

    `page_text`: markdown: a title, an empty line, and a paragraph.
    """
    paragraph = " ".join(page_text.split("\n\n", 2)[1].split())
    return re.split(r"(?<=\.) ", paragraph, maxsplit=1)[0].replace("`", "")


def _print_lines(words: list[str]) -> None:
    """Print the lines of all pages that have all words; ConfigError if none has.

    Headings come before other lines; pages with the words in their title before pages with other headings, and these
    before pages with more lines.
    """
    found = {}
    for topic, page in manual_pages().items():
        lines = _lines(page.read_text(encoding="utf-8"))
        if hits := [hit for hit in lines if all(word in hit[2].lower() for word in words)]:
            found[topic] = sorted(hits)
    near = nearest_word(words[0], manual_pages())
    if not found:
        suggestion = f" (did you mean {near}?)" if near else f" (the pages are {', '.join(manual_pages())})"
        raise ConfigError(f"the manual has no page {' '.join(words)!r} and no line with it{suggestion}")
    for topic, hits in sorted(found.items(), key=lambda item: (item[1][0][1] > 1, item[1][0][0], -len(item[1]))):
        typer.echo(f"{topic}: {len(hits)}")
        for _, number, line in hits[:_LINES]:
            typer.echo(f"  {number:4}  {_around(line.strip(), words[0])}")
    typer.echo(f"\nglstar manual TOPIC prints a page{f'; did you mean {near}?' if near else ''}")


def _lines(page_text: str) -> Iterator[tuple[bool, int, str]]:
    """Yield of each line of a page whether it is no heading, its number, and the line."""
    is_code = False
    for number, line in enumerate(page_text.splitlines(), 1):
        is_code ^= line.startswith("```")
        yield is_code or not line.startswith("#"), number, line


def _around(line: str, word: str) -> str:
    """Return a line, cut to a width with the word in it."""
    at = line.lower().index(word)
    first = max(0, min(at - _WIDTH // 3, len(line) - _WIDTH))
    shown = line[first : first + _WIDTH]
    return f"{'...' if first else ''}{shown}{'...' if first + _WIDTH < len(line) else ''}"


def _print_topics() -> None:
    pages = manual_pages()
    for kind, topics in MANUAL_KINDS.items():
        table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
        table.add_column(min_width=max(map(len, pages)))
        for topic in topics:
            table.add_row(topic, summary(pages[topic].read_text(encoding="utf-8")))
        typer.echo(f"{kind}\n")
        print_table(table)
        typer.echo("")
    typer.echo("glstar manual TOPIC prints a page, glstar manual WORDS finds lines")
    typer.echo("Start with: glstar manual tutorial")
