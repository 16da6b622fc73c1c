"""A progress bar for terminals, or lines where there is none."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from glstar.cli.verbosity import Verbosity, verbosity

# Time between two lines of progress, s: a log of an hour's export has some hundred lines.
_LINE_EVERY_S = 30.0


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        """Return the rate in frames per second, once it is known."""
        return Text("" if task.speed is None else f"{task.speed:.1f}/s")


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress, rate and remaining time on standard error, after a label, if that is a terminal.

    A verbose command writes progress to other files too, as lines; a quiet one writes none.  Yields a function to call
    with the number of finished items and of all items.
    """
    in_terminal = sys.stderr.isatty()
    if verbosity() is Verbosity.VERBOSE and not in_terminal:
        yield _lines(label)
        return
    shown = in_terminal and verbosity() > Verbosity.QUIET
    columns = TextColumn(label), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn()
    console = Console(file=sys.stderr)
    with Progress(*columns, console=console, disable=not shown, transient=True) as progress:
        task = progress.add_task(label, total=None)
        yield lambda done, of: progress.update(task, completed=done, total=of)


def _lines(label: str) -> Callable[[int, int], None]:
    """Return a function that writes progress as lines: the first, the last, and one at intervals."""
    began_s = time.monotonic()
    next_s = began_s

    def on_item(done: int, of: int) -> None:
        nonlocal next_s
        now_s = time.monotonic()
        if now_s < next_s and done < of:
            return
        next_s = now_s + _LINE_EVERY_S
        typer.echo(f"{label}: {done} of {of} after {now_s - began_s:.1f} s", err=True)

    return on_item
