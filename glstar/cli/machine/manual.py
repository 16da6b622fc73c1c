"""``glstar manual``: the pages of the manual, in the terminal."""

import re
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.markdown import Markdown

from glstar.errors import ConfigError
from glstar.system.resources import manual_pages
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
        str,
        typer.Argument(
            metavar="[TOPIC|WORD]",
            help="The page to print, or a word to find on all pages; without it, the list of pages.",
            autocompletion=_topics,
        ),
    ] = "",
) -> None:
    """Print a page of the manual, or the lines of all pages that have a word.

    The page is formatted for a terminal. Piped into a file or another program it is plain Markdown.

    Example: glstar manual tutorial, or glstar manual yolo
    """
    pages = manual_pages()
    if not topic:
        _print_topics()
        return
    page = pages.get(topic.lower().removesuffix(".md"))
    if page is None:
        _print_lines(topic)
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


def _print_lines(word: str) -> None:
    """Print the lines of all pages that have a word, the pages with most of them first; raise ConfigError if none."""
    found = {}
    for topic, page in manual_pages().items():
        lines = page.read_text(encoding="utf-8").splitlines()
        if hits := [(number, line) for number, line in enumerate(lines, 1) if word.lower() in line.lower()]:
            found[topic] = hits
    near = nearest_word(word.lower(), manual_pages())
    if not found:
        suggestion = f" (did you mean {near}?)" if near else f" (the pages are {', '.join(manual_pages())})"
        raise ConfigError(f"the manual has no page {word!r} and no line with it{suggestion}")
    for topic, hits in sorted(found.items(), key=lambda item: -len(item[1])):
        typer.echo(f"{topic}: {len(hits)}")
        for number, line in hits[:_LINES]:
            typer.echo(f"  {number:4}  {_around(line.strip(), word)}")
    typer.echo(f"\nglstar manual TOPIC prints a page{f'; did you mean {near}?' if near else ''}")


def _around(line: str, word: str) -> str:
    """Return a line, cut to a width with the word in it."""
    at = line.lower().index(word.lower())
    first = max(0, min(at - _WIDTH // 3, len(line) - _WIDTH))
    shown = line[first : first + _WIDTH]
    return f"{'...' if first else ''}{shown}{'...' if first + _WIDTH < len(line) else ''}"


def _print_topics() -> None:
    pages = manual_pages()
    width = max(map(len, pages))
    for topic, page in pages.items():
        typer.echo(f"{topic:{width}}  {summary(page.read_text(encoding='utf-8'))}")
    typer.echo(
        "\nglstar manual TOPIC prints a page, glstar manual WORD finds lines; start with: glstar manual tutorial"
    )
