"""Shaders compiled into programs: includes, preprocessor constants, compiler errors, uniforms."""

import re
from collections.abc import Mapping
from types import MappingProxyType

import moderngl

from glstar.errors import ShaderError
from glstar.system.resources import shader

__all__ = ["linked", "set_uniforms"]

_NONE: Mapping[str, str] = MappingProxyType({})
_INCLUDE = re.compile(r'#include "(.+)"')


def linked(
    context: moderngl.Context, vertices: str, fragments: str, *, generated: Mapping[str, str] = _NONE, **constants: int
) -> moderngl.Program:
    """Return the program of a vertex and a fragment shader.

    A line ``#include "NAME"`` in a shader is replaced by that file of ``shaders/``, or by the generated source of that
    name, unless it has been included before.

    Parameters
    ----------
    context : moderngl.Context
    vertices, fragments : str
        File names inside ``shaders/``.
    generated : mapping of str to str
        GLSL to include, by name.
    **constants
        Preprocessor constants.  Software OpenGL executes both branches of an ``if``, but skips those of an ``#if``.

    Returns
    -------
    moderngl.Program
        Owned by the caller.

    Raises
    ------
    ShaderError
        If the driver rejects one of the shaders.
    """
    try:
        program = context.program(
            vertex_shader=_defined(vertices, constants, generated),
            fragment_shader=_defined(fragments, constants, generated),
        )
    except moderngl.Error as error:
        log = str(error)
        files = [fragments if "fragment_shader" in log else vertices]
        _expanded(files, generated)
        found = re.search(r"\b(\d+)[:(](\d+)", log)
        if found is None or int(found[1]) >= len(files):
            raise ShaderError(files[0], None, log) from error
        raise ShaderError(files[int(found[1])], int(found[2]), log) from error
    program.extra = {}  # the uniforms set so far
    return program


def _defined(file: str, constants: dict[str, int], generated: Mapping[str, str] = _NONE) -> str:
    """Return a shader with its includes and with constants defined; line numbers are those of the files."""
    version, _, source = _expanded([file], generated).partition("\n")
    defined = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return f"{version}\n{defined}#line 2 0\n{source}"


def _expanded(files: list[str], generated: Mapping[str, str]) -> str:
    """Return the last of some files with its includes, which are appended to the list.

    The position of a file in the list is its source string number in the driver's messages.
    """
    own = len(files) - 1
    name = files[own]
    lines = []
    for number, line in enumerate((generated[name] if name in generated else shader(name)).splitlines(), start=1):
        found = _INCLUDE.fullmatch(line)
        if found is None:
            lines.append(line)
        elif found[1] in files:
            lines.append("")
        else:
            files.append(found[1])
            lines += [f"#line 1 {len(files) - 1}", _expanded(files, generated), f"#line {number + 1} {own}"]
    return "\n".join(lines) + "\n"


def set_uniforms(program: moderngl.Program, **uniforms: float | tuple[float, ...]) -> None:
    """Set uniforms of a program returned by `linked`; values that have not changed are not sent again.

    Parameters
    ----------
    program : moderngl.Program
    **uniforms
        Values by name.  Setting a uniform that the driver has optimised away is an error.
    """
    given = program.extra
    for name, value in uniforms.items():
        if name not in given or given[name] != value:
            program[name] = given[name] = value
