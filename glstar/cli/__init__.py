"""The command line: ``glstar COMMAND``.

The modules of the commands are imported when they are needed: one for a command, none for ``glstar --help``.
"""

import gc
import os
import sys
from collections.abc import Iterable
from importlib import import_module
from inspect import cleandoc, signature
from typing import Annotated

import typer
from rich.markup import escape

from glstar import __version__
from glstar.cli.commands import COMMANDS
from glstar.cli.dispatch import WORDS, Command, Program, chosen, epilog_of, inner_commands, normalised
from glstar.cli.reporting import Quiet, Verbose, reporting, with_verbosity
from glstar.system.process import exit_on_interrupt

__all__ = ["COMMANDS", "main"]


def _complete(commands: typer.Typer) -> None:
    """Give every command the flags of its reports, and words in brackets in its help, such as [sweep].

    Brackets are escaped, because rich would take them for markup.
    """
    for command in commands.registered_commands:
        if command.callback is None:
            continue
        command.callback = with_verbosity(command.callback)
        command.help = escape(cleandoc(command.callback.__doc__ or ""))
        command.cls = Command
        for parameter in signature(command.callback).parameters.values():
            for option in getattr(parameter.annotation, "__metadata__", ()):
                text = getattr(option, "help", None) or ""
                # Several commands share some options.
                if "[" in text and "\\[" not in text:
                    option.help = escape(text)
    for group in commands.registered_groups:
        if group.typer_instance is not None:
            _complete(group.typer_instance)


def _version(ctx: typer.Context, wanted: bool) -> None:
    """Print the version and exit."""
    if wanted:
        typer.echo(f"glstar {__version__}")
        if {"-v", "--verbose"} & set(ctx.meta.get(WORDS, ())):
            from glstar.cli.machine.doctor import machine_lines  # noqa: PLC0415 - OpenGL, only when it is wanted

            for line in machine_lines():
                typer.echo(line)
        raise typer.Exit


def _glstar(
    ctx: typer.Context,
    traceback: Annotated[bool, typer.Option("--traceback", help="Show the traceback of an error.")] = False,  # noqa: ARG001 - read by `Program`
    quiet: Quiet = False,
    verbose: Verbose = False,
    version: Annotated[  # noqa: ARG001 - its callback prints it
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Show the version and exit; with -v the driver too."
        ),
    ] = False,
) -> None:
    """Simulate long exposures of the night sky by a camera fixed to an aircraft.

    Try: glstar demo
    """
    ctx.with_resource(reporting(quiet=quiet, verbose=verbose))


def _build(names: Iterable[str], *, summaries: bool = False) -> typer.Typer:
    """Return the program with some commands, or with their summaries only."""
    program = typer.Typer(
        name="glstar",
        cls=Program,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    program.callback()(_glstar)
    for name in names:
        entry = COMMANDS[name]
        listed = {"rich_help_panel": entry.panel} if entry.panel else {"hidden": True}
        if summaries:
            inner = ", ".join(inner_commands(name))
            summary = f"{entry.summary} Also: {inner}." if inner else entry.summary
            program.command(name, help=escape(summary), **listed)(_summarised)
            continue
        command = getattr(import_module(f"glstar.cli.{entry.module}"), entry.name)
        if isinstance(command, typer.Typer):
            program.add_typer(command, name=name, **listed)
        else:
            program.command(name, epilog=epilog_of(name), **listed)(command)
    if not summaries:
        _complete(program)
    return program


def _summarised() -> None:
    """Do nothing: a placeholder of a command in the list of commands."""


def _program(words: list[str]) -> typer.Typer:
    """Return the program with the commands that the words of a command line need."""
    if "_GLSTAR_COMPLETE" in os.environ:  # completion by a shell, which sends the words in other variables
        words = (os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")).split()[1:]
    command = chosen(normalised(words))
    if command is not None:
        return _build([command])
    # A wrong word is compared with the names of all commands.
    return _build(COMMANDS, summaries=True)


def __getattr__(name: str) -> typer.Typer:
    """Return ``app``, the program with all commands."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()["app"] = _build(COMMANDS)
    return globals()["app"]  # type: ignore[no-any-return]


def main() -> None:
    """Run the command line and leave with its exit status."""
    # A file name may contain bytes that are not valid text; messages that quote it must not fail.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    # Threads of OpenBLAS wait in a loop, which takes the processors from the threads that draw.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with exit_on_interrupt():
        program = _program(sys.argv[1:])
    gc.freeze()
    gc.enable()
    program()
