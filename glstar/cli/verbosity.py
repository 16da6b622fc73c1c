"""How much the commands report on standard error: ``--quiet`` and ``--verbose``."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import IntEnum
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any

import typer

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no notes; results and errors only.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="More on standard error: the driver, and progress without a terminal.")
]


class Verbosity(IntEnum):
    """What a command writes beside its result, its warnings and its errors."""

    QUIET = 0
    """Nothing."""
    NORMAL = 1
    """Notes, and a progress bar in a terminal."""
    VERBOSE = 2
    """Details as well, and progress in lines where there is no terminal."""


_CURRENT = ContextVar("verbosity", default=Verbosity.NORMAL)


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
        yield
    finally:
        _CURRENT.reset(before)


def with_verbosity(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the flags ``--quiet`` and ``--verbose`` added."""

    @wraps(command)
    def reported(*, quiet: bool = False, verbose: bool = False, **values: Any) -> None:
        with reporting(quiet=quiet, verbose=verbose):
            command(**values)

    own = signature(command)
    flags = [
        Parameter("quiet", Parameter.KEYWORD_ONLY, default=False, annotation=Quiet),
        Parameter("verbose", Parameter.KEYWORD_ONLY, default=False, annotation=Verbose),
    ]
    parameters = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in own.parameters.values()]
    reported.__signature__ = own.replace(parameters=parameters + flags)  # type: ignore[attr-defined]
    return reported
