"""Record which tests run each line of glstar, for random faults: only those tests can see a fault there.

::

    python -m tests.scripts.linetests FOLDER                    # the whole suite: half an hour on two processors
    python -m tests.scripts.linetests FOLDER -n 2 tests/score    # some tests, with arguments of pytest
    python -m tests.scripts.mutants --random 100 --lines FOLDER

Needs the package `coverage`, which the development environment does not have.  Processes that tests start count as the
tests; what a test kills is not seen.  The names of the tests, and how long each took, lie in FOLDER.
"""

import argparse
import ast
import json
import os
import subprocess
import sys
from functools import cached_property
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
_FOLDER = "GLSTAR_LINETESTS"
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
        from coverage import CoverageData

        self._data = CoverageData(str(folder / "lines"))
        self._data.read()
        self._files = {_relative(file): file for file in self._data.measured_files()}
        self._seconds: dict[str, float] = json.loads((folder / "seconds.json").read_text(encoding="utf-8"))

    def of(self, file: str, line: int) -> list[str]:
        """Return the tests that run a line of a file, the quickest first.

        What runs once, when a module is imported, is seen by the tests that run any of the lines which name what it
        defines, or else any line of the module.
        """
        by_line = self._data.contexts_by_lineno(self._files[file]) if file in self._files else {}
        begin, end, names = _statement(file, line)
        found = _named(by_line, range(begin, end + 1))
        if not found and names:
            text = (ROOT / file).read_text(encoding="utf-8").splitlines()
            found = _named(by_line, [k for k, one in enumerate(text, 1) if any(name in one for name in names)])
        found = found or _named(by_line, by_line)
        return sorted(found & self._seconds.keys(), key=lambda test: (self._seconds[test], test))

    def seconds(self, tests: list[str]) -> float:
        """Return how long tests took."""
        return sum(self._seconds[test] for test in tests)

    @cached_property
    def count(self) -> int:
        """Number of tests recorded."""
        return len(self._seconds)


def _named(by_line: dict[int, list[str]], lines) -> set[str]:  # noqa: ANN001
    contexts = {context for line in lines for context in by_line.get(line, ())}
    return {context.rpartition(" (")[0] if context.endswith(")") else context for context in contexts} - {""}


def _relative(file: str) -> str:
    """Return a measured file's path below the checkout that it lay in."""
    parts = Path(file).parts
    return "/".join(parts[len(parts) - 1 - parts[::-1].index("glstar") :]) if "glstar" in parts else file


def _statement(file: str, line: int) -> tuple[int, int, list[str]]:
    """Return the first and last line of the smallest statement at a line, and the names that it assigns to."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    around = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or node.lineno)
    ]
    smallest = min(around, key=lambda node: (node.end_lineno or node.lineno) - node.lineno)
    if isinstance(smallest, ast.FunctionDef | ast.ClassDef | ast.For | ast.While | ast.If | ast.With | ast.Try):
        return line, line, [smallest.name] if isinstance(smallest, ast.FunctionDef | ast.ClassDef) else []
    assigned = [
        node.id for node in ast.walk(smallest) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
    ]
    return smallest.lineno, smallest.end_lineno or line, assigned


# As a plugin of pytest, in each of its processes.
_seconds: dict[str, float] = {}


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item):  # noqa: ANN201
    from coverage import Coverage

    coverage = Coverage.current()
    if coverage is not None:
        coverage.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        if coverage is not None:
            coverage.switch_context("")


def pytest_sessionfinish(session: pytest.Session) -> None:
    from coverage import Coverage

    coverage = Coverage.current()
    if coverage is not None:
        coverage.save()
    if not hasattr(session.config, "workerinput"):
        Path(os.environ[_FOLDER], "seconds.json").write_text(json.dumps(_seconds), encoding="utf-8")


def main() -> int:
    """Read the command line, run the tests and combine what their processes recorded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a new folder for the result")
    wanted, more = parser.parse_known_args()
    folder = wanted.folder.resolve()
    folder.mkdir(parents=True)
    settings = folder / "settings.ini"
    settings.write_text(_SETTINGS.format(source=ROOT / "glstar", folder=folder), encoding="utf-8")
    environment = os.environ | {"COVERAGE_PROCESS_START": str(settings), _FOLDER: str(folder)}
    options = more or ["-n", "auto", "--dist", "worksteal"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.scripts.linetests"]
    failed = subprocess.run([*command, *options], cwd=ROOT, env=environment, check=False).returncode
    combine = [sys.executable, "-m", "coverage", "combine", f"--rcfile={settings}", "-q"]
    subprocess.run(combine, cwd=folder, check=True)
    print(f"{LineTests(folder).count} tests recorded in {folder}")
    return failed


if __name__ == "__main__":
    sys.exit(main())
