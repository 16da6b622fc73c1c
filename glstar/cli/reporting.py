"""What the commands report on standard error: notes, details and progress, by ``--quiet`` and ``--verbose``."""

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import IntEnum
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import Annotated, Any, TextIO

import typer

from glstar.system.process import exit_status

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no notes; results and errors only.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="More on standard error: the driver, and progress without a terminal.")
]


# Suffixes of the files that ``--plot`` writes.
PLOT_FORMATS = (".png", ".svg", ".pdf")


class Verbosity(IntEnum):
    """What a command writes beside its result, its warnings and its errors."""

    QUIET = 0
    """Nothing."""
    NORMAL = 1
    """Notes, and a progress bar in a terminal."""
    VERBOSE = 2
    """Details as well, and progress in lines where there is no terminal."""


# Directory of the package.
_PACKAGE = Path(__file__).parents[1]
_CURRENT = ContextVar("verbosity", default=Verbosity.NORMAL)
# Time between two lines of progress, s: a log of an hour's export has some hundred lines.
_LINE_EVERY_S = 30.0


def verbosity() -> Verbosity:
    """Return the verbosity of the running command."""
    return _CURRENT.get()


def echo_note(message: str) -> None:
    """Write a note to standard error, unless the command is quiet.

    Warnings about missing or wrong results are not notes: the commands print them at any verbosity.
    """
    if verbosity() > Verbosity.QUIET:
        typer.echo(message, err=True)


def echo_detail(message: str) -> None:
    """Write a detail to standard error if the command is verbose."""
    if verbosity() is Verbosity.VERBOSE:
        typer.echo(message, err=True)


@contextmanager
def reporting(*, quiet: bool, verbose: bool) -> Iterator[None]:
    """Set the verbosity for the time of a command; raises typer.BadParameter if both flags are given."""
    if quiet and verbose:
        raise typer.BadParameter("contradict each other; leave one out", param_hint="--quiet and --verbose")
    louder = Verbosity.VERBOSE if verbose else verbosity()
    before = _CURRENT.set(Verbosity.QUIET if quiet else louder)
    try:
        with _warnings_as_lines():
            yield
    finally:
        _CURRENT.reset(before)


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Write each warning of glstar itself as one line, once."""
    shown, others = set(), warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category is not UserWarning or not Path(filename).is_relative_to(_PACKAGE):
            others(message, category, filename, lineno, file, line)
        elif str(message) not in shown:
            shown.add(str(message))
            typer.echo(f"glstar: {message}", err=True)

    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module=r"glstar\.")
        warnings.showwarning = show
        yield


def with_verbosity(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the flags ``--quiet`` and ``--verbose`` added; one that has them stays as it is."""
    own = signature(command)
    if "quiet" in own.parameters:
        return command

    @wraps(command)
    def reported(*, quiet: bool = False, verbose: bool = False, **values: Any) -> None:
        with reporting(quiet=quiet, verbose=verbose):
            command(**values)

    flags = [
        Parameter("quiet", Parameter.KEYWORD_ONLY, default=False, annotation=Quiet),
        Parameter("verbose", Parameter.KEYWORD_ONLY, default=False, annotation=Verbose),
    ]
    parameters = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in own.parameters.values()]
    reported.__signature__ = own.replace(parameters=parameters + flags)  # type: ignore[attr-defined]
    return reported


@contextmanager
def resumable() -> Iterator[None]:
    """End the command if it is interrupted, and say that it goes on when it is run again."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        typer.echo("glstar: stopped; run the same command again to go on", err=True)
        raise typer.Exit(exit_status(interrupt)) from None


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress, rate and remaining time on standard error, after a label, if that is a terminal.

    A verbose command writes progress to other files too, as lines; a quiet one writes none.  Yields a function to call
    with the number of finished items and of all items.
    """
    # Loaded by the commands that show progress only.
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn  # noqa: PLC0415

    in_terminal = sys.stderr.isatty()
    if verbosity() is Verbosity.VERBOSE and not in_terminal:
        yield _lines(label)
        return
    shown = in_terminal and verbosity() > Verbosity.QUIET
    columns = (
        TextColumn(label),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    console = Console(file=sys.stderr)
    with Progress(*columns, console=console, disable=not shown, transient=True) as progress:
        number = progress.add_task(label, total=None, rate="")

        def on_item(done: int, of: int) -> None:
            speed = progress.tasks[0].speed
            progress.update(number, completed=done, total=of, rate="" if speed is None else f"{speed:.1f}/s")

        yield on_item


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
