"""Importing glstar opens no window, makes no context and loads nothing heavy."""

import ast
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import glstar

PACKAGE = Path(glstar.__file__).parent
# Each is loaded when something needs it: a context, a window, a link, an image, a table of stars.
HEAVY = ("moderngl", "glfw", "cv2", "pymavlink", "pyulog", "serial", "imgui_bundle", "astropy", "scipy", "tetra3rs")
# OpenCV is what reads and writes images.
MAY_LOAD = {
    "calibrate": {"cv2", "scipy"},
    "compare": {"cv2", "scipy"},
    "export": {"cv2"},
    "gl": {"moderngl"},
    "realimages": {"cv2"},
    "viewer": {"cv2", "glfw", "imgui_bundle", "moderngl"},
}
# What the viewer thinks with, and a script may: no window, no widgets, no OpenGL.
PLAIN = (
    "comparison",
    "curves",
    "frametimes",
    "imageview",
    "keys",
    "overlays",
    "playhead",
    "stretch",
    "timeaxis",
    "trace",
)
# What is imported where, whatever it is inside of: a function, a condition, a type check.
ROOMS = {
    "moderngl": ["gl", "viewer"],
    "glcontext": [],
    "glfw": ["viewer"],
    "imgui_bundle": ["viewer"],
    "pymavlink": ["telemetry", "link"],
    "pyulog": ["telemetry"],
    "serial": ["link"],
    "cv2": ["export", "camerafile", "cli", "viewer", "calibrate", "realimages", "compare"],
    "exifread": ["realimages", "calibrate"],
    "tifffile": ["export", "realimages"],
    "scipy": ["calibrate", "compare"],
    "tetra3rs": ["calibrate"],
    "astropy": ["catalogue"],
    "sqlite3": ["catalogue"],
    "typer": ["cli"],
    "rich": ["cli"],
    "pydantic": ["config"],
}

# Imports each module into a process that knows nothing of glstar, and says what it loaded.
EACH_ALONE = """
import importlib, sys
heavy = {heavy!r}
for name in {names!r}:
    for loaded in [m for m in sys.modules if m.split(".")[0] in {{"glstar", *heavy}} - {kept!r}]:
        del sys.modules[loaded]
    importlib.import_module(name)
    print(name, *sorted({{m.split(".")[0] for m in sys.modules}} & set(heavy)))
"""

MODULES = ["glstar", *(module.name for module in pkgutil.walk_packages([str(PACKAGE)], "glstar."))]
SOURCES = sorted(PACKAGE.rglob("*.py"))


def python(code: str) -> str:
    """Run some code in a process of its own and return what it prints."""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert (child.returncode, child.stderr) == (0, "")
    return child.stdout


def imported(source: Path) -> set[str]:
    """Return the packages that a source file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


def test_importing_glstar_loads_only_glstar() -> None:
    loaded = python("import sys; before = set(sys.modules); import glstar; print(*set(sys.modules) - before)").split()

    assert {name.split(".")[0] for name in loaded} <= {"glstar", "__future__"}


def test_importing_any_module_alone_works_and_loads_nothing_heavy() -> None:
    names = [name for name in MODULES if name != "glstar.__main__"]
    assert {"glstar.cli", "glstar.config", "glstar.export", "glstar.gl.renderer", "glstar.telemetry"} <= set(names)

    # imgui's bindings end a process that imports them twice: what may need them has a process of its own.
    plain = {f"glstar.viewer.{module}" for module in PLAIN}
    windowed = [name for name in names if name.startswith("glstar.viewer.") and name not in plain]
    names = [name for name in names if name not in windowed] + windowed
    alone = EACH_ALONE.format(heavy=HEAVY, kept=set(), names=names[: -len(windowed)])
    together = EACH_ALONE.format(heavy=HEAVY, kept={"imgui_bundle", "glfw"}, names=windowed)

    told = [line.split() for line in (python(alone) + python(together)).splitlines()]

    assert [name for name, *_ in told] == names
    loaded = {name: set(heavy) - MAY_LOAD.get(name.split(".")[1], set()) for name, *heavy in told if "." in name}
    assert {name: heavy for name, heavy in loaded.items() if heavy} == {}
    assert plain <= set(names)
    assert {name: heavy for name, *heavy in told if name in plain and set(heavy) - {"cv2"}} == {}


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


def test_importing_what_draws_makes_no_context() -> None:
    code = """
import sys
import glstar.gl, glstar.gl.context, glstar.gl.renderer
glcontext = sys.modules.get("glcontext")
libraries = open("/proc/self/maps").read() if sys.platform == "linux" else ""
print("libEGL" in libraries, "libGL.so" in libraries)
"""
    assert python(code).split() == ["False", "False"]


def test_importing_glstar_leaves_the_environment_alone() -> None:
    # pymavlink sets MAVLINK_DIALECT as it is imported, and adds two hundred modules.
    imports = "import glstar.cli, glstar.telemetry, glstar.gl"
    code = f"import os; before = dict(os.environ); {imports}; print(os.environ == before)"

    assert python(code).strip() == "True"


@pytest.mark.parametrize("library", ROOMS)
def test_a_library_is_imported_only_in_its_room(library: str) -> None:
    where = {
        source.relative_to(PACKAGE).as_posix()
        for source in SOURCES
        if library in imported(source) and source.relative_to(PACKAGE).with_suffix("").parts[0] not in ROOMS[library]
    }

    assert where == set()


def test_what_is_imported_is_declared() -> None:
    # Of the names that are imported, each belongs to Python, to glstar, or to a dependency in pyproject.toml.
    declared = {
        *("cv2", "erfa", "moderngl", "numpy", "platformdirs", "pydantic", "pymavlink", "rich", "tifffile", "typer"),
        *("pyulog", "yaml", "astropy", "exifread", "glfw", "imgui_bundle", "matplotlib", "scipy", "serial", "tetra3rs"),
    }
    strangers = {
        (source.name, name)
        for source in SOURCES
        for name in imported(source)
        if name not in sys.stdlib_module_names and name not in declared and name != "glstar"
    }

    assert strangers == set()
