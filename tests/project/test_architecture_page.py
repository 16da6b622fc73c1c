"""The architecture page shows the layers of pyproject.toml, and the files that it names exist."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "assets" / "manual" / "architecture.md").read_text(encoding="utf-8")
ANSWERS = re.findall(r"^### (.+)\n\n((?:\d\. .*\n(?:   .*\n)*)+)", PAGE, re.MULTILINE)


def test_the_drawing_has_the_layers_of_the_contract() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contract = project["tool"]["importlinter"]["contracts"][0]["layers"]
    layers = [[name.strip().removeprefix("glstar.") for name in layer.split("|")] for layer in contract]

    drawn = [re.findall(r"\w+", line[: line.rindex("│")]) for line in PAGE.splitlines() if line.startswith("│")]
    assert drawn == layers


def test_the_architecture_page_is_short() -> None:
    boxes = [name for line in PAGE.splitlines() if line.startswith("│") for name in line[: line.rindex("│")].split("│")]

    assert sum(bool(name.strip()) for name in boxes) <= 20


def test_the_table_of_rooms_lists_every_room_in_one_line() -> None:
    listed = re.findall(r"^\| `([\w.]+)` \| [^|]+ \|$", PAGE, re.MULTILINE)
    packages = {path.parent.relative_to(ROOT / "glstar") for path in (ROOT / "glstar").rglob("__init__.py")}

    rooms = {".".join(package.parts) for package in packages if len(package.parts) > 1}
    assert {room for room in rooms if room not in listed} == set()
    assert {room for room in listed if room not in rooms} == set()
    assert len(set(listed)) == len(listed)


def test_the_architecture_page_answers_four_questions() -> None:
    assert [question for question, _ in ANSWERS] == [
        "the lens applied",
        "an ArduPilot quaternion taken",
        "the SNR of a star computed",
        "the PNG of a frame written",
    ]


@pytest.mark.parametrize(("question", "answer"), ANSWERS)
def test_an_answer_names_at_most_five_files_and_what_is_in_them(question: str, answer: str) -> None:
    steps = re.findall(r"^\d\. `([^`]+)`: (.*(?:\n   .*)*)", answer, re.MULTILINE)

    assert 1 <= len(steps) <= 5
    for file, meaning in steps:
        text = (ROOT / file).read_text(encoding="utf-8")
        first = re.search(r"`(\w+)(?:\.(\w+))?`", meaning)
        missing = [name for name in (first.groups() if first else ()) if name and not re.search(rf"\b{name}\b", text)]
        assert missing == [], file


def test_every_file_named_on_the_page_exists() -> None:
    named = re.findall(r"`((?:glstar|shaders|tests|assets)/[\w/]+\.\w+)`", PAGE)

    assert [name for name in named if not (ROOT / name).is_file()] == []
