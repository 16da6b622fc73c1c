"""Flags of the test suite, and the environment of its child processes."""

import ctypes.util
import gc
import os
import signal
import sys
from functools import cache
from pathlib import Path

import pytest
import typer.testing
from hypothesis import HealthCheck, settings

import glstar

# Files with tests of half a minute and more each.
_LONGEST = {
    *("test_view_work.py", "test_view_sky.py", "test_view_link.py", "test_hostileclients.py"),
    *("test_closed_loops.py", "test_orbit_experiments.py"),
}
# No time limit per example: it would depend on the load of the machine.
settings.register_profile("any pace", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any pace")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--regenerate-golden", action="store_true", help="Render the golden images again; inspect them.")


def pytest_configure() -> None:
    # A suite that runs in the background of a shell ignores SIGINT, under nohup SIGHUP, and its children would, too.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
    # As the command line does: waiting threads of OpenBLAS take the processors from the other workers.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A process builds one program of all commands, not one for each command line that a test runs in it.
    typer.testing._get_command = cache(typer.testing._get_command)
    # Each context of OpenGL would start two processes to find its libraries.
    ctypes.util.find_library = cache(ctypes.util.find_library)
    _read_bundled_stars_once()
    # Tests have folders of caches of their own; software OpenGL would compile its shaders again in each: 0.7 s a test.
    os.environ.setdefault("MESA_SHADER_CACHE_DIR", os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache"))
    # Hundreds of children import glstar: they share its compiled modules, as on a user's machine.  Compiling the tests,
    # with what pytest adds to their asserts, takes half of their collection: they are kept, too.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    # Mistakes of glstar's own code are not taken for damage of a file.
    os.environ["GLSTAR_DEVELOPMENT"] = "1"
    # Children take this glstar, from whatever directory they run in, not another one on the user's PYTHONPATH.
    if paths := os.environ.get("PYTHONPATH"):
        ours = Path(glstar.__file__).parents[1]
        os.environ["PYTHONPATH"] = os.pathsep.join(map(os.path.abspath, [ours, *paths.split(os.pathsep)]))


def _read_bundled_stars_once() -> None:
    """Keep the stars of the bundled catalogue, by magnitude: each flight of a test would read them again, in 30 ms."""
    # Later than OPENBLAS_NUM_THREADS, which counts when numpy is imported.
    from glstar.sky.catalogue.reading import CatalogueFile, StarCatalogue  # noqa: PLC0415
    from glstar.system.resources import asset  # noqa: PLC0415

    read, bundled = CatalogueFile.brighter_than, asset("bsc5.sqlite")
    kept: dict[float, StarCatalogue] = {}

    def brighter_than(file: CatalogueFile, vmag: float) -> StarCatalogue:
        if file.path != bundled:
            return read(file, vmag)
        if vmag not in kept:
            kept[vmag] = read(file, vmag)
        return kept[vmag]

    CatalogueFile.brighter_than = brighter_than


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """Return one worker more than processors: while links and windows play in real time, another worker computes."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None
    return 1 + (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


@pytest.fixture
def kept_patterns(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep patterns of stars in a folder of this run, which its workers share: each takes 1.5 s to be made."""
    folder = tmp_path_factory.getbasetemp()
    shared = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    monkeypatch.setenv("XDG_CACHE_HOME", str(shared / "cache"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests that take longest, so that no worker runs one alone at the end."""
    items.sort(key=lambda item: item.path.name not in _LONGEST)


def pytest_collection_finish() -> None:
    # All tests live to the end: each full garbage collection would take half a second to visit them.
    gc.collect()
    gc.freeze()
