"""The command line: ``glstar COMMAND``.

The modules of the commands are imported when they are needed: one for a command, none for ``glstar --help``.
"""

import os
import sys
from collections.abc import Iterable
from importlib import import_module
from inspect import cleandoc, signature
from itertools import pairwise
from typing import Annotated, Any, NamedTuple

import typer
from rich.markup import escape
from typer.core import TyperGroup

from glstar import __version__
from glstar.cli.reporting import Quiet, Verbose, reporting
from glstar.errors import GlstarError
from glstar.system.process import exit_on_interrupt, exit_status

__all__ = ["COMMANDS", "main"]


# Key of the arguments of the command line, for the options that are processed before the others.
_WORDS = "glstar.words"


class _OneLineErrors(TyperGroup):
    """Prints an error of glstar as one line and exits with 1; with --traceback, the traceback is shown too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; reject empty ones, because an empty path means the working directory."""
        for before, word in pairwise(("", *args)):
            if not word or (word.startswith("--") and word.endswith("=")):
                after = word.rstrip("=") or before
                where = f" after {after}" if after else ""
                raise typer.BadParameter(f"an empty word{where}; is a variable of the shell not set?", ctx=ctx)
        ctx.meta[_WORDS] = tuple(args)
        remaining: list[str] = super().parse_args(ctx, args)
        return remaining

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except GlstarError as error:
            if ctx.params["traceback"]:
                raise
            typer.echo(f"glstar: {' '.join(str(error).split())}", err=True)
            ctx.exit(1)
        except KeyboardInterrupt as interrupt:
            typer.echo("glstar: stopped", err=True)
            ctx.exit(exit_status(interrupt))


class _Command(NamedTuple):
    """A command."""

    module: str  # module in ``glstar.cli``
    name: str  # function in the module, or ``app``: a group of commands
    summary: str  # first paragraph of its help, shown by ``glstar --help``


COMMANDS = {
    "export": _Command(
        "images.export",
        "export",
        "Write the long exposures that the camera would have taken on a flight, and where every star is on them.",
    ),
    "calibrate": _Command(
        "calibration.calibrate",
        "calibrate",
        "Calibrate the simulator's sensor from photographs of the stars: brightness, sharpness, sky and noise.",
    ),
    "compare": _Command(
        "images.compare",
        "compare",
        "Compare real images with simulated ones, star by star: brightness, centroids, length and direction of trails.",
    ),
    "info": _Command(
        "flights.info",
        "info",
        "Show what a flight log holds: vehicle, time, position, every attitude with its rate and gaps, night or day.",
    ),
    "convert": _Command(
        "images.convert",
        "convert",
        "Convert an export: to MCAP or a ROS 2 bag, its truth to CSV, its frames to images with EXIF, or for learning.",
    ),
    "view": _Command("flights.view", "view", "Replay a flight in a window, as the camera would have recorded it."),
    "live": _Command(
        "flights.live",
        "live",
        "Show what the camera on an aircraft sees now, from its telemetry link, in a window; or write it as frames.",
    ),
    "replay-link": _Command(
        "flights.linkcommands",
        "replay_link",
        "Send a flight as MAVLink 2 in real time, a vehicle for glstar live, MAVProxy or QGroundControl.",
    ),
    "score": _Command(
        "images.score",
        "score",
        "Score a navigator's answers: attitude, position, identified stars and run time against the truth.",
    ),
    "answer": _Command(
        "flights.linkcommands",
        "answer",
        "Send an answer of a navigator to glstar live, or those of the standard input, one JSON line each.",
    ),
    "fly": _Command(
        "flights.fly",
        "fly",
        "Write a flight without a log: an orbit, a transit, waypoints, a hover or a spin, in wind and gusts.",
    ),
    "demo": _Command(
        "images.demo",
        "demo",
        "Draw six frames of the bundled flight over Adelaide, and a contact sheet that names the brightest stars.",
    ),
    "sky": _Command(
        "flights.sky",
        "sky",
        "List the stars above a site, the Sun, Moon and planets, or satellites: apparent place, azimuth, altitude.",
    ),
    "camera": _Command(
        "calibration.camera", "app", "Calibrate cameras with boards, show camera files, rectify images."
    ),
    "catalogue": _Command("machine.catalogue", "app", "Build star catalogues and show their contents."),
    "config": _Command(
        "machine.showconfig",
        "show_config",
        "Show every setting in effect, and whether it comes from a flag, the config file, a preset or the default.",
    ),
    "bench": _Command(
        "images.bench", "app", "NightSky-Bench: draw named sets of frames, run solvers on them, compare."
    ),
    "doctor": _Command(
        "machine.doctor", "doctor", "Show OpenGL, devices, libraries and catalogues, and their problems."
    ),
    "manual": _Command("machine.manual", "manual", "Print a page of the manual."),
}


def _keep_brackets(commands: typer.Typer) -> None:
    """Escape words in brackets in the help texts, such as [sweep], because rich would take them for markup."""
    for command in commands.registered_commands:
        if command.callback is None:
            continue
        command.help = escape(cleandoc(command.callback.__doc__ or ""))
        for parameter in signature(command.callback).parameters.values():
            for option in getattr(parameter.annotation, "__metadata__", ()):
                text = getattr(option, "help", None) or ""
                # Several commands share some options.
                if "[" in text and "\\[" not in text:
                    option.help = escape(text)
    for group in commands.registered_groups:
        if group.typer_instance is not None:
            _keep_brackets(group.typer_instance)


def _version(ctx: typer.Context, wanted: bool) -> None:
    """Print the version and exit."""
    if wanted:
        typer.echo(f"glstar {__version__}")
        if {"-v", "--verbose"} & set(ctx.meta.get(_WORDS, ())):
            from glstar.cli.machine.doctor import machine_lines  # noqa: PLC0415 - OpenGL, only when it is wanted

            for line in machine_lines():
                typer.echo(line)
        raise typer.Exit


def _glstar(
    ctx: typer.Context,
    traceback: Annotated[bool, typer.Option("--traceback", help="Show the traceback of an error.")] = False,  # noqa: ARG001 - read by `_OneLineErrors`
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
        cls=_OneLineErrors,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    program.callback()(_glstar)
    for name in names:
        module, attribute, summary = COMMANDS[name]
        if summaries:
            program.command(name, help=escape(summary))(_summarised)
            continue
        command = getattr(import_module(f"glstar.cli.{module}"), attribute)
        if isinstance(command, typer.Typer):
            program.add_typer(command, name=name)
        else:
            program.command(name)(command)
    if not summaries:
        _keep_brackets(program)
    return program


def _summarised() -> None:
    """Do nothing: a placeholder of a command in the list of commands."""


def _program(words: list[str]) -> typer.Typer:
    """Return the program with the commands that the words of a command line need."""
    if "_GLSTAR_COMPLETE" in os.environ:  # completion by a shell, which sends the words in other variables
        return _build(COMMANDS)
    command = next((word for word in words if not word.startswith("-")), None)
    if command in COMMANDS:
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
    program()
