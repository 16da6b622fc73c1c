"""Another revision of glstar beside this one, for benchmarks and comparisons: a git worktree of its own.

A child runs a module of this checkout's tests with the glstar of either: both are measured by the same code.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HERE = Path(__file__).parents[2]

# Imports glstar from one checkout, and after it the tests from this one.
_BOOT = """
import sys
tree, here, module, *arguments = sys.argv[1:]
sys.path.insert(0, tree)
import glstar
sys.path[0] = here
sys.argv = [module, *arguments]
import runpy
runpy.run_module(module, run_name="__main__", alter_sys=False)
"""


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """Check a revision out into a folder of its own, and remove it afterwards."""
    with TemporaryDirectory() as folder:
        tree = Path(folder) / "other"
        _git("worktree", "add", "--quiet", "--detach", str(tree), revision)
        try:
            yield tree
        finally:
            _git("worktree", "remove", "--force", str(tree))


def _git(*arguments: str) -> None:
    subprocess.run(["git", "-C", str(HERE), *arguments], check=True)


def command(tree: Path, module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of this checkout's tests with the glstar of a checkout."""
    return [sys.executable, "-c", _BOOT, str(tree), str(HERE), module, *arguments]


class Turns:
    """Children that do the same steps with the glstar of two checkouts, one after the other.

    Each runs `module` with `arguments`, which calls `serve`.
    """

    def __init__(self, trees: Mapping[str, Path], module: str, *arguments: str) -> None:
        self._children = {
            name: subprocess.Popen(
                command(tree, module, *arguments),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                # As the command line sets it: waiting threads of OpenBLAS take processor time.
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )
            for name, tree in trees.items()
        }
        for name in self._children:  # both are ready before the first turn
            self._answer(name)

    def take(self, step: int) -> dict[str, dict[str, float]]:
        """Let each child do a step, and return what it has measured by the name of its checkout.

        The order changes from step to step.
        """
        names = list(self._children)[:: 1 if step % 2 else -1]
        return {name: self._ask(name, step) for name in names}

    def _ask(self, name: str, step: int) -> dict[str, float]:
        pipe = self._children[name].stdin
        assert pipe is not None
        print(step, file=pipe, flush=True)
        return self._answer(name)

    def _answer(self, name: str) -> dict[str, Any]:
        pipe = self._children[name].stdout
        assert pipe is not None
        for line in pipe:
            if line.startswith("{"):
                return json.loads(line)
        raise RuntimeError(f"the benchmark of {name} has ended early")

    def close(self) -> None:
        """End the children."""
        for child in self._children.values():
            child.communicate()

    def __enter__(self) -> "Turns":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve(step: Callable[[int], Mapping[str, float]]) -> None:
    """Do the steps whose numbers arrive on standard input; answer each with what it has measured, as JSON."""
    print("{}", flush=True)
    for line in sys.stdin:
        print(json.dumps(dict(step(int(line)))), flush=True)
