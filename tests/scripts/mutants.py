"""Inject faults, one at a time, and check that the tests detect them.

::

    python -m tests.scripts.mutants                          # every fault of tests/faults: minutes
    python -m tests.scripts.mutants --only leap zenith       # those whose names contain one of these words
    python -m tests.scripts.mutants --list                   # a list of all faults
    python -m tests.scripts.mutants --random 100 --lines DIR # drawn at random from the sources, by `randomfaults`

Works on copies of the checkout, one per worker, in a temporary directory.  First the tests run without any fault: they
must pass.  A fault is caught if one of its tests fails.  The exit status is 1 if fewer than 95 % are caught, 2 if tests
fail without a fault or a snippet does not occur exactly once.

The tests of a random fault are those that run its line, as `linetests` recorded it in DIR: the quickest first, up to
--most-s in all, so the result is a lower bound of what the suite catches.  A test that fails without the fault, too, is
left out.  They run in forks of one process for each worker, by `forkedfaults`: some five faults a second.
"""

import argparse
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.scripts.forkedfaults import OUTCOMES, TASKS, Fault, changed_file
from tests.scripts.linetests import LineTests
from tests.scripts.randomfaults import drawn_changes

ROOT = Path(__file__).resolve().parents[2]
FAULTS = ROOT / "tests" / "faults"
# Fraction of the faults that the tests must catch.
LEAST_CAUGHT = 0.95
# Timeout, s: a fault with which a test does not end is caught.
SLOWEST_S = 300
NOT_COPIED = (".git", "__pycache__", "*.egg-info", ".*_cache", ".venv*", "build", "dist", "*.pyc")
# pytest's exit status: a test failed.
FAILED = 1
_PYTEST = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--no-header"]
# Tests named for each survivor.
MOST_NAMED = 8


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result for one fault: the first test that failed, or None if it survived."""

    fault: Fault
    caught_by: str | None
    seconds: float


def kept_faults(folder: Path = FAULTS) -> list[Fault]:
    """Return the faults of all files in a folder, one file for each package."""
    lists = [tomllib.loads(path.read_text(encoding="utf-8"))["fault"] for path in sorted(folder.glob("*.toml"))]
    tables = [table for listed in lists for table in listed]
    return [Fault(**table | {"tests": tuple(table["tests"])}) for table in tables]


class Checkout:
    """A copy of the checkout, in which faults are injected.

    Tests and their child processes import `glstar` from it, not an installed one.
    """

    def __init__(self, folder: Path) -> None:
        self.root = folder / "checkout"
        shutil.copytree(ROOT, self.root, ignore=shutil.ignore_patterns(*NOT_COPIED), symlinks=True)
        # Without these links an editable install would use shaders and data of the original checkout.
        for beside in ("shaders", "assets"):
            (self.root / "glstar" / beside).symlink_to(self.root / beside, target_is_directory=True)
        # Tests look for real logs and images beside the checkout.
        if (shared := ROOT.parent / "shared").is_dir():
            (folder / "shared").symlink_to(shared.resolve(), target_is_directory=True)

    def broken_by(self, fault: Fault) -> AbstractContextManager[object]:
        """Inject a fault for a while."""
        return changed_file(self.root / fault.file, fault.old, fault.new)

    def failures(self, tests: Sequence[str], *options: str, slowest_s: float | None = None) -> list[str]:
        """Run tests and return those that fail."""
        # Beside the checkout, whose files some tests list.
        named = self.root.parent / "tests.txt"
        named.write_text("\n".join(tests), encoding="utf-8")
        try:
            done = subprocess.run(
                [*_PYTEST, *options, f"@{named}"],
                cwd=self.root,
                env=self._environment(),
                capture_output=True,
                text=True,
                check=False,
                timeout=slowest_s,
            )
        except subprocess.TimeoutExpired:
            return [f"no end within {slowest_s} s"]
        if done.returncode == 0:
            return []
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        if done.returncode != FAILED and not failed:
            raise RuntimeError(f"pytest cannot run {' '.join(tests)}:\n{done.stdout}{done.stderr}")
        return failed or done.stdout.splitlines()[-1:]

    def judge(self, faults: Sequence[Fault], say: Callable[[Outcome], None]) -> None:
        """Run the tests of some faults in forks of one process of pytest, and say each outcome as it comes."""
        tasks, output = self.root.parent / "tasks.json", self.root.parent / "output.txt"
        tasks.write_text(json.dumps([asdict(fault) for fault in faults]), encoding="utf-8")
        files = sorted({test.partition("::")[0] for fault in faults for test in fault.tests})
        read, write = os.pipe()
        with output.open("w", encoding="utf-8") as printed:
            process = subprocess.Popen(
                [*_PYTEST, "-p", "tests.scripts.forkedfaults", *(files or ["tests/project"])],
                cwd=self.root,
                env=self._environment() | {TASKS: str(tasks), OUTCOMES: str(write)},
                pass_fds=[write],
                stdout=printed,
                stderr=subprocess.STDOUT,
            )
        os.close(write)
        waiting = list(faults)
        with os.fdopen(read, encoding="utf-8") as lines:
            for line in lines:
                say(Outcome(waiting.pop(0), *json.loads(line)))
        if process.wait() != 0 or waiting:
            raise RuntimeError(f"pytest cannot run:\n{output.read_text(encoding='utf-8')}")

    def _environment(self) -> dict[str, str]:
        return os.environ | {"PYTHONPATH": str(self.root)}


class Workers:
    """Checkouts, one per thread."""

    def __init__(self, folder: Path, count: int) -> None:
        self.count = count
        self._free: queue.SimpleQueue[Checkout] = queue.SimpleQueue()
        for number in range(count):
            (folder / str(number)).mkdir()
            self._free.put(Checkout(folder / str(number)))

    @contextmanager
    def one(self) -> Iterator[Checkout]:
        checkout = self._free.get()
        try:
            yield checkout
        finally:
            self._free.put(checkout)

    def failures_when_whole(self, tests: Sequence[str]) -> list[str]:
        """Return which tests fail without a fault."""
        with self.one() as checkout:
            return checkout.failures(tests) if tests else []

    def outcome(self, fault: Fault) -> Outcome:
        began_s = time.monotonic()
        with self.one() as checkout, checkout.broken_by(fault):
            failed = checkout.failures(fault.tests, "-x", slowest_s=SLOWEST_S)
        return Outcome(fault, failed[0] if failed else None, time.monotonic() - began_s)


def run(faults: Sequence[Fault], workers: int) -> int:
    """Inject faults and print the result of each; return the exit status."""
    if odd := [fault for fault in faults if fault.occurrences != 1]:
        for fault in odd:
            print(f"{fault.name}: its snippet occurs {fault.occurrences} times in {fault.file}")
        return 2
    with tempfile.TemporaryDirectory(prefix="glstar-mutants-") as folder:
        checkouts = Workers(Path(folder), workers)
        with ThreadPoolExecutor(workers) as pool:
            tests = list(dict.fromkeys(test for fault in faults for test in fault.tests))
            parts = [tests[number::workers] for number in range(workers)]
            if broken := [
                failure for failures in pool.map(checkouts.failures_when_whole, parts) for failure in failures
            ]:
                print("These fail without any fault:", *broken, sep="\n")
                return 2
            outcomes = []
            for outcome in pool.map(checkouts.outcome, faults):
                outcomes.append(outcome)
                word = "survived" if outcome.caught_by is None else "caught"
                print(f"{word:8}  {outcome.seconds:5.1f} s  {outcome.fault.name}", flush=True)
    return report(outcomes)


def random_faults(count: int, seed: int, only: Sequence[str], lines: LineTests, most_s: float) -> list[Fault]:
    """Return faults drawn at random from the sources, or from the files whose path contains one of some words."""
    faults = []
    for change, old, new in drawn_changes(count, seed, only):
        pairs = zip(old.splitlines(), new.splitlines(), strict=True)
        means = "; ".join(f"{before.strip()}  ->  {after.strip()}" for before, after in pairs if before != after)
        name = f"{change.kind} {change.file}:{change.line}"
        tests = tuple(lines.of(change.file, change.line, most_s))
        times = (lines.time_s(tests), lines.at_import(change.file, change.line))
        faults.append(Fault(name, change.file, old, new, means, tests, *times))
    return faults


def run_random(faults: Sequence[Fault], workers: int) -> int:
    """Inject random faults and print the result of each; return the exit status."""
    outcomes: list[Outcome] = []

    def say(outcome: Outcome) -> None:
        name, means, count = outcome.fault.name, outcome.fault.means, len(outcome.fault.tests)
        by = f"survived {count} tests" if outcome.caught_by is None else f"caught by {outcome.caught_by}"
        print(f"{outcome.seconds:5.1f} s  {name}: {means}\n  {by}", flush=True)
        outcomes.append(outcome)

    with tempfile.TemporaryDirectory(prefix="glstar-mutants-") as folder, ThreadPoolExecutor(workers) as pool:
        folders = [Path(folder, str(number)) for number in range(workers)]
        for one in folders:
            one.mkdir()
        list(pool.map(lambda one: Checkout(one[1]).judge(faults[one[0] :: workers], say), enumerate(folders)))
    return report(outcomes)


def report(outcomes: Sequence[Outcome]) -> int:
    """Print the score and every survivor; return the exit status."""
    survivors = [outcome.fault for outcome in outcomes if outcome.caught_by is None]
    caught = len(outcomes) - len(survivors)
    print(f"\n{caught} of {len(outcomes)} faults were caught: {100 * caught / len(outcomes):.1f} %")
    for fault in survivors:
        print(f"\n{fault.name} ({fault.file}) survived {' '.join(fault.tests[:MOST_NAMED])}\n  {fault.means}")
    return int(caught < LEAST_CAUGHT * len(outcomes))


def main() -> int:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="faults whose names, or files, contain one of these words"
    )
    parser.add_argument("--list", action="store_true", help="print the faults and their consequences")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="number of faults tested at a time")
    parser.add_argument("--random", type=int, metavar="N", help="draw N faults at random from the sources")
    parser.add_argument("--seed", type=int, default=0, help="seed of --random")
    parser.add_argument("--lines", type=Path, metavar="DIR", help="what linetests recorded, for --random")
    parser.add_argument("--most-s", type=float, default=SLOWEST_S, help="tests of a random fault take up to this, s")
    wanted = parser.parse_args()
    if wanted.random is not None:
        if wanted.lines is None:
            parser.error("--random needs --lines DIR; python -m tests.scripts.linetests DIR records it in half an hour")
        if not hasattr(os, "fork"):
            parser.error("--random needs a system that can fork a process, such as Linux or macOS")
        drawn = random_faults(wanted.random, wanted.seed, wanted.only or (), LineTests(wanted.lines), wanted.most_s)
        if wanted.list:
            print(*(f"{fault.name}: {fault.means}" for fault in drawn), sep="\n")
            return 0
        return run_random(drawn, max(1, wanted.workers))
    faults = [fault for fault in kept_faults() if not wanted.only or any(word in fault.name for word in wanted.only)]
    if not faults:
        parser.error(f"no fault is called {' or '.join(wanted.only)}; --list names them")
    if wanted.list:
        by_file: dict[str, list[Fault]] = defaultdict(list)
        for fault in faults:
            by_file[fault.file].append(fault)
        for file, some in by_file.items():
            print(file, *(f"  {fault.name}: {fault.means}" for fault in some), sep="\n")
        return 0
    return run(faults, max(1, wanted.workers))


if __name__ == "__main__":
    sys.exit(main())
