"""The README is short, its links are valid, and continuous integration runs its two commands."""

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

import pytest
from typer.main import get_command

from glstar.cli import app
from tests.support import manualblocks

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_two_commands_are_run_by_continuous_integration() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    install, check = re.findall(r"^python3 -m venv .*$", README, re.MULTILINE)
    assert "pip install ." in install
    assert "glstar demo" in install
    for words in ('pip" install -q .', 'glstar" demo', "pip install -q -e '.[dev]'", "poe check"):
        assert words in script
    assert "pip install -e '.[dev]' && poe check" in check


def test_the_environments_of_the_two_commands_are_ignored() -> None:
    """The linter skips what Git ignores: in an environment inside the checkout it finds the scripts of libraries."""
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").split()
    environments = re.findall(r"^python3 -m venv (\S+)", README, re.MULTILINE)
    assert len(environments) == 2
    for environment in environments:
        assert any(fnmatch(f"{environment}/", pattern) for pattern in ignored)


def test_the_readme_lists_every_command() -> None:
    listed = re.findall(r"\| `glstar ([\w-]+)[^|]*` \|", README)

    program = get_command(app)
    assert sorted(listed) == sorted(name for name in program.list_commands(None) if not program.commands[name].hidden)
    assert len(listed) <= 12


def test_one_table_of_the_readme_has_every_extra() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    table = README.partition("## Extras")[2].partition("## ")[0]

    assert set(settings["project"]["optional-dependencies"]) <= set(re.findall(r"`(\w+)`", table))


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120


@pytest.mark.parametrize("page", manualblocks.PAGES, ids=lambda page: page.stem)
def test_every_link_of_a_page_points_to_a_file(page: Path) -> None:
    links = re.findall(r"\]\((?!https?://)([^)#]+)", page.read_text(encoding="utf-8"))

    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", manualblocks.PAGES, ids=lambda page: page.stem)
def test_every_manual_page_named_on_a_page_exists(page: Path) -> None:
    topics = {one.stem for one in manualblocks.PAGES}

    named = re.findall(r"glstar manual ([a-z]+)", page.read_text(encoding="utf-8"))
    assert set(named) <= topics


def test_the_readme_links_to_every_page_of_the_manual() -> None:
    linked = set(re.findall(r"\(assets/manual/([\w-]+)\.md\)", README))

    assert linked == {page.stem for page in manualblocks.PAGES} - {"README"}


def test_the_pictures_are_small() -> None:
    pictures = [path for path in (ROOT / "assets" / "manual").iterdir() if path.suffix in {".png", ".jpg", ".svg"}]

    assert pictures
    assert sum(path.stat().st_size for path in pictures) < 2e6  # bytes
