"""The public names of glstar: the same list at run time, for type checkers and in the manual."""

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

import glstar as gs

ROOT = Path(__file__).parents[2]
STUB = ast.parse((ROOT / "glstar" / "__init__.pyi").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", gs.__all__)
def test_each_public_name_is_that_of_the_module_that_type_checkers_read(name: str) -> None:
    modules = {
        alias.name: node.module for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }

    assert getattr(gs, name) is getattr(import_module(modules[name] or ""), name)


def test_type_checkers_see_the_same_names_as_python() -> None:
    imports = [alias for node in STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    reexported = [alias.name for alias in imports if alias.name == alias.asname]

    assert sorted(alias.name for alias in imports if alias.name != "Final") == sorted(reexported) == sorted(gs.__all__)


def test_the_public_names_are_listed_for_completion() -> None:
    assert set(gs.__all__) <= set(dir(gs))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'glstar' has no attribute 'Kamera'"):
        gs.Kamera  # noqa: B018


def test_the_python_page_of_the_manual_lists_every_public_name() -> None:
    page = (ROOT / "assets" / "manual" / "python.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `gs\.(\w+)[`(]", page, re.MULTILINE)

    assert sorted(listed) == sorted(gs.__all__)
