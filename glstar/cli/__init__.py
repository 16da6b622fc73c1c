"""The command line: ``glstar COMMAND``."""

import sys
from inspect import cleandoc, signature
from itertools import pairwise
from typing import Annotated, Any

import typer
from rich.markup import escape
from typer.core import TyperGroup

from glstar import __version__
from glstar.cli import (
    calibrate,
    camera,
    catalogue,
    compare,
    demo,
    doctor,
    export,
    fly,
    info,
    live,
    manual,
    replaylink,
    score,
    sky,
    view,
)
from glstar.errors import GlstarError
from glstar.system.interrupt import EXIT_INTERRUPTED

__all__ = ["app", "main"]


class _OneLineErrors(TyperGroup):
    """Prints an error of glstar as one line and exits with 1; with --traceback, the traceback is shown too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; reject empty ones, because an empty path means the working directory."""
        for before, word in pairwise(("", *args)):
            if not word or (word.startswith("--") and word.endswith("=")):
                after = word.rstrip("=") or before
                where = f" after {after}" if after else ""
                raise typer.BadParameter(f"an empty word{where}; is a variable of the shell not set?", ctx=ctx)
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
        except KeyboardInterrupt:
            typer.echo("glstar: stopped", err=True)
            ctx.exit(EXIT_INTERRUPTED)


app = typer.Typer(
    name="glstar",
    cls=_OneLineErrors,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("export")(export.export)
app.command("calibrate")(calibrate.calibrate)
app.command("compare")(compare.compare)
app.command("info")(info.info)
app.command("view")(view.view)
app.command("live")(live.live)
app.command("replay-link")(replaylink.replay_link)
app.command("score")(score.score)
app.command("fly")(fly.fly)
app.command("demo")(demo.demo)
app.command("sky")(sky.sky)
app.add_typer(camera.app, name="camera")
app.add_typer(catalogue.app, name="catalogue")
app.command("doctor")(doctor.doctor)
app.command("manual")(manual.manual)


def _keep_brackets(commands: typer.Typer) -> None:
    """Escape words in brackets in the help texts, such as [sweep], because rich would take them for markup."""
    for command in commands.registered_commands:
        if command.callback is None:
            continue
        command.help = escape(cleandoc(command.callback.__doc__ or ""))
        for parameter in signature(command.callback).parameters.values():
            for described in getattr(parameter.annotation, "__metadata__", ()):
                text = getattr(described, "help", None) or ""
                # Several commands share some options.
                if "[" in text and "\\[" not in text:
                    described.help = escape(text)
    for group in commands.registered_groups:
        if group.typer_instance is not None:
            _keep_brackets(group.typer_instance)


_keep_brackets(app)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"glstar {__version__}")
        raise typer.Exit


@app.callback()
def _glstar(
    traceback: Annotated[bool, typer.Option("--traceback", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Simulate long exposures of the night sky by a camera fixed to an aircraft.

    Try: glstar demo
    """


def main() -> None:
    """Run the command line and leave with its exit status."""
    # A file name may contain bytes that are not valid text; messages that quote it must not fail.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    app()
