"""Shaders made into programs, with the driver's complaints in words."""

import re

import moderngl

from glstar.errors import ShaderError
from glstar.resources import shader

__all__ = ["linked", "set_uniforms"]


def linked(context: moderngl.Context, vertices: str, fragments: str) -> moderngl.Program:
    """Return two shaders as a program.

    Parameters
    ----------
    context : moderngl.Context
    vertices, fragments : str
        File names inside ``shaders/``.

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
        return context.program(vertex_shader=shader(vertices), fragment_shader=shader(fragments))
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
