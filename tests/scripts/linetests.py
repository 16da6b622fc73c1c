"""Record which tests run each line of glstar, for random faults: only those tests can see a fault there.

::

    python -m tests.scripts.linetests FOLDER                    # the whole suite: half an hour on two processors
    python -m tests.scripts.linetests FOLDER -n 2 tests/score    # some tests, with arguments of pytest
    python -m tests.scripts.mutants --random 100 --lines FOLDER

Processes that a test starts count as the test, unless it kills them.  FOLDER has the lines, by test, and how long each
test took.
"""

import argparse
import ast
import itertools
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Generator, Iterable, Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import pytest
from coverage import Coverage, CoverageData

ROOT = Path(__file__).resolve().parents[2]
_FOLDER = "GLSTAR_LINETESTS"
_PHASE = re.compile(r" \((setup|call|teardown)\)$")
_SETTINGS = """[run]
source = {source}
data_file = {folder}/lines
parallel = true
concurrency = thread,multiprocessing
context = ${{PYTEST_CURRENT_TEST-}}
disable_warnings = no-data-collected,module-not-measured,module-not-imported,couldnt-parse,dynamic-conflict
"""


class LineTests:
    """What a run recorded."""

    def __init__(self, folder: Path) -> None:
        self._data = CoverageData(str(folder / "lines"))
        self._data.read()
        self._files = {_relative(file): file for file in self._data.measured_files()}
        self._seconds: dict[str, float] = json.loads((folder / "seconds.json").read_text(encoding="utf-8"))

    def of(self, file: str, line: int, most_s: float = math.inf) -> list[str]:
        """Return the tests that run a line of a file, the quickest first, which together take up to `most_s`.

        What runs once, when a module is imported, is seen by the tests that run any of the lines which name what it
        defines, in any module, and then by those of any line of its module; a default by those of its function.
        """
        by_line = self._by_line(file)
        where = _statement(_text(file), line)
        if where.is_at_import:
            found = _named(by_line, where.body) | self._of_names(file, where)
        else:
            found = _named(by_line, range(where.begin, where.end + 1))
        others = _named(by_line, _in_functions(file)) if where.is_at_import or not found else set()
        tests = [
            one
            for some in (found, others - found)
            for one in sorted((self._seconds[test], test) for test in some & self._seconds.keys())
        ]
        passed = itertools.accumulate(seconds for seconds, _ in tests)
        return [test for (_, test), seconds in zip(tests, passed, strict=True) if seconds <= most_s]

    def _by_line(self, file: str) -> dict[int, list[str]]:
        return self._data.contexts_by_lineno(self._files[file]) if file in self._files else {}

    def _of_names(self, file: str, where: "_Statement") -> set[str]:
        """Return the tests of the lines that name what a statement defines; private names are those of their module."""
        found: set[str] = set()
        for name in where.names:
            word = re.compile(rf"\b{re.escape(name)}\b")
            for other in [file] if name.startswith("_") else self._files:
                lines = _text(other).splitlines()
                named = [k for k in _in_functions(other) if word.search(lines[k - 1])]
                found |= _named(self._by_line(other), named) if named else set()
        return found

    def at_import(self, file: str, line: int) -> bool:
        """Whether a line of a file runs only when its module is imported."""
        by_line, where = self._by_line(file), _statement(_text(file), line)
        return where.is_at_import or not _named(by_line, range(where.begin, where.end + 1))

    def time_s(self, tests: Iterable[str]) -> float:
        """Return the time that tests took together, s."""
        return sum(self._seconds[test] for test in tests)

    @property
    def count(self) -> int:
        """Number of tests recorded."""
        return len(self._seconds)


def _named(by_line: dict[int, list[str]], lines: Iterable[int]) -> set[str]:
    """Return the tests of some lines: a context is a test, or a test and its phase, or nothing."""
    contexts = {context for line in lines for context in by_line.get(line, ())}
    return {_PHASE.sub("", context) for context in contexts} - {""}


def _relative(file: str) -> str:
    """Return a measured file's path below the checkout that it lay in."""
    parts = Path(file).parts
    return "/".join(parts[len(parts) - 1 - parts[::-1].index("glstar") :]) if "glstar" in parts else file


@cache
def _text(file: str) -> str:
    return (ROOT / file).read_text(encoding="utf-8")


class _Statement(NamedTuple):
    """What runs at a line of a module."""

    begin: int  # Its first and last line
    end: int
    names: tuple[str, ...]  # What it defines
    body: range  # Lines of the body if it is the head of a function
    is_at_import: bool  # Whether it runs when the module is imported


def _statement(text: str, line: int) -> _Statement:
    nodes = [node for node in ast.walk(_parsed(text)) if isinstance(node, ast.stmt)]
    around = [node for node in nodes if node.lineno <= line <= (node.end_lineno or node.lineno)]
    functions = (node for node in around if isinstance(node, ast.FunctionDef))
    is_at_import = not any(line >= node.body[0].lineno for node in functions)
    if not around:
        return _Statement(line, line, (), range(0), is_at_import)
    smallest = min(around, key=lambda node: (node.end_lineno or node.lineno) - node.lineno)
    if isinstance(smallest, ast.FunctionDef):
        body = range(smallest.body[0].lineno, (smallest.end_lineno or line) + 1)
        return _Statement(line, line, (smallest.name,), body, is_at_import)
    if hasattr(smallest, "body"):  # Its body has lines of its own
        return _Statement(line, line, (), range(0), is_at_import)
    stored = [node for node in ast.walk(smallest) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    names = tuple(node.id for node in stored)
    return _Statement(smallest.lineno, smallest.end_lineno or line, names, range(0), is_at_import)


@cache
def _in_functions(file: str) -> list[int]:
    """Return the lines of a file in the bodies of functions, which do not run when it is imported."""
    functions = [node for node in ast.walk(_parsed(_text(file))) if isinstance(node, ast.FunctionDef)]
    return sorted({k for node in functions for k in range(node.body[0].lineno, (node.end_lineno or 0) + 1)})


@lru_cache(maxsize=4)
def _parsed(text: str) -> ast.Module:
    return ast.parse(text)


# As a plugin of pytest, in each of its processes.
_seconds: dict[str, float] = {}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    coverage = Coverage.current()
    if coverage is not None:
        coverage.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        if coverage is not None:
            coverage.switch_context("")


def pytest_sessionfinish(session: pytest.Session) -> None:
    coverage = Coverage.current()
    if coverage is not None:
        coverage.save()
    if not hasattr(session.config, "workerinput"):
        Path(os.environ[_FOLDER], "seconds.json").write_text(json.dumps(_seconds), encoding="utf-8")


def record(folder: Path, options: Sequence[str]) -> int:
    """Run tests, with arguments of pytest, and record them in a new folder; return pytest's status."""
    folder = folder.resolve()
    folder.mkdir(parents=True)
    settings = folder / "settings.ini"
    settings.write_text(_SETTINGS.format(source=ROOT / "glstar", folder=folder), encoding="utf-8")
    environment = os.environ | {"COVERAGE_PROCESS_START": str(settings), _FOLDER: str(folder)}
    environment.pop("PYTEST_CURRENT_TEST", None)  # of a test that records others
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.scripts.linetests"]
    status = subprocess.run([*command, *options], cwd=ROOT, env=environment, check=False).returncode
    combine = [sys.executable, "-m", "coverage", "combine", f"--rcfile={settings}", "-q"]
    subprocess.run(combine, cwd=folder, check=True)
    return status


def main() -> int:
    """Read the command line, run the tests and record them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a new folder for the result")
    wanted, options = parser.parse_known_args()
    status = record(wanted.folder, options or ["-n", "auto", "--dist", "worksteal"])
    print(f"{LineTests(wanted.folder).count} tests recorded in {wanted.folder}")
    return status


if __name__ == "__main__":
    sys.exit(main())
