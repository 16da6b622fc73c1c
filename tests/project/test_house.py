"""The shape of the code: how many packages and layers there are, and how long a file, a class and a function may be."""

import ast
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "glstar"
SHADERS = [path for path in (ROOT / "shaders").rglob("*") if path.suffix in {".vert", ".frag", ".glsl"}]
SOURCES = sorted(PACKAGE.rglob("*.py"))

# A newcomer can draw this many boxes (the modules and the package below all others are one), and a screen or two shows
# this many lines.
MAX_BOXES = 20
MAX_LAYERS = 9
MAX_LINES = {"file": 500, "class": 400, "function": 60}


def lengths(source: Path) -> Iterator[tuple[str, str, int]]:
    """Yield the kind, the name and the number of lines of a file and of each class and function in it."""
    text = source.read_text(encoding="utf-8")
    yield "file", source.name, len(text.splitlines())
    if source.suffix != ".py":
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ClassDef):
            yield "class", node.name, (node.end_lineno or 0) - node.lineno + 1
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield "function", node.name, (node.end_lineno or 0) - node.lineno + 1


def test_files_classes_and_functions_are_short() -> None:
    too_long = [
        (str(source.relative_to(ROOT)), kind, name, lines)
        for source in SOURCES + SHADERS
        for kind, name, lines in lengths(source)
        if lines > MAX_LINES[kind]
    ]

    assert too_long == []


def test_the_package_has_few_boxes_on_few_layers() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    (layering,) = (contract for contract in settings["contracts"] if contract["type"] == "layers")
    layered = {name.strip() for layer in layering["layers"] for name in layer.split("|")}
    packages = {".".join(("glstar", *path.parent.relative_to(PACKAGE).parts)) for path in PACKAGE.rglob("__init__.py")}
    modules = {f"glstar.{path.stem}" for path in PACKAGE.glob("[!_]*.py")}

    base = {name.strip() for name in layering["layers"][-1].split("|")}

    assert len(layering["layers"]) <= MAX_LAYERS
    assert len((packages | modules) - {"glstar"} - base) + 1 <= MAX_BOXES
    # Every package and module directly under glstar has its layer.
    assert layered == {name for name in packages | modules if name.count(".") == 1}


def hidden_imports(source: Path) -> set[str]:
    """Return the modules of a source file's own package that it imports for type checkers alone."""
    own_package = ".".join(("glstar", *source.parent.relative_to(PACKAGE).parts))
    return {
        inner.module
        for node in ast.walk(ast.parse(source.read_text(encoding="utf-8")))
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
        if isinstance(inner, ast.ImportFrom) and inner.module and inner.module.startswith(own_package)
    }


def test_no_import_for_types_alone_hides_a_cycle() -> None:
    # The package itself shows type checkers the names that it loads lazily.
    sources = [source for source in SOURCES if source != PACKAGE / "__init__.py"]

    assert {str(source.relative_to(ROOT)): hidden for source in sources if (hidden := hidden_imports(source))} == {}


def test_two_things_have_two_names() -> None:
    # The command line has a module for each command, named after it; packages have their __init__.
    files = defaultdict(list)
    classes = defaultdict(list)
    for source in SOURCES:
        if source.parent.name != "cli" and not source.name.startswith("_"):
            files[source.name].append(source.parent.name)
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                classes[node.name].append(str(source.relative_to(ROOT)))

    assert {name: where for name, where in (files | classes).items() if len(where) > 1} == {}
