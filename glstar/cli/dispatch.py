"""How the words of a command line find their command: subcommands, old names, ``glstar help``, suggestions, panels."""

import re
from collections.abc import Collection
from itertools import pairwise
from typing import Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

from glstar.cli.commands import COMMANDS, OLD_COMMANDS
from glstar.cli.concepts import BY_FLAG, CONCEPTS, PANELS, REPORT, Concept, old_flags
from glstar.errors import ConfigError, GlstarError
from glstar.system.process import exit_status
from glstar.system.userinput import did_you_mean, nearest_word

# Key of the arguments of the command line, for the options that are processed before the others.
WORDS: Final = "glstar.words"

_HELP = ("--help", "-h")
_QUIET = {"--quiet", "-q"}
# What a value must be, by the type of pydantic's error.
_MUST = {
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "{ge:g} or more",
    "less_than": "less than {lt:g}",
    "less_than_equal": "{le:g} or less",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_parsing": "a number",
}


def normalised(words: Collection[str]) -> list[str]:
    """Return the words of a command line with the help flag last, and commands under their present names.

    ``glstar help export`` and ``glstar --help export`` become ``glstar export --help``; ``glstar help mounts``, a page
    of the manual, becomes ``glstar manual mounts``.
    """
    words = list(words)
    at = next((k for k, word in enumerate(words) if not word.startswith("-")), None)
    if at is None:
        return words
    named = words[at:]
    asks = any(word in _HELP for word in words[:at])
    if named[0] == "help":
        named, asks = named[1:], True
    before = [word for word in words[:at] if word not in _HELP]
    if not named:
        return [*before, "--help"]
    if asks and named[0] not in COMMANDS and named[0] not in OLD_COMMANDS:
        return [*before, "manual", *(word for word in named if word not in _HELP)]
    named = [*(_present_name(named) or named[0]).split(), *named[1:]]
    return [*before, *named, *(("--help",) if asks and named[-1] not in _HELP else ())]


def _present_name(named: list[str]) -> str | None:
    """Return the present name of a command that is given by an old one; None for a present name.

    ``glstar bench`` had options, and measured the machine; now it is a group, which has none.
    """
    if named[0] == "bench" and named[1:2] and named[1].startswith("-") and named[1] not in _HELP:
        return "doctor bench"
    return OLD_COMMANDS.get(named[0])


def chosen(words: Collection[str]) -> str | None:
    """Return the command that normalised words name, of one or two words; None if there is none."""
    named = [word for word in words if not word.startswith("-")]
    return next((name for n in (2, 1) if (name := " ".join(named[:n])) in COMMANDS), None)


def note_old_names(words: Collection[str]) -> None:
    """Note that the command of a command line has another name now."""
    words = list(words)
    at = next((k for k, word in enumerate(words) if not word.startswith("-")), None)
    if at is not None and (present := _present_name(words[at:])) is not None:
        _note(words, f"glstar {words[at]} is called glstar {present} now; the old name goes with the next release")


def _note(words: Collection[str], text: str) -> None:
    """Write a note to standard error, unless the words have ``--quiet``: the flags are not parsed yet."""
    if not _QUIET & set(words):
        typer.echo(f"note: {text}", err=True)


class Program(TyperGroup):
    """The program: finds commands of one or two words, and prints an error of glstar as one line, exit status 1.

    With ``--traceback`` the traceback is shown too.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; reject empty ones, because an empty path means the working directory."""
        for before, word in pairwise(("", *args)):
            if not word or (word.startswith("--") and word.endswith("=")):
                after = word.rstrip("=") or before
                where = f" after {after}" if after else ""
                raise typer.BadParameter(f"an empty word{where}; is a variable of the shell not set?", ctx=ctx)
        ctx.meta[WORDS] = tuple(args)
        if not ctx.resilient_parsing:
            note_old_names(args)
        remaining: list[str] = super().parse_args(ctx, normalised(args))
        return remaining

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return a command of two words if there is one, such as ``live answer``."""
        name = " ".join(args[:2])
        if len(args) > 1 and name in self.commands:
            return name, self.commands[name], args[2:]
        inner = inner_words(args[0])
        # A link, or a value of an option, is no misspelt command.
        near = nearest_word(args[1], inner) if len(args) > 1 and args[1] not in inner else ""
        if near and not ctx.resilient_parsing:
            ctx.fail(f"No such command {name!r}. Did you mean '{args[0]} {near}'?")
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the commands of one word in the order of ``glstar --help``."""
        return [name for name in super().list_commands(ctx) if " " not in name]

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        try:
            return super().invoke(ctx)
        except GlstarError as error:
            if ctx.params["traceback"]:
                raise
            message = _with_flags(error, ctx.meta[WORDS])
            typer.echo(f"glstar: {' '.join(message.split())}", err=True)
            ctx.exit(1)
        except KeyboardInterrupt as interrupt:
            typer.echo("glstar: stopped", err=True)
            ctx.exit(exit_status(interrupt))


class Command(TyperCommand):
    """A command: reads old names of its flags, suggests values, and shows its options in panels by concept."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with flags under their present names."""
        try:
            words = _completed(_renamed(args, self._name_of(ctx), ctx))
            _refuse_keys(words, {flag for each in self.params for flag in each.opts}, ctx)
            remaining: list[str] = super().parse_args(ctx, words)
        except typer.BadParameter as error:
            error.message = _plain(error)
            error.message += _suggestion(error.message)
            raise
        return remaining

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters: arguments first, then options by panel."""
        parameters: list[Any] = super().get_params(ctx)
        for parameter in parameters:
            concept = next((BY_FLAG[flag] for flag in parameter.opts if flag in BY_FLAG), None)
            if concept is not None:
                _show(parameter, concept, ctx)
        return sorted(parameters, key=_place)

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Return what a shell offers for a word: the commands inside this one, and options."""
        items: list[Any] = super().shell_complete(ctx, incomplete)
        words = [word for word in inner_words(self._name_of(ctx)) if word.startswith(incomplete)]
        # The class of items is private to typer.
        kind = type(super().shell_complete(ctx, "--help")[0])
        return [*map(kind, words), *items]

    def _name_of(self, ctx: Any) -> str:
        """Return the name of the command without the program's name: ``camera show``."""
        names = [ctx.info_name]
        while (ctx := ctx.parent) is not None and ctx.parent is not None:
            names.insert(0, ctx.info_name)
        return " ".join(names)


def _show(parameter: Any, concept: Concept, ctx: Any) -> None:
    """Give an option its place in the help: the panel, and the unit before the meaning."""
    parameter.rich_help_panel = concept.panel
    if parameter.metavar is not None:
        return
    if choices := _choices(parameter, ctx):
        parameter.metavar, parameter.help = "NAME", f"{parameter.help} One of: {choices}."
    else:
        # A switch has no value.
        parameter.metavar = "" if getattr(parameter, "is_flag", False) else concept.unit or None


def _place(parameter: Any) -> int:
    """Return the rank of a parameter in the help of its command."""
    panel = getattr(parameter, "rich_help_panel", None)
    if parameter.param_type_name == "argument":
        return -1
    return PANELS.index(panel) if panel in PANELS else PANELS.index(REPORT)


def _renamed(args: list[str], command: str, ctx: Any) -> list[str]:
    """Return the arguments of a command with old names of flags replaced; note each of them once."""
    renamed, noted = old_flags(command), set[str]()
    words: list[str] = []
    for number, word in enumerate(args):
        if word == "--":
            return [*words, *args[number:]]
        flag, equals, value = word.partition("=")
        if flag in renamed:
            words.append(f"{renamed[flag]}{equals}{value}")
            if flag not in noted and not ctx.resilient_parsing:
                noted.add(flag)
                note = f"{flag} is called {renamed[flag]} now; the old name goes with the next release"
                _note(ctx.meta.get(WORDS, ()), note)
        else:
            words.append(word)
    return words


def _completed(words: list[str]) -> list[str]:
    """Return the arguments with values after the flags that may have none; ``--foxglove`` means its usual port."""
    values = {f"--{concept.flag}": concept.bare for concept in CONCEPTS if concept.bare}
    completed: list[str] = []
    for word, following in pairwise([*words, "-"]):
        completed.append(word)
        if word in values and following.startswith("-"):
            completed.append(values[word])
    return completed


def _with_flags(error: GlstarError, words: Collection[str]) -> str:
    """Return the message of an error; keys of the config that come from flags have the flag before them."""
    message = str(error)
    if not isinstance(error, ConfigError) or error.file is not None:
        return message
    given = {word.partition("=")[0] for word in words}
    for concept in CONCEPTS:
        if concept.key and given & {f"--{concept.flag}", f"-{concept.short or concept.flag}"}:
            message = message.replace(f"{concept.key}: ", f"--{concept.flag}: {concept.key}: ")
    return message


def _plain(error: typer.BadParameter) -> str:
    """Return the message of a wrong value: what it must be, and what it is; typer repeats the words of pydantic."""
    errors = getattr(error.__cause__, "errors", None)
    if errors is None:
        return error.message
    fault = errors(include_url=False)[0]
    must = _MUST.get(fault["type"])
    if must is None:
        return str(fault["msg"].removeprefix("Value error, "))
    return f"must be {must.format(**fault.get('ctx', {}))}, not {fault['input']}"


def _refuse_keys(words: list[str], own: set[str], ctx: Any) -> None:
    """Name the flag if a word is the key of a config, such as ``--latitude-deg``; `own`: the flags of the command."""
    for word in words:
        flag = word.partition("=")[0]
        if word == "--" or flag in own or not flag.startswith("--"):
            continue
        key = flag.removeprefix("--").replace("-", "_")
        present = [f"--{each.flag}" for each in CONCEPTS if each.key.rpartition(".")[2] == key]
        if near := [each for each in present if each in own]:
            ctx.fail(f"No such option: {flag}. Did you mean {near[0]}?")


def _suggestion(message: str) -> str:
    """Return the choice most similar to a wrong one, by the message of typer, which quotes both."""
    parts = re.search(r"'([^']*)' is not one of (.*)\.$", message)
    if parts is None:
        return ""
    return did_you_mean(parts[1], re.findall(r"'([^']*)'", parts[2]), quote="'", or_else="")


def _choices(parameter: Any, ctx: Any) -> str:
    """Return the choices of an option, with spaces between so that no terminal cuts one; empty if it has none."""
    shown = getattr(parameter, "display_type_rich", None) or parameter.make_metavar
    parts = re.fullmatch(r"[<\[](.+\|.+)[>\]]", shown(ctx) or "")
    return parts[1].replace("|", ", ") if parts else ""


def inner_commands(name: str) -> list[str]:
    """Return the commands inside another: ``live answer`` and ``live replay`` of ``live``."""
    return [other for other in COMMANDS if other.startswith(f"{name} ")]


def inner_words(name: str) -> list[str]:
    """Return the second words of the commands inside another: ``replay`` and ``answer`` of ``live``."""
    return [other.removeprefix(f"{name} ") for other in inner_commands(name)]


def epilog_of(name: str) -> str | None:
    """Return the line below the help of a command that names the commands inside it; None if there are none."""
    inner = [f"glstar {other}" for other in inner_commands(name)]
    return f"See also: {', '.join(inner)}" if inner else None
