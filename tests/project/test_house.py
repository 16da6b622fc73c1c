"""The shape of the code: how many modules and rooms a folder holds, and how long a file, a class and a function may be.

The rules serve the reader: none of them is met by splitting a file that one other module imports.
"""

import ast
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "glstar"
SHADERS = [path for path in (ROOT / "shaders").rglob("*") if path.suffix in {".vert", ".frag", ".glsl"}]
SOURCES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted({source.parent for source in SOURCES})

# A newcomer can read a listing of this many names.
MAX_MODULES, MAX_ROOMS = 12, 8
MAX_LAYERS = 9
# Lines of code: docstrings, comments and blank lines are free, so that no explanation is squeezed to meet a number.
MAX_LINES = {"file": 400, "class": 300, "function": 60}
MAX_SHADER_LINES = 500
# The whole package, packages included.  It had 350 when its rooms were built; each capability since then (the camera of
# a simulated flight, sets for solvers, pages for a browser, one table of flags, a free view) brought some of its own.
MAX_ALL_MODULES = 385


# Nodes that contain statements.
_HOLDERS = (ast.stmt, ast.excepthandler, ast.match_case)


@cache
def tree_of(source: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(source.read_text(encoding="utf-8"))


def documented(tree: ast.Module) -> Iterator[ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef]:
    """Yield the module, its classes and its functions: only statements are searched, which hold them all."""
    nodes: list[ast.AST] = [tree]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
        nodes += [child for child in ast.iter_child_nodes(node) if isinstance(child, _HOLDERS)]


def lines_of(node: ast.stmt) -> set[int]:
    return set(range(node.lineno, (node.end_lineno or node.lineno) + 1))


def code_lines(text: str, tree: ast.Module) -> list[int]:
    """Return the numbers of the lines that hold code, from 1."""
    docstrings: set[int] = set()
    for node in documented(tree):
        if ast.get_docstring(node, clean=False) is not None:
            docstrings |= lines_of(node.body[0])
    lines = enumerate(text.splitlines(), 1)
    return [at for at, line in lines if at not in docstrings and line.strip() and not line.lstrip().startswith("#")]


def lengths(source: Path) -> Iterator[tuple[str, str, int]]:
    """Yield the kind, the name and the lines of code of a file and of each class and function in it."""
    tree = tree_of(source)
    code = set(code_lines(source.read_text(encoding="utf-8"), tree))
    yield "file", source.name, len(code)
    for node in documented(tree):
        if not isinstance(node, ast.Module):
            kind = "class" if isinstance(node, ast.ClassDef) else "function"
            yield kind, node.name, len(lines_of(node) & code)


def test_only_code_is_counted() -> None:
    text = '"""A module."""\n\n# A comment.\nX = 1\n\n\ndef f():\n    """It.\n\n    Twice.\n    """\n    return 1'

    assert code_lines(text, ast.parse(text)) == [4, 7, 12]


def test_files_classes_and_functions_are_short() -> None:
    too_long = [
        (str(source.relative_to(ROOT)), kind, name, lines)
        for source in SOURCES
        for kind, name, lines in lengths(source)
        if lines > MAX_LINES[kind]
    ]
    shaders = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in SHADERS}

    assert too_long == []
    assert {name: lines for name, lines in shaders.items() if lines > MAX_SHADER_LINES} == {}


def test_a_folder_holds_few_modules_and_rooms() -> None:
    held = {
        str(folder.relative_to(ROOT)): (
            sum(path.name != "__init__.py" for path in folder.glob("*.py")),
            sum(path.parent == folder for path in FOLDERS),
        )
        for folder in FOLDERS
        if folder != PACKAGE
    }

    assert {name: counts for name, counts in held.items() if counts[0] > MAX_MODULES or counts[1] > MAX_ROOMS} == {}


def test_the_whole_package_has_few_modules() -> None:
    assert len(SOURCES) <= MAX_ALL_MODULES


def test_every_package_has_its_layer() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    (layering,) = (contract for contract in settings["contracts"] if "glstar.sky" in contract.get("layers", ()))
    layered = {name.strip() for layer in layering["layers"] for name in layer.split("|")}
    packages = {f"glstar.{folder.name}" for folder in FOLDERS if folder.parent == PACKAGE}
    modules = {f"glstar.{path.stem}" for path in PACKAGE.glob("[!_]*.py")}

    assert len(layering["layers"]) <= MAX_LAYERS
    assert layered == packages | modules


@pytest.mark.parametrize("package", ["calibrate", "export", "render", "sky", "telemetry", "viewer"])
def test_the_rooms_of_a_package_have_an_order(package: str) -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    orders = [contract for contract in settings["contracts"] if contract.get("containers") == [f"glstar.{package}"]]

    assert [(order["type"], order["exhaustive"]) for order in orders] == [("layers", True)]


def hidden_imports(source: Path) -> set[str]:
    """Return the modules of a source file's own package that it imports for type checkers alone."""
    own_package = ".".join(("glstar", *source.parent.relative_to(PACKAGE).parts))
    return {
        inner.module
        for node in ast.walk(tree_of(source))
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
        if isinstance(inner, ast.ImportFrom) and inner.module and inner.module.startswith(own_package)
    }


def test_no_import_for_types_alone_hides_a_cycle() -> None:
    # The package itself shows type checkers the names that it loads lazily.
    sources = [source for source in SOURCES if source != PACKAGE / "__init__.py"]

    assert {str(source.relative_to(ROOT)): hidden for source in sources if (hidden := hidden_imports(source))} == {}


def test_two_things_have_two_names() -> None:
    # Within a package: `truth.columns` and `score.columns` may both exist.
    names = defaultdict(list)
    for source in SOURCES:
        package = source.relative_to(PACKAGE).parts[0]
        if not source.name.startswith("_"):
            names[package, source.name].append(str(source.relative_to(ROOT)))
        for node in tree_of(source).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                names[package, node.name].append(str(source.relative_to(ROOT)))

    assert {name: where for name, where in names.items() if len(where) > 1} == {}
