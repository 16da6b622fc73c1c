"""``glstar manual``: the pages of the manual, in the terminal."""

import re
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.markdown import Markdown

from glstar.errors import ConfigError
from glstar.system.resources import manual_pages
from glstar.system.userinput import did_you_mean

# The widest text column in a terminal, in characters; longer lines are hard to read.
_MAX_COLUMNS = 120


def _topics(incomplete: str) -> list[str]:
    """Return the pages whose names begin with a word, for the completion of the shell."""
    return [topic for topic in manual_pages() if topic.startswith(incomplete)]


def manual(
    topic: Annotated[
        str,
        typer.Argument(
            metavar="[TOPIC]", help="The page to print; without it, the list of pages.", autocompletion=_topics
        ),
    ] = "",
) -> None:
    """Print a page of the manual.

    The page is formatted for a terminal. Piped into a file or another program it is plain Markdown.

    Example: glstar manual tutorial
    """
    pages = manual_pages()
    if not topic:
        _print_topics()
        return
    page = pages.get(topic.lower().removesuffix(".md"))
    if page is None:
        raise ConfigError(
            f"the manual has no page {topic!r}"
            + did_you_mean(topic.lower(), list(pages), or_else=f" (the pages are {', '.join(pages)})")
        )
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


def _print_topics() -> None:
    pages = manual_pages()
    width = max(map(len, pages))
    for topic, page in pages.items():
        typer.echo(f"{topic:{width}}  {summary(page.read_text(encoding='utf-8'))}")
    typer.echo("\nglstar manual TOPIC prints a page; start with: glstar manual tutorial")
