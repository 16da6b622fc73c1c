"""Shaders made into programs, with the driver's complaints in words."""

import re

import moderngl

from glstar.errors import ShaderError
from glstar.resources import shader

__all__ = ["linked", "set_uniforms"]


def linked(context: moderngl.Context, vertices: str, fragments: str, **constants: int) -> moderngl.Program:
    """Return two shaders as a program.

    Parameters
    ----------
    context : moderngl.Context
    vertices, fragments : str
        File names inside ``shaders/``.
    **constants
        What the fragment shader's preprocessor knows: software OpenGL executes both sides of an ``if``, and only those
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
    version, _, source = shader(fragments).partition("\n")
    # The numbers of lines stay those of the file.
    defined = "".join(f"#define {name} {value}\n" for name, value in constants.items()) + "#line 2\n"
    try:
        return context.program(vertex_shader=shader(vertices), fragment_shader=f"{version}\n{defined}{source}")
    except moderngl.Error as error:
        log = str(error)
        file = fragments if "fragment_shader" in log else vertices
        line = re.search(r"\b0[:(](\d+)", log)
        raise ShaderError(file, None if line is None else int(line.group(1)), log) from error


def set_uniforms(program: moderngl.Program, **uniforms: float | tuple[float, ...]) -> None:
    """Give a program its uniforms.

    Parameters
    ----------
    program : moderngl.Program
    **uniforms
        Values by name; a name that the driver found to be of no use is an error.
    """
    for name, value in uniforms.items():
        program[name] = value
