"""The code blocks of the README and the manual, and how each is run.

A block whose fence says ``sh``, ``python`` or ``toml`` is run, unless the line before it is ``<!-- not run: WHY -->``:
a device, a cluster or the reader's own files.  The blocks of a page run in order in one directory that holds the
bundled flight as ``flight.BIN``; Python blocks of a page share their names.  A shell block holds ``glstar`` commands
and comments.  A TOML block is a config; one whose first line is ``# NAME.toml`` is written to that file.
"""

import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from typer.main import get_command
from typer.testing import CliRunner

from glstar.cli import app
from glstar.config import Config
from glstar.system.resources import asset

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "assets" / "manual").glob("*.md"))]
LANGUAGES = {"sh", "python", "toml"}

_BLOCK = re.compile(
    r"(?:^<!-- not run: (?P<why>[^\n]+) -->\n)?^```(?P<language>\w+)\n(?P<code>.*?)^```$", re.DOTALL | re.M
)


@dataclass(frozen=True)
class Block:
    """A code block; `why_not` is the reason why it is not run, empty if it is."""

    language: str
    code: str
    line: int
    why_not: str

    @property
    def commands(self) -> list[list[str]]:
        """The commands of a shell block, split into words; comments are left out."""
        lines = self.code.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page that are code."""
    text = page.read_text(encoding="utf-8")
    for match in _BLOCK.finditer(text):
        if match["language"] in LANGUAGES:
            line = text[: match.start("code")].count("\n") + 1
            yield Block(match["language"], match["code"], line, match["why"] or "")


def run_page(page: Path, folder: Path) -> None:
    """Run the blocks of a page in a folder, which is the working directory; check the syntax of the others."""
    shutil.copy(asset("adelaide.BIN"), folder / "flight.BIN")
    names: dict[str, object] = {"__name__": page.stem}
    for block in blocks(page):
        where = f"{page.name}:{block.line}"
        if block.language == "toml":
            _load(block, folder, where)
        elif block.language == "python":
            code = compile("\n" * (block.line - 1) + block.code, str(page), "exec")
            if not block.why_not:
                exec(code, names)
        else:
            _shell(block, where)


def _load(block: Block, folder: Path, where: str) -> None:
    named = re.match(r"# (\S+\.toml)\n", block.code)
    file = folder / (named[1] if named else "block.toml")
    file.write_text(block.code, encoding="utf-8")
    assert block.why_not or Config.load(file), where


def _shell(block: Block, where: str) -> None:
    checked = subprocess.run(["bash", "-n"], input=block.code, text=True, capture_output=True, check=False)
    assert checked.returncode == 0, f"{where}: {checked.stderr}"
    if block.why_not:
        for line in block.code.replace("\\\n", " ").splitlines():
            for command in re.findall(r"(?:^|&& |/)glstar (.*)", line.partition("#")[0]):
                check_options(shlex.split(command), where)
        return
    for program, *words in block.commands:
        assert program == "glstar", f"{where}: only glstar is run; mark the block as not run"
        check_options(words, where)
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, f"{where}: glstar {shlex.join(words)}\n{result.output}{result.exception or ''}"


@cache
def _program() -> Any:
    """Return the program with all commands; to build it takes 35 ms."""
    return get_command(app)


def check_options(words: list[str], where: str) -> None:
    """Check that a command of glstar exists and has the options that are given."""
    command: Any = _program()
    rest = list(words)
    while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        name = " ".join(rest[:2]) if " ".join(rest[:2]) in command.commands else rest[0]
        assert name in command.commands, f"{where}: glstar has no command {name}"
        command, rest = command.commands[name], rest[len(name.split()) :]
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    known |= {"-h", "--help"}
    for word in rest:
        option = word.partition("=")[0]
        if re.match(r"--?[A-Za-z]", option):
            assert option in known, f"{where}: {command.name} has no option {option}"
