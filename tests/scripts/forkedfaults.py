"""Run tests on many faults in one process of pytest, which forks for each fault: some five a second.

A plugin of pytest for `mutants`, in a copy of the checkout.  Tests are collected once.  A fault in a function replaces
that function's code in the fork.  Any other, such as a constant's or a default's, is seen by glstar and tests imported
once more there.  Files hold the fault meanwhile, for modules imported later and programs that tests start.
"""

import gc
import json
import os
import select
import shutil
import signal
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FunctionType

import pytest
from _pytest.unraisableexception import unraisable_exceptions

ROOT = Path(__file__).resolve().parents[2]
# Environment: the path of the list of faults, and the descriptor of the pipe that takes the outcomes.
TASKS, OUTCOMES = "GLSTAR_FAULTS", "GLSTAR_FAULTS_OUTCOMES"
# Tests that may fail without a fault before the fault is given up.
MOST_BROKEN = 5
# Time that a fault may take beside its tests, s, and how much longer than recorded the tests may take.
_STARTS_S, _SLOWER = 60.0, 5.0
# Whether a code object is a function's, not that of a module or a class: CO_NEWLOCALS of `inspect`.
_OF_A_FUNCTION = 2


@dataclass(frozen=True, slots=True)
class Fault:
    """A change to the sources that the tests must detect.

    Attributes
    ----------
    name : str
    file : str
        Relative to the checkout.
    old, new : str
        A snippet that occurs exactly once in the file, and its replacement.
    means : str
        The consequence for the user.
    tests : tuple of str
        Arguments of pytest.
    tests_s : float
        Recorded time of the tests, s.
    at_import : bool
        Whether the line runs only when modules are imported.
    """

    name: str
    file: str
    old: str
    new: str
    means: str
    tests: tuple[str, ...]
    tests_s: float = 0.0
    at_import: bool = False

    @property
    def occurrences(self) -> int:
        """Number of occurrences of the snippet in the file; 1 for a valid fault."""
        path = ROOT / self.file
        return path.read_text(encoding="utf-8").count(self.old) if path.is_file() else 0


def _by_place(code: CodeType) -> Iterator[tuple[tuple[str, int], CodeType]]:
    """Yield a code object and those in it, with what names them in both versions of a file."""
    yield (code.co_qualname, code.co_firstlineno), code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _by_place(constant)


class Loaded:
    """The functions of glstar that are loaded."""

    def __init__(self) -> None:
        self._of: dict[str, dict[tuple[str, int], list[FunctionType]]] = defaultdict(lambda: defaultdict(list))
        gc.unfreeze()  # What is frozen is not listed
        for one in gc.get_objects():
            if type(one) is FunctionType and one.__code__.co_filename.startswith(str(ROOT / "glstar")):
                self._of[one.__code__.co_filename][one.__code__.co_qualname, one.__code__.co_firstlineno].append(one)
        gc.freeze()

    def changes(self, path: Path, old: str, new: str) -> list[tuple[FunctionType, CodeType]] | None:
        """Return the code that functions take when a file is changed; None if it must be imported once more."""
        if str(path) not in self._of:
            return []
        before, after = (dict(_by_place(compile(text, str(path), "exec", dont_inherit=True))) for text in (old, new))
        changed = [place for place, code in after.items() if place in before and before[place] != code]
        # Each function's code holds the functions in it: the last that differs is where the fault is.
        if not changed or not after[changed[-1]].co_flags & _OF_A_FUNCTION:
            return None
        functions = self._of[str(path)]
        found = [(function, after[place]) for place in changed if place in functions for function in functions[place]]
        return found or None


@contextmanager
def changed_file(path: Path, old: str, new: str) -> Iterator[tuple[str, str]]:
    """Replace a snippet in a file for a while; yield the text before and after."""
    whole = path.read_text(encoding="utf-8")
    changed = whole.replace(old, new)
    _write(path, changed)
    try:
        yield whole, changed
    finally:
        _write(path, whole)


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    # Python detects a stale .pyc by time (whole seconds) and size, which two versions may share.
    for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
        compiled.unlink()


class Failures:
    """Keeps the first test that fails, as a plugin of pytest."""

    def __init__(self) -> None:
        self.first: str | None = None

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and self.first is None:
            self.first = report.nodeid


class Forks:
    """Runs tests in forks of this process."""

    def __init__(self, session: pytest.Session) -> None:
        self._session = session
        self._items = {item.nodeid: item for item in session.items}
        self._loaded = Loaded()
        self._valid: set[str] = set()
        # A file left open by an import would count as the first test's.
        session.config.stash[unraisable_exceptions].clear()

    def judged(self, fault: Fault) -> str | None:
        """Return what catches a fault: the name of a test, or a reason; None if nothing does."""
        tests = [test for test in fault.tests if test in self._items]
        for _ in range(MOST_BROKEN):
            if not tests:
                return None
            with changed_file(ROOT / fault.file, fault.old, fault.new) as (whole, changed):
                changes = None if fault.at_import else self._loaded.changes(ROOT / fault.file, whole, changed)
                failed = self._failed(tests, changes, fault.tests_s)
            if failed is None or failed in self._valid:
                return failed
            if failed not in tests:  # No end, or no import: by the fault, or a slow machine
                return failed if self._failed(tests, [], fault.tests_s) != failed else None
            if self._failed([failed], [], fault.tests_s) is None:
                self._valid.add(failed)
                return failed
            tests.remove(failed)  # It fails without the fault
        return None

    def _failed(
        self, tests: Sequence[str], changes: Sequence[tuple[FunctionType, CodeType]] | None, tests_s: float
    ) -> str | None:
        """Run tests in a fork and return the first that fails, or why they did not end."""
        read, write = os.pipe()
        folder = tempfile.mkdtemp(prefix="glstar-fault-")
        process = os.fork()
        if process == 0:
            try:
                os.setpgrp()  # With the programs that tests start
                os.write(write, self._run(tests, changes, Path(folder)).encode())
            finally:
                os._exit(0)
        os.close(write)
        limit_s = _STARTS_S + _SLOWER * tests_s
        try:
            if not select.select([read], [], [], limit_s)[0]:
                return f"no end within {limit_s:.0f} s"
            return {b"": "an end of the process", b"passed": None}.get(answer := os.read(read, 65536), answer.decode())
        finally:
            os.close(read)
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            shutil.rmtree(folder, ignore_errors=True)

    def _run(self, tests: Sequence[str], changes: Sequence[tuple[FunctionType, CodeType]] | None, folder: Path) -> str:
        failures = Failures()
        if changes is None:
            for name in [name for name in sys.modules if name.partition(".")[0] in {"glstar", "tests", "conftest"}]:
                del sys.modules[name]
            arguments = ["-x", "-q", "-p", "no:cacheprovider", f"--basetemp={folder / 'tests'}", *tests]
            status = pytest.main(arguments, plugins=[failures])
            return failures.first or ("passed" if status == 0 else "an error when glstar is imported")
        for function, code in changes:
            function.__code__ = code
        config = self._session.config
        config.pluginmanager.register(failures)
        config._tmp_path_factory._basetemp = folder  # type: ignore[attr-defined]
        items = [self._items[test] for test in tests]
        for item, following in zip(items, [*items[1:], None], strict=True):
            config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if failures.first is not None:
                break
        return failures.first or "passed"


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool:
    forks = Forks(session)
    with os.fdopen(int(os.environ[OUTCOMES]), "w", encoding="utf-8", buffering=1) as outcomes:
        for table in json.loads(Path(os.environ[TASKS]).read_text(encoding="utf-8")):
            began_s = time.monotonic()
            caught_by = forks.judged(Fault(**table))
            print(json.dumps([caught_by, time.monotonic() - began_s]), file=outcomes)
    return True
