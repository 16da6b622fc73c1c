"""Shaders made into programs, with the driver's complaints in words."""

import re

import moderngl

from glstar.errors import ShaderError
from glstar.system.resources import shader

__all__ = ["linked", "set_uniforms"]


def linked(context: moderngl.Context, vertices: str, fragments: str, **constants: int) -> moderngl.Program:
    """Return two shaders as a program.

    Parameters
    ----------
    context : moderngl.Context
    vertices, fragments : str
        File names inside ``shaders/``.
    **constants
        What the shaders' preprocessor knows: software OpenGL executes both sides of an ``if``, and only those
        of an ``#if`` for nothing.

    Returns
    -------
    moderngl.Program
        The caller's to release.

    Raises
    ------
    ShaderError
        If the driver refuses one of them.
    """
    try:
        program = context.program(
            vertex_shader=_defined(vertices, constants), fragment_shader=_defined(fragments, constants)
        )
    except moderngl.Error as error:
        log = str(error)
        file = fragments if "fragment_shader" in log else vertices
        line = re.search(r"\b0[:(](\d+)", log)
        raise ShaderError(file, None if line is None else int(line.group(1)), log) from error
    program.extra = {}  # the uniforms that it was given
    return program


def _defined(file: str, constants: dict[str, int]) -> str:
    """Return a shader that knows some constants; the numbers of its lines stay those of the file."""
    version, _, source = shader(file).partition("\n")
    defined = "".join(f"#define {name} {value}\n" for name, value in constants.items())
    return f"{version}\n{defined}#line 2\n{source}"


def set_uniforms(program: moderngl.Program, **uniforms: float | tuple[float, ...]) -> None:
    """Give a program of `linked` its uniforms, those that it has not been given already: most stay as they are.

    Parameters
    ----------
    program : moderngl.Program
    **uniforms
        Values by name; a name that the driver found to be of no use is an error.
    """
    given = program.extra
    for name, value in uniforms.items():
        if name not in given or given[name] != value:
            program[name] = given[name] = value
