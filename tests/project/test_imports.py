"""Importing glstar opens no window, makes no context and loads nothing heavy."""

import ast
import functools
import pkgutil
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import glstar

pytestmark = pytest.mark.slow  # each test starts Python or imports everything

PACKAGE = Path(glstar.__file__).parent
# Each is loaded when something needs it: a context, a window, a link, an image, a table of stars.
HEAVY = (
    *("moderngl", "glfw", "cv2", "pymavlink", "pyulog", "serial", "imgui_bundle", "astropy", "scipy", "tetra3rs"),
    *("distributed", "openpyxl", "pyarrow", "rosbags", "zmq", "pyvirtualcam", "av"),
)
# OpenCV is what reads and writes images.
MAY_LOAD = {
    "calibrate": {"cv2", "scipy"},
    "compare": {"cv2", "scipy"},
    "export": {"cv2"},
    "export.convert.bags": {"cv2", "rosbags"},
    "export.gymnasium": {"cv2", "gymnasium"},
    "export.run.cluster": {"cv2", "distributed", "moderngl"},
    "export.truth.parquet": {"cv2", "pyarrow"},
    "images": {"cv2"},
    # Sets of NightSky-Bench are exports.
    "score.runs": {"cv2"},
    "score.sets": {"cv2"},
    "render.opengl": {"moderngl"},
    "viewer": {"cv2", "glfw", "imgui_bundle", "moderngl"},
    # What `glstar camera calibrate` and the window import when they are called.
    "cli.calibration.output": {"cv2", "scipy"},
    "cli.calibration.photo": {"cv2", "scipy"},
}
# Modules of the viewer that scripts may use: no window, no widgets, no OpenGL.
WINDOWLESS = (
    "flight.loaded",
    "flight.playhead",
    "flight.traces",
    "frametimes",
    "overlays.canvas",
    "overlays.curves",
    "overlays.table",
    "picture.comparison",
    "picture.view",
    "session.keys",
    "session.memory",
    "skyobjects",
)
# Packages that may import a library anywhere in their source: in a function, a condition or for types.
IMPORTED_IN = {
    "moderngl": ["render"],
    "glcontext": [],
    "glfw": ["viewer"],
    "imgui_bundle": ["viewer"],
    "pymavlink": ["telemetry", "link"],
    "pyulog": ["telemetry"],
    "serial": ["link"],
    "cv2": ["export", "camera", "cli", "viewer", "calibrate", "images", "compare", "system"],
    "exifread": ["camera"],
    "tifffile": ["camera", "export"],
    "scipy": ["calibrate", "compare", "flight", "render"],
    "tetra3rs": ["calibrate"],
    "sgp4": ["sky"],
    "astropy": ["sky"],
    "distributed": ["export"],
    "orjson": ["export", "render", "score", "system"],
    "av": ["export"],
    "gymnasium": ["export"],
    "openpyxl": ["telemetry"],
    "lz4": ["telemetry"],
    "mcap": ["telemetry"],
    "rosbags": ["export", "telemetry"],
    "pyvirtualcam": ["export"],
    "zmq": ["export"],
    "pyarrow": ["export", "telemetry"],
    "zlib_ng": ["export", "system"],
    "zstandard": ["telemetry"],
    "sqlite3": ["sky", "telemetry"],
    "typer": ["cli"],
    "rich": ["cli"],
    "pydantic": ["config"],
}

MODULES = ["glstar", *(module.name for module in pkgutil.walk_packages([str(PACKAGE)], "glstar."))]
SOURCES = sorted(PACKAGE.rglob("*.py"))
PACKAGES = [name for name in MODULES if name.count(".") == 1 and name != "glstar.__main__"]


def python(code: str) -> str:
    """Run some code in a process of its own and return what it prints."""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert (child.returncode, child.stderr) == (0, "")
    return child.stdout


@functools.cache
def imported(source: Path) -> frozenset[str]:
    """Return the packages that a source file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return frozenset(names)


def may_load(name: str) -> set[str]:
    """Return the heavy libraries that a module may load: its own entry, else that of its package."""
    parts = name.removeprefix("glstar.").split(".")
    names = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next((MAY_LOAD[within] for within in names if within in MAY_LOAD), set())


def test_no_module_loads_the_statistics_of_scipy() -> None:
    """They take 0.7 s to load; `scipy.special` has the same distributions."""
    statistics = re.compile(r"scipy\.stats|from scipy import [^\n]*\bstats\b")

    assert [path.name for path in SOURCES if statistics.search(path.read_text(encoding="utf-8"))] == []


def test_importing_glstar_loads_only_glstar() -> None:
    loaded = python("import sys; before = set(sys.modules); import glstar; print(*set(sys.modules) - before)").split()

    assert {name.split(".")[0] for name in loaded} <= {"glstar", "__future__"}


def loaded_with(source: Path) -> set[str]:
    """Return the modules of glstar and the libraries that importing a source file imports at once."""
    waiting: list[ast.AST] = [ast.parse(source.read_text(encoding="utf-8"))]
    names: set[str] = set()
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            of_package = {f"{node.module}.{alias.name}": node.module for alias in node.names}
            # A module of a package needs no name that the package's own __init__ defines.
            names |= {name if name in MODULES else package for name, package in of_package.items()}
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or is_for_types(node):
            continue
        waiting.extend(ast.iter_child_nodes(node))
    return {name if name in MODULES else name.split(".")[0] for name in names} - {"glstar", module_of(source)}


def is_for_types(node: ast.AST) -> bool:
    """Return whether only type checkers read a node."""
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def module_of(source: Path) -> str:
    """Return the name of a source file's module."""
    return ".".join(["glstar", *source.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")


def test_no_module_needs_itself() -> None:
    # And so each can be imported first.
    order = TopologicalSorter({module_of(source): loaded_with(source) for source in SOURCES}).static_order()

    assert set(order) >= set(MODULES)


def test_importing_a_module_loads_nothing_heavy() -> None:
    direct = {module_of(source): loaded_with(source) for source in SOURCES}
    loads: dict[str, set[str]] = {}
    for name in MODULES:
        seen, waiting = set(), [name]
        while waiting:
            one = waiting.pop()
            if one not in seen:
                seen.add(one)
                # A module's package is imported before it.
                waiting.extend({*direct.get(one, ()), one.rpartition(".")[0]} - {""})
        loads[name] = seen

    unwanted = {name: loads[name] & set(HEAVY) - may_load(name) for name in MODULES}
    assert {name: heavy for name, heavy in unwanted.items() if heavy} == {}
    windowless = {f"glstar.viewer.{module}" for module in WINDOWLESS}
    assert windowless <= set(MODULES)
    assert {name: heavy for name in windowless if (heavy := loads[name] & set(HEAVY) - {"cv2"})} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imported_alone_loads_nothing_heavy(package: str) -> None:
    code = f"""
import importlib, sys
importlib.import_module({package!r})
print(*sorted({{name.split(".")[0] for name in sys.modules}} & set({HEAVY!r})))
"""
    assert set(python(code).split()) <= may_load(package)


def test_importing_the_window_opens_none() -> None:
    code = """
import os
os.environ.pop("DISPLAY", None)
import glstar.viewer.window, glstar.viewer.loop
import glfw
glfw.ERROR_REPORTING = "ignore"
glfw.get_current_context()
print(glfw.get_error()[0] == glfw.NOT_INITIALIZED)
"""
    assert python(code).strip() == "True"


def test_the_command_line_starts_without_opengl_and_opencv() -> None:
    code = f"""
import sys
from glstar.cli import main
sys.argv = ["glstar", "--version"]
try:
    main()
except SystemExit as leaving:
    print(leaving.code, *sorted({{name.split(".")[0] for name in sys.modules}} & set({HEAVY!r})))
"""
    assert python(code).splitlines() == [f"glstar {glstar.__version__}", "0"]


@pytest.mark.parametrize(("given", "threads"), [(None, "1"), ("4", "4")])
def test_the_command_line_leaves_the_processors_to_what_draws(
    monkeypatch: pytest.MonkeyPatch, given: str | None, threads: str
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    code = """
import os, sys
from glstar.cli import main
print("numpy" in sys.modules)
sys.argv = ["glstar", "--version"]
try:
    main()
except SystemExit:
    print(os.environ["OPENBLAS_NUM_THREADS"])
"""
    assert python(code).splitlines() == ["False", f"glstar {glstar.__version__}", threads]


def test_importing_what_draws_makes_no_context() -> None:
    code = """
import sys
import glstar.render.opengl, glstar.render.opengl.context, glstar.render.opengl.renderer
glcontext = sys.modules.get("glcontext")
libraries = open("/proc/self/maps").read() if sys.platform == "linux" else ""
print("libEGL" in libraries, "libGL.so" in libraries)
"""
    assert python(code).split() == ["False", "False"]


def test_importing_glstar_leaves_the_environment_alone() -> None:
    # pymavlink sets MAVLINK_DIALECT as it is imported, and adds two hundred modules.
    imports = "import glstar.cli, glstar.telemetry, glstar.render.opengl"
    code = f"import os; before = dict(os.environ); {imports}; print(os.environ == before)"

    assert python(code).strip() == "True"


@pytest.mark.parametrize("library", IMPORTED_IN)
def test_a_library_is_imported_only_in_its_packages(library: str) -> None:
    where = {
        source.relative_to(PACKAGE).as_posix()
        for source in SOURCES
        if library in imported(source)
        and source.relative_to(PACKAGE).with_suffix("").parts[0] not in IMPORTED_IN[library]
    }

    assert where == set()


def test_what_is_imported_is_declared() -> None:
    # Of the names that are imported, each belongs to Python, to glstar, or to a dependency in pyproject.toml.
    declared = {
        *("cv2", "erfa", "moderngl", "numpy", "platformdirs", "pydantic", "pymavlink", "rich", "tifffile", "typer"),
        *("pyulog", "yaml", "astropy", "exifread", "glfw", "imgui_bundle", "matplotlib", "scipy", "serial", "tetra3rs"),
        *(
            "av",
            "distributed",
            "foxglove",
            "fsspec",
            "gymnasium",
            "lz4",
            "mcap",
            "openpyxl",
            "orjson",
            "pyarrow",
            "pillow_heif",
            "pyvirtualcam",
            "rawpy",
            "rosbags",
            "sgp4",
            "tomli_w",
            "zlib_ng",
            "zmq",
            "zstandard",
        ),
    }
    strangers = {
        (source.name, name)
        for source in SOURCES
        for name in imported(source)
        if name not in sys.stdlib_module_names and name not in declared and name != "glstar"
    }

    assert strangers == set()
