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


def test_the_architecture_page_answers_four_questions() -> None:
    assert [question for question, _ in ANSWERS] == ["vignetting", "a log format", "an overlay", "planets"]


@pytest.mark.parametrize(("question", "answer"), ANSWERS)
def test_an_answer_names_at_most_five_files_and_they_exist(question: str, answer: str) -> None:
    files = re.findall(r"^\d\. `([^`]+)`( \(\*new\*\))?", answer, re.MULTILINE)

    assert 1 <= len(files) <= 5
    assert [name for name, new in files if not new and not (ROOT / name).is_file()] == []
    assert [name for name, new in files if new and (ROOT / name).exists()] == []
