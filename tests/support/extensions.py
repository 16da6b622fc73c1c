"""The files and lines that the manual's page *extending* adds to glstar, put into a copy of the checkout.

A block of the page below ``<!-- file: PATH -->`` is a new file.  One below ``<!-- into PATH before: TEXT -->`` (or
``after:``) is lines beside the only line of a file that begins with TEXT; ``+2`` leaves two empty lines between them.
One below ``<!-- in PATH replace: TEXT -->`` takes the place of that line.
"""

import re
import shutil
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "assets" / "manual" / "extending.md"
_BLOCK = re.compile(
    r"^<!-- (?P<what>file|into|in)(?P<rest>[: ][^\n]+) -->\n```\w+\n(?P<code>.*?)^```$", re.DOTALL | re.M
)
_PLACE = re.compile(r" (?P<path>\S+) (?P<where>before|after|replace)(?: \+(?P<empty>\d))?: (?P<text>.+)")


def copy_of_checkout(folder: Path) -> Path:
    """Copy the files that checks and glstar need into a folder, and return it."""
    ignored = shutil.ignore_patterns("__pycache__", ".pytest_cache", "*.egg-info")
    for name in ("glstar", "shaders", "assets", "tests", ".github", ".ci", ".devcontainer"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", ".gitignore"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def extend(checkout: Path) -> list[str]:
    """Add everything on the page to a copy of the checkout; return the paths of the Python files it adds or changes."""
    changed = []
    for block in _BLOCK.finditer(PAGE.read_text(encoding="utf-8")):
        if block["what"] == "file":
            path = block["rest"].removeprefix(": ")
            assert not (checkout / path).exists(), f"{path} exists already"
            (checkout / path).write_text(block["code"], encoding="utf-8")
        else:
            place = _PLACE.fullmatch(block["rest"])
            assert place is not None, block["rest"]
            path = place["path"]
            _edit(checkout / path, place, block["code"])
        changed.append(path)
    return sorted({path for path in changed if path.endswith(".py")})


def _edit(file: Path, place: re.Match[str], code: str) -> None:
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    at = [number for number, line in enumerate(lines) if line.strip().startswith(place["text"])]
    assert len(at) == 1, f"{len(at)} lines of {file} begin with {place['text']}"
    empty = "\n" * int(place["empty"] or 0)
    first = at[0] + (place["where"] == "after")
    lines[first : at[0] + (place["where"] != "before")] = [code + empty if place["where"] == "before" else empty + code]
    file.write_text("".join(lines), encoding="utf-8")
