"""The tasks of pyproject.toml, the benchmarks, and where tests take their helpers from."""

import re
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.bench.__main__ import BENCHMARKS, main

ROOT = Path(__file__).parents[2]
TASKS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["poe"]["tasks"]
DOCUMENTS = (ROOT / "README.md", *(ROOT / ".github").glob("*.md"), *(ROOT / "assets" / "manual").glob("*.md"))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_tasks_and_benchmarks_that_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")

    assert {name for name in re.findall(r"\bpoe ([a-z-]+)", text) if name not in TASKS} == set()
    assert {name for name in re.findall(r"\bpoe bench ([a-z-]+)", text) if name not in BENCHMARKS} == set()


def test_every_benchmark_has_a_module_and_a_line_in_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert [name for name, (module, _) in BENCHMARKS.items() if find_spec(f"tests.bench.{module}") is None] == []

    main([])

    listed = capsys.readouterr().out
    assert [name for name, (_, meaning) in BENCHMARKS.items() if f"{name:15} {meaning}" not in listed] == []


def test_options_without_a_name_are_those_of_drawing_frames(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["bench"])
    with pytest.raises(SystemExit):
        main(["--only", "nothing"])

    assert "poe bench frames: error: argument --only: invalid choice: 'nothing'" in capsys.readouterr().err


def test_a_benchmark_that_does_not_exist_is_refused_with_the_list() -> None:
    with pytest.raises(SystemExit, match=r"there is no benchmark speed \(there are frames, calibrate"):
        main(["speed"])


def test_the_quick_task_runs_folders_that_exist() -> None:
    words = " ".join(step["cmd"] for step in TASKS["quick"]["sequence"] if isinstance(step, dict)).split()
    folders = [word for word in words if word.startswith("tests/")]

    assert folders
    assert [folder for folder in folders if not (ROOT / folder).exists()] == []


def test_helpers_that_tests_share_are_in_the_folder_of_helpers() -> None:
    """A test module that another one imports cannot be moved, renamed or deleted on its own."""
    imports = re.compile(r"^\s*from (tests\.\w+\.test_\w+|tests\.\w+ import test_\w+)", re.MULTILINE)
    sources = [path for room in ("e2e", "gl", "support", "link") for path in (ROOT / "tests" / room).glob("*.py")]

    found = {path.name: imports.findall(path.read_text(encoding="utf-8")) for path in sources}
    assert {name: modules for name, modules in found.items() if modules} == {}
