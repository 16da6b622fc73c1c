"""Makes the tables of ``assets/manual/commandline.md`` from the concepts of the command line and its commands.

``python -m tests.scripts.make_commandline_page`` writes the page; a test compares it.
"""

from collections import defaultdict
from pathlib import Path
from typing import Any, Final

from typer.main import get_command

from glstar.cli import app
from glstar.cli.commands import OLD_COMMANDS
from glstar.cli.concepts import CONCEPTS, PANELS, Concept
from glstar.telemetry.synthetic import OLD_KEYS

PAGE: Final = Path(__file__).parents[2] / "assets" / "manual" / "commandline.md"
_BEGIN, _END = "<!-- from glstar/cli/concepts.py -->\n", "\n## Exit status"
# Goes with the next release: its flags are the keys of a described flight.
GOING: Final = {"fly"}


def commands_by_flag() -> dict[str, list[str]]:
    """Return the commands of every flag."""
    found: defaultdict[str, list[str]] = defaultdict(list)

    def collect(name: str, command: Any) -> None:
        for own, inner in getattr(command, "commands", {}).items():
            collect(f"{name} {own}".strip(), inner)
        if not hasattr(command, "commands") and name not in GOING:
            for flag in (flag for parameter in command.params for flag in parameter.opts if flag.startswith("--")):
                found[flag].append(name)

    collect("", get_command(app))
    return {flag: names for flag, names in sorted(found.items()) if flag != "--help"}


def _row(concept: Concept, commands: list[str]) -> str:
    flag = f"`--{concept.flag}`" + (f", `-{concept.short}`" if concept.short else "")
    key = f"`{concept.key}`" if concept.key else ""
    return f"| {flag} | {concept.meaning} | {key} | {', '.join(commands)} |\n"


def page(text: str) -> str:
    """Return the page with its tables made again."""
    head, _, rest = text.partition(_BEGIN)
    _, _, tail = rest.partition(_END)
    commands = commands_by_flag()
    tables = []
    for panel in PANELS:
        rows = [
            _row(concept, commands[f"--{concept.flag}"])
            for concept in CONCEPTS
            if concept.panel == panel and f"--{concept.flag}" in commands
        ]
        tables.append(f"### {panel}\n\n| flag | meaning | key | commands |\n|---|---|---|---|\n{''.join(rows)}")
    return head + _BEGIN + "\n" + "\n".join([*tables, _old_names()]) + _END + tail


def _old_names() -> str:
    """Return the table of names that are read for one release."""
    names = [(f"glstar {old}", f"glstar {new}") for old, new in OLD_COMMANDS.items()]
    names.append(("glstar fly PATH", "glstar convert 'fly:PATH' -o FILE.csv"))
    for concept in CONCEPTS:
        for old in concept.old:
            command, _, flag = old.rpartition(": ")
            if command not in GOING and (command or f"--{flag}" != "--start-utc"):
                names.append((f"{command} --{flag}".strip(), f"--{concept.flag}"))
    names += [(f"{old} of a described flight", new) for old, new in OLD_KEYS.items()]
    rows = "".join(f"| `{old}` | `{new}` |\n" for old, new in names)
    intro = "These names are read for one more release, with a note:"
    return f"## Old names\n\n{intro}\n\n| old | now |\n|---|---|\n{rows}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
